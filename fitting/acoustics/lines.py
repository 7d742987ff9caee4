"""Find acoustic resonances of the bench: lines that the drives of several reeds have in common."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from fitting.acoustics.poles import MOST_DB, NEXT_TO_CENTS, WITHIN_CENTS, ExcitationPeak
from fitting.cane.excess_scatter import added_cents
from holography.arrays import Array

# Peaks of several reeds are one line if they are this close, or within this many standard errors of
# each other. Chosen: the speed of sound, and with it a cavity, changes by 3 cents per °C, and reeds
# sit in their chamber differently.
_SAME_CENTS, _DEVIATIONS = 40.0, 3.0
# A line belongs to the bench if this fraction of the reeds show it, and this many.
_MOST, LEAST_REEDS = 0.6, 3
# Least part of an error that is of the sweep itself, and how often mean and scatter are computed in
# turns: the second time changes the mean by less than its error.
_LEAST_OWN, _TURNS = 0.05, 2


class Verdict(StrEnum):
    """To what an acoustic line belongs."""

    BENCH = "bench"
    SUSPECT = "suspect"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class NearMode:
    """The mode that is nearest to a peak.

    Attributes
    ----------
    name : str
    cents : float
        Peak less mode.
    """

    name: str
    cents: float


@dataclass(frozen=True)
class SeenPeak:
    """A peak in the drive of one sweep.

    Attributes
    ----------
    reed, run : str
        Name of the reed, and of the run file.
    peak : ExcitationPeak
    mode : NearMode or None
        None if the sweep shows no mode.
    """

    reed: str
    run: str
    peak: ExcitationPeak
    mode: NearMode | None

    def to_json(self) -> dict[str, Any]:
        """Return the peak with stable keys."""
        return asdict(self.peak) | {
            "mode": self.mode.name if self.mode else None,
            "mode_cents": self.mode.cents if self.mode else None,
            "suspect": self.suspect,
        }

    @property
    def next_to_mode(self) -> bool:
        """Whether a mode could account for the peak."""
        return self.mode is not None and abs(self.mode.cents) < NEXT_TO_CENTS

    @property
    def suspect(self) -> bool:
        """Whether it is within a mode's width, and higher than acoustic resonances are.

        The drive has then probably absorbed vibration of the mode.
        """
        within = self.mode is not None and abs(self.mode.cents) < WITHIN_CENTS
        return within and self.peak.height_db > MOST_DB


@dataclass(frozen=True)
class SweepPeaks:
    """All peaks of one sweep.

    Attributes
    ----------
    reed : str
    low_hz, high_hz : float
        Range of the sweep.
    peaks : tuple of SeenPeak
    """

    reed: str
    low_hz: float
    high_hz: float
    peaks: tuple[SeenPeak, ...]


@dataclass(frozen=True)
class AcousticLine:
    """A line that one or more reeds show.

    Attributes
    ----------
    hz, error_hz : float
        Weighted mean of the poles, and its standard error, which contains the excess scatter.
    quality, quality_error : float
    height_db : float
        Median over the sweeps.
    scatter_cents : float
        Excess scatter of the frequencies, in addition to their errors.
    reeds, of : int
        Reeds that show the line, and reeds whose sweeps cover it.
    verdict : Verdict
    reason : str
        Why it is suspect or undecided; else empty.
    seen : tuple of SeenPeak
        In order of reeds.
    """

    hz: float
    error_hz: float
    quality: float
    quality_error: float
    height_db: float
    scatter_cents: float
    reeds: int
    of: int
    verdict: Verdict
    reason: str
    seen: tuple[SeenPeak, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the line with stable keys (documented in ``docs/reference/json.md``)."""
        own = {key: value for key, value in vars(self).items() if key != "seen"}
        seen = [{"reed": s.reed, "run": s.run} | s.to_json() for s in self.seen]
        return own | {"verdict": str(self.verdict), "seen": seen}


def nearest_mode(hz: float, mode_hz: Mapping[str, float]) -> NearMode | None:
    """Return the mode that is nearest to a frequency; None if there are no modes."""
    if not mode_hz:
        return None
    name = min(mode_hz, key=lambda each: abs(_cents(hz, mode_hz[each])))
    return NearMode(name, _cents(hz, mode_hz[name]))


def acoustic_lines(sweeps: Sequence[SweepPeaks]) -> list[AcousticLine]:
    """Group the peaks of several reeds into lines, and judge to what each belongs.

    Parameters
    ----------
    sweeps : sequence of SweepPeaks
        Of any number of reeds; several sweeps of one reed count as one reed.

    Returns
    -------
    list of AcousticLine
        In order of frequency.
    """
    every = sorted((seen for sweep in sweeps for seen in sweep.peaks), key=lambda s: s.peak.hz)
    lines = []
    while every:
        # Windows of a fixed width: peaks in a row do not merge to one.
        windows = [_window(every, first) for first in range(len(every))]
        fullest = max(windows, key=lambda window: len({seen.reed for seen in window}))
        lines.append(_line(fullest, sweeps))
        every = [seen for seen in every if seen not in fullest]
    return sorted(lines, key=lambda line: line.hz)


def _window(every: Sequence[SeenPeak], first: int) -> list[SeenPeak]:
    """Return the peaks from number `first` on that may be the same line."""
    window = [every[first]]
    for seen in every[first + 1 :]:
        if not _same(every[first].peak, seen.peak):
            break
        window.append(seen)
    return window


def _same(one: ExcitationPeak, other: ExcitationPeak) -> bool:
    error_cents = np.hypot(_error_cents(one), _error_cents(other))
    return abs(_cents(one.hz, other.hz)) < max(_SAME_CENTS, _DEVIATIONS * float(error_cents))


def _line(window: Sequence[SeenPeak], sweeps: Sequence[SweepPeaks]) -> AcousticLine:
    peaks = [seen.peak for seen in window]
    hz, error_cents, scatter_cents = _mean_hz(peaks)
    quality, quality_error = _mean_quality(peaks)
    reeds = {seen.reed for seen in window}
    of = {sweep.reed for sweep in sweeps if sweep.low_hz < hz < sweep.high_hz} | reeds
    verdict, reason = _judged(window, len(reeds), len(of))
    return AcousticLine(
        hz=hz,
        error_hz=hz * error_cents * float(np.log(2)) / 1200,
        quality=quality,
        quality_error=quality_error,
        height_db=float(np.median([peak.height_db for peak in peaks])),
        scatter_cents=scatter_cents,
        reeds=len(reeds),
        of=len(of),
        verdict=verdict,
        reason=reason,
        seen=tuple(sorted(window, key=lambda seen: (seen.reed, seen.run))),
    )


def _mean_hz(peaks: Sequence[ExcitationPeak]) -> tuple[float, float, float]:
    """Return the mean of poles in Hz, its error and the excess scatter in cents."""
    cents = np.array([_cents(peak.hz, peaks[0].hz) for peak in peaks])
    per_hz = np.array([1200 / float(np.log(2)) / peak.hz for peak in peaks])
    errors = per_hz * [peak.error_hz for peak in peaks]
    ripple = per_hz * [peak.ripple_hz for peak in peaks]
    mean, error, scatter = _mean(cents, errors, ripple)
    return peaks[0].hz * 2 ** (mean / 1200), error, scatter


def _mean_quality(peaks: Sequence[ExcitationPeak]) -> tuple[float, float]:
    """Return the mean of quality factors, of their logarithms, and its error."""
    qualities = np.array([peak.quality for peak in peaks])
    errors = np.array([peak.quality_error for peak in peaks]) / qualities
    ripple = np.array([peak.ripple_quality for peak in peaks]) / qualities
    mean, error, _ = _mean(np.log(qualities), errors, ripple)
    return float(np.exp(mean)), float(np.exp(mean) * error)


def _mean(values: Array, errors: Array, ripple: Array) -> tuple[float, float, float]:
    """Return a weighted mean, its error, and the excess scatter of the values.

    The ripple of the loudspeaker is the same with every reed: its part of the errors does not
    decrease with the number of reeds, and makes no scatter.
    """
    own = np.sqrt(np.maximum(errors**2 - ripple**2, (_LEAST_OWN * errors) ** 2))
    scatter, freedom = 0.0, np.array([len(values) - 1])
    for _ in range(_TURNS if len(values) > 1 else 0):
        mean = np.average(values, weights=1 / (own**2 + scatter**2))
        scatter = float(added_cents((values - mean)[None], own[None], freedom)[0])
    weights = 1 / (errors**2 + scatter**2)
    share = weights / np.sum(weights)
    own_part = float(np.sum(share**2 * (own**2 + scatter**2)))
    return float(share @ values), float(np.sqrt(own_part + (share @ ripple) ** 2)), scatter


def _judged(window: Sequence[SeenPeak], reeds: int, of: int) -> tuple[Verdict, str]:
    """Return to what a line belongs, and why that is not certain."""
    follows = _followed_mode(window)
    if follows:
        return Verdict.SUSPECT, f"it follows {follows} from reed to reed"
    if reeds >= max(LEAST_REEDS, _MOST * of):
        return Verdict.BENCH, ""
    high = [seen for seen in window if seen.suspect]
    if len(high) > len(window) / 2 and high[0].mode is not None:
        return Verdict.SUSPECT, f"it is next to {high[0].mode.name} and above {MOST_DB:g} dB"
    if of < LEAST_REEDS:
        return Verdict.UNDECIDED, f"fewer than {LEAST_REEDS} reeds cover it"
    return Verdict.SUSPECT, "most reeds do not show it"


def _followed_mode(window: Sequence[SeenPeak]) -> str:
    """Return the mode that a line next to it follows from reed to reed; empty if there is none.

    A line of the bench stays where it is when modes move: its frequency then scatters less than its
    distance to the mode.
    """
    near = [seen.mode for seen in window if seen.mode is not None and seen.next_to_mode]
    names = {mode.name for mode in near}
    if len(window) < LEAST_REEDS or len(near) < len(window) or len(names) != 1:
        return ""
    cents = [_cents(seen.peak.hz, window[0].peak.hz) for seen in window]
    follows = np.std([mode.cents for mode in near]) < np.std(cents)
    return names.pop() if follows else ""


def _error_cents(peak: ExcitationPeak) -> float:
    return 1200 / float(np.log(2)) * peak.error_hz / peak.hz


def _cents(hz: float, reference_hz: float | Array) -> float:
    return float(1200 * np.log2(hz / reference_hz))
