"""Parameters of light: both beams, from the laser to the sensor."""

import math
from dataclasses import dataclass
from typing import Literal

from physics.parameters.quantity import quantity
from physics.reed.geometry import ReedGeometry

# Margins of the image around the vamp of a reed: across the reed in total, and behind the vamp.
# Chosen: a clarinet reed gets the default `Layout.reed_size_m`.
_SIDE_MARGIN_MM, _HEEL_MARGIN_MM = 0.5, 2.5
_HALF_FULL = "both beams together fill half a pixel in a frame of 80 ms"


@dataclass(frozen=True)
class Illumination:
    """Light on the reed and on the sensor, in electrons per pixel and second.

    Attributes
    ----------
    local_oscillator_e_s : float
        Local oscillator at its centre on the sensor.
    local_oscillator_waist_m : float
        1/e² radius of the expanded local oscillator on the sensor.
    local_oscillator_shift_m : (float, float)
        Displacement of its centre on the sensor, along rows and columns (y, x).
    object_e_s : float
        Light that the reed scatters, as a mean over the sensor.
    object_waist_m : float
        1/e² radius of the illumination on the reed.
    vignette : float
        Fraction of the light that is lost in the corners of the sensor.
    lamp_unevenness : float
        Relative rms over the sensor by which a lamp's light differs from its mean.
    reference_leak : float
        Power of the object light, relative to the whole, that is left on the sensor when its
        shutter is closed.
    lattices : {1, 2}
        Lattices of points of the reed that scatter, of the pitch of the image: 1 has a point in the
        middle of each pixel, 2 have them between. Of one lattice, images have no side lobes, and
        the edge of a reed is jagged.
    """

    local_oscillator_e_s: float = quantity(80e3, "electrons/s", 1e2, 1e15, _HALF_FULL)
    local_oscillator_waist_m: float = quantity(
        15e-3, "m", 3e-3, 1.0, "a beam expanded to fill the sensor"
    )
    local_oscillator_shift_m: tuple[float, float] = (0.0, 0.0)
    object_e_s: float = quantity(250.0, "electrons/s", 0.1, 1e13, _HALF_FULL)
    object_waist_m: float = quantity(35e-3, "m", 5e-3, 1.0, "a beam expanded to cover the reed")
    vignette: float = quantity(0.0, "", 0.0, 0.5, "lenses and apertures near the sensor")
    lamp_unevenness: float = quantity(
        0.0, "", 0.0, 0.5, "a lamp without an integrating sphere: EMVA 1288 asks for 3 % or less"
    )
    reference_leak: float = quantity(
        0.0, "", 0.0, 1.0, "light scattered around a shutter: 1e-4 to 1 %"
    )
    lattices: Literal[1, 2] = 1


@dataclass(frozen=True)
class Layout:
    """Position of the reed in front of the sensor.

    Attributes
    ----------
    wavelength_m : float
        Wavelength of the laser.
    distance_m : float
        Distance from reed to sensor.
    reed_centre_m : (float, float)
        Centre (y, x) of the visible reed relative to the optical axis. It is off axis, so that the
        image order is separated from the zero order and from the twin image.
    reed_size_m : (float, float)
        Height and width (y, x) of the rectangle around the visible reed; the tip touches its left
        side.
    defocus_m : float
        Distance at which images are focused less the true one.
    """

    wavelength_m: float = quantity(650e-9, "m", 400e-9, 1100e-9, "paper, section II.B")
    distance_m: float = quantity(1.0, "m", 0.1, 5.0, "chosen: the reed fills the object field")
    reed_centre_m: tuple[float, float] = (22e-3, 0.0)
    reed_size_m: tuple[float, float] = (14e-3, 38e-3)
    defocus_m: float = quantity(0.0, "m", -0.1, 0.1, "a distance by tape measure: centimetres")


def visible_size_m(geometry: ReedGeometry) -> tuple[float, float]:
    """Return height and width (y, x) of the vamp with a margin, in m, for `Layout.reed_size_m`.

    Both are rounded up to whole millimetres.
    """
    y_mm = 1e3 * 2 * geometry.outline.side_half_width_m + _SIDE_MARGIN_MM
    x_mm = 1e3 * geometry.vamp_x_m[-1] + _HEEL_MARGIN_MM
    return 1e-3 * math.ceil(y_mm), 1e-3 * math.ceil(x_mm)


@dataclass(frozen=True)
class Interference:
    """How well, and with which phase, the two beams interfere.

    Attributes
    ----------
    walk_rad_s : float
        Random walk of the phase between the beams, in rad per square root of a second.
    step_walk_rad : float
        Standard deviation of an additional step of this walk from one acquisition to the next.
    gain_scatter : float
        Standard deviation of the logarithm of the object light's amplitude from one acquisition to
        the next.
    power_noise : float
        Standard deviation of the laser's relative power from frame to frame.
    speckle_renewal : float
        Relative rms of the object light that is new in each acquisition: the correlation with the
        one before is √(1 − speckle_renewal²).
    field_change : float
        Relative rms of a smooth change of the object light, in size and phase, from one acquisition
        to the next.
    jitter_rad : float
        Standard deviation of additional random changes of this phase from frame to frame.
    quarter_error_rad : float
        Phase error of every second phase step.
    fade_per_h : float
        Relative loss of the laser's power per hour.
    hop, hop_after_h : float
        Relative loss of fringe contrast by a laser mode hop, and its time in hours since the
        campaign began.
    decorrelation_per_rad2 : float
        Loss of contrast per square of the phase amplitude.
    leak, crosstalk : float
        Relative amplitude of the carrier, and of the next sideband, in the image of each sideband.
    """

    walk_rad_s: float = quantity(
        0.05, "rad/s^0.5", 0.0, 3.0, "an interferometer on a table: 0.1 to 1 rad in a minute"
    )
    step_walk_rad: float = quantity(
        0.0, "rad", 0.0, 3.2, "air that moves and modulators that change frequency, in a step"
    )
    gain_scatter: float = quantity(
        0.0, "", 0.0, 0.3, "efficiency of two modulators at another frequency: up to some per cent"
    )
    power_noise: float = quantity(
        0.0, "", 0.0, 0.05, "laser diodes with regulated power: 0.1 to 1 % rms"
    )
    speckle_renewal: float = quantity(
        0.0, "", 0.0, 0.5, "Yamaguchi 1981: speckle that changes as the surface moves"
    )
    field_change: float = quantity(0.0, "", 0.0, 0.5, "beams that wander, air in layers")
    jitter_rad: float = quantity(0.0, "rad", 0.0, 1.0, "a tenth of a wavelength of path is 0.6 rad")
    quarter_error_rad: float = quantity(
        0.0, "rad", -0.5, 0.5, "a trigger that is late by some per cent of a period"
    )
    fade_per_h: float = quantity(0.0, "1/h", -0.5, 0.5, "lasers that warm up: up to 10 % an hour")
    hop: float = quantity(0.0, "", 0.0, 0.95, "from a little to most of the contrast")
    hop_after_h: float = quantity(0.1, "h", 0.0, 24.0, "at any time of a campaign")
    decorrelation_per_rad2: float = quantity(
        0.0, "1/rad2", 0.0, 0.02, "Yamaguchi 1981: speckle that changes as the surface tilts"
    )
    leak: float = quantity(0.0, "", 0.0, 1.0, "modulators pass 0.1 to 1 % of the unshifted light")
    crosstalk: float = quantity(0.0, "", 0.0, 1.0, "intermodulation of two synthesizers: -40 dB")


@dataclass(frozen=True)
class Optics:
    """All parameters of the light.

    Attributes
    ----------
    layout : Layout
    illumination : Illumination
    interference : Interference
    """

    layout: Layout = Layout()
    illumination: Illumination = Illumination()
    interference: Interference = Interference()
