"""What else may be in a hologram, in addition to its sideband."""

import numpy as np
from scipy.special import j0, j1, jv

from fitting.holograms.displacement import explained_amplitudes
from fitting.modal.identify import JointFit
from holography.arrays import Array, ComplexArray

# What may be in a hologram in addition to its sideband, by name.
# The decoy is what the next sideband would be if phases turned the other way: no light does.
TEMPLATES = ("carrier_leak", "sideband_crosstalk", "decorrelation", "decoy")


def templates(fitted: JointFit) -> tuple[ComplexArray, Array]:
    """Amplitudes (4, k) of what else may be in holograms, and their variances.

    What the displacements' own freedoms can take up is left to them.
    """
    found, functions = fitted.displacements, fitted.basis.functions.astype(float)
    u = found.amplitude_rad @ functions.T
    size = np.abs(u)
    unit = u / np.maximum(size, 1e-12)
    lit = np.exp(found.gain)[:, None] * found.object_field
    F, zero, two = unit * j1(size), j0(size), unit**2 * jv(2, size)
    slope_along = 0.5 * (zero - jv(2, size))
    slope_across = np.where(size > 1e-6, j1(size) / np.maximum(size, 1e-12), 0.5)
    explained = explained_amplitudes(fitted.block_amplitudes, fitted.basis, found)
    left = fitted.block_amplitudes.recorded.T - explained
    bright = np.where(found.reached[:, None], np.abs(lit * F) ** 2, 0.0)
    # Of contrast that is lost, the object field of each block takes up the mean of all holograms.
    usual = np.sum(bright * size**2, axis=0) / np.maximum(np.sum(bright, axis=0), 1e-12)
    waves = np.stack([zero, two, -(size**2 - usual) * F, two.conj()]) * lit
    amplitude = np.zeros((len(TEMPLATES), len(u)), complex)
    variance = np.full((len(TEMPLATES), len(u)), np.inf)
    for k in np.flatnonzero(found.reached & np.any(found.amplitude_rad, axis=1)):
        along, across = lit[k] * unit[k] * slope_along[k], 1j * lit[k] * unit[k] * slope_across[k]
        by_real = along * unit[k].real - across * unit[k].imag
        by_imaginary = along * unit[k].imag + across * unit[k].real
        own = [by_real[:, None] * functions, by_imaginary[:, None] * functions]
        columns = np.hstack([*own, np.stack([lit[k] * F[k], *waves[:, k], left[k]], axis=1)])
        amplitude[:, k], variance[:, k] = _beside(_real(columns), 2 * functions.shape[1] + 1)
    # Blocks that share noise know less than as many independent ones.
    shared = variance / fitted.block_amplitudes.independent_fraction
    return amplitude, shared * np.maximum(found.misfit, 1)


def _beside(columns: Array, own: int) -> tuple[ComplexArray, Array]:
    """Amplitudes (t,) of templates, and variances, in addition to a hologram's own parameters.

    Parameters
    ----------
    columns : (2n, c) float
        Real, then imaginary parts: of the freedoms, the templates, and what is left.
    own : int
        How many freedoms there are.
    """
    n = len(columns) // 2
    turned = np.concatenate([-columns[n:, own:-1], columns[:n, own:-1]])
    columns = np.hstack([columns, turned])
    gram = columns.T @ columns
    mine = gram[:own, :own] + 1e-9 * np.trace(gram[:own, :own]) / own * np.eye(own)
    rest = gram[own:, own:] - gram[own:, :own] @ np.linalg.solve(mine, gram[:own, own:])
    count = len(TEMPLATES)
    which = [t for t in range(2 * count + 1) if t != count]
    information = rest[np.ix_(which, which)]
    found = np.linalg.solve(information, rest[which, count])
    spread = 0.5 * np.diag(np.linalg.inv(information))
    return found[:count] + 1j * found[count:], spread[:count] + spread[count:]


def _real(columns: ComplexArray) -> Array:
    """Real, then imaginary parts of rows: (n, …) → (2n, …)."""
    return np.concatenate([columns.real, columns.imag], axis=0)
