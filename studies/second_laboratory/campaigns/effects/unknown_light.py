"""Causes on no list: optics, laser, camera, clock."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.campaigns.effects.base import (
    LASTS_S,
    Array,
    Effect,
    Moment,
    Places,
    Waves,
    place,
    size,
)
from studies.second_laboratory.light import Geometry

# Multiples of this many numbers are the large steps of a converter, where codes go missing.
_STEP_DN = 256


@dataclass(frozen=True)
class DirtyWindow(Effect):
    """Spots on a window between the beam and the reed darken parts of the vamp."""

    id = "dirty_window"
    lost: float = size(
        0.05, 0.97, "", "light that is lost within a spot", "dust, fingerprints, drops (chosen)"
    )
    spots: float = place(3.0, 20.0, "", "how many")
    radius_mm: float = place(0.4, 3.0, "mm", "their mean radius")
    pattern: float = place(0.0, 1e6, "", "seed of their places")

    def places(self, places: Places) -> Places:
        """Darken the scatterers within spots."""
        rng = np.random.default_rng(int(self.pattern))
        kept = np.ones(len(places.lit))
        for _ in range(int(self.spots)):
            x, y, radius = rng.uniform(0, 38), rng.uniform(-6.5, 6.5), rng.exponential()
            square = (places.x_mm - x) ** 2 + (places.y_mm - y) ** 2
            inside = np.exp(-square / (self.radius_mm * radius) ** 2)
            kept *= 1 - self.lost * inside
        return replace(places, lit=places.lit * np.sqrt(kept))


@dataclass(frozen=True)
class GhostReflection(Effect):
    """A second, weaker image of the reed: light that is reflected twice in a beam splitter."""

    id = "ghost_reflection"
    ratio: float = size(
        0.01,
        0.3,
        "of the amplitude",
        "ghost over image",
        "4 % at an uncoated face, twice, up to a wrong coating (chosen)",
    )
    x_mm: float = place(-8.0, 8.0, "mm", "its shift along the reed")
    y_mm: float = place(-3.0, 3.0, "mm", "its shift across the reed")
    turn: float = place(0.0, 1.0, "turns", "its phase")

    def waves(self, waves: Waves, geometry: Geometry, now: Moment) -> Waves:
        """Add the waves, tilted, to themselves."""
        rate = geometry.wavelength_m * geometry.distance_m
        v, u = (geometry.axis(n) for n in waves.shape[1:])
        turns = 1e-3 * (self.y_mm * v[:, None] + self.x_mm * u) / rate + self.turn
        ghost = self.ratio * np.exp(2j * np.pi * turns)
        return np.asarray(waves * (1 + ghost), np.complex64)


@dataclass(frozen=True)
class WrongWavelength(Effect):
    """The laser has another wavelength than the bench file says."""

    id = "wrong_wavelength"
    nm: float = size(
        0.3,
        15.0,
        "nm",
        "error of 650 nm",
        "diodes of one type differ by ±10 nm (data sheets)",
        signed=True,
    )

    def geometry(self, geometry: Geometry) -> Geometry:
        """Change the wavelength."""
        return replace(geometry, wavelength_m=geometry.wavelength_m + 1e-9 * self.nm)


@dataclass(frozen=True)
class TwoLaserModes(Effect):
    """The laser runs in two modes, whose fringes slide past each other as its cavity warms."""

    id = "two_laser_modes"
    lost: float = size(
        0.03, 0.75, "", "contrast that is lost at the worst times", "multimode diodes (chosen)"
    )
    minutes: float = place(0.7, 8.0, "min", "time from one loss to the next")
    turn: float = place(0.0, 1.0, "turns", "phase at the start")

    def contrast(self, contrast: Array, now: Moment) -> Array:
        """Let the contrast rise and fall."""
        turns = now.middles_s / (60 * self.minutes) + self.turn
        return contrast * (1 - self.lost * np.sin(np.pi * turns) ** 2)


@dataclass(frozen=True)
class InterlacedRows(Effect):
    """Odd rows are exposed later than even rows: an interlaced camera."""

    id = "interlaced_rows"
    ms: float = size(
        0.3, 15.0, "ms", "delay of odd rows", "a part of the 40 ms of interlaced video (chosen)"
    )

    def row_delay_s(self, delay_s: float) -> float:
        """Delay the odd rows."""
        return delay_s + 1e-3 * self.ms


@dataclass(frozen=True)
class MissingCodes(Effect):
    """The converter has missing codes: numbers below its large steps are never given."""

    id = "missing_codes"
    dn: float = size(
        2.0, 80.0, "dn", "numbers that are missing below each multiple of 256",
        "a damaged or badly supplied converter; a good one misses none (chosen)",
    )  # fmt: skip

    def numbers(self, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Replace the numbers that are missing by the next that are not."""
        missing, within = round(self.dn), image % _STEP_DN
        up = image + (_STEP_DN - within)
        return np.where(within >= _STEP_DN - missing, up, image).astype(np.uint16)


@dataclass(frozen=True)
class PhaseSlips(Effect):
    """A synthesizer slips now and then: the phase of its beam jumps and stays there."""

    id = "phase_slips"
    per_minute: float = size(
        0.3,
        40.0,
        "1/min",
        "how often",
        "a reference that a phase-locked loop hardly holds (chosen)",
    )
    rad: float = place(0.5, 3.0, "rad", "how far, in either direction")

    def turns(self, turns: Array, times_s: Array, now: Moment) -> Array:
        """Add all jumps up to each time."""
        if "at" not in now.memory:
            count = now.rng.poisson(self.per_minute * 4 * LASTS_S / 60)
            now.memory["at"] = np.sort(now.rng.uniform(0, 4 * LASTS_S, count))
            steps = now.rng.choice([-1.0, 1.0], count) * self.rad / (2 * np.pi)
            now.memory["sum"] = np.concatenate([[0.0], np.cumsum(steps)])
        passed = np.searchsorted(now.memory["at"], times_s)
        return np.asarray(turns + now.memory["sum"][passed])
