"""Parameters of the mouthpiece's chamber, and of the pressure in it."""

from dataclasses import dataclass
from enum import StrEnum

from physics.parameters.quantity import quantity
from physics.reed.geometry import ReedGeometry

# Distance between the end of the window and the clamp, and width of the reed's edge that a side
# wall covers. Chosen: with these, a clarinet reed gets the default dimensions of `Chamber`.
_BEFORE_CLAMP_M = 5.2e-3
_COVERED_EDGE_M = 1.275e-3
_MOUTHPIECE = "a clarinet mouthpiece, by ruler"


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
class PressureDistortion:
    """A smooth random error of the pressure on the reed: the factor 1 + a complex random field.

    Attributes
    ----------
    rms : float
        Root mean square of the complex field, over the chamber's window and over 1 to 20 kHz with
        equal weight per octave; 0 for no error.
    seed : int
        Seed of the random field.
    """

    rms: float = quantity(
        0.0, "", 0.0, 10.0, "a chamber of unknown inner shape: up to the pressure itself"
    )
    seed: int = 0


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
        Speed of sound.
    leak : float
        Fraction of the pressure that reaches the half that clay should fill.
    travelling : float
        Amplitude of the wave that travels away from the tip, relative to the standing wave: 0 if
        the far end reflects all sound, 1 if it absorbs all.
    rail_leak : float
        Fraction of the pressure that passes between the reed and the rails of the window, and acts
        on the edges that they cover.
    distortion : PressureDistortion
    """

    filling: Filling = Filling.SYMMETRIC
    length_m: float = quantity(33e-3, "m", 10e-3, 80e-3, _MOUTHPIECE)
    half_width_m: float = quantity(5.3e-3, "m", 2e-3, 12e-3, _MOUTHPIECE)
    edge_m: float = quantity(0.6e-3, "m", 0.1e-3, 2e-3, "gap between reed and walls")
    sound_speed_m_s: float = quantity(343.0, "m/s", 331.0, 355.0, "dry air from 0 to 40 degC")
    leak: float = quantity(0.0, "", 0.0, 1.0, "clay that does not close tightly")
    travelling: float = quantity(
        0.0, "", -1.0, 1.0, "a wave in a duct: all standing to all travelling"
    )
    rail_leak: float = quantity(
        0.0, "", 0.0, 1.0, "a reed that lies flat on the rails closes them; a warped one does not"
    )
    distortion: PressureDistortion = PressureDistortion()


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
