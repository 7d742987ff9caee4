"""Modes of a reed of viscoelastic cane from a basis over materials."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import ViscoelasticCane, storage_modulus_pa
from physics.reed.elements.fem import Symmetry
from physics.reed.material_range.basis import SPARE_CANDIDATES, MaterialBasis, ReedModes, all_modes
from physics.reed.material_range.constants import CONSTANTS, constants_of, within_box
from physics.reed.modes import HIGHEST_HZ

_SETTLED_CENTS = 1e-4
_MOST_ITERATIONS = 50


def settled_modes(
    basis: MaterialBasis,
    constants: Cane,
    cane: ViscoelasticCane,
    thickness_offset_m: float = 0.0,
) -> ReedModes:
    """Named modes of one reed, each with the storage moduli of its own frequency.

    The j-th mode of a symmetry is where the j-th eigenfrequency of the reed with the moduli of a
    frequency is that frequency itself (see `modes.viscoelastic_modes`). All are sought at once,
    as reeds that differ in these moduli, and named by shape at the end.

    Parameters
    ----------
    basis : MaterialBasis
    constants : Cane
        Supplies all constants but E_L and G_LT.
    cane : ViscoelasticCane
        Supplies these two.
    thickness_offset_m : float

    Returns
    -------
    ReedModes
        Of one reed, without slopes; within the box if it is with the moduli of every mode.

    Raises
    ------
    ImpossibleReedError
        If the reed cannot be, or the iteration does not settle.
    """
    hz, similarity = np.empty((2, 1, len(basis.names)))
    for symmetry, half in basis.halves.items():
        places = [basis.names.index(name) for name in half.names]
        settled_hz, shapes = _settled(basis, symmetry, constants, cane, thickness_offset_m)
        shares = (half.named_shapes.T @ shapes) ** 2
        chosen = linear_sum_assignment(shares, maximize=True)[1]
        hz[0, places] = settled_hz[chosen]
        similarity[0, places] = shares[np.arange(len(chosen)), chosen]
    offset_m = np.full(len(basis.names), thickness_offset_m)
    within = within_box(basis.box, _constants_at(constants, cane, hz[0]), offset_m).all()
    return ReedModes(basis.names, hz, None, similarity, np.array([within]))


def _settled(
    basis: MaterialBasis,
    symmetry: Symmetry,
    constants: Cane,
    cane: ViscoelasticCane,
    thickness_offset_m: float,
) -> tuple[Array, Array]:
    """Frequencies (j,) and shapes (c, j) of the lowest modes of one symmetry."""
    size, names = basis.halves[symmetry].named_shapes.shape
    numbers = np.arange(min(size, names + SPARE_CANDIDATES))
    hz = np.full(len(numbers), HIGHEST_HZ)
    for _ in range(_MOST_ITERATIONS):
        found, shapes = all_modes(
            basis,
            symmetry,
            _constants_at(constants, cane, hz),
            constants.density_kg_m3,
            thickness_offset_m,
        )
        previous, hz = hz, found[numbers, numbers]
        if np.abs(1200 * np.log2(hz / previous)).max() < _SETTLED_CENTS:
            return hz, shapes[numbers, :, numbers].T
    raise ImpossibleReedError("the modes do not settle; check the cane's Zener parameters")


def _constants_at(constants: Cane, cane: ViscoelasticCane, hz: Array) -> Array:
    """Elastic constants (j, 9) at frequencies (j,)."""
    rows = np.tile(constants_of([constants]), (len(hz), 1))
    rows[:, CONSTANTS.index("E_L_pa")] = storage_modulus_pa(cane.young_L, hz)
    rows[:, CONSTANTS.index("G_LT_pa")] = storage_modulus_pa(cane.shear_LT, hz)
    return rows
