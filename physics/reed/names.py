"""Modes named by what they look like: symmetry, order across the width, nodes along the reed.

The paper's classes are F (flexural), T (transversal) and X (generic); L (lateral) modes move in
the plane of the reed, H modes in its heel. A name never depends on the order of frequencies,
which differs from reed to reed.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.floating[Any]]

# Names of the paper's Table 9, in its order.
PAPER_MODES = ("F1", "T1", "F2", "T2", "X1", "F3", "T3", "X2", "X3", "T4", "F4")
# Order across the width and number of nodal lines across the reed of each generic mode. X1 to X3
# are fixed by the paper's pictures; X4 to X6 are taken in order of computed frequency.
_GENERIC = {(1, 1): "X1", (2, 1): "X2", (1, 2): "X3", (1, 3): "X4", (2, 2): "X5", (3, 1): "X6"}
_WIDTH_ORDERS = 7


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
    edges = np.pad(0.5 * (eta[:, 1:] + eta[:, :-1]), ((0, 0), (1, 1)))
    edges[:, 0], edges[:, -1] = eta[:, 0], eta[:, -1]
    weights = np.diff(edges, axis=1)
    profiles: Array = np.einsum("xy,xyl,xyr->xlr", weights, table, shape, optimize=True)
    return profiles


def likenesses(profiles: Array, *, symmetric: bool) -> dict[str, float]:
    """Names that a vibration of the vamp could bear, each with the share of motion behind it.

    Parameters
    ----------
    profiles : (nx, 7) float
        Width profiles of the deflection, tip first (see `width_profiles`).
    symmetric : bool
        Symmetry of the motion in the median plane.

    Returns
    -------
    dict
        Name → share in [0, 1]; the shares of one vibration add to 1.
    """
    orders = range(0 if symmetric else 1, _WIDTH_ORDERS, 2)
    energy = (profiles**2).sum(axis=0)
    total = sum(energy[order] for order in orders)
    return {
        name_of(order, _nodal_lines(profiles[:, order])): float(energy[order] / total)
        for order in orders
    }


def assign_names(candidates: Sequence[dict[str, float]]) -> list[tuple[str, float]]:
    """Give each of several vibrations a name of its own.

    The assignment with the greatest total likeness: where two modes exchange shapes (the avoided
    crossing of T4 and F4), each gets the name that the other likes less.

    Returns
    -------
    list of (name, likeness)
    """
    names = sorted({name for candidate in candidates for name in candidate})
    # Enough nameless places that nobody is forced into a name that is taken.
    names += [f"?{place}" for place in range(1, len(candidates) + 1)]
    # A name that one has no claim to is worth less than none.
    likeness = np.array(
        [[c.get(name, 0.0 if name.startswith("?") else -1.0) for name in names] for c in candidates]
    )
    rows, columns = linear_sum_assignment(likeness, maximize=True)
    return [
        (names[column], float(likeness[row, column]))
        for row, column in sorted(zip(rows, columns, strict=True))
    ]


def _nodal_lines(profile: Array) -> int:
    """Sign changes along the reed, ignoring the foot where the deflection dies away."""
    kept = profile[np.abs(profile) > 0.02 * np.abs(profile).max()]
    return int(np.count_nonzero(np.diff(np.sign(kept))))
