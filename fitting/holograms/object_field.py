"""What of the light cannot be told from vibration: a smooth factor that all holograms share.

The phasors are ``A c_k F(u_k)``. Where the reed is calm, ``F(u) = u/2``: light that is brighter by
a smooth factor and displacements that are smaller by it look the same. Fringes tell the magnitude
of that factor but never its phase, for ``F(u e^{iθ}) = F(u) e^{iθ}``. So light and displacements,
found in turns, settle slowly, and what they settle at is one answer of many. Here the factor is
found by one Newton step in which the displacements of all holograms follow; and what it may still
be is told to those who know more of displacements: that modes have real shapes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.linearisation import Local
from fitting.holograms.problem import (
    Normal,
    Problem,
    fill_normal,
)
from fitting.parallel.threads import map_threads

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

# Total degree of the polynomials in x and y that the factor's logarithm is made of.
_DEGREE = 6
# Prior standard deviation of each of their coefficients, in nepers or rad: only against what the
# data do not tell at all.
_LOOSE = 1.0
# ... and of a step of theirs: along what data do not tell the factor stays where it is.
_STEP = 0.01


@dataclass(frozen=True)
class SharedError:
    """By how much all displacements are off together if the light is not what it was taken for.

    Attributes
    ----------
    response : (k, 2j, q) float
        Change of amplitudes (real, then imaginary parts) of every hologram by each of q freedoms.
    precision : (q, q) float
        Inverse covariance of the freedoms.
    """

    response: Array
    precision: Array


@dataclass(frozen=True)
class Linear:
    """Phasors linearised around displacements, gains and the light's smooth factor.

    Attributes
    ----------
    normal : Normal
        Equations of each of k holograms, by real and imaginary parts of amplitudes, log gain.
    coupling : (k, 2j + 1, 2c) float
        Of these with the log of the factor: its magnitude, then its phase.
    light_matrix, light_gradient : (2c, 2c), (2c,) float
        Equations of that, holograms weighted.
    """

    normal: Normal
    coupling: Array
    light_matrix: Array
    light_gradient: Array


def smooth_functions(x_m: Array, y_m: Array) -> Array:
    """Polynomials (n, c) at points (n,) of the reed, the first of them constant."""
    x, y = (2 * (at - at.min()) / max(float(np.ptp(at)), 1e-12) - 1 for at in (x_m, y_m))
    along, across = (np.polynomial.legendre.legvander(at, _DEGREE) for at in (x, y))
    return np.stack(
        [along[:, i] * across[:, j] for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)],
        axis=1,
    )


def linearise(
    problem: Problem, smooth: Array, light: Complex, a: Complex, gain: Array, weight: Array
) -> Linear:
    """Linearise all phasors around light (n,), amplitudes (k, j) and log gains (k,).

    Parameters
    ----------
    problem : Problem
        In double precision: along flat directions light and displacements cancel to a millionth.
    smooth : (n, c) float
        What the log of the light's factor is made of.
    weight : (k,) float
        Of each hologram in the equations of the light.
    """
    functions, count = problem.functions, smooth.shape[1]
    size = functions.shape[1]
    power = (light.real**2 + light.imag**2).astype(float)[:, None]
    products = ((power * functions)[:, :, None] * smooth[:, None, :]).reshape(len(functions), -1)
    normal = Normal.empty(len(a), size)
    coupling = np.zeros((len(a), 2 * size + 1, 2 * count))

    def fill(some: slice) -> tuple[Array, Array, Array, Array]:
        steps = np.arange(len(a))[some]
        here, others = fill_normal(normal, some, problem, light, steps, a[some], gain[some])
        first = _with_light(here, products, count, weight[some])
        coupling[some, :-1] = first.coupling
        coupling[some, -1, :count] = first.shown @ smooth
        power, louder, turned = weight[some] @ first.shown, first.louder, first.turned
        free = np.zeros((count, count))
        for other in others:
            trust = weight[some] * other.present
            seen = _with_light(other.here, products, count, trust)
            # Brightness and phase of these holograms are free; they take off what they may be.
            common = (other.present[:, None] * seen.shown) @ smooth
            told = common / other.known[:, None]
            coupling[some, :-1] += other.present[:, None, None] * seen.coupling
            coupling[some, :-1, :count] -= other.of_gain[:, :, None] * told[:, None]
            coupling[some, :-1, count:] -= other.of_phase[:, :, None] * told[:, None]
            free += (weight[some, None] * common).T @ told
            power, louder = power + trust @ seen.shown, louder + seen.louder
            turned = turned + seen.turned
        return power, louder, turned, free

    parts = map_threads(fill, len(a))
    shown, louder, turned, free = (np.sum(each, axis=0) for each in zip(*parts, strict=True))
    light_matrix = np.kron(np.eye(2), smooth.T @ (shown[:, None] * smooth) - free)
    light_gradient = np.concatenate([louder @ smooth, turned @ smooth])
    return Linear(normal, coupling, light_matrix, light_gradient)


@dataclass(frozen=True)
class _WithLight:
    """What phasors of one sideband tell of the light.

    Attributes
    ----------
    coupling : (s, 2j, 2c) float
        Of amplitudes with the log of the factor.
    shown : (s, n) float
        Power of the phasors.
    louder, turned : (n,) float
        Pulls at magnitude and phase, holograms weighted.
    """

    coupling: Array
    shown: Array
    louder: Array
    turned: Array


def _with_light(here: Local, products: Array, count: int, weight: Array) -> _WithLight:
    """`products` (n, j c) of functions and c parts of the factor are times the light's power."""
    square = (here.gain**2).astype(float)
    rows = (
        (here.uu * here.u + here.vu * here.v, here.vu * here.u - here.uu * here.v),
        (here.uv * here.u + here.vv * here.v, here.vv * here.u - here.uv * here.v),
    )
    blocks = np.array([[square * (by @ products) for by in row] for row in rows])
    # From (2, 2, s, j c) to amplitudes, then coefficients of magnitude and phase.
    blocks = blocks.reshape(2, 2, len(square), -1, count).transpose(2, 0, 3, 1, 4)
    pulled = weight[:, None] * here.gain
    return _WithLight(
        coupling=blocks.reshape(len(square), -1, 2 * count),
        shown=square * (here.u * here.u + here.v * here.v) * here.power,
        louder=np.sum(pulled * (here.u * here.left_u + here.v * here.left_v), axis=0),
        turned=np.sum(pulled * (here.u * here.left_v - here.v * here.left_u), axis=0),
    )


def light_factor(smooth: Array, move: Array) -> NDArray[np.complex64]:
    """Factor (n,) of the light.

    Parameters
    ----------
    smooth : (n, c) float
        See `smooth_functions`.
    move : (2c - 1,) float
        Coefficients of its logarithm: of the magnitude, then of the phase without its constant,
        which is that of the holograms and arbitrary.
    """
    factor: NDArray[np.complex64] = np.exp(log_light_factor(smooth, move)).astype(np.complex64)
    return factor


def log_light_factor(smooth: Array, move: Array) -> Complex:
    """Logarithm (n,) of `light_factor`."""
    count = smooth.shape[1]
    factor: Complex = smooth @ move[:count] + 1j * (smooth[:, 1:] @ move[count:])
    return factor


@dataclass(frozen=True)
class LightStep:
    """A Newton step of the light's factor, and of what follows it.

    Attributes
    ----------
    move : (q,) float
        See `light_factor`.
    holograms : (k, 2j + 1) float
        Changes of amplitudes and log gains.
    shared : SharedError
        What may be added to it at no cost that the data would notice.
    linear : Linear
        What it was found from.
    """

    move: Array
    holograms: Array
    shared: SharedError
    linear: Linear


def light_step(linear: Linear, held: Array, x: Array, weight: Array) -> LightStep:
    """Best change of the light's factor, if the holograms follow.

    Parameters
    ----------
    linear : Linear
    held : (2j + 1, 2j + 1) float
        Prior precision of amplitudes and log gains x (k, 2j + 1) around 0.
    weight : (k,) float
        As in `linearise`.
    """
    count = len(linear.light_gradient) // 2
    kept = np.delete(np.arange(2 * count), count)
    coupling = linear.coupling[:, :, kept]
    pull = linear.normal.gradient - x @ held
    reply = np.linalg.solve(
        linear.normal.matrix + held, np.concatenate([coupling, pull[..., None]], axis=2)
    )
    response, alone = reply[:, :, :-1], reply[:, :, -1]
    schur = linear.light_matrix[np.ix_(kept, kept)] - np.einsum(
        "kxc,kxd,k->cd", coupling, response, weight, optimize=True
    )
    force = linear.light_gradient[kept] - np.einsum(
        "kxc,kx,k->c", coupling, alone, weight, optimize=True
    )
    # Half of it: the misfit, of noise of variance 1, is half of χ².
    schur = 0.5 * (schur + schur.T) + 0.5 * _LOOSE**-2 * np.eye(len(kept))
    move = np.linalg.solve(schur + 0.5 * _STEP**-2 * np.eye(len(kept)), force)
    shared = SharedError(-response[:, :-1], 2 * schur)
    return LightStep(move, alone - response @ move, shared, linear)
