"""Compare what an effect changes in rendered numbers with what the model predicts.

Numbers of a campaign with an effect, and those of the same campaign without it, are each compared
with the prediction from the parameters that the bench played. What both have in common, noise of
one seed and errors of the method, cancels in the difference. The errors are those that the
diagnosis states for a number of the campaign with the effect.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diagnosis.inference.nuisances import of_fits
from diagnosis.observable_groups import Coordinates, ObservableGroup
from diagnosis.observe import observable_groups
from diagnosis.readings.sweeps import common_modes
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
        Rendered change along the predicted one, 1 if both are equal, and its standard error, given
        all other groups; NaN and infinite if no change is predicted.
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
    return EffectClosure(effect, sizes, tuple(_closures(changes)), tuple(lost))


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
    fit_bias : (n, p) float
        By what biases of the fit, each of one standard deviation, would change the numbers.
    """

    group: ObservableGroup
    numbers: NDArray[np.intp]
    predicted: Array
    rendered: Array
    fit_bias: Array

    @property
    def covariance(self) -> Array:
        """Covariance (n, n) that the group states."""
        chosen: Array = self.group.covariance[np.ix_(self.numbers, self.numbers)]
        return chosen


def _change(
    after: ObservableGroup,
    before: ObservableGroup,
    pairs: Sequence[tuple[int, int]],
    with_it: Measured,
    without: Measured,
) -> _Change:
    one, two = np.array(pairs).T
    expected, sweeps = after.predict(with_it.parameters), with_it.readings.sweeps
    columns = [
        after.predict(bias.change(with_it.parameters, bias.spread)) - expected
        for bias in (of_fits(common_modes(sweeps)) if sweeps else ())
        if "fit_bias" in after.parts
    ]
    return _Change(
        after,
        one,
        expected[one] - before.predict(without.parameters)[two],
        after.values[one] - before.values[two],
        np.stack(columns, axis=1)[one] if columns else np.zeros((len(one), 0)),
    )


def _closures(changes: Sequence[_Change]) -> Iterator[GroupClosure]:
    """Yield the closure of each group, given all others.

    A fit may exchange a part of a mode for a part of the drive: groups have this bias in common,
    and those of the drive show how large it is.
    """
    biases = max((change.fit_bias.shape[1] for change in changes), default=0)
    bias = np.concatenate(
        [np.pad(c.fit_bias, ((0, 0), (0, biases - c.fit_bias.shape[1]))) for c in changes]
    )
    covariance = linalg.block_diag(*(change.covariance for change in changes)) + bias @ bias.T
    precision = np.linalg.inv(covariance)
    off = np.concatenate([change.rendered - change.predicted for change in changes])
    start = 0
    for change in changes:
        here = slice(start, start + len(change.numbers))
        start = here.stop
        signature = change.predicted
        square = float(signature @ precision[here, here] @ signature)
        along = float(signature @ (precision @ off)[here])
        white = np.linalg.solve(np.linalg.cholesky(covariance[here, here]), off[here])
        yield GroupClosure(
            name=change.group.name,
            observable=str(change.group.tap),
            numbers=tuple(_numbers(change, covariance[here, here], (precision @ off)[here],
                                   precision[here, here])),
            significance=float(np.sqrt(square)),
            scale=1 + along / square if square else np.nan,
            scale_error=1 / float(np.sqrt(square)) if square else np.inf,
            rms_pull=float(np.sqrt(np.mean(white**2))),
        )  # fmt: skip


def _numbers(
    change: _Change, covariance: Array, weighted: Array, precision: Array
) -> Iterator[Number]:
    """Yield the numbers of a group; `weighted` are all differences times the precision, here."""
    error = np.sqrt(np.diag(covariance))
    given = weighted / np.sqrt(np.diag(precision))
    off = change.rendered - change.predicted
    places = [change.group.coordinates[k] for k in change.numbers.tolist()]
    for place, *row in zip(
        places, change.predicted, change.rendered, error, off / error, given, strict=True
    ):
        yield Number(place, *(float(each) for each in row))
