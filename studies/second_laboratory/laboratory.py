"""The laboratory behind the three instruments: what the camera sees of the vibrating reed."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.drive import Drive
from studies.second_laboratory.light import (
    MIDDLE_MM,
    Geometry,
    Propagation,
    circular,
    drift_shapes,
    exposure_weights,
    place_scatterers,
    vibration_samples,
)
from studies.second_laboratory.parameters import BenchParameters, CameraParameters, ReedParameters
from studies.second_laboratory.reed import Reed

# Fields that are propagated at a time, to bound the memory.
_AT_ONCE = 16


@lru_cache(maxsize=2)
def solved(parameters: ReedParameters) -> Reed:
    """Return the reduced model of a reed; the last two are kept."""
    return Reed(parameters.cane, parameters.thickness, parameters.clamp, air=parameters.air)


@dataclass
class Settings:
    """What the instruments play."""

    aom1_hz: Fraction
    aom2_hz: Fraction
    rf: bool = False
    drive_hz: Fraction = Fraction(1000)
    volts: float = 0.0
    sounding: bool = False


class Laboratory:
    """Reed, loudspeaker, beams and sensor.

    Parameters
    ----------
    reed : Reed
    bench : BenchParameters
    clay : bool
        Whether half of the chamber is filled, as in series A.
    geometry : Geometry
    centre_m : (float, float)
        (y, x) of the middle of the vamp from the optical axis.
    settings : Settings
        Shared with the instruments, which change it.
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        reed: Reed,
        bench: BenchParameters,
        clay: bool,
        geometry: Geometry,
        centre_m: tuple[float, float],
        settings: Settings,
        rng: np.random.Generator,
    ) -> None:
        self._reed, self._bench, self._rng, self.settings = reed, bench, rng, settings
        self._drive, self._geometry = Drive(bench.drive, clay), geometry
        self._place_scatterers(centre_m)
        self._sensor = Sensor(bench.camera, geometry.shape, rng)
        self._reference = _reference_beam(bench, geometry)
        self._path_rad = 0.0
        self._drift = np.zeros(self._smooth.shape[1], complex)

    def _place_scatterers(self, centre_m: tuple[float, float]) -> None:
        light, geometry, rng = self._bench.light, self._geometry, self._rng
        x, y = place_scatterers(light.scatterers_per_cell, geometry, rng)
        self._deflection = self._reed.deflection(x, y)
        self._propagation = Propagation(
            geometry, 1e-3 * (x - MIDDLE_MM) + centre_m[1], 1e-3 * y + centre_m[0]
        )
        from_beam = (x - MIDDLE_MM - light.illumination_mm[0]) ** 2
        from_beam = from_beam + (y - light.illumination_mm[1]) ** 2
        self._lit = np.exp(-from_beam / light.illumination_radius_mm**2)
        power = light.object_share * light.reference_e / np.sum(self._lit**2)
        self._lit = self._lit * np.sqrt(power)
        self._speckle = circular(rng, len(x))
        self._smooth = drift_shapes(x, y)

    def vibration_mm(self) -> NDArray[np.complex128]:
        """Return the complex amplitude of each scatterer along the line of sight."""
        now = self.settings
        if not now.sounding or now.volts == 0:
            return np.zeros(len(self._lit), complex)
        hz = float(now.drive_hz)
        pressure = self._drive.pressure_mpa(hz, self._reed.load_x, self._reed.load_y)
        gain = 1 + self._bench.drive.gain_sd * self._rng.standard_normal()
        return np.asarray(self._deflection @ (now.volts * gain * self._reed.response(hz, pressure)))

    def expose(self, starts_s: Sequence[float], exposure_s: float) -> list[NDArray[np.uint16]]:
        """Return the frames of consecutive exposures under the present settings."""
        light, rng, now = self._bench.light, self._rng, self.settings
        starts = np.asarray(starts_s) + self._bench.camera.jitter_s * rng.standard_normal(
            len(starts_s)
        )
        self._age()
        path = self._path_rad + light.path_frames_rad / 2 * np.concatenate(
            [[0.0], np.cumsum(rng.standard_normal(len(starts) - 1))]
        )
        self._path_rad = path[-1] + light.path_sd_rad * rng.standard_normal()
        power = 1 + light.laser_sd * rng.standard_normal(len(starts))
        beating, own = self._light(starts, exposure_s)
        frames = []
        for wave, angle, factor in zip(beating, path, power, strict=True):
            cross = 2 * np.real(wave * np.exp(1j * angle) * self._reference.conj())
            light_e = now.rf * factor * (np.abs(self._reference) ** 2 + own + cross)
            frames.append(self._sensor(light_e))
        return frames

    def _age(self) -> None:
        """Replace a part of the speckle, and let the field drift."""
        light, rng = self._bench.light, self._rng
        new = circular(rng, len(self._speckle))
        self._speckle = np.sqrt(1 - light.renewal**2) * self._speckle + light.renewal * new
        self._drift = self._drift + light.drift_sd * circular(rng, len(self._drift))

    def _light(
        self, starts_s: NDArray[np.float64], exposure_s: float
    ) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
        """Return the light that beats with the reference in each frame, and the object's own."""
        now, moving = self.settings, self.vibration_mm()
        angle = 4e-3 * np.pi / self._geometry.wavelength_m * moving
        count = vibration_samples(float(np.abs(angle).max()))
        beat_hz = float(now.aom1_hz - now.aom2_hz)
        weights = exposure_weights(float(now.drive_hz), beat_hz, starts_s, exposure_s, count)
        field = self._lit * self._speckle * np.exp(self._smooth @ self._drift)
        beating = np.zeros((len(starts_s), *self._geometry.shape), np.complex64)
        own = np.zeros(self._geometry.shape)
        turns = np.exp(2j * np.pi * np.arange(count) / count)
        for first in range(0, count, _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            phases = np.real(turns[part, None] * angle)
            waves = self._propagation((field * np.exp(1j * phases)).astype(np.complex64))
            beating += np.tensordot(weights[:, part].astype(np.complex64), waves, 1)
            own += np.sum(np.abs(waves) ** 2, 0) / count
        return beating, own


def _reference_beam(bench: BenchParameters, geometry: Geometry) -> NDArray[np.complex128]:
    light = bench.light
    v, u = (geometry.axis(n) for n in geometry.shape)
    off = (v[:, None] - 1e-3 * light.reference_mm[0]) ** 2 + (u - 1e-3 * light.reference_mm[1]) ** 2
    wave_number = 2 * np.pi / geometry.wavelength_m
    tilt = wave_number * (
        light.reference_tilt_rad[0] * v[:, None] + light.reference_tilt_rad[1] * u
    )
    amplitude = np.sqrt(light.reference_e) * np.exp(-off / (1e-3 * light.reference_radius_mm) ** 2)
    return np.asarray(amplitude * np.exp(1j * tilt))


class Sensor:
    """Electrons and digital numbers of a 12-bit camera."""

    def __init__(
        self, parameters: CameraParameters, shape: tuple[int, int], rng: np.random.Generator
    ) -> None:
        self._p, self._rng = parameters, rng
        self._response = 1 + parameters.uniformity * rng.standard_normal(shape)
        self._before: NDArray[np.float64] | None = None

    def __call__(self, light_e: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Return the frame of a mean number of electrons in each pixel."""
        p, rng = self._p, self._rng
        mean = np.maximum(light_e, 0) * self._response
        electrons = mean + np.sqrt(mean) * rng.standard_normal(mean.shape)
        before = electrons if self._before is None else self._before
        self._before = electrons
        electrons = electrons + p.lag * (before - electrons)
        electrons = electrons * (1 - p.bend * electrons / p.full_well_e)
        electrons = electrons + p.read_noise_e * rng.standard_normal(mean.shape)
        electrons = electrons + p.row_noise_e * rng.standard_normal((mean.shape[0], 1))
        numbers = p.offset_dn + np.minimum(electrons, p.full_well_e) / p.electrons_per_dn
        return np.asarray(np.clip(np.round(numbers), 0, 4095).astype(np.uint16))
