"""Which effect, if any: every known effect by itself, likely pairs, and something unknown.

The probability of each is its evidence times a prior that is the same for all effects.
"""

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from diagnosis.discrepancy import anything, discrepancies
from diagnosis.estimate import SAME_COST, standing_out
from diagnosis.likeness import ALIKE, cosine
from diagnosis.rivals import (
    Comparison,
    Rival,
    Sized,
    compete,
    compete_straight,
    cost_straight,
    exactly,
    straightened,
)
from diagnosis.sampling import Sampled, checked
from diagnosis.screening import (
    Base,
    Screened,
    count_places,
    screened,
    screened_at,
    usual,
)
from fitting.parallel.processes import map_processes
from physics.effects.effect import Effect

Array = NDArray[np.floating[Any]]

NONE, UNKNOWN = "none", "unknown"
# Prior probabilities: nothing wrong, one effect, two, something that is not in the catalogue. Who
# asks what is wrong has a reason to.
PRIOR = {"none": 0.25, "one": 0.5, "two": 0.1, "unknown": 0.15}
# Something unknown may be too small to be seen, as many a known effect is.
_UNSEEN = 0.3
# An effect that gains so many nats where it gains most is tried at as many of its best places.
_MUCH, _MOST_PLACES = 20.0, 6
# Residuals of so many times their noise, squared, in the mean are far off; and nuisances of so many
# deviations.
_FAR_OFF, _FAR_BENT = 2.0, 4.0
# In deviations of their priors, sizes far out.
_FAR_SIZES = 2.0, 4.0, 6.0
# Of the best effects, all pairs; and the best with as many that explain most of what it leaves.
_MOST_PAIRED, _MOST_BESIDE, _LEAST_GAIN = 5, 4, 3.0
# Beside so many of the likeliest something unknown is looked for, of this prior.
_LOOKED_BESIDE, _ALSO = 3, 0.05
# What is left beside effects of plausible sizes, in deviations, may be their own, that have not
# quite the form that the catalogue gives them: of what they explain a share of this deviation.
_PLAUSIBLE, _OWN_FORM = 4.0, 0.15
# The twin without effects is fitted from so many rivals' nuisances.
_MOST_POLISHED = 4
# So many searches from elsewhere may end in a worse place, or nowhere.
_MOST_AGAIN = 4
# Rivals whose evidence is within so many nats are sampled.
_CLOSE = 5.0
# So many of the likeliest, unless they are that far behind in nats, are fitted with nothing taken
# for straight.
_MOST_REFINED, _FAR_BEHIND = 5, 8.0
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
    signatures : dict of ((n, s) float, (n, s) float)
        What effects move where that is usual for them, whitened, and what of it stands out.
    unknown : dict of float
        Log Bayes factor of something unknown in each block, beside none.
    anything : float
        The same in any of them, or in a few.
    beside : dict of float
        Log Bayes factor of something unknown beside each of the likeliest rivals, by its ids.
    sampled : dict of Sampled
        Of rivals so near that their evidence was sampled.
    unseen : dict of (str, float)
        What may be there and need not show, and was not fitted: effects that move nothing here, and
        pairs of the likeliest effect with any other. Of each what it is beside, and what its
        evidence is more by.
    log_probability : dict of float
        Of `NONE`, `UNKNOWN`, ids, and ids of pairs joined by '+'.
    """

    null: Rival
    alone: dict[str, Rival]
    pairs: dict[str, Rival]
    signatures: dict[str, tuple[Array, Array]]
    unknown: dict[str, float]
    anything: float
    beside: dict[str, float]
    sampled: dict[str, Sampled]
    unseen: dict[str, tuple[str, float]]
    log_probability: dict[str, float]

    @property
    def probability(self) -> dict[str, float]:
        """Of each name."""
        return {name: float(np.exp(log)) for name, log in self.log_probability.items()}

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
    null = compete(comparison, (), [nothing, 0.5 * rng.standard_normal(len(nothing))], exact=True)
    report(0.2)
    begun = _starts(comparison, null)
    for start in begun:
        straightened(comparison, start.at)
    alone: dict[str, Rival] = {}
    signatures: dict[str, tuple[Array, Array]] = {}
    each = map_processes(partial(_looked_for, comparison, begun), effects)
    for number, (effect, (table, found)) in enumerate(zip(effects, each, strict=True)):
        if table is not None:
            signatures[effect.id] = table, standing_out(begun[0].base.slopes, table)
        if found is not None:
            alone[effect.id] = found
        report(0.2 + 0.4 * (number + 1) / len(effects))
    _refine(comparison, alone, null, len(effects))
    null = polished(comparison, null, alone.values())
    report(0.7)
    alike = _alike(signatures)
    pairs = _pairs(comparison, null, alone, effects, alike)
    _refine(comparison, pairs, null, len(effects))
    report(0.85)
    rivals = {**alone, **pairs}
    sampled = _settle(comparison, null, rivals, len(effects), rng)
    alone, pairs = ({n: r for n, r in rivals.items() if n in part} for part in (alone, pairs))
    report(0.95)
    likely = _ranked(alone, null, len(effects))[:_LOOKED_BESIDE]
    beside = {name: anything(comparison, rivals[name]) for name in likely}
    unknown = anything(comparison, null)
    unseen = _unseen(comparison, null, alone, pairs, effects, alike)
    probabilities = _probabilities(null, rivals, unknown, beside, unseen, len(effects))
    report(1.0)
    told = {name: float(f[0]) for name, f in discrepancies(comparison, null).items()}
    return Contest(
        null, alone, pairs, signatures, told, unknown, beside, sampled, unseen, probabilities
    )


def confirmed(comparison: Comparison, found: Contest, name: str, effects: int) -> Contest:
    """A contest of so many effects, one rival of which has been fitted again, from two starts."""
    rival = found.rival(name)
    if rival is None or rival.estimate.starts > 1:
        return found
    again = _again(comparison, rival, np.random.default_rng(_SEED))
    alone, pairs, beside = dict(found.alone), dict(found.pairs), dict(found.beside)
    (alone if name in alone else pairs)[name] = again
    if name in beside:
        beside[name] = anything(comparison, again)
    rivals = {**alone, **pairs}
    odds = _probabilities(found.null, rivals, found.anything, beside, found.unseen, effects)
    return replace(found, alone=alone, pairs=pairs, beside=beside, log_probability=odds)


def unknown_beside(found: Contest, effects: int) -> str:
    """Beside which of so many effects, which pair or none something unknown is likeliest."""
    logs = _also({**found.alone, **found.pairs}, found.null, found.beside, effects)
    logs[NONE] = float(np.log(PRIOR["unknown"])) + found.anything
    return max(logs, key=lambda name: logs[name])


@dataclass(frozen=True)
class _Start:
    """Where effects are looked for: beside nuisances (p,), and whether far out as well."""

    at: Array
    base: Base
    far: bool = True


def _starts(comparison: Comparison, null: Rival) -> list[_Start]:
    """Nuisances to begin with.

    What fits are free to exchange may hide an effect: it is looked for without that as well. If the
    twin without effects is far off, so may be all that it has been bent to.
    """
    at = null.estimate.z
    found = [_Start(at, Base.at(comparison, at))]
    if comparison.exchanging.any():
        kept = np.where(comparison.exchanging, 0.0, at)
        found.append(_Start(kept, Base.at(comparison, kept), far=False))
    bent = np.abs(at).max(initial=0.0) > _FAR_BENT
    if bent or null.estimate.chi2 > _FAR_OFF * len(null.left):
        nothing = np.zeros(len(at))
        found.append(_Start(nothing, Base.at(comparison, nothing)))
    return found


def _refine(comparison: Comparison, rivals: dict[str, Rival], null: Rival, effects: int) -> None:
    """Fit the likeliest rivals anew, with nothing taken for straight."""
    ranked = _ranked(rivals, null, effects)[:_MOST_REFINED]
    if not ranked:
        return
    odds = {name: _log_odds(rivals[name], null, effects) for name in ranked}
    least = max(*odds.values(), float(np.log(PRIOR["none"]))) - _FAR_BEHIND
    near = [name for name in ranked if odds[name] > least]
    for name, found in zip(
        near, map_processes(lambda name: _anew(comparison, rivals[name]), near), strict=True
    ):
        rivals[name] = found


def _anew(comparison: Comparison, rival: Rival) -> Rival:
    """Fit a rival with nothing taken for straight, from where it is; itself if that cannot be."""
    with contextlib.suppress(ValueError):
        found = compete(comparison, rival.effects, [rival.estimate.z])
        return replace(found, elsewhere=rival.elsewhere)
    return rival


def polished(comparison: Comparison, null: Rival, rivals: Iterable[Rival]) -> Rival:
    """Fit the twin without effects again, from where its best rivals' nuisances have come to."""
    best = sorted(rivals, key=lambda rival: -rival.log_evidence)[:_MOST_POLISHED]
    starts = [rival.estimate.z[: len(comparison.nuisances)] for rival in best]
    each = map_processes(lambda start: _without(comparison, start), starts)
    ends = [end for end in each if end is not None]
    if not ends:
        return null
    again = min(ends, key=lambda end: end.estimate.cost)
    gain = null.estimate.cost - again.estimate.cost
    if gain > SAME_COST:
        # Searches that had agreed have agreed on something else.
        rng = np.random.default_rng(_SEED)
        near = again.estimate.z + 0.3 * rng.standard_normal(len(again.estimate.z))
        return compete(comparison, (), [again.estimate.z, near], exact=True)
    kept = again if gain > 0 else null
    least = kept.estimate.cost + SAME_COST
    agreeing = null.estimate.agreeing + sum(end.estimate.cost < least for end in ends)
    tried = null.estimate.starts + len(ends)
    return replace(kept, estimate=replace(kept.estimate, agreeing=agreeing, starts=tried))


def _without(comparison: Comparison, start: Array) -> Rival | None:
    """Fit the twin without effects from one start; None if that is of no possible bench."""
    with contextlib.suppress(ValueError):
        return compete(comparison, (), [start], exact=True)
    return None


def _looked_for(
    comparison: Comparison, begun: Sequence[_Start], effect: Effect
) -> tuple[Array | None, Rival | None]:
    """What an effect moves (n, s) where it is usual, and its fit; None if it moves nothing."""
    places = [screened(comparison, start.base, effect) for start in begun]
    table = usual(places[0]).table if places[0] else None
    return table, _alone(comparison, begun, places)


def _alone(
    comparison: Comparison,
    begun: Sequence[_Start],
    places: Sequence[Sequence[Screened]],
) -> Rival | None:
    """Fit one effect, at its best place; None if it moves nothing, or is of no possible reed.

    Parameters
    ----------
    comparison : Comparison
    begun : sequence of _Start
    places : sequence of sequence of Screened
        The effect beside each of these.
    """
    fitted = [
        _at_its_best(comparison, start, own) for start, own in zip(begun, places, strict=True)
    ]
    found = [rival for rival in fitted if rival is not None]
    if any(other.estimate.cost < found[0].estimate.cost for other in found[1:]):
        # What is straight far from an optimum may promise more than there is.
        found = [exact for rival in found if (exact := _exactly(comparison, rival)) is not None]
    return min(found, key=lambda rival: rival.estimate.cost, default=None)


def _exactly(comparison: Comparison, rival: Rival) -> Rival | None:
    try:
        return exactly(comparison, rival)
    except ValueError:
        return None


def _at_its_best(comparison: Comparison, start: _Start, places: Sequence[Screened]) -> Rival | None:
    """Fit one effect at its best place, from where it is begun."""
    if not places:
        return None
    ranked = sorted(places, key=lambda place: -place.gain)
    tried = [(ranked[0], ranked[0].sizes)]
    if ranked[0].gain > _MUCH:
        # What does much need not be where it would be if it did as much of what little of it does.
        for place in ranked[:_MOST_PLACES]:
            tried += [(place, place.sizes), (place, _first(place, np.sign(place.sizes[0])))]
    if start.far:
        tried += [(ranked[0], sizes) for sizes in _far_out(comparison, start.at, ranked[0])]
    found = [
        (rival, place)
        for place, sizes in tried
        if (rival := _straight(comparison, (place.sized,), start.at, sizes)) is not None
    ]
    if not found:
        return None
    rival, best = min(found, key=lambda pair: pair[0].estimate.cost)
    # Elsewhere it is worse by as much as its signature says; here the fit is exact.
    count = count_places(best.sized.effect)
    others = float(logsumexp([place.gain - ranked[0].gain for place in places]) - np.log(count))
    return replace(rival, elsewhere=others)


def _far_out(comparison: Comparison, about: Array, place: Screened) -> list[Array]:
    """Sizes (s,) far out that are better than none, though a little of the effect may not be."""
    signs = (1.0,) if place.sized.sizes[0].positive else (1.0, -1.0)
    sizes = [_first(place, sign * size) for sign in signs for size in _FAR_SIZES]
    effects = (place.sized,)
    nothing = cost_straight(comparison, (), about, np.zeros(0))
    costs = [cost_straight(comparison, effects, about, tried) for tried in sizes]
    best = int(np.argmin(costs))
    return [sizes[best]] if costs[best] < nothing else []


def _first(place: Screened, size: float) -> Array:
    """Sizes (s,) of which the first is given and the others are usual."""
    sizes: Array = np.zeros(len(place.sizes))
    sizes[0] = size
    return sizes


def _alike(signatures: Mapping[str, tuple[Array, Array]]) -> set[frozenset[str]]:
    """Pairs of effects so alike that both together are but one that need not have its form."""
    return {
        frozenset((one, other))
        for one, other in combinations(signatures, 2)
        if cosine(signatures[one][1], signatures[other][1]) >= ALIKE
    }


def _pairs(
    comparison: Comparison,
    null: Rival,
    alone: Mapping[str, Rival],
    effects: Sequence[Effect],
    alike: set[frozenset[str]],
) -> dict[str, Rival]:
    """Fit pairs: of the best effects, and of the best with what explains what it leaves.

    Not of effects that are alike.
    """
    ranked = sorted(alone.values(), key=lambda rival: -rival.log_evidence)
    best = [r for r in ranked if r.log_evidence > null.log_evidence + _LEAST_GAIN][:_MOST_PAIRED]
    chosen = {tuple(sorted((a.names[0], b.names[0]))): (a, b) for a, b in combinations(best, 2)}
    for first in best[:1]:
        for other in _beside(comparison, first, alone, effects):
            chosen.setdefault(tuple(sorted((first.names[0], other.names[0]))), (first, other))
    apart = [both for names, both in chosen.items() if frozenset(names) not in alike]
    for both in apart:
        straightened(comparison, _about(comparison, both))
    found = map_processes(lambda both: _pair(comparison, *both), apart)
    return {"+".join(rival.names): rival for rival in found if rival is not None}


def _unseen(
    comparison: Comparison,
    null: Rival,
    alone: Mapping[str, Rival],
    pairs: Mapping[str, Rival],
    effects: Sequence[Effect],
    alike: set[frozenset[str]],
) -> dict[str, tuple[str, float]]:
    """What may be there beside nothing, or beside the likeliest effect, and need not show."""
    found = {effect.id: (NONE, 0.0) for effect in effects if effect.id not in alone}
    best = max(alone.values(), key=lambda rival: rival.log_evidence, default=null)
    if best.log_evidence < null.log_evidence + _LEAST_GAIN:
        return found
    first, base = best.names[0], Base.of(comparison, best)
    for effect in effects:
        name = "+".join((first, effect.id))
        fitted = {name, "+".join((effect.id, first))} & set(pairs)
        if effect.id == first or fitted or frozenset((first, effect.id)) in alike:
            continue
        other = alone.get(effect.id)
        more = screened_at(comparison, base, other.effects[0]) if other else None
        # What would show is among the pairs that were fitted, or would do no better there.
        found[name] = first, min(more.gain, 0.0) if more else 0.0
    return found


def _beside(
    comparison: Comparison, first: Rival, alone: Mapping[str, Rival], effects: Sequence[Effect]
) -> list[Rival]:
    """Effects that explain most of what the first leaves."""
    gains, base = {}, Base.of(comparison, first)
    for effect in effects:
        other = alone.get(effect.id)
        if other is None or effect.id == first.names[0]:
            continue
        found = screened_at(comparison, base, other.effects[0])
        if found is not None and found.gain > _LEAST_GAIN:
            gains[effect.id] = found.gain
    ranked = sorted(gains, key=lambda name: -gains[name])
    return [alone[name] for name in ranked[:_MOST_BESIDE]]


def _about(comparison: Comparison, both: tuple[Rival, Rival]) -> Array:
    """Nuisances (p,) from where a pair is fitted: those of the better."""
    better = min(both, key=lambda rival: rival.estimate.cost)
    return better.estimate.z[: len(comparison.nuisances)]


def _pair(comparison: Comparison, one: Rival, other: Rival) -> Rival | None:
    first, second = sorted((one, other), key=lambda rival: rival.estimate.cost)
    about = _about(comparison, (first, second))
    sizes = np.concatenate([first.sizes, second.sizes])
    pair = _straight(comparison, (*first.effects, *second.effects), about, sizes)
    if pair is None:
        return None
    # Each is where it was found; elsewhere they are as much worse as by themselves.
    return replace(pair, elsewhere=one.elsewhere + other.elsewhere)


def _straight(
    comparison: Comparison, effects: Sequence[Sized], about: Array, sizes: Array
) -> Rival | None:
    """Rival with all that nuisances do taken for straight; None of no possible reed."""
    try:
        return compete_straight(comparison, effects, about, sizes)
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
    for name in best[:1]:
        rivals[name] = _again(comparison, rivals[name], rng)
    odds = {NONE: float(np.log(PRIOR["none"]))}
    odds |= {name: _log_odds(rivals[name], null, effects) for name in best}
    first, second = sorted(odds, key=lambda name: -odds[name])[:2] if best else (NONE, NONE)
    found: dict[str, Sampled] = {}
    if odds[first] - odds[second] < _CLOSE:
        close = [name for name in (first, second) if name != NONE]
        each = map_processes(lambda name: checked(comparison, rivals[name]), close)
        for name, (rival, sampled) in zip(close, each, strict=True):
            rivals[name], found[name] = rival, sampled
    return found


def _again(comparison: Comparison, rival: Rival, rng: np.random.Generator) -> Rival:
    """Fit a rival from its optimum, and from elsewhere: a certificate that it is the optimum.

    A search from elsewhere may end in a worse one, or not come to rest; the next may.
    """
    p, again = len(comparison.nuisances), rival
    for _ in range(_MOST_AGAIN):
        z = again.estimate.z
        elsewhere = z + 0.3 * rng.standard_normal(len(z))
        elsewhere[p:] = 0.8 * z[p:]
        try:
            again = compete(comparison, rival.effects, [z, elsewhere], exact=True)
        except ValueError:
            return replace(rival, estimate=replace(rival.estimate, agreeing=0, starts=2))
        if again.estimate.certified:
            break
    return replace(again, elsewhere=rival.elsewhere)


def _log_odds(rival: Rival, null: Rival, effects: int) -> float:
    """Log probability of a rival, up to a constant that all share."""
    return _log_prior(len(rival.effects), effects) + rival.log_evidence - null.log_evidence


def _log_prior(count: int, effects: int) -> float:
    """Log prior of one of so many effects, or of one pair of them."""
    if count == 1:
        return float(np.log(PRIOR["one"] / effects))
    return float(np.log(PRIOR["two"] / (effects * (effects - 1) / 2)))


def _ranked(rivals: Mapping[str, Rival], null: Rival, effects: int) -> list[str]:
    return sorted(rivals, key=lambda name: -_log_odds(rivals[name], null, effects))


def _probabilities(
    null: Rival,
    rivals: Mapping[str, Rival],
    unknown: float,
    beside: Mapping[str, float],
    unseen: Mapping[str, tuple[str, float]],
    effects: int,
) -> dict[str, float]:
    logs = {NONE: float(np.log(PRIOR["none"]))}
    for name, rival in rivals.items():
        logs[name] = _log_odds(rival, null, effects)
    also = _also(rivals, null, beside, effects).values()
    own = {name: _by_form(rivals[name], null, more) for name, more in beside.items()}
    for name, more in own.items():
        logs[name] += more
    for name, (first, more) in unseen.items():
        known = 0.0 if first == NONE else rivals[first].log_evidence - null.log_evidence
        known += own.get(first, 0.0)
        logs[name] = _log_prior(len(name.split("+")), effects) + known + more
    seen = np.logaddexp(np.log1p(-_UNSEEN) + unknown, np.log(_UNSEEN))
    logs[UNKNOWN] = float(logsumexp([np.log(PRIOR["unknown"]) + seen, *also]))
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}


def _also(
    rivals: Mapping[str, Rival], null: Rival, beside: Mapping[str, float], effects: int
) -> dict[str, float]:
    """Log probability of something unknown beside rivals, up to the constant of `_log_odds`."""
    return {
        name: float(np.log(_ALSO)) + _log_odds(rivals[name], null, effects) + more
        for name, more in beside.items()
    }


def _by_form(rival: Rival, null: Rival, left: float) -> float:
    """By how many nats a rival is likelier as what is left beside it may be of its own form.

    Parameters
    ----------
    rival, null : Rival
    left : float
        Log Bayes factor of anything else beside it.
    """
    gained = rival.log_evidence - null.log_evidence
    if left <= 0 or gained <= 0 or np.abs(rival.sizes).max() > _PLAUSIBLE:
        return 0.0
    # Evidence goes by squares: a share of what is explained by its square.
    log_share = -left / gained / (2 * _OWN_FORM**2)
    return float(np.logaddexp(np.log(-np.expm1(log_share)), log_share + left))
