"""A reed of quadratic hexahedra on springs: modes, and what changes of the reed do between them.

Elements and quadrature are scikit-fem's. The clamp is a bed of stiff springs under each strip.
Everything that a case varies afterwards is projected on some forty modes of the reed as it stands.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from skfem import Basis, BilinearForm, ElementHex2, MeshHex, MeshHex2

from blind.shape import (
    CLAMP_X_M,
    CLAMP_Y_M,
    LENGTH_M,
    VAMP_END_M,
    half_width_m,
    side_m,
    thickness_m,
    tip_m,
)

Array = NDArray[np.floating[Any]]

# Columns of elements across: lines along the edges of both strips.
_ACROSS_M = (0.0, 0.85e-3, 1.7e-3, 2.5e-3, 3.0e-3, 3.5e-3, 4.2e-3, 5.0e-3)
# Element faces along the reed behind the curved part of the tip.
_BENT_M, _BENT = 8e-3, (0.0, 0.12, 0.3, 0.55, 0.78, 1.0)
_ALONG_M = (
    *np.linspace(8e-3, 32.5e-3, 13)[1:],
    34.75e-3, 36.6e-3, 37.7e-3, 38.2e-3, 38.7e-3, 40e-3, 44e-3, 50e-3, 56e-3, 60e-3, 61.2e-3,
    LENGTH_M,
)  # fmt: skip
# Where the corner's arc has a slope of 45 degrees.
_CORNER_M = (1.6322e-3, 5.8482e-3)
_THROUGH = (0.0, 0.75, 1.0)
_MODES = 40
# Springs of a clamp that is as good as rigid, Pa/m.
_RIGID_PA_M = 3e15


@dataclass(frozen=True)
class Wood:
    """Constants of the cane at 4 kHz: Pa, kg/m³."""

    E_L: float = 13.78e9
    E_T: float = 480e6
    E_R: float = 480e6
    G_LT: float = 0.926e9
    G_LR: float = 1.2e9
    G_TR: float = 1.2e9
    nu: float = 0.22
    density: float = 520.0

    def stiffness(self) -> Array:
        """Matrix (6, 6) in the order xx, yy, zz, yz, xz, xy."""
        S = np.diag(1 / np.array([self.E_L, self.E_T, self.E_R, self.G_TR, self.G_LR, self.G_LT]))
        S[0, 1] = S[1, 0] = S[0, 2] = S[2, 0] = -self.nu / self.E_L
        S[1, 2] = S[2, 1] = -self.nu / self.E_T
        return np.linalg.inv(S)


@dataclass(frozen=True)
class Build:
    """How a reed is made and held.

    Attributes
    ----------
    wood : Wood
    bumps : tuple of (float, int, int, float)
        Cosines added to the thickness of the vamp: amplitude in m, half waves along and across, and
        phase across.
    wedge_m, crown_m, offset_m, tilt_m : float
        More of it at the heel's end, at the sides, everywhere and on the left.
    groove_m, groove_x_m : float
        Depth and place of a groove across the vamp, 3 mm wide.
    grain : float
        Angle of the fibres in the plane of the reed, rad.
    yielding_m3_n : (float, float)
        Of the beds under the left and the right strip.
    """

    wood: Wood = Wood()
    bumps: tuple[tuple[float, int, int, float], ...] = ()
    wedge_m: float = 0.0
    crown_m: float = 0.0
    offset_m: float = 0.0
    tilt_m: float = 0.0
    groove_m: float = 0.0
    groove_x_m: float = 15e-3
    grain: float = 0.0
    yielding_m3_n: tuple[float, float] = (0.0, 0.0)


def built_thickness_m(build: Build, x_m: Array, y_m: Array) -> Array:
    """Thickness of the reed as it is made."""
    eta = y_m / side_m(x_m)
    # The vamp's own; nothing is taken off the heel.
    on_vamp = 0.5 * (1 - np.tanh((x_m - 33.5e-3) / 1e-3))
    s = np.clip(x_m / VAMP_END_M, 0, 1)
    more = build.offset_m + build.wedge_m * (2 * s - 1) + build.tilt_m * eta
    more = more + build.crown_m * (1.5 * eta**2 - 0.5)
    for size, along, across, phase in build.bumps:
        more = more + size * np.cos(np.pi * along * s) * np.cos(0.5 * np.pi * across * eta + phase)
    more = more - build.groove_m * np.exp(-(((x_m - build.groove_x_m) / 1.5e-3) ** 2))
    thickness: Array = thickness_m(x_m, y_m) + on_vamp * more
    return thickness


@dataclass(frozen=True)
class ModalReed:
    """A reed in the coordinates of its m modes, of unit modal mass.

    Attributes
    ----------
    square : (m,) float
        ω² of the modes, rad²/s².
    by_E, by_G : (m, m) float
        Stiffness per relative change of E_L and of G_LT.
    top_m, top, top_area_m2 : (p, 2), (p, m), (p,) float
        Places on the bark side, deflection there, and area that each stands for.
    stretch : (p, m) float
        Strain along the grain there.
    bottom_m, push_m3 : (q, 2), (q, m) float
        Places on the flat side, and deflection times area there.
    wood : Wood
    """

    square: Array
    by_E: Array
    by_G: Array
    top_m: Array
    top: Array
    top_area_m2: Array
    stretch: Array
    bottom_m: Array
    push_m3: Array
    wood: Wood


# Voigt numbers of pairs of axes.
_VOIGT = {(0, 0): 0, (1, 1): 1, (2, 2): 2, (1, 2): 3, (0, 2): 4, (0, 1): 5}


def make_reed(build: Build) -> ModalReed:
    """Compute the modes of a reed."""
    mesh, bark, flat = _mesh(build)
    basis = Basis(mesh, ElementHex2(), intorder=4)
    slopes = {
        (i, j): BilinearForm(lambda u, v, _, i=i, j=j: v.grad[i] * u.grad[j]).assemble(basis)
        for i in range(3)
        for j in range(3)
        if i <= j
    }
    C = _turned(build.wood.stiffness(), build.grain)
    K = _stiffness(slopes, C) + _springs(mesh, bark, build)
    one = BilinearForm(lambda u, v, _: build.wood.density * u * v).assemble(basis)
    M = sparse.kron(sparse.eye_array(3), one, format="csc")
    lu = splu(
        K.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    inverse = LinearOperator(K.shape, matvec=lu.solve, dtype=float)
    values, modes = eigsh(
        K, k=_MODES, M=M, sigma=0.0, OPinv=inverse, v0=np.ones(K.shape[0]), tol=1e-6
    )
    order = np.argsort(values)
    values, modes = values[order], modes[:, order]

    def softer(name: str) -> Array:
        less = replace(build.wood, **{name: 0.99 * getattr(build.wood, name)})
        change = (C - _turned(less.stiffness(), build.grain)) / 0.01
        return np.asarray(modes.T @ (_stiffness(slopes, change) @ modes))

    n = basis.N
    top_m, top, area, stretch = _on_face(mesh, bark, modes, n)
    bottom_m, bottom, bottom_area, _ = _on_face(mesh, flat, modes, n)
    return ModalReed(
        values, softer("E_L"), softer("G_LT"), top_m, top, area, stretch, bottom_m,
        bottom * bottom_area[:, None], build.wood,
    )  # fmt: skip


@dataclass(frozen=True)
class _Face:
    """Elements at the bark side or at the flat side, and Gauss points there in their own axes.

    Attributes
    ----------
    elements : (e,) int
    points : (3, q) float
    weights : (q,) float
    """

    elements: NDArray[np.intp]
    points: Array
    weights: Array


def _mesh(build: Build) -> tuple[MeshHex2, _Face, _Face]:
    """Hexahedra on lines that follow the tip, the strips and the end of the vamp."""
    along = np.concatenate([np.array(_BENT), 1 + np.arange(1, len(_ALONG_M) + 1)])
    across = np.arange(-len(_ACROSS_M), len(_ACROSS_M) + 1.0)
    flat = MeshHex.init_tensor(along, across, np.array(_THROUGH))
    curved = MeshHex2.from_mesh(flat)
    x, y = _placed(curved.doflocs[0], curved.doflocs[1])
    z = curved.doflocs[2] * built_thickness_m(build, x, y)
    return replace(curved, doflocs=np.stack([x, y, z])), _face(flat, 1.0), _face(flat, 0.0)


def _face(flat: MeshHex, zeta: float) -> _Face:
    """Find a face of the block of elements that is not bent yet."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    nodes, weights = 0.5 * (1 + nodes), 0.5 * weights
    one, other = (grid.ravel() for grid in np.meshgrid(nodes, nodes, indexing="ij"))
    for axis in range(3):
        for side in (0.0, 1.0):
            points = np.insert(np.stack([one, other]), axis, side, axis=0)
            height = flat.mapping().F(points)[2]
            # The face of every element that lies in a plane of constant height, and the outer one.
            if np.ptp(height, axis=1).max() < 1e-12 and np.any(np.abs(height[:, 0] - zeta) < 1e-12):
                if (height[:, 0] - 0.5).mean() * (zeta - 0.5) < 0:
                    continue
                at = np.flatnonzero(np.abs(height[:, 0] - zeta) < 1e-12)
                return _Face(at, points, np.multiply.outer(weights, weights).ravel())
    raise ValueError("the block of elements has no such face")


def _placed(s: Array, t: Array) -> tuple[Array, Array]:
    """Coordinates of nodes numbered along the reed (to 1 in the bent part) and across it."""
    last = len(_ACROSS_M) - 1
    away = np.abs(t)
    outside = np.maximum(away - last, 0.0)
    inner = np.interp(away, np.arange(last + 1), _ACROSS_M)
    # The outermost line begins in the middle of the rounded corner and follows the outline.
    corner_x, corner_y = _CORNER_M
    bent = np.minimum(s, 1.0)
    behind = np.interp(s, 1 + np.arange(len(_ALONG_M) + 1), [_BENT_M, *_ALONG_M])
    side_x = np.where(s <= 1, corner_x + (_BENT_M - corner_x) * bent, behind)
    y = inner + outside * (half_width_m(side_x) - _ACROSS_M[-1])
    begin = tip_m(inner + outside * (corner_y - _ACROSS_M[-1]))
    x = np.where(s <= 1, begin + (_BENT_M - begin) * bent, behind)
    return x, y * np.sign(t)


def _stiffness(slopes: dict[tuple[int, int], Any], C: Array) -> Any:
    """Stiffness (3n, 3n), all x components first, of the matrices ∫ ∂_i N_a ∂_j N_b."""

    def slope(i: int, j: int) -> Any:
        return slopes[i, j] if i <= j else slopes[j, i].T

    def modulus(a: int, i: int, b: int, j: int) -> float:
        one, other = (min(a, i), max(a, i)), (min(b, j), max(b, j))
        return float(C[_VOIGT[one], _VOIGT[other]])

    def block(a: int, b: int) -> Any:
        parts = [
            modulus(a, i, b, j) * slope(i, j)
            for i in range(3)
            for j in range(3)
            if modulus(a, i, b, j)
        ]
        # A block of zeros has a size, too.
        return sum(parts, start=0.0 * slopes[0, 0])

    return sparse.block_array([[block(a, b) for b in range(3)] for a in range(3)], format="csc")


def _springs(mesh: MeshHex2, top: _Face, build: Build) -> Any:
    """Beds under both strips."""
    basis, area = _basis_on(mesh, top)
    x, y = np.asarray(basis.global_coordinates())[:2]
    (x0, x1), (y0, y1) = CLAMP_X_M, CLAMP_Y_M
    left, right = (1 / (1 / _RIGID_PA_M + yielding) for yielding in build.yielding_m3_n)
    under = (x > x0) & (x < x1) & (np.abs(y) > y0) & (np.abs(y) < y1)
    pressure = np.where(under, np.where(y > 0, left, right), 0.0) * area / basis.dx
    form = BilinearForm(lambda u, v, w: w["pressure"] * u * v)
    return sparse.kron(sparse.eye_array(3), form.assemble(basis, pressure=pressure), format="csc")


def _basis_on(mesh: MeshHex2, face: _Face) -> tuple[Basis, Array]:
    """Functions on a face, and the area (e, q) of the plan that each point stands for."""
    quadrature = face.points, face.weights
    basis = Basis(mesh, ElementHex2(), elements=face.elements, quadrature=quadrature)
    axis = int(np.flatnonzero(np.ptp(face.points, axis=1) == 0)[0])
    slopes = mesh.mapping().DF(face.points, tind=face.elements)
    plan = np.delete(slopes, axis, axis=1)[:2]
    area = np.abs(plan[0, 0] * plan[1, 1] - plan[0, 1] * plan[1, 0]) * face.weights
    return basis, area


def _on_face(
    mesh: MeshHex2, face: _Face, modes: Array, n: int
) -> tuple[Array, Array, Array, Array]:
    """Places (p, 2), deflections (p, m), areas of the plan (p,) and strains ε_xx (p, m)."""
    basis, area = _basis_on(mesh, face)
    x, y = (part.ravel() for part in np.asarray(basis.global_coordinates())[:2])
    moved = [np.asarray(basis.interpolate(mode[2 * n :])).ravel() for mode in modes.T]
    stretch = [np.asarray(basis.interpolate(mode[:n]).grad[0]).ravel() for mode in modes.T]
    return (
        np.stack([x, y], axis=1), np.stack(moved, axis=1), area.ravel(), np.stack(stretch, axis=1)
    )  # fmt: skip


def _turned(C: Array, angle: float) -> Array:
    """Stiffness (6, 6) of wood whose grain is turned in the plane of the reed."""
    c, s = np.cos(angle), np.sin(angle)
    # Strains in the axes of the wood from those of the reed, engineering shears.
    T = np.array(
        [
            [c * c, s * s, 0, 0, 0, c * s],
            [s * s, c * c, 0, 0, 0, -c * s],
            [0, 0, 1, 0, 0, 0],
            [0, 0, 0, c, -s, 0],
            [0, 0, 0, s, c, 0],
            [-2 * c * s, 2 * c * s, 0, 0, 0, c * c - s * s],
        ]
    )
    turned: Array = T.T @ C @ T
    return turned
