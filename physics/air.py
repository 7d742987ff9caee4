"""The air that drives the reed: the mouthpiece's chamber between tweeter and reed."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physics.reed.geometry import ReedGeometry

Array = NDArray[np.floating[Any]]

# Of the clarinet's mouthpiece: the window ends this far before the clamp, and its side walls cover
# this much of the reed's edges.
_BEFORE_CLAMP_M = 5.2e-3
_COVERED_EDGE_M = 1.275e-3


class Filling(StrEnum):
    """How the mouthpiece's chamber is prepared."""

    SYMMETRIC = "symmetric"
    # Right half filled with modelling clay: only the left half of the reed is driven.
    ASYMMETRIC = "asymmetric"


@dataclass(frozen=True)
class Chamber:
    """Chamber of the mouthpiece, closed by the reed.

    Attributes
    ----------
    filling : Filling
    length_m : float
        Length of the window under the reed, from the tip.
    half_width_m : float
        Half width of the window; the side walls protect the reed's edges beyond it.
    edge_m : float
        Distance over which the pressure falls at a wall.
    sound_speed_m_s : float
        At about 20 °C.
    """

    filling: Filling = Filling.SYMMETRIC
    length_m: float = 33e-3
    half_width_m: float = 5.3e-3
    edge_m: float = 0.6e-3
    sound_speed_m_s: float = 343.0


def chamber_of(geometry: ReedGeometry, filling: Filling) -> Chamber:
    """Chamber of a mouthpiece that takes a reed as the paper's takes a clarinet reed.

    Its window ends as far before the clamp, and its walls cover as much of the reed's edges.
    """
    half_width_m = geometry.outline.side_half_width_m - _COVERED_EDGE_M
    return Chamber(
        filling,
        # To the micrometre: what is the same reed has the same chamber to the last bit.
        length_m=round(geometry.clamp.x_m[0] - _BEFORE_CLAMP_M, 6),
        half_width_m=round(half_width_m, 6),
    )


@dataclass(frozen=True)
class CavityLine:
    """An acoustic resonance of the excitation device, the same for every reed.

    Attributes
    ----------
    frequency_hz : float
        4308.6 Hz on the paper's bench (picture 78 of both series).
    quality : float
    strength : float
        Static share of the resonant path beside the direct one.
    """

    frequency_hz: float = 4308.6
    quality: float = 25.0
    strength: float = 0.12


def cavity_gain(line: CavityLine, frequency_hz: float) -> complex:
    """Pressure at the tip over the pressure at the tweeter."""
    ratio = frequency_hz / line.frequency_hz
    return 1 + line.strength / (1 - ratio**2 + 1j * ratio / line.quality)


def pressure_shape(chamber: Chamber, frequency_hz: float, x_m: Array, y_m: Array) -> Array:
    """Pressure on the reed's flat side over the pressure at its tip, at points (any shape).

    Along the reed a standing wave that is closed at the tip; across it, full pressure over the
    open part of the window. Positive y is the left side, which stays open when the right half is
    filled.
    """
    wavenumber = 2 * np.pi * frequency_hz / chamber.sound_speed_m_s

    def step(distance_m: Array) -> Array:
        rise: Array = 0.5 * (1 + np.tanh(distance_m / chamber.edge_m))
        return rise

    shape: Array = np.cos(wavenumber * x_m) * step(chamber.length_m - x_m)
    shape = shape * step(chamber.half_width_m - np.abs(y_m))
    if chamber.filling is Filling.ASYMMETRIC:
        shape = shape * step(y_m)
    return shape
