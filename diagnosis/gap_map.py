"""Gap map: where a campaign and the nominal model differ, in units of the standard uncertainty.

The gap of a number is measurement less model, with nothing fitted; its floor is the standard
uncertainty of validation of ASME V&V 20: of data, numerics and inputs. A gap below the floor is not
resolvable, which does not mean that measurement and model agree.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from diagnosis.inference.estimation import absorbed_part
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Observable, ObservableGroup
from holography.arrays import Array

AXES = ("quantity", "mode", "band", "region", "time", "level")
# A cell is resolvable if chance makes as much in a smaller fraction of campaigns. Chosen, as for a
# significant test.
_CHANCE = 0.01


@dataclass(frozen=True)
class GapCell:
    """Some numbers of one observable.

    Attributes
    ----------
    observable : Observable
    group : str
    axis, label : str
        Coordinate that these numbers have in common, and its value.
    count : int
    gap : float
        Root mean square in units of the floor.
    chance : float
        Probability of as large a gap by chance.
    """

    observable: Observable
    group: str
    axis: str
    label: str
    count: int
    gap: float
    chance: float

    @property
    def resolvable(self) -> bool:
        """Whether the gap is above its floor and not due to chance."""
        return self.gap > 1 and self.chance < _CHANCE


@dataclass(frozen=True)
class LadderStep:
    """Fraction of the gap that one observable adds, given the measurement of others.

    Attributes
    ----------
    observable : Observable
    forward, backward : float
        Fraction of the whole gap, given all earlier observables, and given all later ones.
    error : float
        Standard deviation of either, by chance.
    """

    observable: Observable
    forward: float
    backward: float
    error: float


@dataclass(frozen=True)
class GapMap:
    """All cells of a campaign.

    Attributes
    ----------
    cells : tuple of GapCell
        Of every coordinate, and of whole blocks (axis ``observable_group``).
    observables : dict of GapCell
        For each observable the cell that chance explains least, with the chance that any cell of
        any observable is as far off.
    ladder : tuple of LadderStep
        In the order of the measuring chain; fractions add up to 1 either way. Empty if the
        whole gap is not resolvable.
    """

    cells: tuple[GapCell, ...]
    observables: dict[Observable, GapCell]
    ladder: tuple[LadderStep, ...]

    @property
    def first_failing(self) -> Observable | None:
        """First observable in the measuring chain at which measurement and model differ."""
        failing = (tap for tap, worst in self.observables.items() if worst.chance < _CHANCE)
        return next(failing, None)


def gap_map(problem: InferenceProblem) -> GapMap:
    """Compare every number with the nominal model."""
    nothing = np.zeros(len(problem.nuisances))
    left = problem.residuals(problem.parameters(nothing))
    # Here, not where other fits have been.
    slope = problem.jacobian(nothing)
    cells: list[GapCell] = []
    rows: dict[Observable, list[int]] = {}
    for block in problem.groups:
        piece = problem.slices[block.name]
        lower = np.linalg.inv(block.whitening)
        gap = lower @ left[piece]
        inputs = lower @ slope[piece]
        variance = block.covariance + inputs @ inputs.T
        cells.append(_cell(block, "group", block.name, range(len(gap)), gap, variance))
        rows.setdefault(block.tap, []).extend(range(piece.start, piece.stop))
        for axis in AXES:
            cells += _along(block, axis, gap, variance)
    taps = {}
    for tap in _in_order(rows):
        own = [cell for cell in cells if cell.observable is tap]
        worst = min(own, key=lambda cell: cell.chance)
        taps[tap] = replace(worst, chance=min(1.0, len(rows) * len(own) * worst.chance))
    return GapMap(tuple(cells), taps, tuple(_ladder(left, slope, rows)))


def _in_order(rows: Iterable[Observable]) -> list[Observable]:
    """Observables in the order of the measuring chain."""
    return sorted(rows, key=list(Observable).index)


def _square(left: Array, slope: Array, chosen: Sequence[int]) -> float:
    """Return the squared residual (n,) of some numbers, in units of its floor."""
    own, inputs = left[chosen], slope[chosen]
    return float(own @ (own - absorbed_part(inputs, own)))


def _ladder(
    left: Array, slope: Array, rows: Mapping[Observable, Sequence[int]]
) -> list[LadderStep]:
    """Return what each observable adds to the gap, given all before it, or all after it.

    That is what its numbers are off by once the others have determined the nuisances.
    """
    order = _in_order(rows)
    count = {tap: len(rows[tap]) for tap in order}

    def added(taps: Sequence[Observable]) -> dict[Observable, float]:
        found, total = dict[Observable, float](), 0.0
        chosen: list[int] = []
        for tap in taps:
            chosen += list(rows[tap])
            whole = _square(left, slope, chosen)
            found[tap], total = whole - total, whole
        return found

    steps = added(order), added(order[::-1])
    least = [min(chi2.sf(step[tap], count[tap]) for tap in order) for step in steps]
    if len(order) * max(least) > _CHANCE:
        return []
    # A contribution below its floor is no fraction of a gap.
    forward, backward = ({t: max(step[t] - count[t], 0.0) for t in order} for step in steps)
    gap, back = sum(forward.values()), sum(backward.values())
    return [
        LadderStep(
            tap,
            forward[tap] / gap,
            backward[tap] / back,
            float(np.sqrt(2 * count[tap] + 4 * forward[tap])) / gap,
        )
        for tap in order
    ]


def _along(block: ObservableGroup, axis: str, gap: Array, variance: Array) -> list[GapCell]:
    labels = [getattr(place, axis) for place in block.coordinates]
    names = [name for name in dict.fromkeys(labels) if name]
    if axis != "quantity" and len(names) < 2:
        return []
    return [
        _cell(
            block, axis, name, [k for k, label in enumerate(labels) if label == name], gap, variance
        )
        for name in names
    ]


def _cell(
    block: ObservableGroup,
    axis: str,
    label: str,
    chosen: Sequence[int],
    gap: Array,
    variance: Array,
) -> GapCell:
    at = np.array(list(chosen))
    own = gap[at]
    square = float(own @ np.linalg.solve(variance[np.ix_(at, at)], own))
    chance = float(chi2.sf(square, len(at)))
    return GapCell(
        block.tap, block.name, axis, label, len(at), float(np.sqrt(square / len(at))), chance
    )
