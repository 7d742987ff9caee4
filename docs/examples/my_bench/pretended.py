"""Instruments that do not exist, so that the template runs. Delete this file at the end."""

import math
import threading
from datetime import UTC, datetime, timedelta
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from drivers.context import BenchContext
from drivers.roles import Arrangement
from protocols.bench import CameraSensor, DataSheet

# Chosen: enough points of the reed for a speckle pattern, and light that fills a fifth of a pixel.
_POINTS = 150
_REFERENCE_E_S, _OBJECT_E_S, _LAMP_E_S = 4e4, 4e3, 1e5
_NM_PER_VOLT = 20.0
_ORDERS = range(-3, 4)


class PretendedClock:
    """Time that passes only when a driver or the program waits. Real instruments need no clock."""

    def __init__(self) -> None:
        self._now_s, self._opened = 0.0, datetime.now(UTC)
        # Outputs are switched off on several threads at once, and a ramp waits.
        self._lock = threading.Lock()

    def now_s(self) -> float:
        """Return the seconds that have passed."""
        return self._now_s

    def date(self) -> datetime:
        """Return the date in UTC; it passes as `now_s` does."""
        return self._opened + timedelta(seconds=self._now_s)

    def wait(self, seconds: float) -> None:
        """Let time pass; do nothing if `seconds` is not positive."""
        with self._lock:
            self._now_s += max(seconds, 0.0)


class PretendedLaboratory:
    """What the three drivers share: settings, clock, shutters and light.

    Each driver gets it by ``context.share(PretendedLaboratory)``; the first call makes it.
    """

    def __init__(self, context: BenchContext) -> None:
        self.clock = PretendedClock()
        context.clock = self.clock
        context.surroundings = self
        self.aom_hz = (Fraction(0), Fraction(0))
        self.rf_on = self.drive_on = False
        self.drive_hz, self.drive_v = Fraction(1000), 0.0
        self._arrangement = Arrangement.HOLOGRAMS
        self._rng, self._optics = context.rng, context.description.optics
        self._pixel_m = float(context.description.instruments.camera.pixel_m)
        self._shape = (0, 0)
        self.clamp_again()

    def arrange(self, arrangement: Arrangement) -> None:
        """Operate shutters and lamp."""
        self._arrangement = arrangement

    def clamp_again(self) -> None:
        """Scatter light from other points: a reed is never put back where it was."""
        x, y = self._rng.uniform(-15e-3, 15e-3, _POINTS), self._rng.uniform(-5e-3, 5e-3, _POINTS)
        # The fraction of the tip's motion, and the light of each point.
        self._motion = ((15e-3 - x) / 30e-3) ** 2
        self._speckle = np.exp(2j * np.pi * self._rng.random(_POINTS)) / math.sqrt(_POINTS)
        centre = self._optics.reed_centre
        self._x_m, self._y_m = x + float(centre.x_m), y + float(centre.y_m)

    def prepare(self, shape: tuple[int, int]) -> None:
        """Choose the rows and columns that are read."""
        self._shape = shape

    def expose(
        self, start_s: float, exposure_s: float, sheet: DataSheet, camera: CameraSensor
    ) -> NDArray[np.uint16]:
        """Return one frame (rows, columns)."""
        electrons = np.maximum(exposure_s * self._light_e_s(start_s, exposure_s), 0.0)
        noise = np.sqrt(electrons + sheet.read_noise_e**2)
        electrons = electrons + noise * self._rng.standard_normal(self._shape)
        numbers = sheet.offset_dn + np.minimum(electrons, sheet.full_well_e) / sheet.gain_e_dn
        return np.clip(np.rint(numbers), 0, 2**camera.bits - 1).astype(np.uint16)

    def _light_e_s(self, start_s: float, exposure_s: float) -> NDArray[np.float64]:
        dark = np.zeros(self._shape)
        if self._arrangement is Arrangement.FLAT:
            return dark + _LAMP_E_S
        if self._arrangement is Arrangement.DARK or not self.rf_on:
            return dark
        if self._arrangement is Arrangement.LO_ONLY:
            return dark + _REFERENCE_E_S
        if self._arrangement is Arrangement.OBJECT_ONLY:
            return dark + _OBJECT_E_S
        wave = math.sqrt(_OBJECT_E_S) * self._on_sensor(self._beating(start_s, exposure_s))
        # AOM1 shifts the reference beam E_LO. The camera sees |E_LO|² + |E|² + 2 Re(E conj(E_LO)).
        return _REFERENCE_E_S + _OBJECT_E_S + 2 * math.sqrt(_REFERENCE_E_S) * wave.real

    def _beating(self, start_s: float, exposure_s: float) -> NDArray[np.complex128]:
        """Return E conj(E_LO) of each point, averaged over an exposure."""
        volts = self.drive_v if self.drive_on else 0.0
        wavelength_m = float(self._optics.wavelength_m)
        depth_rad = 4e-9 * np.pi * _NM_PER_VOLT * volts / wavelength_m * self._motion
        light = np.zeros(_POINTS, complex)
        for order in _ORDERS:
            # Sideband n has f_AOM2 + n f, the reference f_AOM1. The time factor is exp(+2πi f t):
            # with the lock f_AOM1 - f_AOM2 = n f + f_CCD/4, the phase turns by -90° per frame.
            beat_hz = float(order * self.drive_hz - (self.aom_hz[0] - self.aom_hz[1]))
            turn = np.exp(2j * np.pi * beat_hz * (start_s + exposure_s / 2))
            light += 1j**order * jv(order, depth_rad) * np.sinc(beat_hz * exposure_s) * turn
        return np.asarray(light * self._speckle)

    def _on_sensor(self, light: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the wave of all points, a distance away (Fresnel)."""
        curvature = float(self._optics.wavelength_m * self._optics.distance_m)
        axes = [(np.arange(count) - count // 2) * self._pixel_m for count in self._shape]
        rows, columns = (
            np.exp(-1j * np.pi * (axis[:, None] - place_m) ** 2 / curvature)
            for axis, place_m in zip(axes, (self._y_m, self._x_m), strict=True)
        )
        return np.asarray((rows * light) @ columns.T)
