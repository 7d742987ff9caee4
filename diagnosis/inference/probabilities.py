"""Priors, and the probability of each hypothesis from the evidence of its fit."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import Candidate

NONE, UNKNOWN = "none", "unknown"
# A choice: it is an even bet whether anything is wrong; of what is wrong, a quarter is not in the
# catalogue; one bench in six of those has two things wrong.
_WRONG, _NOT_LISTED, _TWO = 1 / 2, 1 / 4, 1 / 6
# What follows from it: nothing, one effect, two, something unknown alone, and next to an effect.
# How the verdict depends on them is on the page (docs/explanation/diagnosis.md).
PRIOR: Final = {
    "none": 1 - _WRONG,
    "one": _WRONG * (1 - _TWO) * (1 - _NOT_LISTED),
    "two": _WRONG * _TWO * (1 - _NOT_LISTED) ** 2,
    "unknown": _WRONG * ((1 - _TWO) * _NOT_LISTED + _TWO * _NOT_LISTED**2),
    "also": _WRONG * _TWO * 2 * _NOT_LISTED * (1 - _NOT_LISTED),
}
# Factor by which a class is likelier or less likely beforehand for somebody else. Chosen.
_ANOTHER_VIEW = 3.0


def other_priors() -> Iterator[dict[str, float]]:
    """Yield priors in which one of the classes has three times the odds, or a third."""
    for name, own in PRIOR.items():
        for factor in (_ANOTHER_VIEW, 1 / _ANOTHER_VIEW):
            total = 1 + (factor - 1) * own
            changed = PRIOR | {name: factor * own}
            yield {each: share / total for each, share in changed.items()}


def log_odds(
    candidate: Candidate, null: Candidate, effects: int, prior: Mapping[str, float] = PRIOR
) -> float:
    """Return the log probability of a candidate, up to a common constant."""
    return _before(candidate, effects, prior) + candidate.log_evidence - null.log_evidence


def log_prior(count: int, effects: int, prior: Mapping[str, float] = PRIOR) -> float:
    """Return the log prior of one of `effects` effects, or of one pair of them."""
    if count == 1:
        return float(np.log(prior["one"] / effects))
    return float(np.log(prior["two"] / (effects * (effects - 1) / 2)))


def _before(candidate: Candidate, effects: int, prior: Mapping[str, float]) -> float:
    """Return the log prior of a candidate with effects."""
    before = log_prior(len(candidate.effects), effects, prior)
    if candidate.effects[-1].effect.after in candidate.names:
        # Of two causes that come one by one, two of a kind are half as likely as one of each of two
        # kinds.
        before -= float(np.log(2))
    return before


def log_odds_of_all(
    candidates: Mapping[str, Candidate], null: Candidate, effects: int
) -> dict[str, float]:
    """Return the log probability of candidates and of no effect, up to a common constant."""
    odds = {name: log_odds(candidate, null, effects) for name, candidate in candidates.items()}
    return {NONE: float(np.log(PRIOR["none"]))} | odds


@dataclass(frozen=True)
class Evidence:
    """What campaigns say of every hypothesis.

    Attributes
    ----------
    null : Candidate
        Without effects.
    candidates : mapping of Candidate
        With one effect or two, by name.
    unknown : float
        Log Bayes factor of something unknown.
    unknown_with : mapping of float
        The same in addition to candidates, by name.
    unseen : sequence of str
        Effects that change nothing.
    effects : int
        Number of effects that were tried.
    """

    null: Candidate
    candidates: Mapping[str, Candidate]
    unknown: float
    unknown_with: Mapping[str, float]
    unseen: Sequence[str]
    effects: int


def log_probabilities(
    evidence: Evidence, prior: Mapping[str, float] = PRIOR, *, only_what_shows: bool = False
) -> dict[str, float]:
    """Return the log probability of every hypothesis: none, unknown, effects and pairs.

    Parameters
    ----------
    evidence : Evidence
    prior : mapping of float
    only_what_shows : bool
        Whether what would not show counts as none: an effect that is too small, or that changes
        nothing here, counts as no effect, and next to another effect as the other one alone
        (decision 0054).
    """
    effects, null = evidence.effects, evidence.null
    unseen = unseen_share(evidence)
    terms: defaultdict[str, list[float]] = defaultdict(list)
    terms[NONE].append(float(np.log(prior["none"])))
    for name, candidate in evidence.candidates.items():
        terms[name].append(log_odds(candidate, null, effects, prior))
        left = "+".join(candidate.names[:-1]) or NONE
        hidden = _log_hidden(candidate, null, effects, prior)
        terms[left if only_what_shows else name].append(hidden)
    # What changes nothing has the evidence of none.
    for name in evidence.unseen:
        terms[NONE if only_what_shows else name].append(log_prior(1, effects, prior))
    unknown = float(np.log(prior["unknown"]))
    terms[UNKNOWN].append(unknown + float(np.log1p(-unseen)) + evidence.unknown)
    terms[NONE if only_what_shows else UNKNOWN].append(unknown + float(np.log(unseen)))
    for name, log in _beside_unknown(evidence, prior, only_what_shows=only_what_shows):
        terms[name].append(log)
    logs = {name: float(logsumexp(each)) for name, each in terms.items()}
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}


def _beside_unknown(
    evidence: Evidence, prior: Mapping[str, float], *, only_what_shows: bool
) -> Iterator[tuple[str, float]]:
    """Yield what one effect and something unknown together add to the odds of each hypothesis.

    Either of both, or both, may be too small to be seen: the evidence is then that without it. Both
    are looked for together next to the likeliest effects only.
    """
    unseen = unseen_share(evidence)
    shows, hides = float(np.log1p(-unseen)), float(np.log(unseen))
    also, null = float(np.log(prior["also"] / prior["one"])), evidence.null
    for log in log_odds_with_unknown(evidence, prior).values():
        yield UNKNOWN, log
    none = also + log_prior(1, evidence.effects, prior)
    alone = {n: one for n, one in evidence.candidates.items() if len(one.effects) == 1}
    hidden = dict.fromkeys(evidence.unseen, none)
    for name, one in alone.items():
        seen = also + log_odds(one, null, evidence.effects, prior)
        yield name if only_what_shows else UNKNOWN, seen + hides
        # What is unknown explains whatever strengths that do not show might explain.
        hidden[name] = none + min(0.0, one.log_hidden - null.log_evidence)
    for log in hidden.values():
        yield UNKNOWN, log + shows + evidence.unknown
        yield NONE if only_what_shows else UNKNOWN, log + hides


def unseen_share(evidence: Evidence) -> float:
    """Return the probability that something unknown is too small to be seen in these campaigns.

    It is taken to be that of an effect of the catalogue: what nobody has thought of is no better
    and no worse to see. One effect more that shows, and one that does not, keep it from 0 and 1
    (Laplace's rule of succession).
    """
    null = evidence.null.log_evidence
    alone = [one for one in evidence.candidates.values() if len(one.effects) == 1]
    hidden = [float(np.exp(min(0.0, one.log_hidden - null))) for one in alone]
    return (len(evidence.unseen) + sum(hidden) + 1) / (len(evidence.unseen) + len(alone) + 2)


def _log_hidden(
    candidate: Candidate, null: Candidate, effects: int, prior: Mapping[str, float]
) -> float:
    """Log odds of those strengths of a candidate's last effect that would not show."""
    return _before(candidate, effects, prior) + candidate.log_hidden - null.log_evidence


def log_odds_with_unknown(
    evidence: Evidence, prior: Mapping[str, float] = PRIOR
) -> dict[str, float]:
    """Return the log odds of something unknown that shows next to each of the likeliest effects."""
    also = float(np.log(prior["also"] / prior["one"])) + float(np.log1p(-unseen_share(evidence)))
    return {
        name: also
        + log_odds(evidence.candidates[name], evidence.null, evidence.effects, prior)
        + more
        for name, more in evidence.unknown_with.items()
    }
