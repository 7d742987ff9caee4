"""The SDG2042X: a recorded session, silent clamping, and the camera's pulses."""

import os
import re
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.cameras.trigger import CameraTrigger
from drivers.emulators.serving import WireFaults
from drivers.emulators.siglent import SiglentEmulator
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.generators.siglent import understand_wave
from tests.drivers.generators import GAIN, answer
from tests.drivers.vxi11_server import Vxi11Server

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("REEDBENCH_SHARED", REPOSITORY.parent / "shared"))
TRANSCRIPT = SHARED / "data" / "sdg2042x" / "transcript.txt"
DRIVE_HZ = Fraction(2_033_075, 1000)
PULSES = {"camera_trigger": {"width_s": 0.001, "high_v": 3.3}}
SAID = (
    "C1:BSWV WVTP,SINE,FRQ,12345.67891HZ,PERI,8.1e-05S,AMP,2.0005V,AMPVRMS,0.707177Vrms,"
    "OFST,0V,HLEV,1.00025V,LLEV,-1.00025V,PHSE,0"
)


# --- The simulated instrument ------------------------------------------------------------------


def test_the_simulated_generator_answers_as_the_real_one_did():
    if not TRANSCRIPT.exists():
        pytest.skip(f"the recorded session is not at {TRANSCRIPT}")
    device, said, answers = SiglentEmulator(), None, 0
    for number, line in enumerate(TRANSCRIPT.read_text().splitlines(), start=1):
        if line.startswith("-> "):
            said = answer(device, line[3:])
        elif line.startswith("<- "):
            assert said == line[3:], f"line {number}"
            answers += 1
    assert answers == 21


# Of the same public session, what the excerpt leaves out.
@pytest.mark.parametrize(
    ("commands", "said"),
    [
        (
            ("C1:BSWV WVTP,PULSE", "C1:BSWV WIDTH,1E-04"),
            "C1:BSWV WVTP,PULSE,FRQ,1000HZ,PERI,0.001S,AMP,4V,AMPVRMS,2Vrms,OFST,0V,HLEV,2V,"
            "LLEV,-2V,DUTY,10,WIDTH,0.0001,RISE,8.4e-09S,FALL,8.4e-09S,DLY,0",
        ),
        (
            ("C1:BSWV WVTP,PULSE", "C1:BSWV WIDTH,0.0002", "C1:BSWV FRQ,30E6"),
            "C1:BSWV WVTP,PULSE,FRQ,25000000HZ,PERI,4e-08S,AMP,4V,AMPVRMS,2Vrms,OFST,0V,HLEV,2V,"
            "LLEV,-2V,DUTY,59.25,WIDTH,2.37e-08,RISE,8.4e-09S,FALL,8.4e-09S,DLY,0",
        ),
        (
            ("C1:OUTP LOAD,600", "C1:BSWV OFST,-3.3", "C1:BSWV AMP,15"),
            "C1:BSWV WVTP,SINE,FRQ,1000HZ,PERI,0.001S,AMP,11.8615V,AMPVRMS,4.19305Vrms,"
            "AMPDBM,14.6691dBm,OFST,-3.3V,HLEV,2.63077V,LLEV,-9.23077V,PHSE,0",
        ),
        (
            ("C1:BSWV LLEV,1", "C1:BSWV HLEV,0.5"),
            "C1:BSWV WVTP,SINE,FRQ,1000HZ,PERI,0.001S,AMP,0.002V,AMPVRMS,0.000707Vrms,OFST,1.001V,"
            "HLEV,1.002V,LLEV,1V,PHSE,0",
        ),
        (
            ("C1:BSWV FRQ,40E6", "C1:BSWV WVTP,SQUARE", "C1:BSWV DUTY,30"),
            "C1:BSWV WVTP,SQUARE,FRQ,25000000HZ,PERI,4e-08S,AMP,4V,AMPVRMS,2Vrms,OFST,0V,HLEV,2V,"
            "LLEV,-2V,PHSE,0,DUTY,40.75",
        ),
    ],
)
def test_other_waves_are_said_as_the_real_one_says_them(commands, said):
    device = SiglentEmulator()
    for line in commands:
        assert answer(device, line) == ""
    assert answer(device, "C1:BSWV?") == said


def test_a_mode_ends_when_another_begins_and_with_another_wave():
    device = SiglentEmulator()
    assert answer(device, "C1:MDWV?") == "C1:MDWV STATE,OFF"
    for mode in ("MDWV", "BTWV"):
        answer(device, f"C1:{mode} STATE,ON")
        assert answer(device, f"C1:{mode}?").startswith(f"C1:{mode} STATE,ON")
    assert answer(device, "C1:MDWV?") == "C1:MDWV STATE,OFF"
    answer(device, "C1:BSWV WVTP,SINE")
    assert answer(device, "C1:BTWV?") == "C1:BTWV STATE,OFF"


@given(st.lists(st.binary(max_size=30), max_size=6))
@example([b"C1:BSWV FRQ,nan\n", b"C1:BSWV AMP,1e999\nC1:OUTP LOAD,inf\n", b"C1:BSWV FRQ,-1\n"])
def test_nothing_that_is_sent_makes_it_fall_over(lines):
    device = SiglentEmulator()
    for line in lines:
        device.receive(line)
    device.receive(b"\n")
    assert answer(device, "C1:BSWV?").startswith("C1:BSWV WVTP,")


# --- The driver --------------------------------------------------------------------------------


def test_what_is_clamped_without_a_word_is_noticed(stands):
    stand = stands("siglent", most_vpp=6.0)
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 3.0 * GAIN)
    with pytest.raises(InstrumentError, match=r"2033.075 Hz at 8 Vpp, but says .* at 6 Vpp"):
        generator.set_sine(DRIVE_HZ, 4.0 * GAIN)
    assert generator.read() == (DRIVE_HZ, 3.0 * GAIN, True)


@pytest.mark.parametrize("mode", ["MDWV", "SWWV", "BTWV"])
def test_a_modulation_that_another_program_set_is_ended(stands, mode):
    stand = stands("siglent")
    stand.device.turn_knob(f"C1:{mode} STATE,ON")
    stand.open()
    assert answer(stand.device, f"C1:{mode}?") == f"C1:{mode} STATE,OFF"


def test_the_sum_of_both_channels_is_not_left_on_one(stands):
    stand = stands("siglent")
    stand.device.turn_knob("C1:CMBN ON")
    assert stand.device.socket[1] == 4.0
    generator = stand.open()
    generator.set_sine(DRIVE_HZ, 1.0)
    assert stand.device.socket == (DRIVE_HZ, 1.0 / GAIN, True)


def test_a_frequency_of_more_digits_than_are_said_is_read_exactly(stands):
    stand = stands("siglent")
    generator = stand.open()
    for last in range(10):
        frequency_hz = Fraction(19_999_123_450 + last, 1_000_000)
        generator.set_sine(frequency_hz, 1.0)
        assert answer(stand.device, "C1:BSWV?").split(",")[3] in ("19999.12345HZ", "19999.12346HZ")
        assert generator.read()[0] == stand.device.socket[0] == frequency_hz
    stand.device.turn_knob("C1:BSWV FRQ,19999.12348")
    assert generator.read()[0] == Fraction("19999.12348")


def test_one_wrong_byte_never_gives_another_sine():
    right = understand_wave("C1", SAID)
    assert (right["FRQ"], right["AMP"]) == ("12345.67891", "2.0005")
    understood = 0
    for place in range(len(SAID)):
        for byte in range(32, 127):
            try:
                wave = understand_wave("C1", SAID[:place] + chr(byte) + SAID[place + 1 :])
            except ValueError:
                continue
            understood += 1
            # Last digits lie within the rounding of the numbers that they have to agree with.
            assert abs(float(wave["AMP"]) - 2.0005) < 2e-5
            assert abs(float(wave["FRQ"]) - 12345.67891) < 0.25
            assert abs(float(wave["OFST"])) < 2e-5
    assert understood > len(SAID), "right bytes, and wrong ones where nothing stands"


@given(st.text(max_size=60))
def test_whatever_else_is_answered_makes_no_sense(text):
    with pytest.raises(ValueError, match=f"^{re.escape(text)}"):
        understand_wave("C1", text)


def test_its_answers_come_over_vxi_11_through_the_port_mapper(stands):
    stand = stands("siglent")
    try:
        server = Vxi11Server(stand.wire, port_mapper_port=111)
    except OSError as error:
        pytest.skip(f"the port mapper's port 111 cannot be had here: {error}")
    try:
        generator = stand.open({"resource": "TCPIP::127.0.0.1::INSTR", "timeout_s": 1.0})
        generator.set_sine(DRIVE_HZ, 1.0)
        assert generator.read() == (DRIVE_HZ, 1.0, True)
    finally:
        generator.close()
        server.close()


# --- The camera's pulses -----------------------------------------------------------------------


def test_pulses_are_played_at_the_cameras_rate_and_stopped(stands):
    stand = stands("siglent")
    generator = stand.open(PULSES)
    generator.set_sine(DRIVE_HZ, 2.0)
    trigger = stand.contexts[0].share(CameraTrigger)
    for rate_hz in (Fraction(62, 5), Fraction(25, 2)):
        del stand.wire.heard[:]
        trigger.play(rate_hz)
        commands = [line for line in stand.wire.heard if "?" not in line]
        assert (commands[0], commands[-1]) == ("C2:OUTP OFF", "C2:OUTP ON"), (
            "no pulse while they change"
        )
        assert stand.device.trigger == (rate_hz, 1.65, True)
        wave = understand_wave("C2", answer(stand.device, "C2:BSWV?"))
        assert (wave["HLEV"], wave["LLEV"], wave["WIDTH"]) == ("3.3", "0", "0.001")
    assert generator.read() == (DRIVE_HZ, 2.0, True), "the loudspeaker hears nothing of it"
    trigger.stop()
    assert not stand.device.trigger[2]


def test_closing_stops_the_pulses(stands):
    stand = stands("siglent")
    generator = stand.open(PULSES)
    generator.play_pulses(Fraction(12))
    generator.close()
    assert not stand.device.trigger[2]


@pytest.mark.parametrize("rate_hz", [Fraction(0), Fraction(-1), Fraction(37, 3), Fraction(1000)])
def test_a_rate_that_cannot_be_played_exactly_is_refused(stands, rate_hz):
    stand = stands("siglent")
    generator = stand.open(PULSES)
    del stand.wire.heard[:]
    with pytest.raises(LimitError, match=r"choose a frame rate on it|shorten instruments\.gen"):
        generator.play_pulses(rate_hz)
    assert stand.wire.heard == []


def test_without_an_instrument_that_plays_pulses_a_camera_is_reported(stands):
    stand = stands("siglent")
    generator = stand.open()
    with pytest.raises(BenchSetupError, match=r"no instrument plays them; add camera_trigger to"):
        stand.contexts[0].share(CameraTrigger).play(Fraction(12))
    with pytest.raises(BenchSetupError, match=r"add camera_trigger to instruments\.generator"):
        generator.play_pulses(Fraction(12))


@pytest.mark.parametrize("place", range(1, 8))
def test_pulses_that_are_not_confirmed_are_said(stands, place):
    stand = stands("siglent")
    generator = stand.open({**PULSES, "timeout_s": 0.03})
    stand.wire.spoil(WireFaults(lose_command_at=(place, place + 1)))
    try:
        generator.play_pulses(Fraction(12))
    except InstrumentError:
        return
    assert stand.device.trigger == (12, 1.65, True)


def test_pulses_that_are_clamped_are_said(stands):
    stand = stands("siglent", most_vpp=4.0)
    with pytest.raises(InstrumentError, match=r"channel 2 was set to pulses of 0.001 s and"):
        stand.open(PULSES).play_pulses(Fraction(12))
    assert not stand.device.trigger[2]


@pytest.mark.parametrize("pulse", [{"width_s": 0.001}, {"width_s": 0.001, "high_v": 12.0}])
def test_pulses_that_could_harm_a_camera_are_refused(stands, pulse):
    stand = stands("siglent")
    with pytest.raises(BenchSetupError, match=r"options\.camera_trigger\.high_v: "):
        stand.open({"camera_trigger": pulse})
