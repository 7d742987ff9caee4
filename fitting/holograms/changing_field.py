"""Follow the object field of a reed whose speckle changes while the sweep is measured.

Humidity, temperature and air change the speckle of a rough surface a little from one hologram to
the next. The object field of each block is taken as a complex random walk in the order of
recording, ``A_k = A_(k−1) + √q |A| w_k``, and hologram k shows it with a change of its own, ``A_k +
√s |A| v_k``; w and v are independent complex Gaussian numbers of variance 1. For known
displacements the field is found by a Kalman filter forwards and one backwards (Rauch, Tung &
Striebel 1965, AIAA J. 3:1445). The field that a hologram is compared with comes from the other
holograms only: its own light cannot hide what its displacement does not explain. Both variances, q
and s, are found by maximum likelihood of the filter's innovations (Harvey 1989, Forecasting,
Structural Time Series Models and the Kalman Filter, section 3.4).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from fitting.holograms.problem import Problem
from fitting.holograms.sidebands import brightness, sideband_values
from fitting.holograms.within_blocks import blurring
from holography.arrays import Array, Complex64Array, ComplexArray

# Limits of both variances over the mean power of the field: 0.01 % rms from hologram to hologram is
# below the noise of any camera, and fields of which a third is new have no holograms in common.
_LEAST, _MOST = 1e-8, 0.1
# The search begins at changes of 1 % rms.
_START = 1e-4
# Blocks that are enough to find two variances: every fourth.
_STRIDE = 4


@dataclass(frozen=True)
class FieldChange:
    """How much the object field changes, over its mean power.

    Attributes
    ----------
    walk : float
        Variance of the change from one hologram to the next one that was recorded.
    scatter : float
        Variance of the change of a single hologram.
    """

    walk: float
    scatter: float


def same_change(one: FieldChange, other: FieldChange) -> bool:
    """Whether two changes of the object field differ by less than a tenth, as does their noise."""
    pairs = (one.walk, other.walk), (one.scatter, other.scatter)
    return all(abs(a - b) <= 0.1 * max(a, b) for a, b in pairs)


@dataclass(frozen=True)
class FieldEstimate:
    """Object field of every hologram, from all others.

    Attributes
    ----------
    mean : (k, n) complex64
    variance : (k, n) float32
        Its variance, with that of the change of the hologram itself.
    """

    mean: Complex64Array
    variance: NDArray[np.float32]


@dataclass(frozen=True)
class _Shown:
    """What holograms say of the object field if the displacements are known.

    Attributes
    ----------
    information : (k, n) float
        Squared magnitude of F over the variance of the noise, summed over the sidebands.
    pull : (k, n) complex
        Block amplitudes times the complex conjugate of F over the variance of the noise, summed
        over the sidebands.
    log_noise : (k, n) float
        Logarithm of the variance of the noise, summed over the sidebands.
    """

    information: Array
    pull: ComplexArray
    log_noise: Array


def field_estimate(
    problem: Problem,
    a: ComplexArray,
    gain: Array,
    before: ComplexArray,
    change: FieldChange,
    weight: Array,
) -> FieldEstimate:
    """Find the object field of every hologram from all others.

    Parameters
    ----------
    problem : Problem
    a : (k, j) complex
        Amplitudes.
    gain : (k,) float
        Log gains.
    before : (n,) or (k, n) complex
        Object field so far, for the scale of changes and the brightness of other sidebands.
    change : FieldChange
    weight : (k,) float
        Holograms of a smaller weight count for less; 0 is for those without a solution.
    """
    power = mean_power(before)
    shown = _shown(problem, a, gain, before)
    scatter = change.scatter * power
    # The change of a hologram alone is noise of what it says of the field.
    trust = weight[:, None] / (1 + shown.information * scatter)
    information, pull = trust * shown.information, trust * shown.pull
    order, walks = np.argsort(problem.recording_rank), change.walk * power
    mean = np.empty(information.shape, np.complex64)
    variance = np.empty(information.shape, np.float32)
    gaps = _gaps(problem)[:, None] * walks
    forwards = _filtered(information[order], pull[order], gaps, 1 / power)
    # Backwards, the gap after a hologram is the one before it.
    back, gaps = order[::-1], np.roll(gaps[::-1], -1, axis=0)
    backwards = list(_filtered(information[back], pull[back], gaps, np.zeros_like(power)))[::-1]
    for k, (here, force), (there, more) in zip(order, forwards, backwards, strict=True):
        precision = here + there
        mean[k] = (force + more) / precision
        variance[k] = 1 / precision + scatter
    return FieldEstimate(mean, variance)


def mean_power(object_field: ComplexArray) -> Array:
    """Return the power (n,) of the object field, averaged over holograms; never quite 0."""
    power = np.square(object_field.real) + np.square(object_field.imag)
    each = power.astype(float) if power.ndim == 1 else power.mean(axis=0, dtype=float)
    found: Array = np.maximum(each, 1e-6 * each.max() + np.finfo(float).tiny)
    return found


def found_change(
    problem: Problem,
    a: ComplexArray,
    gain: Array,
    before: ComplexArray,
    explained: NDArray[np.bool_],
) -> FieldChange:
    """Find how much the object field changes, from holograms that are explained (k,)."""
    steps = np.flatnonzero(explained)
    shown = _in_turn(problem.some(steps), a[steps], gain[steps], _rows(before, steps))

    def cost(logs: Array) -> float:
        walk, scatter = np.exp(logs).tolist()
        return sum(_costs(shown, FieldChange(walk, scatter)))

    bounds = [(np.log(_LEAST), np.log(_MOST))] * 2
    start = np.log([_START, _START])
    best = minimize(cost, start, method="Nelder-Mead", bounds=bounds,
                    options={"xatol": 0.05, "fatol": 1.0})  # fmt: skip
    walk, scatter = (float(each) for each in np.exp(best.x))
    return FieldChange(walk, scatter)


def unlikelihood(
    problem: Problem,
    a: ComplexArray,
    gain: Array,
    before: ComplexArray,
    change: FieldChange,
    misfit: Array,
) -> float:
    """Return twice the negative log likelihood of all holograms, of every fourth block.

    Residuals alone do not tell which of several solutions is right: one whose field changes more
    has smaller ones. What a hologram costs at most is the cost of light of any size, which explains
    nothing, and so do those without a solution.

    Parameters
    ----------
    problem, a, gain, before, change
        See `field_estimate`.
    misfit : (k,) float
        Mean square residual in units of the noise: what is off says less of the field. Infinite
        without a solution.
    """
    steps = np.flatnonzero(np.isfinite(misfit))
    shown = _in_turn(problem.some(steps), a[steps], gain[steps], _rows(before, steps))
    few = problem.every(_STRIDE)
    power = np.square(few.real) + np.square(few.imaginary)
    unexplained = np.sum(np.log(np.maximum(power, 1)) + np.minimum(power, 1), axis=1)
    trust = 1 / np.maximum(misfit[steps][shown.order], 1)
    costs = np.minimum(_costs(shown, change, trust), unexplained[steps][shown.order])
    return float(np.sum(costs) + np.sum(unexplained[~np.isfinite(misfit)]))


@dataclass(frozen=True)
class _InTurn:
    """What every fourth block of holograms says, in the order of recording.

    Attributes
    ----------
    order : (k,) int
        Numbers of the holograms.
    information, pull, log_noise : (k, n)
        See `_Shown`.
    gaps : (k,) float
    power : (n,) float
    """

    order: NDArray[np.intp]
    information: Array
    pull: ComplexArray
    log_noise: Array
    gaps: Array
    power: Array


def _rows(field: ComplexArray, steps: NDArray[np.intp]) -> ComplexArray:
    return field if field.ndim == 1 else field[steps]


def _in_turn(problem: Problem, a: ComplexArray, gain: Array, before: ComplexArray) -> _InTurn:
    few, field = problem.every(_STRIDE), before[..., ::_STRIDE]
    shown, order = _shown(few, a, gain, field), np.argsort(few.recording_rank)
    return _InTurn(
        order,
        shown.information[order],
        shown.pull[order],
        shown.log_noise[order],
        _gaps(few),
        mean_power(field),
    )


def _costs(shown: _InTurn, change: FieldChange, trust: Array | None = None) -> list[float]:
    """Return twice the negative log likelihood of each hologram, given those before it.

    What each says of the field of later ones is multiplied by `trust` (k,).
    """
    information, pull, power = shown.information, shown.pull, shown.power
    seen = np.maximum(information, np.finfo(float).tiny)
    noise = 1 + change.scatter * power * information
    walks = shown.gaps[:, None] * (change.walk * power)
    known = 1 / noise if trust is None else trust[:, None] / noise
    states = _filtered(known * information, known * pull, walks, 1 / power)
    costs = []
    for k, (precision, force) in enumerate(states):
        # Only the part of the block amplitudes along F says anything of the field.
        innovation = pull[k] - information[k] * force / precision
        variance = noise[k] + information[k] / precision
        left = (np.square(innovation.real) + np.square(innovation.imag)) / seen[k]
        costs.append(float(np.sum(np.log(variance) + shown.log_noise[k] + left / variance)))
    return costs


def _shown(problem: Problem, a: ComplexArray, gain: Array, field: ComplexArray) -> _Shown:
    u, v = problem.bessel_vectors(a)
    factor = np.exp(gain)[:, None]
    power, blurred = mean_power(field), blurring(problem, a)
    weight: Array = 1 / (1 + factor**2 * power * blurred[1])
    log_noise: Array = -np.log(weight)
    information: Array = weight * factor**2 * (u * u + v * v)
    seen: ComplexArray = problem.real + 1j * problem.imaginary
    pull: ComplexArray = weight * factor * (u - 1j * v) * seen
    steps = np.arange(len(a))
    for side in problem.others:
        dim = sideband_values(side, problem.displacement(a))
        values = brightness(side, dim, field, steps)[:, None] * dim
        noise = 1 + power * blurred[side.order]
        weight = side.present[:, None] / noise
        log_noise = log_noise + side.present[:, None] * np.log(noise)
        information = information + weight * np.abs(values) ** 2
        pull = pull + weight * values.conj() * (side.real + 1j * side.imaginary)
    return _Shown(information, pull, log_noise)


def _gaps(problem: Problem) -> Array:
    """Return how many holograms later (k,) each was recorded than the one before."""
    ranks = np.sort(problem.recording_rank)
    return np.diff(ranks, append=ranks[-1] + 1).astype(float)


def _filtered(
    information: Array, pull: ComplexArray, walks: Array, precision: Array
) -> Iterator[tuple[Array, ComplexArray]]:
    """Yield precision (n,) and precision times mean of the field before each hologram is seen.

    `walks` (k, n) are the variances of the changes after each hologram, and `precision` (n,) that
    of a field around 0 before the first one.
    """
    force: ComplexArray = np.zeros(len(precision), complex)
    for own, along, walk in zip(information, pull, walks, strict=True):
        yield precision, force
        after = precision + own
        shrunk = 1 / (1 + walk * after)
        precision, force = after * shrunk, (force + along) * shrunk


def renewal_of(smooth: Array, walk: float, independent: float) -> Array:
    """Return how speckle that is renewed changes the smooth factor of the object field.

    Parameters
    ----------
    smooth : (n, c) float
    walk : float
        Mean square of what changes in each block from one hologram to the next, over that of its
        field.
    independent : float
        Number of independent blocks over that of all.

    Returns
    -------
    (2c - 1, 2c - 1) float
        Covariance of the change of its coefficients (see `fitting.holograms.object_field`): blocks
        are renewed independently, and the factor is fitted to them.
    """
    # Half of what changes is magnitude, half phase.
    each = 0.5 * walk / independent * np.linalg.inv(smooth.T @ smooth)
    # The constant of the phase is no parameter.
    kept = np.flatnonzero(np.arange(2 * len(each)) != len(each))
    whole: Array = np.kron(np.eye(2), each)[np.ix_(kept, kept)]
    return whole
