"""Instruments that are spoken to in lines of text over USB, LAN or a serial line, through VISA.

`open_visa` takes the names of resources that VISA knows, such as ``TCPIP::192.168.0.7::INSTR``
(VXI-11), ``TCPIP::192.168.0.7::5025::SOCKET``, ``USB::0xF4EC::0x1102::SDG2X0001::INSTR`` (USBTMC)
and ``ASRL/dev/ttyUSB0::INSTR``. No VISA of a maker is needed: pyvisa-py speaks all of these. (Over
VXI-11 it gives an instrument that is gone 1 s more than asked to answer, and 5 s to close.)
"""

import socket
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NoReturn, cast

from drivers.errors import BenchSetupError, InstrumentError

if TYPE_CHECKING:
    from pyvisa.resources import MessageBasedResource

_IDENTIFY: Final = "*IDN?"
# So many timeouts after the last answer no other comes.
_LONG: Final = 4.0
_LIBRARY: Final = "install pyvisa and pyvisa-py (pip install pyvisa pyvisa-py)"
_REMEDIES: Final = {
    "TCPIP": "check that it is on, the network cable, its address, and that nobody else uses it",
    "USB": "check that it is on, the USB cable, the numbers in the resource's name, and that this "
    "user may use it (a udev rule)",
    "ASRL": "check that it is on, the cable, the name of the port, and the baud rate",
}


class VisaLine:
    """An open instrument that answers questions of one line with one line each.

    Answers belong to questions by their order alone, so one that comes late could be taken for
    that of a later question. Therefore, after a question without an answer, the line is drained
    before the next. Draining relies on ``*IDN?``, which all instruments of IEEE 488.2 know.

    Parameters
    ----------
    instrument : pyvisa.resources.MessageBasedResource
    device : str
        For messages: role and model.
    resource : str
        VISA's name of the instrument.
    timeout_s : float

    Attributes
    ----------
    identity : str
        What the instrument says that it is: maker, model, serial number, firmware.

    Raises
    ------
    InstrumentError
        If it does not say so twice alike.
    """

    def __init__(
        self, instrument: "MessageBasedResource", device: str, resource: str, timeout_s: float
    ) -> None:
        self._instrument = instrument
        self._device, self._resource, self._timeout_s = device, resource, timeout_s
        self._in_step = False
        # Of its identity: how often it was asked for, and has not come.
        self._owed = 0
        # A network socket and a serial line do not say where a message ends; USBTMC and VXI-11 do.
        if resource.upper().startswith("ASRL") or resource.upper().endswith("SOCKET"):
            instrument.read_termination = "\n"
        self.identity = ""
        self.identity = self._identify()

    def ask(self, text: str) -> str:
        """Ask a question, a second time if the first is not answered.

        Parameters
        ----------
        text : str
            One line, without its end. It must change nothing in the instrument.

        Returns
        -------
        str
            The answer, without its end. What it says is for the caller to judge.

        Raises
        ------
        InstrumentError
            If there is no answer, it is no ASCII, or the connection is lost.
        """
        if not self._in_step:
            self.drain()
        answer = self._answer(text)
        if answer is None:
            self.drain()
            answer = self._answer(text)
        if answer is None:
            self._raise_silent(text)
        return answer

    def send(self, text: str) -> None:
        """Send a command that has no answer; whether it was obeyed has to be asked.

        Parameters
        ----------
        text : str
            One line, without its end.

        Raises
        ------
        InstrumentError
            If it could not be sent, or perhaps not wholly; the instrument's state is unknown then.
        """
        try:
            self._instrument.write_raw(f"{text}\n".encode("ascii"))
        except Exception as error:  # noqa: BLE001  # pyvisa-py raises even bare Exception
            self._raise(text, error)

    def drain(self) -> None:
        """Throw away answers that nobody waits for, until questions and answers are in step.

        What the instrument says of itself is told from all other answers, so once it has come as
        often as it has been asked for, no earlier answer is on its way. Where it has not, and
        nothing more comes for long, some of it was lost.

        Raises
        ------
        InstrumentError
            If the instrument does not say what it is, or the connection is lost.
        """
        self._in_step = False
        self._ask_identity()
        heard = False
        deadline_s = time.monotonic() + self._timeout_s
        while self._owed and time.monotonic() < deadline_s:
            answer = self._read(_IDENTIFY)
            heard |= answer == self.identity
            if heard and answer is not None:
                deadline_s = time.monotonic() + _LONG * self._timeout_s
        if not heard:
            self._raise_silent(_IDENTIFY)
        self._in_step, self._owed = True, 0

    def _ask_identity(self) -> None:
        self.send(_IDENTIFY)
        self._owed += 1

    def close(self) -> None:
        """Hang up. May be called twice; raises nothing."""
        # A device that was unplugged raises whatever its library likes.
        with suppress(Exception):
            self._instrument.close()

    def _identify(self) -> str:
        """Return what the instrument says of itself, when it has said so twice."""
        heard: list[str] = []
        for question in range(1, 5):
            self._ask_identity()
            answer = self._read(_IDENTIFY)
            if answer in heard:
                # With an answer to each question, none is on its way.
                self._in_step = question == 2
                self._owed = question - 2
                return answer
            if answer is not None:
                heard.append(answer)
        if not heard:
            self._raise_silent(_IDENTIFY)
        raise InstrumentError(
            f"{self._device} at {self._resource}: was asked {_IDENTIFY!r} several times and "
            f"answered {' and '.join(map(repr, heard))}; {_remedy(self._resource)}"
        )

    def _answer(self, text: str) -> str | None:
        # Until the answer is here: who gives up in between (Ctrl-C) leaves it on its way.
        in_step, self._in_step = self._in_step, False
        self.send(text)
        answer = self._read(text)
        if answer is not None:
            self._in_step = in_step
        return answer

    def _read(self, text: str) -> str | None:
        """Return the next message, None if there is none in time or it is another's answer."""
        from pyvisa.constants import StatusCode
        from pyvisa.errors import VisaIOError

        message = b""
        try:
            message = self._instrument.read_raw()
        except VisaIOError as error:
            if error.error_code != StatusCode.error_timeout:
                self._raise(text, error)
        except Exception as error:  # noqa: BLE001  # pyvisa-py raises even bare Exception
            self._raise(text, error)
        answer = message.decode("ascii", errors="replace").strip()
        if answer and answer == self.identity:
            self._owed = max(self._owed - 1, 0)
        if answer == text:
            raise InstrumentError(
                f"{self._device} at {self._resource}: was asked {text!r} and said just that; turn "
                "off its echo, and look for a loop in the cable"
            )
        is_late = answer == self.identity and text != _IDENTIFY
        if not message or not message.isascii() or is_late:
            self._in_step = False
            return None
        return answer

    def _raise_silent(self, text: str) -> NoReturn:
        raise InstrumentError(
            f"{self._device} at {self._resource}: did not answer {text!r} within "
            f"{self._timeout_s:g} s; {_remedy(self._resource)}"
        )

    def _raise(self, text: str, error: Exception) -> NoReturn:
        self._in_step = False
        raise InstrumentError(
            f"{self._device} at {self._resource}: {text!r} failed ({_one_line(error)}); "
            f"{_remedy(self._resource)}"
        ) from error


def open_visa(resource: str, timeout_s: float, device: str, baud: int | None = None) -> VisaLine:
    """Open an instrument and learn what it says that it is.

    Parameters
    ----------
    resource : str
        VISA's name of the instrument. ``TCPIP::host,port::inst0::INSTR`` asks no port mapper.
    timeout_s : float
        How long an answer, or the opening, may take.
    device : str
        For messages: role and model, such as ``generator (Siglent SDG2000X)``.
    baud : int, optional
        Of a serial line; means nothing to others.

    Returns
    -------
    VisaLine

    Raises
    ------
    BenchSetupError
        If the name is none, or a library is missing; names the remedy.
    InstrumentError
        If the instrument is not there, or does not say twice the same of itself.
    """
    try:
        import pyvisa
        from pyvisa.rname import InvalidResourceName, parse_resource_name

        manager = pyvisa.ResourceManager("@py")
    except (ImportError, ValueError) as error:
        raise BenchSetupError(
            f"{device} at {resource}: cannot be opened ({_one_line(error)}); {_LIBRARY}"
        ) from error
    try:
        parse_resource_name(resource)
    except InvalidResourceName as error:
        raise BenchSetupError(
            f"{device}: {resource!r} is no VISA resource; write TCPIP::host::INSTR, "
            "TCPIP::host::port::SOCKET, USB::vendor::product::serial::INSTR or ASRL<port>::INSTR"
        ) from error
    milliseconds = round(1000 * timeout_s)
    is_serial = resource.upper().startswith("ASRL")
    line: dict[str, Any] = {"baud_rate": baud} if is_serial and baud else {}
    try:
        instrument = manager.open_resource(
            resource, open_timeout=milliseconds, timeout=milliseconds, **line
        )
    except Exception as error:
        if resource.upper().startswith("USB") and _lacks_libusb():
            raise BenchSetupError(
                f"{device} at {resource}: USB cannot be used; install libusb-1.0 (Debian: apt "
                "install libusb-1.0-0)"
            ) from error
        raise InstrumentError(
            f"{device} at {resource}: cannot be opened ({_one_line(error)}); {_remedy(resource)}"
        ) from error
    _send_at_once(instrument)
    try:
        return VisaLine(cast("MessageBasedResource", instrument), device, resource, timeout_s)
    except InstrumentError:
        with suppress(Exception):
            instrument.close()
        raise


def _send_at_once(instrument: Any) -> None:
    """Do not let a question wait until the command before it is acknowledged (40 ms and more).

    pyvisa-py knows VI_ATTR_TCPIP_NODELAY, but cannot set it.
    """
    with suppress(AttributeError, KeyError, OSError):
        session = instrument.visalib.sessions[instrument.session]
        session.interface.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _lacks_libusb() -> bool:
    from usb.backend import libusb0, libusb1, openusb  # type: ignore[import-untyped]  # no stubs

    return all(kind.get_backend() is None for kind in (libusb1, libusb0, openusb))


def _remedy(resource: str) -> str:
    kinds = (kind for kind in _REMEDIES if resource.upper().startswith(kind))
    return _REMEDIES.get(next(kinds, ""), "check that it is on and its cable")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
