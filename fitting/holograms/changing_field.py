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
    """

    information: Array
    pull: ComplexArray


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
    few = problem.some(steps).every(_STRIDE)
    field = before[::_STRIDE] if before.ndim == 1 else before[steps, ::_STRIDE]
    power, shown = mean_power(field), _shown(few, a[steps], gain[steps], field)
    order, gaps = np.argsort(few.recording_rank), _gaps(few)
    information, pull = shown.information[order], shown.pull[order]
    seen = np.maximum(information, np.finfo(float).tiny)

    def unlikelihood(logs: Array) -> float:
        walk, scatter = np.exp(logs)
        noise = 1 + scatter * power * information
        cost, states = (
            0.0,
            _filtered(information / noise, pull / noise, gaps[:, None] * (walk * power), 1 / power),
        )
        for k, (precision, force) in enumerate(states):
            # Only the part of the block amplitudes along F says anything of the field.
            innovation = pull[k] - information[k] * force / precision
            variance = noise[k] + information[k] / precision
            left = (np.square(innovation.real) + np.square(innovation.imag)) / seen[k]
            cost += float(np.sum(np.log(variance) + left / variance))
        return cost

    bounds = [(np.log(_LEAST), np.log(_MOST))] * 2
    start = np.log([_START, _START])
    best = minimize(unlikelihood, start, method="Nelder-Mead", bounds=bounds,
                    options={"xatol": 0.05, "fatol": 1.0})  # fmt: skip
    walk, scatter = (float(each) for each in np.exp(best.x))
    return FieldChange(walk, scatter)


def _shown(problem: Problem, a: ComplexArray, gain: Array, field: ComplexArray) -> _Shown:
    u, v = problem.bessel_vectors(a)
    factor = np.exp(gain)[:, None]
    power, blurred = mean_power(field), blurring(problem, a)
    weight: Array = 1 / (1 + factor**2 * power * blurred[1])
    information: Array = weight * factor**2 * (u * u + v * v)
    seen: ComplexArray = problem.real + 1j * problem.imaginary
    pull: ComplexArray = weight * factor * (u - 1j * v) * seen
    steps = np.arange(len(a))
    for side in problem.others:
        dim = sideband_values(side, problem.displacement(a))
        values = brightness(side, dim, field, steps)[:, None] * dim
        weight = side.present[:, None] / (1 + power * blurred[side.order])
        information = information + weight * np.abs(values) ** 2
        pull = pull + weight * values.conj() * (side.real + 1j * side.imaginary)
    return _Shown(information, pull)


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
