"""Compare what an effect changes in rendered numbers with what the model predicts.

Numbers of a campaign with an effect, and those of the same campaign without it, are each compared
with the prediction from the parameters that the bench played. What both have in common, noise of
one seed and errors of the method, cancels in the difference. The errors are those that the
diagnosis states for a number of the campaign with the effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.observable_groups import Coordinates, ObservableGroup
from diagnosis.observe import observable_groups
from holography.arrays import Array
from physics.mechanics import ReedSolver
from studies.closure.measuring import Measured

# A pull beyond this many standard errors does not close. Chosen: one of 400 numbers without a
# defect is beyond 3; most noise cancels, so that far fewer are.
LIMIT = 3.0
# An effect whose predicted change of a group is below this many standard errors is not tested by
# it. Chosen: then the group could not tell the effect from its absence with three to one.
TESTED = 2.0


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
        The same in units of the error that is left when all other numbers of the group are known,
        and less what these make it expect: errors that numbers have in common do not count.
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
        Predicted change in standard errors, of all numbers together.
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
        """Root mean square of the pulls of all numbers, given the others of their group."""
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
    closures, lost = [], sorted(after.keys() ^ before.keys())
    for name in after.keys() & before.keys():
        pairs = _pairs(after[name].coordinates, before[name].coordinates)
        missing = len(after[name].values) + len(before[name].values) - 2 * len(pairs)
        if missing:
            lost.append(f"{missing} numbers of {name}")
        if pairs:
            closures.append(_closure(after[name], before[name], pairs, with_it, without))
    order = {name: number for number, name in enumerate(after)}
    closures.sort(key=lambda group: order[group.name])
    return EffectClosure(effect, sizes, tuple(closures), tuple(lost))


def _pairs(one: Sequence[Coordinates], two: Sequence[Coordinates]) -> list[tuple[int, int]]:
    """Return the positions of numbers that both have; those of equal coordinates in their order.

    Some quantities are named by a measured level, such as the linearity of a sensor: where all else
    is equal, numbers correspond by their position.
    """
    if [replace(place, quantity="") for place in one] == [
        replace(place, quantity="") for place in two
    ]:
        return [(k, k) for k in range(len(one))]
    left = dict(enumerate(two))
    pairs = []
    for first, place in enumerate(one):
        second = next((k for k, other in left.items() if other == place), None)
        if second is not None:
            del left[second]
            pairs.append((first, second))
    return pairs


def _closure(
    after: ObservableGroup,
    before: ObservableGroup,
    pairs: Sequence[tuple[int, int]],
    with_it: Measured,
    without: Measured,
) -> GroupClosure:
    one, two = np.array(pairs).T
    predicted = after.predict(with_it.parameters)[one] - before.predict(without.parameters)[two]
    rendered = after.values[one] - before.values[two]
    covariance = after.covariance[np.ix_(one, one)]
    root = np.linalg.cholesky(covariance)
    white, signature = (np.linalg.solve(root, each) for each in (rendered - predicted, predicted))
    numbers = _numbers([after.coordinates[k] for k in one], predicted, rendered, covariance)
    square = float(signature @ signature)
    return GroupClosure(
        name=after.name,
        observable=str(after.tap),
        numbers=numbers,
        significance=float(np.sqrt(square)),
        scale=1 + float(signature @ white) / square if square else np.nan,
        scale_error=1 / float(np.sqrt(square)) if square else np.inf,
        rms_pull=float(np.sqrt(np.mean(white**2))),
    )


def _numbers(
    places: Sequence[Coordinates], predicted: Array, rendered: Array, covariance: Array
) -> tuple[Number, ...]:
    error = np.sqrt(np.diag(covariance))
    precision = np.linalg.inv(covariance)
    off = rendered - predicted
    given = precision @ off / np.sqrt(np.diag(precision))
    return tuple(
        Number(place, *(float(each) for each in row))
        for place, *row in zip(places, predicted, rendered, error, off / error, given, strict=True)
    )
