"""Screening: a score test of each effect at each location, at the cost of one or two models."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.estimation import (
    absorbed_part,
    marginalised_signature,
    posterior_covariance,
)
from diagnosis.inference.problem import InferenceProblem, LocatedEffect
from holography.arrays import Array
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters

# Sizes at which signatures are taken, in prior standard deviations: the first possible one.
_PROBES = 1.0, 0.2
# Effects that shift whitened numbers by less have no signature.
_LEAST_MOVED = 1e-6
# Searches start within these sizes; positive sizes not below the second.
_FARTHEST, _NEAREST = 6.0, 0.05


def locations_of(effect: Effect) -> Iterator[LocatedEffect]:
    """Yield an effect at all its possible locations."""
    names = [parameter.name for parameter in effect.gridded]
    for at in product(*(parameter.grid for parameter in effect.gridded)):
        yield LocatedEffect(effect, dict(zip(names, at, strict=True)))


def count_locations(effect: Effect) -> int:
    """Return the number of possible locations of an effect."""
    return math.prod(len(parameter.grid) for parameter in effect.gridded)


@dataclass(frozen=True)
class Baseline:
    """The model to which effects are added, fitted or not.

    Attributes
    ----------
    parameters : BenchParameters
    residuals : (n,) float
    jacobian : (n, q) float
        Of all that is free.
    pull : (q,) float
        Half the gradient of the cost along that; 0 where it is fitted.
    deviation : (n,) float
        What residuals and slopes are in units of, whitened.
    """

    parameters: BenchParameters
    residuals: Array
    jacobian: Array
    pull: Array
    deviation: Array

    @classmethod
    def of(cls, problem: InferenceProblem, candidate: Candidate) -> "Baseline":
        """Return the baseline of a fitted candidate."""
        slopes, left = candidate.free_jacobian, candidate.estimate.residuals
        fitted = np.zeros(slopes.shape[1])
        return cls(candidate.parameters(problem), left, slopes, fitted, candidate.deviation)

    @classmethod
    def at(cls, problem: InferenceProblem, z: Array) -> "Baseline":
        """Return the baseline with nuisances z (p,)."""
        parameters, slopes = problem.parameters(z), problem.jacobian(z)
        residuals = problem.residuals(parameters)
        return cls(parameters, residuals, slopes, slopes.T @ residuals + z, np.ones(len(residuals)))


@dataclass(frozen=True)
class ScreenedEffect:
    """An effect at one location, and its score test.

    Attributes
    ----------
    located : LocatedEffect
    gain : float
        Of log evidence.
    sizes : (s,) float
        To begin a search with.
    signature : (n, s) float
        The signature, whitened, per deviation of each size's prior.
    detectability : float
        Standard deviations at which one prior deviation of the first size is detected.
    """

    located: LocatedEffect
    gain: float
    sizes: Array
    signature: Array
    detectability: float


def screen_effect(
    problem: InferenceProblem, base: Baseline, effect: Effect
) -> list[ScreenedEffect]:
    """Return the gain of log evidence by adding an effect at each location, with the better sign.

    Locations without a signature, or of no possible reed, are left out.
    """
    found = [screen_at(problem, base, located) for located in locations_of(effect)]
    return [one for one in found if one is not None]


def screen_at(
    problem: InferenceProblem, base: Baseline, located: LocatedEffect
) -> ScreenedEffect | None:
    """Return the same at one location; None without a signature, or of no possible reed."""
    signs = (1.0,) if located.sizes[0].positive else (1.0, -1.0)
    each = [_screened(problem, base, located, sign) for sign in signs]
    return max((one for one in each if one), key=lambda one: one.gain, default=None)


def most_typical(found: Sequence[ScreenedEffect]) -> ScreenedEffect:
    """Return the location with the median detectability."""
    return sorted(found, key=lambda one: one.detectability)[len(found) // 2]


def _screened(
    problem: InferenceProblem, base: Baseline, located: LocatedEffect, sign: float
) -> ScreenedEffect | None:
    table = signature(problem, base, located, sign)
    if table is None:
        return None
    left = table - absorbed_part(base.jacobian, table)
    information = np.eye(table.shape[1]) + table.T @ left
    moved = base.jacobian @ (posterior_covariance(base.jacobian) @ base.pull)
    pull = table.T @ (moved - base.residuals)
    size = np.linalg.solve(information, pull)
    bound = np.array([parameter.positive for parameter in located.sizes])
    gain = -0.5 * float(np.linalg.slogdet(information)[1])
    if not np.any(bound & (size <= 0)):
        gain += 0.5 * float(pull @ size)
    begin = np.where(bound, np.maximum(size, _NEAREST), size)
    seen = math.sqrt(max(float(table[:, 0] @ left[:, 0]), 0.0))
    return ScreenedEffect(located, gain, np.clip(begin, -_FARTHEST, _FARTHEST), table, seen)


def signature(
    problem: InferenceProblem, base: Baseline, located: LocatedEffect, sign: float
) -> Array | None:
    """Return the whitened signature (n, s) of an effect; None if 0, or of no possible reed."""
    for probe in _PROBES:
        with contextlib.suppress(ImpossibleReedError):
            table = _probed(problem, base, located, sign, probe)
            return table if np.any(np.abs(table) > _LEAST_MOVED) else None
    return None


def _probed(
    problem: InferenceProblem, base: Baseline, located: LocatedEffect, sign: float, probe: float
) -> Array:
    columns = []
    nothing = np.zeros(len(located.sizes))
    for k in range(len(nothing)):
        # What a second parameter does may depend on the first, the effect's strength.
        first, size = nothing.copy(), nothing.copy()
        size[0] = sign * probe
        if k:
            first[0], size[k] = sign * probe, probe
        moved = problem.residuals(located.change(base.parameters, size))
        start = problem.residuals(located.change(base.parameters, first))
        columns.append((moved - start) / (probe if k else sign * probe))
    table: Array = np.stack(columns, axis=1) / base.deviation[:, None]
    return table


def signatures_of(
    problem: InferenceProblem, null: Candidate, effects: Sequence[Effect]
) -> dict[str, tuple[Array, Array]]:
    """Return each effect's whitened and marginalised signature (n, s), at its median location."""
    base, found = Baseline.of(problem, null), {}
    for effect in effects:
        places = screen_effect(problem, base, effect)
        if places:
            table = most_typical(places).signature
            found[effect.id] = table, marginalised_signature(base.jacobian, table)
    return found
