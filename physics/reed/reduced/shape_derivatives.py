"""Analytic derivatives of shapes, of losses and of forces on modes.

By Nelson's method: the derivative of a mode solves ``Z dx = -(∂Z/∂p + ∂Z/∂ln f · ∂ln f/∂p) x`` in
all coordinates of the reduced reed, bordered by the condition that its mass stays one. Where two
modes are close this derivative is large, because their shapes mix over a small step; over a larger
one they mix as the eigenvectors of `Derivatives.couplings` do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, ComplexArray
from physics.reed.cane.material import terms_and_slopes
from physics.reed.reduced.changes import Change
from physics.reed.reduced.derivatives import (
    AIR_FRACTION,
    GROWTH_E_L,
    GROWTH_G_LT,
    PARAMETERS,
    Derivatives,
    cane_products,
    changed_products,
    derivatives,
)
from physics.reed.reduced.dynamics import (
    E_L,
    G_LT,
    PIVOT_HZ,
    Coordinates,
    Dynamics,
    LossFactors,
    loose_dynamics_of,
)
from physics.reed.reduced.losses import loss_factors, spring_energies
from physics.reed.reduced.reed import CONSTANTS
from physics.reed.reduced.response import Forces, PressureForce
from physics.reed.reduced.vibrations import Vibrations


@dataclass(frozen=True)
class ShapeDerivatives:
    """How the m modes of a reed follow p parameters, shapes included.

    Attributes
    ----------
    changes : tuple of Change
        Whose amounts are the last parameters.
    frequencies : Derivatives
    shapes : (s, m, p) float
        Of `Vibrations.coordinates`.
    """

    changes: tuple[Change, ...]
    frequencies: Derivatives
    shapes: Array


def shape_derivatives(found: Vibrations, changes: Sequence[Change] = ()) -> ShapeDerivatives:
    """Derivatives of frequencies and shapes; parameters as those of `derivatives`."""
    slopes = derivatives(found, changes)
    shapes = np.zeros_like(slopes.loads)
    yields = any(c.compliance_m_n is not None for c in (found.state.change, *changes))
    systems = [_System.of(found, group.coordinates, yields) for group in found.groups]
    for number, rank in enumerate(found.order):
        for m in np.asarray(rank).tolist():
            for other, system in enumerate(systems):
                rows = system.rows
                load = -slopes.loads[rows, m]
                moved = system.compliance_loads(slopes.reactions[:, m], changes, load.shape[1])
                if other == number:
                    mass = -0.5 * slopes.masses[m]
                    shapes[rows, m] = system.bordered(
                        found.hz[m], found.coordinates[rows, m], load, moved, mass
                    )
                elif load.any() or moved.any():
                    shapes[rows, m] = system.solved(found.hz[m], load, moved)
    return ShapeDerivatives(tuple(changes), slopes, shapes)


@dataclass(frozen=True)
class _System:
    """Dynamic stiffness of a group, and the compliance of its strips.

    Attributes
    ----------
    dynamics : Dynamics
        In n coordinates, of which the last c are those of the strips, or are left out.
    rows : (n,) int
        Which of the coordinates of all parts they are.
    strip : (c,) int
        Which of the coordinates of all strips.
    compliance_m_n : (c, c) float
    """

    dynamics: Dynamics
    rows: NDArray[np.intp]
    strip: NDArray[np.intp]
    compliance_m_n: Array

    @classmethod
    def of(cls, found: Vibrations, coordinates: Coordinates, yields: bool) -> "_System":
        whole = loose_dynamics_of(found.reed, found.state, coordinates)
        rows = coordinates.everywhere
        if not yields:
            cut = slice(coordinates.held)
            held = Dynamics(whole.matrices[:, cut, cut], whole.table, whole.air, whole.air_fraction)
            return cls(held, rows[cut], np.zeros(0, dtype=int), np.zeros((0, 0)))
        strip = np.searchsorted(found.reed.strip, rows[coordinates.held :])
        own = found.state.change.compliance_m_n
        compliance = np.zeros((len(strip),) * 2) if own is None else own[np.ix_(strip, strip)]
        return cls(whole, rows, strip, compliance)

    def compliance_loads(self, reactions: Array, changes: Sequence[Change], count: int) -> Array:
        """What more the strips yield (c, p) under their reactions."""
        loads = np.zeros((len(self.strip), count))
        for number, change in enumerate(changes, len(PARAMETERS)):
            if change.compliance_m_n is not None:
                loads[:, number] = (change.compliance_m_n @ reactions)[self.strip]
        return loads

    def _matrix(self, hz: float) -> Array:
        """Dynamic stiffness (n + c, n + c), with the strips' reactions as further unknowns."""
        amounts, _ = self.dynamics.amounts(np.array([hz]))
        Z = np.tensordot(amounts[0], self.dynamics.matrices, axes=1)
        count = len(self.strip)
        if not count:
            return np.asarray(Z)
        moving = np.eye(len(Z))[:, len(Z) - count :]
        return np.block([[Z, moving], [moving.T, -self.compliance_m_n]])

    def solved(self, hz: float, load: Array, moved: Array) -> Array:
        """Motion (n, p) under loads (n, p), away from the modes."""
        answer = np.linalg.solve(self._matrix(hz), np.vstack([load, moved]))
        return np.asarray(answer[: len(load)])

    def bordered(self, hz: float, x: Array, load: Array, moved: Array, mass: Array) -> Array:
        """Derivative (n, p) of a mode x (n,); mass (p,) is half of what it may gain."""
        matrix = self._matrix(hz)
        amounts, slopes = self.dynamics.amounts(np.array([hz]))
        square = (2 * np.pi * hz) ** 2
        inertial = ~self.dynamics.elastic
        products = self.dynamics.matrices @ x
        size = len(matrix)
        whole = np.zeros((size + 1, size + 1))
        whole[:size, :size] = matrix
        whole[: len(x), size] = slopes[0] @ products
        whole[size, : len(x)] = -(amounts[0] * inertial) @ products / square
        # Mass of the air depends on frequency.
        grown = -(slopes[0] - 2 * amounts[0]) * inertial / square
        whole[size, size] = 0.5 * float(grown @ (products @ x))
        answer = np.linalg.solve(whole, np.vstack([load, moved, mass[None]]))
        return np.asarray(answer[: len(x)])


def loss_derivatives(found: Vibrations, losses: LossFactors, slopes: ShapeDerivatives) -> Array:
    """Derivatives (m, p) of `loss_factors`, those by the loss factors themselves left out."""
    law, x = found.state.law, found.coordinates
    stiffnesses, by_constants = terms_and_slopes(law.constants_at(found.hz))
    directions, by_ln_hz = law.table.directions, law.table.amounts(found.hz)[1]
    products = cane_products(found)
    energies = np.einsum("sm,tsm->mt", x, products, optimize=True)
    ln_hz = slopes.frequencies.ln_hz
    stored = 2 * np.einsum("mt,tsm,smp->mtp", stiffnesses, products, slopes.shapes, optimize=True)
    stored += (by_ln_hz @ directions * energies)[..., None] * ln_hz[:, None, :]
    by_law = energies[..., None] * by_constants
    log_ratio = np.log(found.hz / PIVOT_HZ)[:, None]
    stored[..., : len(CONSTANTS)] += by_law
    stored[..., GROWTH_E_L] += log_ratio * by_law[..., E_L]
    stored[..., GROWTH_G_LT] += log_ratio * by_law[..., G_LT]
    springs = 2 * np.einsum(
        "cm,cmp->mp", slopes.frequencies.reactions, slopes.shapes[found.reed.strip]
    )
    for number, change in enumerate(slopes.changes, len(PARAMETERS)):
        if change.stiffness_terms:
            grown = np.einsum("sm,tsm->mt", x, changed_products(found, change))
            stored[..., number] += stiffnesses * grown
        if change.compliance_m_n is not None:
            f = slopes.frequencies.reactions
            springs[:, number] -= np.einsum("cm,cd,dm->m", f, change.compliance_m_n, f)
    kept = (energies * stiffnesses).sum(axis=1) + spring_energies(found)
    radiated, by_radiation = _radiated(found, slopes)
    share = loss_factors(found, losses) - radiated
    lost = np.einsum("mtp,t->mp", stored, losses.of_terms.imag) + losses.clamp * springs
    gained = stored.sum(axis=1) + springs
    return np.asarray((lost - share[:, None] * gained) / kept[:, None] + by_radiation)


def _radiated(found: Vibrations, slopes: ShapeDerivatives) -> tuple[Array, Array]:
    """Loss factors by radiation (m,), and their derivatives (m, p)."""
    ln_hz, state = slopes.frequencies.ln_hz, found.state
    value, slope = np.zeros(len(found.hz)), np.zeros_like(ln_hz)
    if state.air is None:
        return value, slope
    omega, at = 2 * np.pi * found.hz, np.log(found.hz)
    amounts, by_ln_hz = (state.air.amounts(at, nu) for nu in (0, 1))
    for start, own in zip(found.reed.starts, state.air.resistance_kg_s, strict=True):
        rows = slice(start, start + own.shape[-1])
        products = own @ found.coordinates[rows]
        forms = np.einsum("sm,ksm->mk", found.coordinates[rows], products)
        value += np.sum(amounts * forms, axis=1)
        slope += 2 * np.einsum(
            "mk,ksm,smp->mp", amounts, products, slopes.shapes[rows], optimize=True
        )
        slope += np.sum(by_ln_hz * forms, axis=1)[:, None] * ln_hz
    slope -= value[:, None] * ln_hz
    slope *= state.air_fraction
    slope[:, AIR_FRACTION] += value
    return state.air_fraction * value / omega, slope / omega[:, None]


def modal_forces(found: Vibrations, force: PressureForce) -> ComplexArray:
    """Force (m,) of a pressure on each mode at its own frequency, in N per √kg."""
    forces = [force.at(float(hz)) for hz in found.hz]
    return np.array([_on(found, m, own, found.coordinates[:, m]) for m, own in enumerate(forces)])


def modal_force_derivatives(
    found: Vibrations, force: PressureForce, slopes: ShapeDerivatives
) -> ComplexArray:
    """Derivatives (m, p) of `modal_forces`."""
    answer = np.zeros(slopes.frequencies.ln_hz.shape, dtype=complex)
    for m, hz in enumerate(found.hz.tolist()):
        answer[m] = _on(found, m, force.at(hz), slopes.shapes[:, m])
        grown = _on(found, m, force.by_ln_hz(hz), found.coordinates[:, m])
        answer[m] += grown * slopes.frequencies.ln_hz[m]
    return answer


def _on(found: Vibrations, number: int, forces: Forces, shapes: Array) -> ComplexArray:
    """Work of forces on shapes (s, ...)."""
    pairs = zip(found.reed.starts, forces.values(), strict=True)
    total = sum(own @ shapes[start : start + len(own)] for start, own in pairs)
    return np.asarray(total)
