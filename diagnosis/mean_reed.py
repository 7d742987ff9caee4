"""Resonances of a mean reed in each series: from the paper's Table 1, or from anyone's table."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fitting.errors import FitInputError
from fitting.forward import cents_of
from fitting.paper.printed import printed
from fitting.populations.resonance_table import read_resonances
from holography.arrays import Array
from physics.reed.cane.viscoelastic import Series
from physics.reed.mode_classification import PAPER_MODES

# Mean of what neighbours make pictures with most fringes miss a resonance by, on simulated reeds
# (`python -m studies.identification`).
READING_CENTS = 7.0
# What reeds differ in beyond what their cane explains (paper, section IV.B).
SCATTER_CENTS = 25.0
# Modes that fewer reeds show are those of a choice of reeds.
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class MeanReed:
    """Resonances of a mean reed in one series.

    Attributes
    ----------
    series : Series
    modes : tuple of str
    cents : (m,) float
        Above F6.
    error_cents : (m,) float
        Of the data alone.
    reeds : int
        How many it is the mean of.
    """

    series: Series
    modes: tuple[str, ...]
    cents: Array
    error_cents: Array
    reeds: int


def printed_reeds() -> list[MeanReed]:
    """Means of Table 1 in both series, of the modes that at least half of the reeds show.

    The table gives means in Hz: the mean logarithm is lower by half the square of the relative
    standard deviation.
    """
    numbers = printed()
    reeds = []
    for series in Series:
        seen = {name: numbers.observed_resonances[name][series] for name in PAPER_MODES}
        most = max(mode.identified for mode in seen.values())
        names, cents, errors = [], [], []
        for name, mode in seen.items():
            if mode.identified < _LEAST_SHARE * most or not mode.mean_hz or not mode.sd_hz:
                continue
            log_cents = 600 / np.log(2) * (mode.sd_hz / mode.mean_hz) ** 2
            names.append(name)
            cents.append(float(cents_of(mode.mean_hz)) - log_cents)
            errors.append(np.hypot(READING_CENTS, SCATTER_CENTS / np.sqrt(mode.identified)))
        reeds.append(MeanReed(series, tuple(names), np.array(cents), np.array(errors), most))
    return reeds


def tabled_reeds(path: Path, tell: Callable[[str], None] | None = None) -> list[MeanReed]:
    """Return the mean resonances of the reeds of a table, for each series that it has.

    Where reeds lack modes, means are those of reeds that all have the mean's difference from mode
    to mode: rows and columns are fitted together.

    Parameters
    ----------
    path : Path
        See `fitting.populations.resonance_table`.
    tell : callable, optional
        Called with rows that are of no mode that is compared.

    Raises
    ------
    FitInputError
        If the table cannot be read, or has no series with four modes.
    """
    pieces = list(read_resonances(path, PAPER_MODES))
    if not pieces:
        raise FitInputError(f"{path}: has no rows; write one for every resonance")
    passed_over = sum(piece.passed_over for piece in pieces)
    if passed_over and tell is not None:
        tell(f"{path}: rows of modes other than {', '.join(PAPER_MODES)}: {passed_over}, not used")
    cents = np.concatenate([piece.cents for piece in pieces])
    errors = np.concatenate([piece.error_cents for piece in pieces])
    reeds = []
    for s, series in enumerate(Series):
        mean = _mean(series, cents[:, s], errors[:, s])
        if mean is not None:
            reeds.append(mean)
    if not reeds:
        raise FitInputError(
            f"{path}: no series has four of the modes {', '.join(PAPER_MODES)}, of which at least "
            "half of its reeds show each; fewer do not tell two moduli and an effect apart"
        )
    return reeds


def _mean(series: Series, cents: Array, errors: Array) -> MeanReed | None:
    """Mean of reeds (n, m), NaN where a mode is missing."""
    shown = ~np.isnan(cents)
    used = shown.any(axis=1)
    often = shown[used].sum(axis=0) >= max(1.0, _LEAST_SHARE * used.sum())
    # Reeds that show none of these tell nothing of their mean.
    used = shown[:, often].any(axis=1)
    if not used.any() or often.sum() < 4:
        return None
    cents, errors, shown = (part[used][:, often] for part in (cents, errors, shown))
    level, profile = np.zeros(len(cents)), np.zeros(cents.shape[1])
    weight = np.where(shown, 1.0, 0.0)
    filled = np.where(shown, cents, 0.0)
    # Alternate: few reeds lack few modes, and it settles at once.
    for _ in range(200):
        level = (weight * (filled - profile)).sum(axis=1) / weight.sum(axis=1)
        previous, profile = profile, (weight * (filled - level[:, None])).sum(axis=0)
        profile = profile / weight.sum(axis=0)
        if np.abs(profile - previous).max() < 1e-6:
            break
    counts = shown.sum(axis=0)
    reading = np.sqrt(np.where(shown, errors**2, 0.0).sum(axis=0)) / counts
    scatter = SCATTER_CENTS / np.sqrt(counts) if len(cents) > 1 else np.zeros(len(counts))
    names = tuple(name for name, kept in zip(PAPER_MODES, often, strict=True) if kept)
    return MeanReed(series, names, profile + level.mean(), np.hypot(reading, scatter), len(cents))
