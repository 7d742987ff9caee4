"""Estimate how much the displacement changes within a block, and what that does to its amplitude.

A block amplitude is the mean of F(u) over the light of a block. Its coordinates are those of the
middle of that light, so that a constant slope of u cancels to first order. To second order, ``½
|F''| Σ_i |∂u/∂x_i|² s_i²`` is left, with the variances s² of the positions of the light, times a
random factor of speckle. It is added to the noise: blocks across which fringes pass say little.
"""

import numpy as np
from scipy.spatial import cKDTree

from fitting.holograms.problem import Problem
from holography.arrays import Array, ComplexArray

# A plane through a block and its eight neighbours gives the slope.
_NEIGHBOURS = 9


def spread_slopes(x_m: Array, y_m: Array, size_m: tuple[float, float], functions: Array) -> Array:
    """Return the slopes (2, n, j) of functions (n, j), times the spread of the light in a block.

    Parameters
    ----------
    x_m, y_m : (n,) float
        Coordinates of the blocks.
    size_m : tuple of float
        Sides of a block along x and y; light fills it evenly.
    functions : (n, j) float
    """
    points = np.stack([x_m, y_m], axis=1)
    count = min(_NEIGHBOURS, len(points))
    _, near = cKDTree(points).query(points, k=count)
    # In units of a side: slopes are then per side.
    apart = (points[near] - points[:, None]) / np.array(size_m)
    planes = np.linalg.pinv(np.concatenate([np.ones((*apart.shape[:2], 1)), apart], axis=2))
    slopes = np.einsum("nip,npj->inj", planes[:, 1:], functions[near], optimize=True)
    # The variance of an even distribution over a side of 1 is 1/12.
    spread: Array = (slopes / np.sqrt(12)).astype(functions.dtype)
    return spread


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
