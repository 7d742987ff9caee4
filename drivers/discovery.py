"""Find instruments that are connected to this computer, and their lines in a bench file.

Each kind of thing has a search of its own: serial ports, VISA resources (USB and LAN), cameras,
sound devices. A search that fails is a remark, and does not hide what the others find. Nothing is
changed on any instrument: VISA resources are asked ``*IDN?``, cameras are not opened, and serial
ports are asked only on request. What another program of this package uses is not asked.
"""

import json
import logging
import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from drivers.bench_lock import BenchInUseError, address_locked
from drivers.cameras.aravis import load_aravis
from drivers.cameras.basler import load_pylon
from drivers.errors import BenchSetupError, InstrumentError
from drivers.generators.soundcard import load_sounddevice
from drivers.roles import RoleName
from drivers.transport.visa import open_visa

Kind = Literal["serial", "visa", "camera", "sound"]

_DOES: Final = "lists what is plugged in"
# Links by maker and serial number, which udev keeps (Linux); the numbers of /dev/ttyUSB0 change.
_STABLE_NAMES: Final = Path("/dev/serial/by-id")
# Factory settings of the Novatech 409B, and of most instruments of IEEE 488.2 (the SG380 too).
_BAUD_RATES: Final = (19_200, 9_600)
# The Novatech answers within 30 ms. Chosen: ten times that.
_SERIAL_TIMEOUT_S: Final = 0.3
# Chosen: `VisaLine` asks a silent resource four times, which takes 2 s then.
_VISA_TIMEOUT_S: Final = 0.5
# An answer of one line, with its echo and what was still on its way.
_MOST_LINES: Final = 8

# Whose identity begins like this, has that driver; see `_MODEL` of the drivers.
_DRIVERS: Final[Sequence[tuple[str, RoleName, str]]] = (
    (r"Siglent Technologies,SDG2(04|08|12)2X,", "generator", "siglent-sdg2042x"),
    (r"(Keysight|Agilent) Technologies,335\d\d[AB],", "generator", "keysight-33500b"),
    (r"Stanford Research Systems,SG38[246],", "synthesizers", "srs-sg380"),
)
_NOVATECH_ANSWER: Final = "OK to an empty line, as a Novatech 409B does"
# Required options that only a person can know.
_TO_MEASURE: Final[Mapping[str, tuple[str, ...]]] = {
    "novatech-409b": ("amplitude", "amplitude_max"),
    "srs-sg380": ("power_dbm", "power_max_dbm"),
    "sound-card": ("volts_per_full_scale",),
}
_BLANK: Final = "…"
# With these begin messages about missing libraries.
_KEYS_OF_DRIVERS: Final[Mapping[str, str]] = {
    "camera": "instruments.camera.driver: ",
    "sound": "instruments.generator.driver: ",
}


@dataclass(frozen=True, slots=True)
class Found:
    """One connected instrument or port.

    Attributes
    ----------
    kind : {'serial', 'visa', 'camera', 'sound'}
    address : str
        As a bench file writes it.
    answer : str
        What it says that it is; empty if it was not asked or did not answer.
    remark : str
        Anything else that helps to recognise or to use it.
    role, driver : str or None
        What a bench file would use it as; None where that is not known.
    options : mapping
        Options of that driver that are known by now.
    """

    kind: Kind
    address: str
    answer: str = ""
    remark: str = ""
    role: RoleName | None = None
    driver: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def line(self) -> str:
        """Line of a bench file, with ``…`` where a person has to fill in; empty without driver."""
        if self.driver is None:
            return ""
        written = [f"{key}: {_written(value)}" for key, value in self.options.items()]
        written += [f"{key}: {_BLANK}" for key in _TO_MEASURE.get(self.driver, ())]
        return f"{self.role}: {{driver: {self.driver}, options: {{{', '.join(written)}}}}}"

    def to_json(self) -> dict[str, Any]:
        """Return plain values with stable keys."""
        return {
            "kind": self.kind,
            "address": self.address,
            "answer": self.answer,
            "remark": self.remark,
            "role": self.role,
            "driver": self.driver,
            "options": dict(self.options),
            "fill_in": list(_TO_MEASURE.get(self.driver or "", ())),
        }


@dataclass(frozen=True, slots=True)
class Search:
    """Result of one search.

    Attributes
    ----------
    kind : str
        As in `Found`.
    found : tuple of Found
    remarks : tuple of str
        What could not be looked for, and the remedy.
    """

    kind: Kind
    found: tuple[Found, ...] = ()
    remarks: tuple[str, ...] = ()


def search_all(ask_serial: bool = False) -> tuple[Search, ...]:
    """Search for everything that a bench can use.

    Parameters
    ----------
    ask_serial : bool
        Whether to send an empty line and ``*IDN?`` to every serial port, see `serial_ports`.

    Returns
    -------
    tuple of Search
    """
    searches: tuple[tuple[Kind, Callable[[], Search]], ...] = (
        ("serial", lambda: serial_ports(ask_serial)),
        ("visa", visa_resources),
        ("camera", basler_cameras),
        ("camera", aravis_cameras),
        ("sound", sound_devices),
    )
    return tuple(_tried(kind, search) for kind, search in searches)


def _tried(kind: Kind, search: Callable[[], Search]) -> Search:
    try:
        return search()
    except BenchSetupError as error:
        # It begins with the key of the bench file, which does not matter here.
        return Search(kind, remarks=(str(error).removeprefix(_KEYS_OF_DRIVERS.get(kind, "")),))
    except Exception as error:  # noqa: BLE001  # a search that fails must not hide the others
        return Search(kind, remarks=(f"the search failed ({_one_line(error)})",))


# --- Serial ports ------------------------------------------------------------------------------


def serial_ports(ask: bool) -> Search:
    """Find serial ports, by names that stay the same when they are plugged in again.

    Parameters
    ----------
    ask : bool
        Whether to open each port and send an empty line and ``*IDN?``. This does nothing to a
        Novatech 409B and to instruments of IEEE 488.2. Other devices may obey what they receive,
        and some (Arduinos) restart when their port is opened.
    """
    from serial.tools import list_ports

    stable = _stable_names()
    ports = sorted(list_ports.comports(), key=lambda port: str(port.device))
    return Search("serial", tuple(_serial_port(port, stable, ask) for port in ports))


def _stable_names() -> dict[str, str]:
    """Links of udev by the device file that they lead to."""
    if not _STABLE_NAMES.is_dir():
        return {}
    return {os.path.realpath(link): str(link) for link in sorted(_STABLE_NAMES.iterdir())}


def _serial_port(port: Any, stable: Mapping[str, str], ask: bool) -> Found:
    address = stable.get(os.path.realpath(port.device), port.device)
    remarks = [] if address == port.device else [f"is {port.device} now"]
    # pyserial says n/a of what it does not know.
    remarks += [port.description] if port.description not in (None, "", "n/a") else []
    answer = ""
    if os.path.exists(port.device) and not os.access(port.device, os.R_OK | os.W_OK):
        remarks.append(
            "you may not use it: sudo usermod -aG dialout $USER, then log out and in again"
        )
    elif ask:
        answer, trouble = _asked(address, lambda: _serial_answer(address))
        remarks += [trouble] if trouble else []
    else:
        remarks.append("not asked what it is: use --ask")
    is_novatech = answer == _NOVATECH_ANSWER
    role, driver = ("synthesizers", "novatech-409b") if is_novatech else _driver_of(answer)
    options: dict[str, Any] = {}
    if driver is not None:
        options = {"port": address} if is_novatech else _visa_options(driver, _as_visa(address))
    return Found("serial", address, answer, "; ".join(remarks), role, driver, options)


def _as_visa(port: str) -> str:
    """VISA's name of a serial port, by which the drivers of VISA instruments know it."""
    return f"ASRL{port}::INSTR"


def _serial_answer(port: str) -> str:
    """Ask what is at a serial port; empty if it does not answer.

    Raises
    ------
    OSError
        If the port cannot be opened, because another program has it, for example.
    """
    import serial

    for baud in _BAUD_RATES:
        with serial.serial_for_url(
            port,
            baudrate=baud,
            timeout=_SERIAL_TIMEOUT_S,
            write_timeout=_SERIAL_TIMEOUT_S,
            exclusive=True,
        ) as line:
            # The first line may end what another program left unfinished.
            if "OK" in (*_exchanged(line, ""), *_exchanged(line, "")):
                return _NOVATECH_ANSWER
            answers = [text for text in _exchanged(line, "*IDN?") if text.count(",") >= 2]
            if answers:
                return answers[-1]
    return ""


def _exchanged(line: Any, text: str) -> list[str]:
    """Send a line, and return what comes until nothing more does."""
    line.write(f"{text}\r\n".encode("ascii"))
    heard: list[str] = []
    while len(heard) < _MOST_LINES and (data := line.read_until(b"\n")):
        heard.append(data.decode("ascii", errors="replace").strip())
    # An instrument whose echo is on says the question first.
    return [answer for answer in heard if answer.isprintable() and answer != text]


# --- VISA resources ----------------------------------------------------------------------------


def visa_resources() -> Search:
    """Find instruments on USB and in the local network, and ask each ``*IDN?``.

    In the network, one broadcast asks which hosts speak VXI-11, and nothing else is sent to them.
    """
    remarks: list[str] = []
    with _heard_warnings(remarks):
        names = sorted({name for search in _visa_searches(remarks) for name in search})
    remarks.append(
        "an instrument on the network that is not listed can be named all the same: "
        "TCPIP::ADDRESS::INSTR, with the address from its front panel"
    )
    return Search("visa", tuple(_visa_resource(name) for name in names), tuple(remarks))


def _visa_searches(remarks: list[str]) -> Iterator[Sequence[str]]:
    """Yield the names that each kind of VISA session finds; serial ports are found elsewhere."""
    import pyvisa
    from pyvisa.constants import InterfaceType
    from pyvisa_py.sessions import Session  # type: ignore[import-untyped]  # no stubs

    pyvisa.ResourceManager("@py")
    kinds = {interface for (interface, kind), _ in Session.iter_valid_session_classes()}
    if InterfaceType.usb not in kinds:
        remarks.append(
            "USB instruments cannot be looked for without libusb: sudo apt install libusb-1.0-0"
        )
    for (interface, kind), session in Session.iter_valid_session_classes():
        if kind != "INSTR" or interface is InterfaceType.asrl:
            continue
        try:
            yield session.list_resources()
        except Exception as error:  # noqa: BLE001  # pyvisa-py raises whatever a bus raises
            remarks.append(f"{interface.name.upper()}: the search failed ({_one_line(error)})")


@contextmanager
def _heard_warnings(remarks: list[str]) -> Iterator[None]:
    """Turn what pyvisa-py logs into remarks, and leave out its advice on packages."""

    class Heard(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            name = re.search(r"USB\d*::(\d+)::\d+::\?+::\d+::INSTR", record.getMessage())
            if name is not None:
                remarks.append(
                    f"{name[0]}: you may not use it; write the line "
                    f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{int(name[1]):04x}", MODE="0666" '
                    "into /etc/udev/rules.d/90-bench.rules (as root), and plug it in again"
                )

    logger, heard = logging.getLogger("pyvisa"), Heard(logging.WARNING)
    logger.addHandler(heard)
    propagates, logger.propagate = logger.propagate, False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.removeHandler(heard)
        logger.propagate = propagates


def _visa_resource(name: str) -> Found:
    answer, trouble = _asked(name, lambda: _visa_answer(name))
    role, driver = _driver_of(answer)
    options = {} if driver is None else _visa_options(driver, name)
    return Found("visa", name, answer, trouble, role, driver, options)


def _visa_answer(name: str) -> str:
    line = open_visa(name, _VISA_TIMEOUT_S, "instrument")
    try:
        return line.identity
    finally:
        line.close()


def _visa_options(driver: str, name: str) -> dict[str, Any]:
    # The pair of AOM1 and AOM2; the other one has to be filled in.
    return {"resources": [name, _BLANK]} if driver == "srs-sg380" else {"resource": name}


# --- Cameras -----------------------------------------------------------------------------------


def basler_cameras() -> Search:
    """Find Basler cameras through pylon, without opening them.

    Raises
    ------
    BenchSetupError
        If pypylon is missing.
    """
    devices = load_pylon().TlFactory.GetInstance().EnumerateDevices()
    found = (
        Found(
            "camera",
            str(device.GetSerialNumber()),
            f"{device.GetVendorName()} {device.GetModelName()}",
            f"serial number {device.GetSerialNumber()}",
            "camera",
            "basler",
            {"serial": str(device.GetSerialNumber())},
        )
        for device in devices
    )
    return Search("camera", tuple(found))


def aravis_cameras() -> Search:
    """Find GigE Vision and USB3 Vision cameras through Aravis, without opening them.

    Raises
    ------
    BenchSetupError
        If Aravis is missing.
    """
    aravis = load_aravis()
    aravis.update_device_list()
    names = [str(aravis.get_device_id(number)) for number in range(aravis.get_n_devices())]
    found = (
        Found("camera", name, name, "", "camera", "aravis", {"device": name}) for name in names
    )
    return Search("camera", tuple(found))


# --- Sound devices -----------------------------------------------------------------------------


def sound_devices() -> Search:
    """Find sound cards that can play.

    Raises
    ------
    BenchSetupError
        If PortAudio is missing.
    """
    sounddevice = load_sounddevice()
    hosts = sounddevice.query_hostapis()
    devices = [each for each in sounddevice.query_devices() if each["max_output_channels"] > 0]
    found = (
        Found(
            "sound",
            str(device["name"]),
            "",
            f"{hosts[device['hostapi']]['name']}, {device['max_output_channels']} channels, "
            f"{device['default_samplerate']:g} Hz; unlocked: for trials, not for maps of phase",
            "generator",
            "sound-card",
            {"device": str(device["name"]), "sample_rate_hz": round(device["default_samplerate"])},
        )
        for device in devices
    )
    return Search("sound", tuple(found))


# --- What all searches share -------------------------------------------------------------------


def _asked(address: str, ask: Callable[[], str]) -> tuple[str, str]:
    """Return what is at an address, and why that could not be asked; one of them is empty."""
    try:
        with address_locked(address, _DOES):
            answer = ask()
    except BenchInUseError as busy:
        return "", f"not asked: in use by {busy.holder or 'another program'}"
    except (BenchSetupError, InstrumentError, OSError, ValueError) as error:
        return "", _one_line(error).removeprefix(f"instrument at {address}: ")
    return answer, "" if answer else "does not answer"


def _driver_of(answer: str) -> tuple[RoleName | None, str | None]:
    for pattern, role, driver in _DRIVERS:
        if re.match(pattern, answer):
            return role, driver
    return None, None


def _written(value: object) -> str:
    """Write a value as YAML: strings in quotes, because colons and blanks mean something there."""
    return json.dumps(value, ensure_ascii=False)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
