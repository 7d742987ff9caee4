"""Start frequencies of the joint fit: where each mode is looked for in a sweep."""

from collections.abc import Mapping, Sequence

import numpy as np

from fitting.errors import FitError
from fitting.forward import ForwardModel, cents_of, viscoelastic_cents
from fitting.fringes.fringe_peaks import FringeCurves, likely_components, pick_fringe_peaks
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.shape_basis import ShapeBasis, shape_basis
from fitting.holograms.solved_sweep import Displacements
from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.mode_classification import PAPER_MODES, is_symmetric
from physics.reed.reduced.elastic import viscoelastic_modes
from physics.reed.reduced.reed import ReducedReed

# Moduli in the middle of the sweep, in which shapes are computed.
SHAPES_HZ = 4000.0
# Frequency ratio of the central differences that give the growth of moduli.
_STEP = 1.01
# Resonances beyond the sweep that are fitted, by their ratio to its first and last frequency. An
# octave below the first, a frequency that is off by 5 % changes the response by what a line in log
# frequency describes to 1 %; nearer, it bends it. Above the last there are other modes on both
# sides, and only those that are next to it bend its end.
_BELOW, _ABOVE = 2.0, 1.03
# Shapes up to here are used to find the modes with large amplitudes in each hologram.
_LOOK_HZ = 24e3
# Scatter of resonances of reeds whose shape differs from the finite elements by about 10 µm.
_MISFIT_CENTS = 60.0
# A hologram of large amplitude is assigned to a mode if the cane fitted to all of them agrees
# within this fraction of the distance to the next mode of that symmetry, within limits.
_ROOM, _AGREE_CENTS = 0.4, (80.0, 300.0)
# Fewest holograms in which a peak can be: it has a neighbour on either side.
_FEWEST = 3


def middling_shapes(
    reed: ReducedReed, cane: ViscoelasticCane, x_m: Array, y_m: Array
) -> ShapeBasis:
    """Compute the shapes of a reed of average cane at points (n,) of its bark side."""

    def moduli_pa(hz: float) -> Array:
        return np.array([storage_modulus_pa(z, hz) for z in (cane.young_L, cane.shear_LT)])

    def growth(hz: float) -> tuple[float, float]:
        E, G = np.log(moduli_pa(hz * _STEP) / moduli_pa(hz / _STEP)) / (2 * np.log(_STEP))
        return float(E), float(G)

    E_pa, G_pa = moduli_pa(SHAPES_HZ)
    return shape_basis(reed, float(E_pa), float(G_pa), x_m, y_m, growth)


def start_frequencies(
    block_amplitudes: BlockAmplitudes,
    basis: ShapeBasis,
    displacements: Displacements,
    reed: ReducedReed,
    model: ForwardModel,
    series: Series,
) -> dict[str, float]:
    """Return the start frequency of each mode within the sweep, by name.

    The holograms with the largest amplitudes of the paper's modes determine the cane, and the cane
    determines all other modes. A mode that is larger than all others at its own peak starts there,
    because a reed need not have the nominal shape of its kind. Holograms whose displacement was
    not found do not count.

    Raises
    ------
    FitError
        If no mode lies in the sweep.
    """
    look, reached = basis.hz < _LOOK_HZ, displacements.reached
    reached = reached | (np.count_nonzero(reached) < _FEWEST)
    drive_hz, indices = block_amplitudes.drive_hz[reached], block_amplitudes.step_index[reached]
    modal = np.abs(displacements.amplitude_rad[reached] @ np.linalg.pinv(basis.shapes[look]))
    names = [name for name, counts in zip(basis.names, look, strict=True) if counts]
    weighty = _outweighing(modal * np.linalg.norm(basis.shapes[look], axis=1), names)
    curves = FringeCurves(drive_hz, indices, modal, names)
    picked = pick_fringe_peaks(
        curves,
        model,
        series,
        lambda _shape, _picture: True,
        excess_scatter_cents=_MISFIT_CENTS,
    )
    components = likely_components(picked, model, series, _MISFIT_CENTS)
    try:
        expected = _expected_hz(basis, reed, viscoelastic_cane(components, series))
    except ImpossibleReedError:
        # The picked peaks belong to no possible cane: use the mean cane of the population.
        components = Components()
        expected = _expected_hz(basis, reed, viscoelastic_cane(components, series))
    paper_cents = dict(
        zip(
            model.modes,
            viscoelastic_cents(model, viscoelastic_cane(components, series), series),
            strict=True,
        )
    )
    seen_hz = {name: [float(drive_hz[k]) for k in weighty[name]] for name in names}
    for name, peak in picked.items():
        seen_hz[name].append(peak.frequency_hz)
    starts = expected | _agreeing(seen_hz, paper_cents)
    first, last = block_amplitudes.drive_hz[0], block_amplitudes.drive_hz[-1]
    within = {n: hz for n, hz in starts.items() if first / _BELOW < hz < last * _ABOVE}
    if not within:
        raise FitError(
            f"no mode of this kind of reed lies between {first:.0f} and {last:.0f} Hz, where the "
            "sweep is; sweep a wider range"
        )
    return within


def _agreeing(
    seen_hz: Mapping[str, Sequence[float]], paper_cents: Mapping[str, float]
) -> dict[str, float]:
    """Return, of modes with peaks, the frequency of the one that the cane agrees with best.

    A peak may belong to another mode or to the excitation: then no cane agrees.
    """
    found = {}
    for name, each in seen_hz.items():
        if name not in PAPER_MODES or name not in paper_cents or not each:
            continue
        apart = [abs(float(cents_of(hz)) - paper_cents[name]) for hz in each]
        if min(apart) < _room_cents(name, paper_cents):
            found[name] = each[int(np.argmin(apart))]
    return found


def _outweighing(weight: Array, names: Sequence[str]) -> dict[str, list[int]]:
    """Find the holograms in which a mode has a local maximum and is larger than all others.

    Parameters
    ----------
    weight : (k, m) float
        Size of each mode in each hologram.
    """
    inner, before, after = weight[1:-1], weight[:-2], weight[2:]
    most = inner.argmax(axis=1)
    return {
        name: [
            int(k) + 1
            for k in np.flatnonzero(
                (inner[:, m] > before[:, m]) & (inner[:, m] > after[:, m]) & (most == m)
            )
        ]
        for m, name in enumerate(names)
    }


def _room_cents(name: str, cents: Mapping[str, float]) -> float:
    """Return how far a mode may be from its expected frequency without being another one."""
    others = [
        abs(at - cents[name])
        for other, at in cents.items()
        if other != name and is_symmetric(other) == is_symmetric(name)
    ]
    least, most = _AGREE_CENTS
    return float(np.clip(_ROOM * min(others, default=np.inf), least, most))


def _expected_hz(basis: ShapeBasis, reed: ReducedReed, cane: ViscoelasticCane) -> dict[str, float]:
    """Return the eigenfrequencies of the modes that a reed of this cane has."""
    modes = viscoelastic_modes(reed, cane)
    return {
        name: modes[name].frequency_hz
        for name, hz in zip(basis.names, basis.hz, strict=True)
        if hz < _LOOK_HZ and name in modes
    }
