"""Which instrument stands where: bench files, read as strictly as protocols."""

import math
from collections.abc import Mapping
from fractions import Fraction
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import Field, ValidationInfo, field_validator

from protocols.strict_yaml import (
    Description,
    Section,
    find_description,
    shipped_files,
)
from protocols.units import (
    Frequency,
    Length,
    Resistance,
    Voltage,
)

DEFAULT_BENCH = "simulated"
# Peak volts of a sine for each volt stated one way or another.
_PEAK_PER_VOLT: Final = {
    "peak": Fraction(1),
    "peak_to_peak": Fraction(1, 2),
    "rms": Fraction(math.sqrt(2)),
}


class InstrumentEntry(Section):
    """One instrument: its driver and, untouched, the options that this driver checks itself.

    Attributes
    ----------
    driver : str
        Short name of an entry point, or ``package.module:Class``.
    options : dict
        Port, address, gain and the like.
    """

    driver: Annotated[str, Field(min_length=1, max_length=100)]
    options: Annotated[dict[str, Any], Field(default_factory=dict)]

    def with_options(self, options: Mapping[str, Any]) -> Self:
        """Return a copy with other options."""
        return self.model_copy(update={"options": dict(options)})


class Synthesizers(InstrumentEntry):
    """The pair on one clock: AOM2 stays at the centre, AOM1 carries the difference."""

    step_hz: Annotated[Frequency, Field(alias="step", gt=0)]
    centre_hz: Annotated[Frequency, Field(alias="centre", gt=0)]
    window_hz: Annotated[Frequency, Field(alias="window", gt=0)]

    @field_validator("window_hz")
    @classmethod
    def _about_the_centre(cls, window_hz: Fraction, info: ValidationInfo) -> Fraction:
        step_hz, centre_hz = info.data.get("step_hz"), info.data.get("centre_hz")
        if centre_hz is not None and window_hz >= centre_hz:
            raise ValueError(
                f"{float(window_hz):.10g} Hz about the centre of {float(centre_hz):.10g} Hz "
                "reaches down to 0 Hz; write a narrower window or a higher centre"
            )
        # AOM2 stands at the multiple of the step that is nearest to the centre.
        if step_hz is not None and step_hz > window_hz:
            raise ValueError(
                f"{float(window_hz):.10g} Hz is narrower than instruments.synthesizers.step, which "
                f"is {float(step_hz):.10g} Hz; write a wider window or a smaller step"
            )
        return window_hz


class GeneratorOutput(Section):
    """What lies between a generator's socket and the loudspeaker."""

    amplifier_gain: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
    load_ohm: Annotated[Resistance, Field(alias="load", gt=0)]


class Generator(InstrumentEntry):
    """The signal generator of the tweeter; drivers of real ones ask for `output`."""

    step_hz: Annotated[Frequency, Field(alias="step", gt=0)]
    output: GeneratorOutput | None = None


class DataSheet(Section):
    """What the maker says of a sensor, in electrons and digital numbers of one pixel."""

    offset_dn: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    gain_e_dn: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    read_noise_e: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    full_well_e: Annotated[float, Field(gt=0, allow_inf_nan=False)]


class CameraSensor(InstrumentEntry):
    """The camera and its sensor of square pixels; without a data sheet, one as in the paper."""

    width: Annotated[int, Field(ge=16, le=65_536)]
    height: Annotated[int, Field(ge=16, le=65_536)]
    pixel_m: Annotated[Length, Field(alias="pixel", gt=0)]
    bits: Annotated[int, Field(ge=8, le=16)]
    max_frame_rate_hz: Annotated[Frequency, Field(alias="max_frame_rate", gt=0)]
    data_sheet: DataSheet | None = None


class Instruments(Section):
    """The three roles of a bench."""

    synthesizers: Synthesizers
    generator: Generator
    camera: CameraSensor


class Point(Section):
    """A place on the object plane, from the optical axis; y along rows, x along columns."""

    y_m: Annotated[Length, Field(alias="y")]
    x_m: Annotated[Length, Field(alias="x")]


class Size(Section):
    """A size on the object plane."""

    y_m: Annotated[Length, Field(alias="y", gt=0)]
    x_m: Annotated[Length, Field(alias="x", gt=0)]


class Optics(Section):
    """Where the reed stands in the image that the hologram reconstructs to.

    Without `reed_size`, as much of the image is kept as the protocol's reed needs.
    """

    wavelength_m: Annotated[Length, Field(alias="wavelength", gt=0)]
    distance_m: Annotated[Length, Field(alias="distance", gt=0)]
    reed_centre: Point
    reed_size: Size | None = None


class Limits(Section):
    """What the tweeter may be given: volts at the load, and frequencies.

    Makers state volts one way or another, so the file has to say which is meant: `volts_are`.
    """

    volts_are: Literal["peak", "peak_to_peak", "rms"]
    stated_min_v: Annotated[Voltage, Field(alias="volts_min", ge=0)]
    stated_max_v: Annotated[Voltage, Field(alias="volts_max", gt=0)]
    drive_min_hz: Annotated[Frequency, Field(alias="drive_min", gt=0)]
    drive_max_hz: Annotated[Frequency, Field(alias="drive_max", gt=0)]

    @property
    def volts_min_v(self) -> Fraction:
        """Least peak volts at the load."""
        return self.stated_min_v * _PEAK_PER_VOLT[self.volts_are]

    @property
    def volts_max_v(self) -> Fraction:
        """Most peak volts at the load."""
        return self.stated_max_v * _PEAK_PER_VOLT[self.volts_are]

    @field_validator("stated_max_v")
    @classmethod
    def _volts_in_order(cls, maximum: Fraction, info: ValidationInfo) -> Fraction:
        return _above(maximum, info.data.get("stated_min_v"), "volts_min")

    @field_validator("drive_max_hz")
    @classmethod
    def _drive_in_order(cls, maximum: Fraction, info: ValidationInfo) -> Fraction:
        return _above(maximum, info.data.get("drive_min_hz"), "drive_min")


class BenchFile(Description):
    """One bench: its instruments, optics, limits and known resonances.

    Attributes
    ----------
    name : str
        For people.
    instruments : Instruments
        Drivers, and what the plan has to know of each instrument.
    optics : Optics
        Wavelength, distance and place of the reed.
    limits : Limits
        Checked before anything is sent.
    acoustic_lines_hz : tuple of Fraction
        Known resonances of the excitation device, which are no modes of a reed.
    twin : dict
        Settings of the simulated bench, untouched; the twin checks them.
    known : dict or None
        Effects that this bench is known to have, by name, with their sizes, untouched; a diagnosis
        checks them.
    """

    kind: ClassVar[str] = "bench"
    folder: ClassVar[str] = "benches"

    name: Annotated[str, Field(min_length=1, max_length=80)]
    instruments: Instruments
    optics: Optics
    limits: Limits
    acoustic_lines_hz: Annotated[
        tuple[Frequency, ...], Field(alias="acoustic_lines", strict=False)
    ] = ()
    twin: Annotated[dict[str, Any], Field(default_factory=dict)]
    known: dict[str, dict[str, float | str]] | None = None

    @field_validator("optics")
    @classmethod
    def _far_enough(cls, optics: Optics, info: ValidationInfo) -> Optics:
        instruments = info.data.get("instruments")
        if instruments is None:
            return optics
        _require_fresnel(optics, instruments.camera)
        return optics

    @classmethod
    def from_file(cls, name_or_path: str | Path = DEFAULT_BENCH) -> Self:
        """Read a bench file; without a name, the simulated bench. See `Description.from_file`."""
        return super().from_file(name_or_path)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the content: tells benches apart, not their spelling."""
        return self.sha256


def _above(maximum: Fraction, minimum: Fraction | None, key: str) -> Fraction:
    if minimum is not None and maximum <= minimum:
        raise ValueError(f"the maximum is not above limits.{key}; exchange them")
    return maximum


def _require_fresnel(optics: Optics, camera: CameraSensor) -> None:
    shortest_m = max(camera.width, camera.height) * camera.pixel_m**2 / optics.wavelength_m
    if optics.distance_m < shortest_m:
        raise ValueError(
            f"distance {float(optics.distance_m):.4g} m is below {float(shortest_m):.4g} m, where "
            "the pixels no longer resolve the wavefront's curvature; raise distance"
        )


def find_bench(name_or_path: str | Path = DEFAULT_BENCH) -> Traversable:
    """Find a bench file: a file of yours first, then a shipped one by name.

    Parameters
    ----------
    name_or_path : str or Path
        A path, or the name of a shipped bench: ``simulated`` and ``benches/simulated.yaml``.

    Raises
    ------
    ProtocolError
        If there is neither; the message lists the shipped ones.
    """
    return find_description(str(name_or_path), BenchFile.kind, BenchFile.folder)


def shipped_benches() -> tuple[str, ...]:
    """Names of the bench files that come with the software, sorted."""
    return tuple(sorted(shipped_files(BenchFile.folder)))
