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
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Final, Protocol

from pydantic import Field

from drivers.options import Options

_POLL_S: Final = 0.005
_MOST_BYTES: Final = 4096

_Numbers = Annotated[tuple[int, ...], Field(strict=False)]


class EmulatedDevice(Protocol):
    """The far end of a wire.

    A device may also have a method ``interrupt() -> None``: it is called when bytes arrive before
    the last answer was read, and the device throws that answer away (IEEE 488.2, 6.3.2.3). And a
    method ``unterminated() -> None``, called when an answer is asked for that is not there.
    """

    def receive(self, data: bytes) -> bytes:
        """Take in bytes as they arrive, whole lines or not, and return what is answered at once."""
        ...


def interrupt(device: object) -> bool:
    """Report to a device that bytes arrive before its last answer was read.

    Returns
    -------
    bool
        Whether the device throws the answer away.
    """
    method = getattr(device, "interrupt", None)
    return bool(method is not None and method() is not False)


def unterminated(device: object) -> None:
    """Report to a device that an answer is asked for that is not there."""
    method = getattr(device, "unterminated", None)
    if method is not None:
        method()


class WireFaults(Options):
    """Faults of a connection. Commands, which are lines, and answers to them count from 1."""

    lose_answer_at: _Numbers = ()
    """Answers that never arrive."""
    garble_answer_at: _Numbers = ()
    """Answers that arrive with a byte changed."""
    late_answer_at: _Numbers = ()
    """Answers that arrive `late_s` late."""
    late_s: Annotated[float, Field(ge=0, le=60)] = 1.0
    """Delay of late answers, in s."""
    slow_s: Annotated[float, Field(ge=0, le=60)] = 0.0
    """Delay in s of every answer from `slow_from` on. The device itself obeys at once."""
    slow_from: Annotated[int, Field(ge=1)] = 1
    """First answer that is slow."""
    lose_command_at: _Numbers = ()
    """Commands that never reach the device."""
    echo: bool = False
    """The device repeats each command before it answers."""
    wrong_baud: bool = False
    """Neither end understands the other."""
    unplug_at: int | None = None
    """Answer at which the cable is unplugged."""
    replug_after_s: Annotated[float, Field(ge=0, le=60)] | None = None
    """Time in s after which the cable is plugged in again for good. Without this key, never."""


class UnpluggedError(Exception):
    """The cable is unplugged."""


class FaultyWire:
    """A device behind a wire that spoils what it carries.

    Parameters
    ----------
    device : EmulatedDevice
    faults : WireFaults
    """

    def __init__(self, device: EmulatedDevice, faults: WireFaults) -> None:
        self._device, self._faults = device, faults
        self._commands = self._answers = 0
        self._rest = b""

    def receive(self, data: bytes) -> bytes:
        """Pass on whole commands and return the answers, or what is left of them, when due.

        Raises
        ------
        UnpluggedError
        """
        answered = b""
        for late_s, answer in self.carry(data):
            time.sleep(late_s)
            answered += answer
        return answered

    def carry(self, data: bytes) -> list[tuple[float, bytes]]:
        """Pass on whole commands; return each answer, and how many seconds later it arrives.

        Raises
        ------
        UnpluggedError
        """
        if self._faults.wrong_baud:
            # No end of a line is seen as one.
            return [(0.0, _at_another_baud(self._device.receive(_at_another_baud(data))))]
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [self._carried(line + b"\n") for line in lines]

    def interrupt(self) -> bool:
        """Report bytes that arrive before the last answer was read; see `interrupt`."""
        return interrupt(self._device)

    def unterminated(self) -> None:
        """Report that an answer is asked for that is not there; see `unterminated`."""
        unterminated(self._device)

    def _carried(self, command: bytes) -> tuple[float, bytes]:
        faults, late_s = self._faults, 0.0
        self._commands += 1
        if self._commands in faults.lose_command_at:
            return 0.0, b""
        answer = self._device.receive(command)
        if answer:
            self._answers += 1
            answer, late_s = self._spoilt(answer), self._late_s()
        return late_s, command + answer if faults.echo else answer

    def _late_s(self) -> float:
        faults, number = self._faults, self._answers
        late_s = faults.late_s if number in faults.late_answer_at else 0.0
        return late_s + (faults.slow_s if number >= faults.slow_from else 0.0)

    def _spoilt(self, answer: bytes) -> bytes:
        faults = self._faults
        if self._answers == faults.unplug_at:
            raise UnpluggedError
        if self._answers in faults.lose_answer_at:
            return b""
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
    """A thread that carries bytes between a device and a caller at the other end of a wire.

    Answers keep their order. A late one does not keep the device from obeying what comes next.
    """

    def __init__(self, device: EmulatedDevice, faults: WireFaults | None) -> None:
        self._device = device
        self.spoil(faults or WireFaults())
        self._closing = threading.Event()
        self._pulled = False
        # Answers on their way, and when they arrive.
        self._under_way: deque[tuple[float, bytes]] = deque()
        self._thread = threading.Thread(target=self._serve, name=type(self).__name__, daemon=True)

    def spoil(self, faults: WireFaults) -> None:
        """Let other things go wrong; commands and answers count from now on."""
        self._faults = faults
        self._wire = FaultyWire(self._device, faults)

    def close(self) -> None:
        """Hang up. May be called twice."""
        self._closing.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()

    def _serve(self) -> None:
        raise NotImplementedError

    def _talk(self, handle: int, write: Callable[[bytes], object]) -> None:
        """Carry bytes at a file handle until the caller hangs up or the wire is pulled."""
        self._under_way.clear()
        while not self._closing.is_set():
            wait_s = _POLL_S
            if self._under_way:
                wait_s = min(max(self._under_way[0][0] - time.monotonic(), 0.0), _POLL_S)
            arrived = bool(select.select([handle], [], [], wait_s)[0])
            try:
                if arrived and not self._take(handle):
                    return
                self._deliver(write)
            except UnpluggedError:
                self._pulled = True
                return
            except OSError:
                return

    def _take(self, handle: int) -> bool:
        """Pass on what has arrived; return whether the caller is still there."""
        data = os.read(handle, _MOST_BYTES)
        if not data:
            return False
        if self._under_way and self._wire.interrupt():
            self._under_way.clear()
        for late_s, answer in self._wire.carry(data):
            due_s = time.monotonic() + late_s
            if self._under_way:
                due_s = max(due_s, self._under_way[-1][0])
            if answer:
                self._under_way.append((due_s, answer))
        return True

    def _deliver(self, write: Callable[[bytes], object]) -> None:
        while self._under_way and self._under_way[0][0] <= time.monotonic():
            write(self._under_way.popleft()[1])

    def _is_plugged_in_again(self) -> bool:
        """Wait until a pulled wire is plugged in again; return whether it ever is."""
        after_s = self._faults.replug_after_s
        self._pulled = False
        return after_s is not None and not self._closing.wait(after_s)


class PtyServer(_Server):
    """A device on a pseudo-terminal, which is a serial port for all that open it.

    Baud rates mean nothing here; `WireFaults.wrong_baud` stands for a wrong one.
    """

    def __init__(self, device: EmulatedDevice, faults: WireFaults | None = None) -> None:
        super().__init__(device, faults)
        self._plug_in()
        self._thread.start()

    @property
    def port(self) -> str:
        """Path of the port, another after the wire was pulled and plugged in again."""
        return self._port

    def _plug_in(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self._port = os.ttyname(self._slave)

    def _serve(self) -> None:
        while True:
            try:
                self._talk(self._master, lambda answer: os.write(self._master, answer))
            finally:
                os.close(self._master)
            is_plugged_in_again = self._pulled and self._is_plugged_in_again()
            if not is_plugged_in_again:
                # The system gives the name of a port to the next program once both ends are closed.
                self._closing.wait()
            os.close(self._slave)
            if not is_plugged_in_again:
                return
            self._plug_in()


class SocketServer(_Server):
    """A device on a socket of this computer, one caller at a time.

    Attributes
    ----------
    port : int
        On 127.0.0.1.
    """

    def __init__(self, device: EmulatedDevice, faults: WireFaults | None = None) -> None:
        super().__init__(device, faults)
        self._listener = _listener(0)
        self.port: int = self._listener.getsockname()[1]
        self._thread.start()

    def _serve(self) -> None:
        while True:
            with self._listener:
                self._accept_callers()
            if not (self._pulled and self._is_plugged_in_again()):
                return
            self._listener = _listener(self.port)

    def _accept_callers(self) -> None:
        while not (self._closing.is_set() or self._pulled):
            with suppress(TimeoutError):
                caller, _ = self._listener.accept()
                with caller:
                    caller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self._talk(caller.fileno(), caller.sendall)


def _listener(port: int) -> socket.socket:
    listener = socket.create_server(("127.0.0.1", port))
    listener.settimeout(_POLL_S)
    return listener
