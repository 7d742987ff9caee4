"""How a case's reed answers its loudspeaker: in modal coordinates, in the steady state."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blind.air import air_masses
from blind.reed import ModalReed, built_thickness_m
from blind.world import Air, World

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

_PIVOT_HZ = 4000.0
_SOUND_M_S = 343.4
_AIR_HZ = np.geomspace(1.2e3, 21e3, 7)
# Window of the mouthpiece: length, half width, and over what the pressure falls at its walls.
_WINDOW_M, _HALF_M, _WALL_M = 33e-3, 5.3e-3, 0.7e-3
# What a shaken clamp moves by at a share of 1.
_SHAKEN_M_PA = 1e-6
# Relative changes of stiffness and loss per degree, and when fully dried.
_PER_C, _LOSS_PER_C = -1.2e-3, 0.012
_DRY_E, _DRY_G, _DRY_MASS, _DRY_LOSS = 0.10, 0.14, -0.03, -0.30


@dataclass(frozen=True)
class Answerer:
    """A reed and its loudspeaker, ready to be asked.

    Attributes
    ----------
    world : World
    reed : ModalReed
    mass : (m, m) float
        Of what sticks to the reed, in units of its modal masses.
    stiffness : (m, m) float
        Of what is broken or touches.
    air : (f, m, m) float
        Mass of normal air at `_AIR_HZ`.
    loss : (m,) float
        Factors on the loss of each mode.
    carried : (m,) float
        Mass that each mode has if the clamp moves.
    """

    world: World
    reed: ModalReed
    mass: Array
    stiffness: Array
    air: Array
    loss: Array
    carried: Array

    def base_m(self, hz: float, volts: float) -> complex:
        """By how much the clamp moves."""
        return self.world.air.shake * _SHAKEN_M_PA * speaker_pa(self.world.air, hz, volts)

    def deflection(
        self, hz: float, volts: float, after_s: float, level: float, clampings: int
    ) -> Complex:
        """Modal coordinates (m,) in m.

        Parameters
        ----------
        hz, volts : float
        after_s : float
            Time since the campaign began.
        level : float
            Phase amplitude that the reed was last seen to have, over 10 rad.
        clampings : int
            How often it has been clamped again.
        """
        cane, reed = self.world.cane, self.reed
        degrees = cane.warming_c_h * after_s / 3600 + cane.step_c * clampings
        dry = cane.drying * (1 - np.exp(-after_s / cane.drying_s))
        warm = 1 + _PER_C * degrees
        E = _relative(cane.E, cane.powers[0], hz) * warm * (1 + _DRY_E * dry) - 1
        G = _relative(cane.G, cane.powers[1], hz) * warm * (1 + _DRY_G * dry) - 1
        K = np.diag(reed.square) + E * reed.by_E + G * reed.by_G + self.stiffness
        K = K * (1 + cane.hardening * level**2)
        M = (1 + _DRY_MASS * dry) * np.eye(len(reed.square)) + self.mass
        if cane.air:
            M = M + cane.air * _interpolated(self.air, hz)
        loss = cane.loss * (hz / _PIVOT_HZ) ** cane.loss_power * (1 + cane.lossier * level**2)
        loss = loss * (1 + _LOSS_PER_C * degrees) * (1 + _DRY_LOSS * dry)
        root = np.sqrt(self.loss)
        lossy = K + 1j * loss * root[:, None] * K * root
        omega2 = (2 * np.pi * hz) ** 2
        force = self._pressure(hz, volts) @ reed.push_m3
        force = force + omega2 * self.base_m(hz, volts) * self.carried
        answer: Complex = np.linalg.solve(lossy - omega2 * M, force)
        return answer

    def _pressure(self, hz: float, volts: float) -> Complex:
        """Pressure (q,) in Pa on the flat side."""
        air, (x, y) = self.world.air, self.reed.bottom_m.T
        k = 2 * np.pi * hz / _SOUND_M_S
        wave = np.cos(k * x) * _below(x, _WINDOW_M) * _below(np.abs(y), _HALF_M)
        left = 1 / (1 + np.exp(-4 * y / _WALL_M))
        wave = wave * (left + air.open_right * (1 - left))
        pressure: Complex = speaker_pa(air, hz, volts) * wave * (1 + _distortion(air, hz, x, y))
        return pressure


def answerer(world: World, reed: ModalReed) -> Answerer:
    """Make a reed ready."""
    cane, (x, y) = world.cane, reed.top_m.T
    tip = reed.top_area_m2 * (x < 2e-3)
    side = reed.top_area_m2 * np.exp(-((x - 10e-3) ** 2 + (y - 5e-3) ** 2) / (2 * 1e-6))
    weight = cane.tip_kg * tip / tip.sum() + cane.side_kg * side / side.sum()
    mass = reed.top.T @ (weight[:, None] * reed.top)
    r2 = (x - cane.crack_m[0]) ** 2 + (y - cane.crack_m[1]) ** 2
    depth = cane.crack_depth_m * np.maximum(0, 1 - r2 / (3e-3) ** 2) * reed.top_area_m2
    stiffness = -reed.wood.E_L * reed.stretch.T @ (depth[:, None] * reed.stretch)
    r2 = (x - cane.stop_m[0]) ** 2 + (y - cane.stop_m[1]) ** 2
    touch = reed.top_area_m2 * (r2 < (2e-3) ** 2)
    touched = reed.top.T @ (touch / touch.sum())
    stiffness = stiffness + cane.stop_n_m * np.multiply.outer(touched, touched)
    rng = np.random.default_rng([world.seed, 71])
    loss = np.exp(cane.loss_scatter * rng.standard_normal(len(reed.square)))
    air = air_masses(reed, _AIR_HZ) if cane.air else np.zeros((len(_AIR_HZ), 1, 1))
    kg_m2 = reed.wood.density * built_thickness_m(world.build, x, y)
    carried = (reed.top_area_m2 * kg_m2) @ reed.top
    return Answerer(world, reed, mass, stiffness, air, loss, carried)


def speaker_pa(air: Air, hz: float, volts: float) -> complex:
    """Pressure of the loudspeaker at the tip."""
    r = hz / air.resonance_hz
    speaker = r**2 / (1 - r**2 + 1j * r / air.resonance_q) / (1 + 1j * hz / air.corner_hz)
    rng = np.random.default_rng([air.ripple_seed, 5])
    pitch = np.log(hz / 1e3) / np.log(20.0)
    waves = np.arange(1, 7)
    ripple = np.sum(
        rng.standard_normal(6) / waves * np.cos(np.pi * waves * pitch + 2 * np.pi * rng.random(6))
    )
    gain = np.exp(air.ripple * ripple)
    for line_hz, q, size in (
        (air.line_hz, air.line_q, air.line),
        (air.second_hz, air.second_q, air.second),
    ):
        s = hz / line_hz
        gain = gain * (1 + size / (1 - s**2 + 1j * s / q))
    if np.isfinite(air.roll_hz):
        s = hz / air.roll_hz
        gain = gain / (1 - s**2 + 1.414j * s)
    # The coil gets stiffer the farther it moves, most at low frequencies.
    bell = 1 / (1 + (hz / 6e3) ** 2)
    less = 1 - air.compression * bell * (volts / 16) ** 1.8
    return complex(air.pa_v * volts * speaker * gain * less)


def _relative(zener: tuple[float, float, float], power: float, hz: float) -> float:
    """Modulus over that at 4 kHz."""

    def storage(f: float) -> float:
        moved = (2 * np.pi * f * zener[2]) ** 2
        return zener[0] + zener[1] * moved / (zener[1] ** 2 + moved)

    return float(storage(hz) / storage(_PIVOT_HZ) * (hz / _PIVOT_HZ) ** power)


def _below(at: Array, limit: float) -> Array:
    fall: Array = 1 / (1 + np.exp(np.clip(4 * (at - limit) / _WALL_M, -60, 60)))
    return fall


def _distortion(air: Air, hz: float, x: Array, y: Array) -> Complex:
    """Smooth random field (q,), complex: plane waves of long wavelengths."""
    rng = np.random.default_rng([air.field_seed, 6])
    total = np.zeros(len(x), complex)
    pitch = np.log(hz / 1e3) / np.log(20.0)
    count = 8
    for _ in range(count):
        size, turn = rng.standard_normal(2)
        kx, ky, kf = rng.normal(0, [90.0, 200.0, 3.0])
        total += (size + 1j * turn) * np.exp(1j * (kx * x + ky * y + kf * pitch))
    field: Complex = air.field / np.sqrt(2 * count) * total
    return field


def _interpolated(table: Array, hz: float) -> Array:
    place = float(
        np.clip(
            np.interp(np.log(hz), np.log(_AIR_HZ), np.arange(len(_AIR_HZ))), 0, len(_AIR_HZ) - 1
        )
    )
    low = min(int(place), len(_AIR_HZ) - 2)
    share = place - low
    between: Array = (1 - share) * table[low] + share * table[low + 1]
    return between
