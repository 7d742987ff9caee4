"""Modes and forced response of one reed: finite elements, reduced to a small basis, with air."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.interpolate import CloughTocher2DInterpolator, CubicSpline
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from studies.second_laboratory.air import air_mass, panels_of
from studies.second_laboratory.cane import Cane
from studies.second_laboratory.elements import Prisms, Solid, patch_profile
from studies.second_laboratory.naming import mode_names
from studies.second_laboratory.parameters import Clamp, Crack, Flaws, Patch, Thickness
from studies.second_laboratory.shape import (
    LENGTH,
    Fineness,
    Thicknesses,
    contour,
    plan_mesh,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# The basis holds the modes with the moduli at a middle frequency, and how the lowest of them change
# with each of the moduli that follow frequency. A basis of all modes at 2.5 and 15 kHz has the same
# frequencies below 18 kHz to 0.01 cents.
_MIDDLE_HZ = 6000.0
_MODES, _CHANGED = 30, 18
# Krylov steps from polynomials, after which the modes below 20 kHz are right to 0.1 cents.
_STEPS = 4
HIGHEST_HZ = 20_500.0
# Frequencies at which the air is computed; its matrix is smooth between them.
_AIR_HZ = np.array(
    [500.0, 2500.0, 5000.0, 7500.0, 10_000.0, 12_500.0, 15_000.0, 17_500.0, 21_000.0]
)
_AIR_PANELS_ACROSS = 20
# Behind the front of the strips the plate goes on for about a half width, as a baffle that rests.
_AIR_LENGTH = 44.0
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2), (3, 3), (4, 4), (5, 5))
# Strains that open or shear a crack along the grain: yy, yz and xy.
_ACROSS = [1, 3, 5]
# Two steps of forces that a crack no longer carries.
_CRACK_STEPS = 2


@dataclass(frozen=True)
class Pole:
    """A resonance as it exists on the bench.

    Attributes
    ----------
    name : str
    frequency_hz, loss_factor : float
        With the stiffness at the resonance's own real frequency: λ = (2πf)²(1 + iη) solves
        K(2πf) v = λ (M + A(2πf)) v.
    pole_hz, pole_loss : float
        Re s/2π and 2 Im s/Re s of the frequency s with det(K(s) − s²(M + A)) = 0, where storage
        moduli are continued to complex frequency.
    vector : (m,) complex128
        In the reduced basis, with unit mass.
    """

    name: str
    frequency_hz: float
    loss_factor: float
    pole_hz: float
    pole_loss: float
    vector: ComplexArray


class Reed:
    """One reed on its mouthpiece, as a reduced model of order about 60.

    Parameters
    ----------
    cane : Cane
    thickness : Thickness
    clamp : Clamp
    fineness : Fineness
    air : float
        Density of the air over that of dry air at 20 °C; 0 is a vacuum.
    flaws : Flaws
    """

    def __init__(
        self,
        cane: Cane,
        thickness: Thickness,
        clamp: Clamp,
        fineness: Fineness | None = None,
        air: float = 1.0,
        flaws: Flaws | None = None,
    ) -> None:
        self.cane, self._air_share, self._flaws = cane, air, flaws or Flaws()
        fine, thick = fineness or Fineness(), Thicknesses(thickness)
        bed = clamp.bed_n_per_mm3
        solid = Solid(plan_mesh(thick, clamp, fine), thick, fine, bed == 0.0, clamp.sides)
        mass = solid.mass(cane.density * 1e-12)
        self._reduce(solid, self._shapes(solid, mass, bed), mass, bed)

    def _shapes(self, solid: Solid, mass: sparse.csc_array, bed: float) -> Array:
        """Return displacements (free, m) whose combinations move as the reed does."""
        middle = self.cane.elasticity(2 * np.pi * _MIDDLE_HZ, lossy=False).real
        compliance = Compliance(solid.stiffness(middle, bed))
        modes = compliance.lowest_modes(mass, solid.polynomial_loads(), _MODES)
        field = (solid.ties @ modes[:, :_CHANGED]).reshape(solid.size, 3, -1)
        found = [modes]
        # E_L and G_LT, each a tenth stiffer: what follows frequency.
        for entries in ((0, 0), (5, 5)):
            change = np.zeros((6, 6))
            change[entries] = 0.1 * middle[entries]
            found.append(compliance(solid.forces(field, _everywhere(change))))
        crack = self._flaws.crack
        if crack is not None:
            for _ in range(_CRACK_STEPS):
                found.append(compliance(solid.forces(field, _lost_to(crack, middle))))
                field = (solid.ties @ found[-1]).reshape(solid.size, 3, -1)
        if self._flaws.patches:
            found.append(compliance(solid.patch_loads(self._flaws.patches)))
        return np.concatenate(found, 1)

    def _reduce(self, solid: Solid, vectors: Array, mass: sparse.csc_array, bed: float) -> None:
        modes = vectors[:, :_MODES]
        vectors[:, _MODES:] -= modes @ (modes.T @ (mass @ vectors[:, _MODES:]))
        moving = mass @ vectors
        vectors = vectors / np.sqrt(np.sum(vectors * moving, 0))
        gram = vectors.T @ (mass @ vectors)
        values, rotation = np.linalg.eigh(gram)
        # Directions that others share to 1e-8 of their mass add nothing but rounding.
        kept = values > 1e-8 * values[-1]
        basis = vectors @ (rotation[:, kept] / np.sqrt(values[kept]))
        field = (solid.ties @ basis).reshape(solid.size, 3, -1)
        self.parts = np.zeros((len(_ENTRIES), basis.shape[1], basis.shape[1]))
        crack = self._flaws.crack
        for prisms in solid.prisms:
            strains = [prisms.strain(field, k) for k in range(6)]
            if crack is not None:
                keeps = crack.keeps(prisms.x, prisms.y).reshape(-1, 1)
                strains = [e * keeps if k in _ACROSS else e for k, e in enumerate(strains)]
            weights = prisms.weights.reshape(-1, 1)
            for part, (i, j) in zip(self.parts, _ENTRIES, strict=True):
                product = strains[i].T @ (weights * strains[j])
                part += product if i == j else product + product.T
        lateral = np.sum([_gram(prisms, field[:, 1]) for prisms in solid.prisms], 0)
        self._lateral = self.cane.density * 1e-12 * lateral
        self.bed = solid.bed_gram(field, bed)
        depth = field.reshape(*solid.plan_shape, len(solid.heights), 3, -1)[..., 2, :]
        bark, below = (depth[:, :, k].reshape(-1, basis.shape[1]) for k in (-1, 0))
        self._positions = solid.plan_positions()
        self._bark, self._flat = bark, below
        points = solid.plan_points
        self.load_x, self.load_y = points.x, points.y
        self._loads = np.einsum(
            "pn,pnm->pm", points.basis * points.area[:, None], below[points.nodes]
        )
        self.load_area = points.area
        count = basis.shape[1]
        self._added, self._sprung = np.zeros((count, count)), np.zeros((count, count), complex)
        for patch in self._flaws.patches:
            at = self.on_patch(patch)
            self._added += patch.mass_t * np.outer(at, at)
            self._sprung += patch.spring_n_per_mm * (1 + 1j * patch.loss) * np.outer(at, at)

    def on_patch(self, patch: Patch) -> Array:
        """Return the basis's displacement along z of the flat side, averaged over a patch."""
        share = patch_profile(patch, self.load_x, self.load_y)
        return np.asarray(share @ self._loads / (share @ self.load_area))

    def surface_gram(self, weight: Array) -> Array:
        """Return integrals of products of the basis over the flat side, weighted at `load_x`."""
        return np.asarray(self._loads.T @ ((weight / self.load_area)[:, None] * self._loads))

    def with_cane(self, cane: Cane) -> "Reed":
        """Return this reed with other moduli, losses, temperature or moisture."""
        changed = copy(self)
        changed.cane = cane
        return changed

    def deflection(self, x: Array, y: Array, bark: bool = True) -> Array:
        """Return the basis's displacement along z at points in mm, shape (n, m)."""
        # Points on the outline may lie outside the chords between its nodes.
        inside = np.minimum(np.abs(y), contour(x) - 1e-3)
        at = np.column_stack([np.maximum(x, 1e-3), np.sign(y) * np.maximum(inside, 0)])
        return np.asarray(np.nan_to_num((self._on_bark if bark else self._in_middle)(at)))

    def deflection_of_nodes(self, end: float) -> Array:
        """Return the basis's displacement along z at nodes of the bark side, shape (n, m).

        They are those before x = end, in mm; the outermost lie on the outline itself.
        """
        return np.asarray(self._bark[self._positions[:, 0] < end])

    @cached_property
    def _on_bark(self) -> CloughTocher2DInterpolator:
        return CloughTocher2DInterpolator(self._positions, self._bark)

    @cached_property
    def _in_middle(self) -> CloughTocher2DInterpolator:
        return CloughTocher2DInterpolator(self._positions, 0.5 * (self._bark + self._flat))

    @cached_property
    def vamp(self) -> Array:
        """Displacement of the basis along z on a grid of the bark side, (n, m)."""
        grid = np.meshgrid(np.linspace(0.2, 38, 40), np.linspace(-6.4, 6.4, 15))
        return self.deflection(grid[0].ravel(), grid[1].ravel())

    @cached_property
    def _air(self) -> CubicSpline:
        panels = panels_of(contour, float(contour(3.0)), _AIR_LENGTH, _AIR_PANELS_ACROSS)
        shapes = self.deflection(panels.x, panels.y, bark=False)
        return CubicSpline(
            _AIR_HZ, [self._air_share * air_mass(panels, shapes, 2 * np.pi * hz) for hz in _AIR_HZ]
        )

    def stiffness(self, omega: complex, lossy: bool = True) -> ComplexArray:
        """Return the stiffness at ω, in N/mm."""
        elastic = self.cane.elasticity(omega, lossy)
        weights = np.array([elastic[entry] for entry in _ENTRIES])
        sprung = self._sprung if lossy else self._sprung.real
        return np.asarray(np.tensordot(weights, self.parts, 1) + self.bed + sprung)

    def inertia(self, hz: float, air: float = 1.0) -> ComplexArray:
        """Return the mass with that of the air at a frequency, in t; `air` is a factor of it."""
        mass = self.cane.mass() * np.eye(self.parts.shape[1]) + self._added
        if not self._air_share:
            return mass.astype(complex)
        moved = air * self._air(hz)
        return np.asarray(mass + self._flaws.air_inertia * moved.real + 1j * moved.imag)

    def response(self, hz: float, pressure_mpa: ComplexArray) -> ComplexArray:
        """Return coordinates of the basis in mm under a pressure at `load_x`, `load_y`."""
        omega = 2 * np.pi * hz
        dynamic = self.stiffness(omega) - omega**2 * self.inertia(hz)
        return np.asarray(np.linalg.solve(dynamic, self.load(pressure_mpa)))

    def load(self, pressure_mpa: ComplexArray) -> ComplexArray:
        """Return the forces on the basis of a pressure at `load_x`, `load_y`, in N."""
        # Real products: numpy would copy the large matrix to complex numbers.
        parts = self._loads.T @ np.column_stack([pressure_mpa.real, pressure_mpa.imag])
        return np.asarray(parts[:, 0] + 1j * parts[:, 1])

    @cached_property
    def poles(self) -> list[Pole]:
        """All modes below `HIGHEST_HZ`, by frequency."""
        start_hz = 6000.0
        values, vectors = linalg.eigh(
            self.stiffness(2 * np.pi * start_hz, lossy=False).real, self.inertia(start_hz).real
        )
        found = []
        for value, vector in zip(values, vectors.T, strict=True):
            if value < (1.15 * 2 * np.pi * HIGHEST_HZ) ** 2:
                found.append(self._pole(np.sqrt(value), vector))
        found = sorted(
            (p for p in found if p.frequency_hz < HIGHEST_HZ), key=lambda p: p.frequency_hz
        )
        return self._named(found)

    def _pole(self, omega: float, vector: Array) -> Pole:
        """Follow one mode to its own frequency, then into the complex plane."""
        now = vector.astype(complex)
        value = complex(omega**2)
        for _ in range(12):
            inertia = self.inertia(omega / (2 * np.pi))
            value, now = _nearest(self.stiffness(omega), inertia, now)
            omega = float(np.sqrt(value.real))
        s, shape = complex(np.sqrt(value)), now
        for _ in range(12):
            squared, shape = _nearest(self.stiffness(s), self.inertia(s.real / (2 * np.pi)), shape)
            s = complex(np.sqrt(squared))
        return Pole(
            "",
            omega / (2 * np.pi),
            value.imag / value.real,
            s.real / (2 * np.pi),
            2 * s.imag / s.real,
            now,
        )

    def _named(self, poles: list[Pole]) -> list[Pole]:
        vectors = np.array([p.vector for p in poles]).T
        # The phase of a mode is nearly one: turn it to the real axis.
        vectors = vectors * np.exp(-0.5j * np.angle(np.sum(vectors**2, 0)))
        return [
            Pole(name, p.frequency_hz, p.loss_factor, p.pole_hz, p.pole_loss, vector)
            for name, p, vector in zip(self.names(vectors), poles, vectors.T, strict=True)
        ]

    def names(self, vectors: ComplexArray | Array) -> list[str]:
        """Return the names of modes (m, k) in the reduced basis, by increasing frequency."""
        x, t = np.meshgrid(
            np.linspace(0.5, LENGTH, 150), np.linspace(-0.98, 0.98, 25), indexing="ij"
        )
        y = t * contour(x)
        shapes = self.deflection(x.ravel(), y.ravel()).reshape(*x.shape, -1)
        lateral = np.einsum("im,ij,jm->m", vectors.conj(), self._lateral, vectors).real
        return mode_names((shapes @ vectors).real, x[:, 0], t[0], lateral)


class Compliance:
    """Displacements under forces, to about 0.1 %, by factors of the stiffness in single precision.

    That is enough to span a basis, whose frequencies are then found in double precision, and takes
    half the time of factors in double precision.
    """

    def __init__(self, stiffness: sparse.csc_array) -> None:
        self._stiffness = stiffness
        self._scale = 1 / np.sqrt(stiffness.diagonal())
        diagonal = sparse.diags_array(self._scale)
        scaled = sparse.csc_array(diagonal @ stiffness @ diagonal).astype(np.float32)
        self._factors = _factorised(scaled)

    def __call__(self, forces: Array) -> Array:
        """Return the displacements (n, m) of forces (n, m)."""
        scaled = self._scale[:, None] * forces
        size = np.abs(scaled).max(0)
        found = self._factors.solve((scaled / size).astype(np.float32))
        return np.asarray(self._scale[:, None] * (found * size))

    def lowest_modes(self, mass: sparse.csc_array, loads: Array, count: int) -> Array:
        """Return the shapes (n, count) of the lowest modes, of unit mass, by block Krylov steps."""
        found = [np.linalg.qr(self(loads))[0]]
        for _ in range(_STEPS - 1):
            found.append(np.linalg.qr(self(mass @ found[-1]))[0])
        span = np.concatenate(found, 1)
        # Steps share directions; those that are independent span the same.
        weights, axes = np.linalg.eigh(span.T @ span)
        axes = axes[:, weights > 1e-12] / np.sqrt(weights[weights > 1e-12])
        stiff, heavy = span.T @ (self._stiffness @ span), span.T @ (mass @ span)
        _, vectors = linalg.eigh(
            axes.T @ stiff @ axes, axes.T @ heavy @ axes, subset_by_index=(0, count - 1)
        )
        return np.asarray(span @ (axes @ vectors))


def _factorised(stiffness: sparse.csc_array) -> SuperLU:
    return splu(
        stiffness,
        permc_spec="NATURAL",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _everywhere(elastic: Array) -> Callable[[Prisms], Array]:
    return lambda _: elastic


def _lost_to(crack: Crack, elastic: Array) -> Callable[[Prisms], Array]:
    """Return the elasticity that a crack takes away, at all points of prisms."""

    def lost(prisms: Prisms) -> Array:
        keeps = np.ones((*prisms.x.shape, 6))
        keeps[..., _ACROSS] = crack.keeps(prisms.x, prisms.y)[..., None]
        return np.asarray(elastic * (keeps[..., :, None] * keeps[..., None, :] - 1))

    return lost


def lowest_modes(
    stiffness: sparse.csc_array, mass: sparse.csc_array, count: int
) -> tuple[Array, Array]:
    """Return frequencies in Hz and shapes of the lowest modes of a solid in a vacuum."""
    factors = _factorised(stiffness)
    inverse = LinearOperator(stiffness.shape, factors.solve, dtype=float)
    start = np.random.default_rng(0).standard_normal(stiffness.shape[0])
    values, vectors = eigsh(stiffness, count, mass, sigma=0, OPinv=inverse, v0=start)
    return np.sqrt(values) / (2 * np.pi), vectors


def _gram(prisms: Prisms, values: Array) -> Array:
    """Return the integrals of products of nodal values (nodes, m) over prisms."""
    at_points = np.einsum("epn,enm->epm", prisms.basis, values[prisms.nodes], optimize=True)
    flat = at_points.reshape(-1, values.shape[1])
    return np.asarray(flat.T @ (prisms.weights.reshape(-1, 1) * flat))


def _nearest(
    stiffness: ComplexArray, inertia: ComplexArray, vector: ComplexArray
) -> tuple[complex, ComplexArray]:
    """Return the eigenvalue whose vector is most similar to one, with its vector of unit mass."""
    values, vectors = linalg.eig(stiffness, inertia)
    masses = np.einsum("im,ij,jm->m", vectors, inertia, vectors)
    similar = np.abs(vectors.T @ inertia @ vector) ** 2 / np.abs(masses)
    best = int(np.argmax(similar))
    return complex(values[best]), vectors[:, best] / np.sqrt(masses[best])
