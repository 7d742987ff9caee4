"""Priors, and the probability of each hypothesis from the evidence of its fit."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from diagnosis.inference.candidates import (
    Candidate,
)

Array = NDArray[np.floating[Any]]
# What is left beside effects of plausible sizes, in deviations, may be their own, that have not
# quite the form that the catalogue gives them: of what they explain a share of this deviation.
_PLAUSIBLE, _OWN_FORM = 4.0, 0.15
_ALSO = 0.05
# Something unknown may be too small to be seen, as many a known effect is.
_UNSEEN = 0.3

NONE, UNKNOWN = "none", "unknown"
# Prior probabilities: nothing wrong, one effect, two, something that is not in the catalogue. Who
# asks what is wrong has a reason to.
PRIOR = {"none": 0.25, "one": 0.5, "two": 0.1, "unknown": 0.15}


def log_odds(candidate: Candidate, null: Candidate, effects: int) -> float:
    """Log probability of a candidate, up to a constant that all share."""
    return log_prior(len(candidate.effects), effects) + candidate.log_evidence - null.log_evidence


def log_prior(count: int, effects: int) -> float:
    """Log prior of one of so many effects, or of one pair of them."""
    if count == 1:
        return float(np.log(PRIOR["one"] / effects))
    return float(np.log(PRIOR["two"] / (effects * (effects - 1) / 2)))


def rank_candidates(
    candidates: Mapping[str, Candidate], null: Candidate, effects: int
) -> list[str]:
    """Return the names of candidates, the likeliest first."""
    return sorted(candidates, key=lambda name: -log_odds(candidates[name], null, effects))


def log_probabilities(
    null: Candidate,
    candidates: Mapping[str, Candidate],
    unknown: float,
    beside: Mapping[str, float],
    unseen: Mapping[str, tuple[str, float]],
    effects: int,
) -> dict[str, float]:
    """Return the log probability of every hypothesis: none, unknown, effects and pairs."""
    logs = {NONE: float(np.log(PRIOR["none"]))}
    for name, candidate in candidates.items():
        logs[name] = log_odds(candidate, null, effects)
    also = log_odds_with_unknown(candidates, null, beside, effects).values()
    own = {name: _by_form(candidates[name], null, more) for name, more in beside.items()}
    for name, more in own.items():
        logs[name] += more
    for name, (first, more) in unseen.items():
        known = 0.0 if first == NONE else candidates[first].log_evidence - null.log_evidence
        known += own.get(first, 0.0)
        logs[name] = log_prior(len(name.split("+")), effects) + known + more
    seen = np.logaddexp(np.log1p(-_UNSEEN) + unknown, np.log(_UNSEEN))
    logs[UNKNOWN] = float(logsumexp([np.log(PRIOR["unknown"]) + seen, *also]))
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}


def log_odds_with_unknown(
    candidates: Mapping[str, Candidate], null: Candidate, beside: Mapping[str, float], effects: int
) -> dict[str, float]:
    """Log probability of something unknown beside candidates, up to the constant of `log_odds`."""
    return {
        name: float(np.log(_ALSO)) + log_odds(candidates[name], null, effects) + more
        for name, more in beside.items()
    }


def _by_form(candidate: Candidate, null: Candidate, left: float) -> float:
    """By how many nats a candidate is likelier as what is left beside it may be of its own form.

    Parameters
    ----------
    candidate, null : Candidate
    left : float
        Log Bayes factor of anything else beside it.
    """
    gained = candidate.log_evidence - null.log_evidence
    if left <= 0 or gained <= 0 or np.abs(candidate.sizes).max() > _PLAUSIBLE:
        return 0.0
    # Evidence goes by squares: a share of what is explained by its square.
    log_share = -left / gained / (2 * _OWN_FORM**2)
    return float(np.logaddexp(np.log(-np.expm1(log_share)), log_share + left))
