"""Find resonances the paper's way: pick the picture in which a mode has most fringes.

Fringes are counted for each shape of the finite elements, which gives the modes their names. Each
mode is searched near its expected frequency: first that of the population of reeds, then also that
which the modes found so far imply, because few components determine all frequencies.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.forward import (
    ForwardModel,
    cents_of,
    viscoelastic_cents,
)
from fitting.paper import constants as paper
from fitting.resonance import Resonance
from holography.arrays import Array
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from physics.reed.mode_classification import is_symmetric

# Half width of a search window, in standard deviations of the prediction.
_WINDOW_SD = 4.0
# Pictures this close to an acoustic resonance of the bench show all modes at once.
_LINE_CENTS = 60.0
# Least amplitude of a maximum, rad: above the noise of the count; a first fringe is at 1.84 rad.
_LEAST_RAD = 0.1
# ... and as a fraction of the largest amplitude of its shape in the window: a ripple on a flank is
# no resonance.
_LEAST_FRACTION = 0.2
# Reeds lie within these many standard deviations of the population's mean.
_FARTHEST_SD = 4.0
# Gauss-Newton steps after each new resonance.
_GAUSS_NEWTON_STEPS = 2
# Two modes of one symmetry that are expected this close may have exchanged shapes.
_EXCHANGE_CENTS = 150.0
# Two modes of one symmetry come no closer than this: the closest pairs of the population, F2 and
# T2 or F4 and T4, keep more than 90 cents.
_REPULSION_CENTS = 50.0
# Order of search: the strongest and best separated modes narrow the windows of the others.
_SEARCH_ORDER = ("F1", "T1", "F2", "T3", "T2", "X1", "F3", "X2", "X3", "F4", "T4")


@dataclass(frozen=True)
class FringeCurves:
    """Phase amplitudes of all shapes in all pictures of a sweep (see `fitting.fringes.fringes`).

    Attributes
    ----------
    drive_hz : (k,) float
        Realised drive frequencies of the pictures, ascending.
    step_index : (k,) int
    amplitude_rad : (k, m) float
    names : (m,) str
        Names of the shapes.
    """

    drive_hz: Array
    step_index: NDArray[np.intp]
    amplitude_rad: Array
    names: Sequence[str]


class _Posterior:
    """Normal distribution of the components, given the resonances found so far.

    The model is linearised again whenever the mean changes: near crossings of modes, frequencies
    are far from linear in the components.
    """

    def __init__(self, model: ForwardModel, series: Series, excess_scatter_cents: float) -> None:
        self._model, self._series, self._misfit_cents = model, series, excess_scatter_cents
        self._found: dict[int, float] = {}
        self._mean: Array = np.zeros(4)
        self._covariance: Array = np.eye(4)
        self._linearise()

    def predict(self, m: int) -> tuple[float, float]:
        """Return expected cents of mode m and standard deviation, including the model's misfit."""
        gradient = self._jacobian[m]
        variance = gradient @ self._covariance @ gradient + self._misfit_cents**2
        return float(self._expected[m]), float(np.sqrt(variance))

    @property
    def components(self) -> Components:
        """Expected components."""
        return Components(*map(float, self._mean))

    def learn(self, m: int, cents: float) -> None:
        """Condition on the frequency of mode m, in cents."""
        self._found[m] = cents
        modes, observed = list(self._found), np.array([*self._found.values()])
        weight = 1 / self._misfit_cents**2
        for _ in range(_GAUSS_NEWTON_STEPS):
            jacobian = self._jacobian[modes]
            offset = observed - self._expected[modes] + jacobian @ self._mean
            self._covariance = np.linalg.inv(np.eye(4) + weight * jacobian.T @ jacobian)
            mean = self._covariance @ (weight * jacobian.T @ offset)
            self._mean = np.clip(mean, -_FARTHEST_SD, _FARTHEST_SD)
            self._linearise()

    def _linearise(self) -> None:
        def cents(values: Array) -> Array:
            cane = viscoelastic_cane(Components(*map(float, values)), self._series)
            return viscoelastic_cents(self._model, cane, self._series)

        step = 0.5 * np.eye(4)
        self._expected = cents(self._mean)
        self._jacobian = np.stack(
            [cents(self._mean + d) - cents(self._mean - d) for d in step], axis=1
        )


def likely_components(
    resonances: Mapping[str, Resonance],
    model: ForwardModel,
    series: Series,
    excess_scatter_cents: float = paper.H4_MISFIT_CENTS,
) -> Components:
    """Estimate the components of a reed from its resonances and the population, to first order.

    This is less exact than a fit but always has a result: components that the resonances do not
    determine are those of the population.
    """
    posterior = _Posterior(model, series, excess_scatter_cents)
    for name, found in resonances.items():
        if name in model.modes:
            posterior.learn(model.modes.index(name), float(cents_of(found.frequency_hz)))
    return posterior.components


def pick_fringe_peaks(
    curves: FringeCurves,
    model: ForwardModel,
    series: Series,
    needed: Callable[[int, int], bool],
    acoustic_resonances_hz: Sequence[float] = (),
    excess_scatter_cents: float = paper.H4_MISFIT_CENTS,
) -> dict[str, Resonance]:
    """Pick for every mode the picture in which it has most fringes.

    Parameters
    ----------
    curves : FringeCurves
    model : ForwardModel
        Predicts the frequencies.
    series : Series
    needed : callable
        ``needed(shape, picture)`` is true if the picture cannot be explained without the shape;
        other maxima are ignored.
    acoustic_resonances_hz : sequence of float
        Resonances of the excitation device; pictures next to them are not picked.
    excess_scatter_cents : float
        Standard deviation of a reed's resonances around the model.

    Returns
    -------
    dict
        Found resonances by name, in order of frequency.
    """
    cents, names = cents_of(curves.drive_hz), curves.names
    spacing = np.gradient(cents) if len(cents) > 1 else np.full(1, np.inf)
    clear = np.ones(len(cents), dtype=bool)
    for line in acoustic_resonances_hz:
        clear &= np.abs(cents - cents_of(line)) > _LINE_CENTS
    posterior = _Posterior(model, series, excess_scatter_cents)
    found: dict[str, Resonance] = {}
    for name in _SEARCH_ORDER:
        if name not in names or name not in model.modes:
            continue
        expected, sd = posterior.predict(model.modes.index(name))
        window = clear & (np.abs(cents - expected) < _WINDOW_SD * sd)
        free = window & ~_taken(cents, name, found)
        best = None
        for shape in _shapes_to_follow(name, names, posterior, model):
            peaks = _peaks(curves.amplitude_rad[:, shape], window, free)
            best = next((k for k in peaks if needed(shape, k)), None)
            if best is not None:
                break
        if best is None:
            continue
        posterior.learn(model.modes.index(name), float(cents[best]))
        found[name] = Resonance(
            name=name,
            frequency_hz=float(curves.drive_hz[best]),
            error_cents=float(spacing[best] / np.sqrt(12)),
            step_index=int(curves.step_index[best]),
            amplitude_rad=float(curves.amplitude_rad[best, shape]),
        )
    return dict(sorted(found.items(), key=lambda item: item[1].frequency_hz))


def _taken(cents: Array, name: str, found: Mapping[str, Resonance]) -> NDArray[np.bool_]:
    """Mask (k,) of pictures too near to a mode of the same symmetry: such modes repel."""
    near = np.zeros(len(cents), dtype=bool)
    for other, resonance in found.items():
        if is_symmetric(other) == is_symmetric(name):
            near |= np.abs(cents - cents_of(resonance.frequency_hz)) <= _REPULSION_CENTS
    return near


def _shapes_to_follow(
    name: str, names: Sequence[str], posterior: _Posterior, model: ForwardModel
) -> list[int]:
    """Return the shapes that a mode may have: its own, then those of modes it may mix with."""
    expected, _ = posterior.predict(model.modes.index(name))

    def distance_cents(other: str) -> float:
        return abs(posterior.predict(model.modes.index(other))[0] - expected)

    partners = [
        other
        for other in model.modes
        if other in names and other != name and is_symmetric(other) == is_symmetric(name)
    ]
    near = sorted((o for o in partners if distance_cents(o) < _EXCHANGE_CENTS), key=distance_cents)
    return [names.index(each) for each in (name, *near)]


def _peaks(fringes: Array, window: NDArray[np.bool_], free: NDArray[np.bool_]) -> list[int]:
    """Return the local maxima among the free pictures of a window, the highest first."""
    if not window.any():
        return []
    least = max(_LEAST_RAD, _LEAST_FRACTION * float(fringes[window].max()))
    before, after = np.roll(fringes, 1), np.roll(fringes, -1)
    peak = (fringes >= before) & (fringes >= after) & (fringes > least) & free
    peak[[0, -1]] = False
    return [int(k) for k in sorted(np.flatnonzero(peak), key=lambda k: -fringes[k])]
