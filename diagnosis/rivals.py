"""Rivals: twins with no effect, one, or two, each fitted with all nuisances, and their evidence.

Residuals of all blocks are whitened and put in one vector. Slopes along the nuisances are those at
the twin without effects, taken anew where a fit moves far; along an effect's own parameters they
are taken at every step.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.block import Block
from diagnosis.estimate import (
    LEAST_DECREMENT,
    Estimate,
    fit,
    spread_of,
)
from diagnosis.nuisances import Nuisance
from physics.effects.effect import Effect, Parameter
from physics.twin import Twin

Array = NDArray[np.floating[Any]]

# Slopes are taken anew where a nuisance has moved by so many deviations.
_FAR, _NEAR, _MOST_NEAR = 1.5, 0.3, 8
# Where a fit has not come to rest they are taken here, of steps that are smaller, so many times.
_HERE, _FINE, _MOST_FINE = 0.03, 0.15, 3
_STEP = 0.02
_KEPT, _SLOPES_KEPT = 4096, 4
# Searches end where a step gains less than this share of the cost: hundredths of a nat.
_LEAST_GAIN = 1e-4
# The noise of a block may be larger than its replicates say: log.
_NOISE_SPREAD, _MOST_NOISE = 0.15, 3.0
# Effects have not quite the form that the catalogue gives them: a share of what they do.
_FORM = 0.12


class Comparison:
    """Blocks of a campaign beside a twin whose nuisances are to be found.

    Parameters
    ----------
    blocks : sequence of Block
    base : Twin
        What is known of the bench.
    nuisances : sequence of Nuisance
    """

    def __init__(self, blocks: Sequence[Block], base: Twin, nuisances: Sequence[Nuisance]) -> None:
        self.blocks, self.base, self.nuisances = tuple(blocks), base, tuple(nuisances)
        self._left = lru_cache(maxsize=_KEPT)(self._left_of)
        starts = np.cumsum([0, *(len(block.values) for block in blocks)])
        self.slices = {
            block.name: slice(int(a), int(b))
            for block, a, b in zip(blocks, starts, starts[1:], strict=False)
        }
        self._slopes: list[tuple[Array, Array]] = []

    @property
    def exchanging(self) -> NDArray[np.bool_]:
        """Which nuisances (p,) only say what fits take for something else."""
        return np.array([nuisance.of_fits for nuisance in self.nuisances], dtype=bool)

    def twin(self, z: Array) -> Twin:
        """Twin with nuisances z (p,), in units of their priors."""
        twin = self.base
        for nuisance, size in zip(self.nuisances, z.tolist(), strict=True):
            if size:
                twin = nuisance.change(twin, nuisance.spread * size)
        return twin

    def residuals(self, twin: Twin) -> Array:
        """What a twin leaves (n,), whitened: twin less measurement."""
        return -np.concatenate(
            [
                self._left(number, tuple(getattr(twin, part) for part in block.parts))
                for number, block in enumerate(self.blocks)
            ]
        )

    def _left_of(self, number: int, parts: tuple[Any, ...]) -> Array:
        block = self.blocks[number]
        return block.left(Twin(**dict(zip(block.parts, parts, strict=True))))

    def slope(self, z: Array, far: float = _FAR) -> Array:
        """Derivatives (n, p) along the nuisances, no farther from z than so many deviations."""
        for at, slope in self._slopes:
            if np.abs(z - at).max() <= far:
                return slope
        slope = self.slope_beside(z, lambda twin: twin)
        self._slopes = [(z.copy(), slope), *self._slopes[: _SLOPES_KEPT - 1]]
        return slope

    def slope_beside(
        self, z: Array, change: Callable[[Twin], Twin], *, fine: bool = False
    ) -> Array:
        """Derivatives (n, p) along the nuisances at z, of twins that are changed besides.

        Fine ones are good where modes nearly meet, and cost twice as much.
        """
        here, columns = self.residuals(change(self.twin(z))), []
        for k in range(len(z)):
            step = -_STEP if z[k] > 0 else _STEP
            step *= _FINE if fine else 1
            moved, back = z.copy(), z.copy()
            moved[k] += step
            back[k] -= step
            other = self.residuals(change(self.twin(back))) if fine else here
            more = self.residuals(change(self.twin(moved))) - other
            columns.append(more / (2 * step if fine else step))
        return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Sized:
    """An effect with its places chosen.

    Attributes
    ----------
    effect : Effect
    places : mapping
        Values of its parameters that are places.
    """

    effect: Effect
    places: Mapping[str, float]

    @property
    def sizes(self) -> tuple[Parameter, ...]:
        """Parameters that are to be found."""
        return self.effect.sizes

    def change(self, twin: Twin, z: Array) -> Twin:
        """Twin with the effect at sizes z, in units of their priors."""
        values = {p.name: p.spread * float(v) for p, v in zip(self.sizes, z, strict=True)}
        return self.effect.change(twin, {**values, **self.places})


@dataclass(frozen=True)
class Rival:
    """A twin with chosen effects, fitted.

    Attributes
    ----------
    effects : tuple of Sized
    estimate : Estimate
        Of nuisances, then of the effects' sizes; residuals and slopes in units of `deviation`.
    fitted : float
        Log evidence of the fit.
    chi2 : dict of float
        Of each block.
    deviation : (n,) float
        Standard deviation of the whitened residuals: 1, and more where the effects do much, which
        have not quite the form that the catalogue gives them.
    elsewhere : float
        What other places of the effects add to the log evidence.
    """

    effects: tuple[Sized, ...]
    estimate: Estimate
    fitted: float
    chi2: dict[str, float]
    deviation: Array
    elsewhere: float = 0.0

    @property
    def log_evidence(self) -> float:
        """Of the fit, and of other places."""
        return self.fitted + self.elsewhere

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(sized.effect.id for sized in self.effects)

    @property
    def sizes(self) -> Array:
        """Sizes (s,) of all effects, in units of their priors."""
        count = sum(len(sized.sizes) for sized in self.effects)
        return self.estimate.z[len(self.estimate.z) - count :]

    @property
    def told(self) -> dict[str, list[tuple[Parameter, float, float]]]:
        """Of every effect, by its id, each size and its error in units of the prior."""
        errors = np.sqrt(np.diag(self.estimate.covariance))[-len(self.sizes) :]
        found = iter(zip(self.sizes.tolist(), errors.tolist(), strict=True))
        return {
            sized.effect.id: [(parameter, *next(found)) for parameter in sized.sizes]
            for sized in self.effects
        }

    @property
    def left(self) -> Array:
        """What is left (n,), whitened."""
        left: Array = self.estimate.residuals * self.deviation
        return left

    @property
    def free(self) -> Array:
        """Derivatives (n, q) of the estimate's residuals along all that is not held at 0."""
        positive = [size.positive for sized in self.effects for size in sized.sizes]
        held = np.zeros(len(self.estimate.z), dtype=bool)
        held[len(held) - len(positive) :] = np.array(positive, dtype=bool) & (self.sizes <= 0)
        free: Array = self.estimate.jacobian[:, ~held]
        return free

    def twin(self, comparison: Comparison) -> Twin:
        """The twin as fitted."""
        count = len(comparison.nuisances)
        return self.changed(comparison.twin(self.estimate.z[:count]), self.sizes)

    def changed(self, twin: Twin, sizes: Array) -> Twin:
        """A twin with the rival's effects at other sizes (s,)."""
        return _with_effects(twin, self.effects, sizes)


def d_prime(null: Rival, rival: Rival) -> float:
    """By how many deviations a rival's likelihood stands out of that without effects.

    What an effect moves is less certain by itself, which a cost in units of that does not tell.
    """
    form = 2 * float(np.sum(np.log(rival.deviation)) - np.sum(np.log(null.deviation)))
    gain = null.estimate.cost - rival.estimate.cost - form
    return float(np.sqrt(max(gain, 0.0)))


def compete(
    comparison: Comparison,
    effects: Sequence[Sized],
    starts: Sequence[Array],
    *,
    exact: bool = False,
) -> Rival:
    """Fit a twin with effects.

    Parameters
    ----------
    comparison : Comparison
    effects : sequence of Sized
        None is the twin without any.
    starts : sequence of (p + s,) float
        Nuisances, then sizes of all effects.
    exact : bool
        Whether slopes along the nuisances are to be those where the fit ends.

    Raises
    ------
    ValueError
        If no start is a possible reed.
    """
    p, positive = len(comparison.nuisances), _positive(comparison, effects)

    def residuals(z: Array) -> Array:
        return comparison.residuals(_with_effects(comparison.twin(z[:p]), effects, z[p:]))

    def jacobian(z: Array) -> Array:
        return np.column_stack([comparison.slope(z[:p]), *_by_size(residuals, z, p, positive)])

    def by_effects(z: Array) -> Array:
        moved: Array = residuals(z) - comparison.residuals(comparison.twin(z[:p]))
        return moved

    if not exact:
        found = fit(residuals, positive, starts, jacobian, _LEAST_GAIN)
        return _loosened(comparison, effects, by_effects(found.z), found)
    near = _Slopes(comparison, effects, _NEAR, _MOST_NEAR * len(starts))
    here = _Slopes(comparison, effects, _HERE, _MOST_FINE, fine=True)

    def close(z: Array) -> Array:
        return np.column_stack([near.at(z), *_by_size(residuals, z, p, positive)])

    def closer(z: Array) -> Array:
        return np.column_stack([here.at(z), *_by_size(residuals, z, p, positive, fine=True)])

    ends = _ends(residuals, positive, starts, jacobian)
    found = fit(residuals, positive, ends, close, _LEAST_GAIN)
    agreeing = found.agreeing
    if found.decrement > LEAST_DECREMENT:
        # Slopes of a little way off show steps that there are not.
        found = fit(residuals, positive, [found.z], closer, _LEAST_GAIN)
    # Searches that end at no possible reed agree with none.
    found = replace(found, agreeing=agreeing, starts=len(starts))
    return _loosened(comparison, effects, by_effects(found.z), found)


class _Slopes:
    """Slopes along the nuisances beside effects, taken anew where a fit has moved far.

    At most so often: fits that move on and on explain nothing, and slopes cost most of the time.
    """

    def __init__(
        self,
        comparison: Comparison,
        effects: Sequence[Sized],
        far: float,
        most: int,
        *,
        fine: bool = False,
    ) -> None:
        self._comparison, self._effects, self._fine = comparison, effects, fine
        self._far, self._most = far, most
        self._kept: list[tuple[Array, Array]] = []

    def at(self, z: Array) -> Array:
        """Derivatives (n, p) near z (p + s,)."""
        apart = [float(np.abs(z - at).max()) for at, _ in self._kept]
        if apart and (min(apart) <= self._far or len(apart) == self._most):
            return self._kept[int(np.argmin(apart))][1]
        p = len(self._comparison.nuisances)
        changed = partial(_with_effects, effects=self._effects, sizes=z[p:])
        slope = self._comparison.slope_beside(z[:p], changed, fine=self._fine)
        self._kept.append((z.copy(), slope))
        return slope


def _ends(
    residuals: Callable[[Array], Array],
    positive: Sequence[bool],
    starts: Sequence[Array],
    jacobian: Callable[[Array], Array],
) -> list[Array]:
    """Where searches end that begin at each of some starts; those of no possible reed do not."""
    ends = []
    for start in starts:
        with contextlib.suppress(ValueError):
            ends.append(fit(residuals, positive, [start], jacobian, _LEAST_GAIN).z)
    return ends


def compete_straight(
    comparison: Comparison, effects: Sequence[Sized], about: Array, sizes: Array
) -> Rival:
    """Fit a twin with effects as if all that nuisances do were straight.

    Parameters
    ----------
    comparison : Comparison
    effects : sequence of Sized
    about : (p,) float
        Nuisances at which slopes are taken.
    sizes : (s,) float
        To begin with.

    Raises
    ------
    ValueError
        If the start is no possible reed.
    """
    p, positive = len(comparison.nuisances), _positive(comparison, effects)
    slope, base = comparison.slope(about, _NEAR), comparison.twin(about)

    def residuals(z: Array) -> Array:
        bent = comparison.residuals(_with_effects(base, effects, z[p:]))
        straight: Array = bent + slope @ (z[:p] - about)
        return straight

    def jacobian(z: Array) -> Array:
        return np.column_stack([slope, *_by_size(residuals, z, p, positive)])

    def by_effects(z: Array) -> Array:
        moved: Array = residuals(z) - nothing - slope @ (z[:p] - about)
        return moved

    nothing = comparison.residuals(base)
    start = np.concatenate([about, sizes])
    found = fit(residuals, positive, [start], jacobian, _LEAST_GAIN)
    return _loosened(comparison, effects, by_effects(found.z), found)


def straightened(comparison: Comparison, about: Array) -> None:
    """Take the slopes at nuisances (p,) that all fits need which take those for straight."""
    comparison.slope(about, _NEAR)


def cost_straight(
    comparison: Comparison, effects: Sequence[Sized], about: Array, sizes: Array
) -> float:
    """Least cost of effects of given sizes (s,) if all that nuisances do were straight.

    Infinite of no possible reed. Parameters as those of `compete_straight`.
    """
    slope = comparison.slope(about, _NEAR)
    try:
        left = comparison.residuals(_with_effects(comparison.twin(about), effects, sizes))
    except ValueError:
        return float("inf")
    move = -spread_of(slope) @ (slope.T @ left + about)
    left, nuisances = left + slope @ move, about + move
    return float(left @ left + nuisances @ nuisances + sizes @ sizes)


def exactly(comparison: Comparison, rival: Rival) -> Rival:
    """A rival that costs what the twin leaves by its parameters, with nothing taken for straight.

    What it leaves stays as it is where all is straight: there it is at an optimum.

    Raises
    ------
    ValueError
        If its parameters are of no possible reed.
    """
    estimate = rival.estimate
    residuals = comparison.residuals(rival.twin(comparison)) / rival.deviation
    more = float(residuals @ residuals - estimate.residuals @ estimate.residuals)
    noise = by_noise(comparison, residuals) - by_noise(comparison, estimate.residuals)
    return replace(
        rival,
        estimate=replace(estimate, cost=estimate.cost + more),
        fitted=rival.fitted - 0.5 * more + noise,
    )


def _loosened(
    comparison: Comparison, effects: Sequence[Sized], by_effects: Array, found: Estimate
) -> Rival:
    """Rival whose effects, that move residuals by so much (n,), need not have quite their form."""
    deviation = np.ones(len(found.residuals))
    if effects:
        # Little moves: along the slopes that are known anyway.
        deviation = np.hypot(1.0, _FORM * by_effects)
        narrow, z = found.jacobian / deviation[:, None], found.z.copy()
        left = found.residuals / deviation
        again = fit(
            lambda at: left + narrow @ (at - z),
            _positive(comparison, effects),
            [z],
            lambda _at: narrow,
            _LEAST_GAIN,
        )
        found = replace(
            again, agreeing=found.agreeing, starts=found.starts, decrement=found.decrement
        )
    chi2 = _chi2(comparison, found.residuals * deviation)
    fitted = found.log_evidence - float(np.sum(np.log(deviation)))
    fitted += by_noise(comparison, found.residuals)
    return Rival(tuple(effects), found, fitted, chi2, deviation)


def _chi2(comparison: Comparison, left: Array) -> dict[str, float]:
    """Of each block, of what is left (n,)."""
    return {name: float(np.sum(left[piece] ** 2)) for name, piece in comparison.slices.items()}


def _positive(comparison: Comparison, effects: Sequence[Sized]) -> list[bool]:
    sizes = [size.positive for sized in effects for size in sized.sizes]
    return [False] * len(comparison.nuisances) + sizes


def _by_size(
    residuals: Callable[[Array], Array],
    z: Array,
    p: int,
    positive: Sequence[bool],
    *,
    fine: bool = False,
) -> list[Array]:
    """Derivatives (n,) along each size, which come after p nuisances.

    Fine ones are good where what an effect moves bends within a step, and cost twice as much.
    """
    if len(z) == p:
        return []
    here = residuals(z)
    columns: list[Array] = []
    for k in range(p, len(z)):
        step = _STEP if positive[k] or z[k] <= 0 else -_STEP
        step *= _FINE if fine else 1
        moved, back = z.copy(), z.copy()
        moved[k] += step
        # Nothing is on the other side of a bound.
        back[k] -= step if fine and (z[k] > step or not positive[k]) else 0.0
        other = here if back[k] == z[k] else residuals(back)
        columns.append((residuals(moved) - other) / (moved[k] - back[k]))
    return columns


def _with_effects(twin: Twin, effects: Sequence[Sized], sizes: Array) -> Twin:
    for sized in effects:
        count = len(sized.sizes)
        twin = sized.change(twin, sizes[:count])
        sizes = sizes[count:]
    return twin


def by_noise(comparison: Comparison, residuals: Array) -> float:
    """What evidence gains by noise that may be larger in each block."""
    return sum(
        gain_by_noise(float(np.sum(residuals[piece] ** 2)), piece.stop - piece.start)
        for piece in comparison.slices.values()
    )


def gain_by_noise(chi2: float, count: int) -> float:
    """Gain of log evidence by the likeliest factor on the noise of a block of so many numbers."""
    logs = np.linspace(0.0, _MOST_NOISE * _NOISE_SPREAD, 61)
    gains = 0.5 * chi2 * (1 - np.exp(-2 * logs)) - count * logs - 0.5 * (logs / _NOISE_SPREAD) ** 2
    return float(gains.max())
