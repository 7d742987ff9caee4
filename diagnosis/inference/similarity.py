"""How alike effects are in what they move, and which are so alike that they count as one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from physics.effects.effect import Effect

Array = NDArray[np.floating[Any]]

# Effects this alike, when what is free anyway has taken what it can, are one class.
CONFUSABLE: Final = 0.8
# Deviations by which an effect is to stand out.
DETECTION_SIGMA: Final = 5.0
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


@dataclass(frozen=True)
class Detectability:
    """What data could tell of an effect.

    Attributes
    ----------
    effect : str
    absorbed : float
        Share of its signature that what is free anyway takes up; NaN if it has none.
    detectable : dict of float
        Least size, per parameter in its own unit, that stands out by five deviations; infinite if
        no size would.
    confusable : dict of float
        Cosine beside other effects from 0.8 on, by name.
    """

    effect: str
    absorbed: float
    detectable: dict[str, float]
    confusable: dict[str, float]


def detectability_of(
    effects: Sequence[Effect], signatures: Mapping[str, tuple[Array, Array]]
) -> tuple[Detectability, ...]:
    """Tell what data could say of each effect.

    Parameters
    ----------
    effects : sequence of Effect
    signatures : mapping of ((n, s), (n, s)) float
        What each size moves by a deviation of its prior, whitened: all of it, and what of that
        is left after marginalising the nuisances (see `marginalised_signature`). Effects that
        move nothing may be left out.
    """
    alike = cosines({name: left for name, (_, left) in signatures.items()})
    return tuple(_reach(effect, signatures.get(effect.id), alike) for effect in effects)


def _reach(
    effect: Effect,
    signature: tuple[Array, Array] | None,
    alike: Mapping[str, Mapping[str, float]],
) -> Detectability:
    if signature is None or not np.any(signature[0]):
        nothing = {parameter.name: float("inf") for parameter in effect.sizes}
        return Detectability(effect.id, float("nan"), nothing, {})
    whole, left = signature
    with np.errstate(divide="ignore"):
        least = DETECTION_SIGMA * np.array([p.spread for p in effect.sizes])
        least = least / np.linalg.norm(left, axis=0)
    return Detectability(
        effect=effect.id,
        absorbed=1 - float(np.sum(left**2) / np.sum(whole**2)),
        detectable=dict(zip([p.name for p in effect.sizes], least.tolist(), strict=True)),
        confusable={name: value for name, value in alike[effect.id].items() if value >= CONFUSABLE},
    )


def cosines(signatures: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Cosine of every effect with every other."""
    names = list(signatures)
    return {
        name: {
            other: cosine(signatures[name], signatures[other]) for other in names if other != name
        }
        for name in names
    }


def confusable_classes(reach: Sequence[Detectability]) -> tuple[tuple[str, ...], ...]:
    """Groups of effects each of which is alike to all others of its group, larger groups first."""
    near = {entry.effect: set(entry.confusable) for entry in reach}
    left, groups = set(near), []
    while left:
        seed = max(sorted(left), key=lambda name: len(near[name] & left))
        group = [seed]
        for name in sorted(near[seed] & left):
            if all(name in near[member] for member in group):
                group.append(name)
        groups.append(tuple(sorted(group)))
        left -= set(group)
    return tuple(sorted(groups, key=lambda group: (-len(group), group)))
