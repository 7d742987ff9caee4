"""Linear orthotropic elasticity of cane, grain along x (L), tangential y (T), radial z (R)."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from holography.arrays import Array
from physics.errors import ImpossibleReedError

# Voigt positions (1-based in the literature) of the nine independent stiffnesses.
STIFFNESS_TERMS = ("11", "22", "33", "12", "13", "23", "44", "55", "66")
# Positions in the stiffness matrix of those that couple normal strains.
_NORMAL = tuple((int(term[0]) - 1, int(term[1]) - 1) for term in STIFFNESS_TERMS[:6])
# The others are the shear moduli TR, LR and LT: their positions among the constants of a `Cane`.
_SHEAR = (5, 4, 3)
# Axes of each Poisson ratio.
_POISSON = ((0, 1), (0, 2), (1, 2))


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


def constants_of(canes: Sequence[Cane]) -> Array:
    """Elastic constants (n, 9) of canes, in the order of `Cane`."""
    return np.array([astuple(cane)[:9] for cane in canes], dtype=float).reshape(-1, 9)


def _require_possible(constants: Array) -> None:
    """Refuse constants (n, 9) of no material.

    Raises
    ------
    ImpossibleReedError
    """
    moduli = constants[:, :6]
    if not np.all((moduli > 0) & (moduli < np.inf)):
        raise ImpossibleReedError("moduli of cane must be positive and finite at every frequency")
    E, nu = constants[:, :3], constants[:, 6:]
    # Ratios of axes i < j are -S_ij E_i, so these are the squares of the correlations of strains.
    lt, lr, tr = (nu[:, k] ** 2 * E[:, j] / E[:, i] for k, (i, j) in enumerate(_POISSON))
    mixed = 2 * nu.prod(axis=1) * E[:, 2] / E[:, 0]
    if not np.all((lt < 1) & (1 - lt - lr - tr - mixed > 0)):
        raise ImpossibleReedError(
            f"the Poisson ratios {constants[0, 6:].tolist()} make a material that yields energy"
        )


def terms_and_slopes(constants: Array) -> tuple[Array, Array]:
    """Nine stiffnesses (n, 9), and their derivatives (n, 9, 9) by ln moduli and Poisson ratios.

    Raises
    ------
    ImpossibleReedError
        If constants (n, 9) do not make a positive definite material.
    """
    _require_possible(constants)
    count = len(constants)
    E, nu = constants[:, :3], constants[:, 6:]
    compliance = np.zeros((count, 3, 3))
    by_constants = np.zeros((count, 6, 3, 3))
    for i in range(3):
        compliance[:, i, i] = 1 / E[:, i]
        by_constants[:, i, i, i] = -1 / E[:, i]
    for k, (i, j) in enumerate(_POISSON):
        for a, b in ((i, j), (j, i)):
            compliance[:, a, b] = -nu[:, k] / E[:, i]
            by_constants[:, i, a, b] = nu[:, k] / E[:, i]
            by_constants[:, 3 + k, a, b] = -1 / E[:, i]
    stiffness = np.linalg.inv(compliance)
    changes = -stiffness[:, None] @ by_constants @ stiffness[:, None]
    shear = constants[:, _SHEAR]
    rows, columns = np.transpose(_NORMAL)
    terms = np.concatenate([stiffness[:, rows, columns], shear], axis=1)
    slopes = np.zeros((count, 9, 9))
    normal = changes[:, :, rows, columns].transpose(0, 2, 1)
    slopes[:, :6, :3], slopes[:, :6, 6:] = normal[..., :3], normal[..., 3:]
    for row, column in enumerate(_SHEAR):
        slopes[:, 6 + row, column] = shear[:, row]
    return terms, slopes
