"""The joint model of a sweep: what is known before, its parameters, and what follows from them.

The displacement of hologram k, in coordinates j of few functions, is

    a_kj = d_k Σ_m h_m(f_k) p_m(f_k) T_mj,    h_m(f) = 1 / (1 + iη_m − (f/f_m)^(2 − γ_m))

with the exponent γ_m by which cane stiffens with frequency, and shapes
``T_mj = Σ_n (δ_mn + E_mn) S_nj`` near those S of the finite elements (see `fitting.modal.fit`).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

# Participations of modes beyond the sweep, of which only the tail shows, are of degree 1.
TAIL_TERMS = 2
# Loss factor of dry cane.
LOSS = 0.03
# The drive's magnitude, in nepers: second difference of its smooth part from step to step.
_BEND, _BEND_TURNS = 0.01, 8
# Freedoms of Student's distribution, which lets lines stand out: where none is known, and where
# what other sweeps have shown of them has been taken off.
UNKNOWN_LINES, KNOWN_LINES = 4.0, 100.0
# What holograms may be livelier or calmer besides, at first and at least.
_FIRST_GAIN, _LEAST_GAIN = 0.1, 3e-3


@dataclass(frozen=True)
class Model:
    """What is known before the fit.

    Parameters of one vector of coordinates stand together. Vectors are the shapes of the a active
    modes, then those S of all m modes. Of an active mode's: participation (real, imaginary parts),
    log frequency, log loss. Of the others: the mixing E into each active mode, and participations
    of a mode beyond the sweep.

    Attributes
    ----------
    hz : (k,) float
    log_volts : (k,) float
        Or what else the drive is expected to be, up to a smooth factor.
    lines : float
        `UNKNOWN_LINES` or `KNOWN_LINES`.
    powers : (k, n) float
        Chebyshev polynomials of log frequency.
    reference : (m, j) float
        Shapes S.
    reference_hz : (m,) float
    stiffening : (m,) float
        See `fitting.holograms.shape_basis.ShapeBasis`.
    active : (a,) int
    """

    hz: Array
    log_volts: Array
    lines: float
    powers: Array
    reference: Array
    reference_hz: Array
    stiffening: Array
    active: NDArray[np.intp]

    @property
    def slots(self) -> int:
        """Most parameters of one vector."""
        return int(max(2 * self.powers.shape[1] + 2, len(self.active) + 2 * TAIL_TERMS))

    @property
    def passive(self) -> NDArray[np.intp]:
        """Modes beyond the sweep."""
        return np.setdiff1d(np.arange(len(self.reference)), self.active)


@dataclass(frozen=True)
class State:
    """Parameters (v, p) of the vectors, the log (complex) of the drive (k,), the holograms' gain.

    The last is the standard deviation of what they are brighter or darker by chance, in nepers.
    """

    x: Array
    log_drive: Complex
    together: Array
    gain: float = _FIRST_GAIN


@dataclass(frozen=True)
class Terms:
    """What follows from a state.

    Attributes
    ----------
    resonance, participation : (k, m) complex
        h and p.
    shapes : (m, j) float
        T.
    loss : (m,) float
    ratio : (k, m) float
        (f/f_m)^(2 − γ_m).
    modal : (k, m) complex
        Largest deflections d h p.
    amplitude : (k, j) complex
    """

    resonance: Complex
    participation: Complex
    shapes: Array
    loss: Array
    ratio: Array
    modal: Complex
    amplitude: Complex


def terms(model: Model, state: State) -> Terms:
    """Work out what a state says of all holograms."""
    x, active, passive = state.x, model.active, model.passive
    count, powers = len(active), model.powers.shape[1]
    hz, loss = model.reference_hz.copy(), np.full(len(model.reference), LOSS)
    hz[active] = np.exp(x[:count, 2 * powers])
    loss[active] = np.exp(x[:count, 2 * powers + 1])
    p = np.zeros((len(hz), powers), complex)
    p[active] = x[:count, :powers] + 1j * x[:count, powers : 2 * powers]
    tail = x[count + passive, count : count + 2 * TAIL_TERMS]
    p[passive, :TAIL_TERMS] = tail[:, :TAIL_TERMS] + 1j * tail[:, TAIL_TERMS:]
    shapes = model.reference.copy()
    shapes[active] += x[count:, :count].T @ model.reference
    ratio = (model.hz[:, None] / hz) ** (2 - model.stiffening)
    resonance: Complex = 1 / (1 + 1j * loss - ratio)
    participation: Complex = model.powers.astype(complex) @ p.T
    modal = np.exp(state.log_drive)[:, None] * (resonance * participation)
    return Terms(resonance, participation, shapes, loss, ratio, modal, modal @ shapes)


def scalars(model: Model, state: State, terms: Terms) -> Complex:
    """Derivatives by all parameters, without the vectors that they multiply: (k, v, p)."""
    active, passive, count = model.active, model.passive, len(model.active)
    powers = model.powers.shape[1]
    drive = np.exp(state.log_drive)[:, None]
    h, p = drive * terms.resonance, terms.participation
    s = np.zeros((len(model.hz), count + len(model.reference), model.slots), complex)
    own = h[:, active, None] * model.powers[:, None, :]
    s[:, :count, :powers], s[:, :count, powers : 2 * powers] = own, 1j * own
    steep = h[:, active] * terms.resonance[:, active] * p[:, active]
    exponent = 2 - model.stiffening[active]
    s[:, :count, 2 * powers] = -exponent * terms.ratio[:, active] * steep
    s[:, :count, 2 * powers + 1] = -1j * terms.loss[active] * steep
    s[:, count:, :count] = (h * p)[:, None, active]
    tail = h[:, passive, None] * model.powers[:, None, :TAIL_TERMS]
    s[:, count + passive, count : count + TAIL_TERMS] = tail
    s[:, count + passive, count + TAIL_TERMS : count + 2 * TAIL_TERMS] = 1j * tail
    return s


@dataclass(frozen=True)
class Prior:
    """Centre and precision (v, p) of every parameter; infinite precision fixes it."""

    centre: Array
    precision: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which parameters (v, p) are any."""
        return np.isfinite(self.precision)

    def cost(self, x: Array) -> float:
        """Twice the negative log of the prior."""
        free = self.free
        return float(np.sum(self.precision[free] * (x - self.centre)[free] ** 2))


@dataclass(frozen=True)
class Bend:
    """What is expected of the drive's magnitude.

    Attributes
    ----------
    cost : float
    gradient : (k,) float
    known : (k,) float
        What is told of the smooth part by each hologram.
    whole : (3, k) float
        What is told of it by all, and by its smoothness: bands of a matrix, the diagonal last.
    """

    cost: float
    gradient: Array
    known: Array
    whole: Array

    @property
    def curvature(self) -> Array:
        """Curvature (k, k): whatever the magnitude becomes, the smooth part follows it."""
        follows = linalg.solveh_banded(self.whole, np.diag(self.known), check_finite=False)
        curvature = np.diag(self.known) - self.known[:, None] * follows
        return 0.5 * (curvature + curvature.T)


def bend(model: Model, state: State) -> Bend:
    """Divide the drive's magnitude into a smooth part and what holograms are livelier by.

    Both of Student's distribution: a line of the air is a bend of the one, or a few large values
    of the other.
    """
    magnitude = state.log_drive.real - model.log_volts
    smooth, freedoms = magnitude, model.lines
    for _ in range(_BEND_TURNS):
        bent = (freedoms + 1) / (freedoms + (np.diff(smooth, 2) / _BEND) ** 2)
        known = (freedoms + 1) / (freedoms * state.gain**2 + (magnitude - smooth) ** 2)
        whole = _stiff(bent)
        whole[2] += known
        smooth = linalg.solveh_banded(whole, known * magnitude, check_finite=False)
    gain = magnitude - smooth
    cost = np.sum(np.log1p((np.diff(smooth, 2) / _BEND) ** 2 / freedoms))
    cost += np.sum(np.log1p((gain / state.gain) ** 2 / freedoms))
    gradient = -(freedoms + 1) * gain / (freedoms * state.gain**2 + gain**2)
    return Bend(float((freedoms + 1) * cost), gradient, known, whole)


def _stiff(bent: Array) -> Array:
    """Bands (3, k), the diagonal last, of second differences squared, each weighing (k − 2,)."""
    bands = np.zeros((3, len(bent) + 2))
    for offset, weight in enumerate((1, 4, 1)):
        bands[2, offset : offset + len(bent)] += weight * bent
    bands[1, 1:-1] -= 2 * bent
    bands[1, 2:] -= 2 * bent
    bands[0, 2:] = bent
    bands /= _BEND**2
    return bands


def with_gain(model: Model, state: State) -> State:
    """Estimate by how much holograms are livelier or calmer than a smooth drive makes them."""
    magnitude = state.log_drive.real - model.log_volts
    spread = float(np.median(np.abs(np.diff(magnitude, 2)))) / 0.6745
    # Second differences of independent numbers have six times their variance.
    square = (spread**2 - _BEND**2) / 6
    return replace(state, gain=max(float(np.sqrt(max(square, 0))), _LEAST_GAIN))
