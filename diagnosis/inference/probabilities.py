"""Priors, and the probability of each hypothesis from the evidence of its fit."""

from collections.abc import Iterator, Mapping, Sequence
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


def log_probabilities(
    null: Candidate,
    candidates: Mapping[str, Candidate],
    unknown: float,
    beside: Mapping[str, float],
    unseen: Sequence[str],
    effects: int,
    prior: Mapping[str, float] = PRIOR,
) -> dict[str, float]:
    """Return the log probability of every hypothesis: none, unknown, effects and pairs."""
    logs = {NONE: float(np.log(prior["none"]))}
    for name, candidate in candidates.items():
        hidden = _log_hidden(candidate, null, effects, prior)
        logs[name] = float(np.logaddexp(log_odds(candidate, null, effects, prior), hidden))
    also = log_odds_with_unknown(candidates, null, beside, effects, prior).values()
    # What changes nothing has the evidence of none.
    logs |= {name: log_prior(1, effects, prior) for name in unseen}
    seen = np.logaddexp(np.log1p(-_UNSEEN) + unknown, np.log(_UNSEEN))
    logs[UNKNOWN] = float(logsumexp([np.log(prior["unknown"]) + seen, *also]))
    return _normalised(logs)


def log_probabilities_of_what_shows(
    null: Candidate,
    candidates: Mapping[str, Candidate],
    unknown: float,
    beside: Mapping[str, float],
    unseen: Sequence[str],
    effects: int,
    prior: Mapping[str, float] = PRIOR,
) -> dict[str, float]:
    """Return the same, where what would not show counts as none.

    An effect that is too small, or that changes nothing here, counts as no effect, and next to
    another effect as this one alone (decision 0054).
    """
    terms: dict[str, list[float]] = {NONE: [float(np.log(prior["none"]))]}
    for name, candidate in candidates.items():
        terms.setdefault(name, []).append(log_odds(candidate, null, effects, prior))
        left = "+".join(candidate.names[:-1]) or NONE
        terms.setdefault(left, []).append(_log_hidden(candidate, null, effects, prior))
    also = log_odds_with_unknown(candidates, null, beside, effects, prior).values()
    terms[NONE] += [log_prior(1, effects, prior)] * len(unseen)
    terms[NONE].append(float(np.log(prior["unknown"] * _UNSEEN)))
    shown = np.log(prior["unknown"] * (1 - _UNSEEN)) + unknown
    terms[UNKNOWN] = [float(shown), *also]
    return _normalised({name: float(logsumexp(each)) for name, each in terms.items()})


def _log_hidden(
    candidate: Candidate, null: Candidate, effects: int, prior: Mapping[str, float]
) -> float:
    """Log odds of those strengths of a candidate's last effect that would not show."""
    before = log_prior(len(candidate.effects), effects, prior)
    return before + candidate.log_hidden - null.log_evidence


def _normalised(logs: Mapping[str, float]) -> dict[str, float]:
    total = logsumexp(list(logs.values()))
    return {name: float(log - total) for name, log in logs.items()}


def log_odds_with_unknown(
    candidates: Mapping[str, Candidate],
    null: Candidate,
    beside: Mapping[str, float],
    effects: int,
    prior: Mapping[str, float] = PRIOR,
) -> dict[str, float]:
    """Return the log probability of something unknown in addition to each candidate."""
    return {
        name: float(np.log(_ALSO)) + log_odds(candidates[name], null, effects, prior) + more
        for name, more in beside.items()
    }
