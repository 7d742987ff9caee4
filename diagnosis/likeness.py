"""How alike effects are in what they move, and which are so alike that they count as one."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

# Effects this alike, when what is free anyway has taken what it can, are one class.
ALIKE: Final = 0.8
# Directions along which an effect moves less than this share of its most are rounding.
_ROUNDING = 1e-6


def cosine(one: Array, other: Array) -> float:
    """Largest cosine between what two effects can do.

    Parameters
    ----------
    one, other : (n, k) float
        What each of an effect's sizes moves, whitened.

    Returns
    -------
    float
        0 if either moves nothing.

    Examples
    --------
    >>> import numpy as np
    >>> east, both = np.array([[1.0], [0.0]]), np.array([[1.0], [1.0]])
    >>> round(cosine(east, both), 3)
    0.707
    >>> cosine(east, np.zeros((2, 1)))
    0.0
    """
    bases = []
    for columns in (one, other):
        vectors, values, _ = np.linalg.svd(columns, full_matrices=False)
        bases.append(vectors[:, values > _ROUNDING * max(float(values.max()), 1e-12)])
    if not all(basis.size for basis in bases):
        return 0.0
    return float(np.linalg.norm(bases[0].T @ bases[1], 2))


def cosines(signatures: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Cosine of every effect with every other."""
    names = list(signatures)
    return {
        name: {
            other: cosine(signatures[name], signatures[other]) for other in names if other != name
        }
        for name in names
    }


def classes_of(
    names: Sequence[str], alike: Mapping[str, Mapping[str, float]]
) -> tuple[tuple[str, ...], ...]:
    """Groups of effects each of which is alike to all others of its group, larger groups first.

    Parameters
    ----------
    names : sequence of str
    alike : mapping
        Cosines by name and other name; pairs that are not there are not alike.
    """
    near = {
        name: {other for other, value in alike.get(name, {}).items() if value >= ALIKE}
        for name in names
    }
    left, groups = set(names), []
    while left:
        seed = max(sorted(left), key=lambda name: len(near[name] & left))
        group = [seed]
        for name in sorted(near[seed] & left):
            if all(name in near[member] for member in group):
                group.append(name)
        groups.append(tuple(sorted(group)))
        left -= set(group)
    return tuple(sorted(groups, key=lambda group: (-len(group), group)))
