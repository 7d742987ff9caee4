"""Resonances without a run: which effects take the elastic reed to them, and which cannot be told.

The elastic reed has two moduli per series, E_L and G_LT, and nothing else that is free. Effects
are added to it, alone and together, with parameters that all series share. What no effect explains
is a misfit of unknown size, which evidence averages over: else the effect that is least wrong would
seem certain.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.estimate import (
    Estimate,
    covariance_left,
    fit,
    random_starts,
)
from diagnosis.likeness import (
    Reach,
    classes_of,
    reach_of,
)
from diagnosis.mean_reed import MeanReed
from diagnosis.rivals import Sized
from diagnosis.screening import places_of
from fitting.forward import cents_of
from physics.effects.effect import Effect, Parameter
from physics.mechanics import Mechanics, ReedSolver
from physics.reed.viscoelastic import ViscoelasticCane, Zener
from physics.twin import Twin, with_cane

Array = NDArray[np.floating[Any]]

# Moduli of either series are expected within a third of those of the reference material.
_MODULI_SPREAD = 0.3
_MODULI = ("E_L", "G_LT")
# Of converged elements beside their limit, modes of the vamp (decision 0009).
MESH_CENTS = 4.0
# What neither model nor effect explains: alike likely on a scale of logarithms.
_MISFITS_CENTS = np.geomspace(1.0, 100.0, 13)
# Misfit with which parameters are searched for.
_SEARCH_CENTS = 20.0
_STARTS = 2
# Sets of as many effects that are fitted without straightening anything.
_SETS = 3
_DRAWS = 2000
_SEED = 20_080_401


@dataclass(frozen=True)
class Size:
    """A parameter of an effect, as fitted.

    Attributes
    ----------
    effect, name, unit : str
    value, error : float
    z : float
        In standard deviations of its prior.
    """

    effect: str
    name: str
    unit: str
    value: float
    error: float
    z: float


@dataclass(frozen=True)
class Trial:
    """What effects together take off the gap.

    Attributes
    ----------
    effects : tuple of str
        None of them is the elastic reed.
    sizes : tuple of Size
    rms_cents : dict of float
        What is left, per series.
    kappa, kappa_low, kappa_high : float
        Share of the explainable gap that is closed where the mode was left out of the fit, and its
        95 % interval over modes.
    kappa_other : dict of float
        The same in each series with sizes from the other one; empty if there is one series only.
    log_bayes : float
        Log of the odds beside the elastic reed, in nats.
    certified : bool
    moduli_pa : dict
        E_L and G_LT, per series.
    """

    effects: tuple[str, ...]
    sizes: tuple[Size, ...]
    rms_cents: dict[str, float]
    kappa: float
    kappa_low: float
    kappa_high: float
    kappa_other: dict[str, float]
    log_bayes: float
    certified: bool
    moduli_pa: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class PublishedDiagnosis:
    """All that resonances without a run tell.

    Attributes
    ----------
    reeds : tuple of MeanReed
    floor_cents : dict of (m,) float
        Errors of data and mesh, per series.
    elastic : Trial
    alone : tuple of Trial
        Every effect by itself, the best first.
    together : tuple of Trial
        The best pairs and triples.
    reach : tuple of Reach
    classes : tuple of tuple of str
        Effects that such data do not tell apart.
    residual_cents : dict of (m,) float
        Data less elastic reed, per series.
    """

    reeds: tuple[MeanReed, ...]
    floor_cents: dict[str, Array]
    elastic: Trial
    alone: tuple[Trial, ...]
    together: tuple[Trial, ...]
    reach: tuple[Reach, ...]
    classes: tuple[tuple[str, ...], ...]
    residual_cents: dict[str, Array]


@dataclass(frozen=True)
class _Problem:
    """Data, and the elastic reed with chosen effects as their model.

    Attributes
    ----------
    reeds : tuple of MeanReed
    reed_solver : ReedSolver
    effects : tuple of Sized
    floor_cents : (n,) float
    """

    reeds: tuple[MeanReed, ...]
    reed_solver: ReedSolver
    effects: tuple[Sized, ...]
    floor_cents: Array

    @property
    def sizes(self) -> list[tuple[Effect, Parameter]]:
        """Of all effects, each with its own."""
        return [(sized.effect, p) for sized in self.effects for p in sized.sizes]

    @property
    def positive(self) -> list[bool]:
        """Which unknowns cannot be negative: two moduli per series, then the effects'."""
        moduli = [False] * (len(_MODULI) * len(self.reeds))
        return [*moduli, *(parameter.positive for _, parameter in self.sizes)]

    @property
    def cents(self) -> Array:
        """Data (n,), one series after the other."""
        return np.concatenate([reed.cents for reed in self.reeds])

    def predicted(self, z: Array) -> Array:
        """Cents (n,) above F6."""
        parts = []
        for s, reed in enumerate(self.reeds):
            modes = self.reed_solver.modes(self.twin(z, s).reed)
            missing = [name for name in reed.modes if name not in modes]
            if missing:
                raise ValueError(f"a reed of this kind has no mode {missing[0]}")
            parts.append(cents_of(np.array([modes[name].hz for name in reed.modes])))
        return np.concatenate(parts)

    def twin(self, z: Array, series: int) -> Twin:
        """Elastic reed of a series with all effects."""
        twin = elastic_twin(self.reed_solver)
        moduli = _MODULI_SPREAD * z[len(_MODULI) * series :][: len(_MODULI)]
        twin = with_cane(twin, **dict(zip(_MODULI, moduli.tolist(), strict=True)))
        rest = z[len(_MODULI) * len(self.reeds) :]
        for sized in self.effects:
            own, rest = rest[: len(sized.sizes)], rest[len(sized.sizes) :]
            twin = sized.change(twin, own)
        return twin


def elastic_twin(reed_solver: ReedSolver) -> Twin:
    """The reed of reference material, whose moduli do not depend on frequency."""
    cane = reed_solver.anatomy.reed.cane
    springs = (Zener(1e-6 * modulus, 0.0, 0.0) for modulus in (cane.E_L_pa, cane.G_LT_pa))
    return Twin(reed=Mechanics(cane=ViscoelasticCane(*springs)))


def diagnose_resonances(
    reeds: Sequence[MeanReed],
    reed_solver: ReedSolver,
    effects: Sequence[Effect],
    progress: Callable[[float], None] | None = None,
    largest_set: int = 3,
) -> PublishedDiagnosis:
    """Find which effects close the gap between resonances and the elastic reed.

    Parameters
    ----------
    reeds : sequence of MeanReed
        One per series.
    reed_solver : ReedSolver
    effects : sequence of Effect
        Those that move no frequency are told to be out of reach.
    progress : callable, optional
        Told the share that is done.
    largest_set : int
        Most effects that are tried together.

    Raises
    ------
    ValueError
        If no reed that can be computed is near the data.
    """
    report = progress or (lambda _share: None)
    errors = np.concatenate([reed.error_cents for reed in reeds])
    base = _Problem(tuple(reeds), reed_solver, (), np.hypot(errors, MESH_CENTS))
    elastic = _Fitted.of(base)
    placed = [_at_its_best(base, elastic, effect) for effect in effects]
    columns = {sized.effect.id: column for sized, column in placed}
    seen = [sized for sized, column in placed if np.any(column)]
    alone = []
    for number, sized in enumerate(seen):
        alone.append(_Fitted.of(replace(base, effects=(sized,))))
        report((1 + number) / (len(seen) + 2 * _SETS))
    together = []
    sets = _best_sets(base, elastic, seen, columns, largest_set)
    for number, chosen in enumerate(sets):
        together.append(_Fitted.of(replace(base, effects=chosen)))
        report((1 + len(seen) + 2 * _SETS * (1 + number) / len(sets)) / (len(seen) + 2 * _SETS + 1))
    starts = np.cumsum([0, *(len(reed.cents) for reed in reeds)])
    names = [reed.series.value for reed in reeds]
    pieces = {name: slice(a, b) for name, a, b in zip(names, starts, starts[1:], strict=False)}
    ranked = sorted((trial.told(elastic) for trial in alone), key=lambda t: -t.log_bayes)
    unexplained = min(fitted.over_misfits()[1] for fitted in (elastic, *alone, *together))
    reach = _reach(base, elastic, effects, columns, unexplained)
    return PublishedDiagnosis(
        reeds=tuple(reeds),
        floor_cents={name: base.floor_cents[piece] for name, piece in pieces.items()},
        elastic=elastic.told(elastic),
        alone=tuple(ranked),
        together=tuple(
            sorted((trial.told(elastic) for trial in together), key=lambda t: -t.log_bayes)
        ),
        reach=reach,
        classes=classes_of(reach),
        residual_cents={name: elastic.left[piece] for name, piece in pieces.items()},
    )


@dataclass(frozen=True)
class _Fitted:
    """A model at its best parameters, and how it goes on from there.

    Attributes
    ----------
    problem : _Problem
    estimate : Estimate
        With the misfit of the search.
    left : (n,) float
        Data less model, cents.
    slope : (n, p) float
        Cents per unit of the priors.
    """

    problem: _Problem
    estimate: Estimate
    left: Array
    slope: Array

    @classmethod
    def of(cls, problem: _Problem) -> "_Fitted":
        """Fit a problem, from several starts."""
        deviation = np.hypot(problem.floor_cents, _SEARCH_CENTS)

        def residuals(z: Array) -> Array:
            left: Array = (problem.predicted(z) - problem.cents) / deviation
            return left

        starts = random_starts(_STARTS, problem.positive, np.random.default_rng(_SEED))
        estimate = fit(residuals, problem.positive, starts)
        left = -estimate.residuals * deviation
        return cls(problem, estimate, left, estimate.jacobian * deviation[:, None])

    def linear(self, misfit_cents: float) -> Estimate:
        """Fit anew with another misfit, along the slopes."""
        return _linear(
            self.left,
            self.slope,
            self.estimate.z,
            np.hypot(self.problem.floor_cents, misfit_cents),
            self.problem.positive,
        )

    def over_misfits(self) -> tuple[float, float]:
        """Log evidence averaged over misfits, and the likeliest misfit in cents."""
        logs = []
        for misfit in _MISFITS_CENTS:
            deviation = np.hypot(self.problem.floor_cents, misfit)
            logs.append(self.linear(misfit).log_evidence - float(np.sum(np.log(deviation))))
        highest = max(logs)
        average = highest + float(np.log(np.mean(np.exp(np.array(logs) - highest))))
        return average, float(_MISFITS_CENTS[int(np.argmax(logs))])

    def held_out(self, misfit_cents: float) -> Array:
        """What is left (n,) of each mode, in cents, if it is left out of all series."""
        deviation = np.hypot(self.problem.floor_cents, misfit_cents)
        estimate = self.linear(misfit_cents)
        bound = np.asarray(self.problem.positive) & (estimate.z <= 0)
        J = estimate.jacobian[:, ~bound]
        names = [name for reed in self.problem.reeds for name in reed.modes]
        return -_left_out(J, estimate.residuals, names) * deviation

    def told(self, elastic: "_Fitted") -> Trial:
        """Trial beside the elastic reed."""
        problem, count = self.problem, len(_MODULI) * len(self.problem.reeds)
        own, misfit = self.over_misfits()
        reference, reference_misfit = elastic.over_misfits()
        at = self.linear(misfit)
        errors = np.sqrt(np.diag(at.covariance))
        sizes = tuple(
            Size(effect.id, p.name, p.unit, p.spread * z, p.spread * error, z)
            for (effect, p), z, error in zip(
                problem.sizes, at.z[count:].tolist(), errors[count:].tolist(), strict=True
            )
        )
        before = elastic.held_out(reference_misfit) / problem.floor_cents
        after = self.held_out(misfit) / problem.floor_cents
        names = [name for reed in problem.reeds for name in reed.modes]
        kappa, low, high = _kappa(before, after, names)
        left = -at.residuals * np.hypot(problem.floor_cents, misfit)
        return Trial(
            effects=tuple(sized.effect.id for sized in problem.effects),
            sizes=sizes,
            rms_cents=_rms(problem, left),
            kappa=kappa,
            kappa_low=low,
            kappa_high=high,
            kappa_other=_transferred(self, elastic, misfit, reference_misfit),
            log_bayes=own - reference,
            certified=self.estimate.certified,
            moduli_pa=_moduli_pa(problem, at.z),
        )


def _linear(
    left: Array, slope: Array, z: Array, deviation: Array, positive: Sequence[bool]
) -> Estimate:
    """Best parameters where what is left (n,) at z changes along slopes (n, p)."""
    whitened = slope / deviation[:, None]
    start = -left / deviation
    return fit(lambda at: start + whitened @ (at - z), positive, [z], lambda _at: whitened)


def _left_out(jacobian: Array, residuals: Array, names: Sequence[str]) -> Array:
    """Whitened residuals (n,) of all data of a name if they are left out, exact where linear."""
    answer = np.empty_like(residuals)
    for name in set(names):
        block = np.flatnonzero([other == name for other in names])
        answer[block] = np.linalg.solve(covariance_left(jacobian, block), residuals[block])
    return answer


def _kappa(before: Array, after: Array, names: Sequence[str]) -> tuple[float, float, float]:
    """Share of the explainable gap that is closed, and its 95 % interval over modes.

    Parameters
    ----------
    before, after : (n,) float
        Left out, in units of the floor.
    names : sequence of str
        Modes, drawn whole.
    """

    def closed(weight: Array) -> float:
        gaps = [float(weight @ part**2 / weight.sum()) - 1 for part in (before, after)]
        return (gaps[0] - gaps[1]) / gaps[0] if gaps[0] > 0 else float("nan")

    modes, which = np.unique(names, return_inverse=True)
    rng = np.random.default_rng(_SEED)
    drawn = rng.multinomial(len(modes), np.full(len(modes), 1 / len(modes)), size=_DRAWS)
    kappas = np.array([closed(counts[which].astype(float)) for counts in drawn])
    low, high = np.nanpercentile(kappas, [2.5, 97.5]) if np.any(kappas == kappas) else [np.nan] * 2
    return closed(np.ones(len(before))), float(low), float(high)


def _rms(problem: _Problem, left: Array) -> dict[str, float]:
    starts = np.cumsum([0, *(len(reed.cents) for reed in problem.reeds)])
    return {
        reed.series.value: float(np.sqrt(np.mean(left[a:b] ** 2)))
        for reed, a, b in zip(problem.reeds, starts, starts[1:], strict=False)
    }


def _moduli_pa(problem: _Problem, z: Array) -> dict[str, tuple[float, float]]:
    cane = problem.reed_solver.anatomy.reed.cane
    answer = {}
    for s, reed in enumerate(problem.reeds):
        E, G = np.exp(_MODULI_SPREAD * z[len(_MODULI) * s :][: len(_MODULI)])
        answer[reed.series.value] = float(cane.E_L_pa * E), float(cane.G_LT_pa * G)
    return answer


def _transferred(
    trial: _Fitted, elastic: _Fitted, misfit_cents: float, reference_cents: float
) -> dict[str, float]:
    """Share of the gap closed in each series with sizes that only the other series has told."""
    problem = trial.problem
    if len(problem.reeds) < 2 or not problem.effects:
        return {}
    starts = np.cumsum([0, *(len(reed.cents) for reed in problem.reeds)])
    count, answer = len(_MODULI), {}
    for s, reed in enumerate(problem.reeds):
        here = np.arange(starts[s], starts[s + 1])
        there = np.setdiff1d(np.arange(starts[-1]), here)
        moduli = np.arange(count * s, count * (s + 1))
        learnt = _linear(
            trial.left[there],
            trial.slope[there],
            trial.estimate.z,
            np.hypot(problem.floor_cents[there], misfit_cents),
            problem.positive,
        )
        effects = np.arange(count * len(problem.reeds), len(learnt.z))
        carried = trial.slope[np.ix_(here, effects)] @ (learnt.z - trial.estimate.z)[effects]
        gaps = []
        for fitted, left, misfit in (
            (elastic, elastic.left[here], reference_cents),
            (trial, trial.left[here] - carried, misfit_cents),
        ):
            deviation = np.hypot(problem.floor_cents[here], misfit)
            start_z = fitted.estimate.z[moduli]
            at = _linear(
                left, fitted.slope[np.ix_(here, moduli)], start_z, deviation, [False] * count
            )
            out = _left_out(at.jacobian, at.residuals, reed.modes) * deviation
            gaps.append(float(np.mean((out / problem.floor_cents[here]) ** 2)) - 1)
        answer[reed.series.value] = (gaps[0] - gaps[1]) / gaps[0] if gaps[0] > 0 else float("nan")
    return answer


def _at_its_best(base: _Problem, elastic: _Fitted, effect: Effect) -> tuple[Sized, Array]:
    """An effect at its likeliest place, and what its sizes move there."""
    deviation = np.hypot(base.floor_cents, 0.5 * elastic.over_misfits()[1])
    found = [(sized, _signature(base, elastic.estimate.z, sized)) for sized in places_of(effect)]
    if len(found) == 1:
        return found[0]
    return max(found, key=lambda at: _evidence(base, elastic, (at[0],), [at[1]], deviation))


def _signature(base: _Problem, z: Array, sized: Sized) -> Array:
    """Cents (n, k) per prior deviation of each of an effect's k sizes, at the elastic fit."""
    # Far enough that rounding does not count, near enough to be straight.
    step, here = 0.05, base.predicted(z)
    problem, columns = replace(base, effects=(sized,)), []
    for number in range(len(sized.sizes)):
        unit = np.zeros(len(sized.sizes))
        unit[number] = step
        columns.append((problem.predicted(np.append(z, unit)) - here) / step)
    return np.stack(columns, axis=1)


def _evidence(
    base: _Problem,
    elastic: _Fitted,
    effects: tuple[Sized, ...],
    columns: Sequence[Array],
    deviation: Array,
) -> float:
    """Log evidence of effects along their signatures (n, k)."""
    slope = np.hstack([elastic.slope, *columns])
    z = np.append(elastic.estimate.z, np.zeros(slope.shape[1] - elastic.slope.shape[1]))
    positive = replace(base, effects=effects).positive
    return _linear(elastic.left, slope, z, deviation, positive).log_evidence


def _reach(
    base: _Problem,
    elastic: _Fitted,
    effects: Sequence[Effect],
    columns: Mapping[str, Array],
    misfit_cents: float,
) -> tuple[Reach, ...]:
    """What such data could tell of effects beside a misfit that none of them explains."""
    deviation = np.hypot(base.floor_cents, misfit_cents)
    moduli, _ = np.linalg.qr(elastic.slope / deviation[:, None])
    whole = {name: column / deviation[:, None] for name, column in columns.items()}
    left = {name: column - moduli @ (moduli.T @ column) for name, column in whole.items()}
    return reach_of(effects, {name: (whole[name], left[name]) for name in whole})


def _best_sets(
    base: _Problem,
    elastic: _Fitted,
    effects: Sequence[Sized],
    columns: Mapping[str, Array],
    largest: int,
) -> list[tuple[Sized, ...]]:
    """Best few sets of two effects, of three, and so on, along the slopes at the elastic reed."""
    _, misfit = elastic.over_misfits()
    # What a set leaves is less than what the elastic reed leaves.
    deviation = np.hypot(base.floor_cents, 0.5 * misfit)
    answer: list[tuple[Sized, ...]] = []
    for size in range(2, largest + 1):
        ranked = []
        for chosen in combinations(effects, size):
            own = [columns[sized.effect.id] for sized in chosen]
            ranked.append((_evidence(base, elastic, chosen, own, deviation), chosen))
        ranked.sort(key=lambda entry: -entry[0])
        answer += [chosen for _, chosen in ranked[:_SETS]]
    return answer
