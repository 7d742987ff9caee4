"""Dynamic stiffness of a reed in reduced coordinates, with cane and air of every frequency.

``Z(ω) = Σ a_i(ω) G_i``: matrices G_i of stiffness, of the clamp's springs, of mass and of air, each
with an amount that depends on frequency. A mode is where Z is singular.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import linalg
from scipy.interpolate import CubicSpline

from holography.arrays import Array, ComplexArray
from physics.reed.cane.material import STIFFNESS_TERMS, Cane, terms_and_slopes
from physics.reed.cane.viscoelastic import ViscoelasticCane, Zener, storage_modulus
from physics.reed.reduced.air_matrices import AirMatrices
from physics.reed.reduced.changes import Blocks, Change
from physics.reed.reduced.reed import CONSTANTS, ReducedReed

E_L, G_LT = CONSTANTS.index("E_L_pa"), CONSTANTS.index("G_LT_pa")
# Frequency at which a growth of moduli changes nothing. Chosen: near the middle of the sweep, on a
# logarithmic scale.
PIVOT_HZ = 4000.0
# Range in which stiffnesses are Chebyshev polynomials of log f, and their number: of Zener solids
# that relax within it, exact to 1e-8.
_RANGE_HZ, _NODES = (200.0, 60e3), 36
# Directions of the nine stiffnesses below this share are left out.
_LEAST_DIRECTION = 1e-9
# The clamp yields in a direction if its compliance there is more than this share of the greatest.
_LEAST_COMPLIANCE = 1e-12


@dataclass(frozen=True)
class CaneLaw:
    """Elastic constants of a cane at every frequency.

    Attributes
    ----------
    constants : Cane
        Those that do not depend on frequency, and density.
    viscoelastic : ViscoelasticCane, optional
        E_L and G_LT; if not given they are those of `constants`.
    log_E_L, log_G_LT : float
        Natural logarithms of factors on them.
    growth_E_L, growth_G_LT : float
        Additional growth: exponents of (f / 4 kHz).
    """

    constants: Cane
    viscoelastic: ViscoelasticCane | None = None
    log_E_L: float = 0.0
    log_G_LT: float = 0.0
    growth_E_L: float = 0.0
    growth_G_LT: float = 0.0

    def constants_at(self, hz: Array) -> Array:
        """Elastic constants (m, 9) at frequencies (m,), in the order of `CONSTANTS`."""
        rows = np.tile([getattr(self.constants, name) for name in CONSTANTS], (len(hz), 1))
        if self.viscoelastic is not None:
            rows[:, E_L] = 1e6 * _storage(self.viscoelastic.young_L, hz)
            rows[:, G_LT] = 1e6 * _storage(self.viscoelastic.shear_LT, hz)
        log_ratio = np.log(hz / PIVOT_HZ)
        rows[:, E_L] *= np.exp(self.log_E_L + self.growth_E_L * log_ratio)
        rows[:, G_LT] *= np.exp(self.log_G_LT + self.growth_G_LT * log_ratio)
        return rows

    def at(self, hz: float) -> Cane:
        """Cane at a frequency."""
        row = self.constants_at(np.array([hz]))[0].tolist()
        return replace(self.constants, **dict(zip(CONSTANTS, row, strict=True)))

    @cached_property
    def table(self) -> "StiffnessTable":
        """Stiffnesses as polynomials of log f."""
        return StiffnessTable.of(self)


def _storage(zener: Zener, hz: Array) -> Array:
    parts = (zener.spring_mpa, zener.arm_spring_mpa, zener.arm_dashpot_mpa_s)
    spring, arm, dashpot = np.array(parts)
    return storage_modulus(spring, arm, dashpot, hz).value_mpa


@dataclass(frozen=True)
class StiffnessTable:
    """The nine stiffnesses of a cane at any frequency, as sums of few directions.

    Attributes
    ----------
    directions : (d, 9) float
    coefficients : (n, d) float
        Of Chebyshev polynomials in log f over 200 Hz to 60 kHz; constant beyond.
    """

    directions: Array
    coefficients: Array

    @classmethod
    def of(cls, law: CaneLaw) -> "StiffnessTable":
        """Tabulate a law."""
        terms = terms_and_slopes(law.constants_at(_HZ_OF_NODES))[0]
        scale = np.abs(terms).max(axis=0)
        left, values, right = np.linalg.svd(terms / scale, full_matrices=False)
        kept = values > _LEAST_DIRECTION * values[0]
        return cls(right[kept] * scale, _TO_COEFFICIENTS @ (left[:, kept] * values[kept]))

    def amounts(self, hz: Array) -> tuple[Array, Array]:
        """Amounts of all directions at frequencies (m,), and derivatives by ln f: two (m, d)."""
        low, high = _LOG_RANGE
        places = (2 * np.log(hz) - low - high) / (high - low)
        angle = np.arccos(np.clip(places, -_WITHIN, _WITHIN))
        turned = np.multiply.outer(angle, np.arange(_NODES))
        by_place = np.arange(_NODES) * np.sin(turned) / np.sin(angle)[:, None]
        return np.cos(turned) @ self.coefficients, 2 / (high - low) * by_place @ self.coefficients


# Places just within the range, where slopes of polynomials are no 0/0.
_WITHIN = 1 - 1e-12
_LOG_RANGE = tuple(np.log(_RANGE_HZ).tolist())
_PLACES = chebyshev.chebpts1(_NODES)
_HZ_OF_NODES = np.exp(0.5 * (sum(_LOG_RANGE) + (_LOG_RANGE[1] - _LOG_RANGE[0]) * _PLACES))
_TO_COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(_PLACES, _NODES - 1))


@dataclass(frozen=True)
class LossFactors:
    """Ratios of dissipated to stored energy per radian.

    Attributes
    ----------
    normal, shear : float
        Of the stiffness against normal strains, E_L above all, and against shear, G_LT above all.
    clamp : float
        Of what holds the strips.
    """

    normal: float
    shear: float
    clamp: float = 0.0

    @property
    def of_terms(self) -> ComplexArray:
        """Factors (9,) 1 + iη on the independent stiffnesses."""
        own = [self.normal if int(term[0]) <= 3 else self.shear for term in STIFFNESS_TERMS]
        return 1 + 1j * np.array(own)


@dataclass(frozen=True)
class State:
    """Everything that decides the vibrations of a reduced reed.

    Attributes
    ----------
    law : CaneLaw
    change : Change
    air : AirMatrices, optional
        Vacuum if not given.
    air_fraction : float
        Density of the air as a fraction of normal air.
    """

    law: CaneLaw
    change: Change = Change()
    air: AirMatrices | None = None
    air_fraction: float = 1.0


@dataclass(frozen=True)
class Coordinates:
    """Coordinates in which some parts of a reed are solved for together.

    Attributes
    ----------
    parts : tuple of int
        Numbers of the parts.
    everywhere : (n,) int
        Numbers of their coordinates among those of all parts: first those with the strips at rest,
        then those in which they move.
    held : int
        Number of the former.
    low : (l,) int
        Positions of coordinates that are kept when others are condensed: the lowest modes of the
        middle cane, part after part, and those that springs hold.
    counts : tuple of int
        Number of these modes of each part.
    strip : (c, k) float
        Motion of the strips for each of k coordinates that a unit spring holds.
    """

    parts: tuple[int, ...]
    everywhere: NDArray[np.intp]
    held: int
    low: NDArray[np.intp]
    counts: tuple[int, ...]
    strip: Array

    def lowest(self, count: int) -> NDArray[np.intp]:
        """Positions among `low` of the `count` lowest of each part, and of all held by springs."""
        starts = np.cumsum([0, *self.counts])
        each = [
            start + np.arange(min(count, own))
            for start, own in zip(starts[:-1], self.counts, strict=True)
        ]
        return np.concatenate([*each, np.arange(starts[-1], len(self.low))])

    def ordered(self, matrices: Array) -> Array:
        """Matrices (…, n, n) of the parts side by side, in the order of `everywhere`."""
        if len(self.parts) == 1:
            return matrices
        order = np.searchsorted(np.sort(self.everywhere), self.everywhere)
        return np.asarray(matrices[..., order[:, None], order])

    def at_springs(self, matrices: Array) -> Array:
        """Matrices (…, n, n), with the motion of the strips in coordinates held by unit springs."""
        if not self.strip.size:
            return matrices[..., : self.held, : self.held]
        columns = np.concatenate(
            [matrices[..., : self.held], matrices[..., self.held :] @ self.strip], axis=-1
        )
        return np.concatenate(
            [columns[..., : self.held, :], self.strip.T @ columns[..., self.held :, :]], axis=-2
        )

    def everywhere_of(self, vectors: Array, size: int) -> Array:
        """Coordinates (s, m) of all parts, of vectors (held + k, m)."""
        found = np.zeros((size, vectors.shape[1]), dtype=vectors.dtype)
        found[self.everywhere[: self.held]] = vectors[: self.held]
        found[self.everywhere[self.held :]] = self.strip @ vectors[self.held :]
        return found


def coordinates_of(reed: ReducedReed, change: Change, highest_hz: float) -> list[Coordinates]:
    """Coordinates of each part, or of all together if a change couples them.

    Parameters
    ----------
    reed : ReducedReed
    change : Change
    highest_hz : float
        Modes of the middle cane up to here are called low.
    """
    count = len(reed.loose)
    groups = [tuple(range(count))] if _couples(reed, change) else [(k,) for k in range(count)]
    return [_coordinates(reed, change, group, highest_hz) for group in groups]


def _couples(reed: ReducedReed, change: Change) -> bool:
    """Whether a change makes motions of one part excite another."""
    blocks = (change.stiffness_terms, change.mass, change.mass_kg)
    if any(a != b for own in blocks for a, b in own):
        return True
    compliance = change.compliance_m_n
    half = len(reed.strip) // 2
    return len(reed.loose) > 1 and compliance is not None and bool(compliance[:half, half:].any())


def _coordinates(
    reed: ReducedReed, change: Change, group: tuple[int, ...], highest_hz: float
) -> Coordinates:
    parts = list(reed.loose.values())
    held, low, at = [], [], 0
    for number in group:
        part = parts[number]
        held.append(reed.starts[number] + np.arange(part.held))
        low.append(at + np.arange(np.searchsorted(part.middle_hz, highest_hz)))
        at += part.held
    each = len(reed.strip) // len(parts)
    own = np.concatenate([number * each + np.arange(each) for number in group])
    strip = np.zeros((len(own), 0))
    if change.compliance_m_n is not None:
        values, vectors = linalg.eigh(change.compliance_m_n[np.ix_(own, own)])
        kept = values > _LEAST_COMPLIANCE * max(values.max(), 0.0)
        strip = vectors[:, kept] * np.sqrt(values[kept])
    return Coordinates(
        parts=group,
        everywhere=np.concatenate([*held, reed.strip[own]]),
        held=at,
        low=np.concatenate([*low, at + np.arange(strip.shape[1])]),
        counts=tuple(len(positions) for positions in low),
        strip=strip,
    )


@dataclass(frozen=True)
class Dynamics:
    """Dynamic stiffness of some parts of a reed.

    Attributes
    ----------
    matrices : (i, n, n) float
        Stiffness per direction of the cane, mass in kg, mass of air; with a clamp that yields the
        springs of its coordinates come last.
    table : StiffnessTable
    air : CubicSpline, optional
        Amounts of the matrices of air.
    air_fraction : float
    """

    matrices: Array
    table: StiffnessTable
    air: CubicSpline | None
    air_fraction: float

    def amounts(self, hz: Array) -> tuple[Array, Array]:
        """Amounts of all matrices at frequencies (m,), and derivatives by ln f: two (m, i)."""
        cane, by_log = self.table.amounts(hz)
        squares = -((2 * np.pi * hz[:, None]) ** 2)
        values, slopes = [cane, squares], [by_log, 2 * squares]
        if self.air is not None:
            at = np.log(hz)
            own, slope = (squares * self.air_fraction * self.air(at, nu) for nu in (0, 1))
            values.append(own)
            slopes.append(2 * own + slope)
        missing = len(self.matrices) - sum(part.shape[1] for part in values)
        values.append(np.ones((len(hz), missing)))
        slopes.append(np.zeros((len(hz), missing)))
        return np.hstack(values), np.hstack(slopes)

    @property
    def elastic(self) -> NDArray[np.bool_]:
        """Which matrices (i,) are stiffnesses; the others are masses."""
        marks = np.ones(len(self.matrices), dtype=bool)
        first = len(self.table.directions)
        marks[first : first + 1 + (self.air.c.shape[2] if self.air is not None else 0)] = False
        return marks


def dynamics_of(reed: ReducedReed, state: State, coordinates: Coordinates) -> Dynamics:
    """Dynamic stiffness in coordinates whose strips are held by unit springs."""
    loose = loose_dynamics_of(reed, state, coordinates)
    stacked = coordinates.at_springs(loose.matrices)
    springs = coordinates.strip.shape[1]
    if springs:
        own = np.zeros_like(stacked[:1])
        own[0, -springs:, -springs:] = np.eye(springs)
        stacked = np.concatenate([stacked, own])
    return Dynamics(stacked, loose.table, loose.air, loose.air_fraction)


def loose_dynamics_of(reed: ReducedReed, state: State, coordinates: Coordinates) -> Dynamics:
    """Dynamic stiffness of a reed whose strips are free to move."""
    table, change, group = state.law.table, state.change, coordinates.parts
    parts = list(reed.loose.values())
    sizes = [part.size for part in parts]
    terms = gathered([p.stiffness_terms for p in parts], change.stiffness_terms, group, sizes)
    size = terms.shape[-1]
    stiff = (table.directions @ terms.reshape(9, -1)).reshape(-1, size, size)
    mass = gathered([part.mass for part in parts], change.mass, group, sizes)
    mass = state.law.constants.density_kg_m3 * mass
    if change.mass_kg:
        mass = mass + gathered(None, change.mass_kg, group, sizes)
    matrices = [stiff, mass[None]]
    if state.air is not None:
        matrices.append(gathered(state.air.mass_kg, {}, group, sizes))
    air = state.air.amounts if state.air is not None else None
    stacked = coordinates.ordered(np.concatenate(matrices))
    return Dynamics(stacked, table, air, state.air_fraction)


def gathered(
    own: Sequence[Array] | None, blocks: Blocks, group: tuple[int, ...], sizes: Sequence[int]
) -> Array:
    """Matrix (…, n, n) of some parts: their own, and blocks that a change adds."""
    if len(group) == 1 and own is not None:
        (k,) = group
        return own[k] + blocks[k, k] if (k, k) in blocks else own[k]
    bounds = np.cumsum([0, *(sizes[k] for k in group)])
    cuts = {k: slice(*ends) for k, ends in zip(group, pairwise(bounds.tolist()), strict=True)}
    leading = own[group[0]].shape[:-2] if own else next(iter(blocks.values())).shape[:-2]
    whole = np.zeros((*leading, bounds[-1], bounds[-1]))
    for k in group if own else ():
        whole[..., cuts[k], cuts[k]] = own[k] if own else 0.0
    for (a, b), block in blocks.items():
        if a in cuts and b in cuts:
            whole[..., cuts[a], cuts[b]] += block
            if a != b:
                whole[..., cuts[b], cuts[a]] += np.swapaxes(block, -1, -2)
    return whole
