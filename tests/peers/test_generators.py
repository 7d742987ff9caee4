"""Drivers and hosts of others use the simulated generators, over USB and LAN, also with our driver.

Each pair is independent: no code is shared between those who ask and those who answer.
"""

import warnings
from fractions import Fraction

import pytest

from tests.drivers.generators import GAIN, Stands
from tests.drivers.vxi11_server import Vxi11Server

DRIVE_HZ = Fraction(2_033_075, 1000)


@pytest.fixture
def stands():
    with Stands() as stands:
        yield stands


def of_others(name):
    """Import what others wrote, whatever it warns of."""
    with warnings.catch_warnings():
        # Not ours to mend.
        warnings.simplefilter("ignore")
        return pytest.importorskip(name, reason=f"needs {name}, of the extra peers (make test-all)")


# --- The 33500 ---------------------------------------------------------------------------------


@pytest.mark.parametrize("wire", ["usb", "socket", "vxi11"])
def test_pymeasure_drives_the_33500(stands, wire):
    agilent = of_others("pymeasure.instruments.agilent")
    stand = stands("keysight", wire)
    theirs = agilent.Agilent33500(
        stand.resource, visa_library="@py", timeout=1000, read_termination="\n"
    )
    try:
        assert "33512B" in theirs.id
        assert theirs.check_errors() == []
        channel = theirs.ch_1
        channel.output_load = "INF"
        channel.amplitude_unit = "VPP"
        channel.shape, channel.frequency, channel.amplitude = "SIN", 2033.075, 3.0
        channel.output = True
        assert theirs.check_errors() == []
        assert stand.device.socket == (DRIVE_HZ, 1.5, True)
        assert (channel.shape, channel.frequency, channel.amplitude) == ("SIN", 2033.075, 3.0)
        assert channel.output
        assert channel.amplitude_unit == "VPP"
        assert float(channel.output_load) == pytest.approx(9.9e37)
        channel.offset = 0.5
        assert (channel.voltage_high, channel.voltage_low) == (2.0, -1.0)
        channel.output_load = "50"
        assert channel.amplitude == 1.5, "the same socket, said for another load"
        theirs.write("SOUR1:VOLTS 1")
        assert [error[0] for error in theirs.check_errors()] == [-113]
        channel.output = False
        assert not channel.output
        assert not stand.device.socket[2]
    finally:
        theirs.adapter.close()


def test_qcodes_drives_the_33500(stands):
    drivers = of_others("qcodes.instrument_drivers.Keysight")
    stand = stands("keysight", "vxi11")
    theirs = drivers.Keysight33512B("generator", stand.resource, visalib="@py", silent=True)
    try:
        assert theirs.get_idn()["model"] == "33512B"
        channel = theirs.ch1
        channel.amplitude_unit("VRMS")
        channel.function_type("SIN")
        channel.frequency(2033.075)
        channel.amplitude(0.5)
        channel.output("ON")
        played_hz, played_v, on = stand.device.socket
        assert (played_hz, on) == (DRIVE_HZ, True)
        assert played_v == pytest.approx(2 * 0.5 * 2**0.5), "set for 50 ohm, open"
        assert channel.frequency() == 2033.075
        assert channel.amplitude() == pytest.approx(0.5)
        assert channel.output() == "ON"
        assert theirs.error() == (0, "No error")
    finally:
        theirs.close()


def test_pymeasure_reads_what_our_driver_plays(stands):
    agilent = of_others("pymeasure.instruments.agilent")
    stand = stands("keysight")
    ours = stand.open()
    server = Vxi11Server(stand.device)
    theirs = agilent.Agilent33500(
        f"TCPIP::127.0.0.1,{server.port}::inst0::INSTR", visa_library="@py", timeout=1000
    )
    try:
        for volts in (0.5, 3.3, 16.0):
            ours.set_sine(DRIVE_HZ, volts)
            channel = theirs.ch_1
            assert (channel.shape, channel.frequency) == ("SIN", float(DRIVE_HZ))
            assert channel.amplitude == pytest.approx(2 * volts / GAIN)
            assert channel.output
            channel.amplitude = 1.25
            assert ours.read() == (DRIVE_HZ, 1.25 / 2 * GAIN, True)
        assert theirs.check_errors() == []
    finally:
        theirs.adapter.close()
        server.close()


# --- The SDG2042X ------------------------------------------------------------------------------


@pytest.fixture
def qcodes_siglent(stands):
    """QCoDeS' driver and ours of one instrument, theirs over VXI-11 and ours over USB."""
    siglent = of_others("qcodes_contrib_drivers.drivers.Siglent.sdg")
    stand = stands("siglent")
    server = Vxi11Server(stand.device)
    resource = f"TCPIP::127.0.0.1,{server.port}::inst0::INSTR"
    theirs = siglent.Siglent_SDG_2042X("siglent", resource, visalib="@py")
    yield stand, theirs
    theirs.close()
    server.close()


def test_qcodes_drives_the_sdg2042x(qcodes_siglent):
    stand, theirs = qcodes_siglent
    channel = theirs.channel1
    theirs.reset()
    channel.load("HZ")
    channel.wave_type("sine")
    channel.frequency(2033.075)
    channel.amplitude(3.0)
    channel.enabled(True)
    assert stand.device.socket == (DRIVE_HZ, 1.5, True)
    assert (channel.frequency(), channel.amplitude(), channel.offset()) == (2033.075, 3.0, 0.0)
    assert (channel.high_level(), channel.low_level()) == (1.5, -1.5)
    assert (channel.enabled(), channel.load(), channel.polarity()) == (True, "HZ", "normal")
    channel.load(50)
    assert channel.amplitude() == 1.5, "the same socket, said for another load"
    theirs.channel2.wave_type("pulse")
    theirs.channel2.frequency(12.4)
    theirs.channel2.pulse_width(0.001)
    theirs.channel2.enabled(True)
    assert stand.device.trigger == (Fraction(62, 5), 2.0, True)
    assert theirs.channel2.pulse_width() == 0.001


def test_qcodes_reads_what_our_driver_plays(qcodes_siglent):
    stand, theirs = qcodes_siglent
    ours = stand.open()
    channel = theirs.channel1
    for volts in (0.5, 3.3, 16.0):
        ours.set_sine(DRIVE_HZ, volts)
        assert (channel.wave_type(), channel.frequency()) == ("sine", float(DRIVE_HZ))
        assert channel.amplitude() == pytest.approx(2 * volts / GAIN)
        assert channel.enabled()
        channel.amplitude(1.25)
        assert ours.read() == (DRIVE_HZ, 1.25 / 2 * GAIN, True)


def test_python_usbtmc_is_a_second_host_on_usb(stands):
    usbtmc = of_others("usbtmc")
    stand = stands("siglent")
    ours = stand.open()
    ours.set_sine(DRIVE_HZ, 3.0)
    theirs = usbtmc.Instrument(stand.resource.replace("::0::INSTR", "::INSTR"))
    theirs.timeout = 0.05
    theirs.open()
    try:
        assert theirs.ask("*IDN?") == ours.identity
        assert "FRQ,2033.075HZ" in theirs.ask("C1:BSWV?")
        theirs.write("C1:BSWV AMP,1")
        assert ours.read() == (DRIVE_HZ, 0.5 * GAIN, True)
        with pytest.raises(OSError, match="timed out"):
            theirs.ask("NO:SUCH?")
        assert theirs.ask("C1:OUTP?") == "C1:OUTP ON,LOAD,HZ,PLRT,NOR", "it recovers"
    finally:
        theirs.close()


def test_python_vxi11_is_a_second_host_on_the_network(stands):
    vxi11 = of_others("vxi11.vxi11")
    stand = stands("siglent")
    server = Vxi11Server(stand.device)
    theirs = vxi11.Instrument("127.0.0.1")
    # Without a port mapper.
    theirs.client = vxi11.CoreClient("127.0.0.1", server.port)
    try:
        theirs.write("C1:BSWV FRQ,2033.075,AMP,3")
        theirs.write("C1:OUTP ON")
        assert theirs.ask("C1:OUTP?") == "C1:OUTP ON,LOAD,HZ,PLRT,NOR"
        assert stand.device.socket == (DRIVE_HZ, 1.5, True)
    finally:
        theirs.close()
        server.close()
