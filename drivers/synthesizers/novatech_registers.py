"""Registers of a Novatech 409B, its options, and commands that change them."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from drivers.errors import (
    BenchSetupError,
    InstrumentError,
)
from drivers.options import Options
from protocols.bench import Synthesizers

STEP_HZ: Final = Fraction(1, 10)

_STEPS_PER_MHZ: Final = 10_000_000

_HIGHEST_HZ: Final = Fraction("171127603.1")

FULL_SCALE: Final = 1023


class NovatechOptions(Options):
    """Options of a Novatech 409B."""

    port: Annotated[str, Field(min_length=1)]
    """Serial port, such as `/dev/ttyUSB0`."""
    amplitude: Annotated[float, Field(ge=0.001, le=1)]
    """Amplitude of both channels when RF is on, as a fraction of full scale."""
    amplitude_max: Annotated[float, Field(ge=0.001, le=1)]
    """Highest amplitude that the modulators and their amplifiers stand, as a fraction of full
    scale."""
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    """Longest wait for a line, in s."""
    baud: Literal[9600, 19200, 38400, 57600, 115200] = 19200
    """Baud rate that the box is set to."""
    external_reference: bool = False
    """Whether the box has option /R and a 10 MHz reference is connected. The run file records it;
    nothing is sent, because with /R no clock command may be sent."""

    @model_validator(mode="after")
    def _below_maximum(self) -> Self:
        if self.amplitude > self.amplitude_max:
            raise ValueError(
                f"amplitude {self.amplitude:g} is above amplitude_max {self.amplitude_max:g}, "
                "which would burn the modulators"
            )
        return self


@dataclass(frozen=True, slots=True)
class Registers:
    """Settings of the two channels.

    Attributes
    ----------
    steps : (int, int)
        Frequencies of channels 0 and 1, in 0.1 Hz.
    amplitudes : (int, int)
        Of channels 0 and 1, from 0 to 1023.
    """

    steps: tuple[int, int]
    amplitudes: tuple[int, int]

    def __str__(self) -> str:
        hz = " and ".join(f"{steps // 10}.{steps % 10} Hz" for steps in self.steps)
        return f"{hz}, amplitudes {self.amplitudes[0]} and {self.amplitudes[1]} of {FULL_SCALE}"


def failure_of(attempt: Callable[[], None]) -> InstrumentError | None:
    """Return the error that an attempt ends in; None if it succeeds."""
    try:
        attempt()
    except InstrumentError as error:
        return error
    return None


def commands_between(old: Registers | None, new: Registers) -> list[str]:
    """Return what fills the registers that differ; all if the old ones are unknown."""
    frequencies = [
        f"F{channel} {steps // _STEPS_PER_MHZ}.{steps % _STEPS_PER_MHZ:07d}"
        for channel, steps in enumerate(new.steps)
        if old is None or steps != old.steps[channel]
    ]
    amplitudes = [
        f"V{channel} {word}"
        for channel, word in enumerate(new.amplitudes)
        if old is None or word != old.amplitudes[channel]
    ]
    return frequencies + amplitudes


def require_possible(entry: Synthesizers, bench: str) -> None:
    """Refuse a bench file that asks for frequencies a 409B cannot play."""
    if entry.step_hz != STEP_HZ:
        raise BenchSetupError(
            f"bench {bench!r}: instruments.synthesizers.step: is {float(entry.step_hz):g} Hz, but "
            "a Novatech 409B plays multiples of 0.1 Hz; write step: 0.1 Hz"
        )
    low_hz, high_hz = entry.centre_hz - entry.window_hz, entry.centre_hz + entry.window_hz
    if high_hz > _HIGHEST_HZ:
        raise BenchSetupError(
            f"bench {bench!r}: instruments.synthesizers.window: reaches from {float(low_hz):.10g} "
            f"to {float(high_hz):.10g} Hz, but a Novatech 409B plays up to "
            f"{float(_HIGHEST_HZ):.10g} Hz; narrow it"
        )
