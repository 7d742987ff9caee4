"""From the cane's moduli to the frequencies of named modes, fast enough to be inverted."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import NearestNDInterpolator, RectBivariateSpline

from fitting.paper import constants as paper
from holography.arrays import Array
from physics.reed.cane.viscoelastic import (
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import Mode, elastic_modes
from physics.reed.reduced.reed import BasisSettings, ReducedReed, ReedBox
from physics.reed.reduced.stored import reduced_reed
from physics.reed.reduction.metamodel import REFERENCE_HZ
from protocols.reed import ReedFile

# Network on which the finite elements are tabulated, Pa: the range of a reduced basis.
_E_L_PA, _G_LT_PA = (np.geomspace(*ends, 21) for ends in (ReedBox().E_L_pa, ReedBox().G_LT_pa))
# Each iteration gains a factor of about 5; the paper does one.
_ITERATIONS = 7


def cents_of(frequency_hz: Array | float) -> Array:
    """Interval above F6 (1396.9 Hz), the zero of the paper's cent scale."""
    return np.asarray(1200 * np.log2(np.asarray(frequency_hz) / REFERENCE_HZ))


def hz_of(cents: Array | float) -> Array:
    """Frequency of an interval above F6."""
    return np.asarray(REFERENCE_HZ * 2 ** (np.asarray(cents) / 1200))


class ForwardModel(Protocol):
    """Frequencies of an elastic reed, mode by mode.

    Attributes
    ----------
    name : str
    modes : tuple of str
    iterations : int
        How often the moduli are computed again at the resulting frequencies.
    """

    @property
    def name(self) -> str:
        """Name for reports."""

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes computed, in order."""

    @property
    def iterations(self) -> int:
        """Passes of the iteration over frequency-dependent moduli."""

    def start_hz(self, series: Series) -> Array:
        """Frequencies (m,) at which the iteration over frequency-dependent moduli starts."""

    def elastic_cents(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """Cents above F6 (m,) where mode m has the moduli E_L[m], G_LT[m]."""

    def similarity(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """How far each mode's shape bears out its name (m,); 1 is the mode at its purest."""


@dataclass(frozen=True)
class FiniteElementModel:
    """Finite elements tabulated over E_L and G_LT and interpolated by cubic splines.

    Within the table (7 to 22 GPa, 0.4 to 2.1 GPa) the splines follow the reduced basis to a
    cent, but for T4 and F4 near their avoided crossing.
    """

    modes: tuple[str, ...]
    splines: tuple[RectBivariateSpline, ...]
    similarities: tuple[RectBivariateSpline, ...]
    name: str = "finite elements"
    iterations: int = _ITERATIONS

    def start_hz(self, series: Series) -> Array:
        """Frequencies (m,) in the middle of the table, whatever the series."""
        E, G = (np.full(len(self.modes), np.exp(np.mean(np.log(n)))) for n in (_E_L_PA, _G_LT_PA))
        return hz_of(self.elastic_cents(E, G))

    def elastic_cents(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """Cents above F6 (m,); moduli beyond the table are taken at its edge."""
        return _at(self.splines, E_L_pa, G_LT_pa)

    def similarity(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """Likeness of shape and name (m,), interpolated linearly."""
        return _at(self.similarities, E_L_pa, G_LT_pa)


def _entry(mode: Mode | None) -> tuple[float, float]:
    """Return cents and similarity; the similarity is 0 if no mode has the name."""
    if mode is None:
        return np.nan, 0.0
    return float(cents_of(mode.frequency_hz)), mode.similarity


def _fill_from_nearest(cents: Array) -> None:
    """Replace NaN in a table (e, g) by the nearest entry."""
    missing = np.isnan(cents)
    if missing.any():
        known = np.argwhere(~missing)
        cents[missing] = NearestNDInterpolator(known, cents[~missing])(np.argwhere(missing))


def _at(splines: tuple[RectBivariateSpline, ...], E_L_pa: Array, G_LT_pa: Array) -> Array:
    E = np.log(np.clip(E_L_pa, _E_L_PA[0], _E_L_PA[-1]))
    G = np.log(np.clip(G_LT_pa, _G_LT_PA[0], _G_LT_PA[-1]))
    points = zip(splines, E, G, strict=True)
    return np.array([float(spline.ev(e, g)) for spline, e, g in points])


def basis_of(reed: ReedFile, announce: Callable[[str], None] | None = None) -> ReducedReed:
    """Reduced basis of a kind of reed, from the cache or built and kept (`reduced_reed`)."""
    settings = BasisSettings(ReedBox(cane=reed.constants()))
    return reduced_reed(reed.geometry(), settings=settings, announce=announce)


def finite_element_model(
    reed: ReducedReed, modes: tuple[str, ...] = PAPER_MODES, air_fraction: float = 1.0
) -> FiniteElementModel:
    """Tabulate a reed's modes.

    Parameters
    ----------
    reed : ReducedReed
    modes : tuple of str
    air_fraction : float
        Density of the air as a fraction of normal air; 0 is a vacuum, as in the paper's model.
    """
    table = np.empty((2, len(modes), len(_E_L_PA), len(_G_LT_PA)))
    for i, E in enumerate(_E_L_PA):
        for j, G in enumerate(_G_LT_PA):
            found = elastic_modes(reed, float(E), float(G), air_fraction)
            for m, name in enumerate(modes):
                table[:, m, i, j] = _entry(found.get(name))
    for cents in table[0]:
        _fill_from_nearest(cents)
    # Relative to the mode at its purest: a T4 is never as pure as an F1.
    table[1] /= np.percentile(table[1], 90, axis=(1, 2), keepdims=True)
    axes = np.log(_E_L_PA), np.log(_G_LT_PA)
    return FiniteElementModel(
        modes,
        tuple(RectBivariateSpline(*axes, cents) for cents in table[0]),
        tuple(RectBivariateSpline(*axes, similarity, kx=1, ky=1) for similarity in table[1]),
    )


@dataclass(frozen=True)
class PaperModel:
    """The paper's metamodel: Eq. 1 with Table 9 and the adjustments of hypothesis H4."""

    modes: tuple[str, ...] = PAPER_MODES
    name: str = "paper (Table 9, H4)"
    # "One iteration is enough" (paper, section III.C); its adjustments were made with one.
    iterations: int = 1

    def start_hz(self, series: Series) -> Array:
        """Means of Table 1 (m,), where the paper starts."""
        column = 0 if series is Series.A else 1
        return np.array([paper.MEAN_HZ[name][column] for name in self.modes], dtype=float)

    def elastic_cents(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """Cents above F6 (m,) by Eq. 1."""
        return paper.adjusted_metamodel(self.modes).evaluate(E_L_pa, G_LT_pa)[0]

    def similarity(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """Ones (m,): a formula has no shapes to doubt."""
        return np.ones(len(E_L_pa))


def viscoelastic_cents(model: ForwardModel, cane: ViscoelasticCane, series: Series) -> Array:
    """Cents above F6 (m,) with the storage moduli taken at each mode's own frequency.

    By iteration from the model's own start (paper, section III.C).
    """
    hz = model.start_hz(series)
    cents = cents_of(hz)
    for _ in range(model.iterations):
        cents = model.elastic_cents(*_storage_moduli_pa(cane, hz))
        hz = hz_of(cents)
    return cents


def name_similarity(model: ForwardModel, cane: ViscoelasticCane, cents: Array) -> Array:
    """How far the modes of a reed bear out their names (m,), at their frequencies in cents.

    Where two modes of one symmetry come close they exchange shapes: similarity falls to a half,
    of that of a pure mode, and the frequency of either no longer follows one modulus.
    """
    return model.similarity(*_storage_moduli_pa(cane, hz_of(cents)))


def _storage_moduli_pa(cane: ViscoelasticCane, hz: Array) -> tuple[Array, Array]:
    return storage_modulus_pa(cane.young_L, hz), storage_modulus_pa(cane.shear_LT, hz)
