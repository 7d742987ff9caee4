"""Which effect, if any: every known effect by itself, likely pairs, and something unknown.

The probability of each is its evidence times a prior that is the same for all effects.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from diagnosis.discrepancy import anything, discrepancies
from diagnosis.rivals import Comparison, Rival, compete
from diagnosis.sampling import Sampled, checked
from diagnosis.screening import places_of, screened
from physics.effects.form import Effect

Array = NDArray[np.floating[Any]]

NONE, UNKNOWN = "none", "unknown"
# Prior probabilities: nothing wrong, one effect, two, something that is not in the catalogue.
PRIOR = {"none": 0.35, "one": 0.4, "two": 0.1, "unknown": 0.15}
# Of the best effects, all pairs; and the best with as many that explain most of what it leaves.
_MOST_PAIRED, _MOST_BESIDE, _LEAST_GAIN = 5, 4, 3.0
# Beside so many of the likeliest something unknown is looked for, of this prior.
_LOOKED_BESIDE, _ALSO = 3, 0.05
# Rivals whose evidence is within so many nats are sampled.
_CLOSE = 5.0
_SEED = 20_080_402


@dataclass(frozen=True)
class Contest:
    """All rivals.

    Attributes
    ----------
    null : Rival
    alone : dict of Rival
        By id.
    pairs : dict of Rival
        By ids joined by '+'.
    unknown : dict of float
        Log Bayes factor of something unknown in each block, beside none.
    beside : dict of float
        Log Bayes factor of something unknown beside each of the likeliest rivals, by its ids.
    sampled : dict of Sampled
        Of rivals so near that their evidence was sampled.
    log_probability : dict of float
        Of `NONE`, `UNKNOWN`, ids, and ids of pairs joined by '+'.
    """

    null: Rival
    alone: dict[str, Rival]
    pairs: dict[str, Rival]
    unknown: dict[str, float]
    beside: dict[str, float]
    sampled: dict[str, Sampled]
    log_probability: dict[str, float]

    def rival(self, name: str) -> Rival | None:
        """Rival of a name; None of `NONE` and `UNKNOWN`."""
        return self.alone.get(name) or self.pairs.get(name)


def contest(
    comparison: Comparison,
    effects: Sequence[Effect],
    progress: Callable[[float], None] | None = None,
) -> Contest:
    """Let all effects compete."""
    report = progress or (lambda _share: None)
    rng = np.random.default_rng(_SEED)
    nothing = np.zeros(len(comparison.nuisances))
    null = compete(comparison, (), [nothing, 0.5 * rng.standard_normal(len(nothing))])
    alone: dict[str, Rival] = {}
    for number, effect in enumerate(effects):
        found = _alone(comparison, null, effect)
        if found is not None:
            alone[effect.id] = found
        report(0.6 * (number + 1) / len(effects))
    null = _polished(comparison, null, alone.values())
    pairs = _pairs(comparison, null, alone, effects)
    report(0.85)
    rivals = {**alone, **pairs}
    sampled = _settle(comparison, null, rivals, len(effects), rng)
    alone, pairs = ({n: r for n, r in rivals.items() if n in part} for part in (alone, pairs))
    report(0.95)
    likely = _ranked(alone, null, len(effects))[:_LOOKED_BESIDE]
    beside = {name: anything(comparison, rivals[name]) for name in likely}
    unknown = anything(comparison, null)
    probabilities = _probabilities(null, rivals, unknown, beside, len(effects))
    report(1.0)
    told = {name: float(f[0]) for name, f in discrepancies(comparison, null).items()}
    return Contest(null, alone, pairs, told, beside, sampled, probabilities)


def _polished(comparison: Comparison, null: Rival, rivals: Iterable[Rival]) -> Rival:
    """Fit the twin without effects again, from where its best rival's nuisances have come to."""
    best = max(rivals, key=lambda rival: rival.log_evidence, default=None)
    if best is None:
        return null
    p = len(comparison.nuisances)
    return compete(comparison, (), [null.estimate.z, best.estimate.z[:p]])


def _alone(comparison: Comparison, null: Rival, effect: Effect) -> Rival | None:
    """Fit one effect, at its best place; None if it moves nothing, or is of no possible reed."""
    places = list(places_of(effect))
    ranked = []
    for sized in places:
        found = screened(comparison, null, sized)
        if found is not None:
            ranked.append((*found, sized))
    if not ranked:
        return None
    gain, start, sized = max(ranked, key=lambda entry: entry[0])
    try:
        rival = compete(comparison, (sized,), [np.concatenate([null.estimate.z, start])])
    except ValueError:
        return None
    # Elsewhere it is worse by as much as its signature says; here the fit is exact.
    others = float(logsumexp([entry[0] - gain for entry in ranked]) - np.log(len(places)))
    return replace(rival, elsewhere=others)


def _pairs(
    comparison: Comparison, null: Rival, alone: Mapping[str, Rival], effects: Sequence[Effect]
) -> dict[str, Rival]:
    """Fit pairs: of the best effects, and of the best with what explains what it leaves."""
    ranked = sorted(alone.values(), key=lambda rival: -rival.log_evidence)
    best = [r for r in ranked if r.log_evidence > null.log_evidence + _LEAST_GAIN][:_MOST_PAIRED]
    chosen = {tuple(sorted((a.names[0], b.names[0]))): (a, b) for a, b in combinations(best, 2)}
    for first in best[:1]:
        for other in _beside(comparison, first, alone, effects):
            chosen.setdefault(tuple(sorted((first.names[0], other.names[0]))), (first, other))
    found = {}
    for one, other in chosen.values():
        rival = _pair(comparison, null, one, other)
        if rival is not None:
            found["+".join(rival.names)] = rival
    return found


def _beside(
    comparison: Comparison, first: Rival, alone: Mapping[str, Rival], effects: Sequence[Effect]
) -> list[Rival]:
    """Effects that explain most of what the first leaves."""
    gains = {}
    for effect in effects:
        other = alone.get(effect.id)
        if other is None or effect.id == first.names[0]:
            continue
        found = screened(comparison, first, other.effects[0])
        if found is not None and found[0] > _LEAST_GAIN:
            gains[effect.id] = found[0]
    ranked = sorted(gains, key=lambda name: -gains[name])
    return [alone[name] for name in ranked[:_MOST_BESIDE]]


def _pair(comparison: Comparison, null: Rival, one: Rival, other: Rival) -> Rival | None:
    p = len(comparison.nuisances)
    z = one.estimate.z[:p] + other.estimate.z[:p] - null.estimate.z
    starts = [np.concatenate([z, one.sizes, other.sizes])]
    try:
        return compete(comparison, (*one.effects, *other.effects), starts)
    except ValueError:
        return None


def _settle(
    comparison: Comparison,
    null: Rival,
    rivals: dict[str, Rival],
    effects: int,
    rng: np.random.Generator,
) -> dict[str, Sampled]:
    """Fit the best two again from elsewhere, and sample their evidence if they are close.

    Replaces them among the rivals.
    """
    best = _ranked(rivals, null, effects)[:2]
    for name in best:
        rivals[name] = _again(comparison, rivals[name], rng)
    odds = {NONE: float(np.log(PRIOR["none"]))}
    odds |= {name: _log_odds(rivals[name], null, effects) for name in best}
    first, second = sorted(odds, key=lambda name: -odds[name])[:2] if best else (NONE, NONE)
    found: dict[str, Sampled] = {}
    if odds[first] - odds[second] < _CLOSE:
        for name in {first, second} - {NONE}:
            rivals[name], found[name] = checked(comparison, rivals[name])
    return found


def _again(comparison: Comparison, rival: Rival, rng: np.random.Generator) -> Rival:
    """Fit a rival from its optimum, and from elsewhere: a certificate that it is the optimum."""
    z, p = rival.estimate.z, len(comparison.nuisances)
    elsewhere = z + 0.5 * rng.standard_normal(len(z))
    elsewhere[p:] = 0.6 * z[p:]
    again = compete(comparison, rival.effects, [z, elsewhere])
    return replace(again, elsewhere=rival.elsewhere)


def _log_odds(rival: Rival, null: Rival, effects: int) -> float:
    """Log probability of a rival, up to a constant that all share."""
    count = effects if len(rival.effects) == 1 else effects * (effects - 1) / 2
    prior = PRIOR["one" if len(rival.effects) == 1 else "two"] / count
    return float(np.log(prior) + rival.log_evidence - null.log_evidence)


def _ranked(rivals: Mapping[str, Rival], null: Rival, effects: int) -> list[str]:
    return sorted(rivals, key=lambda name: -_log_odds(rivals[name], null, effects))


def _probabilities(
    null: Rival,
    rivals: Mapping[str, Rival],
    unknown: float,
    beside: Mapping[str, float],
    effects: int,
) -> dict[str, float]:
    logs = {NONE: float(np.log(PRIOR["none"]))}
    for name, rival in rivals.items():
        logs[name] = _log_odds(rival, null, effects)
    also = [float(np.log(_ALSO)) + logs[name] + more for name, more in beside.items()]
    logs[UNKNOWN] = float(logsumexp([np.log(PRIOR["unknown"]) + unknown, *also]))
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}
