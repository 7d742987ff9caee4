"""What alters a reed and its clamp, and what it changes in a reduced reed."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from holography.arrays import Array
from physics.reed.geometry import half_width_m
from physics.reed.random_surface import random_surface
from physics.reed.reduced.changes import (
    BED_SHEAR,
    Change,
    added_mass,
    layer,
    moved_clamp,
    softening,
    yielding_clamp,
)
from physics.reed.reduced.reed import ReducedReed

# Standard deviation of `Mechanics.bed_shear_log`: logarithms of 1.2 for dry contacts, 2 for cork,
# 2.7, and 4.3 for thin layers that cannot spread, over 2.7, have an rms of 0.5 (decision 0096).
BED_SHEAR_SPREAD: Final = 0.5


@dataclass(frozen=True)
class Layer:
    """Additional cane on the vamp; an amount of 1 is a thickness of 1 m where it is thickest.

    The thickness is a product of two Legendre polynomials.

    Attributes
    ----------
    along : int
        Degree of the polynomial along the vamp.
    across : int
        Degree of the polynomial from the right side to the left side.
    """

    along: int
    across: int


@dataclass(frozen=True)
class RandomLayer:
    """Random additional cane on the vamp; an amount of 1 is a thickness of 1 m rms.

    The root mean square is that over many seeds; that of one reed differs from it by some 20 %. See
    `physics.reed.random_surface`. First order in the thickness: with 3, 5 and 8 µm rms the farthest
    of 14 modes of six reeds was 1.4, 3.4 and 8.2 cents from new elements, of shifts up to 13, 21
    and 34 cents.

    Attributes
    ----------
    seed : int
        Selects one map of all.
    correlation_x_m, correlation_y_m : float
        Distances along and across the reed at which the correlation falls to 1/e.
    """

    seed: int
    correlation_x_m: float = 8e-3
    correlation_y_m: float = 4e-3


@dataclass(frozen=True)
class TipMass:
    """Additional mass, spread uniformly over the tip; an amount of 1 is 1 kg.

    Attributes
    ----------
    length_m : float
        Length of the tip that is covered.
    """

    length_m: float = 2e-3


@dataclass(frozen=True)
class SoftSpot:
    """Cane without stiffness along the grain, in a Gaussian spot; an amount of 1 is 1 m deep.

    Attributes
    ----------
    x_m, y_m : float
        Centre of the spot on the bark side.
    radius_m : float
        Standard deviation of the Gaussian.
    """

    x_m: float
    y_m: float
    radius_m: float = 1.5e-3


@dataclass(frozen=True)
class YieldingClamp:
    """Compliance of the clamp; an amount of 1 is 1 m per Pa, away from the reed.

    Its springs lose no energy. Along the reed they yield more: see `Mechanics.bed_shear_log`.

    Attributes
    ----------
    side : {0, 1, -1}
        Strip of the clamp that yields: 0 both, 1 the left one, −1 the right one.
    """

    side: int = 0


@dataclass(frozen=True)
class MovedClamp:
    """Front edge of the clamp away from its place; an amount of 1 is 1 m away from the tip.

    Attributes
    ----------
    tilted : bool
        Whether the edge is turned: the strip at positive y begins farther from the tip by the
        amount, and the other one nearer to it.
    """

    tilted: bool = False


Alteration = Layer | RandomLayer | TipMass | SoftSpot | YieldingClamp | MovedClamp
Alterations = tuple[tuple[Alteration, float], ...]
"""Alterations, each with its amount."""


@dataclass(frozen=True)
class _Sliding:
    """What a `YieldingClamp` of this side yields along the reed; an amount of 1 is 1 m per Pa."""

    side: int


def with_sliding(
    alterations: Alterations, bed_shear_log: float
) -> list[tuple[Alteration | _Sliding, float]]:
    """Return alterations with what clamps yield along the reed, which `unit_change` tells apart.

    Parameters
    ----------
    alterations : tuple of (Alteration, float)
    bed_shear_log : float
        See `physics.mechanics.Mechanics`.
    """
    shear = BED_SHEAR * float(np.exp(bed_shear_log))
    slides = [
        (_Sliding(kind.side), shear * amount)
        for kind, amount in alterations
        if isinstance(kind, YieldingClamp)
    ]
    return [*alterations, *slides]


def unit_change(reed: ReducedReed, kind: Alteration | _Sliding) -> Change:
    """Return the change of stiffness and mass by an alteration of amount 1."""
    outline, end_m = reed.geometry.outline, reed.geometry.vamp_x_m[-1]
    if isinstance(kind, YieldingClamp | _Sliding):
        left, right = float(kind.side >= 0), float(kind.side <= 0)
        slides = float(isinstance(kind, _Sliding))
        return yielding_clamp(reed, left, right, away=1 - slides, along=slides)
    if isinstance(kind, MovedClamp):
        return moved_clamp(reed, float(not kind.tilted), float(kind.tilted))
    if isinstance(kind, RandomLayer):
        return layer(reed, random_surface(kind.seed, kind.correlation_x_m, kind.correlation_y_m))
    if isinstance(kind, TipMass):
        zone = reed.area_m2 * (reed.bark_m[:, 0] < kind.length_m)
        area_m2 = (1 if None in reed.loose else 2) * float(zone.sum())
        return added_mass(reed, lambda x, y: (x < kind.length_m) / area_m2)
    if isinstance(kind, SoftSpot):

        def depth(x: Array, y: Array) -> Array:
            r2 = (x - kind.x_m) ** 2 + (y - kind.y_m) ** 2
            bell: Array = np.exp(-r2 / (2 * kind.radius_m**2))
            return bell

        return softening(reed, depth)
    along = np.polynomial.legendre.Legendre.basis(kind.along)
    across = np.polynomial.legendre.Legendre.basis(kind.across)

    def thickness(x: Array, y: Array) -> Array:
        eta = y / np.maximum(half_width_m(outline, x), 1e-6)
        grown: Array = along(2 * x / end_m - 1) * across(eta)
        return grown

    return layer(reed, thickness)
