"""What the displacement does within a block, where it is not that of the block's middle.

A block amplitude is the mean of F(u) over the light of a block, and a resolution cell of the
hologram contains many scatterers with random phases. The amplitude is therefore ``A (F(u) + Σ_i s_i
dF[∂u/∂x_i] + ½ Σ_i d²F[∂u/∂x_i, ∂u/∂x_i])``. The slopes ∂u/∂x_i are over the standard deviation of
where the light of the block comes from, under the window of the sensor. s_i is the mean position of
the scatterers, weighted by their complex fields: a complex number that speckle decides, the same in
all holograms of a sweep, and found from them. Of the third term, speckle leaves a random part of
the same size, which is added to the noise: blocks across which fringes pass say little.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fitting.holograms.linearisation import rows
from fitting.holograms.problem import Problem
from holography.arrays import Array, ComplexArray

# A plane through a block and its eight neighbours gives the slope.
_NEIGHBOURS = 9
# Start of the variance of positions, in units of that of the light of a block, and how often it is
# found again.
_START, _TURNS = 0.1, 4


def spread_slopes(
    x_m: Array,
    y_m: Array,
    size_m: tuple[float, float],
    spread: Array,
    functions: Array,
) -> Array:
    """Return the slopes (2, n, j) of functions (n, j), times the spread of the light in a block.

    Parameters
    ----------
    x_m, y_m : (n,) float
        Coordinates of the blocks.
    size_m : tuple of float
        Sides of a block along x and y.
    spread : (2, n) float
        Standard deviation of where the light of each block comes from, in these sides.
    functions : (n, j) float
    """
    points = np.stack([x_m, y_m], axis=1)
    count = min(_NEIGHBOURS, len(points))
    _, near = cKDTree(points).query(points, k=count)
    # In units of a side: slopes are then per side.
    apart = (points[near] - points[:, None]) / np.array(size_m)
    planes = np.linalg.pinv(np.concatenate([np.ones((*apart.shape[:2], 1)), apart], axis=2))
    slopes = np.einsum("nip,npj->inj", planes[:, 1:], functions[near], optimize=True)
    scaled: Array = (slopes * spread[..., None]).astype(functions.dtype)
    return scaled


def blurring(problem: Problem, a: ComplexArray) -> dict[int, Array]:
    """Return the variances (k, n) that slopes add, over the light's power, of every sideband.

    Parameters
    ----------
    problem : Problem
        Without slopes in it, nothing is added.
    a : (k, j) complex
        Amplitudes.

    Notes
    -----
    F₁'' is −3u/8 near 0, and of F₀ and F₂ it is 1/2 and 1/4 at most there. Far from 0 all oscillate
    with a variance of 1/(π|u|), and so do their second derivatives (Abramowitz & Stegun 9.2.1).
    Where more than that is left, the mean of F over a block has nothing to do with its middle.
    """
    orders = [1, *(side.order for side in problem.others)]
    if problem.slopes is None:
        return {order: np.zeros(problem.real.shape) for order in orders}
    real, imaginary = (np.asarray(part, problem.functions.dtype) for part in (a.real, a.imag))
    change = np.zeros(problem.real.shape, problem.functions.dtype)
    for along in problem.slopes:
        change += np.square(real @ along.T) + np.square(imaginary @ along.T)
    left = np.square(np.minimum(0.5 * change, 1.0))
    u, v = problem.displacement(a)
    squared = np.maximum(u * u + v * v, 1e-12)
    far = 1 / (np.pi * np.sqrt(squared))
    return {n: left * np.minimum(9 / 64 * squared if n == 1 else 0.25, far) for n in orders}


def slope_terms(problem: Problem, a: ComplexArray) -> ComplexArray | None:
    """Return the changes dF[∂u/∂x_i] (2, k, n) of F(u) over the spread of a block's light.

    None if the problem has no slopes.
    """
    if problem.slopes is None:
        return None
    u, v = problem.displacement(a)
    alpha, beta = problem.tensor(u, v)
    terms = []
    for along in problem.slopes:
        p, q = (np.asarray(part, along.dtype) @ along.T for part in (a.real, a.imag))
        bend = beta * (u * p + v * q)
        terms.append(alpha * (p + 1j * q) + bend * (u + 1j * v))
    return np.stack(terms)


@dataclass(frozen=True)
class WithinBlocks:
    """What displacements do to F(u) over the light of each block.

    Attributes
    ----------
    slopes : (2, k, n) complex
        See `slope_terms`.
    bend : (k, n) complex
        See `mean_bend`.
    """

    slopes: ComplexArray
    bend: ComplexArray


def within_blocks(problem: Problem, a: ComplexArray) -> WithinBlocks | None:
    """Return what amplitudes (k, j) do within blocks; None if the problem has no slopes."""
    slopes = slope_terms(problem, a)
    return None if slopes is None else WithinBlocks(slopes, mean_bend(problem, a))


def mean_bend(problem: Problem, a: ComplexArray) -> ComplexArray:
    """Return the change (k, n) of the mean of F(u) over the light of a block.

    It is ``½ Σ_i d²F[∂u/∂x_i, ∂u/∂x_i]``, with the slopes over the spread of the light. From
    ``dF = α 1 + β u uᵀ`` and ``∂β/∂u = γ u`` follows ``d²F[w, w] = 2 β (u·w) w + β |w|² u + γ
    (u·w)² u``. Of a wave with phase k x, a Gaussian spread s leaves exp(−k² s²/2); here
    1/(1 + k² s²/2) is taken, which no large slope turns negative.
    """
    u, v = problem.displacement(a)
    bend: ComplexArray = np.zeros(u.shape, np.complex64)
    if problem.slopes is None:
        return bend
    _, beta = problem.tensor(u, v)
    gamma = problem.bessel.curvature(np.sqrt(u * u + v * v).astype(np.float32))
    change = np.ones_like(u)
    for along in problem.slopes:
        p, q = (np.asarray(part, along.dtype) @ along.T for part in (a.real, a.imag))
        change += 0.5 * (p * p + q * q)
        onto = u * p + v * q
        radial = beta * (p * p + q * q) + gamma * onto * onto
        bend += (0.5 * radial * u + beta * onto * p) + 1j * (0.5 * radial * v + beta * onto * q)
    return bend / change


def speckle_positions(
    problem: Problem,
    within: WithinBlocks | None,
    a: ComplexArray,
    gain: Array,
    field: ComplexArray,
    weight: Array,
) -> ComplexArray | None:
    """Find the mean positions (n, 2) of light from residuals of the first sideband.

    They are in units of the standard deviation of where the light of a block comes from. None if
    the problem has no slopes.

    Parameters
    ----------
    problem : Problem
        Weighted by the variances of its block amplitudes.
    within : WithinBlocks or None
        For the same amplitudes.
    a : (k, j) complex
        Amplitudes.
    gain : (k,) float
        Log gains.
    field : (n,) or (k, n) complex
        Object field.
    weight : (k,) float
        Holograms of a smaller weight count for less.
    """
    if within is None:
        return None
    steps = np.arange(len(a))
    u, v = problem.bessel_vectors(a)
    shown = np.exp(gain)[:, None] * rows(field, steps)
    left = problem.real + 1j * problem.imaginary - shown * (u + 1j * v + within.bend)
    trust = weight[:, None] * problem.weighed(steps, np.ones_like(u))
    columns = shown * within.slopes
    matrix = np.einsum("ikn,jkn,kn->nij", columns.conj(), columns, trust, optimize=True)
    force = np.einsum("ikn,kn,kn->ni", columns.conj(), left, trust, optimize=True)
    variance = _START
    for _ in range(_TURNS):
        covariance = np.linalg.inv(matrix + np.eye(2) / variance)
        position: ComplexArray = np.einsum("nij,nj->ni", covariance, force)
        # Expectation and maximisation: the mean square of what the positions may be.
        unknown = np.trace(covariance, axis1=1, axis2=2).real / 2
        variance = float(np.mean(np.mean(np.abs(position) ** 2, axis=1) + unknown))
    return position


def from_middle(
    problem: Problem,
    within: WithinBlocks | None,
    gain: Array,
    field: ComplexArray,
    positions: ComplexArray | None,
) -> Problem:
    """Return a problem with block amplitudes as they were if light came from the blocks' middle."""
    if within is None:
        return problem
    moved = within.bend
    if positions is not None:
        moved = moved + np.einsum("ikn,ni->kn", within.slopes, positions)
    shown = np.exp(gain)[:, None] * rows(field, np.arange(len(gain)))
    return problem.less(shown * moved)
