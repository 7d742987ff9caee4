"""Puts a simulated instrument at the far end of a serial line or of a network socket.

A device is a function of the bytes that reach it; these servers carry the bytes, on a thread of
their own, and spoil some of them where faults are asked for.
"""

import os
import select
import socket
import threading
import time
import tty
from collections.abc import Callable
from typing import Annotated, Final, Protocol

from pydantic import Field

from drivers.options import Options

_POLL_S: Final = 0.005
_MOST_BYTES: Final = 4096

_Numbers = Annotated[tuple[int, ...], Field(strict=False)]


class WireDevice(Protocol):
    """The far end of a wire."""

    def receive(self, data: bytes) -> bytes:
        """Take in bytes as they arrive, whole lines or not, and return what is answered at once."""
        ...


class WireFaults(Options):
    """What goes wrong on a wire. Commands, which are lines, and answers to them count from 1.

    Attributes
    ----------
    lose_answer_at, garble_answer_at, late_answer_at : tuple of int
        Answers that never arrive, arrive with a byte changed, or arrive `late_s` late.
    late_s : float
    lose_command_at : tuple of int
        Commands that never reach the device.
    echo : bool
        The device says back what it hears, before it answers.
    wrong_baud : bool
        Neither end understands the other.
    unplug_at : int or None
        The wire is pulled when this answer is due.
    """

    lose_answer_at: _Numbers = ()
    garble_answer_at: _Numbers = ()
    late_answer_at: _Numbers = ()
    late_s: Annotated[float, Field(ge=0, le=60)] = 1.0
    lose_command_at: _Numbers = ()
    echo: bool = False
    wrong_baud: bool = False
    unplug_at: int | None = None


class UnpluggedError(Exception):
    """The wire was pulled."""


class FaultyWire:
    """A device behind a wire that spoils what it carries.

    Parameters
    ----------
    device : WireDevice
    faults : WireFaults
    """

    def __init__(self, device: WireDevice, faults: WireFaults) -> None:
        self._device, self._faults = device, faults
        self._commands = self._answers = 0
        self._rest = b""

    def receive(self, data: bytes) -> bytes:
        """Pass on whole commands and return the answers, or what is left of them.

        Raises
        ------
        UnpluggedError
        """
        if self._faults.wrong_baud:
            # No end of a line is seen as one.
            return _at_another_baud(self._device.receive(_at_another_baud(data)))
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(self._carried(line + b"\n") for line in lines)

    def _carried(self, command: bytes) -> bytes:
        faults = self._faults
        self._commands += 1
        if self._commands in faults.lose_command_at:
            return b""
        answer = self._device.receive(command)
        if answer:
            self._answers += 1
            answer = self._spoilt(answer)
        return command + answer if faults.echo else answer

    def _spoilt(self, answer: bytes) -> bytes:
        faults = self._faults
        if self._answers == faults.unplug_at:
            raise UnpluggedError
        if self._answers in faults.lose_answer_at:
            return b""
        if self._answers in faults.late_answer_at:
            time.sleep(faults.late_s)
        if self._answers in faults.garble_answer_at:
            middle = len(answer) // 2
            answer = answer[:middle] + bytes([answer[middle] ^ 0x15]) + answer[middle + 1 :]
        return answer


def _at_another_baud(data: bytes) -> bytes:
    """Bytes as a receiver of twice the baud rate sees them: every bit twice, in two bytes."""
    doubled = bytearray()
    for byte in data:
        bits = "".join(2 * bit for bit in f"{byte:08b}")
        doubled += int(bits, 2).to_bytes(2, "big")
    return bytes(doubled)


class _Server:
    """A thread that carries bytes between a device and somebody at the other end of a wire."""

    def __init__(self, device: WireDevice, faults: WireFaults | None) -> None:
        self._wire = FaultyWire(device, faults or WireFaults())
        self._closing = threading.Event()
        self._pulled = False
        self._thread = threading.Thread(target=self._serve, name=type(self).__name__, daemon=True)

    def close(self) -> None:
        """Hang up. May be called twice."""
        self._closing.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()

    def _serve(self) -> None:
        raise NotImplementedError

    def _carry(self, handle: int, write: Callable[[bytes], object]) -> bool:
        """Answer what has arrived at a file handle; return whether the wire still holds."""
        try:
            data = os.read(handle, _MOST_BYTES)
            if not data:
                return False
            answer = self._wire.receive(data)
            if answer:
                write(answer)
        except UnpluggedError:
            self._pulled = True
            return False
        except OSError:
            return False
        return True


class PtyServer(_Server):
    """A device on a pseudo-terminal, which is a serial port for all that open it.

    Baud rates mean nothing here; `WireFaults.wrong_baud` stands for a wrong one.

    Attributes
    ----------
    port : str
        Path of the port.
    """

    def __init__(self, device: WireDevice, faults: WireFaults | None = None) -> None:
        super().__init__(device, faults)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._thread.start()

    def _serve(self) -> None:
        try:
            while not self._closing.is_set():
                if not select.select([self._master], [], [], _POLL_S)[0]:
                    continue
                if not self._carry(self._master, lambda answer: os.write(self._master, answer)):
                    return
        finally:
            os.close(self._master)
            os.close(self._slave)


class SocketServer(_Server):
    """A device on a socket of this computer, one caller at a time.

    Attributes
    ----------
    port : int
        On 127.0.0.1.
    """

    def __init__(self, device: WireDevice, faults: WireFaults | None = None) -> None:
        super().__init__(device, faults)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(_POLL_S)
        self.port: int = self._listener.getsockname()[1]
        self._thread.start()

    def _serve(self) -> None:
        with self._listener:
            while not self._closing.is_set():
                try:
                    caller, _ = self._listener.accept()
                except TimeoutError:
                    continue
                with caller:
                    if not self._talk(caller):
                        return

    def _talk(self, caller: socket.socket) -> bool:
        """Serve a caller until it hangs up; return whether the wire still holds."""
        caller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while not self._closing.is_set():
            if not select.select([caller], [], [], _POLL_S)[0]:
                continue
            if not self._carry(caller.fileno(), caller.sendall):
                return not self._pulled
        return True
