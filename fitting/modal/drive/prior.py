"""Prior of the drive's magnitude: a loudspeaker in a chamber, and the scatter of single holograms.

The log magnitude per volt is a smooth function of log frequency plus the scatter of the light from
one hologram to the next. The smooth function is a Gaussian process: level and slope of any size,
and ripple as loudspeakers and chambers have. How much of the finer ripple there is differs along
the sweep, near poles and notches of the chamber, and is found from the sweep. The scatter has a
Student distribution, which admits a few holograms that are far off. Without the bounds of the
process a drive could follow the resonance of a mode that dominates its neighbourhood, and the mode
could be put elsewhere.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from holography.arrays import Array

# Level: any sensitivity; if what all holograms share belongs to participations, it is held. Slope
# per unit of log frequency: 24 dB per octave, a filter of fourth order, is 4 nepers.
ANY_LEVEL, HELD_LEVEL, _SLOPE = 10.0, 0.01, 4.0
# Ripple in nepers, and the log frequency over which it is correlated: data sheets of dome tweeters
# show 3 dB over a third of an octave, and 1 dB of finer structure.
_COARSE, _FINE = (0.35, 0.2), (0.1, 0.06)
# A chamber with poles and notches has more of the finer structure near them. How much is found at
# nodes that are this far apart in log frequency: twice the length over which it is correlated.
_NODE = 0.12
# Limits of its size: 0.1 dB, and one of which two standard deviations are 15 dB: a higher line of
# the drive is suspect next to a mode.
_FINE_LIMITS = (0.012, 0.86)
# Ripple of a start that can follow poles and notches anywhere: 6 dB.
_STRONG = 0.7
# The search for log sizes ends with a step of this length: the next one would be its square. No
# step is longer than a factor of e, and no search has more steps. This share of a cost is rounding:
# matrices of a condition of 1e9, in double precision, with a margin.
_SETTLED, _LONGEST_STEP, _MOST_STEPS, _ROUNDING = 1e-5, 1.0, 50, 1e-11
# How often sizes and outliers are found in turn.
_RIPPLE_TURNS = 4
# A split of a magnitude ends when its forces, in units of 1/gain, differ by no more than this, or
# when no step of at least this length makes it better: the rest is rounding.
_BALANCED, _SHORTEST = 1e-7, 1e-4
# Turns in which the scale of the scatter is found.
_TURNS = 8
# Scatter of single holograms around the smooth drive, in nepers: start and lower limit. Lasers and
# modulators are not steadier than 0.3 %.
FIRST_GAIN, LEAST_GAIN = 0.1, 3e-3
# Ratio of a normal distribution's standard deviation to its median absolute deviation.
_NORMAL_PER_MAD = 1.4826


def _matern(log_hz: Array, length: float) -> Array:
    """Return the Matérn correlation of order 5/2, which has two derivatives."""
    apart = np.sqrt(5) * np.abs(np.subtract.outer(log_hz, log_hz)) / length
    return np.asarray((1 + apart + apart**2 / 3) * np.exp(-apart))


@dataclass(frozen=True)
class Ripple:
    """Prior of the smooth log magnitude, with finer structure that differs along the sweep.

    Attributes
    ----------
    coarse : (k, k) float
        Covariance of level, slope and coarse structure.
    fine : (k, k) float
        Correlation of the finer structure.
    weights : (k, n) float
        Weights of the nodes in every hologram.
    log_size : (n,) float
        Log of the finer structure's standard deviation, in nepers, at the nodes.
    """

    coarse: Array
    fine: Array
    weights: Array
    log_size: Array

    @property
    def finer(self) -> Array:
        """Covariance (k, k) of the finer structure."""
        size = np.exp(self.weights @ self.log_size)
        return np.asarray(size[:, None] * self.fine * size)

    @property
    def covariance(self) -> Array:
        """Covariance (k, k) of the smooth log magnitude."""
        return np.asarray(self.coarse + self.finer)


def quiet_ripple(hz: Array, level: float = ANY_LEVEL) -> Ripple:
    """Return the ripple of data sheets at drive frequencies (k,); the level is in nepers."""
    log_hz = np.log(hz)
    centred = log_hz - log_hz.mean()
    coarse = level**2 + _SLOPE**2 * np.multiply.outer(centred, centred)
    coarse += _COARSE[0] ** 2 * _matern(log_hz, _COARSE[1])
    intervals = max(int(np.ptp(log_hz) / _NODE), 1)
    at = (log_hz - log_hz.min()) / max(np.ptp(log_hz), 1e-9) * intervals
    weights = np.maximum(0, 1 - np.abs(at[:, None] - np.arange(intervals + 1)))
    log_size = np.full(intervals + 1, np.log(_FINE[0]))
    return Ripple(coarse, _matern(log_hz, _FINE[1]), weights, log_size)


@dataclass(frozen=True)
class DriveForm:
    """How the drive of a sweep depends on frequency, as a fit explains it.

    Attributes
    ----------
    log_magnitude : (k,) float
        What is expected by volts and lines, up to a constant.
    ripple : Ripple
        Prior of what is left of the smooth log magnitude.
    log_probability : float
        Of this explanation, among all of the sweep.
    """

    log_magnitude: Array
    ripple: Ripple
    log_probability: float

    def at(self, steps: NDArray[np.intp], louder: Array) -> "DriveForm":
        """Return the form at some of its steps (n,), at `louder` (n,) times the volts."""
        square, ripple = np.ix_(steps, steps), self.ripple
        return DriveForm(
            self.log_magnitude[steps] + np.log(louder),
            Ripple(
                ripple.coarse[square],
                ripple.fine[square],
                ripple.weights[steps],
                ripple.log_size,
            ),
            self.log_probability,
        )


def smooth_ripple(ripple: Ripple) -> Ripple:
    """Return a ripple that can follow no pole and no notch: its finer structure is the least."""
    return replace(ripple, log_size=np.full_like(ripple.log_size, np.log(_FINE_LIMITS[0])))


def strong_ripple(ripple: Ripple) -> Ripple:
    """Return a ripple that can follow poles and notches everywhere."""
    return replace(ripple, log_size=np.full_like(ripple.log_size, np.log(_STRONG)))


@dataclass(frozen=True)
class DrivePrior:
    """Prior of the drive's log magnitude at a state.

    Attributes
    ----------
    cost : float
        Twice the negative log density.
    gradient : (k,) float
        Negative gradient of half the cost.
    scatter : (k,) float
        Of single holograms around the smooth log magnitude.
    covariance : (k, k) float
        Of the log magnitude, for the variances that the scatter has at this state.
    scatter_volume : float
        Log of the variances of the scatter over the square of its scale, summed over holograms.
    """

    cost: float
    gradient: Array
    scatter: Array
    covariance: Array
    scatter_volume: float

    @cached_property
    def curvature(self) -> Array:
        """Half the Hessian (k, k) of the cost."""
        curvature = linalg.inv(self.covariance)
        return np.asarray(0.5 * (curvature + curvature.T))

    @property
    def log_volume(self) -> float:
        """Twice the log of the density's factors and of the volume of the scatter.

        With the cost, it gives the log density of a magnitude whose scatter is unknown, by
        Laplace's method and up to a constant.
        """
        return float(np.linalg.slogdet(self.curvature)[1]) + self.scatter_volume


def drive_prior(
    magnitude: Array, covariance: Array, near: Array, gain: float, dof: float
) -> DrivePrior:
    """Split a log magnitude into a smooth part and scatter, and return what that costs.

    Parameters
    ----------
    magnitude : (k,) float
        Log magnitude less that of the volts.
    covariance : (k, k) float
        Of the smooth part, see `Ripple`.
    near : (k,) float
        Scatter from which the search begins: it may cost least at several.
    gain : float
        Scale of the scatter, in nepers.
    dof : float
        Degrees of freedom of its Student distribution.
    """
    splitting = _Splitting(magnitude, covariance, gain, dof)
    split = splitting.balanced(near)
    variance = splitting.variance(split.scatter)
    volume = float(np.sum(np.log(variance / gain**2)))
    return DrivePrior(
        split.cost, -split.weighted, split.scatter, covariance + np.diag(variance), volume
    )


@dataclass(frozen=True)
class _Split:
    """A magnitude (k,), split into a smooth part and scatter.

    Attributes
    ----------
    weighted : (k,) float
        Smooth part, multiplied by the inverse of its covariance.
    scatter : (k,) float
    cost : float
        Twice the negative log density.
    """

    weighted: Array
    scatter: Array
    cost: float


@dataclass(frozen=True)
class _Splitting:
    """What a magnitude is split by.

    With the covariance C and the weighted smooth part w, the scatter is s = m − C w and costs
    (ν + 1) Σ log(1 + s²/νg²) + wᵀ C w.
    """

    magnitude: Array
    covariance: Array
    gain: float
    dof: float

    def variance(self, scatter: Array) -> Array:
        """Return the variance (k,) that a scatter with a Student distribution has here."""
        return (self.dof * self.gain**2 + scatter**2) / (self.dof + 1)

    def at(self, weighted: Array) -> _Split:
        """Return the split for a weighted smooth part."""
        smooth = self.covariance @ weighted
        scatter = self.magnitude - smooth
        peaks = np.sum(np.log1p((scatter / self.gain) ** 2 / self.dof))
        return _Split(weighted, scatter, float((self.dof + 1) * peaks + smooth @ weighted))

    def balanced(self, scatter: Array) -> _Split:
        """Find the split that costs least near a scatter, by Newton's method."""
        start = self.covariance + np.diag(self.variance(scatter))
        at = self.at(linalg.solve(start, self.magnitude, assume_a="pos", check_finite=False))
        for _ in range(_MOST_STEPS):
            variance = self.variance(at.scatter)
            off = at.weighted - at.scatter / variance
            if np.max(np.abs(off)) * self.gain < _BALANCED:
                break
            better = self._better(at, off, variance)
            if better is None:
                break
            at = better
        return at

    def _better(self, at: _Split, off: Array, variance: Array) -> _Split | None:
        """Take a step; None if the rest is rounding."""
        bend = (2 * self.dof * self.gain**2 / ((self.dof + 1) * variance) - 1) / variance
        tried = self.at(at.weighted - self.step(bend, off))
        if tried.cost < at.cost:
            return tried
        # Where the cost of a scatter bends downwards, its bend is left out: this leads down.
        step, length = self.step(np.maximum(bend, 0), off), 1.0
        while length > _SHORTEST:
            tried = self.at(at.weighted - length * step)
            if tried.cost < at.cost:
                return tried
            length /= 2
        return None

    def step(self, bend: Array, off: Array) -> Array:
        """Return the Newton step (k,) of a weighted smooth part for bends and gradients (k,)."""
        unlike = np.eye(len(off)) + bend[:, None] * self.covariance
        # Where the cost bends downwards this may be next to singular: nothing to warn of, because
        # such a step costs more and is not taken.
        step: Array = np.linalg.solve(unlike, off)
        return step


def found_gain(magnitude: Array, covariance: Array, near: Array, gain: float, dof: float) -> float:
    """Find the scale of the scatter of single holograms, in nepers.

    It is the one for which each magnitude lies as far from what all others predict as it should:
    the smooth function alone could follow most of the scatter. Parameters are as in `drive_prior`;
    `gain` is the start.
    """
    for _ in range(_TURNS):
        prior = drive_prior(magnitude, covariance, near, gain, dof)
        weighted = prior.curvature @ magnitude
        standard = np.abs(weighted) / np.sqrt(np.diag(prior.curvature))
        gain *= _NORMAL_PER_MAD * float(np.median(standard))
        if gain < LEAST_GAIN:
            return LEAST_GAIN
        near = prior.scatter
    return gain


@dataclass(frozen=True)
class FoundRipple:
    """Ripple that a sweep shows.

    Attributes
    ----------
    ripple : Ripple
    covariance : (n, n) float
        Covariance of its log sizes.
    """

    ripple: Ripple
    covariance: Array

    @property
    def log_weight(self) -> float:
        """Log of the prior density of its sizes times their volume, up to a constant."""
        log_prior = -np.sum(np.log(np.cosh(self.ripple.log_size - np.log(_FINE[0]))))
        return float(log_prior + 0.5 * np.linalg.slogdet(self.covariance)[1])


@dataclass(frozen=True)
class KnownMagnitude:
    """What the holograms alone say of the log magnitude less that of the volts.

    Attributes
    ----------
    precision : (k, k) float
        Inverse covariance of a normal distribution; it may be singular.
    pull : (k,) float
        Precision times mean.
    """

    precision: Array
    pull: Array

    @classmethod
    def of(cls, magnitude: Array, covariance: Array, prior: DrivePrior) -> "KnownMagnitude":
        """Take the prior out of the result of a fit: magnitude (k,) and covariance (k, k)."""
        whole = linalg.inv(covariance)
        return cls(whole - prior.curvature, whole @ magnitude)


def found_ripple(start: Ripple, known: KnownMagnitude, gain: float, dof: float) -> FoundRipple:
    """Find the size of the finer structure at every node by its evidence.

    The sizes have a half-Cauchy prior around those of data sheets, which admits poles and notches
    (A. Gelman 2006, Bayesian Analysis 1:515).

    Parameters
    ----------
    start : Ripple
    known : KnownMagnitude
    gain, dof : float
        See `drive_prior`.
    """
    scatter: Array = np.zeros(len(known.pull))
    variance, ripple = np.full(len(known.pull), gain**2), start
    for _ in range(_RIPPLE_TURNS):
        ripple = _likeliest_sizes(ripple, known, variance)
        whole = ripple.covariance + np.diag(variance)
        unlike = np.eye(len(whole)) + known.precision @ whole
        middle = whole @ linalg.solve(unlike, known.pull, check_finite=False)
        splitting = _Splitting(middle, ripple.covariance, gain, dof)
        scatter = splitting.balanced(scatter).scatter
        variance = splitting.variance(scatter)
    curvature, axes = linalg.eigh(0.5 * _size_equations(ripple, known, variance).hessian)
    # No holograms make a size less certain than its prior, which has the variance π²/4.
    covariance = axes / np.maximum(curvature, 4 / np.pi**2) @ axes.T
    return FoundRipple(ripple, np.asarray(covariance))


@dataclass(frozen=True)
class _SizeEquations:
    """Twice the negative log posterior of n log sizes, up to a constant, and its derivatives."""

    cost: float
    gradient: Array
    hessian: Array


def _likeliest_sizes(ripple: Ripple, known: KnownMagnitude, variance: Array) -> Ripple:
    """Find sizes within their limits by Newton's method, with the scatter's variances (k,).

    Along directions in which the cost bends downwards, the size of the bend is taken: steps
    then lead down, too (Y. N. Dauphin and others 2014, NeurIPS 27:2933).
    """
    least, most = np.log(_FINE_LIMITS)
    here, damping = _size_equations(ripple, known, variance), 0.0
    for _ in range(_MOST_STEPS):
        size, slope = ripple.log_size, here.gradient
        free = ~((size <= least) & (slope > 0) | (size >= most) & (slope < 0))
        curvature, axes = linalg.eigh(here.hessian[free][:, free])
        step = -axes @ (axes.T @ slope[free] / (np.abs(curvature) + damping))
        proposed = size.copy()
        proposed[free] += np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        proposed = np.clip(proposed, least, most)
        other = replace(ripple, log_size=proposed)
        there = _size_equations(other, known, variance)
        if there.cost <= here.cost + _ROUNDING * abs(here.cost):
            ripple, here, damping = other, there, 0.0
        else:
            damping = max(4 * damping, float(np.mean(np.abs(curvature))))
        if np.max(np.abs(proposed - size)) < _SETTLED:
            break
    return ripple


def _size_equations(ripple: Ripple, known: KnownMagnitude, variance: Array) -> _SizeEquations:
    """Return the cost of log sizes (n,) with its first and second derivatives.

    With the precision P and the pull b of the holograms, the covariance W of the magnitude and
    S = (I + P W)⁻¹ P, y = (I + P W)⁻¹ b, the evidence costs log det(I + P W) − bᵀ W y, and a change
    dW of the covariance tr(S dW) − yᵀ dW y. The size at node i multiplies rows and columns of the
    finer structure F by exp(w_i), with the weights w_i of the node in every hologram.
    """
    F, w = ripple.finer, ripple.weights
    whole = ripple.coarse + F + np.diag(variance)
    factor = linalg.lu_factor(np.eye(len(whole)) + known.precision @ whole, check_finite=False)
    y = linalg.lu_solve(factor, known.pull, check_finite=False)
    S = linalg.lu_solve(factor, known.precision, check_finite=False)
    S = 0.5 * (S + S.T)
    off = ripple.log_size - np.log(_FINE[0])
    # The density of the logarithm of a half-Cauchy distributed size is 1/cosh.
    cost = np.sum(np.log(np.abs(np.diag(factor[0])))) - known.pull @ (whole @ y)
    cost += 2 * np.sum(np.logaddexp(off, -off))
    of_element = (S - np.outer(y, y)) * F
    of_row = of_element.sum(axis=1)
    gradient = 2 * w.T @ of_row + 2 * np.tanh(off)
    FS, moved = F @ S, w * (F @ y)[:, None] + F @ (w * y[:, None])
    twice = of_element - FS * FS.T - S * (FS @ F)
    hessian = 2 * w.T @ (of_row[:, None] * w + twice @ w) + 2 * moved.T @ (S @ moved)
    hessian += np.diag(2 / np.cosh(off) ** 2)
    return _SizeEquations(float(cost), gradient, 0.5 * (hessian + hessian.T))
