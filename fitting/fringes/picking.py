"""The paper's way to resonances: the picture in which the fringes of a mode are locally most.

Names come from similarity with the finite-element shapes: fringes are counted per shape. Where a
mode is looked for is a matter of what is already known: the population of reeds first, then also
the modes found so far, since few components govern all frequencies.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.forward import (
    ForwardModel,
    cents_of,
    viscoelastic_cents,
)
from fitting.paper import constants as paper
from physics.reed.names import is_symmetric
from physics.reed.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)

Array = NDArray[np.floating[Any]]

# Half width of a search window, in standard deviations of the prediction.
_WINDOW_SD = 4.0
# Pictures this close to an acoustic line of the bench show all modes at once.
_LINE_CENTS = 60.0
# A maximum must stand out of the noise of the count, rad: a first fringe begins at 1.84.
_LEAST_RAD = 0.1
# ... and of the most fringes of its shape within the window: ripples on a flank are no resonance.
_LEAST_SHARE = 0.2
# Reeds lie within these many standard deviations of the population's mean.
_FARTHEST_SD = 4.0
# Steps of Gauss and Newton that a belief takes when it learns.
_BELIEF_STEPS = 2
# Two modes of one symmetry that are expected this close may have exchanged shapes.
_EXCHANGE_CENTS = 150.0
# Two modes of one symmetry come no closer than this: the closest pairs of the population, F2 and
# T2 or F4 and T4, keep more than 90 cents.
_REPULSION_CENTS = 50.0
# Order of search: the liveliest and best separated modes narrow the windows of the others.
_SEARCH_ORDER = ("F1", "T1", "F2", "T3", "T2", "X1", "F3", "X2", "X3", "F4", "T4")


@dataclass(frozen=True)
class Resonance:
    """A mode found in a sweep.

    Attributes
    ----------
    name : str
    frequency_hz : float
        Drive frequency of the picture.
    error_cents : float
        Standard error: the picture may be off by half its distance to its neighbours.
    step_index : int
        Index of the picture in the protocol.
    amplitude_rad : float
        Phase amplitude of the mode in that picture.
    method : str
        ``picture``, or ``joint`` (see `fitting.modal.identify`), which alone knows what follows.
    response_hz : float, optional
        Where the mode is liveliest in the sweep: not its eigenfrequency where the drive is steep.
    loss_factor, loss_error : float, optional
        The latter relative.
    participation : float, optional
        How strongly the drive moves the mode, per unit of the one that it moves most.
    likeness : float, optional
        Of its shape and that of the finite elements' mode of its name (MAC).
    """

    name: str
    frequency_hz: float
    error_cents: float
    step_index: int
    amplitude_rad: float
    method: str = "picture"
    response_hz: float | None = None
    loss_factor: float | None = None
    loss_error: float | None = None
    participation: float | None = None
    likeness: float | None = None


class _Belief:
    """Normal distribution of the components, narrowed by every resonance found.

    The model is linearised at the mean, anew whenever the mean moves: near crossings of modes
    frequencies are far from linear in the components.
    """

    def __init__(self, model: ForwardModel, series: Series, misfit_cents: float) -> None:
        self._model, self._series, self._misfit_cents = model, series, misfit_cents
        self._found: dict[int, float] = {}
        self._mean: Array = np.zeros(4)
        self._covariance: Array = np.eye(4)
        self._linearise()

    def predict(self, m: int) -> tuple[float, float]:
        """Expected cents of mode m and standard deviation, the model's own misfit included."""
        slope = self._slopes[m]
        variance = slope @ self._covariance @ slope + self._misfit_cents**2
        return float(self._expected[m]), float(np.sqrt(variance))

    @property
    def components(self) -> Components:
        """Expected components."""
        return Components(*map(float, self._mean))

    def learn(self, m: int, cents: float) -> None:
        """Condition on mode m having been found at a number of cents."""
        self._found[m] = cents
        modes, observed = list(self._found), np.array([*self._found.values()])
        weight = 1 / self._misfit_cents**2
        for _ in range(_BELIEF_STEPS):
            slopes = self._slopes[modes]
            offset = observed - self._expected[modes] + slopes @ self._mean
            self._covariance = np.linalg.inv(np.eye(4) + weight * slopes.T @ slopes)
            mean = self._covariance @ (weight * slopes.T @ offset)
            self._mean = np.clip(mean, -_FARTHEST_SD, _FARTHEST_SD)
            self._linearise()

    def _linearise(self) -> None:
        def cents(values: Array) -> Array:
            cane = viscoelastic_cane(Components(*map(float, values)), self._series)
            return viscoelastic_cents(self._model, cane, self._series)

        step = 0.5 * np.eye(4)
        self._expected = cents(self._mean)
        self._slopes = np.stack(
            [cents(self._mean + d) - cents(self._mean - d) for d in step], axis=1
        )


def likely_components(
    resonances: Mapping[str, Resonance],
    model: ForwardModel,
    series: Series,
    misfit_cents: float = paper.H4_MISFIT_CENTS,
) -> Components:
    """Components of a reed of the population that has these resonances, to first order.

    Rougher than a fit, but there is always an answer: what the resonances do not tell is taken
    from the population.
    """
    belief = _Belief(model, series, misfit_cents)
    for name, found in resonances.items():
        if name in model.modes:
            belief.learn(model.modes.index(name), float(cents_of(found.frequency_hz)))
    return belief.components


def pick_resonances(
    drive_hz: Array,
    step_index: NDArray[np.intp],
    amplitude_rad: Array,
    names: Sequence[str],
    model: ForwardModel,
    series: Series,
    needed: Callable[[int, int], bool],
    acoustic_resonances_hz: Sequence[float] = (),
    misfit_cents: float = paper.H4_MISFIT_CENTS,
) -> dict[str, Resonance]:
    """Pick for every mode the picture with most of its fringes.

    Parameters
    ----------
    drive_hz : (k,) float
        Realised drive frequencies of the pictures, ascending.
    step_index : (k,) int
    amplitude_rad : (k, m) float
        Phase amplitude of each shape in each picture (see `fitting.fringes.fringes`).
    names : (m,) str
    model : ForwardModel
        Says where to look.
    series : Series
    needed : callable
        ``needed(shape, picture)`` says whether that picture cannot be explained without that
        shape; a maximum where it can is passed over.
    acoustic_resonances_hz : sequence of float
        Resonances of the excitation device; pictures next to them are not picked.
    misfit_cents : float
        Standard deviation of a reed's resonances from those of any cane in the model's shape.

    Returns
    -------
    dict
        Resonances by name, those found only, in order of frequency.
    """
    cents = cents_of(drive_hz)
    spacing = np.gradient(cents) if len(cents) > 1 else np.full(1, np.inf)
    clear = np.ones(len(cents), dtype=bool)
    for line in acoustic_resonances_hz:
        clear &= np.abs(cents - cents_of(line)) > _LINE_CENTS
    belief = _Belief(model, series, misfit_cents)
    found: dict[str, Resonance] = {}
    for name in _SEARCH_ORDER:
        if name not in names or name not in model.modes:
            continue
        expected, sd = belief.predict(model.modes.index(name))
        window = clear & (np.abs(cents - expected) < _WINDOW_SD * sd)
        free = window & ~_taken(cents, name, found)
        best = None
        for shape in _shapes_to_follow(name, names, belief, model):
            peaks = _peaks(amplitude_rad[:, shape], window, free)
            best = next((k for k in peaks if needed(shape, k)), None)
            if best is not None:
                break
        if best is None:
            continue
        belief.learn(model.modes.index(name), float(cents[best]))
        found[name] = Resonance(
            name=name,
            frequency_hz=float(drive_hz[best]),
            error_cents=float(spacing[best] / np.sqrt(12)),
            step_index=int(step_index[best]),
            amplitude_rad=float(amplitude_rad[best, shape]),
        )
    return dict(sorted(found.items(), key=lambda item: item[1].frequency_hz))


def _taken(cents: Array, name: str, found: Mapping[str, Resonance]) -> NDArray[np.bool_]:
    """Pictures (k,) too near to a mode of the same symmetry: such modes repel each other."""
    near = np.zeros(len(cents), dtype=bool)
    for other, resonance in found.items():
        if is_symmetric(other) == is_symmetric(name):
            near |= np.abs(cents - cents_of(resonance.frequency_hz)) <= _REPULSION_CENTS
    return near


def _shapes_to_follow(
    name: str, names: Sequence[str], belief: _Belief, model: ForwardModel
) -> list[int]:
    """Shapes whose fringes may show a mode: its own, then those it may have exchanged it with."""
    expected, _ = belief.predict(model.modes.index(name))

    def distance_cents(other: str) -> float:
        return abs(belief.predict(model.modes.index(other))[0] - expected)

    partners = [
        other
        for other in model.modes
        if other in names and other != name and is_symmetric(other) == is_symmetric(name)
    ]
    near = sorted((o for o in partners if distance_cents(o) < _EXCHANGE_CENTS), key=distance_cents)
    return [names.index(each) for each in (name, *near)]


def _peaks(fringes: Array, window: NDArray[np.bool_], free: NDArray[np.bool_]) -> list[int]:
    """Free pictures of a window where the fringes are locally most, the highest first."""
    if not window.any():
        return []
    least = max(_LEAST_RAD, _LEAST_SHARE * float(fringes[window].max()))
    before, after = np.roll(fringes, 1), np.roll(fringes, -1)
    peak = (fringes >= before) & (fringes >= after) & (fringes > least) & free
    peak[[0, -1]] = False
    return [int(k) for k in sorted(np.flatnonzero(peak), key=lambda k: -fringes[k])]
