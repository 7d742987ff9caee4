"""What is known of the excitation device and of the light."""

from dataclasses import dataclass

from physics.air import CavityLine, Chamber
from physics.drive import Tweeter


@dataclass(frozen=True)
class Device:
    """What moves the reed, and the light that shows it, as nominally known.

    Attributes
    ----------
    chamber : Chamber
    line : CavityLine
        Resonance of the air that the device is known to have.
    wavelength_m : float
    tweeter : Tweeter
    """

    chamber: Chamber
    line: CavityLine
    wavelength_m: float
    tweeter: Tweeter = Tweeter()
