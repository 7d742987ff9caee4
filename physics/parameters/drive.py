"""Parameters of the drive: from the volts at the amplifier's load to the pressure at the reed."""

import math
from dataclasses import dataclass, field

from physics.parameters.quantity import quantity

_DOME = "data sheets of 25 mm dome tweeters"
_CAVITY = "small cavities with openings"


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

    sensitivity_pa_v: float = quantity(
        0.7, "Pa/V", 0.01, 100.0, "16 V move a reed by about a micrometre (paper, Fig. 2)"
    )
    resonance_hz: float = quantity(1100.0, "Hz", 500.0, 2000.0, _DOME)
    resonance_quality: float = quantity(0.7, "", 0.3, 3.0, _DOME)
    corner_hz: float = quantity(14e3, "Hz", 4e3, 1e9, _DOME)
    connected: bool = True


@dataclass(frozen=True)
class AcousticResonance:
    """An acoustic resonance of the excitation device, the same for every reed.

    Attributes
    ----------
    frequency_hz : float
        Resonance frequency; 4308.6 Hz on the paper's bench (picture 78 of both series).
    quality : float
        Quality factor.
    strength : float
        Pressure through the resonant path at low frequency, relative to the direct path.
    phase_rad : float
        Phase that this pressure has in addition, at all frequencies: 0 for a chamber behind an
        opening, π/2 for a dome or a tube, which adds its pressure in phase at its resonance.
    """

    frequency_hz: float = quantity(4308.6, "Hz", 1e3, 25e3, "paper, Fig. 2: picture 78")
    quality: float = quantity(25.0, "", 3.0, 100.0, _CAVITY)
    strength: float = quantity(0.12, "", 0.0, 1.0, "a clear but moderate peak (paper, Fig. 2)")
    phase_rad: float = quantity(0.0, "rad", -math.pi, math.pi, "paths of any length")


@dataclass(frozen=True)
class Drive:
    """Drive chain: from volts to the pressure on the reed.

    Attributes
    ----------
    tweeter : Tweeter
    acoustic_resonance : AcousticResonance
        The first one that the bench file lists; of strength 0 if it lists none.
    further_resonances : tuple of AcousticResonance
        The others that it lists.
    second_resonance, third_resonance : AcousticResonance
        Two that it does not list; of strength 0 if there is none.
    compression : float
        Fraction of the pressure that is lost at 16 V and low frequency, where the coil moves most.
    compression_hz : float
        Frequency above which the coil moves less.
    roll_off : float
        10 kHz divided by the corner frequency of the amplifier's second-order low-pass; 0 for an
        amplifier without one.
    bypass_real, bypass_imaginary : float
        Pressure that reaches the reed on another path, relative to the direct one.
    """

    tweeter: Tweeter = field(default_factory=Tweeter)
    acoustic_resonance: AcousticResonance = field(default_factory=AcousticResonance)
    further_resonances: tuple[AcousticResonance, ...] = ()
    second_resonance: AcousticResonance = AcousticResonance(7e3, 30.0, 0.0)
    third_resonance: AcousticResonance = AcousticResonance(7e3, 30.0, 0.0)
    compression: float = quantity(
        0.0, "", 0.0, 0.6, "a dome tweeter near its rated power loses 1 to 3 dB"
    )
    compression_hz: float = quantity(
        5e3, "Hz", 1e3, 20e3, "stiffness controls the dome up to some kHz"
    )
    roll_off: float = quantity(0.0, "", 0.0, 2.0, "audio amplifiers reach 20 kHz or more")
    bypass_real: float = quantity(0.0, "", -0.3, 0.3, "sound that goes around: some per cent")
    bypass_imaginary: float = quantity(0.0, "", -0.3, 0.3, "sound that goes around: some per cent")
