"""Diagnose mean resonances: which effects make the elastic reed agree with them.

The elastic reed has two free moduli in each series, E_L and G_LT. Effects are added to it, alone
and together, with sizes that all series share. What no effect explains is a misfit of unknown
size, over which the evidence is averaged: otherwise the least wrong effect would seem certain.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from diagnosis.inference.effect_scan import locations_of
from diagnosis.inference.problem import LocatedEffect
from diagnosis.inference.similarity import Detectability, confusable_classes, detectability_of
from diagnosis.mean_reed import MeanReed
from diagnosis.resonance_fit import FittedReed, ResonanceFit, ResonanceProblem, fit_linear
from holography.arrays import Array
from physics.effects.effect import Effect
from physics.mechanics import ReedSolver

# Sets of as many effects that are fitted without straightening anything.
_SETS = 3
# Difference of converged elements from their limit, modes of the vamp (decision 0009).
MESH_CENTS = 4.0


@dataclass(frozen=True)
class ResonanceDiagnosis:
    """The answer of a diagnosis of resonances.

    Attributes
    ----------
    reeds : tuple of MeanReed
    floor_cents : dict of (m,) float
        Errors of data and mesh, per series.
    elastic : ResonanceFit
    single : tuple of ResonanceFit
        Every effect by itself, the best first.
    together : tuple of ResonanceFit
        The best pairs and triples.
    detectability : tuple of Detectability
    classes : tuple of tuple of str
        Groups of effects that such data cannot separate.
    residual_cents : dict of (m,) float
        Data less elastic reed, per series.
    """

    reeds: tuple[MeanReed, ...]
    floor_cents: dict[str, Array]
    elastic: ResonanceFit
    single: tuple[ResonanceFit, ...]
    together: tuple[ResonanceFit, ...]
    detectability: tuple[Detectability, ...]
    classes: tuple[tuple[str, ...], ...]
    residual_cents: dict[str, Array]


def diagnose_resonances(
    reeds: Sequence[MeanReed],
    reed_solver: ReedSolver,
    effects: Sequence[Effect],
    progress: Callable[[float], None] | None = None,
    largest_set: int = 3,
) -> ResonanceDiagnosis:
    """Find which effects close the gap between resonances and the elastic reed.

    Parameters
    ----------
    reeds : sequence of MeanReed
        One per series.
    reed_solver : ReedSolver
    effects : sequence of Effect
        Those without influence on frequencies are reported as undetectable.
    progress : callable, optional
        Called with the fraction that is done.
    largest_set : int
        Most effects that are tried together.

    Raises
    ------
    ImpossibleReedError
        If no reed that can be computed is near the data.
    """
    report = progress or (lambda _share: None)
    errors = np.concatenate([reed.error_cents for reed in reeds])
    base = ResonanceProblem(tuple(reeds), reed_solver, (), np.hypot(errors, MESH_CENTS))
    elastic = FittedReed.of(base)
    placed = [_at_its_best(base, elastic, effect) for effect in effects]
    columns = {located.effect.id: column for located, column in placed}
    seen = [located for located, column in placed if np.any(column)]
    alone = []
    for number, located in enumerate(seen):
        alone.append(FittedReed.of(replace(base, effects=(located,))))
        report((1 + number) / (len(seen) + 2 * _SETS))
    together = []
    sets = _best_sets(base, elastic, seen, columns, largest_set)
    for number, chosen in enumerate(sets):
        together.append(FittedReed.of(replace(base, effects=chosen)))
        report((1 + len(seen) + 2 * _SETS * (1 + number) / len(sets)) / (len(seen) + 2 * _SETS + 1))
    starts = np.cumsum([0, *(len(reed.cents) for reed in reeds)])
    names = [reed.series.value for reed in reeds]
    pieces = {name: slice(a, b) for name, a, b in zip(names, starts, starts[1:], strict=False)}
    ranked = sorted((trial.summary(elastic) for trial in alone), key=lambda t: -t.log_bayes)
    unexplained = min(fitted.over_misfits()[1] for fitted in (elastic, *alone, *together))
    reach = _reach(base, elastic, effects, columns, unexplained)
    return ResonanceDiagnosis(
        reeds=tuple(reeds),
        floor_cents={name: base.floor_cents[piece] for name, piece in pieces.items()},
        elastic=elastic.summary(elastic),
        single=tuple(ranked),
        together=tuple(
            sorted((trial.summary(elastic) for trial in together), key=lambda t: -t.log_bayes)
        ),
        detectability=reach,
        classes=confusable_classes(reach),
        residual_cents={name: elastic.residual_cents[piece] for name, piece in pieces.items()},
    )


def _at_its_best(
    base: ResonanceProblem, elastic: FittedReed, effect: Effect
) -> tuple[LocatedEffect, Array]:
    """Return an effect at its likeliest location, and its signature there."""
    deviation = np.hypot(base.floor_cents, 0.5 * elastic.over_misfits()[1])
    found = [
        (located, _signature(base, elastic.estimate.z, located)) for located in locations_of(effect)
    ]
    if len(found) == 1:
        return found[0]
    return max(found, key=lambda at: _evidence(base, elastic, (at[0],), [at[1]], deviation))


def _signature(base: ResonanceProblem, z: Array, located: LocatedEffect) -> Array:
    """Cents (n, k) per prior deviation of each of an effect's k sizes, at the elastic fit."""
    # Large compared with rounding, small compared with the curvature.
    step, here = 0.05, base.predicted(z)
    problem, columns = replace(base, effects=(located,)), []
    for number in range(len(located.sizes)):
        unit = np.zeros(len(located.sizes))
        unit[number] = step
        columns.append((problem.predicted(np.append(z, unit)) - here) / step)
    return np.stack(columns, axis=1)


def _evidence(
    base: ResonanceProblem,
    elastic: FittedReed,
    effects: tuple[LocatedEffect, ...],
    columns: Sequence[Array],
    deviation: Array,
) -> float:
    """Log evidence of effects along their signatures (n, k)."""
    slope = np.hstack([elastic.jacobian_cents, *columns])
    z = np.append(elastic.estimate.z, np.zeros(slope.shape[1] - elastic.jacobian_cents.shape[1]))
    positive = replace(base, effects=effects).positive
    return fit_linear(elastic.residual_cents, slope, z, deviation, positive).log_evidence


def _reach(
    base: ResonanceProblem,
    elastic: FittedReed,
    effects: Sequence[Effect],
    columns: Mapping[str, Array],
    excess_scatter_cents: float,
) -> tuple[Detectability, ...]:
    """Return how well such data detect effects, given a misfit that none explains."""
    deviation = np.hypot(base.floor_cents, excess_scatter_cents)
    moduli, _ = np.linalg.qr(elastic.jacobian_cents / deviation[:, None])
    whole = {name: column / deviation[:, None] for name, column in columns.items()}
    left = {name: column - moduli @ (moduli.T @ column) for name, column in whole.items()}
    return detectability_of(effects, {name: (whole[name], left[name]) for name in whole})


def _best_sets(
    base: ResonanceProblem,
    elastic: FittedReed,
    effects: Sequence[LocatedEffect],
    columns: Mapping[str, Array],
    largest: int,
) -> list[tuple[LocatedEffect, ...]]:
    """Best few sets of two effects, of three, and so on, along the slopes at the elastic reed."""
    _, misfit = elastic.over_misfits()
    # What a set leaves is less than what the elastic reed leaves.
    deviation = np.hypot(base.floor_cents, 0.5 * misfit)
    answer: list[tuple[LocatedEffect, ...]] = []
    for size in range(2, largest + 1):
        ranked = []
        for chosen in combinations(effects, size):
            own = [columns[located.effect.id] for located in chosen]
            ranked.append((_evidence(base, elastic, chosen, own, deviation), chosen))
        ranked.sort(key=lambda entry: -entry[0])
        answer += [chosen for _, chosen in ranked[:_SETS]]
    return answer
