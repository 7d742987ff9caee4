"""A serial port that carries lines of text."""

from contextlib import suppress
from typing import Final, NoReturn

from drivers.errors import BenchSetupError, InstrumentError

_LONGEST_LINE: Final = 256


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
        self._place = f"{device} at {port}"
        try:
            self._port = serial.serial_for_url(
                port, baudrate=baud, timeout=timeout_s, write_timeout=timeout_s, exclusive=True
            )
        # pyserial raises ValueError for a baud rate or a URL that it does not know.
        except (OSError, ValueError) as error:
            raise InstrumentError(
                f"{self._place}: the port cannot be opened ({error}); check its name, that the "
                "adapter is plugged in, that this user may use it (group dialout) and that no "
                "other program does"
            ) from error

    def write(self, text: str) -> None:
        """Send a line, to which the end is added; what had come before is thrown away.

        Raises
        ------
        InstrumentError
            If the port is gone; the line may have arrived or not.
        """
        try:
            while self._port.in_waiting:
                self._port.read(self._port.in_waiting)
            self._port.write(f"{text}\r\n".encode("ascii"))
        except OSError as error:
            self._raise_gone(text, error)

    def read(self, text: str) -> str | None:
        """Return the next line without its end, or None if none is complete in time.

        Parameters
        ----------
        text : str
            What it should answer, for the message.

        Raises
        ------
        InstrumentError
            If the port is gone.
        """
        try:
            line = self._port.read_until(b"\n", _LONGEST_LINE)
        except OSError as error:
            self._raise_gone(text, error)
        return line.decode("ascii", errors="replace").strip() if line.endswith(b"\n") else None

    def close(self) -> None:
        """Close the port. May be called twice; raises nothing."""
        with suppress(OSError):
            self._port.close()

    def _raise_gone(self, text: str, error: OSError) -> NoReturn:
        raise InstrumentError(
            f"{self._place}: the port failed at {text!r} ({error}); plug the cable or adapter in "
            "again and open the bench anew"
        ) from error
