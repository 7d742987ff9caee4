"""Vibration of the reed at one moment: tones of the drive, moduli of the hour, large motion."""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from studies.second_laboratory.campaigns.climate import Climate
from studies.second_laboratory.campaigns.effects.base import Body, Cast, ComplexArray, Moment
from studies.second_laboratory.drive import Drive
from studies.second_laboratory.reed import Reed

# Frequencies at which loads are computed; they are smooth between them. Harmonics above the last
# one are left out: the reduced reed ends far below.
_LOAD_HZ = np.concatenate([[0.0], np.linspace(1000.0, 41_000.0, 41)])
# The added mass of the air is known up to here.
_AIR_HZ = 21_000.0
# Large motion: at most this many steps, each halfway, until coordinates change by this part.
_STEPS, _SETTLED = 40, 1e-4
_KELVIN = 273.15


class Motion:
    """How one reed in one clamping answers.

    Parameters
    ----------
    reed : Reed
    drive : Drive
    cast : Cast
    """

    def __init__(self, reed: Reed, drive: Drive, cast: Cast) -> None:
        self._reed, self._drive, self._cast = reed, drive, cast
        x, y = reed.load_x, reed.load_y
        across = cast.through("across", y, x)
        patterns = [drive.pattern(hz, x, y, across) for hz in _LOAD_HZ]
        self._load = CubicSpline(_LOAD_HZ, [reed.load(each) for each in patterns])
        # Made once, for all copies with other moduli.
        _ = reed.vamp, reed.inertia(1000.0)

    def reed_in(self, climate: Climate) -> Reed:
        """Return the reed with the moduli and the mass of a climate."""
        cane = replace(
            self._reed.cane,
            temperature_c=climate.temperature_c,
            moisture=climate.moisture,
        )
        return self._reed.with_cane(cane)

    def coordinates(self, climate: Climate, gain: float, now: Moment) -> dict[int, ComplexArray]:
        """Return the motion at each harmonic of the drive, in mm of the reed's basis.

        Parameters
        ----------
        climate : Climate
        gain : float
            Factor of the sound: what wanders and scatters.
        now : Moment
        """
        tones = self._cast.through("tones", {1: complex(now.volts)}, now)
        hz = self._cast.through("drive_hz", now.drive_hz)
        reed, found = self.reed_in(climate), dict[int, ComplexArray]()
        for harmonic, tone in sorted(tones.items()):
            at_hz = harmonic * hz
            if at_hz > _LOAD_HZ[-1]:
                continue
            factor = self._cast.through("transfer", 1 + 0j, at_hz)
            pressure = 1e-6 * tone * gain * factor * self._drive.loudspeaker(at_hz)
            forces = np.asarray(pressure * self._load(at_hz))
            found[harmonic] = self._settled(reed, climate, at_hz, forces, now)
        return found

    def _settled(
        self, reed: Reed, climate: Climate, hz: float, forces: ComplexArray, now: Moment
    ) -> ComplexArray:
        """Return coordinates that agree with the stiffness that they cause."""
        stiffness = dynamic_stiffness(reed, climate, hz)
        coordinates = np.zeros_like(forces)
        for step in range(_STEPS):
            body = Body(reed, hz, coordinates)
            matrix = self._cast.through("dynamic", stiffness, body, now)
            wanted = np.linalg.solve(matrix, forces)
            if not self._cast.nonlinear:
                return np.asarray(wanted)
            change = np.linalg.norm(wanted - coordinates)
            halfway = 0.5 * (coordinates + wanted)
            coordinates = np.asarray(wanted if step == 0 else halfway)
            if change < _SETTLED * np.linalg.norm(wanted):
                break
        return np.asarray(coordinates)


def dynamic_stiffness(reed: Reed, climate: Climate, hz: float) -> ComplexArray:
    """Return K − ω²M with the air of a temperature."""
    omega = 2 * np.pi * hz
    return np.asarray(reed.stiffness(omega) - omega**2 * inertia(reed, climate, hz))


def inertia(reed: Reed, climate: Climate, hz: float) -> ComplexArray:
    """Return the mass with that of the air, whose density falls as its temperature rises."""
    thinner = (20.0 + _KELVIN) / (climate.temperature_c + _KELVIN)
    return reed.inertia(min(hz, _AIR_HZ), thinner)
