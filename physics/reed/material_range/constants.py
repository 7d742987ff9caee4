"""Elastic constants of many canes: their order, box, possible values and stiffness terms."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from holography.arrays import Array, Mask
from physics.reed.cane.material import STIFFNESS_TERMS, Cane

# Elastic constants of a cane, in the order of `Cane`: six moduli, three Poisson ratios.
CONSTANTS = tuple(field.name for field in fields(Cane))[:-1]
MODULI = CONSTANTS[:6]
# What frequencies are derived by, in the order of `ReedModes.slopes`.
SLOPES = (
    *(f"ln {name}" for name in MODULI),
    *CONSTANTS[6:],
    "ln density_kg_m3",
    "thickness_offset_m",
)
# Positions in the stiffness matrix of `STIFFNESS_TERMS` that couple normal strains.
_NORMAL = tuple((int(term[0]) - 1, int(term[1]) - 1) for term in STIFFNESS_TERMS[:6])
# The remaining terms are the shear moduli TR, LR and LT.
_SHEAR = tuple(MODULI.index(name) for name in ("G_TR_pa", "G_LR_pa", "G_LT_pa"))
_POISSON = ((0, 1), (0, 2), (1, 2))
# No solid is softer or stiffer, and no reed as thick as this; beyond, numbers would overflow.
_MODULI_PA = (1.0, 1e15)


@dataclass(frozen=True)
class MaterialBox:
    """Range (lowest, highest) of every input that a basis answers for.

    The density may be any up to `material_snapshots.heaviest_kg_m3`; of heavier cane the highest
    modes are rough.

    Attributes
    ----------
    E_L_pa … nu_TR : (float, float)
        As in `Cane`.
    thickness_offset_m : (float, float)
        Added to the offset of the reed's geometry.
    """

    E_L_pa: tuple[float, float] = (7e9, 21e9)
    E_T_pa: tuple[float, float] = (480e6 / 1.33, 480e6 * 1.33)
    E_R_pa: tuple[float, float] = (480e6 / 1.33, 480e6 * 1.33)
    G_LT_pa: tuple[float, float] = (0.45e9, 2e9)
    G_LR_pa: tuple[float, float] = (1200e6 / 1.33, 1200e6 * 1.33)
    G_TR_pa: tuple[float, float] = (1200e6 / 1.33, 1200e6 * 1.33)
    nu_LT: tuple[float, float] = (0.15, 0.30)
    nu_LR: tuple[float, float] = (0.15, 0.30)
    nu_TR: tuple[float, float] = (0.15, 0.30)
    thickness_offset_m: tuple[float, float] = (-20e-6, 20e-6)


def constants_of(canes: Sequence[Cane]) -> Array:
    """Elastic constants (n, 9) of canes, in the order of `CONSTANTS`."""
    return np.array([astuple(cane)[:9] for cane in canes], dtype=float).reshape(-1, 9)


def within_box(box: MaterialBox, constants: Array, thickness_offset_m: Array) -> Mask:
    """Which reeds (n,) of constants (n, 9) and offsets (n,) lie in a box, its ends included."""
    limits = np.asarray(astuple(box))
    inputs = np.column_stack([constants, thickness_offset_m])
    # The ends of the box are often computed: a rounding error is not outside.
    slack = 1e-9 * np.diff(limits)[:, 0]
    inside = (inputs >= limits[:, 0] - slack) & (inputs <= limits[:, 1] + slack)
    return np.asarray(inside.all(axis=1))


def possible_canes(constants: Array) -> Mask:
    """Which canes (n,) of constants (n, 9) store energy however they are strained."""
    moduli, (softest, stiffest) = constants[:, :6], _MODULI_PA
    solid = np.all((moduli >= softest) & (moduli <= stiffest), axis=1)
    solid &= np.isfinite(constants).all(axis=1)
    # A stand-in keeps the arithmetic quiet.
    safe = np.where(solid[:, None], constants, np.asarray(astuple(Cane())[:9]))
    E, nu = safe[:, :3], safe[:, 6:]
    # Minors of the compliance matrix, scaled to a unit diagonal.
    c = np.stack([nu[:, k] * np.sqrt(E[:, j] / E[:, i]) for k, (i, j) in enumerate(_POISSON)])
    determinant = 1 - 2 * np.prod(c, axis=0) - np.sum(c**2, axis=0)
    return np.asarray(solid & (np.abs(c) < 1).all(axis=0) & (determinant > 0))


def terms_and_slopes(constants: Array) -> tuple[Array, Array]:
    """Nine stiffnesses (n, 9), and their derivatives (n, 9, 9) by ln moduli and Poisson ratios."""
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
