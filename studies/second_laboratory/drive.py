"""Loudspeaker and mouthpiece: the pressure on the flat side of the reed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.air import SOUND
from studies.second_laboratory.parameters import DriveParameters

# The window begins behind the tip rail and ends where the table of the mouthpiece begins, mm; over
# these distances the pressure rises from its value on rail and table. Usual clarinet mouthpieces.
_WINDOW = (1.0, 34.0)
_RISE = (0.5, 1.5)
_SIDE_RISE, _CLAY_RISE = 0.5, 0.8


@dataclass(frozen=True)
class Drive:
    """Pressure per volt on one reed, in one series.

    Parameters
    ----------
    parameters : DriveParameters
    clay : bool
        Whether the right half of the chamber, y < 0, is filled, as in series A.
    """

    parameters: DriveParameters
    clay: bool

    def loudspeaker(self, hz: float) -> complex:
        """Return the pressure at the tip, in Pa per volt."""
        p = self.parameters
        s = 1j * hz
        high = s**2 / (s**2 + s * p.highpass_hz / 0.8 + p.highpass_hz**2)
        low = p.lowpass_hz**2 / (s**2 + s * p.lowpass_hz / 0.7 + p.lowpass_hz**2)
        membrane = 1.0 + 0j
        for pole_hz, quality, residue in p.breakup:
            width_hz = pole_hz / quality
            membrane += residue * s * width_hz / (s**2 + s * width_hz + pole_hz**2)
        pole_hz, quality, residue = p.cavity
        cavity = 1 + residue * pole_hz**2 / (s**2 + s * pole_hz / quality + pole_hz**2)
        return complex(p.pascal_per_volt * high * low * membrane * cavity)

    def pressure_mpa(
        self, hz: float, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Return the pressure on the flat side less that on the bark side, in MPa per volt."""
        return np.asarray(1e-6 * self.loudspeaker(hz) * self.pattern(hz, x_mm, y_mm))

    def pattern(
        self,
        hz: float,
        x_mm: NDArray[np.float64],
        y_mm: NDArray[np.float64],
        across_mm: NDArray[np.float64] | None = None,
    ) -> NDArray[np.complex128]:
        """Return the pressure over that of `loudspeaker`.

        `across_mm` is which y of the chamber lies behind each point; the same y if None.
        """
        p = self.parameters
        k = 2 * np.pi * hz / SOUND
        # Closed at the tip: a standing wave with its antinode there, and one that travels to it.
        wave = (1 - p.travelling) * np.cos(k * x_mm) + p.travelling * np.exp(1j * k * x_mm)
        along = _rise((x_mm - _WINDOW[0]) / _RISE[0]) * _rise((_WINDOW[1] - x_mm) / _RISE[1])
        y = (y_mm if across_mm is None else across_mm) + p.lateral_mm
        open_part = along * _rise((p.chamber_half_mm - np.abs(y)) / _SIDE_RISE)
        share = p.on_rails + (1 - p.on_rails) * open_part
        if self.clay:
            share = share * (p.through_clay + (1 - p.through_clay) * _rise(y / _CLAY_RISE))
        # Behind the table the flat side rests on the wedge, and no pressure gets there.
        vamp = _rise((36.0 - x_mm) / _RISE[1])
        return np.asarray(vamp * (share * wave - p.leakage))


def _rise(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(0.5 + 0.5 * np.tanh(2 * distance))
