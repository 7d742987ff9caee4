"""Context that drivers get when their bench is opened, and through which they share objects."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, TypeVar, cast

import numpy as np

from drivers.roles import Clock, Surroundings
from protocols.bench import BenchFile
from protocols.preparation import Preparation

T = TypeVar("T")


class WallClock:
    """Real time since this clock was made."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()

    def now_s(self) -> float:
        """Return the seconds since this clock was made."""
        return time.monotonic() - self._start_s

    def date(self) -> datetime:
        """Return date and time in UTC."""
        return datetime.now(UTC)

    def wait(self, seconds: float) -> None:
        """Sleep; a signal that is handled does not shorten the sleep."""
        if seconds > 0:
            time.sleep(seconds)


@dataclass
class BenchContext:
    """One bench while it is being opened.

    Attributes
    ----------
    description : BenchFile
        The bench file.
    preparation : Preparation
        Reed and chamber. A check of the bench, and switching it off, name no real reed.
    rng : numpy.random.Generator
        The only source of random numbers on this bench; it follows from the seed of the run.
    announce : callable
        Called with a few words about what is being waited for.
    clock : Clock
        The bench's clock: that of the wall unless a driver puts another one here while it is
        opened. The program takes it once, when all instruments are open. A driver that only uses
        the clock reads this attribute each time, because a driver that is opened later may
        replace it.
    surroundings : Surroundings or None
        A driver that can change them puts them here while it is opened; the program takes them
        once, when all instruments are open.
    simulated_disorder : str
        A driver that simulates a bench with disorder puts here what it is, as JSON. Run files
        keep it in plain text.
    """

    description: BenchFile
    preparation: Preparation
    rng: np.random.Generator
    announce: Callable[[str], None]
    clock: Clock = field(default_factory=WallClock)
    surroundings: Surroundings | None = None
    simulated_disorder: str = ""
    _shared: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    def share(self, make: Callable[["BenchContext"], T]) -> T:
        """Return what `make` gives for this bench, the same object to all drivers that ask.

        This is how instruments that are one thing (a multi-channel box, a simulated laboratory)
        find it: each asks for ``context.share(Box)``, and the first makes it.

        The object lives as long as the bench, longer than a driver that is closed and opened again
        after a failure. If it has a method ``close() -> None``, `close` calls it.
        """
        if make not in self._shared:
            self._shared[make] = make(self)
        return cast(T, self._shared[make])

    def close(self) -> None:
        """Close what the drivers share, the last made first. May be called twice; raises nothing.

        Called after the instruments were closed, also when the bench could not be opened.
        """
        while self._shared:
            _, shared = self._shared.popitem()
            close = getattr(shared, "close", None)
            if close is not None:
                # A driver of others may raise anything; the others are still to be closed.
                with suppress(Exception):
                    close()
