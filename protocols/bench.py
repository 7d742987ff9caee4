"""Bench files: instruments, optics and limits of one bench."""

import math
from collections.abc import Mapping
from fractions import Fraction
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import Field, ValidationInfo, field_validator

from protocols.units import (
    Frequency,
    Length,
    Resistance,
    Voltage,
)
from protocols.yaml_files.strict_yaml import (
    Description,
    Section,
    find_description,
    shipped_files,
)

DEFAULT_BENCH = "simulated"
# Peak volts of a sine for each volt stated one way or another.
_PEAK_PER_VOLT: Final = {
    "peak": Fraction(1),
    "peak_to_peak": Fraction(1, 2),
    "rms": Fraction(math.sqrt(2)),
}


class InstrumentEntry(Section):
    """One instrument with the options of its driver."""

    driver: Annotated[str, Field(min_length=1, max_length=100)]
    """Short name of the driver, or `package.module:Class`."""
    options: Annotated[dict[str, Any], Field(default_factory=dict)]
    """Port, address, gain and other settings, which the driver checks."""

    def with_options(self, options: Mapping[str, Any]) -> Self:
        """Return a copy with other options."""
        return self.model_copy(update={"options": dict(options)})


class Synthesizers(InstrumentEntry):
    """Two synthesizer channels on one clock: AOM2 stays at the centre, AOM1 moves."""

    step_hz: Annotated[Frequency, Field(alias="step", gt=0)]
    """Smallest frequency step of both channels."""
    centre_hz: Annotated[Frequency, Field(alias="centre", gt=0)]
    """Frequency of AOM2."""
    window_hz: Annotated[Frequency, Field(alias="window", gt=0)]
    """Distance from the centre that neither channel may exceed, because the modulators diffract no
    light outside."""

    @field_validator("window_hz")
    @classmethod
    def _about_the_centre(cls, window_hz: Fraction, info: ValidationInfo) -> Fraction:
        step_hz, centre_hz = info.data.get("step_hz"), info.data.get("centre_hz")
        if centre_hz is not None and window_hz >= centre_hz:
            raise ValueError(
                f"{float(window_hz):.10g} Hz about the centre of {float(centre_hz):.10g} Hz "
                "reaches down to 0 Hz; write a narrower window or a higher centre"
            )
        # AOM2 has the multiple of the step that is nearest to the centre.
        if step_hz is not None and step_hz > window_hz:
            raise ValueError(
                f"{float(window_hz):.10g} Hz is narrower than instruments.synthesizers.step, which "
                f"is {float(step_hz):.10g} Hz; write a wider window or a smaller step"
            )
        return window_hz


class GeneratorOutput(Section):
    """Electrical path from the output of a generator to the loudspeaker."""

    amplifier_gain: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
    """Voltage gain of the amplifier."""
    load_ohm: Annotated[Resistance, Field(alias="load", gt=0)]
    """Impedance of the loudspeaker."""


class Generator(InstrumentEntry):
    """The signal generator of the tweeter."""

    step_hz: Annotated[Frequency, Field(alias="step", gt=0)]
    """Smallest frequency step."""
    output: GeneratorOutput | None = None
    """Path from the generator to the loudspeaker. Drivers of real generators require it."""


class DataSheet(Section):
    """Nominal values of a sensor, as its data sheet states them, for one pixel."""

    offset_dn: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """Digital number of a pixel without light."""
    gain_e_dn: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    """Electrons of one digital number."""
    read_noise_e: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    """Standard deviation of the read noise in electrons."""
    full_well_e: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    """Electrons at which a pixel saturates."""


class CameraSensor(InstrumentEntry):
    """The camera and its sensor with square pixels."""

    width: Annotated[int, Field(ge=16, le=65_536)]
    """Columns of the sensor."""
    height: Annotated[int, Field(ge=16, le=65_536)]
    """Rows of the sensor."""
    pixel_m: Annotated[Length, Field(alias="pixel", gt=0)]
    """Distance between neighbouring pixels."""
    bits: Annotated[int, Field(ge=8, le=16)]
    """Bits of a digital number."""
    max_frame_rate_hz: Annotated[Frequency, Field(alias="max_frame_rate", gt=0)]
    """Highest frame rate of the whole sensor."""
    data_sheet: DataSheet | None = None
    """Nominal values of the sensor. A diagnosis expects that a specimen differs from them a
    little. Without this key it hardly knows what the camera should do."""


class Instruments(Section):
    """The three instruments of a bench."""

    synthesizers: Synthesizers
    """Synthesizers of the two acousto-optic modulators."""
    generator: Generator
    """Signal generator of the tweeter."""
    camera: CameraSensor
    """Camera."""


class Point(Section):
    """A point of the object plane, measured from the optical axis."""

    y_m: Annotated[Length, Field(alias="y")]
    """Coordinate along the columns of the sensor."""
    x_m: Annotated[Length, Field(alias="x")]
    """Coordinate along the rows of the sensor."""


class Size(Section):
    """A size on the object plane."""

    y_m: Annotated[Length, Field(alias="y", gt=0)]
    """Size along the columns of the sensor."""
    x_m: Annotated[Length, Field(alias="x", gt=0)]
    """Size along the rows of the sensor."""


class Optics(Section):
    """Light, distance, and position of the reed in the reconstructed image."""

    wavelength_m: Annotated[Length, Field(alias="wavelength", gt=0)]
    """Wavelength of the laser."""
    distance_m: Annotated[Length, Field(alias="distance", gt=0)]
    """Distance from the reed to the sensor."""
    reed_centre: Point
    """Centre of the part of the image that is kept."""
    reed_size: Size | None = None
    """Size of the part of the image that is kept. Without this key, it is chosen to fit the reed of
    the protocol."""


class Limits(Section):
    """Volts at the loudspeaker and drive frequencies that no protocol may leave."""

    volts_are: Literal["peak", "peak_to_peak", "rms"]
    """How `volts_min` and `volts_max` are stated. (Volts of a protocol are always peak volts.)"""
    stated_min_v: Annotated[Voltage, Field(alias="volts_min", ge=0)]
    """Lowest volts at the loudspeaker."""
    stated_max_v: Annotated[Voltage, Field(alias="volts_max", gt=0)]
    """Highest volts at the loudspeaker."""
    drive_min_hz: Annotated[Frequency, Field(alias="drive_min", gt=0)]
    """Lowest drive frequency."""
    drive_max_hz: Annotated[Frequency, Field(alias="drive_max", gt=0)]
    """Highest drive frequency."""

    @property
    def volts_min_v(self) -> Fraction:
        """Lowest peak volts at the load."""
        return self.stated_min_v * _PEAK_PER_VOLT[self.volts_are]

    @property
    def volts_max_v(self) -> Fraction:
        """Highest peak volts at the load."""
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
    """One bench: its instruments, optics, limits and known resonances."""

    kind: ClassVar[str] = "bench"
    folder: ClassVar[str] = "benches"

    name: Annotated[str, Field(min_length=1, max_length=80)]
    """Title in tables and reports."""
    instruments: Instruments
    """Drivers, and the properties of each instrument that a plan depends on."""
    optics: Optics
    """Light, distance, and position of the reed in the image."""
    limits: Limits
    """Limits of the drive, checked before anything is sent to an instrument."""
    acoustic_resonances_hz: Annotated[
        tuple[Frequency, ...], Field(alias="acoustic_resonances", strict=False)
    ] = ()
    """Known resonances of the excitation device. Every reed shows them at the same frequency, so
    they are no modes of a reed."""
    twin: Annotated[dict[str, Any], Field(default_factory=dict)]
    """Settings of the simulated bench, which checks them."""
    known: dict[str, dict[str, float | str]] | None = None
    """Effects that this bench is known to have, by name, with their parameters, such as
    ``{air_load: {fraction: 0.3 ± 0.1}}``. A diagnosis checks them and includes them in its model;
    sizes with a standard error can then differ from what is written here."""

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
        """SHA-256 of the content; two files that differ in spelling only have the same."""
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
    """Find a bench file by its path, or a shipped one by its name.

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
