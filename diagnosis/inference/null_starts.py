"""Where the fit of the model without effects begins.

An acoustic resonance and sound that goes around the reed add with their phases. Two chambers may
therefore explain the same excitation peaks nearly as well, far apart, and a search from the
prior's centre ends in the nearer of them. Everything else is nearly linear there: chambers are
drawn from their prior, everything else is fitted to each of them in one step, and searches begin at
the best of these.

The clamp is the exception: where it yields more than usual, modes in which the reed moves sideways
fall below others and exchange shapes with them. One more search begins with a soft clamp.
"""

import contextlib

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from diagnosis.inference.estimation import posterior_covariance
from diagnosis.inference.problem import InferenceProblem
from holography.arrays import Array
from physics.errors import ImpossibleReedError

# Families of nuisances whose sounds add with their phases.
_INTERFERING = frozenset({"known resonance", "bypass"})
# Chambers that are tried, a power of two for Sobol's points. Chosen: of five nuisances, each is
# tried at three places, whatever the others are.
_TRIED = 256
# Searches that begin at the best of them. Chosen: two that agree confirm each other.
_STARTS = 2
# A soft clamp, in prior standard deviations. Chosen: beyond the crossing of the first two modes
# that a clamp makes cross (L1 and X1 of the paper's reed, at twice the usual compliance).
_CLAMP, _SOFT = "clamp", 2.0
# Chambers that differ by less, in prior standard deviations, are one start. Chosen.
_APART = 0.5


def starts_without_effects(problem: InferenceProblem) -> list[Array]:
    """Return starts (p,) of the nuisances.

    Those of the best chambers, the best of them with a soft clamp, then the prior's centre.

    Parameters
    ----------
    problem : InferenceProblem

    Raises
    ------
    ImpossibleReedError
        If the reed at the prior's centre is impossible.
    """
    centre = np.zeros(len(problem.nuisances))
    free = np.array([nuisance.family in _INTERFERING for nuisance in problem.nuisances])
    soft = np.array([_SOFT * (nuisance.name == _CLAMP) for nuisance in problem.nuisances])
    if not free.any():
        return [centre, soft] if soft.any() else [centre]
    best: list[Array] = []
    for _, z in sorted(_drawn(problem, free), key=lambda drawn: drawn[0]):
        if all(np.abs(z - other)[free].max() > _APART for other in best):
            best.append(z)
        if len(best) == _STARTS:
            break
    if best and soft.any():
        best.append(np.where(free, best[0], soft))
    return [*best, centre]


def _drawn(problem: InferenceProblem, free: NDArray[np.bool_]) -> list[tuple[float, Array]]:
    """Return costs and nuisances (p,) of possible chambers; everything else is fitted linearly."""
    centre = np.zeros(len(free))
    near = problem.parameters(centre)
    slopes = problem.jacobian(centre)[:, ~free]
    covariance = posterior_covariance(slopes)
    # The first half of the points has one at minus infinity.
    points = qmc.Sobol(int(free.sum()), scramble=False).random(2 * _TRIED)[_TRIED:]
    found: list[tuple[float, Array]] = []
    for chamber in ndtri(points):
        z = centre.copy()
        z[free] = chamber
        with contextlib.suppress(ImpossibleReedError):
            left = problem.residuals(problem.parameters(z), near)
            z[~free] = -covariance @ (slopes.T @ left)
            left = left + slopes @ z[~free]
            found.append((float(left @ left + z @ z), z))
    return found
