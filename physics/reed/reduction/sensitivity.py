"""How a reed's frequencies follow the constants of its cane (paper, Table 3).

Twice: by varying one constant at a time and computing all modes again, as the paper did, and
exactly from the energies of the modes (Rayleigh's quotient is stationary).
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final

import numpy as np

from holography.arrays import Array
from physics.reed.cane.material import (
    STIFFNESS_TERMS,
    Cane,
    stiffness_matrix_pa,
)
from physics.reed.elements.fem import ReedMatrices, projected_stiffness
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.modes import NamedMode, reed_modes

# In the order of Table 3; the first six are moduli, and their sensitivities add to 1/2.
CONSTANTS: Final = ("E_L", "G_LT", "E_T", "G_LR", "E_R", "G_TR", "nu_TR", "nu_LT", "nu_LR")
MODULI: Final = CONSTANTS[:6]
# The 16 modes of Table 3. Its L2 has sensitivities that only our heel mode H1 has.
CLASSES: Final[dict[str, tuple[str, ...]]] = {
    "F": ("F1", "F2", "F3", "F4"),
    "T": ("T1", "T2", "T3", "T4"),
    "X": ("X1", "X2", "X3", "X4", "X5", "X6"),
    "L": ("L1", "H1"),
}
TABLE_3_MODES: Final = tuple(name for names in CLASSES.values() for name in names)
_HIGHEST_HZ = 20.5e3
# Position in the compliance of each constant, and axes of its stress and contraction.
_DIAGONAL = {"E_L": 0, "E_T": 1, "E_R": 2, "G_TR": 3, "G_LR": 4, "G_LT": 5}
_RATIOS = {"nu_LT": (0, 1), "nu_LR": (0, 2), "nu_TR": (1, 2)}


def field_of(constant: str) -> str:
    """Attribute of `Cane` that holds a constant."""
    return constant if constant in _RATIOS else f"{constant}_pa"


def stiffness_slopes_pa(cane: Cane) -> Array:
    """Derivatives (9, 9) of the independent stiffnesses with respect to ln of each constant.

    Rows in the order of `CONSTANTS`, columns in that of `STIFFNESS_TERMS`.
    """
    stiffness = stiffness_matrix_pa(cane)
    compliance = np.linalg.inv(stiffness)
    rows = []
    for constant in CONSTANTS:
        slope = np.zeros((6, 6))
        if constant in _RATIOS:
            i, j = _RATIOS[constant]
            slope[i, j] = slope[j, i] = compliance[i, j]
        else:
            at = _DIAGONAL[constant]
            slope[at, at] = -compliance[at, at]
            # A modulus divides the ratios of the contractions under its own stress, too.
            for i, j in _RATIOS.values():
                if i == at:
                    slope[i, j] = slope[j, i] = -compliance[i, j]
        changed = -stiffness @ slope @ stiffness
        rows.append([changed[int(term[0]) - 1, int(term[1]) - 1] for term in STIFFNESS_TERMS])
    return np.array(rows)


def rayleigh_sensitivities(
    matrices: ReedMatrices, modes: Sequence[NamedMode], cane: Cane
) -> dict[str, Array]:
    """Exact derivatives of ln f with respect to ln of each constant, (9,) by mode.

    Parameters
    ----------
    matrices : ReedMatrices
        Of the mesh on which the modes were computed.
    modes : sequence of NamedMode
    cane : Cane
        With which they were computed.
    """
    answer: dict[str, Array] = {}
    for mode in modes:
        energies = projected_stiffness(matrices, mode.shape[:, :, None])[:, 0, 0]
        # ω² M = K: half the mass-normalised energy per unit of each stiffness, over ω².
        omega2 = (2 * np.pi * mode.frequency_hz) ** 2
        answer[mode.name] = stiffness_slopes_pa(cane) @ energies / (2 * omega2)
    return answer


def one_at_a_time(
    geometry: ReedGeometry,
    cane: Cane,
    level: MeshLevel,
    share: float = 0.1,
    names: Sequence[str] = TABLE_3_MODES,
    done: Callable[[str], None] | None = None,
) -> dict[str, Array]:
    """Relative change of frequency over relative change of each constant, (9,) by mode.

    Every constant is raised and lowered by a share of itself and all modes are computed again:
    ``(f₊ - f₋) / (2 · share · f)``.

    Parameters
    ----------
    geometry : ReedGeometry
    cane : Cane
    level : MeshLevel
    share : float
        0.1 in the paper.
    names : sequence of str
        Modes wanted; those of Table 3.
    done : callable, optional
        Called with the name of each constant when it is done.

    Raises
    ------
    ValueError
        For a share that is not within 0 and 1, if a wanted mode cannot be found, and as
        `reed_modes`.
    """
    if not 0 < share < 1:
        raise ValueError(f"constants changed by {share} of themselves; give a share within 0 and 1")

    def frequencies_hz(changed: Cane) -> Array:
        found = {m.name: m.frequency_hz for m in reed_modes(geometry, changed, level, _HIGHEST_HZ)}
        missing = [name for name in names if name not in found]
        if missing:
            raise ValueError(
                f"no {', '.join(missing)} below {_HIGHEST_HZ:.0f} Hz with {changed}; "
                "change constants by less, or leave the mode out"
            )
        return np.array([found[name] for name in names])

    def slope(constant: str) -> Array:
        name, value = field_of(constant), getattr(cane, field_of(constant))
        high, low = (
            frequencies_hz(replace(cane, **{name: value * factor}))
            for factor in (1 + share, 1 - share)
        )
        if done:
            done(constant)
        return np.asarray((high - low) / (2 * share * middle))

    # SuperLU lets go of the interpreter: two constants at a time take two cores.
    with ThreadPoolExecutor(2) as pool:
        middle = pool.submit(frequencies_hz, cane).result()
        slopes = np.stack(list(pool.map(slope, CONSTANTS)), axis=-1)
    return dict(zip(names, slopes, strict=True))


def class_means(by_mode: Mapping[str, Array]) -> dict[str, Array]:
    """Means over each class of Table 3 and over all its modes ("all"), (9,) each."""
    means = {
        letter: np.mean([by_mode[name] for name in names], axis=0)
        for letter, names in CLASSES.items()
    }
    return {**means, "all": np.mean([by_mode[name] for name in TABLE_3_MODES], axis=0)}
