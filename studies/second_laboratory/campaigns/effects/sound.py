"""Loudspeaker, amplifier and chamber."""

import math
from dataclasses import dataclass, replace

from studies.second_laboratory.campaigns.effects.base import Effect, Moment, place, size
from studies.second_laboratory.parameters import DriveParameters

# Volts at the end of the ramp, and the highest frequency, of the paper's sweep.
_FULL_V, _HIGHEST_HZ = 16.0, 20_000.0
# Part of a tweeter's compression that its suspension causes; the voice coil's heat causes the rest,
# and makes no harmonics. Chosen.
_SUSPENSION = 0.3


@dataclass(frozen=True)
class TweeterCompression(Effect):
    """The tweeter gives less than in proportion to its volts.

    The output follows V/√(1 + (V/V₀)²). What the suspension takes from the fundamental appears, a
    third of it, at three times the frequency, as a cubic spring does.
    """

    id = "tweeter_compression"
    loss_db: float = size(
        0.1,
        6.0,
        "dB",
        "sound that is missing at 16 V",
        "power compression of tweeters at rated power, 1–6 dB (Button 1992, J. Audio Eng. Soc. 40)",
    )

    def tones(self, tones: dict[int, complex], now: Moment) -> dict[int, complex]:
        """Lower the fundamental, and add a third harmonic."""
        lost = 10 ** (self.loss_db / 10) - 1
        kept = 1 / math.sqrt(1 + lost * (now.volts / _FULL_V) ** 2)
        third = tones.get(3, 0.0) + _SUSPENSION / 3 * (1 - kept) * tones[1]
        return {**tones, 1: kept * tones[1], **({3: third} if third else {})}


@dataclass(frozen=True)
class AmplifierRolloff(Effect):
    """The amplifier, its cable or a filter lets high frequencies through less: one pole."""

    id = "amplifier_rolloff"
    loss_db: float = size(
        0.2,
        10.0,
        "dB",
        "loss at 20 kHz",
        "audio amplifiers −0.5 to −3 dB at 20 kHz (data sheets); chosen up to a wrong filter",
    )

    def transfer(self, factor: complex, hz: float) -> complex:
        """Return one pole whose corner follows from the loss."""
        over_corner = hz / _HIGHEST_HZ * math.sqrt(10 ** (self.loss_db / 10) - 1)
        return factor / (1 + 1j * over_corner)


@dataclass(frozen=True)
class AcousticResonance(Effect):
    """The known resonance of the chamber is stronger: its seal is tighter than usual."""

    id = "acoustic_resonance"
    more_db: float = size(
        0.5,
        12.0,
        "dB",
        "strength above the usual",
        "seals of couplers change Q up to fourfold (chosen)",
    )

    def drive(self, drive: DriveParameters) -> DriveParameters:
        """Raise the residue of the resonance."""
        pole_hz, quality, height = drive.cavity
        return replace(drive, cavity=(pole_hz, quality, height * 10 ** (self.more_db / 20)))


@dataclass(frozen=True)
class SecondAcousticResonance(Effect):
    """Another resonance of the chamber or its tube, which no bench file lists."""

    id = "second_acoustic_resonance"
    peak_db: float = size(
        0.5, 12.0, "dB", "level at its peak", "half-wave resonances of tubes and cavities (chosen)"
    )
    hz: float = place(1800.0, 15_000.0, "Hz", "its frequency")
    quality: float = place(6.0, 40.0, "", "its Q")

    def transfer(self, factor: complex, hz: float) -> complex:
        """Add a resonance."""
        height = 10 ** (self.peak_db / 20) - 1
        s, width_hz = 1j * hz, self.hz / self.quality
        return factor * (1 + height * s * width_hz / (s**2 + s * width_hz + self.hz**2))


@dataclass(frozen=True)
class ChamberLeakage(Effect):
    """Sound leaks past or through the clay into the covered half of the chamber."""

    id = "chamber_leakage"
    series = "A"
    part: float = size(
        0.02, 0.6, "of the pressure", "what more gets to the covered half", "gaps of clay (chosen)"
    )

    def drive(self, drive: DriveParameters) -> DriveParameters:
        """Let more through the clay."""
        through = drive.through_clay + self.part * (1 - drive.through_clay)
        return replace(drive, through_clay=through)
