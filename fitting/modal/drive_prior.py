"""Prior of the drive's magnitude: a loudspeaker in a chamber, and the scatter of single holograms.

The log magnitude per volt is a smooth function of log frequency plus the scatter of the light from
one hologram to the next. The smooth function is a Gaussian process: level and slope of any size,
and ripple as loudspeakers and chambers have. The scatter has a Student distribution, which admits a
few holograms that are far off. Without the bounds of the process a drive could follow the resonance
of a mode that dominates its neighbourhood, and the mode could be put elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from holography.arrays import Array

# Level: any sensitivity. Slope per unit of log frequency: 24 dB per octave, a filter of fourth
# order, is 4 nepers.
_LEVEL, _SLOPE = 10.0, 4.0
# Ripple in nepers, and the log frequency over which it is correlated. Data sheets of dome tweeters
# show 3 dB over a third of an octave, and 1 dB of finer structure: a quiet drive. A lively one is
# for chambers with strong resonances and notches; its 2 dB of finer structure are chosen (decision
# 0025). The evidence of a sweep decides between the two.
QUIET = ((0.35, 0.2), (0.1, 0.06))
LIVELY = ((0.35, 0.2), (0.25, 0.06))
# Iterations of the reweighting by which a Student distribution is fitted.
_TURNS = 8
# Scatter of single holograms around the smooth drive, in nepers: start and lower limit. Lasers and
# modulators are not steadier than 0.3 %.
FIRST_GAIN, LEAST_GAIN = 0.1, 3e-3
# Ratio of a normal distribution's standard deviation to its median absolute deviation.
_NORMAL_PER_MAD = 1.4826


def drive_covariance(hz: Array, ripples: Sequence[tuple[float, float]]) -> Array:
    """Return the prior covariance (k, k) of the smooth log magnitude at frequencies (k,).

    `ripples` are standard deviations in nepers, and log frequencies of correlation.
    """
    log_hz = np.log(hz)
    centred = log_hz - log_hz.mean()
    covariance = _LEVEL**2 + _SLOPE**2 * np.multiply.outer(centred, centred)
    for size, length in ripples:
        apart = np.sqrt(5) * np.abs(np.subtract.outer(log_hz, log_hz)) / length
        # Matérn covariance of order 5/2: two derivatives exist.
        covariance += size**2 * (1 + apart + apart**2 / 3) * np.exp(-apart)
    return np.asarray(covariance)


@dataclass(frozen=True)
class DrivePrior:
    """Prior of the drive's log magnitude at a state.

    Attributes
    ----------
    cost : float
        Twice the negative log density.
    gradient : (k,) float
        Negative gradient of half the cost.
    curvature : (k, k) float
        Half the Hessian of the cost, for the weights that the scatter has at this state.
    scatter_volume : float
        Log of the variances of the scatter over the square of its scale, summed over holograms.
    """

    cost: float
    gradient: Array
    curvature: Array
    scatter_volume: float

    @property
    def log_volume(self) -> float:
        """Twice the log of the density's factors and of the volume of the scatter.

        With the cost, it gives the log density of a magnitude whose scatter is unknown, by
        Laplace's method and up to a constant.
        """
        return float(np.linalg.slogdet(self.curvature)[1]) + self.scatter_volume


def drive_prior(magnitude: Array, covariance: Array, gain: float, dof: float) -> DrivePrior:
    """Split a log magnitude into a smooth part and scatter, and return what that costs.

    Parameters
    ----------
    magnitude : (k,) float
        Log magnitude less that of the volts.
    covariance : (k, k) float
        See `drive_covariance`.
    gain : float
        Scale of the scatter, in nepers.
    dof : float
        Degrees of freedom of its Student distribution.
    """
    variance = np.full(len(magnitude), gain**2)
    for _ in range(_TURNS):
        factor = linalg.cho_factor(covariance + np.diag(variance), lower=True, check_finite=False)
        weighted = linalg.cho_solve(factor, magnitude, check_finite=False)
        scatter = variance * weighted
        variance = (dof * gain**2 + scatter**2) / (dof + 1)
    smooth = magnitude - scatter
    cost = (dof + 1) * np.sum(np.log1p((scatter / gain) ** 2 / dof)) + smooth @ weighted
    gradient = -(dof + 1) * scatter / (dof * gain**2 + scatter**2)
    curvature = linalg.inv(covariance + np.diag(variance))
    volume = float(np.sum(np.log(variance / gain**2)))
    return DrivePrior(float(cost), gradient, 0.5 * (curvature + curvature.T), volume)


def found_gain(magnitude: Array, covariance: Array, gain: float, dof: float) -> float:
    """Find the scale of the scatter of single holograms, in nepers.

    It is the one for which each magnitude lies as far from what all others predict as it should:
    the smooth function alone could follow most of the scatter. Parameters are as in `drive_prior`;
    `gain` is the start.
    """
    for _ in range(_TURNS):
        prior = drive_prior(magnitude, covariance, gain, dof)
        weighted = prior.curvature @ magnitude
        standard = np.abs(weighted) / np.sqrt(np.diag(prior.curvature))
        gain *= _NORMAL_PER_MAD * float(np.median(standard))
        if gain < LEAST_GAIN:
            return LEAST_GAIN
    return gain
