"""Metamodels: a reed's frequencies as formulas in E_L and G_LT, fitted to computed modes.

They give their derivatives, and take whole populations at once.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from holography.arrays import Array

# Exponents of Eq. 1, for moduli in MPa.
EXPONENT_E_L, EXPONENT_G_LT = -0.66643, 0.7627
# Zero of the paper's cent scale, F6.
REFERENCE_HZ = 1396.9


class Metamodel(Protocol):
    """Frequencies in cents above F6, and how they follow the moduli.

    Attributes
    ----------
    modes : tuple of str
        m names.
    """

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes computed, in order."""

    def evaluate(self, E_L_pa: Array, G_LT_pa: Array) -> tuple[Array, Array, Array]:
        """Cents, and their derivatives with respect to ln E_L and ln G_LT.

        Parameters
        ----------
        E_L_pa, G_LT_pa : (..., m) float
            Moduli at which each mode is asked for; with Zener cane every mode has its own.

        Returns
        -------
        cents, by_ln_E_L, by_ln_G_LT : (..., m) float
        """


@dataclass(frozen=True)
class Equation1:
    """The paper's Eq. 1: quadratic in ``E_p = E_L^-0.66643`` and ``G_p = G_LT^0.7627``, MPa.

    Attributes
    ----------
    modes : tuple of str
    coefficients : (m, 6) float
        a_{m,0} … a_{m,5}: of 1, E_p, G_p, E_p·G_p, E_p², G_p².
    """

    modes: tuple[str, ...]
    coefficients: Array

    def evaluate(self, E_L_pa: Array, G_LT_pa: Array) -> tuple[Array, Array, Array]:
        """See `Metamodel.evaluate`."""
        E, G = _powers(E_L_pa, G_LT_pa)
        a0, a1, a2, a3, a4, a5 = self.coefficients.T
        by_E, by_G = a1 + a3 * G + 2 * a4 * E, a2 + a3 * E + 2 * a5 * G
        cents = a0 + E * (a1 + a3 * G + a4 * E) + G * (a2 + a5 * G)
        return cents, EXPONENT_E_L * E * by_E, EXPONENT_G_LT * G * by_G


def _powers(E_L_pa: Array, G_LT_pa: Array) -> tuple[Array, Array]:
    E, G = 1e-6 * np.asarray(E_L_pa), 1e-6 * np.asarray(G_LT_pa)
    return E**EXPONENT_E_L, G**EXPONENT_G_LT


def fit_equation_1(
    modes: tuple[str, ...], E_L_pa: Array, G_LT_pa: Array, cents: Array
) -> Equation1:
    """Fit Eq. 1 to computed modes by least squares.

    Parameters
    ----------
    E_L_pa, G_LT_pa : (n,) float
        The network of materials, see `paper_network_pa`.
    cents : (n, m) float
        Above F6.
    """
    E, G = _powers(E_L_pa, G_LT_pa)
    terms = np.stack([np.ones_like(E), E, G, E * G, E**2, G**2], axis=1)
    # The terms differ by ten powers of ten: scaled, the normal matrix stays well conditioned.
    scale = np.abs(terms).max(axis=0)
    scaled = np.linalg.lstsq(terms / scale, cents, rcond=None)[0]
    return Equation1(modes, (scaled / scale[:, None]).T)


def paper_network_pa() -> tuple[Array, Array]:
    """E_L and G_LT, (92,) each, of the network that Eq. 1 was fitted on.

    The text gives the number and the ranges, 8000 to 17000 and 800 to 1700 MPa. 10 × 10 values
    less the corners in which one modulus is at an end of its range and the other at or next to an
    end, two at each corner, make 92.
    """
    E, G = np.meshgrid(np.linspace(8e9, 17e9, 10), np.linspace(0.8e9, 1.7e9, 10), indexing="ij")
    kept = np.ones(E.shape, dtype=bool)
    for i in (0, -1):
        for j in ((0, 1), (-2, -1)):
            kept[i, j] = False
    return E[kept], G[kept]
