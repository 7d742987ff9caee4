"""Signs that the cause is none of the catalogue's, each beside what chance makes of it.

Chance is what campaigns would show in which the best rival were true: noise, nuisances and the
form of its effects are drawn, and the same is done to each as to the one that was measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.discrepancy import discrepancies, in_one
from diagnosis.effect_notes import notes_of
from diagnosis.estimate import (
    covariance_left,
    spread_of,
    taken_up,
)
from diagnosis.rivals import Comparison, Rival

Array = NDArray[np.floating[Any]]

_DRAWS = 1000
# Errors of fits have longer tails than a Gaussian's: Student's, of so many freedoms.
_FREEDOMS = 5
# Signs that chance shows more seldom than this count.
_SELDOM = 0.01


@dataclass(frozen=True)
class Trigger:
    """One sign.

    Attributes
    ----------
    id, words : str
    value : float
    chance : float
        Share of campaigns without anything unknown in which it is as large; no less than one in as
        many as were drawn.
    """

    id: str
    words: str
    value: float
    chance: float

    @property
    def fired(self) -> bool:
        """Whether chance hardly explains it."""
        return self.chance < _SELDOM


def triggers(
    comparison: Comparison, rival: Rival, condition: Sequence[str], seed: int = 0
) -> tuple[Trigger, ...]:
    """Look for all signs beside a rival.

    Parameters
    ----------
    comparison : Comparison
    rival : Rival
        What is named; the one without effects if nothing is.
    condition : sequence of str
        Not empty for the numbers of a condition that is left out whole (see `how_far`).
    seed : int
        Of the draws.
    """
    rng = np.random.default_rng(seed)
    both = _with_drawn(rival, rng)
    found = [
        _sign("discrepancy", "numbers move together as no effect has them do",
              in_one(discrepancies(comparison, rival, both))),
        _sign("largest", "one number is farther off than any should be", _largest(rival, both)),
    ]  # fmt: skip
    left_out = np.array([bool(name) for name in condition])
    if left_out.any():
        found.append(
            _sign("transfer", "the other condition is not as predicted",
                  _transfer(rival, both, left_out))
        )  # fmt: skip
    if rival.effects:
        found.append(_implausible(rival, rng))
        kept = _kept(comparison, rival)
        if kept.any():
            found.append(_sign("kept", "what the effect must leave alone has moved",
                               _moved(both, kept)))  # fmt: skip
    return tuple(found)


def _sign(name: str, words: str, values: Array) -> Trigger:
    """Sign of the first value, beside those of the others."""
    chance = (1 + np.count_nonzero(values[1:] >= values[0])) / len(values)
    return Trigger(name, words, float(values[0]), float(chance))


def _with_drawn(rival: Rival, rng: np.random.Generator) -> Array:
    """What a rival leaves (n, 1 + d): of what was measured, and of campaigns if it is true."""
    J, n = rival.free, len(rival.estimate.residuals)
    noise = np.sqrt(1 - 2 / _FREEDOMS) * rng.standard_t(_FREEDOMS, (n, _DRAWS))
    measured = noise + J @ rng.standard_normal((J.shape[1], _DRAWS))
    left = measured - taken_up(J, measured)
    return np.column_stack([rival.estimate.residuals, left])


def _largest(rival: Rival, residuals: Array) -> Array:
    J = rival.free
    variance = 1 - np.einsum("np,pq,nq->n", J, spread_of(J), J, optimize=True)
    scaled = np.abs(residuals) / np.sqrt(np.maximum(variance, 1e-6))[:, None]
    largest: Array = scaled.max(axis=0)
    return largest


def _transfer(rival: Rival, residuals: Array, left_out: NDArray[np.bool_]) -> Array:
    """Squares of what a condition leaves that is predicted by the others."""
    inner, left = covariance_left(rival.free, left_out), residuals[left_out]
    out = np.linalg.solve(inner, left)
    squares: Array = np.sum(out * left, axis=0)
    return squares


def _kept(comparison: Comparison, rival: Rival) -> NDArray[np.bool_]:
    """Numbers of taps that all effects of a rival must leave alone."""
    taps = frozenset.intersection(*(notes_of(sized.effect).unaffected for sized in rival.effects))
    kept = np.zeros(len(rival.estimate.residuals), dtype=bool)
    for block in comparison.blocks:
        kept[comparison.slices[block.name]] = block.tap in taps
    return kept


def _moved(residuals: Array, kept: NDArray[np.bool_]) -> Array:
    """Squares of what numbers that must not move are off by."""
    squares: Array = np.sum(residuals[kept] ** 2, axis=0)
    return squares


def _implausible(rival: Rival, rng: np.random.Generator) -> Trigger:
    usual = np.abs(rng.standard_normal((len(rival.sizes), _DRAWS))).max(axis=0)
    values = np.append(np.abs(rival.sizes).max(), usual)
    return _sign("implausible", "a size is beyond what is plausible", values)
