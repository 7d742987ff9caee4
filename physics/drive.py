"""The tweeter: sound pressure from the volts at the amplifier's load."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tweeter:
    """A dome tweeter that is screwed onto the mouthpiece: a minimum-phase band-pass.

    Attributes
    ----------
    sensitivity_pa_v : float
        Pressure per volt in the middle of the band.
    resonance_hz, resonance_quality : float
        Mechanical resonance; the response is proportional to f² below it.
    corner_hz : float
        Corner frequency of the voice coil's inductance; the response falls as 1/f above it.
    connected : bool
        Whether the cable is plugged in.
    """

    sensitivity_pa_v: float = 0.7
    resonance_hz: float = 1100.0
    resonance_quality: float = 0.7
    corner_hz: float = 14e3
    connected: bool = True


def tweeter_pressure_pa(tweeter: Tweeter, frequency_hz: float, volts: float) -> complex:
    """Return the complex pressure amplitude in Pa for a sine of given peak volts at the load."""
    if not tweeter.connected:
        return 0j
    ratio = frequency_hz / tweeter.resonance_hz
    high_pass = -(ratio**2) / (1 - ratio**2 + 1j * ratio / tweeter.resonance_quality)
    low_pass = 1 / (1 + 1j * frequency_hz / tweeter.corner_hz)
    return tweeter.sensitivity_pa_v * volts * high_pass * low_pass
