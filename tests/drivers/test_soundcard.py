"""The sound card plays a sine without clicks or gaps, or says that it did not."""

import math
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.context import BenchContext
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.generators.oscillator import Oscillator
from drivers.generators.soundcard import SoundCardGenerator
from drivers.roles import SignalGenerator
from protocols.bench import BenchFile
from protocols.preparation import Preparation

RATE_HZ = 48_000
FULL_SCALE_V = 20.0
PREPARATION = Preparation("R07", "A", "asymmetric")


# --- The samples -------------------------------------------------------------------------------


def oscillator():
    return Oscillator(RATE_HZ, FULL_SCALE_V, Fraction(1000))


def filled(oscillator, *counts):
    """Samples of successive blocks, joined."""
    blocks = [np.full(count, np.nan, np.float32) for count in counts]
    for block in blocks:
        oscillator.fill(block)
    return np.concatenate(blocks)


def playing(frequency_hz, volts):
    started = oscillator()
    started.play(Fraction(frequency_hz), volts, 0)
    return started


def sine_of(turns):
    """Sines of exact phases."""
    return np.array([math.sin(2 * math.pi * float(turn % 1)) for turn in turns])


def assert_equal_to_float32(samples, expected):
    half_ulp = np.spacing(np.abs(expected).astype(np.float32)).astype(float) / 2
    assert np.all(np.abs(samples - expected) <= half_ulp * (1 + 1e-6) + 1e-15)


FREQUENCIES_HZ = st.fractions(20, 20_000, max_denominator=10**6)
VOLTS = st.floats(0, FULL_SCALE_V)


@given(frequency_hz=FREQUENCIES_HZ, volts=VOLTS)
@settings(max_examples=25)
def test_samples_are_those_of_the_sine(frequency_hz, volts):
    samples = filled(playing(frequency_hz, volts), 700)
    phases = [n * frequency_hz / RATE_HZ for n in range(700)]
    assert_equal_to_float32(samples, volts / FULL_SCALE_V * sine_of(phases))


def test_the_phase_is_kept_for_hours():
    """After 20 s a frequency that is no multiple of anything is still there to the last bit."""
    frequency_hz, late = Fraction(2033075, 1000) + Fraction(1, 7), 20 * RATE_HZ
    voice = playing(frequency_hz, 16.0)
    filled(voice, late)
    phases = [n * frequency_hz / RATE_HZ for n in range(late, late + 200)]
    assert_equal_to_float32(filled(voice, 200), 0.8 * sine_of(phases))


TONES = st.tuples(FREQUENCIES_HZ, VOLTS, st.integers(0, 3000))
STRETCHES = st.lists(
    st.tuples(TONES, st.lists(st.integers(1, 2500), min_size=1, max_size=6)),
    min_size=1,
    max_size=4,
)


@given(stretches=STRETCHES)
@settings(max_examples=60)
def test_samples_do_not_depend_on_how_they_are_cut(stretches):
    cut, whole = oscillator(), oscillator()
    for tone, blocks in stretches:
        cut.play(*tone)
        whole.play(*tone)
        np.testing.assert_array_equal(filled(cut, *blocks), filled(whole, sum(blocks)))
    assert cut.progress.samples == whole.progress.samples
    assert cut.progress.volts == whole.progress.volts


def test_blocks_may_be_larger_than_what_is_made_at_once():
    np.testing.assert_array_equal(
        filled(playing(777, 3.0), 20_001), filled(playing(777, 3.0), *[3] * 6667)
    )


@given(before_hz=FREQUENCIES_HZ, after_hz=FREQUENCIES_HZ, before=st.integers(1, 900))
@settings(max_examples=25)
def test_a_change_of_frequency_keeps_the_phase(before_hz, after_hz, before):
    voice = playing(before_hz, 10.0)
    first = filled(voice, before)
    voice.play(after_hz, 10.0, 0)
    samples = np.concatenate([first, filled(voice, 300)])
    phases = [n * before_hz / RATE_HZ for n in range(before)]
    phases += [(before * before_hz + n * after_hz) / RATE_HZ for n in range(300)]
    assert_equal_to_float32(samples, 0.5 * sine_of(phases))


@given(start_v=VOLTS, end_v=VOLTS, count=st.integers(1, 6000))
@settings(max_examples=60)
def test_a_ramp_is_even_and_ends_exactly(start_v, end_v, count):
    # At a quarter of the sample rate, every other sample is the peak.
    ramped, steady = playing(RATE_HZ // 4, start_v), playing(RATE_HZ // 4, end_v)
    filled(ramped, 4)
    ramped.play(Fraction(RATE_HZ, 4), end_v, count)
    samples, reference = filled(ramped, count + 8), filled(steady, count + 8)
    volts = np.abs(samples[1::2].astype(float)) * FULL_SCALE_V
    part = np.minimum(np.arange(2, count + 9, 2) / count, 1)[: volts.size]
    np.testing.assert_allclose(volts, start_v + (end_v - start_v) * part, rtol=1e-7, atol=1e-12)
    assert np.all(np.diff(volts) * np.sign(end_v - start_v) >= 0)
    np.testing.assert_array_equal(samples[count - 1 :], reference[count - 1 :])


def test_progress_says_when_a_ramp_has_ended():
    voice = playing(1000, 2.0)
    filled(voice, 10)
    tone = voice.play(Fraction(1000), 4.0, 500)
    assert voice.progress.tone is not tone, "not before the next block"
    filled(voice, 499)
    assert voice.progress.tone is tone
    assert (voice.progress.samples, voice.progress.ramp_left) == (509, 1)
    assert voice.progress.volts == pytest.approx(2 + 2 * 499 / 500, rel=1e-12)
    filled(voice, 1)
    assert (voice.progress.volts, voice.progress.ramp_left) == (4.0, 0)


def test_a_ramp_that_is_overtaken_goes_on_from_where_it_was():
    voice = playing(RATE_HZ // 4, 0.0)
    voice.play(Fraction(RATE_HZ, 4), 16.0, 1600)
    rising = filled(voice, 800)
    voice.play(Fraction(RATE_HZ, 4), 0.0, 800)
    volts = FULL_SCALE_V * np.abs(np.concatenate([rising, filled(voice, 900)])[1::2])
    assert volts.max() == pytest.approx(8.0)
    np.testing.assert_allclose(np.abs(np.diff(volts[:800])), 0.02, rtol=1e-3)
    assert not volts[800:].any()


# --- A card that is played by hand ---------------------------------------------------------------


class PortAudioError(Exception):
    pass


class CallbackAbort(Exception):  # noqa: N818  # the name in sounddevice
    pass


class FakeStream:
    """A stream that asks for as many samples as time has passed on `FakeCard`."""

    latency = 0.0421

    def __init__(self, card, device, samplerate, blocksize, channels, dtype, latency, callback):
        self.card, self.device, self.samplerate = card, device, card.rate_hz or samplerate
        self.blocksize, self.channels, self.dtype = blocksize, channels, dtype
        self.asked_latency_s, self._callback = latency, callback
        self.calls, self.blocks, self._owed = [], [], 0.0
        self.running = self.vanished = self.stalled = self.sticks = False
        self.underflows, self.status_error, self.stop_error = 0, None, None

    @property
    def active(self):
        if self.vanished:
            raise PortAudioError("Device unavailable", -9985)
        return self.running

    @property
    def played(self):
        """(samples, channels) since the stream was opened."""
        return np.concatenate(self.blocks or [np.empty((0, self.channels), np.float32)])

    def start(self):
        self.calls.append("start")
        if self.card.start_error:
            raise self.card.start_error
        self.running = True

    def stop(self, ignore_errors=True):
        self._end("stop")

    def abort(self, ignore_errors=True):
        self._end("abort")

    def close(self):
        self.calls.append("close")
        self.running = False

    def _end(self, name):
        self.calls.append(name)
        if self.stop_error:
            raise self.stop_error
        self.running = self.sticks
        self.vanished = False

    @property
    def output_underflow(self):
        """As of the status that a callback is handed, which this stream is too."""
        if self.status_error:
            raise self.status_error
        self.underflows -= 1
        return self.underflows >= 0

    def pass_time(self, seconds):
        self._owed += seconds * self.samplerate
        while self._owed >= self.blocksize and self.running and not self.stalled:
            self._owed -= self.blocksize
            # What PortAudio hands over is not empty.
            block = np.full((self.blocksize, self.channels), 0.99, self.dtype)
            try:
                self._callback(block, self.blocksize, None, self)
            except CallbackAbort:
                self.running = False
            self.blocks.append(block)


class FakeCard:
    """Stands for the module ``sounddevice``, and for the clock that it plays by."""

    PortAudioError, CallbackAbort = PortAudioError, CallbackAbort

    def __init__(self):
        self.devices = [
            {"index": 0, "name": "Microphone", "max_output_channels": 0, "hostapi": 0},
            {"index": 1, "name": "Scarlett", "max_output_channels": 4, "hostapi": 0},
            {"index": 2, "name": "Scarlett HDMI", "max_output_channels": 1, "hostapi": 0},
        ]
        self.rate_hz = self.open_error = self.start_error = self.stream = None
        self._now_s = 5.0

    def query_devices(self, device=None, kind=None):
        if kind is None:
            return self.devices
        found = [
            known
            for known in self.devices
            if known["max_output_channels"]
            and (device in (None, known["index"]) or str(device) in known["name"])
        ]
        if len(found) != 1 and isinstance(device, str):
            raise ValueError(f"{len(found)} devices\nmatch")
        if not found:
            raise PortAudioError("Error querying device -1")
        return found[0]

    def query_hostapis(self, index):
        return {"name": ["ALSA"][index]}

    def get_portaudio_version(self):
        return 1246720, "PortAudio V19.6.0-devel,\nrevision 396fe4b"

    def OutputStream(self, **asked):  # noqa: N802  # the name in sounddevice
        if self.open_error:
            raise self.open_error
        self.stream = FakeStream(self, **asked)
        return self.stream

    def now_s(self):
        return self._now_s

    def wait(self, seconds):
        self._now_s += seconds
        if self._now_s > 1000:
            raise TimeoutError("waited for ever")
        if self.stream:
            self.stream.pass_time(seconds)


@pytest.fixture
def card(monkeypatch):
    fake = FakeCard()
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    return fake


def bench_of(changes=None, **options):
    content = {
        "instruments.generator.driver": "drivers.generators.soundcard:SoundCardGenerator",
        "instruments.generator.output": {"amplifier_gain": 16.0, "load": "8 ohm"},
        "instruments.generator.options": {"volts_per_full_scale": 1.25, "device": 1, **options},
        "limits.volts_min": "0.5 V",
    }
    return BenchFile.from_file().replace(content | (changes or {}))


def open_generator(card, changes=None, **options):
    bench = bench_of(changes, **options)
    context = BenchContext(bench, PREPARATION, np.random.default_rng(1), lambda _: None)
    return SoundCardGenerator(bench.instruments.generator, context, clock=card)


@pytest.fixture
def generator(card):
    return open_generator(card)


HZ = Fraction(20001, 10)


def played_volts(card, since=0, column=0):
    """What the loudspeaker got, from sample `since` on."""
    return card.stream.played[since:, column].astype(float) * FULL_SCALE_V


def assert_sine(volts, frequency_hz, peak_v):
    """Samples are a sine of this frequency and peak, of whatever phase."""
    phase = 2 * math.pi * float(frequency_hz) / RATE_HZ * np.arange(volts.size)
    basis = np.stack([np.sin(phase), np.cos(phase)], axis=1)
    (a, b), *_ = np.linalg.lstsq(basis, volts)
    assert math.hypot(a, b) == pytest.approx(peak_v, rel=1e-6)
    np.testing.assert_allclose(basis @ [a, b], volts, atol=2e-6 * peak_v)


def test_it_fills_the_role_and_says_that_it_is_unlocked(generator):
    assert isinstance(generator, SignalGenerator)
    assert generator.identity == (
        "sound card 'Scarlett' on ALSA, 48000 Hz, unlocked; PortAudio V19.6.0-devel, "
        "revision 396fe4b"
    )
    assert generator.read() == (20, 0.0, False)


def test_opening_makes_no_sound(card, generator):
    assert (card.stream.calls, card.stream.device, card.stream.dtype) == ([], 1, "float32")
    assert card.stream.asked_latency_s == pytest.approx(2 * 1024 / 48_000)


def test_a_sine_has_the_volts_at_the_load_that_were_asked(card, generator):
    generator.set_sine(HZ, 16.0)
    assert generator.read() == (HZ, 16.0, True)
    since = len(card.stream.played)
    card.wait(0.2)
    assert_sine(played_volts(card, since), HZ, 16.0)
    assert 0.79 < np.abs(card.stream.played[since:, 0]).max() <= 0.8
    assert not card.stream.played[:, 1].any(), "the other channel is silent"


def test_the_amplifier_multiplies_the_volts_of_the_card(card):
    output = {"amplifier_gain": 40.0, "load": "8 ohm"}
    open_generator(card, {"instruments.generator.output": output}).set_sine(HZ, 16.0)
    assert np.abs(card.stream.played).max() == pytest.approx(16 / (40 * 1.25), rel=0.01)


def test_a_sine_has_reached_the_load_when_set_sine_returns(card, generator):
    generator.set_sine(HZ, 4.0)
    generator.set_sine(HZ + 50, 8.0)
    heard = len(card.stream.played) - round(card.stream.latency * RATE_HZ)
    card.wait(0.1)
    assert_sine(played_volts(card, heard), HZ + 50, 8.0)


def test_no_change_clicks(card, generator):
    generator.set_sine(HZ, 16.0)
    generator.set_sine(2 * HZ, 0.5)
    generator.set_sine(HZ / 2, 16.0)
    generator.output_off()
    generator.set_sine(HZ, 16.0)
    generator.close()
    volts = played_volts(card)
    # The steepest slope of the sines, and that of the ramps, which 50 ms make slight.
    steepest = 16 * 2 * math.sin(math.pi * float(2 * HZ) / RATE_HZ)
    assert np.abs(np.diff(volts, prepend=0.0)).max() < steepest + 16 / 2400
    assert volts[-1] == 0.0


@pytest.mark.parametrize(
    ("duration_s", "samples"), [(0.2, 9600), (0.05, 2400), (0, 2400), (0.07, 3360), (3, 144_000)]
)
def test_a_ramp_lasts_as_many_samples_as_asked(card, generator, duration_s, samples):
    generator.set_sine(Fraction(RATE_HZ, 4), 4.0)
    since = len(card.stream.played)
    generator.ramp_to(12.0, duration_s)
    assert generator.read() == (Fraction(RATE_HZ, 4), 12.0, True)
    volts = np.abs(played_volts(card, since))
    changing = np.flatnonzero((volts > 4.0001) & (volts < 11.9999))
    assert samples - 4 <= changing[-1] - changing[0] + 1 <= samples
    per_sample_v = np.ptp(volts[changing]) / (changing[-1] - changing[0])
    assert per_sample_v == pytest.approx(8 / samples, rel=1e-5)


def test_a_ramp_down_ends_in_silence(card, generator):
    generator.set_sine(HZ, 12.0)
    generator.ramp_to(0.0, 0.1)
    assert generator.read() == (HZ, 0.0, True)
    since = len(card.stream.played)
    card.wait(0.1)
    assert not played_volts(card, since).any()
    assert card.stream.calls == ["start"]


def test_output_off_fades_and_stops(card, generator):
    generator.set_sine(HZ, 12.0)
    since = len(card.stream.played)
    generator.output_off()
    assert card.stream.calls == ["start", "stop"]
    assert generator.read() == (HZ, 0.0, False)
    fade = played_volts(card, since)
    last = np.flatnonzero(fade)[-1]
    assert 2390 <= last <= 2400 + 2 * 1024
    assert fade[-1] == 0.0
    generator.output_off()
    assert card.stream.calls == ["start", "stop"]


def test_an_output_that_is_off_ramps_to_nothing_but_0_v(card, generator):
    generator.ramp_to(0.0, 0.1)
    with pytest.raises(InstrumentError, match=r"output is off, but was asked to ramp to 2 V; call"):
        generator.ramp_to(2.0, 0.1)
    assert card.stream.calls == []


def test_0_v_switches_on_and_is_silent(card, generator):
    generator.set_sine(HZ, 0.0)
    assert generator.read() == (HZ, 0.0, True)
    assert not card.stream.played.any()


def test_another_channel_may_drive_the_amplifier(card):
    open_generator(card, channel=3).set_sine(HZ, 8.0)
    assert card.stream.channels == 3
    assert card.stream.played[:, 2].any()
    assert not card.stream.played[:, :2].any()


def test_a_card_of_one_channel_is_opened_with_one(card):
    open_generator(card, device="HDMI")
    assert (card.stream.device, card.stream.channels) == (2, 1)


# --- What is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hertz", "volts", "said"),
    [
        (Fraction(19), 2.0, "was asked for 19 Hz, outside 20 to 20000 Hz"),
        (Fraction(20001), 2.0, "was asked for 20001 Hz"),
        (math.nan, 2.0, "was asked for nan Hz"),
        (math.inf, 2.0, "was asked for inf Hz"),
        ("loud", 2.0, "was asked for 'loud' Hz"),
        (Fraction(10**400), 2.0, "was asked for Fraction"),
        (True, 2.0, "was asked for 1 Hz"),
        (HZ, 0.4, "was asked for 0.4 V, outside 0.5 to 16 V"),
        (HZ, 16.1, "was asked for 16.1 V"),
        (HZ, -2.0, "was asked for -2 V"),
        (HZ, math.nan, "was asked for nan V"),
        (HZ, math.inf, "was asked for inf V"),
        (HZ, "2", "was asked for 2 V"),
        (HZ, True, "was asked for 1 V"),
        (HZ, None, "was asked for None V"),
    ],
)
@pytest.mark.parametrize("on", [False, True])
def test_limits_are_checked_before_anything_is_played(card, generator, on, hertz, volts, said):
    if on:
        generator.set_sine(HZ, 8.0)
    before = generator.read(), list(card.stream.calls)
    with pytest.raises(LimitError, match=said):
        generator.set_sine(hertz, volts)
    if hertz == HZ:
        with pytest.raises(LimitError, match=said):
            generator.ramp_to(volts, 0.1)
    assert (generator.read(), card.stream.calls) == before


@pytest.mark.parametrize("duration_s", [-0.1, math.nan, math.inf, "1", None])
def test_durations_are_checked(generator, duration_s):
    generator.set_sine(HZ, 8.0)
    with pytest.raises(LimitError, match="give a time"):
        generator.ramp_to(2.0, duration_s)
    assert generator.read() == (HZ, 8.0, True)


def test_clipping_is_refused(card):
    with pytest.raises(
        BenchSetupError, match=r"limits.volts_max: 16 V peak are not below the 16 V"
    ):
        open_generator(card, volts_per_full_scale=1.0)
    assert card.stream is None
    open_generator(card, volts_per_full_scale=1.0001).set_sine(HZ, 16.0)
    card.wait(0.1)
    assert 0.99 < np.abs(card.stream.played).max() < 1


# --- What goes wrong while it plays ------------------------------------------------------------


def test_a_dropout_is_reported_once(card, generator):
    generator.set_sine(HZ, 8.0)
    card.stream.underflows = 3
    card.wait(0.2)
    with pytest.raises(InstrumentError, match=r"dropped samples 3 time\(s\).*raise .*block_frames"):
        generator.read()
    assert generator.read() == (HZ, 8.0, True)


def test_a_dropout_since_the_last_step_stops_the_next_one(card, generator):
    generator.set_sine(HZ, 8.0)
    card.stream.underflows = 1
    card.wait(0.1)
    with pytest.raises(InstrumentError, match="frames taken since then saw no sine"):
        generator.set_sine(HZ + 10, 8.0)
    assert generator.read() == (HZ, 8.0, True), "nothing has changed"


def test_a_dropout_in_a_change_is_reported(card, generator):
    generator.set_sine(HZ, 8.0)
    card.stream.underflows = 1
    with pytest.raises(InstrumentError, match=r"dropped samples 1 time\(s\)"):
        generator.set_sine(HZ + 10, 8.0)


def test_a_dropout_does_not_keep_the_volts_up(card, generator):
    generator.set_sine(HZ, 8.0)
    card.stream.underflows = 1
    with pytest.raises(InstrumentError, match="dropped samples"):
        generator.ramp_to(0.0, 0.1)
    assert generator.read() == (HZ, 0.0, True)
    generator.output_off()


def test_a_gap_in_silence_or_before_the_output_was_switched_on_is_none(card, generator):
    generator.set_sine(HZ, 0.0)
    card.stream.underflows = 1
    card.wait(0.1)
    assert generator.read()[2]
    generator.ramp_to(8.0, 0.1)
    card.stream.underflows = 1
    generator.output_off()
    generator.set_sine(HZ, 2.0)
    assert generator.read() == (HZ, 2.0, True)


def test_an_error_on_the_audio_thread_is_raised_on_the_main_one(card, generator):
    generator.set_sine(HZ, 8.0)
    card.stream.status_error = cause = RuntimeError("broken")
    card.wait(0.1)
    assert not card.stream.blocks[-1].any()
    assert not card.stream.running
    for ask in (generator.read, lambda: generator.set_sine(HZ, 8.0)):
        with pytest.raises(InstrumentError, match=r"audio thread failed \(RuntimeErr") as raised:
            ask()
        assert raised.value.__cause__ is cause
    generator.output_off()
    card.stream.status_error = None
    generator.set_sine(HZ, 8.0)
    assert generator.read() == (HZ, 8.0, True)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"running": False}, "plays no more, its stream has ended"),
        ({"vanished": True}, "plays no more, PortAudio says: .*Device unavailable"),
        ({"stalled": True}, "has asked for no samples for 2 s"),
    ],
)
def test_a_card_that_vanishes_is_missed(card, generator, fault, said):
    generator.set_sine(HZ, 8.0)
    vars(card.stream).update(fault)
    for ask in (
        generator.read,
        lambda: generator.set_sine(HZ, 8.0),
        lambda: generator.ramp_to(0.0, 0.1),
    ):
        with pytest.raises(InstrumentError, match=said):
            ask()
    generator.output_off()
    assert card.stream.calls[-1] == "abort", "no longer able to fade"
    assert generator.read() == (HZ, 0.0, False)


def test_a_stream_that_broke_off_starts_again_from_silence(card, generator):
    generator.set_sine(HZ, 16.0)
    card.stream.running = False
    generator.output_off()
    since = len(card.stream.played)
    generator.set_sine(HZ, 16.0)
    assert np.abs(played_volts(card, since)[:100]).max() < 16 * 100 / 2400
    assert generator.read() == (HZ, 16.0, True)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"stop_error": PortAudioError("Unanticipated host error")}, "Unanticipated host error"),
        ({"sticks": True}, "its stream is still active"),
    ],
)
def test_an_output_that_stays_on_is_reported(card, generator, fault, said):
    generator.set_sine(HZ, 8.0)
    vars(card.stream).update(fault)
    with pytest.raises(InstrumentError, match=f"{said}; pull the loudspeaker's cable"):
        generator.output_off()
    assert generator.read()[2]
    generator.close()
    assert card.stream.calls[-1] == "close"


def test_a_card_that_does_not_start_is_off(card, generator):
    card.start_error = PortAudioError("Device unavailable", -9985)
    with pytest.raises(InstrumentError, match=r"start playing, but PortAudio says: .*unavailable"):
        generator.set_sine(HZ, 8.0)
    assert not generator.read()[2]


def test_closing_twice_fades_once(card, generator):
    generator.set_sine(HZ, 8.0)
    generator.close()
    generator.close()
    assert card.stream.calls[:2] == ["start", "stop"]
    assert played_volts(card)[-1] == 0.0
    assert not generator.read()[2]


# --- Opening -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"volts_per_full_scale": 0.0}, "volts_per_full_scale: should be greater than 0"),
        ({"volts_per_full_scale": math.inf}, "volts_per_full_scale: should be a finite number"),
        ({"volts_per_full_scale": "1 V"}, "volts_per_full_scale: should be a valid number"),
        ({"sample_rate": 48_000}, "sample_rate: unknown key; known are .*sample_rate_hz"),
        ({"channel": 0}, "channel: should be greater than or equal to 1"),
        ({"channel": 5}, "channel: 5 is more than the 4 channels of 'Scarlett'"),
        ({"sample_rate_hz": 40_000}, "sample_rate_hz: 40000 is not above twice the 20000 Hz"),
        ({"device": "Scar"}, r"device: 'Scar' is not one .*are 1 'Scarlett', 2 'Scarlett HDMI'; "),
        ({"device": 0}, "device: 0 is not one output device"),
        ({"device": True}, "options.device"),
    ],
)
def test_options_are_checked(card, options, said):
    with pytest.raises(BenchSetupError, match=said) as refused:
        open_generator(card, **options)
    assert "\n" not in str(refused.value)
    assert "instruments.generator.options" in str(refused.value)
    assert card.stream is None


def test_the_calibration_has_no_default(card):
    changes = {"instruments.generator.options": {}}
    with pytest.raises(BenchSetupError, match=r"options.volts_per_full_scale: is missing; add it"):
        open_generator(card, changes)


def test_the_amplifier_has_to_be_described(card):
    with pytest.raises(BenchSetupError, match=r"instruments.generator.output: is missing; add amp"):
        open_generator(card, {"instruments.generator.output": None})


def test_a_computer_without_a_card_is_reported(card):
    card.devices = []
    with pytest.raises(BenchSetupError, match=r"the default one is not one .* there are none;"):
        open_generator(card, device=None)


@pytest.mark.parametrize(
    ("code", "error", "said"),
    [
        (-9997, BenchSetupError, "options.sample_rate_hz: 48000 is refused by 'Scarlett'"),
        (-9998, BenchSetupError, "options.channel: 1 is refused by"),
        (-9985, InstrumentError, "cannot be opened, .*no other program plays on it"),
    ],
)
def test_a_card_that_does_not_open_is_distinguished(card, code, error, said):
    card.open_error = PortAudioError("refused", code)
    with pytest.raises(error, match=said) as refused:
        open_generator(card)
    assert type(refused.value) is error


def test_another_sample_rate_than_asked_is_refused(card):
    card.rate_hz = 44_100
    with pytest.raises(BenchSetupError, match="48000 was asked for, but 'Scarlett' plays at 44100"):
        open_generator(card)
    assert card.stream.calls == ["close"]


def test_a_missing_library_names_its_package(monkeypatch, tmp_path):
    (tmp_path / "sounddevice.py").write_text("raise OSError('PortAudio library not found')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "sounddevice", raising=False)
    with pytest.raises(BenchSetupError, match=r"not found.*Debian package libportaudio2"):
        open_generator(None)


def test_a_missing_module_names_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(BenchSetupError, match="pip install sounddevice"):
        open_generator(None)


def test_the_library_is_not_loaded_before_a_card_is_opened():
    code = "import sys, drivers.generators.soundcard; sys.exit('sounddevice' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
