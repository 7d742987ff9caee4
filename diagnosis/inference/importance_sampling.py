"""Check Laplace's evidence by importance sampling."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.estimation import posterior_covariance
from diagnosis.inference.problem import InferenceProblem
from physics.errors import ImpossibleReedError

# Degrees of freedom of Student's distribution, and its width over the posterior's.
_FREEDOMS, _WIDER = 4, 1.5
_DRAWS = 96
# With fewer effective draws Laplace's evidence stays.
_LEAST_EFFECTIVE = 10.0


@dataclass(frozen=True)
class Sampled:
    """Evidence of a candidate by importance sampling over the sizes of its effects.

    Attributes
    ----------
    gain : float
        Log evidence minus Laplace's.
    effective : float
        Effective number of draws.
    """

    gain: float
    effective: float


def sampled(
    problem: InferenceProblem, candidate: Candidate, seed: int = 0, draws: int = _DRAWS
) -> Sampled:
    """Sample a candidate's evidence.

    Sizes are drawn; nuisances, in which the model is linear, are integrated for each draw.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
        With effects.
    seed, draws : int
    """
    p, sizes = len(problem.nuisances), candidate.sizes
    z, J = candidate.estimate.z[:p], candidate.estimate.jacobian[:, :p]
    uncertain = posterior_covariance(J)
    spread = _WIDER**2 * candidate.estimate.covariance[p:, p:]
    bound = np.array([s.positive for located in candidate.effects for s in located.sizes])
    wide = multivariate_t(np.maximum(sizes, 0) * bound + sizes * ~bound, spread, df=_FREEDOMS)
    drawn = np.atleast_2d(wide.rvs(draws, random_state=np.random.default_rng(seed)))
    drawn = drawn.reshape(draws, len(sizes))
    logs = np.full(draws, -np.inf)
    # Half a Gaussian is twice as dense.
    prior = np.log(2) * np.count_nonzero(bound) - 0.5 * len(sizes) * np.log(2 * np.pi)
    for k, size in enumerate(drawn):
        if np.any(bound & (size < 0)):
            continue
        try:
            r = (
                problem.residuals(candidate.changed(problem.parameters(z), size))
                / candidate.deviation
            )
        except ImpossibleReedError:
            continue
        g = J.T @ r + z
        cost = float(r @ r + z @ z - g @ uncertain @ g + size @ size)
        logs[k] = -0.5 * cost + prior - float(np.atleast_1d(wide.logpdf(size))[0])
    if not np.any(np.isfinite(logs)):
        return Sampled(0.0, 0.0)
    log_evidence = float(logsumexp(logs) - np.log(draws))
    log_evidence += 0.5 * float(np.linalg.slogdet(uncertain)[1])
    weights = np.exp(logs - logsumexp(logs))
    return Sampled(log_evidence - candidate.estimate.log_evidence, float(1 / np.sum(weights**2)))


def checked(problem: InferenceProblem, candidate: Candidate) -> tuple[Candidate, Sampled]:
    """Return a candidate with its sampled evidence, if enough draws are effective."""
    found = sampled(problem, candidate)
    if found.effective < _LEAST_EFFECTIVE:
        return candidate, found
    return replace(candidate, fit_log_evidence=candidate.fit_log_evidence + found.gain), found
