"""Time that passed while this process was given a processor.

Tests that set a limit on a wait measure it so. A machine that stands still for seconds, as those of
public services do, makes no wait of ours longer; a wait of ours that is too long is still seen.
"""

import threading
import time

# Chosen: how often it is looked, and what a busy machine with free processors may be late.
_EVERY_S = 0.005
_MOST_LATE_S = 0.05


class Stalls:
    """Times at which this process stood still.

    Parameters
    ----------
    now_s : float
        Monotonic time at which it is first known to run.
    """

    def __init__(self, now_s: float) -> None:
        # Two threads note: a stall that both see counts once.
        self._seen_s, self._noting = now_s, threading.Lock()
        self._lost: list[tuple[float, float]] = []

    def note(self, now_s: float) -> None:
        """Note that the process runs at this monotonic time."""
        with self._noting:
            seen_s, self._seen_s = self._seen_s, max(self._seen_s, now_s)
            if now_s - seen_s > _MOST_LATE_S:
                self._lost.append((seen_s + _MOST_LATE_S, now_s))

    def awake_s(self, from_s: float, until_s: float) -> float:
        """Return the time between two monotonic times, less that in which it stood still."""
        lost_s = (min(until_s, end_s) - max(from_s, begin_s) for begin_s, end_s in self._lost)
        return until_s - from_s - sum(lost for lost in lost_s if lost > 0)


class AwakeClock(threading.Thread):
    """Looks every few milliseconds whether the process runs, while it is entered."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._stalls, self._over = Stalls(time.monotonic()), threading.Event()

    def __enter__(self) -> "AwakeClock":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join()

    def run(self) -> None:
        """Look until it is left."""
        while not self._over.wait(_EVERY_S):
            self._stalls.note(time.monotonic())

    def awake_s(self, from_s: float, until_s: float | None = None) -> float:
        """Return the time since a monotonic time, or up to another, as `Stalls.awake_s`."""
        now_s = time.monotonic()
        # What still stands still has not been seen to.
        self._stalls.note(now_s)
        return self._stalls.awake_s(from_s, now_s if until_s is None else until_s)
