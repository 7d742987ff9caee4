"""Priors, and the probability of each hypothesis from the evidence of its fit."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import Candidate

# Prior of something unknown in addition to an effect, relative to the effect's.
_ALSO = 0.05
# Probability that something unknown is too small to be seen.
_UNSEEN = 0.3

NONE, UNKNOWN = "none", "unknown"
# Prior probabilities, a choice (docs/explanation/diagnosis.md): no effect, one effect, two effects,
# something that is not in the catalogue.
PRIOR = {"none": 0.25, "one": 0.5, "two": 0.1, "unknown": 0.15}


def log_odds(candidate: Candidate, null: Candidate, effects: int) -> float:
    """Return the log probability of a candidate, up to a common constant."""
    return log_prior(len(candidate.effects), effects) + candidate.log_evidence - null.log_evidence


def log_prior(count: int, effects: int) -> float:
    """Return the log prior of one of `effects` effects, or of one pair of them."""
    if count == 1:
        return float(np.log(PRIOR["one"] / effects))
    return float(np.log(PRIOR["two"] / (effects * (effects - 1) / 2)))


def log_odds_of_all(
    candidates: Mapping[str, Candidate], null: Candidate, effects: int
) -> dict[str, float]:
    """Return the log probability of candidates and of no effect, up to a common constant."""
    odds = {name: log_odds(candidate, null, effects) for name, candidate in candidates.items()}
    return {NONE: float(np.log(PRIOR["none"]))} | odds


def log_probabilities(
    null: Candidate,
    candidates: Mapping[str, Candidate],
    unknown: float,
    beside: Mapping[str, float],
    unseen: Sequence[str],
    effects: int,
) -> dict[str, float]:
    """Return the log probability of every hypothesis: none, unknown, effects and pairs."""
    logs = {NONE: float(np.log(PRIOR["none"]))}
    for name, candidate in candidates.items():
        logs[name] = log_odds(candidate, null, effects)
    also = log_odds_with_unknown(candidates, null, beside, effects).values()
    # What changes nothing has the evidence of none.
    logs |= {name: log_prior(1, effects) for name in unseen}
    seen = np.logaddexp(np.log1p(-_UNSEEN) + unknown, np.log(_UNSEEN))
    logs[UNKNOWN] = float(logsumexp([np.log(PRIOR["unknown"]) + seen, *also]))
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}


def log_odds_with_unknown(
    candidates: Mapping[str, Candidate], null: Candidate, beside: Mapping[str, float], effects: int
) -> dict[str, float]:
    """Return the log probability of something unknown in addition to each candidate."""
    return {
        name: float(np.log(_ALSO)) + log_odds(candidates[name], null, effects) + more
        for name, more in beside.items()
    }
