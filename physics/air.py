"""The air that drives the reed: the chamber of the mouthpiece, between tweeter and reed."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from holography.arrays import Array
from physics.reed.geometry import ReedGeometry

# Distance between the end of the window and the clamp, and width of the reed's edge that a side
# wall covers. Chosen: with these, a clarinet reed gets the default dimensions of `Chamber`.
_BEFORE_CLAMP_M = 5.2e-3
_COVERED_EDGE_M = 1.275e-3


class Filling(StrEnum):
    """Preparation of the mouthpiece's chamber.

    Attributes
    ----------
    SYMMETRIC : the chamber is open.
    ASYMMETRIC : modelling clay fills the right half, so only the left half of the reed is driven.
    """

    SYMMETRIC = "symmetric"
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
        Half width of the window; the side walls cover the reed's edges beyond it.
    edge_m : float
        Distance over which the pressure falls to zero at a wall.
    sound_speed_m_s : float
        Speed of sound; the default is that of air at about 20 °C.
    """

    filling: Filling = Filling.SYMMETRIC
    length_m: float = 33e-3
    half_width_m: float = 5.3e-3
    edge_m: float = 0.6e-3
    sound_speed_m_s: float = 343.0


def chamber_of(geometry: ReedGeometry, filling: Filling) -> Chamber:
    """Return the chamber of a mouthpiece for a given reed.

    Distance from window to clamp and covered width of the edges are those of a clarinet reed on the
    paper's mouthpiece.
    """
    half_width_m = geometry.outline.side_half_width_m - _COVERED_EDGE_M
    return Chamber(
        filling,
        # Rounded to 1 µm, so that equal reeds have chambers that are equal to the last bit.
        length_m=round(geometry.clamp.x_m[0] - _BEFORE_CLAMP_M, 6),
        half_width_m=round(half_width_m, 6),
    )


@dataclass(frozen=True)
class CavityLine:
    """An acoustic resonance of the excitation device, the same for every reed.

    Attributes
    ----------
    frequency_hz : float
        Resonance frequency; 4308.6 Hz on the paper's bench (picture 78 of both series).
    quality : float
        Quality factor.
    strength : float
        Pressure through the resonant path at low frequency, relative to the direct path.
    """

    frequency_hz: float = 4308.6
    quality: float = 25.0
    strength: float = 0.12


def cavity_gain(line: CavityLine, frequency_hz: float) -> complex:
    """Return the ratio of the pressures at the reed's tip and at the tweeter."""
    ratio = frequency_hz / line.frequency_hz
    return 1 + line.strength / (1 - ratio**2 + 1j * ratio / line.quality)


def pressure_shape(chamber: Chamber, frequency_hz: float, x_m: Array, y_m: Array) -> Array:
    """Return the pressure on the reed's flat side, relative to the pressure at its tip.

    Along the reed it is a standing wave that is closed at the tip. Across the reed it is constant
    over the open part of the window. Positive y is the left side, which stays open if the right
    half is filled.

    Parameters
    ----------
    chamber : Chamber
    frequency_hz : float
    x_m, y_m : float arrays of one shape
        Points on the flat side in coordinates of the reed, in m.

    Returns
    -------
    float array of the same shape
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
