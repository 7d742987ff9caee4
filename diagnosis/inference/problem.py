"""The inference problem: observables of a campaign, and the model whose nuisances are unknown."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.inference.linear_model import KNOWN, LinearModel
from diagnosis.inference.nuisances import FAMILY_FREEDOM, Nuisance
from diagnosis.observable_groups import ObservableGroup
from holography.arrays import Array
from physics.effects.effect import Effect, Parameter
from physics.parameters.tree import BenchParameters

# Log of how much larger the noise of a group may be than its replicates: prior and limit.
_NOISE_SPREAD, _MOST_NOISE = 0.15, 3.0
_KEPT, _SLOPES_KEPT = 4096, 4
STEP = 0.02
# Where a fit has not come to rest: distance, fraction of the step, and most Jacobians.
HERE, FINE, MOST_FINE = 0.03, 0.15, 3

# The Jacobian is taken again where a nuisance has moved by this many prior deviations; limits.
_FAR, NEAR, MOST_NEAR = 1.5, 0.3, 8


class InferenceProblem:
    """The observables of a campaign, and the model whose nuisances are unknown.

    Parameters
    ----------
    groups : sequence of ObservableGroup
    base : BenchParameters
        What is known of the bench.
    nuisances : sequence of Nuisance
    """

    def __init__(
        self,
        blocks: Sequence[ObservableGroup],
        base: BenchParameters,
        nuisances: Sequence[Nuisance],
    ) -> None:
        self.groups, self.base, self.nuisances = tuple(blocks), base, tuple(nuisances)
        self._left = lru_cache(maxsize=_KEPT)(self._left_of)
        starts = np.cumsum([0, *(len(block.values) for block in blocks)])
        self.slices = {
            block.name: slice(int(a), int(b))
            for block, a, b in zip(blocks, starts, starts[1:], strict=False)
        }
        self._slopes: list[tuple[Array, Array]] = []
        # From units of all errors to units of the noise.
        self._to_noise = [
            block.noise_whitening @ np.linalg.inv(block.whitening) for block in blocks
        ]

    @property
    def is_fit_bias(self) -> NDArray[np.bool_]:
        """Which nuisances (p,) are fit biases."""
        return np.array([nuisance.of_fits for nuisance in self.nuisances], dtype=bool)

    def parameters(self, z: Array) -> BenchParameters:
        """Return the model with nuisances z (p,), in units of their priors."""
        parameters = self.base
        for nuisance, size in zip(self.nuisances, z.tolist(), strict=True):
            if size:
                parameters = nuisance.change(parameters, nuisance.spread * size)
        return parameters

    def residuals(self, parameters: BenchParameters) -> Array:
        """Return the whitened residuals (n,): model less measurement."""
        return -np.concatenate(
            [
                self._left(number, tuple(getattr(parameters, part) for part in block.parts))
                for number, block in enumerate(self.groups)
            ]
        )

    def _left_of(self, number: int, parts: tuple[Any, ...]) -> Array:
        block = self.groups[number]
        return block.whitened_residual(
            BenchParameters(**dict(zip(block.parts, parts, strict=True)))
        )

    def to_noise(self, whitened: Array) -> Array:
        """Return numbers (n, ...) that are in units of all errors, in units of the noise."""
        return np.concatenate(
            [
                root @ whitened[piece]
                for root, piece in zip(self._to_noise, self.slices.values(), strict=True)
            ]
        )

    def linear_model(self, residuals: Array, slopes: Array, z: Array) -> LinearModel:
        """Return the model that is linear around nuisances z (p,), in units of its noise.

        Parameters
        ----------
        residuals : (n,) float
            Whitened residuals at z.
        slopes : (n, p) float
            Their Jacobian.
        z : (p,) float
        """
        at_none = residuals - slopes @ z
        left, columns = [], []
        of_groups = [
            (g, each) for g, group in enumerate(self.groups) for each in group.errors.nuisances
        ]
        names = sorted({nuisance.family for nuisance in self.nuisances} - {""})
        for piece, root in zip(
            self.slices.values(), self._to_noise, strict=True
        ):
            left.append(root @ at_none[piece])
            columns.append(root @ slopes[piece])
        family = [names.index(n.family) if n.family else KNOWN for n in self.nuisances]
        own = [np.zeros((len(at_none), each.columns.shape[1])) for _, each in of_groups]
        for number, ((g, each), table) in enumerate(zip(of_groups, own, strict=True)):
            table[list(self.slices.values())[g]] = self.groups[g].noise_whitening @ each.columns
            family += [len(names) + number] * each.columns.shape[1]
        return LinearModel(
            left=np.concatenate(left),
            slopes=np.hstack([np.concatenate(columns), *own]),
            group=np.repeat(np.arange(len(self.groups)), [len(g.values) for g in self.groups]),
            family=np.array(family, dtype=np.intp),
            noise_freedom=np.array([group.errors.noise_freedom for group in self.groups]),
            family_freedom=np.array(
                [FAMILY_FREEDOM] * len(names) + [each.freedom for _, each in of_groups]
            ),
        )

    def jacobian(self, z: Array, far: float = _FAR) -> Array:
        """Return the Jacobian (n, p) along the nuisances, taken within `far` deviations of z."""
        for at, slope in self._slopes:
            if np.abs(z - at).max() <= far:
                return slope
        slope = self.jacobian_of_changed(z, lambda parameters: parameters)
        self._slopes = [(z.copy(), slope), *self._slopes[: _SLOPES_KEPT - 1]]
        return slope

    def jacobian_of_changed(
        self, z: Array, change: Callable[[BenchParameters], BenchParameters], *, fine: bool = False
    ) -> Array:
        """Return the Jacobian (n, p) along the nuisances at z, of a changed model.

        Fine central differences are accurate where modes nearly meet, and cost twice as much.
        """
        here, columns = self.residuals(change(self.parameters(z))), []
        for k in range(len(z)):
            step = -STEP if z[k] > 0 else STEP
            step *= FINE if fine else 1
            moved, back = z.copy(), z.copy()
            moved[k] += step
            back[k] -= step
            other = self.residuals(change(self.parameters(back))) if fine else here
            more = self.residuals(change(self.parameters(moved))) - other
            columns.append(more / (2 * step if fine else step))
        return np.stack(columns, axis=1)


@dataclass(frozen=True)
class LocatedEffect:
    """An effect at one location.

    Attributes
    ----------
    effect : Effect
    location : mapping
        Values of its parameters that have a grid.
    """

    effect: Effect
    location: Mapping[str, float]

    @property
    def sizes(self) -> tuple[Parameter, ...]:
        """Sizes that are fitted."""
        return self.effect.sizes

    def change(self, parameters: BenchParameters, z: Array) -> BenchParameters:
        """Return the model with the effect at sizes z, in units of their priors."""
        values = {p.name: p.scale * float(v) for p, v in zip(self.sizes, z, strict=True)}
        return self.effect.change(parameters, {**values, **self.location})


def with_effects(
    parameters: BenchParameters, effects: Sequence[LocatedEffect], sizes: Array
) -> BenchParameters:
    """Return the model with effects of given sizes (s,), in units of their priors."""
    for located in effects:
        count = len(located.sizes)
        parameters = located.change(parameters, sizes[:count])
        sizes = sizes[count:]
    return parameters


def noise_inflation_gain(problem: InferenceProblem, residuals: Array) -> float:
    """Return the gain of log evidence because the noise of each group may be larger."""
    return sum(
        group_noise_gain(float(np.sum(residuals[piece] ** 2)), piece.stop - piece.start)
        for piece in problem.slices.values()
    )


def group_noise_gain(chi2: float, count: int) -> float:
    """Return the gain of log evidence by the likeliest factor on the noise of a group."""
    logs = np.linspace(0.0, _MOST_NOISE * _NOISE_SPREAD, 61)
    gains = 0.5 * chi2 * (1 - np.exp(-2 * logs)) - count * logs - 0.5 * (logs / _NOISE_SPREAD) ** 2
    return float(gains.max())
