"""What is plugged in is found, named as a bench file names it, and not changed."""

import builtins
import importlib
import logging
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from serial.tools import list_ports

from drivers import discovery
from drivers.bench_lock import address_locked
from drivers.discovery import (
    Found,
    Search,
    aravis_cameras,
    basler_cameras,
    search_all,
    serial_ports,
    sound_devices,
    visa_resources,
)
from drivers.emulators.novatech import NovatechEmulator
from drivers.emulators.serving import PtyServer, SocketServer
from drivers.emulators.siglent import SiglentEmulator
from drivers.emulators.srs import SRSEmulator
from drivers.errors import BenchSetupError
from protocols.bench import BenchFile
from tests.drivers.usbtmc_bus import UsbtmcInstrument, plugged_in


class Heard:
    """A device, and all that it heard."""

    def __init__(self, device):
        self.device, self.heard = device, b""

    def receive(self, data):
        self.heard += data
        return self.device.receive(data)


class Silent:
    """A device that is at another baud rate, or no instrument."""

    def receive(self, data):
        return b""


@pytest.fixture
def at_ports(monkeypatch):
    """Return a function that puts devices on serial ports of this computer, and nothing else."""
    servers = []

    def put(*devices):
        servers.extend(PtyServer(device) for device in devices)
        ports = [SimpleNamespace(device=each.port, description="n/a") for each in servers]
        monkeypatch.setattr(list_ports, "comports", lambda: ports)
        return [server.port for server in servers]

    yield put
    for server in servers:
        server.close()


@pytest.fixture
def no_network(monkeypatch):
    """Let no test send broadcasts."""
    from pyvisa_py.tcpip import TCPIPInstrSession

    monkeypatch.setattr(TCPIPInstrSession, "list_resources", staticmethod(list))


@pytest.fixture
def impatient(monkeypatch):
    """Wait less for what does not answer."""
    monkeypatch.setattr(discovery, "_SERIAL_TIMEOUT_S", 0.05)
    monkeypatch.setattr(discovery, "_VISA_TIMEOUT_S", 0.2)


def read_line(found):
    """The line of a bench file as YAML reads it."""
    return yaml.safe_load(found.line)[found.role]


# --- Serial ports ------------------------------------------------------------------------------


def test_a_serial_port_is_not_asked_unless_that_is_wanted(at_ports):
    device = Heard(NovatechEmulator(lambda _: None))
    (port,) = at_ports(device)
    (found,) = serial_ports(ask=False).found
    assert (found.address, found.answer, found.driver) == (port, "", None)
    assert "--ask" in found.remark
    assert device.heard == b""


def test_a_novatech_is_recognised_and_nothing_is_changed(at_ports):
    device = Heard(NovatechEmulator(lambda _: None))
    before = device.device.outputs
    (port,) = at_ports(device)
    (found,) = serial_ports(ask=True).found
    assert (found.role, found.driver) == ("synthesizers", "novatech-409b")
    line = read_line(found)
    assert line["options"] == {"port": port, "amplitude": "…", "amplitude_max": "…"}
    assert set(device.heard.split()) == set()
    assert device.device.outputs == before


def test_an_instrument_of_ieee_488_on_a_serial_line_is_recognised(at_ports):
    (port,) = at_ports(SRSEmulator(lambda *_: None))
    (found,) = serial_ports(ask=True).found
    assert found.answer.startswith("Stanford Research Systems,SG384")
    assert found.driver == "srs-sg380"
    assert found.options["resources"][0] == f"ASRL{port}::INSTR"


def test_what_does_not_answer_is_listed(at_ports, impatient):
    at_ports(Silent())
    (found,) = serial_ports(ask=True).found
    assert (found.answer, found.driver) == ("", None)
    assert "does not answer" in found.remark


@contextmanager
def held_by_another(port):
    """Another process that uses a port, as a run does."""
    code = (
        "import sys, time; from drivers.bench_lock import address_locked\n"
        "with address_locked(sys.argv[1], 'measures x.h5'):\n"
        "    print('held', flush=True); time.sleep(60)"
    )
    root = Path(__file__).parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", code, port],
        env={**os.environ, "PYTHONPATH": str(root)}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_port_that_a_run_uses_is_not_asked(at_ports):
    device = Heard(NovatechEmulator(lambda _: None))
    (port,) = at_ports(device)
    with held_by_another(port) as process:
        (found,) = serial_ports(ask=True).found
    assert f"in use by process {process.pid}" in found.remark
    assert "measures x.h5" in found.remark
    assert device.heard == b""


def test_a_port_has_the_name_that_it_keeps(at_ports, tmp_path, monkeypatch):
    (port,) = at_ports(NovatechEmulator(lambda _: None))
    link = tmp_path / "usb-FTDI_409B_A1-if00-port0"
    link.symlink_to(port)
    monkeypatch.setattr(discovery, "_STABLE_NAMES", tmp_path)
    (found,) = serial_ports(ask=True).found
    assert found.address == found.options["port"] == str(link)
    assert port in found.remark


def test_a_port_without_permission_names_the_remedy(at_ports, monkeypatch):
    device = Heard(NovatechEmulator(lambda _: None))
    at_ports(device)
    monkeypatch.setattr(os, "access", lambda *_: False)
    (found,) = serial_ports(ask=True).found
    assert "dialout" in found.remark
    assert device.heard == b""


# --- VISA --------------------------------------------------------------------------------------


def test_a_generator_on_usb_is_found_and_only_asked_what_it_is(no_network):
    device = Heard(SiglentEmulator())
    instrument = UsbtmcInstrument(device, 0xF4EC, 0x1102, "SDG2XSIM")
    with plugged_in(instrument), usb_sessions():
        search = visa_resources()
    (found,) = search.found
    assert "SDG2042X" in found.answer
    assert set(device.heard.split()) == {b"*IDN?"}
    line = read_line(found)
    assert line == {"driver": "siglent-sdg2042x", "options": {"resource": found.address}}
    bench = BenchFile.from_file().replace(
        {f"instruments.generator.{key}": value for key, value in line.items()}
    )
    assert bench.instruments.generator.options["resource"] == found.address


@contextmanager
def usb_sessions():
    """Let pyvisa-py search USB although it was imported where libusb is missing."""
    from pyvisa.constants import InterfaceType
    from pyvisa_py.sessions import Session

    key = (InterfaceType.usb, "INSTR")
    before = Session._session_classes[key]  # noqa: SLF001  # it has no other way
    Session._session_classes[key] = importlib.import_module("pyvisa_py.usb").USBInstrSession  # noqa: SLF001  # it has no other way
    try:
        yield
    finally:
        Session._session_classes[key] = before  # noqa: SLF001  # it has no other way


def test_one_bus_that_fails_does_not_hide_the_others(no_network, monkeypatch):
    from pyvisa_py.tcpip import TCPIPInstrSession

    def unreachable():
        raise OSError("Network is unreachable")

    monkeypatch.setattr(TCPIPInstrSession, "list_resources", staticmethod(unreachable))
    instrument = UsbtmcInstrument(SiglentEmulator(), 0xF4EC, 0x1102, "SDG2XSIM")
    with plugged_in(instrument), usb_sessions():
        search = visa_resources()
    assert len(search.found) == 1
    assert any("TCPIP" in remark and "unreachable" in remark for remark in search.remarks)


def test_a_usb_instrument_without_permission_names_the_udev_rule(monkeypatch):
    from pyvisa_py.common import LOGGER
    from pyvisa_py.tcpip import TCPIPInstrSession

    def search():
        LOGGER.warning("Found a USB INSTR device whose serial number cannot be read. The partial "
                       "VISA resource name is: USB0::62700::4354::???::0::INSTR")  # fmt: skip
        return []

    monkeypatch.setattr(TCPIPInstrSession, "list_resources", staticmethod(search))
    (remark,) = [each for each in visa_resources().remarks if "udev" in each]
    assert "USB0::62700::4354::???::0::INSTR" in remark
    assert 'ATTR{idVendor}=="f4ec"' in remark
    assert not [each for each in logging.getLogger("pyvisa").handlers if each.level]


def test_a_resource_that_does_not_answer_is_listed_with_the_reason(
    no_network, monkeypatch, impatient
):
    server = SocketServer(Silent())
    name = f"TCPIP::127.0.0.1::{server.port}::SOCKET"
    monkeypatch.setattr(discovery, "_visa_searches", lambda remarks: iter([[name]]))
    (found,) = visa_resources().found
    server.close()
    assert (found.address, found.answer, found.line) == (name, "", "")
    assert "did not answer" in found.remark


# --- Cameras and sound -------------------------------------------------------------------------


def test_basler_cameras_are_found_without_being_opened(monkeypatch):
    device = SimpleNamespace(
        GetSerialNumber=lambda: "40012345",
        GetVendorName=lambda: "Basler",
        GetModelName=lambda: "acA1300-60gm",
    )
    factory = SimpleNamespace(EnumerateDevices=lambda: [device])
    pylon = SimpleNamespace(TlFactory=SimpleNamespace(GetInstance=lambda: factory))
    monkeypatch.setattr(discovery, "load_pylon", lambda: pylon)
    (found,) = basler_cameras().found
    assert read_line(found) == {"driver": "basler", "options": {"serial": "40012345"}}
    assert "acA1300-60gm" in found.answer


def test_cameras_of_aravis_are_found_without_being_opened(monkeypatch):
    names = ["Basler-40012345", "Fake_1"]
    aravis = SimpleNamespace(
        update_device_list=lambda: None,
        get_n_devices=lambda: len(names),
        get_device_id=lambda number: names[number],
    )
    monkeypatch.setattr(discovery, "load_aravis", lambda: aravis)
    assert [each.address for each in aravis_cameras().found] == names
    assert read_line(aravis_cameras().found[0])["options"] == {"device": "Basler-40012345"}


def test_sound_cards_that_can_play_are_found(monkeypatch):
    devices = [
        {"name": "Scarlett 2i2: USB (hw:1,0)", "hostapi": 0, "max_output_channels": 2,
         "default_samplerate": 48000.0},
        {"name": "microphone", "hostapi": 0, "max_output_channels": 0,
         "default_samplerate": 44100.0},
    ]  # fmt: skip
    sounddevice = SimpleNamespace(
        query_hostapis=lambda: [{"name": "ALSA"}], query_devices=lambda: devices
    )
    monkeypatch.setattr(discovery, "load_sounddevice", lambda: sounddevice)
    (found,) = sound_devices().found
    options = read_line(found)["options"]
    assert (options["device"], options["sample_rate_hz"]) == ("Scarlett 2i2: USB (hw:1,0)", 48000)
    assert "volts_per_full_scale" in options
    assert "unlocked" in found.remark


# --- All of them -------------------------------------------------------------------------------


@pytest.fixture
def nothing_installed(monkeypatch):
    """A computer without any of the libraries."""
    imported = builtins.__import__

    def refuse(name, *arguments, **more):
        if name.partition(".")[0] in ("pypylon", "gi", "serial", "pyvisa", "pyvisa_py"):
            raise ImportError(f"No module named {name!r}")
        return imported(name, *arguments, **more)

    def no_module(name, *_):
        if name == "sounddevice":
            raise OSError("PortAudio library not found")
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(builtins, "__import__", refuse)
    monkeypatch.setattr(importlib, "import_module", no_module)


def test_each_library_that_is_missing_is_one_line_with_its_remedy(nothing_installed):
    searches = search_all()
    remarks = [remark for search in searches for remark in search.remarks]
    assert [search.kind for search in searches] == ["serial", "visa", "camera", "camera", "sound"]
    assert len(remarks) == 5
    for words in ("reedbench[basler]", "gir1.2-aravis", "libportaudio2"):
        assert any(words in remark for remark in remarks)
    assert not any("instruments." in remark or "\n" in remark for remark in remarks)


def test_a_search_that_fails_does_not_hide_what_others_find(monkeypatch):
    found = Found("sound", "a card")

    def broken(*_):
        raise RuntimeError("segment\nfault")

    def missing():
        raise BenchSetupError("instruments.camera.driver: needs pypylon; install it")

    for name in ("serial_ports", "visa_resources", "aravis_cameras"):
        monkeypatch.setattr(discovery, name, broken)
    monkeypatch.setattr(discovery, "basler_cameras", missing)
    monkeypatch.setattr(discovery, "sound_devices", lambda: Search("sound", (found,)))
    searches = search_all()
    assert searches[-1].found == (found,)
    assert searches[0].remarks == ("the search failed (segment fault)",)
    assert searches[2].remarks == ("needs pypylon; install it",)


def test_asking_frees_the_address_again(at_ports, impatient):
    (port,) = at_ports(Silent())
    serial_ports(ask=True)
    with address_locked(port, "a run"):
        pass
