"""Finite elements of the reed: triangular prisms, complete polynomials in plan, layers in depth.

A quadrilateral of the plan mesh is cut into two triangles. Each carries Lagrange polynomials of
`Fineness.order` in plan, and through the thickness polynomials of `layer_order` in each layer. In
front of the clamp the displacement of each normal is one polynomial of `vamp_order`, which the
layers interpolate, so that neighbours stay continuous. Points are mapped exactly: z = ζ·t(x, y).

Units: mm, MPa, tonnes; so frequencies come out in Hz.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from studies.second_laboratory.parameters import Patch
from studies.second_laboratory.shape import Fineness, PlanMesh, Thicknesses

Array = NDArray[np.float64]
# Points of Gauss on each direction of a triangle and a layer, beyond the order of the element.
_MORE_POINTS = 0
# Stiffness of a bed along x, y and z: an elastic layer has its shear modulus along the surface, and
# G/E = 1/(2(1 + nu)) for nu = 0.35 of a hard plastic.
_BED_DIRECTIONS = (0.37, 0.37, 1.0)
# Directions and powers along x and y of forces from whose displacements modes are found: all shapes
# that bend and twist, and some that move sideways.
_LOADS = (
    *((2, i, j) for i in range(6) for j in range(4)),
    *((1, i, 0) for i in range(3)),
    (0, 1, 1),
)
# Components of strain (xx, yy, zz, yz, xz, xy) as pairs of displacement and direction.
_STRAIN = (((0, 0),), ((1, 1),), ((2, 2),), ((1, 2), (2, 1)), ((0, 2), (2, 0)), ((0, 1), (1, 0)))


@dataclass(frozen=True)
class _Triangle:
    """One of the four ways in which a triangle lies in the unit square."""

    lattice: NDArray[np.int64]
    basis: Array
    slopes: Array
    geometry: Array
    geometry_slopes: Array
    corners: NDArray[np.int64]
    weights: Array


def _lattice(order: int, rising: bool, first: bool) -> NDArray[np.int64]:
    a, b = np.divmod(np.arange((order + 1) ** 2), order + 1)
    sign = a - b if rising else order - a - b
    keep = sign >= 0 if first else sign <= 0
    return np.column_stack([a[keep], b[keep]])


def _monomials(points: Array, order: int) -> tuple[Array, Array]:
    """Return all monomials up to an order, and their slopes, at points of the unit square."""
    x, y = (points - 0.5).T
    powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    value = np.stack([x**i * y**j for i, j in powers], -1)
    along = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in powers], -1)
    across = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in powers], -1)
    return value, np.stack([along, across])


def _triangle(order: int, rising: bool, first: bool) -> _Triangle:
    corners = _lattice(1, rising, first).astype(float)
    gauss, weight = np.polynomial.legendre.leggauss(order + 1 + _MORE_POINTS)
    gauss, weight = (gauss + 1) / 2, weight / 2
    u, v = (each.ravel() for each in np.meshgrid(gauss, gauss, indexing="ij"))
    # Duffy's map of the unit square onto the triangle.
    points = corners[0] + u[:, None] * (corners[1] - corners[0])
    points = points + (u * v)[:, None] * (corners[2] - corners[1])
    weights = np.outer(weight, weight).ravel() * u
    tables = []
    for degree in (order, 2):
        inverse = np.linalg.inv(_monomials(_lattice(degree, rising, first) / degree, degree)[0])
        value, slopes = _monomials(points, degree)
        tables += [value @ inverse, slopes @ inverse]
    lattice, corner = _lattice(order, rising, first), _lattice(2, rising, first)
    return _Triangle(lattice, tables[0], tables[1], tables[2], tables[3], corner, weights)


def _interpolation(nodes: Array, points: Array) -> tuple[Array, Array]:
    """Return Lagrange polynomials through nodes, and their slopes, at points."""
    inverse = np.linalg.inv(np.vander(nodes, increasing=True))
    powers = np.arange(len(nodes))
    slopes = powers * points[:, None] ** np.maximum(powers - 1, 0)
    return np.vander(points, len(nodes), increasing=True) @ inverse, slopes @ inverse


@dataclass(frozen=True)
class Prisms:
    """All prisms of one kind of triangle in one layer, and their functions at their points."""

    nodes: NDArray[np.int64]
    basis: Array
    slopes: Array
    weights: Array
    x: Array
    y: Array

    def strain(self, field: Array, component: int) -> Array:
        """Return a strain of displacements (n, 3, m) at all points, shape (points, m)."""
        parts = [
            np.matmul(self.slopes[direction], field[self.nodes, axis])
            for axis, direction in _STRAIN[component]
        ]
        return np.asarray(sum(parts)).reshape(-1, field.shape[-1])


class Solid:
    """The finite elements of one reed.

    Parameters
    ----------
    mesh : PlanMesh
    thickness : Thicknesses
    fineness : Fineness
    clamped : bool
        Whether nothing moves under the strips.
    sides : (float, float)
        Stiffness of the bed under the left strip, y > 0, and the right one, in units of the bed's.
    """

    def __init__(
        self,
        mesh: PlanMesh,
        thickness: Thicknesses,
        fineness: Fineness,
        clamped: bool = True,
        sides: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        self.clamped, self._sides = clamped, sides
        self._mesh, self._thickness, self._fine = mesh, thickness, fineness
        order, quads = fineness.order, mesh.rising.shape
        self.plan_shape = (order * quads[0] + 1, order * quads[1] + 1)
        self.heights = np.unique(
            np.concatenate(
                [np.linspace(*pair, fineness.layer_order + 1) for pair in pairwise(fineness.layers)]
            )
        )
        self.size = self.plan_shape[0] * self.plan_shape[1] * len(self.heights)
        self._kinds = [
            (rising, _triangle(order, rising, first))
            for rising in (True, False)
            for first in (True, False)
            if np.any(mesh.rising == rising)
        ]

    def _plan(
        self, rising: bool, triangle: _Triangle, chosen: NDArray[np.bool_]
    ) -> tuple[Any, ...]:
        """Return plan nodes, x, y, thickness and slopes, plan slopes and weights of triangles."""
        i, j = np.nonzero((self._mesh.rising == rising) & chosen)
        order = self._fine.order
        lattice = triangle.lattice
        nodes = (order * i[:, None] + lattice[:, 0]) * self.plan_shape[1]
        nodes = nodes + order * j[:, None] + lattice[:, 1]
        at = self._mesh.nodes[
            2 * i[:, None] + triangle.corners[:, 0], 2 * j[:, None] + triangle.corners[:, 1]
        ]
        x, y = np.einsum("pg,egk->kep", triangle.geometry, at)
        jacobian = np.einsum("dpg,egk->epkd", triangle.geometry_slopes, at)
        determinant = np.linalg.det(jacobian)
        slopes = np.einsum("epdk,dpn->kepn", np.linalg.inv(jacobian), triangle.slopes)
        vamp = self._mesh.on_vamp[i, j][:, None] & np.ones_like(x, bool)
        t, t_x, t_y = self._thickness(x, y, vamp)
        return nodes, x, y, t, t_x, t_y, slopes, np.abs(determinant) * triangle.weights

    @cached_property
    def prisms(self) -> list[Prisms]:
        """All prisms, by kind of triangle and layer."""
        fine, found = self._fine, []
        gauss, weight = np.polynomial.legendre.leggauss(fine.layer_order + 1)
        everywhere = np.ones(self._mesh.rising.shape, bool)
        for rising, triangle in self._kinds:
            plan, x, y, t, t_x, t_y, slopes, area = self._plan(rising, triangle, everywhere)
            for number, (low, high) in enumerate(pairwise(fine.layers)):
                zeta = low + (high - low) * (gauss + 1) / 2
                first = number * fine.layer_order
                value, slope = _interpolation(
                    self.heights[first : first + fine.layer_order + 1], zeta
                )
                deep = plan[:, :, None] * len(self.heights) + first
                nodes = deep + np.arange(fine.layer_order + 1)
                shape = (len(plan), -1, nodes[0].size)

                def product(flat: Array, depth: Array, shape: tuple[int, ...] = shape) -> Array:
                    """Return plan functions times functions of depth at all points."""
                    return np.asarray(
                        np.einsum("epa,zb->epzab", flat, depth, optimize=True).reshape(shape)
                    )

                ones = np.broadcast_to(triangle.basis, slopes[0].shape)
                lean = [-(tilt / t)[..., None] * ones for tilt in (t_x, t_y)]
                by_depth = product(ones / t[..., None], slope)
                leaning = [product(each, zeta[:, None] * slope) for each in lean]
                gradient = [product(slopes[k], value) + leaning[k] for k in (0, 1)]
                volume = (area * t)[..., None] * weight * (high - low) / 2
                found.append(
                    Prisms(
                        nodes.reshape(len(plan), -1),
                        product(ones, value),
                        np.stack([*gradient, by_depth]),
                        volume.reshape(len(plan), -1),
                        *(np.repeat(each, len(zeta), 1) for each in (x, y)),
                    )
                )
        return found

    def stiffness(self, elastic: Array, bed_n_per_mm3: float = 0.0) -> sparse.csc_array:
        """Return the stiffness of all free displacements.

        Parameters
        ----------
        elastic : (6, 6) float64
            Matrix of elasticity in MPa, for strains xx, yy, zz, yz, xz, xy.
        bed_n_per_mm3 : float
            Stiffness of the strips' bed per area; 0 for strips on which nothing moves.
        """
        whole = self._assembled(lambda prisms: _element_stiffness(prisms, elastic))
        if bed_n_per_mm3:
            whole = whole + self._bed(bed_n_per_mm3)
        return sparse.csc_array(self.ties.T @ whole @ self.ties)

    def mass(self, density: float) -> sparse.csc_array:
        """Return the mass of all free displacements, for a density in t/mm³."""

        def element(prisms: Prisms) -> Array:
            weighted = prisms.basis * (density * prisms.weights)[:, :, None]
            return np.asarray(np.matmul(prisms.basis.transpose(0, 2, 1), weighted))

        one = self._assembled(element, 1)
        return sparse.csc_array(self.ties.T @ sparse.kron(one, sparse.eye_array(3)) @ self.ties)

    def _assembled(
        self, element: Callable[[Prisms], Array], directions: int = 3
    ) -> sparse.csc_array:
        """Return the matrix of all nodes, of elements' matrices in some directions at each node."""
        rows, columns, values = [], [], []
        for prisms in self.prisms:
            dofs = directions * prisms.nodes[:, :, None] + np.arange(directions)
            dofs = dofs.reshape(len(prisms.nodes), -1).astype(np.int32)
            count = dofs.shape[1]
            rows.append(np.repeat(dofs, count, 1).ravel())
            columns.append(np.tile(dofs, count).ravel())
            values.append(element(prisms).ravel())
        # One conversion, not a sum of sparse matrices, which takes three times as long.
        where = np.concatenate(rows), np.concatenate(columns)
        size = directions * self.size
        return sparse.coo_array((np.concatenate(values), where), shape=(size, size)).tocsc()

    def forces(self, field: Array, elastic: Callable[[Prisms], Array]) -> Array:
        """Return the forces of displacements (nodes, 3, m) on the free ones, shape (free, m).

        `elastic` gives the matrix of elasticity of prisms, (6, 6) or at each point (e, p, 6, 6).
        """
        count = field.shape[-1]
        total = np.zeros((self.size, 3 * count))
        for prisms in self.prisms:
            strains = [
                prisms.strain(field, k).reshape(*prisms.weights.shape, count) for k in range(6)
            ]
            weighted = np.stack(strains, 2) * prisms.weights[:, :, None, None]
            stress = np.matmul(elastic(prisms), weighted)
            forces = np.zeros((*prisms.nodes.shape, 3, count))
            for k, pairs in enumerate(_STRAIN):
                for axis, direction in pairs:
                    slopes = prisms.slopes[direction].transpose(0, 2, 1)
                    forces[:, :, axis] += np.matmul(slopes, stress[:, :, k])
            flat = prisms.nodes.ravel()
            gathered = sparse.csr_array(
                (np.ones(len(flat)), (flat, np.arange(len(flat)))), shape=(self.size, len(flat))
            )
            total += gathered @ forces.reshape(len(flat), -1)
        return np.asarray(self.ties.T @ total.reshape(3 * self.size, count))

    def bed_gram(self, field: Array, stiffness_n_per_mm3: float) -> Array:
        """Return the stiffness of the bed between displacements (nodes, 3, m)."""
        flat = field.reshape(3 * self.size, -1)
        return np.asarray(flat.T @ (self._bed(stiffness_n_per_mm3) @ flat))

    def _bed(self, stiffness_n_per_mm3: float) -> sparse.csc_array:
        """Return the stiffness of the bed under the strips, on the bark side."""
        size = 3 * self.size
        total = sparse.csc_array((size, size))
        for rising, triangle in self._kinds:
            plan, _, y, *_, area = self._plan(rising, triangle, self._mesh.on_strip)
            if len(plan):
                area = area * np.where(y > 0, *self._sides)
                gram = np.einsum("pa,ep,pb->eab", triangle.basis, area, triangle.basis)
                springs = stiffness_n_per_mm3 * np.diag(_BED_DIRECTIONS)
                dofs = 3 * ((plan + 1) * len(self.heights) - 1)[:, :, None] + np.arange(3)
                values = np.einsum("eab,ij->eaibj", gram, springs).reshape(len(plan), -1)
                total = total + _scattered(dofs.reshape(len(plan), -1), values, size)
        return total

    @cached_property
    def ties(self) -> sparse.csc_array:
        """Displacements of all nodes from the free ones, ordered by nested dissection."""
        order, heights = self._fine.order, self.heights
        layered, strip = (
            _nodes_of(quads, order) for quads in (self._mesh.layered, self._mesh.on_strip)
        )
        through = np.linspace(0.0, 1.0, self._fine.vamp_order + 1)
        vamp = _interpolation(through, heights)[0]
        free = np.eye(len(heights))
        # Three kinds of normals: on the vamp, in layers, and in layers under a strip that holds.
        blocks = [sparse.coo_array(np.kron(one, np.eye(3))) for one in (vamp, free, free[:, :-1])]
        kinds = np.where(layered, 1 + (strip & self.clamped), 0)
        rows, columns, values, first = [], [], [], 0
        for i, j in _dissected(*self.plan_shape, order):
            block = blocks[kinds[i, j]]
            rows.append(3 * len(heights) * (i * self.plan_shape[1] + j) + block.coords[0])
            columns.append(first + block.coords[1])
            values.append(block.data)
            first += block.shape[1]
        where = np.concatenate(rows), np.concatenate(columns)
        return sparse.coo_array((np.concatenate(values), where), (3 * self.size, first)).tocsc()

    def plan_positions(self) -> Array:
        """Return x and y of all plan nodes in mm, shape (n, 2)."""
        found = np.empty((self.plan_shape[0] * self.plan_shape[1], 2))
        order = self._fine.order
        for rising, triangle in self._kinds:
            local = triangle.lattice / order
            inverse = np.linalg.inv(_monomials(triangle.corners / 2, 2)[0])
            i, j = np.nonzero(self._mesh.rising == rising)
            corners = triangle.corners
            at = self._mesh.nodes[2 * i[:, None] + corners[:, 0], 2 * j[:, None] + corners[:, 1]]
            nodes = (order * i[:, None] + triangle.lattice[:, 0]) * self.plan_shape[1]
            nodes = nodes + order * j[:, None] + triangle.lattice[:, 1]
            found[nodes] = np.einsum("pg,egk->epk", _monomials(local, 2)[0] @ inverse, at)
        return found

    def polynomial_loads(self) -> Array:
        """Return forces on the free displacements, polynomials of x and y, shape (free, m)."""
        at = np.repeat(self.plan_positions(), len(self.heights), 0)
        x, y = at[:, 0] / np.max(at[:, 0]), at[:, 1] / np.max(at[:, 1])
        loads = np.zeros((self.size, 3, len(_LOADS)))
        for k, (axis, i, j) in enumerate(_LOADS):
            loads[:, axis, k] = np.polynomial.legendre.Legendre.basis(i)(2 * x - 1) * y**j
        return np.asarray(self.ties.T @ loads.reshape(3 * self.size, -1))

    def patch_loads(self, patches: Sequence[Patch]) -> Array:
        """Return forces along z on the flat side, one for each patch, shape (free, m)."""
        points = self.plan_points
        loads = np.zeros((self.plan_shape[0] * self.plan_shape[1], len(patches)))
        for k, patch in enumerate(patches):
            share = patch_profile(patch, points.x, points.y) * points.area
            np.add.at(loads[:, k], points.nodes, points.basis * share[:, None])
        whole = np.zeros((len(loads), len(self.heights), 3, len(patches)))
        whole[:, 0, 2] = loads
        return np.asarray(self.ties.T @ whole.reshape(3 * self.size, -1))

    @cached_property
    def plan_points(self) -> "PlanPoints":
        """Points of quadrature in plan, for loads and for what the camera sees."""
        plan, x, y, basis, area = [], [], [], [], []
        for rising, triangle in self._kinds:
            everywhere = np.ones(self._mesh.rising.shape, bool)
            nodes, px, py, _, _, _, _, weights = self._plan(rising, triangle, everywhere)
            plan.append(np.repeat(nodes, px.shape[1], 0))
            basis.append(np.tile(triangle.basis, (len(nodes), 1)))
            x.append(px.ravel())
            y.append(py.ravel())
            area.append(weights.ravel())
        return PlanPoints(*(np.concatenate(each) for each in (plan, basis, x, y, area)))


@dataclass(frozen=True)
class PlanPoints:
    """Points of quadrature in plan.

    Attributes
    ----------
    nodes : (n, m) int64
        Plan nodes of the triangle of each point.
    basis : (n, m) float64
    x, y, area : (n,) float64
        In mm and mm².
    """

    nodes: NDArray[np.int64]
    basis: Array
    x: Array
    y: Array
    area: Array


def patch_profile(patch: Patch, x: Array, y: Array) -> Array:
    """Return the Gaussian profile of a patch at points."""
    square = (x - patch.x_mm) ** 2 + (y - patch.y_mm) ** 2
    return np.asarray(np.exp(-0.5 * square / patch.radius_mm**2))


def _scattered(dofs: NDArray[np.int64], values: Array, size: int) -> sparse.csc_array:
    count = dofs.shape[1]
    where = np.repeat(dofs, count, 1).ravel(), np.tile(dofs, count).ravel()
    return sparse.coo_array((values.ravel(), where), shape=(size, size)).tocsc()


def _element_stiffness(prisms: Prisms, elastic: Array) -> Array:
    gram = [
        [np.matmul((a * prisms.weights[:, :, None]).transpose(0, 2, 1), b) for b in prisms.slopes]
        for a in prisms.slopes
    ]
    shear = np.zeros((3, 3))
    for (i, j), modulus in zip(((1, 2), (0, 2), (0, 1)), np.diag(elastic)[3:], strict=True):
        shear[i, j] = shear[j, i] = modulus
    count = prisms.nodes.shape[1]
    total = np.empty((len(prisms.nodes), count, 3, count, 3))
    for i in range(3):
        for j in range(3):
            if i == j:
                around = sum(shear[i, k] * gram[k][k] for k in range(3))
                total[:, :, i, :, i] = elastic[i, i] * gram[i][i] + around
            else:
                total[:, :, i, :, j] = elastic[i, j] * gram[i][j] + shear[i, j] * gram[j][i]
    return total


def _nodes_of(quads: NDArray[np.bool_], order: int) -> NDArray[np.bool_]:
    """Return which plan nodes belong to marked quadrilaterals."""
    nodes = np.zeros((order * quads.shape[0] + 1, order * quads.shape[1] + 1), bool)
    for i, j in zip(*np.nonzero(quads), strict=True):
        nodes[order * i : order * (i + 1) + 1, order * j : order * (j + 1) + 1] = True
    return nodes


def _dissected(rows: int, columns: int, order: int) -> list[tuple[int, int]]:
    """Return the points of a lattice in the order of nested dissection (George, 1973).

    Lines between elements, every `order` points, separate what lies on their two sides.
    """

    def dissect(low: tuple[int, int], high: tuple[int, int]) -> list[tuple[int, int]]:
        for axis in sorted((0, 1), key=lambda k: low[k] - high[k]):
            line = order * round((low[axis] + high[axis] - 1) / 2 / order)
            if low[axis] < line < high[axis] - 1:
                left, right, start, end = list(high), list(low), list(low), list(high)
                left[axis], right[axis], start[axis], end[axis] = line, line + 1, line, line + 1
                parts = dissect(low, (left[0], left[1])), dissect((right[0], right[1]), high)
                return [*parts[0], *parts[1], *points((start[0], start[1]), (end[0], end[1]))]
        return points(low, high)

    def points(low: tuple[int, int], high: tuple[int, int]) -> list[tuple[int, int]]:
        return [(i, j) for i in range(low[0], high[0]) for j in range(low[1], high[1])]

    return dissect((0, 0), (rows, columns))
