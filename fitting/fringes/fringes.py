"""Fit the amplitude of each mode shape to the fringes of every picture.

A picture of the first sideband shows ``B(x) J₁²(φ(x))``, where φ = 4π|w|/λ is the phase amplitude
of the vibration and B the intensity of the light from the surface. The vibration is a sum of known
mode shapes, ``φ = |Σ_m a_m W_m|``. The complex amplitudes a_m are found for all pictures at once by
Levenberg-Marquardt steps. With shapes normalised to a largest deflection of 1, |a_m| is the largest
phase amplitude of mode m alone: its fringes, in radians.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.bessel import SidebandTable
from fitting.levenberg_marquardt import Damping, NormalEquations, minimise_all
from holography.arrays import Array, Complex64Array, Float32Array, IndexArray

# Largest value of J₁²: the brightness of the first bright fringe.
FIRST_FRINGE = 0.3386
# Single-shape starts of each picture, and rounds over neighbours' solutions and light.
_STARTS = 2
_ROUNDS = 2
# A solution is handed to the next and to the previous picture, as it is, weaker and stronger: on
# the flank of a resonance amplitudes change by a quarter per step.
_HANDED_ON = tuple((shift, scale) for shift in (1, -1) for scale in (1.0, 0.75, 1.33))
# A neighbour's solution is used if it decreases the misfit to this fraction.
_GAIN = 0.9
_START_STEPS, _NEIGHBOUR_STEPS, _FINAL_STEPS, _ALONE_STEPS = 12, 5, 5, 25
# Chosen by hand; no study of other values is kept.
_DAMPING = Damping(first=1e-2, after_gain=0.3, after_loss=5, constant=1e-6)
# Phase amplitudes tried for a single shape, rad.
_TRIAL_RAD = np.geomspace(0.1, 60.0, 80, dtype=np.float32)
# Pictures from which a fit without a shape starts: all near neighbours may lie in the same wrong
# minimum, but not those farther away.
_AROUND = np.array([-8, -6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6, 8])
# The light B of a point is estimated from this many pictures, in which the point is brightest.
_BRIGHTEST = 6
# Points that never reach a fringe would get too little light from that estimate.
_LEAST_LIGHT = 0.6
# Light below this fraction of the median is noise: relative to it, noise would look like fringes.
_DARKEST = 0.1


@dataclass(frozen=True)
class Fringes:
    """Mode amplitudes of every picture.

    Attributes
    ----------
    amplitude_rad : (k, m) complex64
        Phase amplitude of each shape in each picture, up to a common phase per picture.
    phase_rad : (k,) float
        Root mean square over the points of the phase amplitude φ.
    misfit : (k,) float
        Mean square residual of the picture's brightness, relative to B.
    light : (n,) float32
        Light B of each point.
    """

    amplitude_rad: Complex64Array
    phase_rad: Array
    misfit: Array
    light: Float32Array


@dataclass(frozen=True)
class _Problem:
    """Pictures (k, n) divided by their light, and the mode shapes (n, m)."""

    relative: Float32Array
    shapes: Float32Array
    bessel: SidebandTable

    def only(self, pictures: NDArray[np.intp]) -> "_Problem":
        """Return the problem of some of the pictures."""
        return _Problem(self.relative[pictures], self.shapes, self.bessel)

    def residual_and_jacobian(self, a: Complex64Array) -> tuple[Float32Array, Float32Array]:
        """Return residuals (k, n) and derivatives (k, n, 2m) by real, then imaginary parts."""
        sum_ = a @ self.shapes.T
        phi = np.abs(sum_)
        value, slope = self.bessel(phi)
        # d(J₁²)/dφ over φ, times the parts of the sum: dφ = Re(conj(sum)·W da)/φ.
        scale = 2 * value * slope / np.maximum(phi, np.float32(1e-6))
        parts = (sum_.real * scale)[..., None], (sum_.imag * scale)[..., None]
        jacobian = np.concatenate([part * self.shapes for part in parts], axis=2)
        return value * value - self.relative, jacobian


def mean_square(residual: Float32Array) -> Array:
    """Return the mean square (k,) of residuals (k, n)."""
    squares: Array = np.einsum("kn,kn->k", residual, residual) / residual.shape[1]
    return squares


def _fit_amplitudes(
    problem: _Problem, start: Complex64Array, iterations: int
) -> tuple[Complex64Array, Array]:
    """Fit the amplitudes (k, m) of all pictures; return them and the misfits (k,)."""
    modes = start.shape[1]

    def complex_of(x: Array) -> Complex64Array:
        return (x[:, :modes] + 1j * x[:, modes:]).astype(np.complex64)

    def equations(x: Array, which: IndexArray) -> NormalEquations:
        residual, jacobian = problem.only(which).residual_and_jacobian(complex_of(x))
        points = residual.shape[1]
        matrix = np.matmul(jacobian.transpose(0, 2, 1), jacobian) / points
        return NormalEquations(
            cost_terms=mean_square(residual)[None],
            negative_gradient=-np.einsum("knu,kn->ku", jacobian, residual) / points,
            matrix=matrix,
            curvature=np.trace(matrix, axis1=1, axis2=2),
        )

    def cost_terms(x: Array, which: IndexArray) -> Array:
        return mean_square(problem.only(which).residual_and_jacobian(complex_of(x))[0])[None]

    x0 = np.concatenate([start.real, start.imag], axis=1)
    x, (misfit,) = minimise_all(equations, cost_terms, x0, iterations, _DAMPING)
    return complex_of(x), misfit


def _single_shape_starts(problem: _Problem) -> tuple[NDArray[np.intp], Float32Array]:
    """For each picture, shapes in order of similarity (k, m) and their best amplitude (k, m)."""
    costs, amplitudes = [], []
    power = mean_square(problem.relative)[:, None]
    for shape in problem.shapes.T:
        value, _ = problem.bessel(_TRIAL_RAD[:, None] * np.abs(shape))
        pattern = value * value
        overlap = problem.relative @ pattern.T / len(shape)
        cost = power - 2 * overlap + mean_square(pattern)
        costs.append(cost.min(axis=1))
        amplitudes.append(_TRIAL_RAD[cost.argmin(axis=1)])
    order = np.argsort(np.stack(costs, axis=1), axis=1)
    return order, np.stack(amplitudes, axis=1)


def _start(problem: _Problem) -> tuple[Complex64Array, Array]:
    """Fit every picture from its best single shapes, and keep the best result."""
    order, amplitudes = _single_shape_starts(problem)
    pictures, shapes = amplitudes.shape
    # Phases spread by the golden angle: no two shapes start in phase or in opposition.
    spread = 1e-2 * np.exp(2j * np.pi * 0.618034 * np.arange(shapes))
    best, cost = np.zeros((pictures, shapes), np.complex64), np.full(pictures, np.inf)
    for rank in range(min(_STARTS, shapes)):
        a = np.tile(spread, (pictures, 1)).astype(np.complex64)
        rows, chosen = np.arange(pictures), order[:, rank]
        a[rows, chosen] = amplitudes[rows, chosen]
        a, new = _fit_amplitudes(problem, a, _START_STEPS)
        best, cost = np.where((new < cost)[:, None], a, best), np.minimum(new, cost)
    return best, cost


def _from_neighbours(
    problem: _Problem, a: Complex64Array, cost: Array
) -> tuple[Complex64Array, Array]:
    """Fit pictures from their neighbours' solutions, because resonances are wider than a step.

    A picture that improves passes its new solution on, until no picture improves.
    """
    last = len(a) - 1
    spreading = np.arange(len(a))
    for _ in range(len(a)):
        gained: list[int] = []
        for shift, scale in _HANDED_ON:
            to = spreading + shift
            inside = (to >= 0) & (to <= last)
            to, source = to[inside], spreading[inside]
            if not len(to):
                continue
            start = (scale * a[source]).astype(np.complex64)
            tried, new = _fit_amplitudes(problem.only(to), start, _NEIGHBOUR_STEPS)
            better = new < _GAIN * cost[to]
            a[to[better]], cost[to[better]] = tried[better], new[better]
            gained += to[better].tolist()
        if not gained:
            break
        spreading = np.unique(gained)
    return a, cost


def first_light(brightness: Float32Array) -> Float32Array:
    """Estimate the light B (n,) from the brightest of pictures (k, n), which show a fringe."""
    count = min(_BRIGHTEST, len(brightness))
    brightest = np.partition(brightness, -count, axis=0)[-count:].mean(axis=0)
    light: Float32Array = (brightest / FIRST_FRINGE).astype(np.float32)
    return np.maximum(light, np.float32(_LEAST_LIGHT) * np.median(light))


def count_fringes(
    brightness: Float32Array, shapes: Float32Array, start: Fringes | None = None
) -> Fringes:
    """Fit the amplitudes of given mode shapes to every picture of a sweep.

    Parameters
    ----------
    brightness : (k, n) float32
        Speckle-averaged |H|² of each picture at n points, less its noise; any unit.
    shapes : (n, m) float32
        Deflection of each mode shape at the points, largest magnitude 1.
    start : Fringes, optional
        Fit of the same pictures with almost the same shapes.

    Returns
    -------
    Fringes

    Notes
    -----
    The problem is not convex. Each picture starts from the single shapes that resemble it most,
    then from the solutions of its neighbours. In between, the light B is fitted to all pictures by
    linear least squares.
    """
    bessel, light = SidebandTable(1), start.light if start else first_light(brightness)
    problem = _Problem(brightness / light, shapes, bessel)
    a, cost = (
        _fit_amplitudes(problem, start.amplitude_rad, _START_STEPS) if start else _start(problem)
    )
    for _ in range(1 if start else _ROUNDS):
        a, cost = _from_neighbours(problem, a, cost)
        light = _light(brightness, a, cost, problem)
        problem = _Problem(brightness / light, shapes, bessel)
        a, cost = _fit_amplitudes(problem, a, _FINAL_STEPS)
    phase = np.sqrt(mean_square(np.abs(a @ shapes.T)))
    return Fringes(a, phase, cost, light)


def _light(
    brightness: Float32Array, a: Complex64Array, cost: Array, problem: _Problem
) -> Float32Array:
    """Light B (n,) by least squares over pictures, the better explained weighing more."""
    value, _ = problem.bessel(np.abs(a @ problem.shapes.T))
    pattern = value * value
    # Relative to what there is to explain: a dark picture fits any light.
    unexplained = np.maximum(cost, 1e-12) / np.maximum(mean_square(pattern), 1e-12)
    weight = np.clip(0.1 * np.median(unexplained) / unexplained, 0.0, 1.0)[:, None]
    numerator = (weight * brightness * pattern).sum(axis=0)
    denominator = (weight * pattern * pattern).sum(axis=0)
    light = numerator / np.maximum(denominator, 1e-12)
    lifted: Float32Array = np.maximum(light, _DARKEST * np.median(light)).astype(np.float32)
    return lifted


def misfit_without(
    brightness: Float32Array, shapes: Float32Array, fringes: Fringes, shape: int, picture: int
) -> float:
    """Return the misfit of one picture if it is fitted without one shape.

    Compared with `Fringes.misfit` it shows whether the picture needs the shape at all: a picture
    shows only the magnitude of φ, so that a mode which does not vibrate may get some amplitude.

    Parameters
    ----------
    brightness, shapes : as for `count_fringes`
    fringes : Fringes
        Fit of the pictures with all shapes.
    shape, picture : int
        Column of `shapes`, row of `brightness`.
    """
    near = np.unique(np.clip(picture + _AROUND, 0, len(brightness) - 1))
    others = np.delete(np.arange(shapes.shape[1]), shape)
    relative = np.repeat(brightness[picture : picture + 1] / fringes.light, len(near), axis=0)
    problem = _Problem(relative, shapes[:, others], SidebandTable(1))
    _, cost = _fit_amplitudes(problem, fringes.amplitude_rad[np.ix_(near, others)], _ALONE_STEPS)
    return float(cost.min())
