"""Convergence of the reed's frequencies: ``python -m studies.second_laboratory.convergence``.

Prints the modes below 16 kHz of the paper's reference material, with strips on which nothing moves
(the hardest case: stress is singular at their edges), for coarser and finer meshes, in cents above
the finest. Takes about five minutes and 8 GB.
"""

import resource
import time

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.cane import DENSITY, Cane
from studies.second_laboratory.elements import Solid
from studies.second_laboratory.parameters import Clamp, Thickness
from studies.second_laboratory.reed import lowest_modes
from studies.second_laboratory.shape import Fineness, Thicknesses, plan_mesh

# Table 3 and Table 9 of the paper.
_REFERENCE = Cane(fixed=(14_000.0, 1100.0))
_NAMES = ("F1", "T1", "F2", "T2", "X1", "L1", "T3", "F3", "X2", "X3", "T4")
_MESHES = {
    "default": Fineness(),
    "coarser everywhere": Fineness(4.5, 1.6, 0.2, 5.0, 2),
    "finer vamp and tip": Fineness(vamp_mm=1.8, tip_mm=0.7),
    "gentler grading": Fineness(ratio=2.0),
    "quartic in plan": Fineness(order=4),
    "vamp quartic in depth": Fineness(vamp_order=4),
    "edges 0.05 mm": Fineness(edge_mm=0.05, layers=(0.0, 0.75, 0.95, 0.985, 1.0)),
    "edges 0.025 mm": Fineness(edge_mm=0.025, layers=(0.0, 0.75, 0.95, 0.985, 0.996, 1.0)),
}


def frequencies_hz(fineness: Fineness, cane: Cane = _REFERENCE) -> tuple[int, NDArray[np.float64]]:
    """Return the number of unknowns and the lowest frequencies of the drawing in a vacuum."""
    thickness, clamp = Thicknesses(Thickness()), Clamp()
    solid = Solid(plan_mesh(thickness, clamp, fineness), thickness, fineness)
    elastic = cane.elasticity(1.0, lossy=False).real
    found = lowest_modes(solid.stiffness(elastic), solid.mass(DENSITY * 1e-12), len(_NAMES))
    return solid.ties.shape[1], found[0]


def main() -> None:
    """Print the table."""
    found = {}
    for name, fineness in _MESHES.items():
        start_s = time.process_time()
        unknowns, found[name] = frequencies_hz(fineness)
        spent_s = time.process_time() - start_s
        print(f"{name:<22} {unknowns:>7} unknowns {spent_s:>5.0f} s", flush=True)
    finest = found["edges 0.025 mm"]
    print(f"\n{'cents above the finest':<22}", *(f"{name:>6}" for name in _NAMES))
    for name, hz in found.items():
        print(f"{name:<22}", *(f"{c:>6.1f}" for c in 1200 * np.log2(hz / finest)))
    print(f"{'Hz':<22}", *(f"{hz:>6.0f}" for hz in finest))
    # Errors of edges fall with their size: what is beyond the finest is about its last step.
    step = 1200 * np.log2(found["edges 0.05 mm"] / finest)
    print(f"{'left beyond, at most':<22}", *(f"{c:>6.1f}" for c in step))
    gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"\n{gigabytes:.1f} GB")


if __name__ == "__main__":
    main()
