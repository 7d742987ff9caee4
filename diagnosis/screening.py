"""Which effects may be there: a score test of each beside a fit, one or two twins apiece."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.estimate import spread_of, standing_out, taken_up
from diagnosis.rivals import Comparison, Rival, Sized
from physics.effects.form import Effect
from physics.twin import Twin

Array = NDArray[np.floating[Any]]

# Sizes at which an effect's signature is taken, in deviations of its prior.
_PROBE = 1.0
# Effects that move whitened numbers by less do not move them.
_LEAST_MOVED = 1e-6
# Searches begin no farther out, and a positive size no nearer to nothing.
_FARTHEST, _NEAREST = 6.0, 0.05


def places_of(effect: Effect) -> Iterator[Sized]:
    """Yield an effect at all places where it may be."""
    names = [parameter.name for parameter in effect.placed]
    for at in product(*(parameter.places for parameter in effect.placed)):
        yield Sized(effect, dict(zip(names, at, strict=True)))


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


def screened(comparison: Comparison, base: Base, sized: Sized) -> tuple[float, Array] | None:
    """Gain of log evidence by adding an effect, along its signature, of either sign.

    Returns
    -------
    gain : float
    sizes : (s,) float
        To begin a search with.

    None if the effect moves nothing, or is of no possible reed.
    """
    signs = (1.0,) if sized.sizes[0].positive else (1.0, -1.0)
    found = [_screened(comparison, base, sized, sign) for sign in signs]
    return max((each for each in found if each), key=lambda each: each[0], default=None)


def _screened(
    comparison: Comparison, base: Base, sized: Sized, sign: float
) -> tuple[float, Array] | None:
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
    return gain, np.clip(begin, -_FARTHEST, _FARTHEST)


def signature(comparison: Comparison, base: Base, sized: Sized, sign: float) -> Array | None:
    """What each size of an effect moves (n, s), whitened; None if nothing, or of no reed."""
    columns = []
    nothing = np.zeros(len(sized.sizes))
    for k in range(len(nothing)):
        # What a second parameter does may depend on the first, the effect's strength.
        first, size = nothing.copy(), nothing.copy()
        size[0] = sign * _PROBE
        if k:
            first[0], size[k] = sign * _PROBE, _PROBE
        try:
            moved = comparison.residuals(sized.change(base.twin, size))
            start = comparison.residuals(sized.change(base.twin, first))
        except ValueError:
            return None
        columns.append((moved - start) / (1.0 if k else sign))
    table = np.stack(columns, axis=1) / base.deviation[:, None]
    return table if np.any(np.abs(table) > _LEAST_MOVED) else None


def signatures(
    comparison: Comparison, null: Rival, alone: Mapping[str, Rival]
) -> dict[str, tuple[Array, Array]]:
    """What each effect moves (n, s) where it was found, whitened, and what of it stands out."""
    found = {}
    for name, rival in alone.items():
        sized = rival.effects[0]
        sign = 1.0 if sized.sizes[0].positive or rival.sizes[0] > 0 else -1.0
        table = _both(comparison, Base.of(comparison, null), sized, sign)
        if table is not None:
            found[name] = table
    return found


def signatures_of(
    comparison: Comparison, null: Rival, effects: Sequence[Effect]
) -> dict[str, tuple[Array, Array]]:
    """The same of effects that were not looked for, in the middle of the places they may be at."""
    base, found = Base.of(comparison, null), {}
    for effect in effects:
        places = list(places_of(effect))
        table = _both(comparison, base, places[len(places) // 2], 1.0)
        if table is not None:
            found[effect.id] = table
    return found


def _both(
    comparison: Comparison, base: Base, sized: Sized, sign: float
) -> tuple[Array, Array] | None:
    table = signature(comparison, base, sized, sign)
    if table is None:
        return None
    return table, standing_out(base.slopes, table)
