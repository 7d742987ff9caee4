"""The sound card's driver over the real PortAudio and ALSA, into a file instead of a card.

ALSA's ``type file`` writes what a card would have been sent. It takes samples as fast as they come,
so the stream is held back to the pace of a card. A home of its own, and so a process of its own,
keeps the definition of that device away from the user's.
"""

import json
import os
import subprocess
import sys
from ctypes.util import find_library
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
RATE_HZ = 48_000
FULL_SCALE_V = 20.0

ASOUNDRC = """
pcm.reedbench_file {{ type file  slave.pcm "null"  file "{file}"  format "raw" }}
pcm.reedbench_other {{ type null }}
"""

PLAY = '''
import json, pathlib, sys, time
from fractions import Fraction

import numpy as np
import sounddevice

from protocols.bench import BenchFile
from drivers.generators import soundcard
from drivers.context import BenchContext
from drivers.errors import BenchSetupError, InstrumentError
from protocols.preparation import Preparation

folder, sessions, answers = pathlib.Path(sys.argv[1]), [], {}

class Paced(sounddevice.OutputStream):
    def __init__(self, callback, samplerate, **asked):
        def paced(block, frames, moment, status):
            callback(block, frames, moment, status)
            sessions[-1].append(block.copy())
            time.sleep(frames / samplerate)

        super().__init__(callback=paced, samplerate=samplerate, **asked)

    def start(self):
        sessions.append([])
        super().start()

sounddevice.OutputStream = Paced

def opened(**options):
    bench = BenchFile.from_file().replace({
        "instruments.generator.output": {"amplifier_gain": 16.0, "load": "8 ohm"},
        "instruments.generator.options": {
            "volts_per_full_scale": 1.25, "device": "reedbench_file", "block_frames": 512, **options
        },
    })
    preparation = Preparation("R07", "A", "asymmetric")
    context = BenchContext(bench, preparation, np.random.default_rng(1), lambda _: None)
    return soundcard.SoundCardGenerator(bench.instruments.generator, context)

def plateau():
    """Numbers of the first sample and of the one behind the last of a piece of the session."""
    first = len(sessions[-1])
    while len(sessions[-1]) < first + 4:
        time.sleep(0.005)
    return [512 * first, 512 * (first + 4)]

def message(error, act):
    try:
        act()
    except error as raised:
        return str(raised)

generator = opened()
answers["identity"] = generator.identity
generator.set_sine(Fraction(20001, 10), 16.0)
answers["read"] = [str(value) for value in generator.read()]
answers["plateaus"] = [plateau()]
generator.set_sine(Fraction(30001, 10), 8.0)
answers["plateaus"].append(plateau())
generator.ramp_to(0.0, 0.06)
generator.output_off()
answers["off"] = generator.read()[2]
generator.set_sine(Fraction(4000), 4.0)
generator.close()
for number, blocks in enumerate(sessions):
    np.save(folder / f"session{number}.npy", np.concatenate(blocks))

generator = opened(device="reedbench_other")
generator.set_sine(Fraction(1000), 4.0)
def broken(self, samples):
    raise RuntimeError("broken")
soundcard.Oscillator.fill = broken
time.sleep(0.05)
answers["failed"] = message(InstrumentError, generator.read)
generator.output_off()
answers["off after failure"] = generator.read()[2]
generator.close()

answers["device"] = message(BenchSetupError, lambda: opened(device="nowhere"))
answers["several"] = message(BenchSetupError, lambda: opened(device="reedbench"))
answers["channel"] = message(BenchSetupError, lambda: opened(channel=100_000))
answers["rate"] = message(BenchSetupError, lambda: opened(sample_rate_hz=10**9))
(folder / "answers.json").write_text(json.dumps(answers))
'''


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The folder with what was handed to PortAudio, what came out, and what was answered."""
    if not sys.platform.startswith("linux"):
        pytest.skip("ALSA is part of Linux")
    if find_library("portaudio") is None:
        pytest.skip("PortAudio is absent; install the Debian package libportaudio2")
    folder = tmp_path_factory.mktemp("portaudio")
    (folder / ".asoundrc").write_text(ASOUNDRC.format(file=folder / "captured.raw"))
    subprocess.run(
        [sys.executable, "-c", PLAY, folder],
        cwd=REPOSITORY,
        env=os.environ | {"HOME": str(folder)},
        check=True,
        timeout=120,
    )
    return folder


@pytest.fixture(scope="module")
def answers(played):
    return json.loads((played / "answers.json").read_text())


def handed_over(played, session):
    return np.load(played / f"session{session}.npy")


def captured(played):
    return np.fromfile(played / "captured.raw", "<f4").reshape(-1, 2)


def primed_samples(played):
    """Silence that PortAudio fills its buffers with whenever it starts, here twice."""
    return (len(captured(played)) - sum(len(handed_over(played, k)) for k in (0, 1))) // 2


def test_every_sample_arrives_bit_for_bit(played):
    first, second = handed_over(played, 0), handed_over(played, 1)
    came, silence = captured(played), np.zeros((primed_samples(played), 2), np.float32)
    assert len(silence) < RATE_HZ // 10
    np.testing.assert_array_equal(came, np.concatenate([silence, first, silence, second]))


@pytest.mark.parametrize(
    ("number", "frequency_hz", "peak_v"), [(0, 2000.1, 16.0), (1, 3000.1, 8.0)]
)
def test_what_arrives_is_the_sine_that_was_asked(played, answers, number, frequency_hz, peak_v):
    first, end = (primed_samples(played) + n for n in answers["plateaus"][number])
    volts = captured(played)[first:end, 0].astype(float) * FULL_SCALE_V
    phase = 2 * np.pi * frequency_hz / RATE_HZ * np.arange(volts.size)
    basis = np.stack([np.sin(phase), np.cos(phase)], axis=1)
    parts = np.linalg.lstsq(basis, volts)[0]
    assert np.hypot(*parts) == pytest.approx(peak_v, rel=1e-6)
    np.testing.assert_allclose(basis @ parts, volts, atol=1e-6 * peak_v)


def test_the_other_channel_is_silent(played):
    assert not captured(played)[:, 1].any()


def test_nothing_clicks_from_first_to_last_sample(played):
    volts = captured(played)[:, 0].astype(float) * FULL_SCALE_V
    steepest = 16 * 2 * np.sin(np.pi * 3000.1 / RATE_HZ) + 16 / 2400
    assert np.abs(np.diff(volts, prepend=0.0)).max() < steepest
    assert volts[-1] == 0.0
    assert handed_over(played, 0)[-1, 0] == 0.0


def test_it_gets_what_plays(answers):
    assert answers["identity"].startswith(
        "sound card 'reedbench_file' on ALSA, 48000 Hz, unlocked; "
    )
    assert answers["read"] == ["20001/10", "16.0", "True"]
    assert answers["off"] is False


def test_an_error_on_the_audio_thread_surfaces_and_the_card_stops(answers):
    assert "audio thread failed (RuntimeError('broken'))" in answers["failed"]
    assert answers["off after failure"] is False


def test_what_portaudio_refuses_names_the_key(answers):
    assert "options.device: 'nowhere' is not one output device; there are" in answers["device"]
    assert "'reedbench_file', " in answers["several"]
    assert "options.channel: 100000 is more than the " in answers["channel"]
    assert "options.sample_rate_hz: 1000000000 is refused by 'reedbench_file'" in answers["rate"]
