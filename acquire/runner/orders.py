"""Orders to a run while it is measured: stop, pause, continue.

Orders come as signals or from other threads. Inside `signals_obeyed`, a signal that can be caught
does not end the process: it is an order to stop, and the code that uses the bench switches it off.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

# Every signal that ends or suspends a process (signal(7)) is an order, with these exceptions:
# signals that cannot be caught,
_UNCATCHABLE: Final = ("SIGKILL", "SIGSTOP")
# signals that report a fault of the program itself: a handler would return to the fault,
_FAULTS: Final = ("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS")
# signals that do not end a process,
_HARMLESS: Final = ("SIGCHLD", "SIGCLD", "SIGURG", "SIGWINCH", "SIGCONT", "SIGINFO", "SIGTTIN")
# and signals that Python converts to an error of the write that caused them.
_ERRORS: Final = ("SIGPIPE", "SIGXFSZ")
_PAUSE: Final = ("SIGUSR1", "SIGTSTP")
_CONTINUE: Final = ("SIGUSR2",)
# Without this, the system would suspend a background process that writes to its terminal, and its
# outputs would stay on.
_IGNORED: Final = ("SIGTTOU",)
# Signals that are obeyed even if they were ignored before: a shell starts background processes with
# some of them ignored, and this program itself ignores late orders. Other ignored signals were
# ignored on purpose, such as SIGHUP by nohup, and stay ignored.
_ALWAYS: Final = ("SIGINT", "SIGQUIT", "SIGTERM", "SIGUSR1", "SIGUSR2")

# Chosen: an operator who continues a run does not notice a delay of a tenth of a second.
_POLL_S: Final = 0.1

Handler = Callable[[int, FrameType | None], Any] | int | None


class Orders:
    """Orders to stop, pause and continue a run; every thread may give them."""

    def __init__(self) -> None:
        self._stop, self._pause = threading.Event(), threading.Event()
        # Number of the order to stop at which `interrupt` raises; 0 if it never raises.
        self._raises_at = 0

    @property
    def stopped(self) -> bool:
        """Return whether the run was ordered to stop."""
        return self._stop.is_set()

    @property
    def paused(self) -> bool:
        """Return whether the run was ordered to pause, and not to stop."""
        return self._pause.is_set() and not self.stopped

    def stop(self) -> None:
        """Order the run to stop after the present step."""
        self._stop.set()

    def pause(self) -> None:
        """Order the run to switch all outputs off after the present step, and to wait."""
        self._pause.set()

    def proceed(self) -> None:
        """Order the run to continue after a pause."""
        self._pause.clear()

    def wait(self) -> None:
        """Wait until the run is ordered to continue or to stop."""
        while self.paused:
            time.sleep(_POLL_S)

    def interrupt(self) -> None:
        """Obey Ctrl-C: the first stops the run after its step, the second gives up the step.

        Call it on the thread that executes the run.

        Raises
        ------
        KeyboardInterrupt
            Inside `given_up_at`, at the order that is given there.
        """
        repeated = self._stop.is_set()
        self._stop.set()
        if self._raises_at == 1 or (self._raises_at == 2 and repeated):
            self._raises_at = 0
            raise KeyboardInterrupt

    @contextmanager
    def given_up_at(self, order: int) -> Iterator[None]:
        """Raise KeyboardInterrupt inside the context at the first or second order to stop, once.

        Parameters
        ----------
        order : {1, 2}
            1 also counts an order that came before the context.
        """
        before = self._raises_at
        try:
            self._raises_at = order
            if order == 1 and self.stopped:
                raise KeyboardInterrupt
            yield
        finally:
            # After one KeyboardInterrupt, the code that cleans up is not interrupted again.
            self._raises_at = before if self._raises_at else 0


@contextmanager
def signals_obeyed(orders: Orders) -> Iterator[None]:
    """Convert signals to orders inside the context; do nothing on other threads than the main one.

    Signals that end a process stop the run. SIGUSR1 and Ctrl-Z (SIGTSTP) pause it, SIGUSR2
    continues it. Handlers that the program has set for other signals stay in force.
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
            if _is_to_be_handled(number):
                before[number] = signal.signal(number, act)
        for number in _numbers(_IGNORED):
            before[number] = signal.signal(number, signal.SIG_IGN)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _actions(orders: Orders) -> dict[int, Callable[[], None]]:
    """Return the order for each signal of this operating system."""
    excepted = _numbers(
        (*_UNCATCHABLE, *_FAULTS, *_HARMLESS, *_ERRORS, *_PAUSE, *_CONTINUE, *_IGNORED)
    )
    actions = {
        int(number): orders.interrupt for number in signal.valid_signals() if number not in excepted
    }
    actions |= dict.fromkeys(_numbers(_PAUSE), orders.pause)
    return actions | dict.fromkeys(_numbers(_CONTINUE), orders.proceed)


def _is_to_be_handled(number: int) -> bool:
    """Return whether a signal would end the process, or must always stop the run."""
    if number in _numbers(_ALWAYS):
        return True
    return signal.getsignal(number) is signal.SIG_DFL


def _numbers(names: tuple[str, ...]) -> set[int]:
    return {int(getattr(signal, name)) for name in names if hasattr(signal, name)}
