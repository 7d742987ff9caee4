"""Instruments that are spoken to in lines of text over USB, LAN or a serial line, through VISA.

`open_visa` takes the names of resources that VISA knows, such as ``TCPIP::192.168.0.7::INSTR``
(VXI-11), ``TCPIP::192.168.0.7::5025::SOCKET``, ``USB::0xF4EC::0x1102::SDG2X0001::INSTR`` (USBTMC)
and ``ASRL/dev/ttyUSB0::INSTR``. No VISA of a maker is needed: pyvisa-py speaks all of these. (Over
VXI-11 it gives an instrument that is gone 1 s more than asked to answer.)
"""

import math
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final, NoReturn, cast

from drivers.errors import BenchSetupError, InstrumentError
from drivers.transport.hosts import is_refused, require_known_host

if TYPE_CHECKING:
    from pyvisa.resources import MessageBasedResource

_IDENTIFY: Final = "*IDN?"
# Chosen: this many timeouts after the last answer, no other comes.
_LONG: Final = 4.0
# The shortest wait that pyvisa-py knows: over USB, 0 means to wait for ever.
_AT_ONCE_S: Final = 0.001
# More than any answer has here; an answer may come in pieces.
_MOST_BYTES: Final = 4096
_LIBRARY: Final = "install pyvisa and pyvisa-py (pip install pyvisa pyvisa-py)"
_SLOW: Final = "if the instrument, the network or this computer is slow, raise options.timeout_s"
_REFUSED: Final = (
    "the host refuses the connection: check the address and the port, that the instrument's LAN "
    "interface is on, and that no other program is connected to it"
)
_REMEDIES: Final = {
    "TCPIP": "check power, network cable and address, and that no other program uses it",
    "USB": "check that it is on, the USB cable, the numbers in the resource's name, and that this "
    "user may use it (a udev rule)",
    "ASRL": "check that it is on, the cable, the name of the port, and the baud rate",
}


class LateError(InstrumentError):
    """An answer did not come while `VisaLine.within` allowed to wait; it may still come."""


class VisaLine:
    """An open instrument that answers questions of one line with one line each.

    Answers belong to questions by their order alone, so one that comes late could be taken for
    that of a later question. Therefore, after a question without an answer, the line is drained
    before the next. Draining relies on ``*IDN?``, which all instruments of IEEE 488.2 know. Several
    threads may ask and send: a question waits for the answer to that of another one.

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
        What the instrument says that it is: maker, model, serial number, firmware. Empty until
        `identify`.
    may_have_interrupted : bool
        Whether anything was sent before the last answer was read, or an answer was read that was
        not there. IEEE 488.2 calls the first a query error, INTERRUPTED, and the second
        UNTERMINATED; an instrument with an error queue then reports -410 or -420, and may throw
        the answer away. Whoever has read these errors sets this to False.
    """

    def __init__(
        self, instrument: "MessageBasedResource", device: str, resource: str, timeout_s: float
    ) -> None:
        self._instrument: Any = instrument
        self._device, self._resource, self._timeout_s = device, resource, timeout_s
        self._in_step = False
        # A generator and the camera that it triggers are switched off on threads of their own.
        self._asking = threading.RLock()
        # Of its identity: how often it was asked for, and has not come.
        self._owed = 0
        self._until_s = math.inf
        self._is_lost = self._is_asked = False
        self.may_have_interrupted = False
        # A network socket and a serial line do not say where a message ends; USBTMC and VXI-11 do.
        self._is_stream = _is_serial(resource) or resource.upper().endswith("SOCKET")
        self._received = b""
        if self._is_stream:
            self._instrument.read_termination = "\n"
        self.identity = ""

    def identify(self) -> None:
        """Ask the instrument what it is, until it has given the same answer twice.

        Raises
        ------
        InstrumentError
            If it does not give the same identity twice.
        """
        heard: list[str] = []
        for question in range(1, 5):
            self._ask_identity()
            answer = self._read(_IDENTIFY)
            if answer in heard:
                # With an answer to each question, none is on its way.
                self._in_step = question == 2
                self._owed = question - 2
                self.identity = answer
                return
            if answer is not None:
                heard.append(answer)
        if not heard:
            self._raise_silent(_IDENTIFY)
        raise InstrumentError(
            f"{self._device} at {self._resource}: was asked {_IDENTIFY!r} several times and "
            f"answered {' and '.join(map(repr, heard))}; {_remedy(self._resource)}"
        )

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
        LateError
            If there is no answer within the time that `within` allows.
        InstrumentError
            If there is no answer, it is no ASCII, or the connection is lost.
        """
        with self._asking:
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

        It is sent at once, also if answers to earlier questions are missing.

        Parameters
        ----------
        text : str
            One line, without its end.

        Raises
        ------
        InstrumentError
            If it could not be sent, or perhaps not wholly; the instrument's state is unknown then.
        """
        self.may_have_interrupted |= self._is_asked
        try:
            self._wait_at_most(self._patience_s())
            self._instrument.write_raw(f"{text}\n".encode("ascii"))
        except Exception as error:  # noqa: BLE001  # pyvisa-py raises even bare Exception
            self._raise(text, error)

    @contextmanager
    def within(self, seconds: float) -> Iterator[None]:
        """Wait for answers no longer than this in all, whatever the timeout is.

        Parameters
        ----------
        seconds : float

        Raises
        ------
        LateError
            From what is asked inside, when the time is over.
        """
        before_s = self._until_s
        self._until_s = min(before_s, time.monotonic() + seconds)
        try:
            yield
        finally:
            self._until_s = before_s

    def drain(self) -> None:
        """Throw away answers that are not waited for, until questions and answers are in step.

        Its identity differs from all other answers, so once it has come as
        often as it has been asked for, no earlier answer is on its way. Where it has not, and
        nothing more comes for long, some of it was lost. USBTMC and VXI-11 carry one answer at a
        time: there, no answer to an earlier question follows the last.

        Raises
        ------
        LateError
            If `within` does not allow to wait long enough.
        InstrumentError
            If the instrument does not say what it is, or the connection is lost.
        """
        with self._asking:
            self._in_step = False
            if self._patience_s() <= _AT_ONCE_S:
                self._raise_silent(_IDENTIFY)
            if not self._is_stream:
                self._owed = 0
            self._ask_identity()
            heard = False
            deadline_s = time.monotonic() + self._timeout_s
            while True:
                answer = self._read(_IDENTIFY)
                heard |= answer == self.identity
                now_s = time.monotonic()
                if not self._owed:
                    break
                if now_s >= self._until_s:
                    self._raise_silent(_IDENTIFY)
                if heard and answer is not None:
                    deadline_s = now_s + _LONG * self._timeout_s
                if now_s >= deadline_s:
                    break
            if not heard:
                self._raise_silent(_IDENTIFY)
            self._in_step, self._owed = True, 0

    def close(self) -> None:
        """Hang up. May be called twice; raises nothing."""
        # A device that was unplugged raises whatever its library likes.
        with suppress(Exception):
            if self._is_lost and not self._is_stream:
                # Over VXI-11, pyvisa-py would wait 5 s for its goodbye.
                self._session.interface.sock.shutdown(socket.SHUT_RDWR)
        with suppress(Exception):
            self._instrument.close()

    @property
    def is_in_step(self) -> bool:
        """Whether no answer to an earlier question is on its way."""
        return self._in_step

    @property
    def _session(self) -> Any:
        return self._instrument.visalib.sessions[self._instrument.session]

    def _ask_identity(self) -> None:
        self.send(_IDENTIFY)
        self._is_asked = True
        self._owed += 1

    def _answer(self, text: str) -> str | None:
        # Until the answer is here: who gives up in between (Ctrl-C) leaves it on its way.
        in_step, self._in_step = self._in_step, False
        self.send(text)
        self._is_asked = True
        answer = self._read(text)
        if answer is not None:
            self._in_step = in_step
        return answer

    def _read(self, text: str) -> str | None:
        """Return the next message, None if there is none in time or it is another's answer."""
        try:
            message = self._line() if self._is_stream else self._message()
        except Exception as error:  # noqa: BLE001  # pyvisa-py raises even bare Exception
            self._raise(text, error)
        if message:
            self._is_asked = self._is_lost = False
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

    def _line(self) -> bytes:
        """Return the next line of a stream, empty if none is complete in time.

        What lies in the computer's buffer when the time is up has come in time: this process may
        have been stopped, or starved by others, for longer than the timeout.
        """
        from pyvisa.constants import StatusCode
        from pyvisa.errors import VisaIOError

        for patience_s in (self._patience_s(), _AT_ONCE_S):
            self._wait_at_most(patience_s)
            # Not by `read_raw`, which would throw away the first half of a line.
            data, status = self._session.read(_MOST_BYTES)
            self._received += data
            if status < 0 and status != StatusCode.error_timeout:
                raise VisaIOError(status)
            if b"\n" in self._received:
                line, _, self._received = self._received.partition(b"\n")
                return line + b"\n"
        return b""

    def _message(self) -> bytes:
        """Return the next message, empty if there is none in time."""
        from pyvisa.constants import StatusCode
        from pyvisa.errors import VisaIOError

        self._wait_at_most(self._patience_s())
        try:
            return bytes(self._instrument.read_raw())
        except VisaIOError as error:
            if error.error_code != StatusCode.error_timeout:
                raise
        # An instrument that was asked to talk, and had nothing to say.
        self.may_have_interrupted = True
        return b""

    def _patience_s(self) -> float:
        left_s = self._until_s - time.monotonic()
        return max(min(self._timeout_s, left_s), _AT_ONCE_S)

    def _wait_at_most(self, seconds: float) -> None:
        self._instrument.timeout = max(round(1000 * seconds), 1)

    def _raise_silent(self, text: str) -> NoReturn:
        self._is_lost = True
        place = f"{self._device} at {self._resource}"
        if time.monotonic() >= self._until_s:
            raise LateError(f"{place}: did not answer {text!r} yet; {_SLOW}")
        raise InstrumentError(
            f"{place}: did not answer {text!r} within {self._timeout_s:g} s; "
            f"{_remedy(self._resource)}; {_SLOW}"
        )

    def _raise(self, text: str, error: Exception) -> NoReturn:
        self._in_step, self._is_lost = False, True
        remedy = _REFUSED if is_refused(error) else _remedy(self._resource)
        raise InstrumentError(
            f"{self._device} at {self._resource}: {text!r} failed ({_one_line(error)}); {remedy}"
        ) from error


def open_visa(
    resource: str,
    timeout_s: float,
    device: str,
    baud: int | None = None,
    make_safe: Sequence[str] = (),
) -> VisaLine:
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
    make_safe : sequence of str, optional
        Commands that switch its outputs off. They are sent to an instrument that can be reached
        and does not say what it is, before the connection is given up.

    Returns
    -------
    VisaLine

    Raises
    ------
    BenchSetupError
        If the name is none, or a library is missing; names the remedy.
    InstrumentError
        If the instrument is not there, its host is unknown or refuses the connection, or it does
        not say twice the same of itself.
    """
    instrument = _open_resource(resource, timeout_s, f"{device} at {resource}", baud)
    _send_at_once(instrument)
    line = VisaLine(cast("MessageBasedResource", instrument), device, resource, timeout_s)
    try:
        line.identify()
    except BaseException:
        for command in make_safe:
            with suppress(InstrumentError):
                line.send(command)
        line.close()
        raise
    return line


def _open_resource(resource: str, timeout_s: float, place: str, baud: int | None) -> Any:
    """Open a resource with pyvisa-py; `place` names the instrument in messages."""
    try:
        import pyvisa

        manager = pyvisa.ResourceManager("@py")
    except (ImportError, ValueError) as error:
        raise BenchSetupError(
            f"{place}: cannot be opened ({_one_line(error)}); {_LIBRARY}"
        ) from error
    _require_name(resource, place)
    milliseconds = round(1000 * timeout_s)
    settings: dict[str, Any] = {"baud_rate": baud} if _is_serial(resource) and baud else {}
    try:
        return manager.open_resource(
            resource, open_timeout=milliseconds, timeout=milliseconds, **settings
        )
    except Exception as error:
        if resource.upper().startswith("USB") and _lacks_libusb():
            raise BenchSetupError(
                f"{place}: USB cannot be used; install libusb-1.0 (Debian: apt install "
                "libusb-1.0-0)"
            ) from error
        remedy = _REFUSED if is_refused(error) else _remedy(resource)
        raise InstrumentError(
            f"{place}: cannot be opened ({_one_line(error)}); {remedy}"
        ) from error


def _require_name(resource: str, place: str) -> None:
    """Refuse a text that is no VISA resource, or names an unknown host."""
    from pyvisa.rname import InvalidResourceName, parse_resource_name

    try:
        parsed: Any = parse_resource_name(resource)
    except InvalidResourceName as error:
        raise BenchSetupError(
            f"{place}: {resource!r} is no VISA resource; write TCPIP::host::INSTR, "
            "TCPIP::host::port::SOCKET, USB::vendor::product::serial::INSTR or ASRL<port>::INSTR"
        ) from error
    if hasattr(parsed, "host_address"):
        # VXI-11 writes host,port where no port mapper is to be asked.
        host = parsed.host_address.partition(",")[0]
        require_known_host(host, place, "its resource of the bench file")


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


def _is_serial(resource: str) -> bool:
    return resource.upper().startswith("ASRL")


def _remedy(resource: str) -> str:
    kinds = (kind for kind in _REMEDIES if resource.upper().startswith(kind))
    return _REMEDIES.get(next(kinds, ""), "check that it is on and its cable")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
