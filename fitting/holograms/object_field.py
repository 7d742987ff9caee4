"""Fit the smooth factor of the object field that is nearly confounded with the vibration.

The block amplitudes are ``A c_k F(u_k)``. At small amplitudes ``F(u) = u/2``: an object field that
is brighter by a smooth factor, with displacements that are smaller by it, gives the same holograms.
Fringes determine the magnitude of that factor but never its phase, because
``F(u e^{iθ}) = F(u) e^{iθ}``. Alternating minimisation over object field and displacements would
therefore converge slowly, to one solution of many. Here one Newton step finds the factor, and the
displacements of all holograms follow it. The remaining uncertainty of the factor is returned as a
common-mode error; the modal fit reduces it, because modes have real shapes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.linearisation import Local
from fitting.holograms.problem import (
    Normal,
    Problem,
    fill_normal,
)
from fitting.parallel.threads import map_threads
from holography.arrays import Array, ComplexArray, IndexArray

# Total degree in x and y of the polynomial that is the factor's logarithm: enough to turn the shape
# of F1 into that of any mode below 20 kHz (decision 0047).
_DEGREE = 10
# Prior standard deviation of each coefficient, in nepers or rad: weak, for the directions that the
# data do not determine.
_LOOSE = 1.0
# ... and of a step: along those directions the factor stays where it is.
_STEP = 0.01


@dataclass(frozen=True)
class CommonModeError:
    """Error that all displacements have in common because the object field is uncertain.

    Attributes
    ----------
    response : (k, 2j, q) float
        Derivatives of the amplitudes (real, then imaginary parts) of every hologram with respect
        to the q parameters of the error.
    precision : (k, q, q) float
        What each hologram adds to the inverse covariance of the parameters.
    pull : (k, q) float
        What it adds to the negative gradient of half of χ² by the parameters, where they are 0.
    """

    response: Array
    precision: Array
    pull: Array

    @property
    def whole(self) -> Array:
        """Inverse covariance (q, q) of parameters that are the same in all holograms."""
        weak = _LOOSE**-2 * np.eye(self.precision.shape[1])
        whole: Array = weak + self.precision.sum(axis=0)
        return whole


@dataclass(frozen=True)
class LinearisedSweep:
    """Block amplitudes linearised in displacements, gains and the object field's smooth factor.

    Attributes
    ----------
    normal : Normal
        Normal equations of each of k holograms.
    coupling : (k, 2j + 1, 2c) float
        Elements of the normal matrix between the unknowns of a hologram and the coefficients of
        the log factor: of its magnitude, then of its phase.
    field_matrix : (k, c, c) float
        Normal matrix of the coefficients, of weighted holograms: of the magnitude as of the phase.
    field_gradient : (k, 2c) float
        Negative gradient, of weighted holograms.
    """

    normal: Normal
    coupling: Array
    field_matrix: Array
    field_gradient: Array


def smooth_functions(x_m: Array, y_m: Array) -> Array:
    """Return Legendre polynomials (n, c) at points (n,) of the reed; the first is constant."""
    x, y = (2 * (at - at.min()) / max(float(np.ptp(at)), 1e-12) - 1 for at in (x_m, y_m))
    along, across = (np.polynomial.legendre.legvander(at, _DEGREE) for at in (x, y))
    return np.stack([along[:, i] * across[:, j] for i, j in _degrees()], axis=1)


def _degrees() -> list[tuple[int, int]]:
    """Return the degrees in x and y of the smooth functions."""
    return [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]


def of_low_degree(degree: int) -> IndexArray:
    """Return which parameters of the common-mode error have a total degree of 1 up to `degree`."""
    low = np.array([c for c, (i, j) in enumerate(_degrees()) if 0 < i + j <= degree])
    # The constant of the phase is no parameter.
    return np.concatenate([low, len(_degrees()) - 1 + low])


def linearise(
    problem: Problem,
    smooth: Array,
    object_field: ComplexArray,
    a: ComplexArray,
    gain: Array,
    weight: Array,
) -> LinearisedSweep:
    """Linearise all block amplitudes in the object field, amplitudes and log gains.

    Parameters
    ----------
    problem : Problem
        In double precision: along flat directions, the effects of object field and displacement
        cancel to one part in a million.
    smooth : (n, c) float
        See `smooth_functions`.
    object_field : (n,) or (k, n) complex
    a : (k, j) complex
        Amplitudes.
    gain : (k,) float
        Log gains.
    weight : (k,) float
        Weight of each hologram in the equations of the object field.
    """
    functions, count = problem.functions, smooth.shape[1]
    size = functions.shape[1]
    products = (functions[:, :, None] * smooth[:, None, :]).reshape(len(functions), -1)
    pairs = (smooth[:, :, None] * smooth[:, None, :]).reshape(len(smooth), -1)
    normal = Normal.empty(len(a), size)
    coupling = np.zeros((len(a), 2 * size + 1, 2 * count))
    field_matrix = np.zeros((len(a), count, count))

    def fill(some: slice) -> tuple[Array, Array]:
        steps = np.arange(len(a))[some]
        here, others = fill_normal(normal, some, problem, object_field, steps, a[some], gain[some])
        first = _field_terms(here, products, count, weight[some])
        coupling[some, :-1] = first.coupling
        coupling[some, -1, :count] = first.shown @ smooth
        power = weight[some, None] * first.shown
        louder, turned = first.louder, first.turned
        free = np.zeros((len(steps), count, count))
        for other in others:
            trust = weight[some] * other.present
            seen = _field_terms(other.here, products, count, trust)
            # Brightness and phase of these holograms are free: they are eliminated.
            common = (other.present[:, None] * seen.shown) @ smooth
            eliminated = common / other.known[:, None]
            coupling[some, :-1] += other.present[:, None, None] * seen.coupling
            coupling[some, :-1, :count] -= other.of_gain[:, :, None] * eliminated[:, None]
            coupling[some, :-1, count:] -= other.of_phase[:, :, None] * eliminated[:, None]
            free += (weight[some, None] * common)[:, :, None] * eliminated[:, None]
            power, louder = power + trust[:, None] * seen.shown, louder + seen.louder
            turned = turned + seen.turned
        field_matrix[some] = (power @ pairs).reshape(free.shape) - free
        return louder, turned

    parts = zip(*map_threads(fill, len(a)), strict=True)
    field_gradient = np.concatenate([np.concatenate(each) @ smooth for each in parts], axis=1)
    return LinearisedSweep(normal, coupling, field_matrix, field_gradient)


@dataclass(frozen=True)
class _FieldTerms:
    """Contribution of one sideband to the equations of the object field.

    Attributes
    ----------
    coupling : (s, 2j, 2c) float
        Elements of the normal matrix between amplitudes and coefficients of the log factor.
    shown : (s, n) float
        Power of the block amplitudes.
    louder, turned : (s, n) float
        Negative gradients of log magnitude and phase, of weighted holograms.
    """

    coupling: Array
    shown: Array
    louder: Array
    turned: Array


def _field_terms(here: Local, products: Array, count: int, weight: Array) -> _FieldTerms:
    """Compute the contribution of a sideband.

    `products` (n, j c) are the functions times the c smooth functions.
    """
    square = (here.gain**2).astype(float)
    power = square * here.power
    rows = (
        here.uu * here.u + here.vu * here.v, here.vu * here.u - here.uu * here.v,
        here.uv * here.u + here.vv * here.v, here.vv * here.u - here.uv * here.v,
    )  # fmt: skip
    # One product: its time is that of reading the products of functions.
    blocks = np.concatenate([power * by for by in rows]) @ products
    # From (2, 2, s, j c) to amplitudes, then coefficients of magnitude and phase.
    blocks = blocks.reshape(2, 2, len(square), -1, count).transpose(2, 0, 3, 1, 4)
    pulled = weight[:, None] * here.gain
    return _FieldTerms(
        coupling=blocks.reshape(len(square), -1, 2 * count),
        shown=square * (here.u * here.u + here.v * here.v) * here.power,
        louder=pulled * (here.u * here.residual_u + here.v * here.residual_v),
        turned=pulled * (here.u * here.residual_v - here.v * here.residual_u),
    )


def field_factor(smooth: Array, move: Array) -> NDArray[np.complex64]:
    """Return the smooth factor (..., n) of the object field.

    Parameters
    ----------
    smooth : (n, c) float
        See `smooth_functions`.
    move : (..., 2c - 1) float
        Coefficients of its logarithm: of the magnitude, then of the phase without the constant,
        which belongs to the holograms and is arbitrary.
    """
    factor: NDArray[np.complex64] = np.exp(log_field_factor(smooth, move)).astype(np.complex64)
    return factor


def log_field_factor(smooth: Array, move: Array) -> ComplexArray:
    """Return the logarithm (..., n) of `field_factor`."""
    count = smooth.shape[1]
    factor: ComplexArray = move[..., :count] @ smooth.T + 1j * (move[..., count:] @ smooth[:, 1:].T)
    return factor


@dataclass(frozen=True)
class FieldStep:
    """A Newton step of the object field's factor and of all holograms.

    Attributes
    ----------
    move : (q,) float
        See `field_factor`.
    holograms : (k, 2j + 1) float
        Changes of amplitudes and log gains.
    common_mode : CommonModeError
        Uncertainty of the factor and its effect on the displacements.
    linear : LinearisedSweep
        The equations that were solved.
    """

    move: Array
    holograms: Array
    common_mode: CommonModeError
    linear: LinearisedSweep


def field_step(
    linear: LinearisedSweep, held: Array, x: Array, weight: Array, *, common: bool = True
) -> FieldStep:
    """Solve for the change of the object field's factor and of all holograms.

    Parameters
    ----------
    linear : LinearisedSweep
    held : (2j + 1, 2j + 1) float
        Half the prior precision of amplitudes and log gains around 0.
    x : (k, 2j + 1) float
        Amplitudes (real, then imaginary parts) and log gains.
    weight : (k,) float
        As in `linearise`.
    common : bool
        Whether the factor changes; if not, holograms alone do.
    """
    count = linear.field_gradient.shape[1] // 2
    kept = np.delete(np.arange(2 * count), count)
    coupling = linear.coupling[:, :, kept]
    field_matrix = np.zeros((len(coupling), 2 * count, 2 * count))
    for half in (slice(count), slice(count, None)):
        field_matrix[:, half, half] = linear.field_matrix
    pull = linear.normal.gradient - x @ held
    reply = np.linalg.solve(
        linear.normal.matrix + held, np.concatenate([coupling, pull[..., None]], axis=2)
    )
    response, alone = reply[:, :, :-1], reply[:, :, -1]
    schur = field_matrix[:, kept][:, :, kept] - weight[:, None, None] * (
        coupling.swapaxes(1, 2) @ response
    )
    force = linear.field_gradient[:, kept] - np.einsum("kxc,kx,k->kc", coupling, alone, weight)
    # Half the precision: the misfit, of noise of variance 1, is half of χ².
    common_mode = CommonModeError(-response[:, :-1], schur + schur.swapaxes(1, 2), 2 * force)
    held_back = 0.5 * common_mode.whole + 0.5 * _STEP**-2 * np.eye(len(kept))
    found = np.linalg.solve(held_back, force.sum(axis=0))
    move = found if common else np.zeros_like(found)
    return FieldStep(move, alone - response @ move, common_mode, linear)
