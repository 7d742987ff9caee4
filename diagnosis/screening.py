"""Which effects may be there: a score test of each beside a fit, one or two twins apiece."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.estimate import (
    spread_of,
    standing_out,
    taken_up,
)
from diagnosis.rivals import (
    Comparison,
    Rival,
    Sized,
)
from physics.effects.effect import Effect
from physics.twin import Twin

Array = NDArray[np.floating[Any]]

# Sizes at which signatures are taken, in deviations of the prior: the first that a reed may have.
_PROBES = 1.0, 0.2
# Effects that move whitened numbers by less do not move them.
_LEAST_MOVED = 1e-6
# Searches begin no farther out, and a positive size no nearer to nothing.
_FARTHEST, _NEAREST = 6.0, 0.05


def places_of(effect: Effect) -> Iterator[Sized]:
    """Yield an effect at all places where it may be."""
    names = [parameter.name for parameter in effect.gridded]
    for at in product(*(parameter.grid for parameter in effect.gridded)):
        yield Sized(effect, dict(zip(names, at, strict=True)))


def count_places(effect: Effect) -> int:
    """At how many places an effect may be."""
    return math.prod(len(parameter.grid) for parameter in effect.gridded)


@dataclass(frozen=True)
class Base:
    """A twin that effects are added to, fitted or not.

    Attributes
    ----------
    twin : Twin
    residuals : (n,) float
    slopes : (n, q) float
        Of all that is free.
    pull : (q,) float
        Half the gradient of the cost along that; 0 where it is fitted.
    deviation : (n,) float
        What residuals and slopes are in units of, whitened.
    """

    twin: Twin
    residuals: Array
    slopes: Array
    pull: Array
    deviation: Array

    @classmethod
    def of(cls, comparison: Comparison, rival: Rival) -> "Base":
        """A rival as fitted."""
        slopes, left = rival.free, rival.estimate.residuals
        fitted = np.zeros(slopes.shape[1])
        return cls(rival.twin(comparison), left, slopes, fitted, rival.deviation)

    @classmethod
    def at(cls, comparison: Comparison, z: Array) -> "Base":
        """A twin with nuisances z (p,)."""
        twin, slopes = comparison.twin(z), comparison.slope(z)
        residuals = comparison.residuals(twin)
        return cls(twin, residuals, slopes, slopes.T @ residuals + z, np.ones(len(residuals)))


@dataclass(frozen=True)
class Screened:
    """An effect at one place, along its signature.

    Attributes
    ----------
    sized : Sized
    gain : float
        Of log evidence.
    sizes : (s,) float
        To begin a search with.
    table : (n, s) float
        The signature, whitened, per deviation of each size's prior.
    seen : float
        By how many deviations one deviation of the first size stands out.
    """

    sized: Sized
    gain: float
    sizes: Array
    table: Array
    seen: float


def screened(comparison: Comparison, base: Base, effect: Effect) -> list[Screened]:
    """Gain of log evidence by adding an effect at each of its places, of either sign.

    Places where the effect moves nothing, or is of no possible reed, are left out.
    """
    found = [screened_at(comparison, base, sized) for sized in places_of(effect)]
    return [one for one in found if one is not None]


def screened_at(comparison: Comparison, base: Base, sized: Sized) -> Screened | None:
    """The same at one place; None if it moves nothing there, or is of no possible reed."""
    signs = (1.0,) if sized.sizes[0].positive else (1.0, -1.0)
    each = [_screened(comparison, base, sized, sign) for sign in signs]
    return max((one for one in each if one), key=lambda one: one.gain, default=None)


def usual(found: Sequence[Screened]) -> Screened:
    """Of an effect at several places, the one where it is neither seen best nor worst."""
    return sorted(found, key=lambda one: one.seen)[len(found) // 2]


def _screened(comparison: Comparison, base: Base, sized: Sized, sign: float) -> Screened | None:
    table = signature(comparison, base, sized, sign)
    if table is None:
        return None
    left = table - taken_up(base.slopes, table)
    information = np.eye(table.shape[1]) + table.T @ left
    moved = base.slopes @ (spread_of(base.slopes) @ base.pull)
    pull = table.T @ (moved - base.residuals)
    size = np.linalg.solve(information, pull)
    bound = np.array([parameter.positive for parameter in sized.sizes])
    gain = -0.5 * float(np.linalg.slogdet(information)[1])
    if not np.any(bound & (size <= 0)):
        gain += 0.5 * float(pull @ size)
    begin = np.where(bound, np.maximum(size, _NEAREST), size)
    seen = math.sqrt(max(float(table[:, 0] @ left[:, 0]), 0.0))
    return Screened(sized, gain, np.clip(begin, -_FARTHEST, _FARTHEST), table, seen)


def signature(comparison: Comparison, base: Base, sized: Sized, sign: float) -> Array | None:
    """What each size of an effect moves (n, s), whitened; None if nothing, or of no reed."""
    for probe in _PROBES:
        with contextlib.suppress(ValueError):
            table = _probed(comparison, base, sized, sign, probe)
            return table if np.any(np.abs(table) > _LEAST_MOVED) else None
    return None


def _probed(comparison: Comparison, base: Base, sized: Sized, sign: float, probe: float) -> Array:
    columns = []
    nothing = np.zeros(len(sized.sizes))
    for k in range(len(nothing)):
        # What a second parameter does may depend on the first, the effect's strength.
        first, size = nothing.copy(), nothing.copy()
        size[0] = sign * probe
        if k:
            first[0], size[k] = sign * probe, probe
        moved = comparison.residuals(sized.change(base.twin, size))
        start = comparison.residuals(sized.change(base.twin, first))
        columns.append((moved - start) / (probe if k else sign * probe))
    table: Array = np.stack(columns, axis=1) / base.deviation[:, None]
    return table


def signatures_of(
    comparison: Comparison, null: Rival, effects: Sequence[Effect]
) -> dict[str, tuple[Array, Array]]:
    """What each effect moves (n, s) where it is usual, whitened, and what of it stands out."""
    base, found = Base.of(comparison, null), {}
    for effect in effects:
        places = screened(comparison, base, effect)
        if places:
            table = usual(places).table
            found[effect.id] = table, standing_out(base.slopes, table)
    return found
