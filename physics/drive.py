"""The drive: sound pressure at the tip of the reed from the volts at the amplifier's load."""

import numpy as np

from holography.arrays import Array, ComplexArray
from physics.parameters.drive import AcousticResonance, Drive, Tweeter

# Volts to which `Drive.compression` refers: the most that the paper's sweeps use.
_FULL_V = 16.0
# Frequency to which `Drive.roll_off` refers.
_ROLL_OFF_HZ = 1e4
# A tweeter that compresses keeps at least this fraction of the pressure.
_LEAST_KEPT = 0.02


def tweeter_pressure_pa(tweeter: Tweeter, frequency_hz: float, volts: float) -> complex:
    """Return the complex pressure amplitude in Pa for a sine of given peak volts at the load."""
    if not tweeter.connected:
        return 0j
    ratio = frequency_hz / tweeter.resonance_hz
    high_pass = -(ratio**2) / (1 - ratio**2 + 1j * ratio / tweeter.resonance_quality)
    low_pass = 1 / (1 + 1j * frequency_hz / tweeter.corner_hz)
    return tweeter.sensitivity_pa_v * volts * high_pass * low_pass


def resonance_gain(resonance: AcousticResonance, hz: Array | float) -> ComplexArray:
    """Return the ratio of the pressures behind and before an acoustic resonance."""
    ratio = np.asarray(hz, dtype=float) / resonance.frequency_hz
    residue = resonance.strength * np.exp(1j * resonance.phase_rad)
    through = residue / (1 - ratio**2 + 1j * ratio / resonance.quality)
    return np.asarray(1 + through, dtype=complex)


def acoustic_gain(drive: Drive, hz: Array | float) -> ComplexArray:
    """Return the ratio of the pressures at the reed's tip and at the tweeter."""
    paths = np.ones(np.shape(hz), dtype=complex)
    listed = drive.acoustic_resonance, *drive.further_resonances
    for line in (*listed, drive.second_resonance, drive.third_resonance):
        paths = paths * resonance_gain(line, hz)
    return paths + complex(drive.bypass_real, drive.bypass_imaginary)


def amplifier_gain(drive: Drive, hz: Array | float) -> ComplexArray:
    """Return the gain of an amplifier with a Butterworth low-pass of second order."""
    ratio = drive.roll_off * np.asarray(hz, dtype=float) / _ROLL_OFF_HZ
    return np.asarray(1 / (1 + 1j * np.sqrt(2) * ratio - ratio**2), dtype=complex)


def kept_by_tweeter(drive: Drive, volts: Array | float, hz: Array | float) -> Array:
    """Return the fraction of the pressure that a compressing tweeter keeps."""
    moves = 1 / (1 + (np.asarray(hz, dtype=float) / drive.compression_hz) ** 2)
    lost = drive.compression * moves * (np.asarray(volts, dtype=float) / _FULL_V) ** 2
    kept: Array = np.maximum(1 - lost, _LEAST_KEPT)
    return kept


def pressure_at_tip_pa(drive: Drive, hz: float, volts: float) -> complex:
    """Return the complex pressure amplitude at the tip of the reed, in Pa."""
    at_tweeter = tweeter_pressure_pa(drive.tweeter, hz, volts)
    gains = amplifier_gain(drive, hz) * acoustic_gain(drive, hz) * kept_by_tweeter(drive, volts, hz)
    return at_tweeter * complex(gains)
