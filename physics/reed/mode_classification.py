"""Modes named by what they look like: symmetry, order across the width, nodes along the reed.

The paper's classes are F (flexural), T (transversal) and X (generic); L (lateral) modes move in
the plane of the reed, H modes in its heel. A name never depends on the order of frequencies,
which differs from reed to reed.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from holography.arrays import Array
from physics.reed.elements.fem import Symmetry

# Names of the paper's Table 9, in its order.
PAPER_MODES = ("F1", "T1", "F2", "T2", "X1", "F3", "T3", "X2", "X3", "T4", "F4")
# Order across the width and number of nodal lines across the reed of each generic mode. X1 to X3
# are fixed by the paper's pictures; X4 to X6 are taken in order of computed frequency.
_GENERIC = {(1, 1): "X1", (2, 1): "X2", (1, 2): "X3", (1, 3): "X4", (2, 2): "X5", (3, 1): "X6"}
_WIDTH_ORDERS = 7
# The rounded tip has no straight line across; profiles start behind it.
_TIP_M = 0.5e-3
# Towards the foot, where less than this share of the greatest is left, signs mean nothing.
_LEAST_DEFLECTION = 0.02
# A mode with more than this share of its kinetic energy sideways and behind the vamp is lateral or
# the heel's, whichever is more.
_FOREIGN_SHARE = 0.5
# A name that bears out less than this share of a motion says nothing of it.
_LEAST_CLAIM = 0.1
# Distinguished from their like of the other symmetry: the paper's lateral modes bend in the plane,
# modes of the heel are symmetric first, and a place without a name belongs to neither.
_SUFFIXES = {
    ("L", Symmetry.SYMMETRIC): "s",
    ("H", Symmetry.ANTISYMMETRIC): "a",
    ("?", Symmetry.SYMMETRIC): "s",
    ("?", Symmetry.ANTISYMMETRIC): "a",
}


@dataclass(frozen=True)
class ModeDescriptor:
    """What names tell m motions of a reed by, in their part of one symmetry.

    Attributes
    ----------
    symmetry : Symmetry
    share, sideways, behind : (m,) float
        Shares of the kinetic energy of each motion: of this part, and in it of what moves along y
        and of what moves along z behind the vamp.
    profiles : (k, 7, m) float
        Of the vamp's deflection (see `vamp_profiles`).
    square : (m,) float
        Of the vamp's deflection, integrated; the profiles resolve a part of it.
    """

    symmetry: Symmetry
    share: Array
    sideways: Array
    behind: Array
    profiles: Array
    square: Array


@dataclass(frozen=True)
class ModeClassification:
    """Name of a motion.

    Attributes
    ----------
    name : str
        ``?`` and a number where a better claimant bears the name.
    symmetry : Symmetry
        Of the part with more kinetic energy.
    similarity : float
        Share of the vamp's motion that bears out the name; of a lateral mode or one of the heel,
        of the kinetic energy.
    outside : float
        Share of the kinetic energy sideways and behind the vamp.
    """

    name: str
    symmetry: Symmetry
    similarity: float
    outside: float


def name_of(width_order: int, nodal_lines: int) -> str:
    """Name of a mode with a given order across the width and nodal lines across the reed."""
    if width_order == 0:
        return f"F{nodal_lines + 1}"
    if nodal_lines == 0:
        return f"T{width_order}"
    return _GENERIC.get((width_order, nodal_lines), f"X({width_order},{nodal_lines})")


def is_symmetric(name: str) -> bool:
    """Whether a mode of the vamp, F, T or X1 to X6, is symmetric about the reed's axis.

    Raises
    ------
    ValueError
        For any other name.
    """
    if name.startswith("F"):
        return True
    if name.startswith("T"):
        return int(name[1:]) % 2 == 0
    for (width_order, _), generic in _GENERIC.items():
        if generic == name:
            return width_order % 2 == 0
    raise ValueError(f"{name} is no mode of the vamp with a fixed symmetry")


def vamp_profiles(plan_m: Array, deflections: Array, vamp_end_m: float) -> tuple[Array, Array]:
    """Width profiles of the vamp's bark side, and the deflections that they describe.

    Both are weighted by the root of the area that each line or point stands for, so that sums of
    their squares are integrals over the vamp, however the mesh is graded.

    Parameters
    ----------
    plan_m : (nx, ny, 2) float
        Nodes (x, y) of half a reed, from the axis to the side on each line across.
    deflections : (nx, ny, r) float
        Along z, at these nodes.
    vamp_end_m : float
        Abscissa.

    Returns
    -------
    profiles : (k, 7, r) float
        See `width_profiles`.
    points : (k·ny, r) float
    """
    x_m = plan_m[:, 0, 0]
    vamp = (x_m > _TIP_M) & (x_m < vamp_end_m)
    width_m = plan_m[vamp, -1:, 1]
    eta = plan_m[vamp, :, 1] / width_m
    area_m2 = np.gradient(x_m[vamp])[:, None] * width_m
    lines = deflections[vamp] * np.sqrt(area_m2)[..., None]
    points = lines * np.sqrt(_point_weights(eta))[..., None]
    return width_profiles(lines, eta), points.reshape(eta.size, -1)


def width_profiles(shape: Array, eta: Array) -> Array:
    """Legendre profiles of deflections across the width.

    Parameters
    ----------
    shape : (nx, ny, r) float
        Deflections on lines across half the reed.
    eta : (nx, ny) float
        y / half width of each point, from 0 to 1 along a line.

    Returns
    -------
    (nx, 7, r) float
        Coefficients of the orthonormal Legendre polynomials of order 0 to 6; of a half reed, only
        those of the deflection's own parity mean anything.
    """
    table = np.polynomial.legendre.legvander(eta, _WIDTH_ORDERS - 1)
    table *= np.sqrt(2 * np.arange(_WIDTH_ORDERS) + 1)
    profiles: Array = np.einsum("xy,xyl,xyr->xlr", _point_weights(eta), table, shape, optimize=True)
    return profiles


def _point_weights(eta: Array) -> Array:
    """Share (nx, ny) of each line across that a point on it stands for."""
    edges = np.pad(0.5 * (eta[:, 1:] + eta[:, :-1]), ((0, 0), (1, 1)))
    edges[:, 0], edges[:, -1] = eta[:, 0], eta[:, -1]
    return np.diff(edges, axis=1)


def names_of(descriptors: Sequence[ModeDescriptor]) -> list[ModeClassification]:
    """Give each motion a name; no two get the same.

    Parameters
    ----------
    descriptors : sequence of ModeDescriptor
        Of the same m motions, ascending in frequency: one of half a reed, whose motions have one
        symmetry; two of a whole reed, whose motions may have parts of both.

    Returns
    -------
    list of ModeClassification
    """
    outside = np.sum(
        [descriptor.sideways + descriptor.behind for descriptor in descriptors], axis=0
    )
    larger = np.argmax([descriptor.share for descriptor in descriptors], axis=0)
    vamp = np.flatnonzero(outside <= _FOREIGN_SHARE).tolist()
    claims = _claims(descriptors)
    # Squared: one clear similarity is worth more than two faint ones.
    weights = [
        {name: claim**2 for name, claim in claims[m].items() if claim > _LEAST_CLAIM} for m in vamp
    ]
    names = dict(zip(vamp, (name for name, _ in assign_names(weights)), strict=True))
    counts: Counter[str] = Counter()
    answer = []
    for m, descriptor in enumerate(descriptors[k] for k in larger):
        name = names.get(m)
        if name in claims[m]:
            similarity = claims[m][name]
        else:
            kind, similarity = ("?", 0.0) if name else _foreign_kind(descriptor, m)
            suffix = _SUFFIXES.get((kind, descriptor.symmetry), "")
            counts[kind + suffix] += 1
            name = f"{kind}{counts[kind + suffix]}{suffix}"
        answer.append(ModeClassification(name, descriptor.symmetry, similarity, float(outside[m])))
    return answer


def _foreign_kind(descriptor: ModeDescriptor, number: int) -> tuple[str, float]:
    """L or H, and the share of the kinetic energy that says so."""
    sideways, behind = float(descriptor.sideways[number]), float(descriptor.behind[number])
    return ("L", sideways) if sideways > behind else ("H", behind)


def _claims(descriptors: Sequence[ModeDescriptor]) -> list[dict[str, float]]:
    """Names that motions could bear on the vamp, and the share of each motion behind each name."""
    claims: list[dict[str, float]] = [{} for _ in descriptors[0].share]
    for descriptor in descriptors:
        symmetric = descriptor.symmetry is Symmetry.SYMMETRIC
        own = similarities(descriptor.profiles, descriptor.square, symmetric=symmetric)
        for claim, share, names in zip(claims, descriptor.share.tolist(), own, strict=True):
            claim |= {name: share * similarity for name, similarity in names.items()}
    return claims


def similarities(profiles: Array, square: Array, *, symmetric: bool) -> list[dict[str, float]]:
    """Names that vibrations of the vamp could bear, each with the share of motion behind it.

    Parameters
    ----------
    profiles : (k, 7, m) float
        Width profiles of the deflections, tip first (see `vamp_profiles`).
    square : (m,) float
        Of the deflections, integrated over the vamp.
    symmetric : bool
        Symmetry of the motions in the median plane.

    Returns
    -------
    list of dict
        Name → share in [0, 1]. The shares of a vibration add to 1, or to less where it has waves
        across that are finer than the profiles resolve: T7 and beyond.
    """
    orders = range(0 if symmetric else 1, _WIDTH_ORDERS, 2)
    own = profiles[:, orders]
    energy = np.sum(own**2, axis=0)
    whole = np.maximum(square, energy.sum(axis=0))
    # A part of a motion that does not move bears out no name.
    shares = energy / np.where(whole > 0, whole, 1.0)
    nodes = _nodal_lines(own)
    return [
        {
            name_of(order, lines): share
            for order, lines, share in zip(orders, of_lines, of_shares, strict=True)
        }
        for of_lines, of_shares in zip(nodes.T.tolist(), shares.T.tolist(), strict=True)
    ]


def assign_names(candidates: Sequence[dict[str, float]]) -> list[tuple[str, float]]:
    """Give each of several vibrations a name of its own.

    The assignment with the greatest total similarity: where two modes exchange shapes (the avoided
    crossing of T4 and F4), each gets the name that the other likes less.

    Returns
    -------
    list of (name, similarity)
    """
    names = sorted({name for candidate in candidates for name in candidate})
    # Enough places without a name, so that no motion is forced into a name that is taken.
    names += [f"?{place}" for place in range(1, len(candidates) + 1)]
    # A name that one has no claim to is worth less than none.
    similarity = np.array(
        [[c.get(name, 0.0 if name.startswith("?") else -1.0) for name in names] for c in candidates]
    ).reshape(len(candidates), len(names))
    rows, columns = linear_sum_assignment(similarity, maximize=True)
    return [
        (names[column], float(similarity[row, column]))
        for row, column in sorted(zip(rows, columns, strict=True))
    ]


def _nodal_lines(profiles: Array) -> NDArray[np.intp]:
    """Sign changes along the reed (…) of profiles (k, …), ignoring where they die away."""
    kept = np.abs(profiles) > _LEAST_DEFLECTION * np.abs(profiles).max(axis=0)
    lines = np.arange(len(profiles)).reshape(-1, *(1,) * (profiles.ndim - 1))
    last_kept = np.maximum.accumulate(np.where(kept, lines, 0), axis=0)
    signs = np.take_along_axis(kept * np.sign(profiles), last_kept, axis=0)
    changes: NDArray[np.intp] = np.count_nonzero(signs[1:] * signs[:-1] < 0, axis=0)
    return changes
