"""Project stiffness and mass of a reed on given shapes, at the points of quadrature."""

import numpy as np

from holography.arrays import Array
from physics.reed.cane.material import STIFFNESS_TERMS
from physics.reed.elements.fem import hexahedron
from physics.reed.elements.mesh import ReedMesh

# Elements whose strains are worked on together.
_ELEMENTS = 16


def integrals(mesh: ReedMesh, shapes: Array) -> tuple[Array, Array]:
    """Stiffness (9, r, r) per unit stiffness of the cane and mass (r, r) of shapes (n, 3, r).

    The quadrature is that of `fem.assemble`, so this is a projection of its matrices; done at the
    points of quadrature, it takes a tenth of the time.
    """
    reference = hexahedron(mesh.orders)
    weights, values, local = reference.weights, reference.shape, reference.gradients
    size = shapes.shape[2]
    stiffnesses, masses = np.zeros((9, size, size)), np.zeros((size, size))
    for start in range(0, len(mesh.elements), _ELEMENTS):
        elements = mesh.elements[start : start + _ELEMENTS]
        jacobian = np.einsum("iqm,emj->eqij", local, mesh.nodes_m[elements], optimize=True)
        scale = np.sqrt(np.linalg.det(jacobian) * weights)
        moved = shapes[elements].reshape(*elements.shape, -1)
        displacements = (values @ moved) * scale[..., None]
        masses += _gram(displacements.reshape(-1, size))
        gradient = np.einsum("eqij,jqm->eiqm", np.linalg.inv(jacobian), local, optimize=True)
        gradient *= scale[:, None, :, None]
        # Index i: derived along; a: component of the displacement.
        strains = _strains((gradient @ moved[:, None]).reshape(*gradient.shape[:3], 3, size))
        for term, name in enumerate(STIFFNESS_TERMS):
            left, right = (strains[int(number) - 1] for number in name)
            product = left.T @ right
            stiffnesses[term] += product if left is right else product + product.T
    return stiffnesses, masses


def _gram(rows: Array) -> Array:
    return rows.T @ rows


def _strains(derived: Array) -> list[Array]:
    """Engineering strains (points, r) in Voigt order, of ``derived[e, i, q, a] = ∂_i u_a``."""
    size = derived.shape[-1]

    def sheared(i: int, a: int) -> Array:
        return (derived[:, i, :, a] + derived[:, a, :, i]).reshape(-1, size)

    normal = [derived[:, i, :, i].reshape(-1, size) for i in range(3)]
    return [*normal, sheared(1, 2), sheared(0, 2), sheared(0, 1)]
