"""Clocks of synthesizers and generator."""

from dataclasses import dataclass

from studies.second_laboratory.campaigns.effects.base import Array, Effect, Moment, size


@dataclass(frozen=True)
class SynthesizerDetuning(Effect):
    """The difference of both synthesizers is off by the same at all times: no common reference."""

    id = "synthesizer_detuning"
    hz: float = size(
        0.005,
        0.3,
        "Hz",
        "error of f1 − f2",
        "two ovens at 80 MHz that differ by 6e-11 to 4e-9 (OCXO data sheets); more is seen at once",
        signed=True,
    )

    def turns(self, turns: Array, times_s: Array, now: Moment) -> Array:
        """Add turns in proportion to time."""
        return turns + self.hz * times_s


@dataclass(frozen=True)
class SynthesizerDrift(Effect):
    """The difference of both synthesizers drifts, from 0 at the start."""

    id = "synthesizer_drift"
    hz_per_hour: float = size(
        0.03,
        1.5,
        "Hz/h",
        "growth of the error of f1 − f2",
        "warming ovens drift by 4e-10 to 2e-8 an hour at 80 MHz (OCXO data sheets)",
        signed=True,
    )

    def turns(self, turns: Array, times_s: Array, now: Moment) -> Array:
        """Add the integral of the error."""
        return turns + 0.5 * self.hz_per_hour / 3600 * times_s**2


@dataclass(frozen=True)
class GeneratorClock(Effect):
    """The generator of the tweeter runs on a clock of its own."""

    id = "generator_clock"
    ppm: float = size(
        0.2,
        15.0,
        "ppm",
        "difference to the synthesizers' clock",
        "compensated quartz 1–2 ppm, plain quartz 20–50 ppm (data sheets of generators)",
        signed=True,
    )

    def drive_hz(self, hz: float) -> float:
        """Return the frequency that is played."""
        return hz * (1 + 1e-6 * self.ppm)
