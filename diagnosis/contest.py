"""Which effect, if any: every known effect by itself, likely pairs, and something unknown.

The probability of each is its evidence times a prior that is the same for all effects.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import logsumexp

from diagnosis.block import Block
from diagnosis.rivals import Comparison, Rival, Sized, compete, gain_by_noise
from physics.effects.form import Effect

Array = NDArray[np.floating[Any]]

NONE, UNKNOWN = "none", "unknown"
# Prior probabilities: nothing wrong, one effect, two, something that is not in the catalogue.
PRIOR = {"none": 0.35, "one": 0.4, "two": 0.1, "unknown": 0.15}
# Effects whose evidence is within so many nats of the best are tried in pairs, as many at most.
_PAIRED_WITHIN, _MOST_PAIRED, _LEAST_GAIN = 1e9, 6, 3.0
# Unknown things have any of these sizes, in standard deviations of the numbers that they move.
_SIZES = (2.0, 5.0, 15.0, 50.0, 150.0, 500.0)
_KINDS = ("each", "quantity", "mode", "band", "time")
# Sizes at which an effect's signature is taken, in deviations of its prior.
_PROBE = 1.0
# Effects that move whitened numbers by less do not move them.
_LEAST_MOVED = 1e-6


@dataclass(frozen=True)
class Contest:
    """All rivals.

    Attributes
    ----------
    null : Rival
    alone : dict of Rival
        By id.
    pairs : dict of Rival
        By ids.
    unknown : dict of float
        Log Bayes factor of something unknown in each block, beside none.
    log_probability : dict of float
        Of `NONE`, `UNKNOWN`, ids, and ids of pairs joined by '+'.
    """

    null: Rival
    alone: dict[str, Rival]
    pairs: dict[tuple[str, str], Rival]
    unknown: dict[str, float]
    log_probability: dict[str, float]


def contest(
    comparison: Comparison,
    effects: Sequence[Effect],
    progress: Callable[[float], None] | None = None,
) -> Contest:
    """Let all effects compete."""
    report = progress or (lambda _share: None)
    null = compete(comparison, (), [np.zeros(len(comparison.nuisances))])
    alone: dict[str, Rival] = {}
    for number, effect in enumerate(effects):
        found = _alone(comparison, null, effect)
        if found is not None:
            alone[effect.id] = found
        report(0.7 * (number + 1) / len(effects))
    null = _polished(comparison, null, alone.values())
    pairs = _pairs(comparison, null, alone)
    report(0.95)
    unknown = {block.name: _unknown(comparison, null, block) for block in comparison.blocks}
    probabilities = _probabilities(null, alone, pairs, unknown, len(effects))
    report(1.0)
    return Contest(null, alone, pairs, unknown, probabilities)


def _polished(comparison: Comparison, null: Rival, rivals: Any) -> Rival:
    """Fit the twin without effects again, from where its best rival's nuisances have come to."""
    best = max(rivals, key=lambda rival: rival.log_evidence, default=None)
    if best is None:
        return null
    p = len(comparison.nuisances)
    again = compete(comparison, (), [best.estimate.z[:p]])
    return max(null, again, key=lambda rival: -rival.estimate.cost)


def _alone(comparison: Comparison, null: Rival, effect: Effect) -> Rival | None:
    """Fit one effect, at its best place; None if it moves nothing, or is of no possible reed."""
    places = [dict(zip((p.name for p in effect.placed), at, strict=True))
              for at in product(*(p.places for p in effect.placed))]  # fmt: skip
    ranked = []
    for at in places:
        sized = Sized(effect, at)
        sign_gains = [_screened(comparison, null, sized, sign) for sign in (1.0, -1.0)]
        options = [option for option in sign_gains if option is not None]
        if options:
            gain, start = max(options, key=lambda option: option[0])
            ranked.append((gain, start, sized))
    if not ranked:
        return None
    ranked.sort(key=lambda entry: -entry[0])
    gain, start, sized = ranked[0]
    try:
        rival = compete(comparison, (sized,), [np.concatenate([null.estimate.z, start])])
    except ValueError:
        return None
    if len(ranked) > 1:
        # Elsewhere it is worse by as much as its signature says; here the fit is exact.
        others = logsumexp([entry[0] - gain for entry in ranked]) - np.log(len(places))
        rival = Rival(rival.effects, rival.estimate, rival.log_evidence + float(others), rival.chi2)
    return rival


def _screened(
    comparison: Comparison, null: Rival, sized: Sized, sign: float
) -> tuple[float, Array] | None:
    """Gain of log evidence along the signature of an effect, and the sizes to begin with."""
    if sign < 0 and sized.sizes[0].positive:
        return None
    table = _signature(comparison, null, sized, sign)
    if table is None:
        return None
    beside, r = _beside(null, table), null.estimate.residuals
    information = table.T @ beside + np.eye(table.shape[1])
    pull = -(table.T @ r)
    size = np.linalg.solve(information, pull)
    bound = np.array([p.positive for p in sized.sizes])
    begin: Array = np.where(bound, np.maximum(size, 0.05), size)
    gain = 0.5 * float(pull @ np.linalg.solve(information, pull))
    gain -= 0.5 * float(np.linalg.slogdet(information)[1])
    if np.any(bound & (size <= 0)):
        gain = -0.5 * float(np.linalg.slogdet(information)[1])
    return gain, np.clip(begin, -6.0, 6.0)


def signatures(comparison: Comparison, null: Rival, alone: Mapping[str, Rival]) -> dict[str, Array]:
    """What each effect moves (n, k), whitened, when nuisances have taken what they can."""
    found = {}
    for name, rival in alone.items():
        sized = rival.effects[0]
        sign = 1.0 if sized.sizes[0].positive or rival.estimate.z[-len(sized.sizes)] > 0 else -1.0
        table = _signature(comparison, null, sized, sign)
        if table is not None:
            found[name] = _beside(null, table)
    return found


def _beside(null: Rival, table: Array) -> Array:
    """Columns (n, k) less what the nuisances take up of them."""
    J = null.estimate.jacobian
    M = linalg.cho_factor(np.eye(J.shape[1]) + J.T @ J)
    beside: Array = table - J @ linalg.cho_solve(M, J.T @ table)
    return beside


def _signature(comparison: Comparison, null: Rival, sized: Sized, sign: float) -> Array | None:
    """What each size of an effect moves (n, k), whitened; None if nothing, or of no reed."""
    z, columns = null.estimate.z, []
    twin = comparison.twin(z)
    for k in range(len(sized.sizes)):
        size = np.zeros(len(sized.sizes))
        # What a second parameter does may depend on the first, the effect's strength.
        size[0] = sign * _PROBE
        base = np.zeros(len(sized.sizes))
        if k:
            base[0] = sign * _PROBE
            size[k] = _PROBE
        try:
            moved = comparison.residuals(sized.change(twin, size))
            start = comparison.residuals(sized.change(twin, base)) if k else null.estimate.residuals
        except ValueError:
            return None
        columns.append((moved - start) / (sign if not k else 1.0))
    table = np.stack(columns, axis=1)
    return table if np.any(np.abs(table) > _LEAST_MOVED) else None


def _pairs(
    comparison: Comparison, null: Rival, alone: dict[str, Rival]
) -> dict[tuple[str, str], Rival]:
    """Fit pairs of the best effects."""
    p = len(comparison.nuisances)
    ranked = sorted(alone.values(), key=lambda rival: -rival.log_evidence)
    best = [r for r in ranked if r.log_evidence > null.log_evidence + _LEAST_GAIN][:_MOST_PAIRED]
    found = {}
    for one, other in combinations(best, 2):
        z = one.estimate.z[:p] + other.estimate.z[:p] - null.estimate.z
        start = np.concatenate([z, one.estimate.z[p:], other.estimate.z[p:]])
        try:
            rival = compete(comparison, (*one.effects, *other.effects), [start])
        except ValueError:
            continue
        found[one.names[0], other.names[0]] = rival
    return found


def _unknown(comparison: Comparison, null: Rival, block: Block) -> float:
    """Log Bayes factor of something that moves the numbers of a block in no known way."""
    piece = comparison.slices[block.name]
    J = null.estimate.jacobian
    M = linalg.cho_factor(np.eye(J.shape[1]) + J.T @ J)
    J_b, left = J[piece], null.estimate.residuals[piece]
    told = np.eye(len(left)) - J_b @ linalg.cho_solve(M, J_b.T)
    gains = []
    for kind in _KINDS:
        table = _table(block, kind)
        if table is None:
            continue
        pull, information = table.T @ left, table.T @ told @ table
        values, vectors = np.linalg.eigh(information)
        along = (vectors.T @ pull) ** 2
        for size in _SIZES:
            grown = 1 + size**2 * np.maximum(values, 0)
            gains.append(float(0.5 * np.sum(size**2 * along / grown) - 0.5 * np.sum(np.log(grown))))
    # Of the twin without effects it is known that its noise may be larger.
    usual = gain_by_noise(float(left @ left), len(left))
    return float(logsumexp(gains) - np.log(len(gains))) - usual


def _table(block: Block, kind: str) -> Array | None:
    """Columns (n, c) along which something unknown may move a block, whitened."""
    if kind == "each":
        return np.eye(len(block.values))
    labels = [f"{place.quantity} {getattr(place, kind)}" for place in block.places]
    names = sorted(set(labels))
    if len(names) in (1, len(labels)) and kind != "quantity":
        return None
    deviation = np.sqrt(1 / np.diag(np.linalg.inv(block.covariance)))
    indicator = np.array([[label == name for name in names] for label in labels], dtype=float)
    table: Array = block.root @ (deviation[:, None] * indicator)
    return table


def _probabilities(
    null: Rival,
    alone: dict[str, Rival],
    pairs: dict[tuple[str, str], Rival],
    unknown: dict[str, float],
    effects: int,
) -> dict[str, float]:
    logs = {NONE: np.log(PRIOR["none"])}
    for name, rival in alone.items():
        logs[name] = np.log(PRIOR["one"] / effects) + rival.log_evidence - null.log_evidence
    count = effects * (effects - 1) / 2
    for (one, other), rival in pairs.items():
        gain = rival.log_evidence - null.log_evidence
        logs[f"{one}+{other}"] = np.log(PRIOR["two"] / count) + gain
    logs[UNKNOWN] = float(
        np.log(PRIOR["unknown"] / len(unknown)) + logsumexp(list(unknown.values()))
    )
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}
