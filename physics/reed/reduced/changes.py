"""Changes of a reed: layers, softening, added mass, and a clamp that yields or is moved.

A change is what it adds to stiffness, mass and compliance, in the coordinates of the parts of a
`ReducedReed`. Changes are vectors: see `combined`. Those of shape hold to first order;
`studies.reduced_basis` measures over which range.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import combinations_with_replacement, pairwise

import numpy as np

from holography.arrays import Array
from physics.reed.cane.material import STIFFNESS_TERMS
from physics.reed.reduced.boundary import STRIP_AXES
from physics.reed.reduced.reed import ReducedReed

Function = Callable[[Array, Array], Array]
Blocks = Mapping[tuple[int, int], Array]

# Offset of the thickness of all the vamp up to which first order holds to 3 cents
# (`studies.reduced_basis`).
LARGEST_OFFSET_M = 7e-6
# How many times as much the bed of a strip yields along its surface as away from it: hard plastic
# that may spread, 2(1 + ν) with ν = 0.35 (decision 0096).
BED_SHEAR = 2.7
_MATRICES = ("stiffness_terms", "mass", "mass_kg")


@dataclass(frozen=True)
class Change:
    """What is added to a reed.

    Matrices are kept as blocks between parts a ≤ b, by their numbers; a block that is not there is
    zero. With s and t coordinates of these parts a block has the shape (…, s, t).

    Attributes
    ----------
    stiffness_terms : mapping of (9, s, t) float
        Per unit of each independent stiffness of the cane.
    mass : mapping of (s, t) float
        Per unit density.
    mass_kg : mapping of (s, t) float
        Of what is no cane.
    compliance_m_n : (c, c) float, or None
        Of what holds the strips, in their coordinates, part after part; None if it does not yield.
    """

    stiffness_terms: Blocks = field(default_factory=dict)
    mass: Blocks = field(default_factory=dict)
    mass_kg: Blocks = field(default_factory=dict)
    compliance_m_n: Array | None = None


def combined(parts: Iterable[tuple[float, Change]]) -> Change:
    """Sum of changes, each multiplied by an amount."""
    sums: dict[str, dict[tuple[int, int], Array]] = {name: {} for name in _MATRICES}
    compliance: Array | None = None
    for amount, change in parts:
        for name, total in sums.items():
            for place, block in getattr(change, name).items():
                if place in total:
                    total[place] += amount * block
                else:
                    total[place] = amount * block
        own = change.compliance_m_n
        if own is not None:
            compliance = amount * own if compliance is None else compliance + amount * own
    return Change(**sums, compliance_m_n=compliance)


def as_matrix(reed: ReducedReed, blocks: Blocks) -> Array:
    """Matrix (…, s, s) in the coordinates of all parts."""
    bounds = np.cumsum([0, *(part.size for part in reed.loose.values())])
    leading = next((block.shape[:-2] for block in blocks.values()), ())
    whole = np.zeros((*leading, bounds[-1], bounds[-1]))
    for (a, b), block in blocks.items():
        rows, columns = slice(bounds[a], bounds[a + 1]), slice(bounds[b], bounds[b + 1])
        whole[..., columns, rows] = np.swapaxes(block, -1, -2)
        whole[..., rows, columns] = block
    return whole


def layer(reed: ReducedReed, thickness: Function) -> Change:
    """Cane grown on the bark side of the vamp.

    Parameters
    ----------
    reed : ReducedReed
    thickness : callable
        In m at points (x, y), y of either sign; holds in first order.
    """
    return Change(_strain_terms(reed, thickness), _moved(reed, thickness))


def softening(reed: ReducedReed, depth: Function) -> Change:
    """Stiffness along the grain lost under the bark side, as by a crack; the mass stays.

    Parameters
    ----------
    reed : ReducedReed
    depth : callable
        In m at points (x, y): of cane that carries nothing along the grain.
    """
    along = np.array([-float(term.startswith("1")) for term in STIFFNESS_TERMS])[:, None, None]
    terms = _strain_terms(reed, depth)
    return Change({place: along * block for place, block in terms.items()})


def added_mass(reed: ReducedReed, kg_m2: Function) -> Change:
    """Mass that sticks to the bark side: water, wax.

    Parameters
    ----------
    reed : ReducedReed
    kg_m2 : callable
        At points (x, y).
    """
    return Change(mass_kg=_moved(reed, kg_m2))


def yielding_clamp(
    reed: ReducedReed,
    left_m3_n: float,
    right_m3_n: float,
    *,
    away: float = 1.0,
    along: float = BED_SHEAR,
) -> Change:
    """Strips on elastic beds.

    Parameters
    ----------
    reed : ReducedReed
    left_m3_n, right_m3_n : float
        Yielding in m per Pa of the strips at positive and negative y.
    away, along : float
        How many times as much beds yield in the direction away from the reed, and along its surface
        in both directions.
    """
    times = np.where(STRIP_AXES == 2, away, along)
    # No coordinate of a strip moves in two directions.
    own = times[:, None] * np.linalg.inv(reed.strip_m2)
    mean, difference = 0.5 * (left_m3_n + right_m3_n), 0.5 * (left_m3_n - right_m3_n)
    return Change(
        compliance_m_n=np.block([[mean * own, difference * own], [difference * own, mean * own]])
    )


def moved_clamp(reed: ReducedReed, back_m: float, turned_m: float = 0.0) -> Change:
    """Strips whose front edge is farther from the tip.

    Parameters
    ----------
    reed : ReducedReed
    back_m : float
        Of both strips.
    turned_m : float
        More of that of y > 0, and less of the other.
    """
    by = np.array([back_m, turned_m])
    terms = np.tensordot(by, reed.edge.stiffness_terms, axes=1)
    mass = np.tensordot(by, reed.edge.mass, axes=1)
    return Change(_blocks(reed, terms), _blocks(reed, mass))


def _blocks(reed: ReducedReed, whole: Array) -> Blocks:
    """Blocks of a matrix (…, s, s) that are not zero."""
    bounds = np.cumsum([0, *(part.size for part in reed.loose.values())])
    cuts = [slice(*ends) for ends in pairwise(bounds.tolist())]
    found = {
        (a, b): whole[..., cuts[a], cuts[b]]
        for a, b in combinations_with_replacement(range(len(cuts)), 2)
    }
    return {place: block for place, block in found.items() if block.any()}


def _weights(reed: ReducedReed, function: Function) -> tuple[Array, Array]:
    """A function of the vamp's plan times the area of each point (b,): even and odd parts.

    Of a whole reed everything is in the first, which couples motions within its only part.
    """
    x, y = reed.bark_m.T
    area = reed.area_m2 * (x < reed.geometry.vamp_x_m[-1])
    left = area * function(x, y)
    if None in reed.loose:
        return left, np.zeros_like(left)
    right = area * function(x, -y)
    return 0.5 * (left + right), 0.5 * (left - right)


def _strain_terms(reed: ReducedReed, function: Function) -> Blocks:
    """Strain energy (9, s, t) in a layer of a thickness, per unit of each stiffness."""
    weights, fields = _weights(reed, function), [part.strain for part in reed.loose.values()]
    by_term = []
    for term in STIFFNESS_TERMS:
        i, j = int(term[0]) - 1, int(term[1]) - 1
        by_term.append(_products(fields, weights, sorted({(i, j), (j, i)})))
    return {place: np.stack([blocks[place] for blocks in by_term]) for place in by_term[0]}


def _moved(reed: ReducedReed, function: Function) -> Blocks:
    """Integrals (s, t) of a function times products of displacements."""
    fields = [part.motion for part in reed.loose.values()]
    return _products(fields, _weights(reed, function), [(k, k) for k in range(3)])


def _products(
    fields: list[Array], weights: tuple[Array, Array], pairs: list[tuple[int, int]]
) -> dict[tuple[int, int], Array]:
    """Integrals (s, t) of products of components of the fields (c, b, s) of two parts."""
    even, odd = weights
    blocks = {}
    for a, b in combinations_with_replacement(range(len(fields)), 2):
        weight = (even if a == b else odd)[:, None]
        if weight.any():
            products = [fields[a][i].T @ (weight * fields[b][j]) for i, j in pairs]
            blocks[a, b] = np.sum(products, axis=0)
    return blocks
