"""Fit mean resonances with the elastic reed and chosen effects."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.inference.estimation import MapEstimate, fit, random_starts, residual_covariance
from diagnosis.inference.problem import LocatedEffect
from diagnosis.mean_reed import MeanReed
from fitting.forward import cents_of
from holography.arrays import Array
from physics.effects.effect import Effect, Parameter
from physics.errors import ImpossibleReedError
from physics.mechanics import Mechanics, ReedSolver
from physics.parameters.tree import BenchParameters, with_cane
from physics.reed.cane.viscoelastic import ViscoelasticCane, Zener

_SEED = 20_080_401
_DRAWS = 2000
_STARTS = 2
# Misfit with which parameters are searched for.
_SEARCH_CENTS = 20.0
# Misfits that neither model nor effect explains, cents; equally likely on a logarithmic scale.
_MISFITS_CENTS = np.geomspace(1.0, 100.0, 13)
_MODULI = ("E_L", "G_LT")

# Moduli of either series are expected within a third of those of the reference material.
_MODULI_SPREAD = 0.3


@dataclass(frozen=True)
class FittedSize:
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
class ResonanceFit:
    """Fit of the elastic reed with chosen effects.

    Attributes
    ----------
    effects : tuple of str
        None of them is the elastic reed.
    sizes : tuple of FittedSize
    rms_cents : dict of float
        What is left, per series.
    explained, explained_low, explained_high : float
        Fraction of the gap that is explained where the mode was left out of the fit, and its
        95 % interval over modes.
    explained_other_series : dict of float
        The same in each series with sizes from the other one; empty if there is one series only.
    log_bayes : float
        Log odds against the elastic reed, in nats.
    converged : bool
    moduli_pa : dict
        E_L and G_LT, per series.
    """

    effects: tuple[str, ...]
    sizes: tuple[FittedSize, ...]
    rms_cents: dict[str, float]
    explained: float
    explained_low: float
    explained_high: float
    explained_other_series: dict[str, float]
    log_bayes: float
    converged: bool
    moduli_pa: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class ResonanceProblem:
    """Data, and the elastic reed with chosen effects as their model.

    Attributes
    ----------
    reeds : tuple of MeanReed
    reed_solver : ReedSolver
    effects : tuple of LocatedEffect
    floor_cents : (n,) float
    """

    reeds: tuple[MeanReed, ...]
    reed_solver: ReedSolver
    effects: tuple[LocatedEffect, ...]
    floor_cents: Array

    @property
    def sizes(self) -> list[tuple[Effect, Parameter]]:
        """Of all effects, each with its own."""
        return [(located.effect, p) for located in self.effects for p in located.sizes]

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
            modes = self.reed_solver.modes(self.parameters(z, s).reed)
            missing = [name for name in reed.modes if name not in modes]
            if missing:
                raise ImpossibleReedError(f"a reed of this kind has no mode {missing[0]}")
            parts.append(cents_of(np.array([modes[name].hz for name in reed.modes])))
        return np.concatenate(parts)

    def parameters(self, z: Array, series: int) -> BenchParameters:
        """Elastic reed of a series with all effects."""
        parameters = elastic_parameters(self.reed_solver)
        moduli = _MODULI_SPREAD * z[len(_MODULI) * series :][: len(_MODULI)]
        parameters = with_cane(parameters, **dict(zip(_MODULI, moduli.tolist(), strict=True)))
        rest = z[len(_MODULI) * len(self.reeds) :]
        for located in self.effects:
            own, rest = rest[: len(located.sizes)], rest[len(located.sizes) :]
            parameters = located.change(parameters, own)
        return parameters


def elastic_parameters(reed_solver: ReedSolver) -> BenchParameters:
    """The reed of reference material, whose moduli do not depend on frequency."""
    cane = reed_solver.reed.cane
    springs = (Zener(1e-6 * modulus, 0.0, 0.0) for modulus in (cane.E_L_pa, cane.G_LT_pa))
    return BenchParameters(reed=Mechanics(cane=ViscoelasticCane(*springs)))


@dataclass(frozen=True)
class FittedReed:
    """A model at its best parameters, and how it goes on from there.

    Attributes
    ----------
    problem : ResonanceProblem
    estimate : MapEstimate
        With the misfit of the search.
    residual_cents : (n,) float
        Data less model, cents.
    jacobian_cents : (n, p) float
        Cents per unit of the priors.
    """

    problem: ResonanceProblem
    estimate: MapEstimate
    residual_cents: Array
    jacobian_cents: Array

    @classmethod
    def of(cls, problem: ResonanceProblem) -> "FittedReed":
        """Fit a problem, from several starts."""
        deviation = np.hypot(problem.floor_cents, _SEARCH_CENTS)

        def residuals(z: Array) -> Array:
            left: Array = (problem.predicted(z) - problem.cents) / deviation
            return left

        starts = random_starts(_STARTS, problem.positive, np.random.default_rng(_SEED))
        estimate = fit(residuals, problem.positive, starts)
        left = -estimate.residuals * deviation
        return cls(problem, estimate, left, estimate.jacobian * deviation[:, None])

    def linear(self, excess_scatter_cents: float) -> MapEstimate:
        """Refit the linearised model with another misfit."""
        return fit_linear(
            self.residual_cents,
            self.jacobian_cents,
            self.estimate.z,
            np.hypot(self.problem.floor_cents, excess_scatter_cents),
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

    def held_out(self, excess_scatter_cents: float) -> Array:
        """What is left (n,) of each mode, in cents, if it is left out of all series."""
        deviation = np.hypot(self.problem.floor_cents, excess_scatter_cents)
        estimate = self.linear(excess_scatter_cents)
        bound = np.asarray(self.problem.positive) & (estimate.z <= 0)
        J = estimate.jacobian[:, ~bound]
        names = [name for reed in self.problem.reeds for name in reed.modes]
        return -_left_out(J, estimate.residuals, names) * deviation

    def summary(self, elastic: "FittedReed") -> ResonanceFit:
        """Return the fit compared with the elastic reed."""
        problem, count = self.problem, len(_MODULI) * len(self.problem.reeds)
        own, misfit = self.over_misfits()
        reference, reference_misfit = elastic.over_misfits()
        at = self.linear(misfit)
        errors = np.sqrt(np.diag(at.covariance))
        sizes = tuple(
            FittedSize(effect.id, p.name, p.unit, p.spread * z, p.spread * error, z)
            for (effect, p), z, error in zip(
                problem.sizes, at.z[count:].tolist(), errors[count:].tolist(), strict=True
            )
        )
        before = elastic.held_out(reference_misfit) / problem.floor_cents
        after = self.held_out(misfit) / problem.floor_cents
        names = [name for reed in problem.reeds for name in reed.modes]
        kappa, low, high = _explained(before, after, names)
        left = -at.residuals * np.hypot(problem.floor_cents, misfit)
        return ResonanceFit(
            effects=tuple(located.effect.id for located in problem.effects),
            sizes=sizes,
            rms_cents=_rms(problem, left),
            explained=kappa,
            explained_low=low,
            explained_high=high,
            explained_other_series=_transferred(self, elastic, misfit, reference_misfit),
            log_bayes=own - reference,
            converged=self.estimate.converged,
            moduli_pa=_moduli_pa(problem, at.z),
        )


def fit_linear(
    left: Array, slope: Array, z: Array, deviation: Array, positive: Sequence[bool]
) -> MapEstimate:
    """Best parameters where what is left (n,) at z changes along slopes (n, p)."""
    whitened = slope / deviation[:, None]
    start = -left / deviation
    return fit(lambda at: start + whitened @ (at - z), positive, [z], lambda _at: whitened)


def _left_out(jacobian: Array, residuals: Array, names: Sequence[str]) -> Array:
    """Whitened residuals (n,) of all data of a name if they are left out, exact where linear."""
    answer = np.empty_like(residuals)
    for name in set(names):
        block = np.flatnonzero([other == name for other in names])
        answer[block] = np.linalg.solve(residual_covariance(jacobian, block), residuals[block])
    return answer


def _explained(before: Array, after: Array, names: Sequence[str]) -> tuple[float, float, float]:
    """Return the explained fraction, and its 95 % interval over modes.

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


def _rms(problem: ResonanceProblem, left: Array) -> dict[str, float]:
    starts = np.cumsum([0, *(len(reed.cents) for reed in problem.reeds)])
    return {
        reed.series.value: float(np.sqrt(np.mean(left[a:b] ** 2)))
        for reed, a, b in zip(problem.reeds, starts, starts[1:], strict=False)
    }


def _moduli_pa(problem: ResonanceProblem, z: Array) -> dict[str, tuple[float, float]]:
    cane = problem.reed_solver.reed.cane
    answer = {}
    for s, reed in enumerate(problem.reeds):
        E, G = np.exp(_MODULI_SPREAD * z[len(_MODULI) * s :][: len(_MODULI)])
        answer[reed.series.value] = float(cane.E_L_pa * E), float(cane.G_LT_pa * G)
    return answer


def _transferred(
    trial: FittedReed, elastic: FittedReed, excess_scatter_cents: float, reference_cents: float
) -> dict[str, float]:
    """Return the fraction explained in each series with the sizes of the other series."""
    problem = trial.problem
    if len(problem.reeds) < 2 or not problem.effects:
        return {}
    starts = np.cumsum([0, *(len(reed.cents) for reed in problem.reeds)])
    count, answer = len(_MODULI), {}
    for s, reed in enumerate(problem.reeds):
        here = np.arange(starts[s], starts[s + 1])
        there = np.setdiff1d(np.arange(starts[-1]), here)
        moduli = np.arange(count * s, count * (s + 1))
        learnt = fit_linear(
            trial.residual_cents[there],
            trial.jacobian_cents[there],
            trial.estimate.z,
            np.hypot(problem.floor_cents[there], excess_scatter_cents),
            problem.positive,
        )
        effects = np.arange(count * len(problem.reeds), len(learnt.z))
        carried = (
            trial.jacobian_cents[np.ix_(here, effects)] @ (learnt.z - trial.estimate.z)[effects]
        )
        gaps = []
        for fitted, left, misfit in (
            (elastic, elastic.residual_cents[here], reference_cents),
            (trial, trial.residual_cents[here] - carried, excess_scatter_cents),
        ):
            deviation = np.hypot(problem.floor_cents[here], misfit)
            start_z = fitted.estimate.z[moduli]
            at = fit_linear(
                left,
                fitted.jacobian_cents[np.ix_(here, moduli)],
                start_z,
                deviation,
                [False] * count,
            )
            out = _left_out(at.jacobian, at.residuals, reed.modes) * deviation
            gaps.append(float(np.mean((out / problem.floor_cents[here]) ** 2)) - 1)
        answer[reed.series.value] = (gaps[0] - gaps[1]) / gaps[0] if gaps[0] > 0 else float("nan")
    return answer
