"""Similarity of effects' signatures, confusable effects, and the minimum detectable size."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from holography.arrays import Array
from physics.effects.effect import Effect

# Effects whose marginalised signatures have at least this cosine are confusable.
CONFUSABLE: Final = 0.8
# An effect is detected at this many standard deviations.
DETECTION_SIGMA: Final = 5.0
# Directions along which an effect moves less than this fraction of its largest are rounding.
_ROUNDING = 1e-6


def cosine(one: Array, other: Array) -> float:
    """Return the largest cosine between the signatures of two effects.

    Parameters
    ----------
    one, other : (n, k) float
        Whitened signature of each size of an effect.

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
    """How well data can detect an effect.

    Attributes
    ----------
    effect : str
    absorbed : float
        Fraction of its signature that nuisances absorb; NaN if it has no signature.
    detectable : dict of float
        Minimum size, for each parameter in its unit, that is detected at five standard deviations;
        infinite if no size is.
    confusable : dict of float
        Cosine with each effect from 0.8 on, by identifier.
    """

    effect: str
    absorbed: float
    detectable: dict[str, float]
    confusable: dict[str, float]


def detectability_of(
    effects: Sequence[Effect], signatures: Mapping[str, tuple[Array, Array]]
) -> tuple[Detectability, ...]:
    """Return how well data can detect each effect.

    Parameters
    ----------
    effects : sequence of Effect
    signatures : mapping of ((n, s), (n, s)) float
        Whitened signature of each size, for one standard deviation of its prior: all of it, and
        what is left after marginalising the nuisances (see `marginalised_signature`). Effects
        without a signature may be left out.
    """
    similar = cosines({name: left for name, (_, left) in signatures.items()})
    return tuple(_reach(effect, signatures.get(effect.id), similar) for effect in effects)


def _reach(
    effect: Effect,
    signature: tuple[Array, Array] | None,
    similar: Mapping[str, Mapping[str, float]],
) -> Detectability:
    if signature is None or not np.any(signature[0]):
        nothing = {parameter.name: float("inf") for parameter in effect.sizes}
        return Detectability(effect.id, float("nan"), nothing, {})
    whole, left = signature
    with np.errstate(divide="ignore"):
        least = DETECTION_SIGMA * np.array([p.scale for p in effect.sizes])
        least = least / np.linalg.norm(left, axis=0)
    return Detectability(
        effect=effect.id,
        absorbed=1 - float(np.sum(left**2) / np.sum(whole**2)),
        detectable=dict(zip([p.name for p in effect.sizes], least.tolist(), strict=True)),
        confusable={
            name: value for name, value in similar[effect.id].items() if value >= CONFUSABLE
        },
    )


def cosines(signatures: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Return the cosine of every effect with every other."""
    names = list(signatures)
    return {
        name: {
            other: cosine(signatures[name], signatures[other]) for other in names if other != name
        }
        for name in names
    }


def confusable_classes(reach: Sequence[Detectability]) -> tuple[tuple[str, ...], ...]:
    """Return groups in which all effects are confusable with each other, larger groups first."""
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
