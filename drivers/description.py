"""What drivers may ask of a bench file. `protocols.bench.BenchFile` has this shape."""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any, Protocol


class InstrumentDescription(Protocol):
    """One instrument of a bench file."""

    @property
    def driver(self) -> str:
        """Short name of an entry point, or ``package.module:Class``."""
        ...

    @property
    def options(self) -> Mapping[str, Any]:
        """What the driver checks itself: port, address, gain and the like."""
        ...


class SynthesizersDescription(InstrumentDescription, Protocol):
    """The pair of synthesizers."""

    @property
    def step_hz(self) -> Fraction:
        """Spacing of the frequencies."""
        ...

    @property
    def centre_hz(self) -> Fraction:
        """Middle of the window."""
        ...

    @property
    def window_hz(self) -> Fraction:
        """How far from the centre the modulators diffract."""
        ...


class OutputDescription(Protocol):
    """What lies between a generator's socket and the loudspeaker."""

    @property
    def amplifier_gain(self) -> float:
        """Volts at the loudspeaker per volt at the socket; 1 without an amplifier."""
        ...

    @property
    def load_ohm(self) -> Fraction:
        """Resistance of the loudspeaker."""
        ...


class GeneratorDescription(InstrumentDescription, Protocol):
    """The signal generator."""

    @property
    def step_hz(self) -> Fraction:
        """Spacing of the frequencies."""
        ...

    @property
    def output(self) -> OutputDescription | None:
        """Required by drivers of real generators."""
        ...


class DataSheetDescription(Protocol):
    """What the maker says of a sensor."""

    @property
    def offset_dn(self) -> float:
        """Number of a dark pixel."""
        ...

    @property
    def gain_e_dn(self) -> float:
        """Electrons per number."""
        ...

    @property
    def read_noise_e(self) -> float:
        """Standard deviation per pixel and frame."""
        ...

    @property
    def full_well_e(self) -> float:
        """Electrons at which a pixel stops filling."""
        ...


class CameraDescription(InstrumentDescription, Protocol):
    """The camera."""

    @property
    def width(self) -> int:
        """Columns of the sensor."""
        ...

    @property
    def height(self) -> int:
        """Rows of the sensor."""
        ...

    @property
    def pixel_m(self) -> Fraction:
        """Pitch of the square pixels."""
        ...

    @property
    def bits(self) -> int:
        """Of the ADC."""
        ...

    @property
    def max_frame_rate_hz(self) -> Fraction:
        """Of the whole sensor."""
        ...

    @property
    def data_sheet(self) -> DataSheetDescription | None:
        """Of the sensor, where it is known."""
        ...


class InstrumentsDescription(Protocol):
    """The three roles."""

    @property
    def synthesizers(self) -> SynthesizersDescription:
        """The pair of synthesizers."""
        ...

    @property
    def generator(self) -> GeneratorDescription:
        """The signal generator."""
        ...

    @property
    def camera(self) -> CameraDescription:
        """The camera."""
        ...


class Place(Protocol):
    """A point, or a size, on the object plane."""

    @property
    def y_m(self) -> Fraction:
        """Along the rows' axis."""
        ...

    @property
    def x_m(self) -> Fraction:
        """Along the columns' axis."""
        ...


class OpticsDescription(Protocol):
    """Light and where the reed stands in it."""

    @property
    def wavelength_m(self) -> Fraction:
        """Of the laser."""
        ...

    @property
    def distance_m(self) -> Fraction:
        """From reed to sensor."""
        ...

    @property
    def reed_centre(self) -> Place:
        """From the optical axis."""
        ...

    @property
    def reed_size(self) -> Place | None:
        """Of the rectangle around the visible reed; None if it is that of the reed itself."""
        ...


class LimitsDescription(Protocol):
    """What the loudspeaker may be given."""

    @property
    def volts_min_v(self) -> Fraction:
        """Least peak volts at the load, but for 0."""
        ...

    @property
    def volts_max_v(self) -> Fraction:
        """Most peak volts at the load."""
        ...

    @property
    def drive_min_hz(self) -> Fraction:
        """Lowest drive."""
        ...

    @property
    def drive_max_hz(self) -> Fraction:
        """Highest drive."""
        ...


class BenchDescription(Protocol):
    """A bench file."""

    @property
    def name(self) -> str:
        """For people."""
        ...

    @property
    def fingerprint(self) -> str:
        """Tells benches apart."""
        ...

    @property
    def instruments(self) -> InstrumentsDescription:
        """The three roles."""
        ...

    @property
    def optics(self) -> OpticsDescription:
        """Light and geometry."""
        ...

    @property
    def limits(self) -> LimitsDescription:
        """Checked before anything is sent."""
        ...

    @property
    def twin(self) -> Mapping[str, Any]:
        """Settings of a simulated bench."""
        ...
