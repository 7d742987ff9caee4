"""Switch off every instrument of a bench that can be reached, even if others fail."""

import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final

from acquire.bench.findings import Finding, all_confirmed_off, unreached
from acquire.runner.orders import Orders
from drivers.bench_lock import BenchInUseError
from drivers.errors import BenchSetupError
from drivers.exclusive import Holder
from drivers.registry import Opened, is_simulated, open_each
from drivers.roles import RoleName
from protocols.bench import BenchFile
from protocols.preparation import Preparation

_CHECK: Final = "off"
# Text for other programs that find the bench in use.
_PURPOSE: Final = "switches the bench off"
# The tweeter first, because it is loud and drives the reed.
_ORDER: Final[tuple[RoleName, ...]] = ("generator", "synthesizers", "camera")
# Opening an instrument does not depend on the preparation.
_NO_PREPARATION: Final = Preparation("none", "none", "asymmetric")

# Longest wait for another program. Chosen: a step of a sweep takes about 1 s, switching off another
# second, and a driver may wait for several timeouts of 2 s before that.
_MAX_WAIT_S: Final = 15.0
# Time after which the other program is asked again. Chosen: a run stops after its present step,
# which ends earlier; the second order gives up that step.
_ASK_AGAIN_S: Final = 5.0
# Pause between two attempts to open the bench. Chosen: short compared with a step.
_POLL_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class OffReport:
    """Result of switching off a bench.

    Attributes
    ----------
    bench : str
        Name of the bench.
    findings : tuple of Finding
        One finding for each instrument.
    stopped : tuple of int
        Numbers of processes that used the bench and were asked to stop.
    """

    bench: str
    findings: tuple[Finding, ...]
    stopped: tuple[int, ...]

    @property
    def is_off(self) -> bool:
        """Return whether every output is confirmed off."""
        return all(finding.result != "fail" for finding in self.findings)

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON values with stable keys."""
        return {
            "bench": self.bench,
            "off": self.is_off,
            "stopped": list(self.stopped),
            "findings": [finding.to_json() for finding in self.findings],
        }


def switch_off(
    bench: BenchFile,
    orders: Orders,
    announce: Callable[[str], None],
    patience_s: float = _MAX_WAIT_S,
) -> OffReport:
    """Switch off every instrument of a bench, each independently of the others.

    A program of this computer that uses the bench is asked to stop first, because only that program
    can talk to the instruments while it runs.

    Parameters
    ----------
    bench : BenchFile
    orders : Orders
        The first order to stop ends the wait for another program, but not the switching off; a
        second one gives up.
    announce : callable
        Called with a text while this function waits for another program.
    patience_s : float
        Longest wait for another program, in s.

    Returns
    -------
    OffReport
    """
    real = tuple(role for role in _ORDER if not _is_simulated(bench, role))
    simulated = tuple(
        Finding(_CHECK, role, "note", "simulated: there is nothing to switch off")
        for role in _ORDER
        if role not in real
    )
    if not real:
        return OffReport(bench.name, simulated, ())
    waiting = _Waiting(orders, announce, patience_s)
    findings = _switched_off(bench, real, orders, announce, waiting)
    return OffReport(bench.name, (*findings, *simulated), tuple(waiting.asked))


def _is_simulated(bench: BenchFile, role: RoleName) -> bool:
    try:
        return is_simulated(role, getattr(bench.instruments, role).driver)
    except BenchSetupError:
        # An instrument without a driver counts as real, and cannot be reached.
        return False


def _switched_off(
    bench: BenchFile,
    roles: Sequence[RoleName],
    orders: Orders,
    announce: Callable[[str], None],
    waiting: "_Waiting",
) -> list[Finding]:
    with ExitStack() as held:
        try:
            opened = _opened(held, bench, roles, orders, announce, waiting)
        except KeyboardInterrupt:
            given_up = "you interrupted the switching off; run acquire bench off again"
            return [unreached(_CHECK, role, given_up) for role in roles]
        except BenchSetupError as error:
            return [unreached(_CHECK, role, error) for role in roles]
        off = all_confirmed_off(_CHECK, opened.instruments)
        return [off.get(role) or unreached(_CHECK, role, opened.failures[role]) for role in roles]


def _opened(
    held: ExitStack,
    bench: BenchFile,
    roles: Sequence[RoleName],
    orders: Orders,
    announce: Callable[[str], None],
    waiting: "_Waiting",
) -> Opened:
    """Open the instruments as soon as no other program uses them; drivers open with outputs off.

    Raises
    ------
    BenchInUseError
        If another program continues to use the bench.
    """
    while True:
        try:
            # The first order to stop does not end this, because the outputs may be on.
            with orders.given_up_at(2):
                return held.enter_context(
                    open_each(bench, _NO_PREPARATION, announce=announce, roles=roles, does=_PURPOSE)
                )
        except BenchInUseError as busy:
            waiting.wait(busy)


class _Waiting:
    """Ask other programs to stop, and wait for them.

    Attributes
    ----------
    asked : dict of int to float
        Time at which each process was asked last, on the monotonic clock, in s.
    """

    def __init__(self, orders: Orders, announce: Callable[[str], None], patience_s: float) -> None:
        self._orders, self._announce, self._patience_s = orders, announce, patience_s
        self._deadline_s: float | None = None
        self.asked: dict[int, float] = {}

    def wait(self, busy: BenchInUseError) -> None:
        """Ask the process that uses the bench to stop, and wait for `_POLL_S`.

        Raises
        ------
        BenchInUseError
            If the process cannot be asked, or does not stop in time.
        """
        now_s = time.monotonic()
        if self._deadline_s is None:
            self._deadline_s = now_s + self._patience_s
        # A new lock may not name its process yet.
        if busy.holder is not None:
            self._ask(busy.holder, now_s)
        if self._orders.stopped:
            raise _still_busy(busy, "you interrupted the wait; run acquire bench off again")
        if now_s > self._deadline_s:
            raise _still_busy(busy, _last_resort(busy.holder, self._patience_s))
        time.sleep(_POLL_S)

    def _ask(self, holder: Holder, now_s: float) -> None:
        if now_s - self.asked.get(holder.pid, -_ASK_AGAIN_S) < _ASK_AGAIN_S:
            return
        if not holder.is_here or holder.pid == os.getpid():
            return
        again = holder.pid in self.asked
        try:
            os.kill(holder.pid, signal.SIGTERM)
        except ProcessLookupError:
            return
        except PermissionError:
            raise BenchInUseError(
                f"in use by {holder}, which belongs to another user; ask them to stop it, or run "
                "this command with sudo",
                holder,
            ) from None
        self.asked[holder.pid] = now_s
        self._announce(
            f"{holder} still uses the bench; asked again to stop"
            if again
            else f"{holder} uses the bench; asked to stop, waiting up to {self._patience_s:g} s"
        )


def _last_resort(holder: Holder | None, patience_s: float) -> str:
    if holder is None or not holder.is_here:
        return "no process of this computer uses it; end the program on the computer where it runs"
    if holder.pid == os.getpid():
        return "this program itself uses it; close the bench first"
    return (
        f"it did not stop within {patience_s:g} s; end it with: kill -9 {holder.pid}; then run "
        "acquire bench off again"
    )


def _still_busy(busy: BenchInUseError, remedy: str) -> BenchInUseError:
    holder = busy.holder or "an unknown program"
    return BenchInUseError(f"in use by {holder}; {remedy}", busy.holder)
