"""Parameters of clocks and frequencies."""

from dataclasses import dataclass

from physics.parameters.quantity import quantity


@dataclass(frozen=True)
class Clocks:
    """Errors of frequencies and clocks.

    Attributes
    ----------
    detuning_hz : float
        Error of the difference frequency of the two modulators.
    detuning_hz_h : float
        Growth of this error per hour.
    generator_ppm : float
        Relative error of the generator's clock compared with the synthesizers' clock, in ppm.
    frame_jitter_s : float
        Standard deviation of the time by which each frame begins early or late.
    lost_fraction : float
        Fraction of acquisitions with a lost or repeated frame.
    """

    detuning_hz: float = quantity(
        0.0, "Hz", -2.0, 2.0, "synthesizers on two clocks of 10 ppb at 80 MHz: 1.6 Hz"
    )
    detuning_hz_h: float = quantity(0.0, "Hz/h", -2.0, 2.0, "warm-up of crystal oscillators")
    generator_ppm: float = quantity(
        0.0, "ppm", -50.0, 50.0, "data sheets of signal generators: 1 to 50 ppm"
    )
    frame_jitter_s: float = quantity(
        0.0, "s", 0.0, 5e-3, "hardware triggers: microseconds; software triggers: up to 3 ms"
    )
    lost_fraction: float = quantity(0.0, "", 0.0, 1.0, "cameras on a busy computer")
