"""Light of the reed on the sensor, for one clamping, and the reference that it beats with."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from studies.second_laboratory.campaigns.drawing import BeamParameters, Clamping
from studies.second_laboratory.campaigns.effects.base import (
    Array,
    Cast,
    ComplexArray,
    Moment,
    Places,
    Waves,
)
from studies.second_laboratory.light import (
    MIDDLE_MM,
    Geometry,
    Propagation,
    circular,
    drift_shapes,
    place_scatterers,
    vibration_samples,
)
from studies.second_laboratory.reed import Reed

# A narrower kernel than that of sweeps: its error, 5e-4 of the field, is an eighth of shot noise.
_KERNEL_WIDTH = 7
# Phases of a vibration over which the object's own light is averaged. It is 1 % of all light, and
# equal in the four frames of a hologram, which subtracts it. A smaller motion counts as rest.
_OWN_PHASES, _RESTS_RAD = 4, 0.02
# Steps of a sweep last this long; a reed at rest, in still air, ages ten times slower. Chosen.
_STEP_S, _AT_REST = 0.4, 0.1
# Radius of the pattern of dust on the sensor's window, in pixels. Chosen.
_DUST_PIXELS = 4.0


@dataclass(frozen=True)
class Beat:
    """How light beats with the reference in each frame.

    Attributes
    ----------
    drive_hz, beat_hz : float
        f, and Δ = f_AOM1 − f_AOM2, as set.
    middles_s : (m,) float64
        Middle of each exposure.
    exposure_s : float
    turns, detuning_hz : (m,) float64
        Phase of Δ in addition to what was set, in turns, and its mean slope in each exposure.
    lines : list
        Lines of the reference: offset in drive frequencies, and amplitude.
    """

    drive_hz: float
    beat_hz: float
    middles_s: Array
    exposure_s: float
    turns: Array
    detuning_hz: Array
    lines: list[tuple[int, complex]]

    def weights(self, samples: int) -> ComplexArray:
        """Return how strongly light at phases 2πk/samples of the vibration beats in each frame."""
        order = np.arange(-(samples // 2) + 1, samples - samples // 2)
        phases = np.exp(-2j * np.pi * np.outer(order, np.arange(samples)) / samples) / samples
        total = np.zeros((len(self.middles_s), samples), complex)
        for multiple, amplitude in self.lines:
            hz = order * self.drive_hz - (self.beat_hz + multiple * self.drive_hz)
            seen = np.sinc((hz - self.detuning_hz[:, None]) * self.exposure_s)
            turned = np.mod(hz * self.middles_s[:, None], 1.0) - self.turns[:, None]
            total += np.conj(amplitude) * (seen * np.exp(2j * np.pi * turned)) @ phases
        return total


class ReedImage:
    """Scatterers of a reed in one clamping, and their waves on the sensor.

    Parameters
    ----------
    reed : Reed
    beams : BeamParameters
    stated : Geometry
        As the bench file states it; the true one is what effects make of it.
    centre_m : (float, float)
        (y, x) of the middle of the vamp from the optical axis, as the bench file states it.
    clamping : Clamping
    cast : Cast
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        reed: Reed,
        beams: BeamParameters,
        stated: Geometry,
        centre_m: tuple[float, float],
        clamping: Clamping,
        cast: Cast,
        rng: np.random.Generator,
    ) -> None:
        self._beams, self._cast, self._rng = beams, cast, rng
        self.geometry = cast.through("geometry", stated)
        x, y = place_scatterers(beams.scatterers_per_cell, stated, rng)
        self._deflection = reed.deflection(x, y).astype(np.float32)
        self.places = cast.through("places", _seen(x, y, beams, centre_m, clamping))
        self._propagation = Propagation(
            self.geometry, self.places.u_m, self.places.v_m, _KERNEL_WIDTH
        )
        self._speckle = circular(rng, len(x))
        self._smooth = drift_shapes(x, y)
        self._drift = np.zeros(self._smooth.shape[1], complex)
        self._aged_s: float | None = None

    def age(self, time_s: float, driven: bool) -> None:
        """Renew a part of the speckle, and let the field drift, since the last call."""
        passed_s = _STEP_S if self._aged_s is None else time_s - self._aged_s
        self._aged_s = time_s
        steps = min(passed_s / _STEP_S, 1.0) if driven else 0.0
        steps += _AT_REST * max(passed_s / _STEP_S - steps, 0.0)
        renewal = self._cast.through("renewal", self._beams.renewal, time_s)
        # Of independent renewals the squares add up.
        new = min(math.sqrt(1 - (1 - min(renewal, 0.9) ** 2) ** steps), 1.0)
        fresh = circular(self._rng, len(self._speckle))
        self._speckle = math.sqrt(1 - new**2) * self._speckle + new * fresh
        walk = self._beams.drift_sd * math.sqrt(steps)
        self._drift = self._drift + walk * circular(self._rng, len(self._drift))

    def light(
        self, motion: dict[int, ComplexArray], beat: Beat, now: Moment
    ) -> tuple[Waves, NDArray[np.float32]]:
        """Return the waves that beat in each frame (m, ny, nx), and the object's own light.

        Parameters
        ----------
        motion : dict
            Coordinates of the reed's basis in mm, by harmonic.
        beat : Beat
        now : Moment
        """
        radians = 4e-3 * np.pi / self.geometry.wavelength_m
        amplitude_mm = {h: self._motion_of(q) for h, q in motion.items()}
        angles = {h: radians * each for h, each in amplitude_mm.items()}
        largest = sum(h * float(np.abs(each).max()) for h, each in angles.items())
        samples = -(-vibration_samples(largest) // _OWN_PHASES) * _OWN_PHASES
        field = self.places.lit * self._speckle * np.exp(self._smooth @ self._drift)
        phases = np.zeros((samples, len(field)), np.float32)
        for harmonic, angle in angles.items():
            turn = np.exp(2j * np.pi * harmonic * np.arange(samples) / samples).astype(np.complex64)
            phases += turn.real[:, None] * angle.real - turn.imag[:, None] * angle.imag
        # Sine and cosine apart: numpy has faster ones of real than of complex numbers.
        light = np.empty(phases.shape, np.complex64)
        np.cos(phases, out=light.real)
        np.sin(phases, out=light.imag)
        beating = beat.weights(samples).astype(np.complex64) @ light * field.astype(np.complex64)
        peak_um = np.zeros(len(field))
        for each in amplitude_mm.values():
            peak_um += 1e3 * np.abs(each)
        beating = self._cast.through("coherence", beating, peak_um)
        waves = self._propagation(beating)
        waves = self._cast.through("waves", waves, self.geometry, now)
        chosen = slice(0, 1) if largest < _RESTS_RAD else slice(0, None, samples // _OWN_PHASES)
        own = self._propagation((light[chosen] * field).astype(np.complex64))
        return waves, np.asarray(np.mean(np.abs(own) ** 2, 0))

    def _motion_of(self, coordinates: ComplexArray) -> NDArray[np.complex64]:
        parts = np.column_stack([coordinates.real, coordinates.imag]).astype(np.float32)
        moving = self._deflection @ parts
        return np.asarray(moving[:, 0] + 1j * moving[:, 1])


def _seen(
    x: Array, y: Array, beams: BeamParameters, centre_m: tuple[float, float], clamping: Clamping
) -> Places:
    """Return where scatterers are seen in a clamping, and how the beam lights them."""
    turn, (dx, dy) = clamping.turn_rad, clamping.place_mm
    along = (x - MIDDLE_MM) * math.cos(turn) - y * math.sin(turn) + dx
    across = (x - MIDDLE_MM) * math.sin(turn) + y * math.cos(turn) + dy
    square = (along - beams.illumination_mm[0]) ** 2 + (across - beams.illumination_mm[1]) ** 2
    lit = np.exp(-square / beams.illumination_radius_mm**2)
    lit = lit * np.sqrt(beams.object_share * beams.reference_e / np.sum(lit**2))
    return Places(x, y, 1e-3 * along + centre_m[1], 1e-3 * across + centre_m[0], lit)


def reference_beam(
    beams: BeamParameters, geometry: Geometry, rng: np.random.Generator
) -> ComplexArray:
    """Return the local oscillator on the sensor, whose mean over it is set to `reference_e`."""
    v, u = (geometry.axis(n) for n in geometry.shape)
    (y, x), radius = beams.reference_mm, 1e-3 * beams.reference_radius_mm
    square = (v[:, None] - 1e-3 * y) ** 2 + (u - 1e-3 * x) ** 2
    dust = gaussian_filter(rng.standard_normal(geometry.shape), _DUST_PIXELS, mode="wrap")
    power = np.exp(-2 * square / radius**2) * (1 + beams.dust * dust / dust.std())
    power *= beams.reference_e / power.mean()
    wave_number = 2 * np.pi / geometry.wavelength_m
    tilt = beams.reference_tilt_rad[0] * v[:, None] + beams.reference_tilt_rad[1] * u
    return np.asarray(np.sqrt(np.maximum(power, 0)) * np.exp(1j * wave_number * tilt))
