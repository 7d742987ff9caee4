"""What people ask of a run while it goes on: to stop, to pause, to go on.

Orders come as signals or from other threads. While `signals_obeyed` is in force, no signal that can
be caught ends the process: it is an order to stop, and whoever uses the bench switches it off.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

# Signals by which the operating system ends or suspends a process, but for these (signal(7)):
# those that cannot be caught,
_UNCATCHABLE: Final = ("SIGKILL", "SIGSTOP")
# those that report a fault of the program itself, which a handler would only repeat,
_FAULTS: Final = ("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS")
# those that end nothing,
_HARMLESS: Final = ("SIGCHLD", "SIGCLD", "SIGURG", "SIGWINCH", "SIGCONT", "SIGINFO", "SIGTTIN")
# and those that Python itself turns into errors of the write that caused them.
_ERRORS: Final = ("SIGPIPE", "SIGXFSZ")
_PAUSE: Final = ("SIGUSR1", "SIGTSTP")
_CONTINUE: Final = ("SIGUSR2",)
# A background process that writes to its terminal would be suspended with its outputs on.
_IGNORED: Final = ("SIGTTOU",)
# Background processes of a shell are started with some signals ignored, and this program ignores
# orders that come too late. These are obeyed all the same; others were ignored on purpose, as
# SIGHUP is by nohup.
_ALWAYS: Final = ("SIGINT", "SIGQUIT", "SIGTERM", "SIGUSR1", "SIGUSR2")

# Who goes on after a pause does not notice a tenth of a second.
_POLL_S: Final = 0.1

Handler = Callable[[int, FrameType | None], Any] | int | None


class Orders:
    """Stop, pause and continue; may be given from any thread."""

    def __init__(self) -> None:
        self._stop, self._pause = threading.Event(), threading.Event()
        # How many orders to stop it takes until `interrupt` raises; 0: it never does.
        self._patience = 0

    @property
    def stopped(self) -> bool:
        """Whether the run is to end."""
        return self._stop.is_set()

    @property
    def paused(self) -> bool:
        """Whether the run is to pause, and not to end."""
        return self._pause.is_set() and not self.stopped

    def stop(self) -> None:
        """End the run at the next step boundary."""
        self._stop.set()

    def pause(self) -> None:
        """Switch all off at the next step boundary, and wait."""
        self._pause.set()

    def proceed(self) -> None:
        """Go on after a pause."""
        self._pause.clear()

    def wait(self) -> None:
        """Wait as long as the run is to pause."""
        while self.paused:
            time.sleep(_POLL_S)

    def interrupt(self) -> None:
        """Do what Ctrl-C asks for: the first time `stop`, then give up what is being done.

        To be called on the thread that executes the run.

        Raises
        ------
        KeyboardInterrupt
            Inside `given_up_at`, when its number of orders has come.
        """
        repeated = self._stop.is_set()
        self._stop.set()
        if self._patience == 1 or (self._patience == 2 and repeated):
            self._patience = 0
            raise KeyboardInterrupt

    @contextmanager
    def given_up_at(self, order: int) -> Iterator[None]:
        """Let the first or second order to stop raise KeyboardInterrupt, once.

        Parameters
        ----------
        order : {1, 2}
            With 1, an order that came before counts.
        """
        before = self._patience
        try:
            self._patience = order
            if order == 1 and self.stopped:
                raise KeyboardInterrupt
            yield
        finally:
            # Who has given up once is not interrupted again while clearing up.
            self._patience = before if self._patience else 0


@contextmanager
def signals_obeyed(orders: Orders) -> Iterator[None]:
    """Turn signals into orders, if this is the main thread; other threads get no signals.

    Signals that end a process stop the run. SIGUSR1 and Ctrl-Z (SIGTSTP) pause it, SIGUSR2 goes on
    with it. Other handlers that the program has set stay in force.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    actions = _actions(orders)

    def act(number: int, _frame: FrameType | None) -> None:
        actions[number]()

    before: dict[int, Handler] = {}
    try:
        for number in actions:
            if _may_be_taken(number):
                before[number] = signal.signal(number, act)
        for number in _numbers(_IGNORED):
            before[number] = signal.signal(number, signal.SIG_IGN)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _actions(orders: Orders) -> dict[int, Callable[[], None]]:
    """What to do at each signal that this system knows."""
    left_alone = _numbers(
        (*_UNCATCHABLE, *_FAULTS, *_HARMLESS, *_ERRORS, *_PAUSE, *_CONTINUE, *_IGNORED)
    )
    actions = {
        int(number): orders.interrupt
        for number in signal.valid_signals()
        if number not in left_alone
    }
    actions |= dict.fromkeys(_numbers(_PAUSE), orders.pause)
    return actions | dict.fromkeys(_numbers(_CONTINUE), orders.proceed)


def _may_be_taken(number: int) -> bool:
    """Whether a signal would end the process, or must stop a run whoever handles it."""
    if number in _numbers(_ALWAYS):
        return True
    return signal.getsignal(number) is signal.SIG_DFL


def _numbers(names: tuple[str, ...]) -> set[int]:
    return {int(getattr(signal, name)) for name in names if hasattr(signal, name)}
