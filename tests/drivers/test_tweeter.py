"""Generators of all makers fill their role, whatever happens on the wire or at the front panel."""

import math
import threading
import time
from fractions import Fraction
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.context import WallClock
from drivers.emulators.serving import WireFaults
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.generators.replies import agrees, in_hertz
from drivers.roles import SignalGenerator
from drivers.transport.visa import VisaLine
from tests.drivers.generators import DEVICES, GAIN, MOST_V

DRIVE_HZ = Fraction(2_033_075, 1000)
LEAST_V = 0.001 * GAIN
MAKERS = pytest.mark.parametrize("maker", sorted(DEVICES))
# What a person at the front panel may do.
LOUD_INTO_50_OHM = {
    "siglent": ("C1:OUTP LOAD,50", "C1:BSWV AMP,10", "C1:OUTP ON"),
    "keysight": ("VOLT 10", "OUTP ON"),
}
ANOTHER_AMPLITUDE = {"siglent": "C1:BSWV AMP,1.5", "keysight": "VOLT 1.5"}
ANOTHER_LOAD = {"siglent": "C1:OUTP LOAD,50", "keysight": "OUTP1:LOAD 50"}
ANOTHER_SHAPE = {"siglent": "C1:BSWV WVTP,SQUARE", "keysight": "FUNC SQU"}
OFFSET = {"siglent": "C1:BSWV OFST,0.5", "keysight": "VOLT:OFFS 0.5"}
SWITCH_ON = {"siglent": "C1:OUTP ON", "keysight": "OUTP1 ON"}


def volts_at_load(stand):
    return stand.device.socket[1] * GAIN


# --- Opening -----------------------------------------------------------------------------------


@MAKERS
@pytest.mark.parametrize("wire", ["usb", "socket", "vxi11"])
def test_a_generator_fills_its_role_over_any_wire(stands, maker, wire):
    stand = stands(maker, wire)
    generator = stand.open({"timeout_s": 1.0})
    assert isinstance(generator, SignalGenerator)
    assert {"siglent": "SDG2042X", "keysight": "33512B"}[maker] in generator.identity
    generator.set_sine(DRIVE_HZ, 5.0)
    assert generator.read() == (DRIVE_HZ, 5.0, True)
    assert stand.device.socket == (DRIVE_HZ, 5.0 / GAIN, True)
    generator.output_off()
    assert generator.read() == (DRIVE_HZ, 5.0, False)
    assert not stand.device.socket[2]


@MAKERS
def test_opening_switches_off_first_and_leaves_the_least_amplitude(stands, maker):
    stand = stands(maker)
    for command in LOUD_INTO_50_OHM[maker]:
        stand.device.turn_knob(command)
    assert stand.device.socket[1:] == (10.0, True), "10 Vpp into 50 ohm are 10 V peak when open"
    del stand.changes[:]
    stand.open()
    assert stand.changes[0] == (1000, 10.0, False), "off before anything else changes"
    assert not any(on for _, _, on in stand.changes)
    assert stand.device.socket == (1000, pytest.approx(0.001), False)


@MAKERS
def test_another_instrument_gets_no_command(stands, maker):
    stand = stands(maker, identity="Rigol Technologies,DP832,DP8A1,00.01.14")
    with pytest.raises(InstrumentError, match=r"says that it is 'Rigol.*correct instruments\.gen"):
        stand.open()
    assert set(stand.wire.heard) == {"*IDN?"}


OTHER_MODEL = {
    "siglent": "Siglent Technologies,SDG1032X,SDG1X000001,1.01.01.33R1B10",
    "keysight": "Agilent Technologies,33220A,MY44000001,2.02-2.02-22-2",
}


@MAKERS
def test_another_model_of_the_same_language_is_switched_off_and_refused(stands, maker):
    stand = stands(maker, identity=OTHER_MODEL[maker])
    stand.device.turn_knob(SWITCH_ON[maker])
    with pytest.raises(InstrumentError, match=r"says that it is.*correct instruments\.gen"):
        stand.open()
    assert not stand.device.socket[2]


@MAKERS
def test_who_does_not_say_what_it_is_is_switched_off(stands, maker):
    stand = stands(maker)
    stand.device.turn_knob(SWITCH_ON[maker])
    stand.wire.spoil(WireFaults(lose_answer_at=range(1, 100)))
    with pytest.raises(InstrumentError, match="did not answer"):
        stand.open({"timeout_s": 0.03})
    assert not stand.device.socket[2]


@MAKERS
def test_opening_that_fails_half_way_leaves_the_output_off(stands, maker, monkeypatch):
    stand = stands(maker, has_reference=False)
    receive = stand.device.receive

    def meddled_with(data):
        answer = receive(data)
        if b"ROSC" in data:
            stand.device.turn_knob(SWITCH_ON[maker])
        return answer

    monkeypatch.setattr(stand.device, "receive", meddled_with)
    with pytest.raises(InstrumentError, match=r"ROSC|reference"):
        stand.open()
    assert not stand.device.socket[2]


@MAKERS
def test_a_missing_reference_is_said_and_nothing_stays_open(stands, maker):
    stand = stands(maker, "socket", has_reference=False)
    said = r"check the 10 MHz|ROSC:SOUR EXT.*Settings conflict"
    with pytest.raises(InstrumentError, match=said) as caught:
        stand.open()
    assert not stand.device.socket[2]
    # The server takes one caller at a time.
    stand.open({"reference": "internal"}).set_sine(DRIVE_HZ, 1.0)
    assert "\n" not in str(caught.value)


@MAKERS
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"instruments.generator.output": None}, r"instruments\.generator\.output: is missing"),
        (
            {"instruments.generator.output": {"amplifier_gain": 1.5, "load": "8 ohm"}},
            r"limits\.volts_max: allows 16 V peak, but .* give 15 V; .*amplifier_gain",
        ),
        ({"instruments.generator.step": "1.5 uHz"}, r"generator\.step: is 1.5e-06 Hz"),
        ({"limits.drive_max": "25 MHz"}, r"limits\.drive_max: is above the 20000000 Hz"),
        ({"options": {"resource": 7}}, r"options\.resource: should be a valid string"),
        ({"options": {"reference": "10 MHz"}}, r"options\.reference: should be 'external' or"),
        ({"options": {"timeout": 1.0}}, r"options\.timeout: unknown key; known are resource"),
        ({"options": {"resource": "the generator"}}, "is no VISA resource"),
    ],
)
def test_a_wrong_bench_file_is_refused_before_anything_is_sent(stands, maker, changes, said):
    stand = stands(maker)
    with pytest.raises(BenchSetupError, match=said) as caught:
        stand.open(**changes)
    assert "\n" not in str(caught.value)
    assert stand.wire.heard == []


# --- Playing -----------------------------------------------------------------------------------


@MAKERS
def test_all_volts_and_frequencies_are_played_and_read_back(stands, maker):
    stand = stands(maker)
    generator = stand.open()

    @given(
        microhertz=st.integers(20_000_000, 20_000_000_000),
        volts=st.one_of(st.floats(LEAST_V, MOST_V), st.just(MOST_V)),
    )
    @settings(max_examples=60, deadline=None)
    def round_trip(microhertz, volts):
        frequency_hz = Fraction(microhertz, 1_000_000)
        generator.set_sine(frequency_hz, volts)
        played_hz, played_v, on = stand.device.socket
        assert (played_hz, on) == (frequency_hz, True)
        # Never more than was asked for.
        assert volts * (1 - 1e-5) <= played_v * GAIN <= volts * (1 + 1e-15)
        assert generator.read() == (frequency_hz, pytest.approx(played_v * GAIN, rel=1e-12), True)

    round_trip()


@MAKERS
def test_no_volts_are_the_least_amplitude_and_said_so(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 0.0)
    assert generator.read() == (DRIVE_HZ, LEAST_V, True)
    assert stand.device.socket == (DRIVE_HZ, pytest.approx(0.001), True)
    generator.ramp_to(-0.0, 0.1)
    assert generator.read() == (DRIVE_HZ, LEAST_V, True)


@MAKERS
def test_frequencies_snap_to_the_grid_of_the_bench_file(stands, maker):
    generator = stands(maker).open(**{"instruments.generator.step": "0.1 Hz"})
    generator.set_sine(Fraction(2_000_06, 100), 1.0)
    assert generator.read()[0] == Fraction(20_001, 10)


@MAKERS
@pytest.mark.parametrize("volts", [16.001, -0.5, math.nan, math.inf, 1e9, 0.49])
def test_volts_outside_the_limits_change_nothing(stands, maker, volts):
    stand = stands(maker)
    generator = stand.open(**{"limits.volts_min": "0.5 V"})
    generator.set_sine(DRIVE_HZ, 1.0)
    before = stand.device.socket
    del stand.wire.heard[:]
    for ask in (
        lambda: generator.set_sine(DRIVE_HZ, volts),
        lambda: generator.ramp_to(volts, 0.1),
    ):
        with pytest.raises(LimitError, match=r"outside 0\.5 to 16 V"):
            ask()
    assert stand.wire.heard == []
    assert stand.device.socket == before


@MAKERS
def test_volts_below_the_least_amplitude_are_refused(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    del stand.wire.heard[:]
    with pytest.raises(LimitError, match=r"0\.0019 V, but can play 0 V, or 0\.002 V and more"):
        generator.set_sine(DRIVE_HZ, 0.0019)
    assert stand.wire.heard == []


@MAKERS
@pytest.mark.parametrize("frequency_hz", [Fraction(19), Fraction(30_000), Fraction(0), math.nan])
def test_drives_outside_the_limits_change_nothing(stands, maker, frequency_hz):
    stand = stands(maker)
    generator = stand.open()
    del stand.wire.heard[:]
    with pytest.raises(LimitError, match="outside 20 to 20000 Hz"):
        generator.set_sine(frequency_hz, 1.0)
    assert stand.wire.heard == []


@MAKERS
@pytest.mark.parametrize("start_v", [0.0, 8.0])
def test_a_ramp_takes_its_time_in_small_equal_steps(stands, maker, start_v):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, start_v)
    del stand.changes[:]
    start_s = stand.clock.now_s()
    generator.ramp_to(8.0 - start_v, 1.0)
    assert stand.clock.now_s() - start_s == pytest.approx(1.0, abs=0.05)
    volts = [abs(start_v - socket_v * GAIN) for _, socket_v, _ in stand.changes]
    assert len(volts) >= 10
    steps = [after - before for before, after in pairwise([0.0, *volts])]
    assert steps == pytest.approx([8.0 / len(volts)] * len(volts), abs=0.005)
    assert {(hz, on) for hz, _, on in stand.changes} == {(DRIVE_HZ, True)}
    assert generator.read() == (DRIVE_HZ, max(8.0 - start_v, LEAST_V), True)


@MAKERS
def test_a_ramp_to_0_v_asks_nothing_on_its_way(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 8.0)
    del stand.wire.heard[:]
    generator.ramp_to(0.0, 0.1)
    steps = [line.rpartition(" ")[2].rpartition(",")[2] for line in stand.wire.heard]
    asked = [number for number, line in enumerate(stand.wire.heard) if "?" in line]
    assert min(asked) >= 10
    volts = [float(step) * GAIN / 2 for step in steps[: min(asked)]]
    assert volts[0] == pytest.approx(8.0 * 19 / 20, abs=0.01), "from where it was"
    assert volts == sorted(volts, reverse=True)
    assert volts[-1] == pytest.approx(LEAST_V)
    assert generator.read() == (DRIVE_HZ, LEAST_V, True)


@MAKERS
def test_a_ramp_to_0_v_takes_at_least_50_ms(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 8.0)
    start_s = stand.clock.now_s()
    generator.ramp_to(0.0, 0.0)
    assert stand.clock.now_s() - start_s >= 0.05


@MAKERS
def test_a_ramp_to_0_v_that_does_not_get_there_is_an_error(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 8.0)
    stand.wire.spoil(WireFaults(lose_command_at=(20,)))
    with pytest.raises(InstrumentError, match=r"was set to play .* but says"):
        generator.ramp_to(0.0, 0.1)


@MAKERS
def test_a_ramp_on_an_output_that_is_off(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    del stand.changes[:]
    generator.ramp_to(0.0, 0.1)
    with pytest.raises(InstrumentError, match=r"output is off.*call set_sine first"):
        generator.ramp_to(1.0, 0.1)
    assert stand.changes == []


@MAKERS
def test_an_output_that_was_switched_on_by_hand_can_be_ramped_and_is_closed(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    stand.device.turn_knob(SWITCH_ON[maker])
    generator.ramp_to(1.0, 0.1)
    assert generator.read() == (1000, 1.0, True)
    generator.close()
    assert not stand.device.socket[2]


@MAKERS
@pytest.mark.parametrize("duration_s", [-0.1, math.nan, math.inf])
def test_a_ramp_needs_a_duration(stands, maker, duration_s):
    generator = stands(maker).open()
    generator.set_sine(DRIVE_HZ, 1.0)
    with pytest.raises(LimitError, match="give a time"):
        generator.ramp_to(0.0, duration_s)


@given(st.integers(1, 40_000_000_000_000), st.integers(6, 15))
def test_a_number_agrees_with_what_it_looks_like_and_with_nothing_else(micro, digits):
    sent = Fraction(micro, 1_000_000)
    said = Fraction(f"{float(sent):.{digits}g}")
    last_digit = Fraction(10) ** (int(f"{float(sent):e}".split("e")[1]) - digits + 1)
    assert agrees(sent, said, digits)
    assert not agrees(sent, said + last_digit * 2, digits)
    assert not agrees(sent, said - last_digit * 2, digits)
    assert Fraction(in_hertz(sent)) == sent


# --- At the front panel and behind the socket --------------------------------------------------


@MAKERS
def test_an_output_that_tripped_is_an_error_and_is_not_switched_on_again(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.trip()
    assert generator.read() == (DRIVE_HZ, 1.0, False)
    with pytest.raises(InstrumentError, match="its output is off, but was switched on; look for"):
        generator.set_sine(DRIVE_HZ, 2.0)
    assert stand.device.socket == (DRIVE_HZ, 0.5, False)
    stand.device.trip()
    with pytest.raises(InstrumentError, match="output is off"):
        generator.ramp_to(1.0, 0.1)
    generator.output_off()
    generator.set_sine(DRIVE_HZ, 2.0)
    assert generator.read() == (DRIVE_HZ, 2.0, True)


@MAKERS
def test_a_ramp_to_0_v_does_not_make_it_forget_that_an_output_tripped(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.trip()
    generator.ramp_to(0.0, 0.1)
    for _ in range(2):
        with pytest.raises(InstrumentError, match="its output is off, but was switched on"):
            generator.set_sine(DRIVE_HZ, 2.0)
        with pytest.raises(InstrumentError, match="its output is off, but was switched on"):
            generator.ramp_to(2.0, 0.1)
    assert not stand.device.socket[2]
    generator.output_off()
    generator.set_sine(DRIVE_HZ, 2.0)
    assert stand.device.socket == (DRIVE_HZ, 1.0, True)


@MAKERS
def test_what_was_turned_by_hand_is_what_is_read(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.turn_knob(ANOTHER_AMPLITUDE[maker])
    assert generator.read() == (DRIVE_HZ, 1.5, True)
    generator.ramp_to(0.0, 0.1)
    assert generator.read() == (DRIVE_HZ, LEAST_V, True)


@MAKERS
@pytest.mark.parametrize("knob", [ANOTHER_LOAD, ANOTHER_SHAPE, OFFSET], ids=["load", "shape", "dc"])
def test_what_is_no_sine_into_high_impedance_has_no_volts(stands, maker, knob):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.turn_knob(knob[maker])
    for ask in (generator.read, lambda: generator.set_sine(DRIVE_HZ, 2.0)):
        with pytest.raises(InstrumentError, match="instead of a sine without offset into"):
            ask()
    generator.output_off()
    assert not stand.device.socket[2]


@MAKERS
def test_an_output_that_does_not_switch_off_is_an_error(stands, maker, monkeypatch):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    heard = stand.device.receive

    def stuck(data):
        answer = heard(data)
        stand.device.turn_knob(SWITCH_ON[maker])
        return answer

    monkeypatch.setattr(stand.device, "receive", stuck)
    with pytest.raises(InstrumentError, match="says that it is on; pull the loudspeaker's cable"):
        generator.output_off()


@MAKERS
def test_closing_switches_off_and_may_be_done_twice(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    generator.close()
    assert not stand.device.socket[2]
    generator.close()
    with pytest.raises(InstrumentError):
        generator.read()


# --- On the wire -------------------------------------------------------------------------------

FAULTS = {
    "lost answer": lambda place: WireFaults(lose_answer_at=(place,)),
    "two lost answers": lambda place: WireFaults(lose_answer_at=(place, place + 1)),
    "garbled answer": lambda place: WireFaults(garble_answer_at=(place,)),
    "two garbled answers": lambda place: WireFaults(garble_answer_at=(place, place + 1)),
    "lost command": lambda place: WireFaults(lose_command_at=(place,)),
    "two lost commands": lambda place: WireFaults(lose_command_at=(place, place + 1)),
    "unplugged": lambda place: WireFaults(unplug_at=place),
}
OVERCOME = ("lost answer", "garbled answer")


def failures_of_a_sweep(stand, generator):
    """Use a generator; whatever it does not refuse has to be true. Return what it refused."""
    failures = []

    def attempt(step, *arguments):
        try:
            step(*arguments)
        except InstrumentError as error:
            failures.append(str(error))

    def play(volts):
        frequency_hz = DRIVE_HZ + round(100 * volts)
        generator.set_sine(frequency_hz, volts)
        assert stand.device.socket == (frequency_hz, volts / GAIN, True)

    def listen():
        frequency_hz, volts, on = generator.read()
        assert stand.device.socket == (frequency_hz, volts / GAIN, on)

    def silence():
        generator.output_off()
        assert not stand.device.socket[2]

    for volts in (4.0, 2.0):
        attempt(play, volts)
        attempt(listen)
    attempt(silence)
    return failures


@MAKERS
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_anywhere_never_make_wrong_volts_believed(stands, maker, fault):
    failures = []
    for place in range(1, 13):
        stand = stands(maker)
        generator = stand.open({"timeout_s": 0.03})
        stand.wire.spoil(FAULTS[fault](place))
        failures.append(failures_of_a_sweep(stand, generator))
        assert max(volts for _, volts, _ in stand.changes) <= 4.0 / GAIN
    assert any(failures) == (fault not in OVERCOME)
    assert not any("\n" in message for place in failures for message in place)


@MAKERS
@pytest.mark.parametrize(
    ("faults", "overcome"),
    [
        (WireFaults(lose_answer_at=(2,)), True),
        (WireFaults(garble_answer_at=(2,)), True),
        (WireFaults(late_answer_at=(2,), late_s=0.3), True),
        (WireFaults(lose_command_at=(2,)), False),
        (WireFaults(echo=True), False),
        (WireFaults(wrong_baud=True), False),
        (WireFaults(unplug_at=2), False),
    ],
    ids=["lost", "garbled", "late", "command lost", "echo", "noise", "unplugged"],
)
def test_faults_of_a_network_are_overcome_or_said(stands, maker, faults, overcome):
    stand = stands(maker, "socket")
    generator = stand.open({"timeout_s": 0.2})
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.wire.spoil(faults)
    if overcome:
        generator.set_sine(DRIVE_HZ + 1, 2.0)
        assert generator.read() == (DRIVE_HZ + 1, 2.0, True)
        assert stand.device.socket == (DRIVE_HZ + 1, 2.0 / GAIN, True)
        return
    with pytest.raises(InstrumentError, match=r"^generator \(\w+ \w+\) at TCPIP0::127"):
        generator.set_sine(DRIVE_HZ + 1, 2.0)
    assert stand.device.socket[1] * GAIN <= 2.0


def told_volts(stand):
    return [line for line in stand.wire.heard if "AMP," in line or "VOLT " in line]


@MAKERS
@pytest.mark.parametrize("arrived", [True, False])
def test_a_write_of_unknown_outcome_is_looked_at_and_not_repeated(
    stands, maker, arrived, monkeypatch
):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    del stand.wire.heard[:]
    send = VisaLine.send

    def failing(line, text):
        writes_volts = "AMP," in text or "VOLT " in text
        if arrived or not writes_volts:
            send(line, text)
        if writes_volts:
            raise InstrumentError("the write timed out")

    monkeypatch.setattr(VisaLine, "send", failing)
    if arrived:
        generator.set_sine(DRIVE_HZ, 2.0)
        assert generator.read() == (DRIVE_HZ, 2.0, True)
    else:
        with pytest.raises(InstrumentError, match=r"2033.075 Hz at 2 Vpp, but says"):
            generator.set_sine(DRIVE_HZ, 2.0)
        assert generator.read() == (DRIVE_HZ, 1.0, True)
    assert len(told_volts(stand)) == arrived


@MAKERS
def test_switching_off_is_sent_again_if_it_was_not_received(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.wire.spoil(WireFaults(lose_command_at=(1,)))
    generator.output_off()
    assert not stand.device.socket[2]


NEVER = WireFaults(lose_answer_at=range(1, 1000))
SLOW = WireFaults(slow_s=1.0)
AMID_A_QUESTION = {"siglent": "C1:OUTP?", "keysight": "SYST:ERR?"}


@pytest.fixture
def playing(stands):
    """Return a function that opens a generator on a socket, in real time, and plays 8 V."""

    def make(maker, timeout_s=2.0):
        stand = stands(maker, "socket", WallClock())
        generator = stand.open({"timeout_s": timeout_s})
        generator.set_sine(DRIVE_HZ, 8.0)
        del stand.changes[:]
        return stand, generator

    return make


def interrupt_amid(stand, generator, question):
    """Press Ctrl-C while an answer is awaited."""
    line = generator._line  # noqa: SLF001  # the moment between a question and its answer

    def interrupted(*_):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(line, "_read", interrupted)
        with pytest.raises(KeyboardInterrupt):
            line.ask(question)


def times_to_off(stand, generator):
    """Switch off as a run does; return when that was asked, when it happened, and the errors."""
    seen = {"asked": time.monotonic()}

    def watch():
        while not {"ramped", "off"} <= set(seen) and time.monotonic() < seen["asked"] + 8:
            _, volts, on = stand.device.socket
            if volts * GAIN == pytest.approx(LEAST_V):
                seen.setdefault("ramped", time.monotonic())
            if not on:
                seen.setdefault("off", time.monotonic())
            time.sleep(0.002)

    watching = threading.Thread(target=watch)
    watching.start()
    errors = []
    for switch in (lambda: generator.ramp_to(0.0, 0.1), generator.output_off):
        try:
            switch()
        except InstrumentError as error:
            errors.append(str(error))
    seen["returned"] = time.monotonic()
    watching.join()
    return seen, errors


def ramp_of(stand):
    """Volts at the load while the output was on."""
    return [volts * GAIN for _, volts, on in stand.changes if on]


@MAKERS
@pytest.mark.parametrize("amid", [False, True], ids=["in step", "amid a question"])
@pytest.mark.parametrize("faults", [WireFaults(), SLOW], ids=["prompt", "slow"])
def test_switching_off_does_not_wait_for_answers(playing, maker, faults, amid, awake_s):
    stand, generator = playing(maker)
    stand.server.spoil(faults)
    if amid:
        interrupt_amid(stand, generator, AMID_A_QUESTION[maker])
    seen, errors = times_to_off(stand, generator)
    assert awake_s(seen["asked"], seen["off"]) < 1.0
    assert seen["asked"] + 0.05 < seen["ramped"] < seen["off"] + 0.01
    assert len(ramp_of(stand)) >= 10
    assert errors == [], "what is slow is not missing"
    most_s = 1.0 if faults == WireFaults() else 6.0
    assert awake_s(seen["asked"], seen["returned"]) < most_s


@MAKERS
@pytest.mark.parametrize("amid", [False, True], ids=["in step", "amid a question"])
def test_switching_off_happens_though_no_answer_comes(playing, maker, amid, awake_s):
    stand, generator = playing(maker, timeout_s=0.6)
    stand.server.spoil(NEVER)
    if amid:
        interrupt_amid(stand, generator, AMID_A_QUESTION[maker])
    seen, errors = times_to_off(stand, generator)
    assert awake_s(seen["asked"], seen["off"]) < 1.0
    assert len(ramp_of(stand)) >= 10
    assert len(errors) == 1
    assert "not confirmed" in errors[0]
    assert "pull the loudspeaker's cable" in errors[0]
    assert "\n" not in errors[0]
    # The end of the ramp, and twice three questions at most.
    assert awake_s(seen["asked"], seen["returned"]) < 0.5 + 0.4 + 3 * 0.6 + 0.5


@MAKERS
def test_switching_off_is_sent_twice_though_no_answer_comes(stands, maker):
    stand = stands(maker, "socket")
    generator = stand.open({"timeout_s": 0.1})
    generator.set_sine(DRIVE_HZ, 1.0)
    # The first command that it hears gets lost.
    stand.server.spoil(WireFaults(lose_answer_at=range(1, 1000), lose_command_at=(1,)))
    with pytest.raises(InstrumentError, match="asked twice"):
        generator.output_off()
    assert not stand.device.socket[2]


@MAKERS
def test_closing_does_not_wait_long_for_a_generator_that_answers_no_more(stands, maker, awake_s):
    stand = stands(maker, "socket")
    generator = stand.open({"timeout_s": 30.0})
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.server.spoil(NEVER)
    started_s = time.monotonic()
    generator.close()
    assert awake_s(started_s) < 1.5
    assert not stand.device.socket[2]


@MAKERS
def test_closing_a_generator_that_is_gone_raises_nothing(stands, maker):
    stand = stands(maker)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.wire.spoil(WireFaults(unplug_at=1))
    with pytest.raises(InstrumentError, match="No such device"):
        generator.read()
    with pytest.raises(InstrumentError):
        generator.output_off()
    generator.close()
    generator.close()
