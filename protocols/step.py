"""Steps of a plan, and reasons why a plan cannot run."""

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from protocols.units import exact_decimal


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a plan: its frequencies, volts, sideband and exposure.

    Attributes
    ----------
    index : int
        k of the protocol's sweep.
    order : int
        Sideband that the synthesizers select.
    asked_hz : Fraction
        Frequency that the protocol asks for, to 1 µHz.
    drive_hz : Fraction
        Drive frequency: the nearest one that the synthesizers can lock to.
    aom1_hz, aom2_hz, difference_hz : Fraction
        Both synthesizers, and AOM1 − AOM2.
    lock_residual_hz : Fraction
        Difference between `difference_hz` and the lock; 0 is a perfect lock.
    volts : float
        Peak volts at the load, to 1 µV.
    frames : int
        Frames of the acquisition.
    settle_s, exposure_s : Fraction
        Wait after a new setting, and exposure of one frame.
    carrier_leak : float
        Amplitude of the carrier in the hologram, relative to what the sideband gives per unit
        amplitude, see `holography.demodulation.carrier_leak`.
    """

    index: int
    order: int
    asked_hz: Fraction
    drive_hz: Fraction
    aom1_hz: Fraction
    aom2_hz: Fraction
    difference_hz: Fraction
    lock_residual_hz: Fraction
    volts: float
    frames: int
    settle_s: Fraction
    exposure_s: Fraction
    carrier_leak: float

    def to_json(self) -> dict[str, Any]:
        """Return the step with stable keys, frequencies as exact decimal strings."""
        return {
            "index": self.index,
            "order": self.order,
            "asked_hz": exact_decimal(self.asked_hz),
            "drive_hz": exact_decimal(self.drive_hz),
            "aom1_hz": exact_decimal(self.aom1_hz),
            "aom2_hz": exact_decimal(self.aom2_hz),
            "difference_hz": exact_decimal(self.difference_hz),
            "lock_residual_hz": exact_decimal(self.lock_residual_hz),
            "volts": self.volts,
            "frames": self.frames,
            "carrier_leak": self.carrier_leak,
        }


@dataclass(frozen=True, slots=True)
class Violation:
    """One reason why a plan cannot run.

    Attributes
    ----------
    key : str
        Key path in the protocol that removes it, such as ``drive.to``.
    message : str
        What is wrong and what to write.
    """

    key: str
    message: str
