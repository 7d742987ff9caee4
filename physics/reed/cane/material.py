"""Linear orthotropic elasticity of cane, grain along x (L), tangential y (T), radial z (R)."""

from dataclasses import dataclass

import numpy as np

from holography.arrays import Array
from physics.errors import ImpossibleReedError

# Voigt positions (1-based in the literature) of the nine independent stiffnesses.
STIFFNESS_TERMS = ("11", "22", "33", "12", "13", "23", "44", "55", "66")


@dataclass(frozen=True)
class Cane:
    """Elastic constants and density; the defaults are the paper's reference material.

    Attributes
    ----------
    E_L_pa, E_T_pa, E_R_pa, G_LT_pa, G_LR_pa, G_TR_pa : float
        Young and shear moduli.
    nu_LT, nu_LR, nu_TR : float
        Poisson ratios; ν_ij is the contraction along j under stress along i.
    density_kg_m3 : float
    """

    E_L_pa: float = 14000e6
    E_T_pa: float = 480e6
    E_R_pa: float = 480e6
    G_LT_pa: float = 1100e6
    G_LR_pa: float = 1200e6
    G_TR_pa: float = 1200e6
    nu_LT: float = 0.22
    nu_LR: float = 0.22
    nu_TR: float = 0.22
    density_kg_m3: float = 520.0


def stiffness_matrix_pa(cane: Cane) -> Array:
    """Stiffness matrix (6, 6) in Voigt order xx, yy, zz, yz, xz, xy (engineering shears).

    Raises
    ------
    ImpossibleReedError
        If the constants do not make a positive definite material.
    """
    E, nu = (cane.E_L_pa, cane.E_T_pa, cane.E_R_pa), (cane.nu_LT, cane.nu_LR, cane.nu_TR)
    compliance = np.zeros((6, 6))
    moduli = (*E, cane.G_TR_pa, cane.G_LR_pa, cane.G_LT_pa)
    if not all(0 < value < np.inf for value in (*moduli, cane.density_kg_m3)):
        raise ImpossibleReedError(
            f"moduli and density of cane must be positive and finite, got {cane}"
        )
    np.fill_diagonal(compliance, 1 / np.asarray(moduli))
    for (i, j), ratio in zip(((0, 1), (0, 2), (1, 2)), nu, strict=True):
        compliance[i, j] = compliance[j, i] = -ratio / E[i]
    if np.linalg.eigvalsh(compliance[:3, :3])[0] <= 0:
        raise ImpossibleReedError(
            f"the Poisson ratios of {cane} make a material that yields energy"
        )
    return np.linalg.inv(compliance)


def stiffness_terms_pa(cane: Cane) -> Array:
    """Nine independent stiffnesses (9,), in the order of `STIFFNESS_TERMS`."""
    matrix = stiffness_matrix_pa(cane)
    return np.array([matrix[int(term[0]) - 1, int(term[1]) - 1] for term in STIFFNESS_TERMS])
