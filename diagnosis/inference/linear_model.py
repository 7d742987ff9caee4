"""Evidence of a linear model whose noise and nuisances have scales that are not quite known.

A bench may be noisier, and differ more from the drawing, than usual. Each group of observables has
a factor on its noise, and each family of nuisances (thickness of the reed, constants of the cane,
ripple of the loudspeaker …) a factor on its standard deviations. Their logarithms have Gaussian
priors and are fitted for each hypothesis, so that more disorder costs power and is no
evidence for an effect. Given the factors the model is linear and Gaussian, and its evidence exact.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from diagnosis.inference.posterior import Posterior, Structure
from holography.arrays import Array

# Iterations of the factors: until none changes by more than the first number, and at most the
# second. Chosen:
# changes below a hundredth change no evidence by a tenth of a nat.
_SETTLED, _MOST_TURNS = 0.01, 60
# Newton steps for one factor, which converge quadratically.
_STEPS = 8
# Family of a column whose standard deviation is known.
KNOWN = -1


@dataclass(frozen=True)
class Scales:
    """Logarithms of the factors on noise and nuisances.

    Attributes
    ----------
    noise : (g,) float
        Of each group of observables; not negative.
    families : (f,) float
        Of each family of nuisances.
    """

    noise: Array
    families: Array


@dataclass(frozen=True)
class LinearModel:
    """Numbers of all groups, linear in all nuisances, in units of their noise.

    Attributes
    ----------
    left : (n,) float
        Model less measurement with all nuisances at 0.
    slopes : (n, q) float
        What one standard deviation of each nuisance changes.
    group : (n,) int
        Group of each number, from 0.
    family : (q,) int
        Family of each nuisance, from 0; `KNOWN` for those of known standard deviation.
    noise_freedom : (g,) float
        Standard deviation of the log of each group's noise factor.
    family_freedom : (f,) float
        The same of each family's factor.
    """

    left: Array
    slopes: Array
    group: NDArray[np.intp]
    family: NDArray[np.intp]
    noise_freedom: Array
    family_freedom: Array

    @cached_property
    def structure(self) -> Structure:
        """Which nuisances reach one group only."""
        return Structure.of(self.slopes, self.group)

    @property
    def usual(self) -> Scales:
        """Factors of 1."""
        return Scales(np.zeros(len(self.noise_freedom)), np.zeros(len(self.family_freedom)))

    def with_columns(self, columns: Array) -> "LinearModel":
        """Return the model with further columns (n, c) of known unit standard deviation."""
        return replace(
            self,
            slopes=np.hstack([self.slopes, columns]),
            family=np.concatenate([self.family, np.full(columns.shape[1], KNOWN)]),
        )

    def not_absorbed(self, shift: Array, scales: "Scales") -> Array:
        """Return the part of a shift (n,) that nuisances of such scales do not absorb."""
        found = _posterior(replace(self, left=shift), scales, np.zeros(len(shift)))
        left: Array = shift + self.slopes @ found.mean
        return left

    def moved(self, shift: Array) -> "LinearModel":
        """Return the model that a shift (n,) of the predictions changes."""
        return replace(self, left=self.left + shift)


@dataclass(frozen=True)
class Weighed:
    """A linear model with the likeliest scales.

    Attributes
    ----------
    log_evidence : float
        Up to a constant of the data.
    scales : Scales
    nuisances : (q,) float
        Posterior mean, in units of the usual standard deviations.
    form : (n,) float
        Further variance of each number that it was weighed with.
    unusual : float
        Sum of squares of the scales' logarithms, in units of their standard deviations.
    posterior : Posterior
        Of the nuisances.
    """

    log_evidence: float
    scales: Scales
    nuisances: Array
    form: Array
    unusual: float
    posterior: Posterior

    @cached_property
    def precision(self) -> Array:
        """Inverse covariance (n, n) of `LinearModel.left`."""
        return self.posterior.precision()


def weigh(
    model: LinearModel, begin: Scales | None = None, more: Array | None = None, turns: int = 0
) -> Weighed:
    """Find the likeliest scales of a model, and its evidence.

    Parameters
    ----------
    model : LinearModel
    begin : Scales, optional
        Where to begin as well as at 1: the better end counts.
    more : (n,) float, optional
        Further variance of each number, of known size: by the form of an effect, for example.
    turns : int
        Most iterations; by default until the scales have settled.

    Returns
    -------
    Weighed
    """
    extra = np.zeros(len(model.left)) if more is None else more
    starts = [model.usual] if begin is None else [model.usual, begin]
    ends = [_settled(model, start, extra, turns or _MOST_TURNS) for start in starts]
    each = [weighed_at(model, end, extra) for end in ends]
    return max(each, key=lambda one: one.log_evidence)


def _settled(model: LinearModel, scales: Scales, extra: Array, turns: int) -> Scales:
    """Follow the scales until they have settled."""
    for _ in range(turns):
        found = _posterior(model, scales, extra)
        after = _next(model, scales, extra, found)
        change = max(
            np.abs(after.noise - scales.noise).max(initial=0.0),
            np.abs(after.families - scales.families).max(initial=0.0),
        )
        scales = after
        if change < _SETTLED:
            break
    return scales


def weighed_at(model: LinearModel, scales: Scales, more: Array | None = None) -> Weighed:
    """Weigh a model with given scales; parameters as those of `weigh`."""
    extra = np.zeros(len(model.left)) if more is None else more
    found, unusual = _posterior(model, scales, extra), _unusual(model, scales)
    log_det = float(np.sum(np.log(found.variance)) - found.log_det)
    log_det += float(np.sum(np.log(_prior_variance(model, scales))))
    return Weighed(
        log_evidence=-0.5 * (found.squares + log_det + unusual),
        scales=scales,
        nuisances=found.mean,
        form=extra,
        unusual=unusual,
        posterior=found,
    )


def _posterior(model: LinearModel, scales: Scales, extra: Array) -> Posterior:
    """Posterior of the nuisances for given scales."""
    variance = np.exp(2 * scales.noise)[model.group] + extra
    return Posterior.of(model.structure, model.left, variance, _prior_variance(model, scales))


def _prior_variance(model: LinearModel, scales: Scales) -> Array:
    variance = np.ones(len(model.family))
    scaled = model.family != KNOWN
    variance[scaled] = np.exp(2 * scales.families[model.family[scaled]])
    return variance


def _unusual(model: LinearModel, scales: Scales) -> float:
    squares = np.sum((scales.noise / model.noise_freedom) ** 2)
    squares += np.sum((scales.families / model.family_freedom) ** 2)
    return float(squares)


def _next(model: LinearModel, scales: Scales, extra: Array, found: Posterior) -> Scales:
    """Return the scales that are likeliest if nuisances and noise are as the last ones say (EM)."""
    left = model.left + model.slopes @ found.mean
    uncertain, spread = found.variances()
    # Of numbers with further variance only the share that is noise tells how large noise is.
    noise = np.exp(2 * scales.noise)[model.group]
    share = noise / found.variance
    square = share**2 * (left**2 + spread) + share * extra
    groups = len(model.noise_freedom)
    sums = np.bincount(model.group, square, groups).astype(float)
    counts = np.bincount(model.group, minlength=groups)
    families = len(model.family_freedom)
    scaled = model.family != KNOWN
    own = found.mean**2 + uncertain
    amounts = np.bincount(model.family[scaled], own[scaled], families).astype(float)
    sizes = np.bincount(model.family[scaled], minlength=families)
    return Scales(
        np.maximum(_likeliest_log(sums, counts, model.noise_freedom, scales.noise), 0.0),
        _likeliest_log(amounts, sizes, model.family_freedom, scales.families),
    )


def _likeliest_log(sums: Array, counts: NDArray[np.intp], freedom: Array, begin: Array) -> Array:
    """Return x (k,) where −c x − s e^(−2x)/2 − x²/(2 t²) is largest, by Newton's method."""
    x = begin.copy()
    for _ in range(_STEPS):
        grown = sums * np.exp(-2 * x)
        slope = grown - counts - x / freedom**2
        step = slope / (2 * grown + 1 / freedom**2)
        x = x + np.clip(step, -1.0, 1.0)
    return x
