"""Priors, and the probability of each hypothesis from the evidence of its fit."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import Candidate

# Prior of something unknown in addition to an effect, relative to the effect's.
_ALSO = 0.05
# Probability that something unknown is too small to be seen.
_UNSEEN = 0.3

NONE, UNKNOWN = "none", "unknown"
# Prior probabilities, a choice: it is an even bet whether anything is wrong; of what is wrong, a
# quarter is not in the catalogue; of what is in it, one bench in six has two effects at a time. How
# the verdict depends on them is on the page (docs/explanation/diagnosis.md).
PRIOR: Final = {"none": 0.5, "one": 0.3125, "two": 0.0625, "unknown": 0.125}
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
    before = log_prior(len(candidate.effects), effects, prior)
    return before + candidate.log_evidence - null.log_evidence


def log_prior(count: int, effects: int, prior: Mapping[str, float] = PRIOR) -> float:
    """Return the log prior of one of `effects` effects, or of one pair of them."""
    if count == 1:
        return float(np.log(prior["one"] / effects))
    return float(np.log(prior["two"] / (effects * (effects - 1) / 2)))


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
    terms[UNKNOWN].append(unknown + float(np.log1p(-_UNSEEN)) + evidence.unknown)
    terms[NONE if only_what_shows else UNKNOWN].append(unknown + float(np.log(_UNSEEN)))
    terms[UNKNOWN] += log_odds_with_unknown(evidence, prior).values()
    logs = {name: float(logsumexp(each)) for name, each in terms.items()}
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}


def _log_hidden(
    candidate: Candidate, null: Candidate, effects: int, prior: Mapping[str, float]
) -> float:
    """Log odds of those strengths of a candidate's last effect that would not show."""
    before = log_prior(len(candidate.effects), effects, prior)
    return before + candidate.log_hidden - null.log_evidence


def log_odds_with_unknown(
    evidence: Evidence, prior: Mapping[str, float] = PRIOR
) -> dict[str, float]:
    """Return the log odds of something unknown in addition to each of the likeliest candidates."""
    return {
        name: float(np.log(_ALSO))
        + log_odds(evidence.candidates[name], evidence.null, evidence.effects, prior)
        + more
        for name, more in evidence.unknown_with.items()
    }
