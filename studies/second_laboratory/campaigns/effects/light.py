"""Laser, beams, and the frequencies that they carry."""

from dataclasses import dataclass, replace

import numpy as np

from studies.second_laboratory.campaigns.drawing import BeamParameters
from studies.second_laboratory.campaigns.effects.base import (
    LASTS_S,
    Array,
    Effect,
    Moment,
    Waves,
    place,
    size,
)
from studies.second_laboratory.light import Geometry

_SPURS = "spurs and intermodulation of synthesizers and RF amplifiers, −70 to −20 dBc (chosen)"


@dataclass(frozen=True)
class LaserPowerDrift(Effect):
    """The laser becomes stronger or weaker all the time."""

    id = "laser_power_drift"
    per_hour: float = size(
        0.03,
        0.6,
        "per hour",
        "relative change of the power",
        "diode lasers that are not stabilised, while they warm up (chosen)",
        signed=True,
    )

    def power(self, power: Array, now: Moment) -> Array:
        """Change the power in proportion to time."""
        return power * (1 + self.per_hour * now.middles_s / 3600)


@dataclass(frozen=True)
class LaserModeHop(Effect):
    """The laser hops to a mode of less coherence: contrast is lost at once, and for good."""

    id = "laser_mode_hop"
    lost: float = size(
        0.03,
        0.7,
        "",
        "contrast that is lost",
        "diode lasers at a mode hop (Wieman & Hollberg 1991)",
    )
    at: float = place(0.1, 0.9, "of 15 min", "when it hops")

    def contrast(self, contrast: Array, now: Moment) -> Array:
        """Lower the contrast after the hop."""
        return contrast * (1 - self.lost * (now.middles_s > self.at * LASTS_S))


@dataclass(frozen=True)
class SpeckleDecorrelation(Effect):
    """Fringes lose contrast with amplitude: where the reed moves far, its speckle is smeared."""

    id = "speckle_decorrelation"
    per_um: float = size(
        0.08,
        1.5,
        "1/µm",
        "inverse of the amplitude at which the light falls to 1/e",
        "tilts smear speckle by twice the slope times the distance (Goodman 2007, ch. 9; chosen)",
    )

    def coherence(self, field: Waves, amplitude_um: Array) -> Waves:
        """Lower the light by a Gaussian of the amplitude."""
        return np.asarray(field * np.exp(-((self.per_um * amplitude_um) ** 2)), np.complex64)


@dataclass(frozen=True)
class SidebandCrosstalk(Effect):
    """The next sideband leaks in: a weak line of the reference beats with it."""

    id = "sideband_crosstalk"
    ratio: float = size(0.003, 0.3, "of the amplitude", "line at f1 + f over that at f1", _SPURS)
    turn: float = place(0.0, 1.0, "turns", "its phase")

    def lines(self, lines: list[tuple[int, complex]]) -> list[tuple[int, complex]]:
        """Add a line one drive frequency above."""
        return [*lines, (1, complex(self.ratio * np.exp(2j * np.pi * self.turn)))]


@dataclass(frozen=True)
class CarrierLeak(Effect):
    """Unshifted light leaks in: a weak line of the reference beats with the carrier."""

    id = "carrier_leak"
    ratio: float = size(3e-4, 0.1, "of the amplitude", "line at f1 − f over that at f1", _SPURS)
    turn: float = place(0.0, 1.0, "turns", "its phase")

    def lines(self, lines: list[tuple[int, complex]]) -> list[tuple[int, complex]]:
        """Add a line one drive frequency below."""
        return [*lines, (-1, complex(self.ratio * np.exp(2j * np.pi * self.turn)))]


@dataclass(frozen=True)
class PhaseStepError(Effect):
    """Phase steps are unequal: every other frame has a phase that is off."""

    id = "phase_step_error"
    rad: float = size(
        0.01,
        0.3,
        "rad",
        "phase of every other frame",
        "piezos 5–10 % (Schwider et al. 1983, Appl. Opt. 22); an uneven trigger (chosen)",
        signed=True,
    )

    def path(self, path_rad: Array, now: Moment) -> Array:
        """Turn the second and the fourth frame."""
        return path_rad + self.rad * (np.arange(len(path_rad)) % 2)


@dataclass(frozen=True)
class Defocus(Effect):
    """The reed is nearer or farther than the bench file says."""

    id = "defocus"
    mm: float = size(
        2.0,
        80.0,
        "mm",
        "error of 1 m",
        "tape measures to a wrong reference plane (chosen)",
        signed=True,
    )

    def geometry(self, geometry: Geometry) -> Geometry:
        """Change the distance."""
        return replace(geometry, distance_m=geometry.distance_m + 1e-3 * self.mm)


@dataclass(frozen=True)
class LoMisalignment(Effect):
    """The local oscillator is off centre on the sensor; its level is set again for that."""

    id = "lo_misalignment"
    mm: float = size(
        1.5, 9.0, "mm", "distance of its middle from the sensor's", "a knocked mirror (chosen)"
    )
    turn: float = place(0.0, 1.0, "turns", "its direction")

    def beams(self, beams: BeamParameters) -> BeamParameters:
        """Move the beam."""
        angle, (y, x) = 2 * np.pi * self.turn, beams.reference_mm
        moved = (y + self.mm * float(np.sin(angle)), x + self.mm * float(np.cos(angle)))
        return replace(beams, reference_mm=moved)


@dataclass(frozen=True)
class Vignetting(Effect):
    """Something cuts off the corners of the light on the sensor, whatever its source."""

    id = "vignetting"
    lost: float = size(
        0.03,
        0.8,
        "",
        "light that is lost in the corners",
        "filters and mounts that are too small (chosen)",
    )

    def beams(self, beams: BeamParameters) -> BeamParameters:
        """Darken the corners."""
        return replace(beams, vignetting=1 - (1 - beams.vignetting) * (1 - self.lost))


@dataclass(frozen=True)
class BenchVibration(Effect):
    """The bench vibrates: the phase jitters from frame to frame, and a little within each."""

    id = "bench_vibration"
    rad: float = size(
        0.02,
        0.3,
        "rad sd",
        "jitter of each frame's phase",
        "floors of 1–30 µm/s at 5–30 Hz (Gordon 1991, Proc. SPIE 1619), and what an isolated table "
        "leaves of that (chosen)",
    )

    def path(self, path_rad: Array, now: Moment) -> Array:
        """Turn each frame at random."""
        return path_rad + self.rad * now.rng.standard_normal(len(path_rad))

    def contrast(self, contrast: Array, now: Moment) -> Array:
        """Lower the contrast by the motion within an exposure, half of that between them."""
        return contrast * float(np.exp(-0.5 * (0.5 * self.rad) ** 2))
