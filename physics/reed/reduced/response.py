"""Forced vibration of a reed under a pressure on its flat side."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy import linalg

from holography.arrays import Array, ComplexArray
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import ViscoelasticCane
from physics.reed.elements.fem import Symmetry
from physics.reed.modes import at_frequency
from physics.reed.reduced.changes import Change, as_matrix
from physics.reed.reduced.dynamics import LossFactors, coordinates_of
from physics.reed.reduced.reed import ReducedReed, ReedPart

Pressure = Callable[[float, Array, Array], ComplexArray]
Forces = dict[Symmetry | None, ComplexArray]

# Numbers of polynomials that are tried one after another, and the share of the force by which the
# last quarter of them may differ from nothing.
_COUNTS, _NEGLIGIBLE = (32, 64, 128, 256), 1e-6
# Step of ln f of differences of projected pressures. Chosen: a hundredth of half the width of a
# resonance of quality 5000, of which it gives the slope to 1e-4.
_STEP = 1e-6


@dataclass(frozen=True)
class PressureForce:
    """Generalised forces of a pressure on the coordinates of a reed, at any frequency.

    Attributes
    ----------
    reed : ReducedReed
    pressure : callable
        See `forced_response`.
    highest_hz : float
        Up to here forces are polynomials of frequency; beyond, the pressure is projected again.
    coefficients : dict of (n, s) complex
        Of Chebyshev polynomials, per part of the reed, its strips free to move.
    """

    reed: ReducedReed
    pressure: Pressure
    highest_hz: float
    coefficients: Forces

    def at(self, hz: float, *, loose: bool = False) -> Forces:
        """Forces (r,) per part, in N; `loose` as in `pressure_forces`."""
        if not self._followed(hz):
            return pressure_forces(self.reed, hz, self.pressure, loose=loose)
        angle = np.arccos(2 * hz / self.highest_hz - 1)
        count = len(next(iter(self.coefficients.values())))
        polynomials = np.cos(angle * np.arange(count))
        found = {key: polynomials @ own for key, own in self.coefficients.items()}
        return found if loose else _held(self.reed, found)

    def _followed(self, hz: float) -> bool:
        return 0 <= hz <= self.highest_hz

    def by_ln_hz(self, hz: float) -> Forces:
        """Derivatives (r,) of the forces by ln f, per part; differences where `at` projects."""
        if not self._followed(hz):
            ahead, behind = (
                pressure_forces(self.reed, hz * float(np.exp(step)), self.pressure)
                for step in (_STEP, -_STEP)
            )
            return {key: (own - behind[key]) / (2 * _STEP) for key, own in ahead.items()}
        place, scale = 2 * hz / self.highest_hz - 1, 2 * hz / self.highest_hz
        found = {
            key: np.asarray(scale * chebyshev.chebval(place, chebyshev.chebder(own)))
            for key, own in self.coefficients.items()
        }
        return _held(self.reed, found)


def _held(reed: ReducedReed, forces: Forces) -> Forces:
    """Forces on the coordinates that leave the strips at rest."""
    return {key: own[: reed.loose[key].held] for key, own in forces.items()}


def pressure_forces(
    reed: ReducedReed, hz: float, pressure: Pressure | PressureForce, *, loose: bool = False
) -> Forces:
    """Generalised forces (r,) of a pressure at a frequency, per part of the reed.

    Parameters
    ----------
    reed : ReducedReed
    hz : float
    pressure : callable or PressureForce
        See `forced_response`.
    loose : bool
        Whether forces on coordinates in which the strips of the clamp move are wanted, too.
    """
    if isinstance(pressure, PressureForce):
        return pressure.at(hz, loose=loose)
    x, y = reed.load_points_m.T
    return {
        key: _pressure_on(key, pressure, hz, x, y) @ part.load_z
        for key, part in (reed.loose if loose else reed.parts).items()
    }


def pressure_force(
    reed: ReducedReed, pressure: Pressure, highest_hz: float = 25e3
) -> PressureForce:
    """Project a pressure once for all frequencies.

    Polynomials of frequency follow a standing wave with a third of the projections that splines
    need. Forces are exact to 2e-5 of their norm, or they are projected again at every frequency: a
    pressure with a sharp resonance should leave that to a factor.

    Parameters
    ----------
    reed : ReducedReed
    pressure : callable
        See `forced_response`.
    highest_hz : float
    """
    for count in _COUNTS:
        places = chebyshev.chebpts1(count)
        sampled = [
            pressure_forces(reed, float(hz), pressure, loose=True)
            for hz in 0.5 * highest_hz * (1 + places)
        ]
        to_coefficients = np.linalg.inv(chebyshev.chebvander(places, count - 1))
        coefficients: Forces = {
            key: to_coefficients.astype(complex) @ np.stack([force[key] for force in sampled])
            for key in reed.parts
        }
        if all(_converged(own) for own in coefficients.values()):
            return PressureForce(reed, pressure, highest_hz, coefficients)
    return PressureForce(reed, pressure, -1.0, coefficients)


def _converged(coefficients: ComplexArray) -> bool:
    size = np.linalg.norm(coefficients)
    return bool(np.linalg.norm(coefficients[-len(coefficients) // 4 :]) <= _NEGLIGIBLE * size)


def forced_response(
    reed: ReducedReed,
    cane: ViscoelasticCane,
    loss: float | LossFactors,
    frequencies_hz: Array,
    pressure: Pressure | PressureForce,
    air_fraction: float = 1.0,
) -> dict[Symmetry | None, ComplexArray]:
    """Steady vibration under a sinusoidal pressure on the flat side.

    Solves ``(K(ω)(1 + iη) − ω²M + iωR) q = F`` at every frequency, with the storage moduli and air
    of that frequency and a loss factor η of its own (see decisions 0004 and 0026).

    Parameters
    ----------
    reed : ReducedReed
    cane : ViscoelasticCane
    loss : float or LossFactors
        Ratio η of dissipated to stored energy per radian.
    frequencies_hz : (k,) float
    pressure : callable or PressureForce
        ``pressure(frequency_hz, x_m, y_m)`` gives complex pressures in Pa at points of the flat
        side, y of either sign; positive pushes towards the bark side (+z).
    air_fraction : float
        Density of the air as a fraction of normal air; 0 is a vacuum.

    Returns
    -------
    dict of (k, r) complex
        Reduced coordinates in m, per part of the reed, time factor exp(+iωt).
    """
    each = [
        response_at(reed, at_frequency(reed.cane, cane, hz), loss, hz, pressure, air_fraction)
        for hz in frequencies_hz.tolist()
    ]
    return {key: np.stack([response[key] for response in each]) for key in reed.parts}


def response_at(
    reed: ReducedReed,
    material: Cane,
    loss: float | LossFactors,
    hz: float,
    pressure: Pressure | PressureForce,
    air_fraction: float = 1.0,
) -> Forces:
    """Steady vibration (r,) at one frequency, per part; see `forced_response`.

    Parameters
    ----------
    reed : ReducedReed
    material : Cane
        All constants, at this frequency.
    loss, hz, pressure, air_fraction
        See `forced_response`.
    """
    forces = pressure_forces(reed, hz, pressure)
    in_air = _air_of(reed, hz, air_fraction)
    return {
        key: _solve(part, material, _losses(loss), hz, forces[key], added)
        for (key, part), added in zip(reed.parts.items(), in_air, strict=True)
    }


def response_of_changed(
    reed: ReducedReed,
    change: Change,
    material: Cane,
    loss: float | LossFactors,
    hz: float,
    force_n: ComplexArray,
    *,
    air_fraction: float = 1.0,
    added_n_m: Array | None = None,
) -> ComplexArray:
    """Steady vibration (s,) of a changed reed under forces (s,), in the coordinates of all parts.

    Solves ``(Σ C_k(1 + iη_k) K_k - ω²M + iωR) q = F``, with the springs of the clamp in addition.

    Parameters
    ----------
    reed : ReducedReed
    change : Change
    material : Cane
        All constants, at this frequency.
    loss : float or LossFactors
    hz : float
    force_n : (s,) complex
    air_fraction : float
        See `forced_response`.
    added_n_m : (s, s) float, optional
        More stiffness, with the loss factor of normal strains.
    """
    losses, omega = _losses(loss), 2 * np.pi * hz
    terms = stiffness_terms_pa(material) * losses.of_terms
    stiffness_terms = reed.stiffness_terms
    if change.stiffness_terms:
        stiffness_terms = stiffness_terms + as_matrix(reed, change.stiffness_terms)
    mass = material.density_kg_m3 * reed.mass
    for factor, blocks in ((material.density_kg_m3, change.mass), (1.0, change.mass_kg)):
        if blocks:
            mass = mass + factor * as_matrix(reed, blocks)
    dynamic = np.tensordot(terms, stiffness_terms, axes=1) - omega**2 * mass
    if added_n_m is not None:
        dynamic = dynamic + (1 + 1j * losses.normal) * added_n_m
    if reed.air is not None and air_fraction:
        dynamic = dynamic + linalg.block_diag(*_air_of(reed, hz, air_fraction))
    moved = np.zeros(len(force_n), dtype=complex)
    for own in coordinates_of(reed, change, 0.0):
        rows, held = own.everywhere, own.held
        matrix = own.at_springs(dynamic[np.ix_(rows, rows)])
        springs = np.diag(np.arange(len(matrix)) >= held) * (1 + 1j * losses.clamp)
        matrix = matrix + springs
        force = np.concatenate([force_n[rows[:held]], own.strip.T @ force_n[rows[held:]]])
        moved += own.everywhere_of(np.linalg.solve(matrix, force)[:, None], len(moved))[:, 0]
    return moved


def _air_of(reed: ReducedReed, hz: float, air_fraction: float) -> list[ComplexArray]:
    """Dynamic stiffness (s, s) of the air, per part."""
    if reed.air is None or not air_fraction:
        return [np.zeros((part.size,) * 2, dtype=complex) for part in reed.loose.values()]
    omega = 2 * np.pi * hz
    return [
        air_fraction * (1j * omega * resistance - omega**2 * mass)
        for mass, resistance in reed.air.at(hz)
    ]


def _losses(loss: float | LossFactors) -> LossFactors:
    return loss if isinstance(loss, LossFactors) else LossFactors(loss, loss)


def _pressure_on(
    key: Symmetry | None, pressure: Pressure, hz: float, x_m: Array, y_m: Array
) -> ComplexArray:
    """What of a pressure moves the part of a symmetry; all of it, a part of any shape."""
    if key is None:
        return pressure(hz, x_m, y_m)
    sign = 1 if key is Symmetry.SYMMETRIC else -1
    return 0.5 * (pressure(hz, x_m, y_m) + sign * pressure(hz, x_m, -y_m))


def _solve(
    part: ReedPart,
    material: Cane,
    losses: LossFactors,
    hz: float,
    load: ComplexArray,
    air: ComplexArray,
) -> ComplexArray:
    terms = stiffness_terms_pa(material) * losses.of_terms
    omega2 = (2 * np.pi * hz) ** 2
    dynamic = np.tensordot(terms, part.stiffness_terms, axes=1).astype(complex)
    dynamic -= omega2 * material.density_kg_m3 * part.mass
    dynamic += air[: part.held, : part.held]
    answer: ComplexArray = np.linalg.solve(dynamic, load)
    return answer
