"""Bench entries of generators: their options, and what a bench file may ask of them."""

from fractions import Fraction
from typing import Annotated, Final, Literal, TypeVar

from pydantic import Field

from drivers.context import BenchContext
from drivers.errors import BenchSetupError
from drivers.generators.replies import MICROHERTZ, SineRange
from drivers.options import Options, read_options
from protocols.bench import BenchFile, Generator, GeneratorOutput

Given = TypeVar("Given", bound="GeneratorOptions")

# Key path of the options of a generator in a bench file.
OPTIONS_KEY: Final = "instruments.generator.options"


class GeneratorOptions(Options):
    """Options of a generator that is reached through VISA."""

    resource: Annotated[str, Field(min_length=1)]
    """VISA name of the generator, such as `TCPIP::192.168.0.7::INSTR`."""
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 2.0
    """Longest wait for an answer, in s. A relay may take 0.3 s."""
    reference: Literal["external", "internal"] = "external"
    """Source of its 10 MHz. On its internal reference it drifts against the synthesizers."""


def generator_options(model: type[Given], entry: Generator, context: BenchContext) -> Given:
    """Read the options of a generator.

    Raises
    ------
    BenchSetupError
        With the key path of the first thing that is wrong.
    """
    return read_options(model, entry.options, context.description.name, OPTIONS_KEY)


def required_output(description: BenchFile, entry: Generator) -> GeneratorOutput:
    """Return the path from the generator to the loudspeaker.

    Raises
    ------
    BenchSetupError
        If the bench file does not describe it.
    """
    if entry.output is None:
        raise BenchSetupError(
            f"bench {description.name!r}: instruments.generator.output: is missing; describe the "
            "path from the socket to the loudspeaker, such as output: {amplifier_gain: 2, load: 8 "
            "ohm}"
        )
    return entry.output


def require_within_range(can_play: SineRange, description: BenchFile, entry: Generator) -> None:
    """Refuse a bench file that allows what the generator cannot play, or not exactly.

    Raises
    ------
    BenchSetupError
        With the key path and the remedy.
    """
    limits, output = description.limits, required_output(description, entry)
    most_v = Fraction(can_play.most_vpp) / 2 * Fraction(str(output.amplifier_gain))
    if entry.step_hz % MICROHERTZ:
        key, complaint = (
            "instruments.generator.step",
            f"is {float(entry.step_hz):g} Hz, but the generator's grid is 1 uHz; write a "
            "multiple of that",
        )
    elif limits.volts_max_v > most_v:
        key, complaint = (
            "limits.volts_max",
            f"allows {float(limits.volts_max_v):g} V peak, but the generator and its amplifier "
            f"give {float(most_v):g} V; lower it, or correct "
            "instruments.generator.output.amplifier_gain",
        )
    elif limits.drive_max_hz > can_play.most_hz:
        key, complaint = (
            "limits.drive_max",
            f"is above the {can_play.most_hz} Hz that the generator plays at full volts; lower it",
        )
    else:
        return
    raise BenchSetupError(f"bench {description.name!r}: {key}: {complaint}")
