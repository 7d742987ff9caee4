"""Clocks of cameras: the time on a camera, and the start of an exposure.

All three clocks err to one side only: a frame is never believed to have begun later than it did,
relative to `now_s`. A camera that is asked for frames from now on may so lose time, but never
hands out a frame from before.
"""

from collections.abc import Callable
from typing import Final, Protocol

# Two crystals, of the camera and of the computer, of 50 ppm each.
_DRIFT: Final = 1e-4


class CameraClock(Protocol):
    """The time of a camera's frames."""

    @property
    def name(self) -> str:
        """Source of this clock, in a few words."""
        ...

    @property
    def known(self) -> bool:
        """Whether `now_s` can tell yet; it may need a frame first."""
        ...

    def now_s(self) -> float:
        """Return the present time on the clock of the frames, or a little later."""
        ...

    def started(self) -> None:
        """Record that the camera is about to be started."""
        ...

    def began_s(self, stamp_s: float, absent_s: float, exposure_s: float) -> float:
        """Return when an exposure began, or a little earlier.

        Parameters
        ----------
        stamp_s : float
            The camera's time stamp.
        absent_s : float
            A moment on the computer's clock at which the frame had not arrived yet.
        exposure_s : float
        """
        ...


class LatchedClock:
    """The clock of a camera that tells its time when asked.

    The latch falls after it was asked for, so `now_s` lies within the call: after all that was
    done before, and at most the duration of the call too early for what is done after.

    Parameters
    ----------
    latch : callable
        Asks the camera for its time in s.
    stamped_at_end : bool
        The camera stamps the end of an exposure instead of its start.
    """

    def __init__(self, latch: Callable[[], float], *, stamped_at_end: bool) -> None:
        self._latch, self._stamped_at_end = latch, stamped_at_end

    @property
    def name(self) -> str:
        """Source of this clock."""
        return "times of the camera's clock, latched"

    @property
    def known(self) -> bool:
        """Always."""
        return True

    def now_s(self) -> float:
        """Ask the camera."""
        return self._latch()

    def started(self) -> None:
        """Nothing to note."""

    def began_s(self, stamp_s: float, absent_s: float, exposure_s: float) -> float:
        """Return the time stamp, less the exposure if that is its end."""
        return stamp_s - exposure_s if self._stamped_at_end else stamp_s


class BoundedClock:
    """The clock of a camera that stamps its frames but does not tell its time.

    No frame is stamped before the camera was started: that bounds the difference of both
    clocks from above, and `now_s` goes by this bound. No frame arrives before it is stamped: that
    bounds it from below, and `error_s` is the distance of both bounds. The upper one is widened by
    the drift of two crystals since the start, 0.1 ms per second.

    Parameters
    ----------
    host_s : callable
        The computer's clock.
    stamped_at_end : bool
        The camera stamps the end of an exposure instead of its start.
    """

    def __init__(self, host_s: Callable[[], float], *, stamped_at_end: bool) -> None:
        self._host_s, self._stamped_at_end = host_s, stamped_at_end
        self._started_s = host_s()
        self._most_s: float | None = None
        self._least_s = 0.0

    @property
    def name(self) -> str:
        """Source of this clock."""
        return "times of the camera's clock, bounded by its start"

    @property
    def known(self) -> bool:
        """After the first frame."""
        return self._most_s is not None

    @property
    def error_s(self) -> float:
        """Largest delay of `now_s`, which is never early."""
        return self._offset_s() - self._least_s + self._drift_s()

    def now_s(self) -> float:
        """Return the computer's time plus the largest difference that both clocks can have.

        Raises
        ------
        ValueError
            If no frame has come since the start.
        """
        return self._host_s() + self._offset_s()

    def started(self) -> None:
        """Forget the bounds: the first frame to come gives new ones."""
        self._started_s, self._most_s = self._host_s(), None

    def began_s(self, stamp_s: float, absent_s: float, exposure_s: float) -> float:
        """Return the time stamp, less the exposure if that is its end; and learn from it."""
        most_s, least_s = stamp_s - self._started_s, stamp_s - self._host_s()
        if self._most_s is None:
            self._most_s, self._least_s = most_s, least_s
        # A late frame may have been stamped before the first that came.
        self._most_s = min(self._most_s, most_s)
        self._least_s = max(self._least_s, least_s)
        return stamp_s - exposure_s if self._stamped_at_end else stamp_s

    def _offset_s(self) -> float:
        if self._most_s is None:
            raise ValueError("no frame has come yet, so the camera's time is unknown")
        return self._most_s + self._drift_s()

    def _drift_s(self) -> float:
        return _DRIFT * (self._host_s() - self._started_s)


class ArrivalClock:
    """The computer's clock, for a camera that does not stamp its frames.

    An exposure is taken to have begun one exposure and one readout before the last moment at which
    the frame was known not to have arrived. A frame that was longer on its way, through drivers
    and queues, is still believed too fresh: no such camera is good for measurements in earnest.

    Parameters
    ----------
    host_s : callable
        The computer's clock.
    readout_s : float
        From the end of an exposure to the arrival of the frame.
    """

    def __init__(self, host_s: Callable[[], float], readout_s: float) -> None:
        self._host_s, self._readout_s = host_s, readout_s

    @property
    def name(self) -> str:
        """Source of this clock."""
        return "no time stamps: times of arrival at the computer, less exposure and readout"

    @property
    def known(self) -> bool:
        """Always."""
        return True

    def now_s(self) -> float:
        """Return the computer's time."""
        return self._host_s()

    def started(self) -> None:
        """Nothing to note."""

    def began_s(self, stamp_s: float, absent_s: float, exposure_s: float) -> float:
        """Return the latest moment before arrival, less exposure and readout."""
        return absent_s - exposure_s - self._readout_s
