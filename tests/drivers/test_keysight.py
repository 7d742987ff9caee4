"""The 33500: limits of its own, an error queue, and units that another program chose."""

from fractions import Fraction

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.emulators.keysight import KeysightEmulator
from drivers.emulators.serving import WireFaults
from drivers.errors import InstrumentError
from drivers.transport.visa import open_visa
from tests.drivers.generators import GAIN, MOST_V, answer

DRIVE_HZ = Fraction(2_033_075, 1000)


# --- The simulated instrument ------------------------------------------------------------------


def test_a_reset_leaves_the_defaults_of_the_series():
    device = KeysightEmulator()
    for line in ("OUTP:LOAD INF", "VOLT 5", "FREQ 2000", "OUTP ON", "*RST"):
        assert answer(device, line) == ""
    said = answer(device, "FUNC?;:FREQ?;:VOLT?;:VOLT:OFFS?;:VOLT:UNIT?;:OUTP:LOAD?;:OUTP?")
    assert said == (
        "SIN;+1.000000000000000E+03;+1.000000000000000E-01;+0.000000000000000E+00;VPP;"
        "+5.000000000000000E+01;0"
    )


@pytest.mark.parametrize(
    "head", ["SOUR1:VOLT:LIM:STAT", "source:voltage:limit:state", ":VOLTage:LIMit:STATe"]
)
def test_short_and_long_forms_are_the_same(head):
    device = KeysightEmulator()
    assert answer(device, f"{head} ON;{head}?") == "1"
    assert answer(device, f"{head} 0;{head}?") == "0"
    assert answer(device, "SYST:ERR?") == '+0,"No error"'


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("VOLTS 1", '-113,"Undefined header"'),
        ("SOUR3:VOLT 1", '-113,"Undefined header"'),
        ("FREQ 40E6", '-222,"Data out of range;value clipped to upper limit"'),
        ("VOLT 0.0001", '-222,"Data out of range;value clipped to lower limit"'),
        ("VOLT 11", '-222,"Data out of range;value clipped to upper limit"'),
        ("FUNC COS", '-224,"Illegal parameter value"'),
        ("VOLT one", '-120,"Numeric data error"'),
        ("VOLT:HIGH 6", '-221,"Settings conflict"'),
    ],
)
def test_what_it_refuses_is_in_its_error_queue(line, error):
    device = KeysightEmulator()
    answer(device, line)
    assert [answer(device, "SYST:ERR?") for _ in range(2)] == [error, '+0,"No error"']
    answer(device, line)
    answer(device, "*CLS")
    assert answer(device, "SYSTem:ERRor?") == '+0,"No error"'


def test_volts_are_said_for_the_load_and_in_the_unit():
    device = KeysightEmulator()
    answer(device, "VOLT 2;OUTP:LOAD INF")
    assert device.socket[1] == 2.0
    for unit, volts in (("VPP", 4.0), ("VRMS", 2**0.5)):
        answer(device, f"VOLT:UNIT {unit}")
        assert float(answer(device, "VOLT?")) == pytest.approx(volts)
    answer(device, "OUTP:LOAD 50;VOLT:UNIT DBM")
    assert float(answer(device, "VOLT?")) == pytest.approx(10.0)
    answer(device, "VOLT 0")
    assert device.socket[1] == pytest.approx(2 * 0.31623, rel=1e-4), "1 mW into 50 ohm"


@given(st.lists(st.binary(max_size=30), max_size=6))
@example([b"FREQ nan\nVOLT 1e999\nOUTP:LOAD -1\nVOLT:OFFS 99\n", b"VOLT:LIM:HIGH inf;:VOLT -1\n"])
def test_nothing_that_is_sent_makes_it_fall_over(lines):
    device = KeysightEmulator()
    for line in lines:
        device.receive(line)
    device.receive(b"\n")
    assert answer(device, "FREQ?").startswith("+")


# --- The driver --------------------------------------------------------------------------------


def test_its_own_limits_hold_at_the_volts_of_the_bench_file(stands):
    stand = stands("keysight")
    generator = stand.open()
    assert answer(stand.device, "VOLT:LIM:STAT?") == "1"
    assert float(answer(stand.device, "VOLT:LIM:HIGH?")) == MOST_V / GAIN
    assert float(answer(stand.device, "VOLT:LIM:LOW?")) == -MOST_V / GAIN
    generator.set_sine(DRIVE_HZ, MOST_V)
    # Another program asks it for more than the loudspeaker bears.
    answer(stand.device, "VOLT 20")
    assert stand.device.socket[1] == MOST_V / GAIN


@pytest.mark.parametrize("most_v", ["15.9999 V", "3.3333 V", "0.0123 V"])
def test_the_most_that_the_bench_file_allows_is_not_refused(stands, most_v):
    stand = stands("keysight")
    generator = stand.open(**{"limits.volts_max": most_v})
    volts = float(most_v.removesuffix(" V"))
    generator.set_sine(DRIVE_HZ, volts)
    assert stand.device.socket[1] * GAIN == pytest.approx(volts, rel=1e-5)
    answer(stand.device, "VOLT 20")
    assert stand.device.socket[1] * GAIN == pytest.approx(volts, abs=0.001 * GAIN)


def test_limits_are_armed_before_the_output_can_be_on(stands):
    stand = stands("keysight")
    stand.open()
    commands = [line for line in stand.wire.heard if "?" not in line]
    assert commands[0] == "OUTP1 OFF"
    assert commands.index("OUTP1:LOAD INF") < commands.index("SOUR1:VOLT:LIM:STAT ON")
    assert "OUTP1 ON" not in commands


def test_limits_that_were_switched_off_by_hand_are_missed(stands):
    stand = stands("keysight")
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.turn_knob("VOLT:LIM:STAT OFF")
    with pytest.raises(InstrumentError, match="with its limits off, instead of"):
        generator.set_sine(DRIVE_HZ, 2.0)


def test_what_it_reports_is_said_and_the_queue_is_emptied(stands):
    stand = stands("keysight")
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    for command in ("NONSENSE", "FREQ 1e9", "VOLT:LIM:HIGH 1"):
        stand.device.turn_knob(command)
    with pytest.raises(InstrumentError, match=r'reports -113,"Und.* and -222,.*; look at its'):
        generator.set_sine(DRIVE_HZ, 2.0)
    assert answer(stand.device, "SYST:ERR?") == '+0,"No error"'
    with pytest.raises(InstrumentError, match=r"was sent 'SOUR1:VOLT 4' and reports -222"):
        generator.set_sine(DRIVE_HZ, 4.0)
    assert generator.read() == (DRIVE_HZ, 2.0, True)


def test_a_question_before_the_last_answer_was_read_is_a_query_error(stands):
    stand = stands("keysight")
    line = open_visa(stand.resource, 0.5, "a host")
    line.send("FREQ?")
    line.send("VOLT?")
    assert float(line.ask("SYST:ERR?").partition(",")[0]) == -410
    line.close()


LATE = WireFaults(late_answer_at=(2,), late_s=0.3)


@pytest.mark.parametrize("wire", ["usb", "vxi11", "socket"])
@pytest.mark.parametrize("lost", [False, True], ids=["late", "lost"])
def test_a_late_answer_does_not_end_a_run_and_leaves_no_error(stands, wire, lost):
    stand = stands("keysight", wire)
    generator = stand.open({"timeout_s": 0.2})
    generator.set_sine(DRIVE_HZ, 1.0)
    spoilt = stand.server if wire == "socket" else stand.wire
    for place in range(1, 8):
        faults = LATE.model_copy(update={"late_answer_at": (place,)})
        spoilt.spoil(WireFaults(lose_answer_at=(place,)) if lost else faults)
        volts = 1.0 + place / 10
        generator.set_sine(DRIVE_HZ + place, volts)
        assert generator.read() == (DRIVE_HZ + place, pytest.approx(volts), True)
    generator.output_off()
    generator.set_sine(DRIVE_HZ, 1.0)
    generator.output_off()
    assert answer(stand.device, "SYST:ERR?") == '+0,"No error"'


def test_a_query_error_that_another_has_caused_is_said(stands):
    stand = stands("keysight")
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.interrupt()
    with pytest.raises(InstrumentError, match="reports -410"):
        generator.set_sine(DRIVE_HZ, 2.0)


def test_other_errors_are_said_though_an_answer_was_late(stands):
    stand = stands("keysight")
    generator = stand.open({"timeout_s": 0.2})
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.turn_knob("NONSENSE")
    # Of its first question, whether the output is on.
    stand.wire.spoil(WireFaults(lose_answer_at=(1,)))
    with pytest.raises(InstrumentError, match=r'reports -113,"Undefined header"; look') as caught:
        generator.set_sine(DRIVE_HZ, 2.0)
    assert "-4" not in str(caught.value)


def test_switching_off_amid_a_question_leaves_no_error(stands):
    stand = stands("keysight")
    generator = stand.open({"timeout_s": 0.2})
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.wire.spoil(WireFaults(lose_answer_at=(1,)))
    generator.output_off()
    assert answer(stand.device, "SYST:ERR?") == '+0,"No error"'


def test_errors_from_before_do_not_keep_it_from_opening(stands):
    stand = stands("keysight")
    for _ in range(5):
        stand.device.turn_knob("NONSENSE")
    stand.open().set_sine(DRIVE_HZ, 1.0)


@pytest.mark.parametrize("unit", ["VRMS", "DBM"])
def test_volts_in_another_unit_are_not_taken_for_peak_to_peak(stands, unit):
    stand = stands("keysight")
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    stand.device.turn_knob("OUTP1:LOAD 50" if unit == "DBM" else "FREQ?")
    stand.device.turn_knob(f"VOLT:UNIT {unit}")
    with pytest.raises(InstrumentError, match="which makes no sense"):
        generator.read()


class Garbling:
    """Changes one byte of what is answered about the wave."""

    def __init__(self, device):
        self.receive_rightly = device.receive
        self.place, self.byte = 0, b""

    def receive(self, data):
        answer = self.receive_rightly(data)
        if data.startswith(b":SOUR1:FUNC?") and self.place < len(answer) - 1:
            return answer[: self.place] + self.byte + answer[self.place + 1 :]
        return answer


def test_one_wrong_byte_never_gives_other_volts(stands, monkeypatch):
    stand = stands("keysight")
    generator = stand.open({"timeout_s": 0.03})
    generator.set_sine(DRIVE_HZ, 5.0)
    garbling = Garbling(stand.device)
    monkeypatch.setattr(stand.device, "receive", garbling.receive)

    @given(place=st.integers(0, 170), byte=st.sampled_from(b"0123456789+-.;E"))
    @settings(max_examples=300, deadline=None)
    def read_garbled(place, byte):
        garbling.place, garbling.byte = place, bytes([byte])
        try:
            _, volts, _ = generator.read()
        except InstrumentError:
            return
        assert volts == pytest.approx(5.0, abs=0.001 * GAIN)

    read_garbled()
