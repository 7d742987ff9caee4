"""Modes and forced vibration of a reed whose cane depends on frequency."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physics.reed.basis import HalfBasis, ReducedReed, reduced_modes
from physics.reed.fem import Symmetry
from physics.reed.material import stiffness_terms_pa
from physics.reed.names import assign_names, likenesses
from physics.reed.viscoelastic import ViscoelasticCane, storage_modulus_pa

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

# A mode whose kinetic energy is mostly sideways is lateral; one mostly behind the vamp, a heel's.
_FOREIGN_SHARE = 0.5
# Modes named per symmetry: all below 20 kHz. Higher ones are no longer those of the full model
# (see `BasisSettings.modes`) and would only compete for names.
_NAMED_MODES = 11
_SETTLED_CENTS = 1e-3
_MOST_ITERATIONS = 30


@dataclass(frozen=True)
class Mode:
    """One vibration of the undamped reed.

    Attributes
    ----------
    name : str
    frequency_hz : float
    symmetry : Symmetry
    coordinates : (r,) float
        Mass-normalised shape of the half reed in its reduced coordinates.
    likeness : float
        Share of its motion that bears out its name; low where two modes exchange shapes.
    """

    name: str
    frequency_hz: float
    symmetry: Symmetry
    coordinates: Array
    likeness: float


def elastic_modes(reed: ReducedReed, E_L_pa: float, G_LT_pa: float) -> dict[str, Mode]:
    """Modes of the reed with fixed moduli, by name."""
    cane = replace(reed.cane, E_L_pa=E_L_pa, G_LT_pa=G_LT_pa)
    terms = stiffness_terms_pa(cane)
    modes = {}
    for symmetry, half in reed.halves.items():
        frequencies, shapes = reduced_modes(half, terms, cane.density_kg_m3)
        frequencies, shapes = frequencies[:_NAMED_MODES], shapes[:, :_NAMED_MODES]
        names = _names(half, shapes, symmetry, cane.density_kg_m3)
        for (name, likeness), hz, shape in zip(names, frequencies, shapes.T, strict=True):
            modes[name] = Mode(name, float(hz), symmetry, shape, likeness)
    return modes


def _names(
    half: HalfBasis, shapes: Array, symmetry: Symmetry, density: float
) -> list[tuple[str, float]]:
    """Names and likenesses of mass-normalised shapes (r, m), ascending in frequency."""

    def share(part: Array) -> Array:
        shares: Array = density * np.einsum("rm,rs,sm->m", shapes, part, shapes, optimize=True)
        return shares

    symmetric = symmetry is Symmetry.SYMMETRIC
    lateral, heel = share(half.lateral_mass), share(half.heel_mass)
    profiles = np.moveaxis(half.profiles @ shapes, -1, 0)
    # Lateral modes of the symmetric half stretch the width; the paper's L bend in the plane.
    counted = {"L": "" if not symmetric else "s", "H": "" if symmetric else "a"}
    answer: list[tuple[str, float]] = []
    vamp = []
    for m in range(shapes.shape[1]):
        kind, part = ("L", lateral[m]) if lateral[m] > heel[m] else ("H", heel[m])
        if part > _FOREIGN_SHARE:
            number = 1 + sum(name.startswith(kind) for name, _ in answer)
            answer.append((f"{kind}{number}{counted[kind]}", float(part)))
        else:
            vamp.append(m)
            answer.append(("", 0.0))
    named = assign_names([likenesses(profiles[m], symmetric=symmetric) for m in vamp])
    for m, (name, likeness) in zip(vamp, named, strict=True):
        # A place without a name is told from its like of the other symmetry.
        suffix = symmetry[0] if name.startswith("?") else ""
        answer[m] = (name + suffix, likeness)
    return answer


def viscoelastic_mode(
    reed: ReducedReed, cane: ViscoelasticCane, name: str, start_hz: float
) -> Mode:
    """Mode of a given name, with the storage moduli taken at its own frequency.

    Raises
    ------
    ValueError
        If the reed has no such mode, or the iteration does not settle.
    """
    hz = start_hz
    for _ in range(_MOST_ITERATIONS):
        modes = elastic_modes(
            reed,
            float(storage_modulus_pa(cane.young_L, hz)),
            float(storage_modulus_pa(cane.shear_LT, hz)),
        )
        if name not in modes:
            raise ValueError(f"this reed has no mode {name} near {hz:.0f} Hz")
        previous, hz = hz, modes[name].frequency_hz
        if abs(1200 * np.log2(hz / previous)) < _SETTLED_CENTS:
            return modes[name]
    raise ValueError(f"mode {name} does not settle: it jumps about {hz:.0f} Hz")


def forced_response(
    reed: ReducedReed,
    cane: ViscoelasticCane,
    loss_factor: float,
    frequencies_hz: Array,
    pressure: Callable[[float, Array, Array], Complex],
) -> dict[Symmetry, Complex]:
    """Steady vibration under a sinusoidal pressure on the flat side.

    Solves ``(K(ω)(1 + iη) − ω²M) q = F`` at every frequency, with the storage moduli of that
    frequency and a loss factor η of its own (see decision 0004).

    Parameters
    ----------
    loss_factor : float
        Ratio η of dissipated to stored energy per radian.
    frequencies_hz : (k,) float
    pressure : callable
        ``pressure(frequency_hz, x_m, y_m)`` gives complex pressures in Pa at points of the flat
        side, y of either sign; positive pushes towards the bark side (+z).

    Returns
    -------
    dict of (k, r) complex
        Reduced coordinates in m, per symmetry, time factor exp(+iωt).
    """
    x, y = reed.load_points_m.T
    answer = {}
    for symmetry, half in reed.halves.items():
        sign = 1 if symmetry is Symmetry.SYMMETRIC else -1
        response = np.empty((len(frequencies_hz), half.mass.shape[0]), dtype=complex)
        for k, hz in enumerate(frequencies_hz):
            even_or_odd = 0.5 * (pressure(hz, x, y) + sign * pressure(hz, x, -y))
            response[k] = _solve(reed, half, cane, loss_factor, hz, even_or_odd @ half.load_z)
        answer[symmetry] = response
    return answer


def _solve(
    reed: ReducedReed,
    half: HalfBasis,
    cane: ViscoelasticCane,
    loss_factor: float,
    hz: float,
    load: Complex,
) -> Complex:
    material = replace(
        reed.cane,
        E_L_pa=float(storage_modulus_pa(cane.young_L, hz)),
        G_LT_pa=float(storage_modulus_pa(cane.shear_LT, hz)),
    )
    K = np.tensordot(stiffness_terms_pa(material), half.stiffness_terms, axes=1)
    omega2 = (2 * np.pi * hz) ** 2
    answer: Complex = np.linalg.solve(
        (1 + 1j * loss_factor) * K - omega2 * material.density_kg_m3 * half.mass, load
    )
    return answer
