"""Stiffness error of a coarse mesh: the paper's kind of elements against converged ones."""

from collections.abc import Callable

import numpy as np

from physics.reed.cache import Arrays, kept
from physics.reed.cane.material import Cane
from physics.reed.elements.mesh import STANDARD
from physics.reed.elements.tetrahedra import PLAIN, tetrahedral_reed
from physics.reed.geometry import ReedGeometry
from physics.reed.modes import reed_modes

# The paper's size, and half of it at the tip: on tetrahedra of 2 mm everywhere modes beyond T3 lose
# their names.
_SIZE_M, _TIP_SIZE_M = 2e-3, 1e-3
_HIGHEST_HZ = 22.5e3


def coarse_mesh_cents(
    geometry: ReedGeometry, cane: Cane, announce: Callable[[str], None] | None = None
) -> dict[str, float]:
    """Cents by which quadratic tetrahedra of 2 mm raise each mode, by name; kept for the next time.

    Parameters
    ----------
    geometry : ReedGeometry
    cane : Cane
    announce : callable, optional
        Called with what is being waited for, if anything.

    Raises
    ------
    ImpossibleReedError
        As `tetrahedra.tetrahedral_reed`.
    """

    def build() -> dict[str, float]:
        if announce:
            announce("solving a coarse mesh of the reed (kept for the next time)")
        named = {
            level: reed_modes(geometry, cane, level, _HIGHEST_HZ) for level in (PLAIN, STANDARD)
        }
        coarse = tetrahedral_reed(
            geometry, cane, named[PLAIN], _SIZE_M, tip_size_m=_TIP_SIZE_M, level=PLAIN
        )
        fine_hz = {mode.name: mode.frequency_hz for mode in named[STANDARD]}
        return {
            mode.name: float(1200 * np.log2(mode.frequency_hz / fine_hz[mode.name]))
            for mode in coarse.modes
            if mode.name in fine_hz
        }

    def to_arrays(cents: dict[str, float]) -> Arrays:
        return {"names": np.array(list(cents)), "cents": np.array(list(cents.values()))}

    def restored(arrays: Arrays) -> dict[str, float]:
        return dict(zip(arrays["names"].tolist(), arrays["cents"].tolist(), strict=True))

    return kept("coarse", (geometry, cane), build, to_arrays, restored, announce)
