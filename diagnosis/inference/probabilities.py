"""Priors, and the probability of each hypothesis from the evidence of its fit."""

from collections.abc import Mapping

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import (
    Candidate,
)

# Residuals of an effect of plausible size (in prior standard deviations) may be due to its form,
# which deviates from the catalogue's by this fraction (standard deviation).
_PLAUSIBLE, _OWN_FORM = 4.0, 0.15
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
    """Return the log probability of something unknown in addition to each candidate."""
    return {
        name: float(np.log(_ALSO)) + log_odds(candidates[name], null, effects) + more
        for name, more in beside.items()
    }


def _by_form(candidate: Candidate, null: Candidate, left: float) -> float:
    """Return the gain of a candidate, in nats, because its residuals may be due to its form.

    Parameters
    ----------
    candidate, null : Candidate
    left : float
        Log Bayes factor of something unknown in addition to it.
    """
    gained = candidate.log_evidence - null.log_evidence
    if left <= 0 or gained <= 0 or np.abs(candidate.sizes).max() > _PLAUSIBLE:
        return 0.0
    # Evidence goes by squares: a share of what is explained by its square.
    log_share = -left / gained / (2 * _OWN_FORM**2)
    return float(np.logaddexp(np.log(-np.expm1(log_share)), log_share + left))
