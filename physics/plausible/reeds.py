"""Plausible reeds of one kind: which parameters vary, how far, and the modes that follow.

Cane varies as in the paper's population and as handbooks say, the thickness of the vamp, the clamp
and the air as on an ordinary bench (`physics.parameters.disorder`). All parameters are in standard
deviations, with independent normal distributions. Real reeds differ from every such model: each
mode has a shift of its own, and close modes a coupling, of a width that whoever uses them has to
know.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from holography.arrays import Array
from physics.alterations import BED_SHEAR_SPREAD, RandomLayer
from physics.effects.catalogue import BY_ID
from physics.mechanics import CaneShift, cane_law
from physics.parameters.disorder import BY_NAME
from physics.plausible.nearby import NearbyReeds
from physics.plausible.surfaces import ThicknessFunctions
from physics.reed.cane.material import STIFFNESS_TERMS, terms_and_slopes
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.geometry import half_width_m
from physics.reed.reduced.changes import BED_SHEAR, Change, combined, yielding_clamp
from physics.reed.reduced.derivatives import DENSITY, PARAMETERS, derivatives
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.reed import ReducedReed
from physics.reed.reduced.vibrations import Vibrations, vibrations

# Modes up to here are computed: those above still mix into the highest of a sweep (20 kHz).
_HIGHEST_HZ = 26e3
# Step of numerical derivatives of moduli by components of the cane, which are linear in them.
_STEP = 1e-3
_CONSTANTS = ("E_T", "E_R", "G_LR", "G_TR", "density", "nu_LT", "nu_LR", "nu_TR")
# Frequencies of 55 reeds are 30.4 cents (rms) off those of H4 (paper, Table 4a), as by moduli that
# are off by twice as much, because frequencies follow their square root.
_LEVEL = 2 * 30.4 * float(np.log(2)) / 1200
# One standard deviation by which E_L and G_LT, and their growth with frequency, leave hypothesis
# H4, as fields of a `CaneShift` (decisions 0049 and 0059).
BEYOND_H4 = {
    "E_L": _LEVEL,
    "G_LT": _LEVEL,
    **{f"growth_{each.name}": each.spread for each in BY_ID["viscoelastic_stiffening"].parameters},
}
# Name of the first parameter that is not of the cane.
_FIRST_LAYER = "thickness 1"
_SHAPE = ("thickness_slope", "clamp_shift", "clamp_tilt")
# How far the clamp yields, and how many times more along the reed.
_CLAMP = ("clamp_compliance", "bed_shear")
(_COMPLIANCE,) = BY_ID["clamp_compliance"].parameters
# Steps of standard deviations for derivatives by these. Chosen: small next to 1, where they bend.
_CLAMP_STEP = 1e-4
_CENT = float(np.log(2) / 1200)
# Modes of one symmetry that are farther apart in the reference do not exchange their characters.
# Chosen: three times the repulsion of X1 and L1 (109 cents), the strongest of the paper's reed.
_CLOSE_CENTS = 350.0


def _ordinary(name: str) -> float:
    return BY_NAME[name].ordinary.deviation


@dataclass(frozen=True)
class PlausibleReeds:
    """All reeds of one kind that are plausible in a series, with p parameters.

    The m modes of the reference, the reed in the middle, are the coordinates of thickness, of the
    clamp's place and of air, which act on them to first order. Cane, and how far the clamp yields,
    act exactly.

    Attributes
    ----------
    reed : ReducedReed
    series : Series
    names : tuple of str
        Parameters: components and constants of the cane, with the level and growth of E_L and G_LT
        where they are free (see `with_free_moduli`), then how the clamp yields, then thickness,
        place of the clamp and air, then the shift of each mode of the reference, and the coupling
        of those that are close, in cents.
    reference : Vibrations
        Of the reed whose parameters are all 0, in vacuum.
    stiffness : (d, 9, m, m) float
        What one standard deviation of each parameter that is not cane adds to the stiffness between
        these modes, per unit of each stiffness of the cane.
    mass : (d, m, m) float
        What it adds to their mass, per unit density.
    air_mass : (m, m) float
        Mass of free air between these modes.
    characters : (m, m) float
        Motions of one character each, as sums of the modes of the reference: shifts are theirs.
        Near an avoided crossing a mode has two characters (see `_characters`).
    close : tuple of (int, int)
        Characters of one symmetry that are so close that modes may exchange them.
    """

    reed: ReducedReed
    series: Series
    names: tuple[str, ...]
    reference: Vibrations
    stiffness: Array
    mass: Array
    air_mass: Array
    characters: Array
    close: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, reed: ReducedReed, series: Series) -> "PlausibleReeds":
        """Set up the parameters for a kind of reed.

        Parameters
        ----------
        reed : ReducedReed
        series : Series
        """
        components = ("e1", "e2", "e3") if series is Series.A else ("e1", "e2", "e3", "e4")
        middle = dict.fromkeys((*components, *_CONSTANTS, *_CLAMP), 0.0)
        law = _law(reed, series, middle)
        reference = vibrations(reed, State(law, _clamp(reed, middle)), _HIGHEST_HZ)
        thickness = _thickness(reed)
        stiffness, mass = _layers(reference, thickness)
        moved_stiffness, moved_mass = _moved_clamp(reference)
        layers = tuple(f"thickness {k + 1}" for k in range(thickness.shape[1] - 1))
        close = _close_modes(reference)
        shifts = tuple(f"shift {k + 1}" for k in range(len(reference.hz)))
        shifts += tuple(f"coupling {one + 1} {other + 1}" for one, other in close)
        return cls(
            reed=reed,
            series=series,
            names=(*components, *_CONSTANTS, *_CLAMP, *layers, *_SHAPE, "air", *shifts),
            reference=reference,
            stiffness=np.concatenate([stiffness, moved_stiffness]),
            mass=np.concatenate([mass, moved_mass]),
            air_mass=_air_mass(reference),
            characters=_characters(reference),
            close=close,
        )

    def near(self, parameters: Array) -> NearbyReeds:
        """Return the reeds near one whose parameters are given.

        Parameters
        ----------
        parameters : (p,) float

        Raises
        ------
        ImpossibleReedError
            If no material has its moduli.
        """
        values = dict(zip(self.names, parameters.tolist(), strict=True))
        state = State(self.law(parameters), _clamp(self.reed, values))
        found = vibrations(self.reed, state, _HIGHEST_HZ)
        stiffness, mass = self._by_others(found)
        exactly = self._by_cane_and_clamp(found, values)
        start = parameters.copy()
        start[self._first_layer :] = 0.0
        return NearbyReeds(
            found,
            start,
            self.names.index("air"),
            self.characters.T @ self._turned(found),
            np.concatenate([exactly, stiffness]),
            np.concatenate([np.zeros_like(exactly), mass]),
        )

    def with_free_moduli(self) -> "PlausibleReeds":
        """Return the same reeds, of cane whose E_L and G_LT may leave hypothesis H4.

        The law of the paper is that of one brand. It is good for telling modes apart; how fast
        moduli grow near a mode is known less well than by it.
        """
        count = self.clamp
        return replace(self, names=(*self.names[:count], *BEYOND_H4, *self.names[count:]))

    def law(self, parameters: Array) -> CaneLaw:
        """Return the cane of the reed with parameters (p,)."""
        return _law(self.reed, self.series, dict(zip(self.names, parameters.tolist(), strict=True)))

    @property
    def moduli(self) -> NDArray[np.intp]:
        """Numbers of the parameters that E_L and G_LT follow: components, and what leaves H4."""
        free = enumerate(self.names[: self.clamp])
        return np.array([number for number, name in free if name not in _CONSTANTS])

    @property
    def clamp(self) -> int:
        """Number of the parameter by which the clamp yields."""
        return self.names.index(_CLAMP[0])

    @property
    def shifts(self) -> slice:
        """Which parameters are shifts of modes, and couplings, in cents."""
        count = len(self.reference.hz) + len(self.close)
        return slice(len(self.names) - count, len(self.names))

    @cached_property
    def parts(self) -> NDArray[np.intp]:
        """Number (m,) of the part of the reed that moves in each mode of the reference."""
        return _parts(self.reference)

    @property
    def _first_layer(self) -> int:
        return self.names.index(_FIRST_LAYER)

    def _shifted(self, turned: Array) -> Array:
        """Return what shifts and couplings add (c, m, m), for modes as sums of characters (r, m).

        As of a random symmetric matrix, in any basis: couplings have half the variance of shifts.
        """
        own = turned[:, :, None] * turned[:, None, :]
        pairs = [np.multiply.outer(turned[one], turned[other]) for one, other in self.close]
        coupled = [(pair + pair.T) / np.sqrt(2) for pair in pairs]
        return np.concatenate([own, np.reshape(coupled, (-1, *own.shape[1:]))])

    def _turned(self, found: Vibrations) -> Array:
        """Return modes as sums of those of the reference (r, m), of unit mass in both."""
        density = self.reference.state.law.constants.density_kg_m3
        mass = density * self.reed.mass
        return np.asarray(self.reference.coordinates.T @ mass @ found.coordinates)

    def _by_cane_and_clamp(self, found: Vibrations, values: Mapping[str, float]) -> Array:
        """Return the couplings (c, m, m) of parameters of the cane, and of how the clamp yields."""
        yielding = {name: _clamp_slope(self.reed, values, name) for name in _CLAMP}
        slopes, law = derivatives(found, list(yielding.values())).couplings, found.state.law
        answer: list[Array] = []
        known = (*PARAMETERS, *yielding)
        at = {name: slopes[..., number] for number, name in enumerate(known)}
        for name in self.names[: self._first_layer]:
            if name in yielding:
                answer.append(at[name])
            elif name in BEYOND_H4:
                slope = at[name if name.startswith("growth") else f"ln {name}_pa"]
                answer.append(BEYOND_H4[name] * slope)
            elif name not in _CONSTANTS:
                moved = _law(self.reed, self.series, {**values, name: values[name] + _STEP})
                grown = np.log(moved.constants_at(found.hz) / law.constants_at(found.hz)) / _STEP
                # A coupling takes the mean of both modes: moduli change little between close ones.
                both = 0.5 * (grown[:, None] + grown[None, :])
                answer.append(both[..., 0] * at["ln E_L_pa"] + both[..., 3] * at["ln G_LT_pa"])
            elif name == "density":
                answer.append(_ordinary(name) * at["ln density_kg_m3"])
            elif name.startswith("nu"):
                answer.append(_ordinary(name) * getattr(law.constants, name) * at[name])
            else:
                answer.append(_ordinary(name) * at[f"ln {name}_pa"])
        return np.stack(answer)

    def _by_others(self, found: Vibrations) -> tuple[Array, Array]:
        """Return what all other parameters add to stiffness and mass, each (d + 1 + m, m, m)."""
        law = found.state.law
        turned = self._turned(found)
        terms = terms_and_slopes(law.constants_at(found.hz))[0]
        stiffness = np.einsum(
            "rm,dtrs,sn,nt->dmn", turned, self.stiffness, turned, terms, optimize=True
        )
        mass = law.constants.density_kg_m3 * self.mass
        inert = turned.T @ np.concatenate([mass, self.air_mass[None]]) @ turned
        # Moduli that grow with frequency make modes follow more than ω = √(k/m): by the density,
        # whose load is -ω², one sees how much.
        follow = np.sqrt(-2 * np.diag(derivatives(found).couplings[..., DENSITY]))
        omega = 2 * np.pi * found.hz
        elastic = np.zeros_like(inert)
        elastic[:-1] = 0.5 * (stiffness + stiffness.transpose(0, 2, 1))
        scale = follow / omega
        shifted = _CENT * self._shifted(self.characters.T @ turned)
        inert = inert * np.multiply.outer(follow, follow)
        return (
            np.concatenate([0.5 * elastic * np.multiply.outer(scale, scale), shifted]),
            np.concatenate([inert, np.zeros_like(shifted)]),
        )


def _law(reed: ReducedReed, series: Series, cane: Mapping[str, float]) -> CaneLaw:
    """Return the cane of a reed whose parameters are given in standard deviations."""
    components = Components(**{f.name: cane.get(f.name, 0.0) for f in fields(Components)})
    constants = {name: _ordinary(name) * cane[name] for name in _CONSTANTS}
    moduli = {name: spread * cane.get(name, 0.0) for name, spread in BEYOND_H4.items()}
    shift = CaneShift(**constants, **moduli)
    return cane_law(reed.cane, viscoelastic_cane(components, series), shift)


def _clamp(reed: ReducedReed, values: Mapping[str, float]) -> Change:
    """Return what a clamp changes whose parameters are given in standard deviations.

    It never yields less than nothing: compliances are half of a normal distribution.
    """
    compliance_m_pa = _COMPLIANCE.spread * float(ndtri(0.5 + 0.5 * ndtr(values[_CLAMP[0]])))
    along = BED_SHEAR * np.exp(BED_SHEAR_SPREAD * values[_CLAMP[1]])
    return yielding_clamp(reed, compliance_m_pa, compliance_m_pa, along=along)


def _clamp_slope(reed: ReducedReed, values: Mapping[str, float], name: str) -> Change:
    """Return the derivative of `_clamp` by one of its parameters."""
    step = 0.5 * _CLAMP_STEP
    ends = [(side / _CLAMP_STEP, {**values, name: values[name] + side * step}) for side in (1, -1)]
    return combined((by, _clamp(reed, end)) for by, end in ends)


def _characters(reference: Vibrations) -> Array:
    """Return motions of one character each (m, m), as sums of modes, in columns.

    Of all motions in a part, as many as have more than half of their energy outside the vamp are
    those with the most energy there. Each is the one nearest to its mode, as the others are.
    """
    parts, outside = _parts(reference), _outside(reference)
    answer = np.zeros_like(outside)
    for part in np.unique(parts):
        own = np.flatnonzero(parts == part)
        foreign = np.diag(outside)[own] > 0.5
        _, vectors = np.linalg.eigh(outside[np.ix_(own, own)])
        vamp = vectors[:, : np.count_nonzero(~foreign)]
        inner = vamp @ vamp.T
        nearest = np.where(foreign, np.eye(len(own)) - inner, inner)
        left, _, right = np.linalg.svd(nearest)
        answer[np.ix_(own, own)] = left @ right
    return answer


def _outside(reference: Vibrations) -> Array:
    """Return the form (m, m) of the energy sideways and behind the vamp, over all energy."""
    reed, x = reference.reed, reference.coordinates
    total = np.zeros((x.shape[1], x.shape[1]))
    for start, part in zip(reed.starts, reed.loose.values(), strict=True):
        rows = x[start : start + part.size]
        for own in part.measures.values():
            total += rows.T @ (own.lateral_mass + own.heel_mass) @ rows
    return np.asarray(reference.state.law.constants.density_kg_m3 * total)


def _close_modes(reference: Vibrations) -> tuple[tuple[int, int], ...]:
    """Return pairs of modes of one part that are within `_CLOSE_CENTS`."""
    parts, cents = _parts(reference), np.log(reference.hz) / _CENT
    return tuple(
        (one, other)
        for one, other in combinations(range(len(cents)), 2)
        if parts[one] == parts[other] and cents[other] - cents[one] < _CLOSE_CENTS
    )


def _thickness(reed: ReducedReed) -> Array:
    """Return thicknesses (2, f, b) in m: at the bark points, and at their mirror images.

    One standard deviation of each of f independent functions.
    """
    kind, rms_m = RandomLayer(0), BY_NAME["thickness_map"].ordinary.root_mean_square
    functions = ThicknessFunctions.of(reed.geometry, kind.correlation_x_m, kind.correlation_y_m)
    x_m, y_m = reed.bark_m.T
    half_m = np.maximum(half_width_m(reed.geometry.outline, x_m), 1e-6)
    slope = _ordinary("thickness_slope") * y_m / half_m
    answer = [
        np.concatenate([rms_m * functions.at(x_m, side * y_m), side * slope[None]])
        for side in (1.0, -1.0)
    ]
    on_vamp = x_m < reed.geometry.vamp_x_m[-1]
    return np.asarray(np.stack(answer, axis=0) * on_vamp)


def _layers(reference: Vibrations, thickness: Array) -> tuple[Array, Array]:
    """Return stiffness (f, 9, m, m) per unit of each stiffness, and mass, of layers (2, f, b)."""
    reed = reference.reed
    left, right = thickness * reed.area_m2
    parts, (strain, motion) = _parts(reference), _fields(reference)
    if None in reed.loose:
        right = left
    same = parts[:, None] == parts
    even, odd = 0.5 * (left + right), 0.5 * (left - right)

    def products(one: Array, other: Array) -> Array:
        found = np.zeros((len(left), one.shape[1], one.shape[1]))
        for weight, where in ((even, same), (odd, ~same)):
            weighted = (weight[..., None] * other).transpose(1, 0, 2)
            each = (one.T @ weighted.reshape(len(other), -1)).reshape(one.shape[1], len(left), -1)
            found += np.where(where, each.transpose(1, 0, 2), 0.0)
        return found

    stiffness = []
    for term in STIFFNESS_TERMS:
        i, j = int(term[0]) - 1, int(term[1]) - 1
        each = products(strain[i], strain[j])
        stiffness.append(each if i == j else each + each.transpose(0, 2, 1))
    mass = np.sum([products(motion[k], motion[k]) for k in range(3)], axis=0)
    return np.stack(stiffness, axis=1), mass


def _parts(reference: Vibrations) -> NDArray[np.intp]:
    """Return the number (m,) of the part that moves in each mode."""
    reed = reference.reed
    sizes = [part.size for part in reed.loose.values()]
    cuts = np.split(reference.coordinates, np.cumsum(sizes)[:-1])
    return np.asarray(np.argmax([np.abs(cut).max(axis=0) for cut in cuts], axis=0))


def _fields(reference: Vibrations) -> tuple[Array, Array]:
    """Return strains (6, b, m) and displacements (3, b, m) of each mode, in its own part."""
    reed, x, parts = reference.reed, reference.coordinates, _parts(reference)
    strain = np.zeros((6, len(reed.bark_m), x.shape[1]))
    motion = np.zeros((3, len(reed.bark_m), x.shape[1]))
    for number, (start, part) in enumerate(zip(reed.starts, reed.loose.values(), strict=True)):
        own = np.flatnonzero(parts == number)
        strain[..., own] = part.strain @ x[start : start + part.size, own]
        motion[..., own] = part.motion @ x[start : start + part.size, own]
    return strain, motion


def _moved_clamp(reference: Vibrations) -> tuple[Array, Array]:
    """Return stiffness (2, 9, m, m) and mass (2, m, m) of a clamp that is shifted, and turned."""
    edge, x = reference.reed.edge, reference.coordinates
    by = np.array([_ordinary("clamp_shift"), _ordinary("clamp_tilt")])
    stiffness = by[:, None, None, None] * (x.T @ edge.stiffness_terms @ x)
    return stiffness, by[:, None, None] * (x.T @ edge.mass @ x)


def _air_mass(reference: Vibrations) -> Array:
    """Return the mass (m, m) of free air between modes, at the mean of their log frequencies."""
    reed, x = reference.reed, reference.coordinates
    mass = np.zeros((x.shape[1], x.shape[1]))
    if reed.air is None:
        return mass
    owners, log_hz = _parts(reference), np.log(reference.hz)
    for number, (part, moved) in enumerate(zip(reed.loose.values(), reed.air.mass_kg, strict=True)):
        own, start = np.flatnonzero(owners == number), reed.starts[number]
        shapes = x[start : start + part.size, own]
        at = reed.air.amounts(0.5 * np.add.outer(log_hz[own], log_hz[own]))
        each = np.einsum("rm,krq,qn->kmn", shapes, moved, shapes, optimize=True)
        mass[np.ix_(own, own)] = np.einsum("mnk,kmn->mn", at, each)
    return mass
