"""Amplitudes of holograms from a known object field, and the object field from amplitudes."""

import numpy as np
from scipy.stats import median_abs_deviation

from fitting.holograms.problem import GAIN_NEPERS, Problem, misfits, normal
from fitting.holograms.sidebands import brightness, sideband_values
from fitting.levenberg_marquardt import Damping, NormalEquations, minimise_all
from holography.arrays import Array, Complex64Array, ComplexArray, IndexArray

# Holograms over which gains are averaged, in the order of recording: standard deviation of a
# Gaussian window. Chosen: at least eight holograms count, in seconds during which a laser drifts
# little.
_SLOW = 3.0
# Least scatter of gains: power of a stabilised laser (data sheets: 0.2 %), and how many holograms
# must show their own gain.
LEAST_GAIN_NEPERS, FEWEST_GAINS = 0.002, 8
# Prior standard deviation of amplitudes, rad: weak, for directions that the data do not determine.
FINAL_RAD = 10.0
# Steps end when they are expected to gain less, in half of χ²: all coordinates together are then
# off by a tenth of a standard error.
_LEAST_GAIN = 5e-3
# Chosen by hand; no study of other values is kept.
_DAMPING = Damping(first=1e-3, after_gain=0.2, after_loss=6, constant=1e-3, largest=1e6)


def fit_amplitudes(
    problem: Problem,
    object_field: Complex64Array,
    steps: IndexArray,
    start: tuple[ComplexArray, Array],
    iterations: int,
    prior: Array,
) -> tuple[ComplexArray, Array, Array]:
    """Fit amplitudes and gains of holograms to block amplitudes by Levenberg-Marquardt steps.

    Parameters
    ----------
    problem : Problem
    object_field : (n,) complex64
    steps : (s,) int
        Numbers of the holograms in the problem.
    start : tuple of (s, j) complex and (s,) float
        Amplitudes in rad, and log gains.
    iterations : int
        At least 1.
    prior : (j, j) or (s, j, j) float
        Precision of the amplitudes around 0.

    Returns
    -------
    amplitude : (s, j) complex
    gain : (s,) float
        Log gains.
    misfit : (s,) float
        Squared residuals of the block amplitudes.
    """
    a, gain = start
    size = a.shape[1]
    precision = np.zeros((len(a), 2 * size + 1, 2 * size + 1))
    # Half of it: the misfit, of noise of variance 1, is half of χ².
    precision[:, :size, :size] = precision[:, size:-1, size:-1] = 0.5 * prior
    precision[:, -1, -1] = problem.half_gain_precision

    def equations(x: Array, which: IndexArray) -> NormalEquations:
        a = x[:, :size] + 1j * x[:, size:-1]
        here = normal(problem, object_field, steps[which], a, x[:, -1])
        pulled = (precision[which] @ x[..., None])[..., 0]
        return NormalEquations(
            cost_terms=np.stack([here.misfit, np.sum(x * pulled, axis=1)]),
            negative_gradient=here.gradient - pulled,
            matrix=here.matrix + precision[which],
            curvature=np.trace(here.matrix[:, :-1, :-1], axis1=1, axis2=2),
        )

    def cost_terms(x: Array, which: IndexArray) -> Array:
        a = x[:, :size] + 1j * x[:, size:-1]
        left = misfits(problem, object_field, steps[which], a, x[:, -1])
        pulled = (precision[which] @ x[..., None])[..., 0]
        return np.stack([left, np.sum(x * pulled, axis=1)])

    x0 = np.concatenate([a.real, a.imag, gain[:, None]], axis=1)
    x, (misfit, _) = minimise_all(
        equations, cost_terms, x0, iterations, _DAMPING, 2 * size, _LEAST_GAIN
    )
    return x[:, :size] + 1j * x[:, size:-1], x[:, -1], misfit


def block_object_field(
    problem: Problem,
    steps: IndexArray,
    a: ComplexArray,
    gain: Array,
    weight: Array,
    before: Complex64Array | None = None,
) -> Complex64Array:
    """Fit the object field (n,) of every block to holograms (s,) of given weights.

    `before` is the object field so far; it is needed if there are other sidebands.
    """
    u, v = problem.bessel_vectors(a)
    factor = np.exp(gain).astype(np.float32)[:, None]
    weighed = (weight[:, None] * factor).astype(np.float32)
    real, imaginary = problem.real[steps], problem.imaginary[steps]
    power = np.sum(weighed * factor * (u * u + v * v), axis=0)
    object_field = np.sum(weighed * (u * real + v * imaginary), axis=0) + 1j * np.sum(
        weighed * (u * imaginary - v * real), axis=0
    )
    if before is not None:
        for side in problem.others:
            shown = sideband_values(side, problem.displacement(a))
            shown = brightness(side, shown, before, steps).astype(np.complex64)[:, None] * shown
            trust = (weight * side.present[steps]).astype(np.float32)[:, None]
            seen = side.real[steps] + 1j * side.imaginary[steps]
            power += np.sum(trust * (shown.real**2 + shown.imag**2), axis=0)
            object_field += np.sum(trust * shown.conj() * seen, axis=0)
    found: Complex64Array = (object_field / np.maximum(power, np.float32(1e-9))).astype(
        np.complex64
    )
    return found


def gain_scatter(problem: Problem, gain: Array, matrix: Array) -> float:
    """Return the standard deviation of log gains (k,) around what changes slowly, in nepers.

    Slow changes of brightness belong to the object field.

    Parameters
    ----------
    problem : Problem
    gain : (k,) float
    matrix : (k, 2j + 1, 2j + 1) float
        Normal matrices of amplitudes and log gains. At small amplitudes a hologram does not
        determine its gain.
    """
    size = matrix.shape[1] - 1
    coupling = matrix[:, :size, size:]
    weak = 0.5 * FINAL_RAD**-2 * np.eye(size)
    along = np.linalg.solve(matrix[:, :size, :size] + weak, coupling)
    known = matrix[:, -1, -1] - np.sum(coupling * along, axis=(1, 2))
    # Half of the precision, as the misfit is half of χ².
    sure = problem.independent_fraction * known > 0.5 / GAIN_NEPERS**2
    if np.count_nonzero(sure) < FEWEST_GAINS:
        return GAIN_NEPERS
    known = np.where(sure, known, 0)
    # Without what the prior does to them.
    free = np.where(sure, gain * (1 + problem.half_gain_precision / np.maximum(known, 1e-9)), 0)
    weight = np.minimum(known, 0.5 / LEAST_GAIN_NEPERS**2)
    apart = np.subtract.outer(problem.recording_rank, problem.recording_rank) / _SLOW
    window = np.exp(-0.5 * apart**2) * (1 - np.eye(len(gain))) * weight
    slow: Array = window @ free / (window.sum(axis=1) + 0.5 / GAIN_NEPERS**2)
    scatter = float(median_abs_deviation((free - slow)[sure], scale="normal"))
    # Of noise that blocks share, fits take less for noise than there is.
    own = float(np.median(0.5 / known[sure])) / problem.independent_fraction
    found = np.sqrt(max(scatter**2 - own, 0.0))
    return float(np.clip(found, LEAST_GAIN_NEPERS, GAIN_NEPERS))
