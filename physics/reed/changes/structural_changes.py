"""Changes of a reed: layers, softening, added mass and a clamp that yields.

A change is what a layer, a mass or a clamp that yields adds to stiffness, mass and compliance, in
the coordinates of `ShapeDerivatives`: those of symmetric motion, then those of antisymmetric.
Changes are vectors: see `combined`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import blas

from holography.arrays import Array
from physics.reed.cane.material import STIFFNESS_TERMS
from physics.reed.changes.shape_derivatives import ShapeDerivatives
from physics.reed.elements.fem import Symmetry


@dataclass(frozen=True)
class Change:
    """What is added to a reed, in s coordinates; m of either symmetry move its strip.

    Attributes
    ----------
    stiffness_terms : (9, s, s) float
        Per unit of each independent stiffness of the cane.
    mass : (s, s) float
        Per unit density.
    mass_kg : (s, s) float
        Of what is no cane.
    compliance_m_n : (2m, 2m) float
        Of what holds the strip.
    """

    stiffness_terms: Array
    mass: Array
    mass_kg: Array
    compliance_m_n: Array


def unchanged(shape_derivatives: ShapeDerivatives) -> Change:
    """Nothing added."""
    sizes = [half.mass.shape[0] for half in shape_derivatives.reed.halves.values()]
    s, m = sum(sizes), len(sizes) * len(shape_derivatives.strip_m2)
    return Change(np.zeros((9, s, s)), np.zeros((s, s)), np.zeros((s, s)), np.zeros((m, m)))


def combined(shape_derivatives: ShapeDerivatives, parts: Iterable[tuple[float, Change]]) -> Change:
    """Sum of changes, each multiplied by an amount."""
    total = unchanged(shape_derivatives)
    for amount, change in parts:
        for field in fields(Change):
            # In place: arrays are large, and to make new ones takes longer than to add.
            into = getattr(total, field.name).ravel()
            blas.daxpy(getattr(change, field.name).ravel(), into, a=amount)
    return total


def layer(
    shape_derivatives: ShapeDerivatives, thickness: Callable[[Array, Array], Array]
) -> Change:
    """Cane grown on the bark side.

    Parameters
    ----------
    shape_derivatives : ShapeDerivatives
    thickness : callable
        In m at points (x, y), y of either sign; holds in first order.
    """
    weights = _even_odd(shape_derivatives, thickness)
    return Change(
        _strain_terms(shape_derivatives, weights),
        _products(shape_derivatives.motion, weights),
        *_nothing_more(shape_derivatives),
    )


def softening(
    shape_derivatives: ShapeDerivatives, depth: Callable[[Array, Array], Array]
) -> Change:
    """Stiffness along the grain lost under the bark side, as by a crack; the mass stays.

    Parameters
    ----------
    shape_derivatives : ShapeDerivatives
    depth : callable
        In m at points (x, y): of cane that carries nothing along the grain.
    """
    even, odd = _even_odd(shape_derivatives, depth)
    terms = _strain_terms(shape_derivatives, (-even, -odd))
    terms[[not term.startswith("1") for term in STIFFNESS_TERMS]] = 0
    none = unchanged(shape_derivatives)
    return Change(terms, none.mass, none.mass_kg, none.compliance_m_n)


def added_mass(
    shape_derivatives: ShapeDerivatives, kg_m2: Callable[[Array, Array], Array]
) -> Change:
    """Mass that sticks to the bark side: water, wax.

    Parameters
    ----------
    shape_derivatives : ShapeDerivatives
    kg_m2 : callable
        At points (x, y).
    """
    none = unchanged(shape_derivatives)
    mass_kg = _products(shape_derivatives.motion, _even_odd(shape_derivatives, kg_m2))
    return Change(none.stiffness_terms, none.mass, mass_kg, none.compliance_m_n)


def yielding_clamp(
    shape_derivatives: ShapeDerivatives, left_m3_n: float, right_m3_n: float
) -> Change:
    """Strips on elastic beds.

    Parameters
    ----------
    shape_derivatives : ShapeDerivatives
    left_m3_n, right_m3_n : float
        Yielding in m per Pa of the strips at positive and negative y.
    """
    own = np.linalg.inv(shape_derivatives.strip_m2)
    mean, difference = 0.5 * (left_m3_n + right_m3_n), 0.5 * (left_m3_n - right_m3_n)
    none = unchanged(shape_derivatives)
    compliance = np.block([[mean * own, difference * own], [difference * own, mean * own]])
    return Change(none.stiffness_terms, none.mass, none.mass_kg, compliance)


def _nothing_more(shape_derivatives: ShapeDerivatives) -> tuple[Array, Array]:
    none = unchanged(shape_derivatives)
    return none.mass_kg, none.compliance_m_n


def _even_odd(
    shape_derivatives: ShapeDerivatives, function: Callable[[Array, Array], Array]
) -> tuple[Array, Array]:
    """Even and odd parts (q,) of a function of the vamp's plan, times the area of each point."""
    x, y = shape_derivatives.bark_m.T
    area = shape_derivatives.area_m2 * (x < shape_derivatives.reed.geometry.vamp_x_m[-1])
    left, right = function(x, y), function(x, -y)
    return 0.5 * area * (left + right), 0.5 * area * (left - right)


def _strain_terms(shape_derivatives: ShapeDerivatives, weights: tuple[Array, Array]) -> Array:
    """Strain energy (9, s, s) in a layer of even and odd thickness times area (q,)."""
    return np.stack(
        [
            _products(
                {s: strain[[int(term[0]) - 1, int(term[1]) - 1]] for s, strain in both.items()},
                weights,
                pairs=((0, 1),) if term[0] == term[1] else ((0, 1), (1, 0)),
            )
            for term, both in ((term, shape_derivatives.strain) for term in STIFFNESS_TERMS)
        ]
    )


def _products(
    fields: dict[Symmetry, Array],
    weights: tuple[Array, Array],
    pairs: tuple[tuple[int, int], ...] = ((0, 0), (1, 1), (2, 2)),
) -> Array:
    """Integrals (s, s) of products of components of fields (c, q, r) of either symmetry."""
    even, odd = weights
    blocks = [
        [
            sum(
                fields[a][i].T @ ((even if a is b else odd)[:, None] * fields[b][j])
                for i, j in pairs
            )
            for b in Symmetry
        ]
        for a in Symmetry
    ]
    return np.block(blocks)
