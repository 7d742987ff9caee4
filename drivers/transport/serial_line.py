"""A serial port that carries lines of text."""

import time
from contextlib import suppress
from typing import Final, NoReturn
from urllib.parse import urlsplit

from drivers.errors import BenchSetupError, InstrumentError
from drivers.transport.hosts import is_refused, require_known_host

# Longer than any answer of an instrument here; more without an end of line is noise.
_LONGEST_LINE: Final = 256
# Chosen: how long one look at the port may take. A line may come so much later than its timeout.
_LOOK_S: Final = 0.02


class SerialLine:
    """An open serial port, of this program alone.

    Parameters
    ----------
    port : str
        Such as ``/dev/ttyUSB0`` or ``COM3``; or one of pyserial's, such as ``socket://host:port``
        for a serial line behind a terminal server.
    baud : int
        With 8 bits, no parity, one stop bit and no flow control.
    timeout_s : float
        How long a line may take to come.
    device : str
        For messages: role and model.

    Raises
    ------
    BenchSetupError
        If pyserial is missing.
    InstrumentError
        If the port cannot be opened.
    """

    def __init__(self, port: str, baud: int, timeout_s: float, device: str) -> None:
        try:
            import serial
        except ImportError as error:
            raise BenchSetupError(
                f"{device} at {port}: pyserial is missing; install it (pip install pyserial)"
            ) from error
        self._place, self._timeout_s, self._rest = f"{device} at {port}", timeout_s, b""
        host = _host_of(port)
        if host is not None:
            require_known_host(host, self._place, "options.port")
        try:
            self._port = serial.serial_for_url(
                port,
                baudrate=baud,
                timeout=min(timeout_s, _LOOK_S),
                write_timeout=timeout_s,
                exclusive=True,
            )
        # pyserial raises ValueError for a baud rate or a URL that it does not know.
        except (OSError, ValueError) as error:
            raise self._not_opened(error) from error

    def write(self, text: str, discard: bool = True) -> None:
        """Send a line, to which the end is added.

        Parameters
        ----------
        text : str
        discard : bool
            Whether to throw away what has come before.

        Raises
        ------
        InstrumentError
            If the port is gone; the line may have arrived or not.
        """
        try:
            if discard:
                self._rest = b""
                while self._port.in_waiting:
                    self._port.read(self._port.in_waiting)
            self._port.write(f"{text}\r\n".encode("ascii"))
        except OSError as error:
            self._raise_gone(text, error)

    def read(self, text: str, patience_s: float | None = None) -> str | None:
        """Return the next line without its end, or None if none is complete in time.

        A line that lies in the computer's buffer when the time is up has come in time: this
        process may have been stopped, or starved by others, for longer than the timeout.

        Parameters
        ----------
        text : str
            What it should answer, for the message.
        patience_s : float, optional
            How long to wait; the timeout of the line if not given.

        Raises
        ------
        InstrumentError
            If the port is gone.
        """
        wait_s = self._timeout_s if patience_s is None else patience_s
        deadline_s = time.monotonic() + wait_s
        while b"\n" not in self._rest:
            is_over = time.monotonic() >= deadline_s
            try:
                waiting = self._port.in_waiting
                if is_over and not waiting:
                    return None
                self._rest += self._port.read(max(1, waiting))
            except OSError as error:
                self._raise_gone(text, error)
            if len(self._rest) > _LONGEST_LINE and b"\n" not in self._rest:
                self._rest = b""
                return None
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode("ascii", errors="replace").strip()

    def close(self) -> None:
        """Close the port. May be called twice; raises nothing."""
        with suppress(OSError):
            self._port.close()

    def _not_opened(self, error: Exception) -> InstrumentError:
        if is_refused(error):
            return InstrumentError(
                f"{self._place}: the host refuses the connection; check the number of the port in "
                "options.port, that the terminal server is set up, and that no other program uses "
                "it"
            )
        return InstrumentError(
            f"{self._place}: the port cannot be opened ({error}); check its name, that the "
            "adapter is plugged in, that this user may use it (group dialout) and that no "
            "other program does"
        )

    def _raise_gone(self, text: str, error: OSError) -> NoReturn:
        raise InstrumentError(
            f"{self._place}: the port failed at {text!r} ({error}); plug the cable or adapter in "
            "again and open the bench again"
        ) from error


def _host_of(port: str) -> str | None:
    """Return the host of a port on a network, such as ``socket://host:4001``."""
    return urlsplit(port).hostname if port.startswith(("socket://", "rfc2217://")) else None
