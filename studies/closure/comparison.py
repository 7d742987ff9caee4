"""Compare what an effect changes in rendered numbers with what the model predicts.

Numbers of a campaign with an effect, and those of the same campaign without it, are each compared
with the prediction from the parameters that the bench played. What both have in common, noise of
one seed, disorder and errors of the method, cancels in the difference. The errors are those of
measuring that the diagnosis states for a number of the campaign with the effect.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnosis.observable_groups import MEASURED, Coordinates, ObservableGroup
from diagnosis.observe import observable_groups
from holography.arrays import Array
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters
from studies.closure.measuring import Measured

# A pull beyond this many standard errors does not close. Chosen: one of 400 numbers without a
# defect is beyond 3; most noise cancels, so that far fewer are.
LIMIT = 3.0
# An effect whose predicted change of a group is below this many standard errors is not tested by
# it. Chosen: then the group could not tell the effect from its absence with three to one.
TESTED = 2.0
# Predictions of one number by the same parameters are equal but for rounding.
_SAME = 1e-9


@dataclass(frozen=True)
class Number:
    """One number of a group.

    Attributes
    ----------
    coordinates : Coordinates
    predicted, rendered : float
        Change by the effect.
    error : float
        Standard error that the diagnosis states.
    pull : float
        Rendered less predicted, in standard errors.
    pull_given_others : float
        The same in units of the error that is left when all other numbers are known, and less what
        these make it expect: errors that numbers have in common do not count.
    """

    coordinates: Coordinates
    predicted: float
    rendered: float
    error: float
    pull: float
    pull_given_others: float

    @property
    def worst(self) -> float:
        """The larger of both pulls."""
        return max(self.pull, self.pull_given_others, key=abs)


@dataclass(frozen=True)
class GroupClosure:
    """A group of observables of one effect.

    Attributes
    ----------
    name : str
    observable : str
    numbers : tuple of Number
    significance : float
        Predicted change in standard errors, of all numbers of the group together.
    scale, scale_error : float
        Rendered change along the predicted one, 1 if both are equal, and its standard error; NaN
        and infinite if no change is predicted.
    rms_pull : float
        Root mean square of the whitened differences.
    """

    name: str
    observable: str
    numbers: tuple[Number, ...]
    significance: float
    scale: float
    scale_error: float
    rms_pull: float

    @property
    def worst(self) -> Number:
        """The number with the largest pull."""
        return max(self.numbers, key=lambda number: abs(number.worst))

    @property
    def tested(self) -> bool:
        """Whether the effect is large enough for this group."""
        return self.significance >= TESTED

    @property
    def scale_pull(self) -> float:
        """Difference of the scale from 1 in its standard errors; 0 if no change is predicted."""
        return (self.scale - 1) / self.scale_error if self.significance else 0.0

    @property
    def closes(self) -> bool:
        """Whether rendered and predicted changes agree within their errors."""
        return max(abs(self.worst.worst), abs(self.scale_pull)) < LIMIT


@dataclass(frozen=True)
class EffectClosure:
    """All groups of one effect.

    Attributes
    ----------
    effect : str
    sizes : dict of float
    groups : tuple of GroupClosure
    lost : tuple of str
        Groups and numbers that only one of both campaigns has.
    """

    effect: str
    sizes: dict[str, float]
    groups: tuple[GroupClosure, ...]
    lost: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of observables."""
        return sum(len(group.numbers) for group in self.groups)

    @property
    def rms_pull(self) -> float:
        """Root mean square of the pulls of all numbers, given the others."""
        pulls = [n.pull_given_others for group in self.groups for n in group.numbers]
        return float(np.sqrt(np.mean(np.square(pulls))))

    @property
    def worst(self) -> GroupClosure:
        """Group with the largest pull of a number."""
        return max(self.groups, key=lambda group: abs(group.worst.worst))

    @property
    def significance(self) -> float:
        """Predicted change in standard errors, of all groups together."""
        return float(np.sqrt(sum(group.significance**2 for group in self.groups)))

    @property
    def verdict(self) -> str:
        """``closes``, ``open``, or ``not shown`` if no group could show the effect."""
        if not all(group.closes for group in self.groups):
            return "open"
        return "closes" if any(group.tested for group in self.groups) else "not shown"


def compare(
    effect: str, sizes: dict[str, float], with_it: Measured, without: Measured, solver: ReedSolver
) -> EffectClosure:
    """Compare a campaign with an effect with the same campaign without it.

    Parameters
    ----------
    effect : str
    sizes : dict of float
    with_it, without : Measured
    solver : ReedSolver
        Of the kind of reed.
    """
    after = {group.name: group for group in observable_groups(with_it.readings, solver)}
    before = {group.name: group for group in observable_groups(without.readings, solver)}
    lost, changes = sorted(after.keys() ^ before.keys()), []
    for name, group in after.items():
        if name not in before:
            continue
        pairs = _pairs(group, before[name], without.parameters)
        missing = len(group.values) + len(before[name].values) - 2 * len(pairs)
        if missing:
            lost.append(f"{missing} numbers of {name}")
        if pairs:
            changes.append(_change(group, before[name], pairs, with_it, without))
    return EffectClosure(effect, sizes, tuple(_closure(change) for change in changes), tuple(lost))


def _pairs(
    after: ObservableGroup, before: ObservableGroup, parameters: BenchParameters
) -> list[tuple[int, int]]:
    """Return the positions of numbers that both groups have.

    Some quantities are named by a measured level, such as the linearity of a sensor: where all else
    is equal, numbers correspond by their position. Others, such as the steps of a band, have equal
    coordinates: if one campaign lacks some of them, those correspond of which the same is expected.
    """
    one, two = after.coordinates, before.coordinates
    if [replace(place, quantity="") for place in one] == [
        replace(place, quantity="") for place in two
    ]:
        return [(k, k) for k in range(len(one))]
    expected = after.predict(parameters), before.predict(parameters)
    pairs = []
    for place in dict.fromkeys(one):
        here, there = ([k for k, p in enumerate(each) if p == place] for each in (one, two))
        if len(here) == len(there):
            pairs += list(zip(here, there, strict=True))
            continue
        same = np.abs(expected[0][here][:, None] - expected[1][there]) < _SAME
        alone = same & (same.sum(axis=0) == 1) & (same.sum(axis=1) == 1)[:, None]
        pairs += [(here[h], there[t]) for h, t in np.argwhere(alone).tolist()]
    return sorted(pairs)


@dataclass(frozen=True)
class _Change:
    """What an effect changes in a group.

    Attributes
    ----------
    group : ObservableGroup
        Of the campaign with the effect.
    numbers : (n,) int
        Those of its numbers that both campaigns have.
    predicted, rendered : (n,) float
    """

    group: ObservableGroup
    numbers: NDArray[np.intp]
    predicted: Array
    rendered: Array

    @property
    def covariance(self) -> Array:
        """Covariance (n, n) of what the group states as measured: not of disorder."""
        errors = self.group.errors
        measured = [each for each in errors.nuisances if each.freedom == MEASURED]
        chosen: Array = errors.covariance(measured)[np.ix_(self.numbers, self.numbers)]
        return chosen


def _change(
    after: ObservableGroup,
    before: ObservableGroup,
    pairs: Sequence[tuple[int, int]],
    with_it: Measured,
    without: Measured,
) -> _Change:
    one, two = np.array(pairs).T
    expected = after.predict(with_it.parameters)
    return _Change(
        after,
        one,
        expected[one] - before.predict(without.parameters)[two],
        after.values[one] - before.values[two],
    )


def _closure(change: _Change) -> GroupClosure:
    """Return the closure of a group."""
    precision = np.linalg.inv(change.covariance)
    off, signature = change.rendered - change.predicted, change.predicted
    square, along = float(signature @ precision @ signature), float(signature @ precision @ off)
    white = np.linalg.solve(np.linalg.cholesky(change.covariance), off)
    return GroupClosure(
        name=change.group.name,
        observable=str(change.group.tap),
        numbers=tuple(_numbers(change, precision)),
        significance=float(np.sqrt(square)),
        scale=1 + along / square if square else np.nan,
        scale_error=1 / float(np.sqrt(square)) if square else np.inf,
        rms_pull=float(np.sqrt(np.mean(white**2))),
    )


def _numbers(change: _Change, precision: Array) -> Iterator[Number]:
    """Yield the numbers of a group; `precision` is the inverse of its covariance."""
    error = np.sqrt(np.diag(change.covariance))
    off = change.rendered - change.predicted
    given = precision @ off / np.sqrt(np.diag(precision))
    places = [change.group.coordinates[k] for k in change.numbers.tolist()]
    for place, *row in zip(
        places, change.predicted, change.rendered, error, off / error, given, strict=True
    ):
        yield Number(place, *(float(each) for each in row))
