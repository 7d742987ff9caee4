"""Evidence of a linear model whose noise and nuisances have scales that are not quite known.

A bench may be noisier, and differ more from the drawing, than usual. Each group of observables has
a factor on its noise, and each family of nuisances (thickness of the reed, constants of the cane,
ripple of the loudspeaker …) a factor on its standard deviations. So has the form of effects, which
is not quite that of the catalogue (decision 0106): one for numbers that have something in common,
one for each number by itself. The logarithms of all these have Gaussian priors
and are fitted for each hypothesis, so that more disorder costs power and is no evidence for an
effect. Given the factors the model is linear and Gaussian, and its evidence exact. That of all
factors together is the likeliest one's times the width of their posterior in units of their prior:
a Gaussian, cut off where noise would be less than was measured (decision 0107).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from diagnosis.inference.posterior import Posterior, Structure
from holography.arrays import Array

# Iterations of the factors: until none changes by more than the first number, and at most the
# second. Chosen:
# changes below a hundredth change no evidence by a tenth of a nat.
_SETTLED, _MOST_TURNS = 0.01, 60
# Newton steps for one factor, which converge quadratically.
_STEPS = 8
# The form of an effect is no farther off than this many standard deviations of its factors: what
# deviates more is another cause.
MOST_FORM_DEVIATIONS = 2.0
# Places of these two among the families: of what numbers have in common, and of each by itself.
TOGETHER, BY_ITSELF = -2, -1
FORMS = [TOGETHER, BY_ITSELF]
# Family of a column whose standard deviation is known.
KNOWN = -1
# The same of a number that is wrong, see `diagnosis.inference.gross_errors`.
GROSS = -2


@dataclass(frozen=True)
class Scales:
    """Logarithms of the factors on noise and nuisances.

    Attributes
    ----------
    noise : (g,) float
        Of each group of observables; not negative.
    families : (f,) float
        Of each family of nuisances, not negative for rare ones; the last two are the form of
        effects, see `FORMS`.
    """

    noise: Array
    families: Array

    @property
    def form(self) -> float:
        """Factor on the deviations of the form of effects, of each number by itself."""
        return float(np.exp(self.families[BY_ITSELF]))


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
        Family of each nuisance, from 0; `KNOWN` for those of known standard deviation, `GROSS` for
        those of numbers that are wrong. The last two are the form of effects: `FORMS`.
    noise_freedom : (g,) float
        Standard deviation of the log of each group's noise factor.
    family_freedom : (f,) float
        The same of each family's factor.
    rare : (f,) bool
        Whether the factor of a family is at least 1, see `GroupNuisances`.
    form : (n,) float
        Further variance of each number by the form of effects, where their factor is 1.
    log_prior : float
        Of the numbers that are wrong, over that of none.
    """

    left: Array
    slopes: Array
    group: NDArray[np.intp]
    family: NDArray[np.intp]
    noise_freedom: Array
    family_freedom: Array
    rare: NDArray[np.bool_]
    form: Array
    log_prior: float = 0.0

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

    def with_gross_error(self, column: Array, log_prior: float) -> "LinearModel":
        """Return the model with a number that is wrong.

        Parameters
        ----------
        column : (n,) float
            One standard deviation of its error.
        log_prior : float
            Log odds that it is wrong.
        """
        return replace(
            self,
            slopes=np.hstack([self.slopes, column[:, None]]),
            family=np.append(self.family, GROSS),
            log_prior=self.log_prior + log_prior,
        )

    def with_errors_of(self, other: "LinearModel") -> "LinearModel":
        """Return the model in which those numbers are wrong that are in another one."""
        own, others = self.family != GROSS, other.family == GROSS
        gross = other.slopes[:, others]
        return replace(
            self,
            slopes=np.hstack([self.slopes[:, own], gross]),
            family=np.concatenate([self.family[own], other.family[others]]),
            log_prior=other.log_prior,
        )

    def without_gross_errors(self) -> "LinearModel":
        """Return the model in which no number is wrong."""
        own = self.family != GROSS
        return replace(self, slopes=self.slopes[:, own], family=self.family[own], log_prior=0.0)

    def with_form(self, columns: Array, variance: Array) -> "LinearModel":
        """Return the model with an effect whose form may deviate.

        Parameters
        ----------
        columns : (n, c) float
            One standard deviation of what numbers have in common.
        variance : (n,) float
            Of each number by itself.
        """
        own = np.full(columns.shape[1], len(self.family_freedom) + TOGETHER)
        return replace(
            self,
            slopes=np.hstack([self.slopes, columns]),
            family=np.concatenate([self.family, own]),
            form=self.form + variance,
        )

    def not_absorbed(self, shift: Array, scales: "Scales") -> Array:
        """Return the part of a shift (n,) that nuisances of such scales do not absorb."""
        found = _posterior(replace(self, left=shift), scales)
        left: Array = shift + self.slopes @ found.mean
        return left

    def prior_variance(self, scales: Scales) -> Array:
        """Return the variance (q,) of the nuisances before anything is measured."""
        variance = np.ones(len(self.family))
        scaled = self.family >= 0
        variance[scaled] = np.exp(2 * scales.families[self.family[scaled]])
        return variance

    def moved(self, shift: Array) -> "LinearModel":
        """Return the model that a shift (n,) of the predictions changes."""
        return replace(self, left=self.left + shift)


@dataclass(frozen=True)
class Weighed:
    """A linear model with the likeliest scales.

    Attributes
    ----------
    log_evidence : float
        Of these scales, up to a constant of the data; of all scales where `weigh` found these.
    scales : Scales
    nuisances : (q,) float
        Posterior mean, in units of the usual standard deviations.
    unusual : float
        Sum of squares of the scales' logarithms, in units of their standard deviations.
    posterior : Posterior
        Of the nuisances.
    """

    log_evidence: float
    scales: Scales
    nuisances: Array
    unusual: float
    posterior: Posterior

    @cached_property
    def precision(self) -> Array:
        """Inverse covariance (n, n) of `LinearModel.left`."""
        return self.posterior.precision()


def weigh(model: LinearModel, begin: Scales | None = None, turns: int = 0) -> Weighed:
    """Find the likeliest scales of a model, and its evidence.

    Parameters
    ----------
    model : LinearModel
    begin : Scales, optional
        Where to begin as well as at 1: the better end counts.
    turns : int
        Most iterations; by default until the scales have settled.

    Returns
    -------
    Weighed
    """
    starts = [model.usual] if begin is None else [model.usual, begin]
    ends = [_settled(model, start, turns or _MOST_TURNS) for start in starts]
    each = [weighed_at(model, end) for end in ends]
    best = max(each, key=lambda one: one.log_evidence)
    return replace(best, log_evidence=best.log_evidence + log_width(model, best))


def _settled(model: LinearModel, scales: Scales, turns: int) -> Scales:
    """Follow the scales until they have settled."""
    for _ in range(turns):
        after = _next(model, scales, _posterior(model, scales))
        change = max(
            np.abs(after.noise - scales.noise).max(initial=0.0),
            np.abs(after.families - scales.families).max(initial=0.0),
        )
        scales = after
        if change < _SETTLED:
            break
    return scales


def weighed_at(model: LinearModel, scales: Scales) -> Weighed:
    """Weigh a model with given scales."""
    found, unusual = _posterior(model, scales), _unusual(model, scales)
    log_det = float(np.sum(np.log(found.variance)) - found.log_det)
    log_det += float(np.sum(np.log(model.prior_variance(scales))))
    return Weighed(
        log_evidence=model.log_prior - 0.5 * (found.squares + log_det + unusual),
        scales=scales,
        nuisances=found.mean,
        unusual=unusual,
        posterior=found,
    )


def log_width(model: LinearModel, weighed: Weighed) -> float:
    """Return the log of the evidence of all scales over that of the likeliest ones.

    The form of effects is left out: most numbers say nothing about it, or only that it deviates by
    less than some share, and then it has no Gaussian width.

    Parameters
    ----------
    model : LinearModel
    weighed : Weighed
        The same with the likeliest scales.
    """
    scales, found = weighed.scales, weighed.posterior
    left = model.left + model.slopes @ found.mean
    uncertain, spread = found.variances()
    # Squares that are left of each group, and how many the nuisances leave: they tell its noise.
    share = np.exp(2 * scales.noise)[model.group] / found.variance
    groups = len(model.noise_freedom)
    squares = _sums(model.group, share * left**2 / found.variance, groups)
    counts = _sums(model.group, share * (1 - spread / found.variance), groups)
    widths = _log_widths_from_0(squares, counts, model.noise_freedom, scales.noise)
    # Squares of the nuisances of each family tell its scale.
    families = len(model.family_freedom) - len(FORMS)
    scaled = (model.family >= 0) & (model.family < families)
    variance, own = model.prior_variance(scales)[scaled], model.family[scaled]
    sums = _sums(own, found.mean[scaled] ** 2 / variance, families)
    counts = _sums(own, 1 - uncertain[scaled] / variance, families)
    freedom, rare = model.family_freedom[:families], model.rare[:families]
    free = -0.5 * np.log(2 * sums * freedom**2 + 1)
    bounded = _log_widths_from_0(sums, counts, freedom, scales.families[:families])
    return float(widths.sum() + np.where(rare, bounded, free).sum())


def _sums(of: NDArray[np.intp], amounts: Array, count: int) -> Array:
    """Return the sum of the amounts (n,) of each group or family (count,)."""
    return np.bincount(of, amounts, count).astype(float)


def _log_widths_from_0(squares: Array, counts: Array, freedom: Array, logs: Array) -> Array:
    """Return the log widths (k,) of posteriors of logs that are not negative, over their priors'.

    Parameters
    ----------
    squares, counts : (k,) float
        Squares, in units of their variances, that tell the factors of which these are the logs, and
        how many numbers they are from.
    freedom : (k,) float
        Standard deviations of the logs before.
    logs : (k,) float
        The likeliest.
    """
    # At 0 a log may be less likely by a slope; elsewhere the likeliest has none.
    slope = np.where(logs > 0, 0.0, np.minimum(squares - counts, 0.0))
    bend = 2 * squares + 1 / freedom**2
    widths = 0.5 * slope**2 / bend - 0.5 * np.log(0.25 * bend * freedom**2)
    return np.asarray(widths + log_ndtr((logs + slope / bend) * np.sqrt(bend)))


def _posterior(model: LinearModel, scales: Scales) -> Posterior:
    """Posterior of the nuisances for given scales."""
    variance = np.exp(2 * scales.noise)[model.group] + scales.form**2 * model.form
    return Posterior.of(model.structure, model.left, variance, model.prior_variance(scales))


def _unusual(model: LinearModel, scales: Scales) -> float:
    squares = np.sum((scales.noise / model.noise_freedom) ** 2)
    squares += np.sum((scales.families / model.family_freedom) ** 2)
    return float(squares)


def _next(model: LinearModel, scales: Scales, found: Posterior) -> Scales:
    """Return the scales that are likeliest if nuisances and noise are as the last ones say (EM)."""
    left = model.left + model.slopes @ found.mean
    uncertain, spread = found.variances()
    # Of numbers with further variance only the share that is noise tells how large noise is.
    noise = np.exp(2 * scales.noise)[model.group]
    share = noise / found.variance
    square = share**2 * (left**2 + spread) + share * (found.variance - noise)
    groups = len(model.noise_freedom)
    sums = _sums(model.group, square, groups)
    counts = np.bincount(model.group, minlength=groups).astype(float)
    families = len(model.family_freedom)
    scaled = model.family >= 0
    squares = found.mean**2 + uncertain
    amounts = _sums(model.family[scaled], squares[scaled], families)
    sizes = np.bincount(model.family[scaled], minlength=families).astype(float)
    # Most numbers determine nothing of a form, and EM would hardly move (D. J. C. MacKay 1992,
    # Neural Computation 4:415).
    own = model.family == families + TOGETHER
    amounts[TOGETHER] = np.sum(found.mean[own] ** 2)
    sizes[TOGETHER] = np.sum(1 - uncertain[own] / np.exp(2 * scales.families[TOGETHER]))
    amounts[BY_ITSELF], sizes[BY_ITSELF] = _of_form(model, scales, found, left**2, spread)
    after = _likeliest_log(amounts, sizes, model.family_freedom, scales.families)
    most = MOST_FORM_DEVIATIONS * model.family_freedom[FORMS]
    after[FORMS] = np.clip(after[FORMS], -most, most)
    after[model.rare] = np.maximum(after[model.rare], 0.0)
    louder = _likeliest_log(sums, counts, model.noise_freedom, scales.noise)
    return Scales(np.maximum(louder, 0.0), after)


def _of_form(
    model: LinearModel,
    scales: Scales,
    found: Posterior,
    square: Array,
    spread: Array,
) -> tuple[float, float]:
    """Return the squares of what each number by itself deviates by, and how many are determined.

    Parameters
    ----------
    model : LinearModel
    scales : Scales
    found : Posterior
    square, spread : (n,) float
        Of what is left of the numbers, and its variance.
    """
    factor = scales.form**2
    seen = model.form > 0
    share = factor * model.form[seen] / found.variance[seen]
    squares = np.sum(share**2 * square[seen] / model.form[seen])
    determined = np.sum(share * (1 - spread[seen] / found.variance[seen]))
    return float(squares), float(determined)


def _likeliest_log(sums: Array, counts: Array, freedom: Array, begin: Array) -> Array:
    """Return x (k,) where −c x − s e^(−2x)/2 − x²/(2 t²) is largest, by Newton's method."""
    x = begin.copy()
    for _ in range(_STEPS):
        grown = sums * np.exp(-2 * x)
        slope = grown - counts - x / freedom**2
        step = slope / (2 * grown + 1 / freedom**2)
        x = x + np.clip(step, -1.0, 1.0)
    return x
