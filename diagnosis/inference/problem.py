"""The inference problem: observables of a campaign, and the model whose nuisances are unknown."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from diagnosis.inference.linear_model import (
    FORMS,
    KNOWN,
    MOST_FORM_DEVIATIONS,
    LinearModel,
    Scales,
)
from diagnosis.inference.nuisances import Nuisance, uncertain_sizes
from diagnosis.observable_groups import DISORDER, ObservableGroup
from holography.arrays import Array
from physics.effects.effect import Effect, Parameter
from physics.parameters.tree import BenchParameters, near_to
from physics.sized_effect import SizedEffect

_KEPT = 4096
# Effects have not quite the form that the catalogue gives them: a share of what they do in each
# number, and one in all numbers of one mode, band, time or level. Chosen: what a clock or a count
# does is known to some thousandths, and laws of one or two numbers describe a loudspeaker, a clamp
# or a piece of cane within a tenth to a third. Both shares are found between these limits, which
# are two standard deviations of their logs from the middle (decision 0106).
_LEAST_FORM, _MOST_FORM = 0.003, 0.33
FORM = math.sqrt(_LEAST_FORM * _MOST_FORM)
_FORM_FREEDOM = math.log(_MOST_FORM / FORM) / MOST_FORM_DEVIATIONS
_FORM_KINDS = ("band", "level", "mode", "time")
STEP = 0.02


class InferenceProblem:
    """The observables of a campaign, and the model whose nuisances are unknown.

    Parameters
    ----------
    groups : sequence of ObservableGroup
    base : BenchParameters
        What is known of the bench, but for its known effects.
    nuisances : sequence of Nuisance
    known : sequence of SizedEffect
        Effects that the bench is known to have. Each size with a standard error is one more
        nuisance, after those given.
    """

    def __init__(
        self,
        blocks: Sequence[ObservableGroup],
        base: BenchParameters,
        nuisances: Sequence[Nuisance],
        known: Sequence[SizedEffect] = (),
    ) -> None:
        self.groups, self.base, self.known = tuple(blocks), base, tuple(known)
        self.nuisances = (*nuisances, *(n for effect in known for n in uncertain_sizes(effect)))
        self._left = lru_cache(maxsize=_KEPT)(self._left_of)
        starts = np.cumsum([0, *(len(block.values) for block in blocks)])
        self.slices = {
            block.name: slice(int(a), int(b))
            for block, a, b in zip(blocks, starts, starts[1:], strict=False)
        }
        # Families of nuisances, and those of each group, which come after them.
        self._families = sorted({nuisance.family for nuisance in self.nuisances} - {""})
        self._of_groups = [(g, one) for g, b in enumerate(blocks) for one in b.errors.nuisances]
        # From units of all errors to units of the noise.
        self._to_noise = [
            block.noise_whitening @ np.linalg.inv(block.whitening) for block in blocks
        ]

    def parameters(self, z: Array) -> BenchParameters:
        """Return the model with nuisances z (p,), in units of their priors."""
        parameters = self.base
        for nuisance, size in zip(self.nuisances, z.tolist(), strict=True):
            if size:
                parameters = nuisance.change(parameters, nuisance.spread * size)
        # The sizes of one effect act together, so that they are no changes of their own.
        last = len(z) - sum(len(effect.uncertain) for effect in self.known)
        for effect in self.known:
            count = len(effect.uncertain)
            parameters = effect.change(parameters, tuple(z[last : last + count].tolist()))
            last += count
        return parameters

    def without_known(self) -> "InferenceProblem":
        """Return the same problem for a bench of which no effect is known."""
        return InferenceProblem(self.groups, self.base, self._of_bench)

    def with_groups(self, groups: Sequence[ObservableGroup]) -> "InferenceProblem":
        """Return the same problem for other groups of observables."""
        return InferenceProblem(groups, self.base, self._of_bench, self.known)

    @property
    def _of_bench(self) -> tuple[Nuisance, ...]:
        """Nuisances that are no sizes of known effects."""
        count = len(self.nuisances) - sum(len(effect.uncertain) for effect in self.known)
        return self.nuisances[:count]

    def residuals(self, parameters: BenchParameters, near: BenchParameters | None = None) -> Array:
        """Return the whitened residuals (n,): model less measurement.

        Parameters
        ----------
        parameters : BenchParameters
        near : BenchParameters, optional
            A model that differs little: modes are sought from those of its reed, which is faster.

        Raises
        ------
        ImpossibleReedError
            If the reed, or the one near it, is physically impossible.
        """
        if near is not None:
            parameters = near_to(parameters, near)
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

    @cached_property
    def errors_of_fits(self) -> Array:
        """One standard error of each number that is the result of a fit (n, k), in units of noise.

        See `Errors.of_fits`.
        """
        count = sum(len(group.values) for group in self.groups)
        found = [np.zeros((count, 0))]
        for group in self.groups:
            if group.errors.of_fits:
                errors = np.sqrt(np.diag(group.errors.covariance()))
                table = np.zeros((count, len(errors)))
                table[self.slices[group.name]] = group.noise_whitening * errors
                found.append(table)
        return np.hstack(found)

    def to_noise(self, whitened: Array) -> Array:
        """Return numbers (n, ...) that are in units of all errors, in units of the noise."""
        return np.concatenate(
            [
                root @ whitened[piece]
                for root, piece in zip(self._to_noise, self.slices.values(), strict=True)
            ]
        )

    def from_noise(self, scaled: Array) -> Array:
        """Return numbers (n, ...) that are in units of the noise, in units of all errors."""
        return np.concatenate(
            [
                np.linalg.solve(root, scaled[piece])
                for root, piece in zip(self._to_noise, self.slices.values(), strict=True)
            ]
        )

    def with_form(self, model: LinearModel, seen: Array) -> LinearModel:
        """Return a model with an effect whose form may deviate from that of the catalogue.

        What it does to a number, and to the numbers of one mode, band, time or level, may be a
        share more or less. Shares that change less than a standard error are left out.

        Parameters
        ----------
        model : LinearModel
            With the effect.
        seen : (n,) float
            What the effect does beyond what nuisances absorb, in units of the noise.
        """
        columns = []
        for group, piece in zip(self.groups, self.slices.values(), strict=True):
            own = np.linalg.solve(group.noise_whitening, seen[piece])
            labels = {
                (kind, label)
                for kind in _FORM_KINDS
                for place in group.coordinates
                if (label := getattr(place, kind))
            }
            for kind, label in sorted(labels):
                chosen = [getattr(place, kind) == label for place in group.coordinates]
                column = np.zeros(len(seen))
                column[piece] = FORM * group.noise_whitening @ (own * np.array(chosen))
                if column @ column > (FORM / _MOST_FORM) ** 2:
                    columns.append(column)
        common = np.stack(columns, axis=1) if columns else np.zeros((len(seen), 0))
        return model.with_form(common, (FORM * seen) ** 2)

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
        family = [self._families.index(n.family) if n.family else KNOWN for n in self.nuisances]
        own = []
        for number, (g, each) in enumerate(self._of_groups):
            table = np.zeros((len(residuals), each.columns.shape[1]))
            table[self.slices[self.groups[g].name]] = self.groups[g].noise_whitening @ each.columns
            own.append(table)
            family += [len(self._families) + number] * each.columns.shape[1]
        return LinearModel(
            left=self.to_noise(residuals - slopes @ z),
            slopes=np.hstack([self.to_noise(slopes), *own]),
            group=np.repeat(np.arange(len(self.groups)), [len(g.values) for g in self.groups]),
            family=np.array(family, dtype=np.intp),
            noise_freedom=np.array([group.errors.noise_freedom for group in self.groups]),
            family_freedom=np.array(
                [
                    *(DISORDER for _ in self._families),
                    *(each.freedom for _, each in self._of_groups),
                    *(_FORM_FREEDOM for _ in FORMS),
                ]
            ),
            rare=np.array(
                [
                    *(False for _ in self._families),
                    *(each.rare for _, each in self._of_groups),
                    *(False for _ in FORMS),
                ]
            ),
            form=np.zeros(len(residuals)),
        )

    def usual_errors(self, number: int, scales: Scales) -> Scales:
        """Return scales of which those of one group, and of its own nuisances, are 1."""
        noise, families = scales.noise.copy(), scales.families.copy()
        noise[number] = 0.0
        for place, (g, _) in enumerate(self._of_groups, len(self._families)):
            if g == number:
                families[place] = 0.0
        return Scales(noise, families)

    def covariance(self, number: int, scales: Scales) -> Array:
        """Return the covariance (k, k) of the numbers of a group, with errors of such scales."""
        group = self.groups[number]
        noise = group.errors.noise
        whole = np.exp(2 * scales.noise[number]) * (np.diag(noise**2) if noise.ndim == 1 else noise)
        for place, (g, each) in enumerate(self._of_groups, len(self._families)):
            if g == number:
                whole = whole + np.exp(2 * scales.families[place]) * each.columns @ each.columns.T
        return np.asarray(whole)

    def jacobian(self, z: Array) -> Array:
        """Return the Jacobian (n, p) along the nuisances at z (p,), without effects."""
        return self.jacobian_of_changed(z, lambda parameters: parameters)

    def jacobian_of_changed(
        self, z: Array, change: Callable[[BenchParameters], BenchParameters]
    ) -> Array:
        """Return the Jacobian (n, p) along the nuisances at z, of a changed model."""
        near, columns = change(self.parameters(z)), []
        here = self.residuals(near, near)
        for k in range(len(z)):
            step = -STEP if z[k] > 0 else STEP
            moved = z.copy()
            moved[k] += step
            there = self.residuals(change(self.parameters(moved)), near)
            columns.append((there - here) / step)
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
