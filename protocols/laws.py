"""Sweep laws: which frequency and how many volts each step of a sweep has.

The key ``law`` of the sections `sweep` and `drive` of a protocol names one of the classes below. To
add a law, write a class with its own ``law``, and name it in `FrequencyLaw` or `AmplitudeLaw` at
the end of this file. No other file has to change.
"""

import decimal
from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Iterator
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise
from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field, ValidationInfo, field_validator

from protocols.units import Frequency, Interval, Voltage, format_quantity
from protocols.yaml_files.strict_yaml import Section

# Chosen: twice the number of steps of the longest run (`protocols.protocol.MAX_STEPS`).
_MOST_INDEX: Final = 100_000
# Chosen: ten octaves of hearing, above and below the reference.
_MOST_CENTS: Final = 20 * 1200
_MICRO: Final = Decimal("1e-6")
# Decimal powers are correctly rounded, so a plan is the same on every machine; those of floats
# are not. 40 digits leave a µHz exact at any frequency that a protocol can express.
_EXACT: Final = decimal.Context(prec=40)

_Index = Annotated[int, Field(ge=-_MOST_INDEX, le=_MOST_INDEX)]
_DriveFrequency = Annotated[Frequency, Field(gt=0, le=10**9)]
_PeakVolts = Annotated[Voltage, Field(gt=0, le=1000)]


class BaseFrequencyLaw(Section):
    """Common part of all frequency laws. Frequencies grow with the index of the step.

    Attributes
    ----------
    scale_key : str
        Key that moves all frequencies.
    spacing : tuple of str
        Key that sets the distance of neighbouring steps, and the remedy where they coincide.
    """

    scale_key: ClassVar[str]
    spacing: ClassVar[tuple[str, str]]

    stride: Annotated[int, Field(ge=1)] = 1
    """Measure every n-th step only: 2 leaves out every second one."""
    direction: Literal["up", "down", "shuffled"] = "up"
    """Order in which the steps are measured. The shuffled order is the same in every run."""

    @property
    @abstractmethod
    def indices(self) -> range:
        """Indices k of the steps, ascending."""

    @abstractmethod
    def frequency_hz(self, index: int) -> Fraction:
        """Return the frequency that step `index` asks for, to 1 µHz."""

    @abstractmethod
    def remedy_to_begin_at(self, index: int) -> tuple[str, str]:
        """Return the key and what to write there, so that step `index` is the first."""

    @abstractmethod
    def remedy_to_end_at(self, index: int) -> tuple[str, str]:
        """Return the key and what to write there, so that step `index` is the last."""


class GeometricLaw(BaseFrequencyLaw):
    """Equal intervals in cents: f_k = reference · 2^(interval·k / 1200 cents), k = first … last.

    The paper's sweep is of this kind. Twelve semitones from A4, every sixth of them:

    >>> sweep = GeometricLaw.model_validate({
    ...     "law": "geometric", "reference": "440 Hz", "interval": "100 cents",
    ...     "first": 0, "last": 12, "stride": 6,
    ... })
    >>> [float(sweep.frequency_hz(k)) for k in sweep.indices]
    [440.0, 622.253967, 880.0]
    """

    scale_key: ClassVar[str] = "reference"
    spacing: ClassVar[tuple[str, str]] = ("interval", "write a larger interval")

    law: Literal["geometric"]
    """Equal intervals in cents, from `first` to `last`."""
    reference_hz: Annotated[_DriveFrequency, Field(alias="reference")]
    """Frequency of the step with index 0, whether or not it is measured."""
    interval_cents: Annotated[Interval, Field(alias="interval", gt=0, le=1200)]
    """Interval between neighbouring indices."""
    first: _Index
    """Index of the first step; it may be negative."""
    last: _Index
    """Index of the last step, at least `first`."""

    @field_validator("first", "last")
    @classmethod
    def _near_reference(cls, index: int, info: ValidationInfo) -> int:
        interval_cents = info.data.get("interval_cents")
        if interval_cents is not None and abs(index) * interval_cents > _MOST_CENTS:
            raise ValueError(f"{index} is over 20 octaves from the reference; write a nearer step")
        return index

    @field_validator("last")
    @classmethod
    def _has_steps(cls, last: int, info: ValidationInfo) -> int:
        first = info.data.get("first")
        if first is not None and last < first:
            raise ValueError(
                f"{last} is below sweep.first {first}, so there are 0 steps; write at least {first}"
            )
        return last

    @property
    def indices(self) -> range:
        """Indices k of the steps."""
        return range(self.first, self.last + 1, self.stride)

    def frequency_hz(self, index: int) -> Fraction:
        """Return reference · 2^(interval·k / 1200 cents), to 1 µHz."""
        octaves = _decimal(self.interval_cents * index / 1200)
        ratio = _EXACT.power(Decimal(2), octaves)
        asked_hz = _EXACT.multiply(_decimal(self.reference_hz), ratio)
        return Fraction(_EXACT.quantize(asked_hz, _MICRO))

    def remedy_to_begin_at(self, index: int) -> tuple[str, str]:
        """Return the key and the index to write."""
        return "first", f"write {index}"

    def remedy_to_end_at(self, index: int) -> tuple[str, str]:
        """Return the key and the index to write."""
        return "last", f"write {index}"


class LinearLaw(BaseFrequencyLaw):
    """Equal steps in hertz: f_k = from + step·(k − 1), k = 1, 2, … as long as f_k ≤ to.

    A close look at one resonance:

    >>> sweep = LinearLaw.model_validate({
    ...     "law": "linear", "from": "1990 Hz", "to": "2010 Hz", "step": "7.5 Hz",
    ... })
    >>> [float(sweep.frequency_hz(k)) for k in sweep.indices]
    [1990.0, 1997.5, 2005.0]
    """

    scale_key: ClassVar[str] = "from"
    spacing: ClassVar[tuple[str, str]] = ("step", "write a larger step")

    law: Literal["linear"]
    """Equal steps in hertz, from `from` to `to`."""
    from_hz: Annotated[_DriveFrequency, Field(alias="from")]
    """Frequency of the first step."""
    to_hz: Annotated[_DriveFrequency, Field(alias="to")]
    """Highest frequency; it is measured if a whole number of steps leads to it."""
    step_hz: Annotated[Frequency, Field(alias="step", gt=0)]
    """Distance between neighbouring indices."""

    @field_validator("to_hz")
    @classmethod
    def _not_below(cls, to_hz: Fraction, info: ValidationInfo) -> Fraction:
        from_hz = info.data.get("from_hz")
        if from_hz is not None and to_hz < from_hz:
            raise ValueError(
                f"{float(to_hz):.10g} Hz is below sweep.from, so there are 0 steps; write at least "
                f"'{float(from_hz):.10g} Hz'"
            )
        return to_hz

    @field_validator("step_hz")
    @classmethod
    def _countable(cls, step_hz: Fraction, info: ValidationInfo) -> Fraction:
        from_hz, to_hz = info.data.get("from_hz"), info.data.get("to_hz")
        if from_hz is not None and to_hz is not None and (to_hz - from_hz) // step_hz > _MOST_INDEX:
            raise ValueError(f"makes more than {_MOST_INDEX} steps; write a larger step")
        return step_hz

    @property
    def indices(self) -> range:
        """Indices k of the steps, from 1."""
        return range(1, int((self.to_hz - self.from_hz) // self.step_hz) + 2, self.stride)

    def frequency_hz(self, index: int) -> Fraction:
        """Return from + step·(k − 1), to 1 µHz."""
        return _rounded_hz(self.from_hz + self.step_hz * (index - 1))

    def remedy_to_begin_at(self, index: int) -> tuple[str, str]:
        """Return the key and the frequency to write."""
        return "from", f"write '{format_quantity(self.frequency_hz(index), 'Hz')}'"

    def remedy_to_end_at(self, index: int) -> tuple[str, str]:
        """Return the key and the frequency to write."""
        return "to", f"write '{format_quantity(self.frequency_hz(index), 'Hz')}'"


class ListLaw(BaseFrequencyLaw):
    """The frequencies themselves, ascending; k counts them from 1.

    Three resonances, without what lies between them:

    >>> sweep = ListLaw.model_validate({
    ...     "law": "list", "frequencies": ["1.9 kHz", "3.4 kHz", "5 kHz"], "direction": "down",
    ... })
    >>> [float(sweep.frequency_hz(k)) for k in sweep.indices]
    [1900.0, 3400.0, 5000.0]
    """

    scale_key: ClassVar[str] = "frequencies"
    spacing: ClassVar[tuple[str, str]] = ("frequencies", "leave out one of the two")

    law: Literal["list"]
    """The frequencies themselves."""
    frequencies_hz: Annotated[
        tuple[_DriveFrequency, ...], Field(alias="frequencies", strict=False, min_length=1)
    ]
    """Frequencies in ascending order; `direction` sets the order of measurement."""

    @field_validator("frequencies_hz")
    @classmethod
    def _ascending(cls, frequencies_hz: tuple[Fraction, ...]) -> tuple[Fraction, ...]:
        return _require_ascending(frequencies_hz)

    @property
    def indices(self) -> range:
        """Indices k of the steps, from 1."""
        return range(1, len(self.frequencies_hz) + 1, self.stride)

    def frequency_hz(self, index: int) -> Fraction:
        """Return the frequency number k, to 1 µHz."""
        return _rounded_hz(self.frequencies_hz[index - 1])

    def remedy_to_begin_at(self, index: int) -> tuple[str, str]:
        """Return the key and the frequency to begin with."""
        return "frequencies", f"begin with '{format_quantity(self.frequency_hz(index), 'Hz')}'"

    def remedy_to_end_at(self, index: int) -> tuple[str, str]:
        """Return the key and the frequency to end with."""
        return "frequencies", f"end with '{format_quantity(self.frequency_hz(index), 'Hz')}'"


class BaseAmplitudeLaw(Section):
    """Common part of all amplitude laws. Volts are peak volts at the loudspeaker."""

    @abstractmethod
    def volts(self, index: int, frequency_hz: Fraction) -> float:
        """Return the peak volts of step `index`, which asks for `frequency_hz`, to 1 µV."""

    @abstractmethod
    def extremes(self) -> Iterator[tuple[str, Fraction]]:
        """Yield the keys that hold the lowest and the highest peak volts, with these."""


class RampLaw(BaseAmplitudeLaw):
    """Exponential ramp: v_k = from · (to/from)^x with x = (k − first)/(last − first).

    The volts are constant before `first` and after `last`. The paper's ramp ends at step 73:

    >>> ramp = RampLaw.model_validate(
    ...     {"law": "ramp", "from": "0.5 V", "to": "16 V", "first": 1, "last": 73}
    ... )
    >>> [ramp.volts(k, Fraction(1000)) for k in (1, 37, 73, 184)]
    [0.5, 2.828427, 16.0, 16.0]
    """

    law: Literal["ramp"]
    """Volts that grow by the same ratio at each index."""
    from_v: Annotated[_PeakVolts, Field(alias="from")]
    """Peak volts at step `first` and before."""
    to_v: Annotated[_PeakVolts, Field(alias="to")]
    """Peak volts at step `last` and after."""
    first: int
    """Index at which the ramp begins; it need not be a step."""
    last: int
    """Index at which the ramp ends, above `first`."""

    @field_validator("last")
    @classmethod
    def _rises_over_steps(cls, last: int, info: ValidationInfo) -> int:
        first = info.data.get("first")
        if first is not None and last <= first:
            raise ValueError(f"{last} is not above drive.first {first}; write a later index")
        return last

    def volts(self, index: int, frequency_hz: Fraction) -> float:
        """Return the peak volts of step `index`, whatever its frequency."""
        del frequency_hz
        inside = min(max(index, self.first), self.last)
        fraction = _decimal(Fraction(inside - self.first, self.last - self.first))
        ratio = _EXACT.power(_decimal(self.to_v / self.from_v), fraction)
        return _rounded_volts(_EXACT.multiply(_decimal(self.from_v), ratio))

    def extremes(self) -> Iterator[tuple[str, Fraction]]:
        """Yield both ends."""
        yield "from", self.from_v
        yield "to", self.to_v


class ConstantLaw(BaseAmplitudeLaw):
    """The same volts at all steps.

    >>> drive = ConstantLaw.model_validate({"law": "constant", "volts": "250 mV"})
    >>> drive.volts(1, Fraction(1000)), drive.volts(99, Fraction(9000))
    (0.25, 0.25)
    """

    law: Literal["constant"]
    """The same volts at all steps."""
    volts_v: Annotated[_PeakVolts, Field(alias="volts")]
    """Peak volts."""

    def volts(self, index: int, frequency_hz: Fraction) -> float:
        """Return the peak volts of every step."""
        del index, frequency_hz
        return _rounded_volts(_decimal(self.volts_v))

    def extremes(self) -> Iterator[tuple[str, Fraction]]:
        """Yield the volts."""
        yield "volts", self.volts_v


class TableLaw(BaseAmplitudeLaw):
    """Volts by frequency, with straight lines between the points and constant volts outside.

    A loudspeaker that is weak below 2 kHz gets more there:

    >>> drive = TableLaw.model_validate({
    ...     "law": "table", "frequencies": ["1 kHz", "2 kHz"], "volts": ["8 V", "2 V"],
    ... })
    >>> [drive.volts(k, Fraction(hz)) for k, hz in enumerate((500, 1000, 1500, 2000, 9000), 1)]
    [8.0, 8.0, 5.0, 2.0, 2.0]
    """

    law: Literal["table"]
    """Volts by frequency, from a table."""
    frequencies_hz: Annotated[
        tuple[_DriveFrequency, ...], Field(alias="frequencies", strict=False, min_length=2)
    ]
    """Frequencies of the points, ascending."""
    volts_v: Annotated[tuple[_PeakVolts, ...], Field(alias="volts", strict=False)]
    """Peak volts at these frequencies."""

    @field_validator("frequencies_hz")
    @classmethod
    def _ascending(cls, frequencies_hz: tuple[Fraction, ...]) -> tuple[Fraction, ...]:
        return _require_ascending(frequencies_hz)

    @field_validator("volts_v")
    @classmethod
    def _one_for_each_frequency(
        cls, volts_v: tuple[Fraction, ...], info: ValidationInfo
    ) -> tuple[Fraction, ...]:
        frequencies_hz = info.data.get("frequencies_hz")
        if frequencies_hz is not None and len(volts_v) != len(frequencies_hz):
            raise ValueError(
                f"has {len(volts_v)} values for {len(frequencies_hz)} frequencies; give one each"
            )
        return volts_v

    def volts(self, index: int, frequency_hz: Fraction) -> float:
        """Return the peak volts at a frequency, whatever its index."""
        del index
        nodes_hz, volts_v = self.frequencies_hz, self.volts_v
        inside_hz = min(max(frequency_hz, nodes_hz[0]), nodes_hz[-1])
        k = min(bisect_right(nodes_hz, inside_hz), len(nodes_hz) - 1)
        fraction = (inside_hz - nodes_hz[k - 1]) / (nodes_hz[k] - nodes_hz[k - 1])
        return _rounded_volts(_decimal(volts_v[k - 1] + fraction * (volts_v[k] - volts_v[k - 1])))

    def extremes(self) -> Iterator[tuple[str, Fraction]]:
        """Yield the lowest and the highest volts."""
        for extreme in sorted({min(self.volts_v), max(self.volts_v)}):
            yield "volts", extreme


def _require_ascending(frequencies_hz: tuple[Fraction, ...]) -> tuple[Fraction, ...]:
    for lower, higher in pairwise(frequencies_hz):
        if higher <= lower:
            raise ValueError(
                f"has {float(higher):.10g} Hz after {float(lower):.10g} Hz; write each frequency "
                "once, in ascending order"
            )
    return frequencies_hz


def _decimal(value: Fraction) -> Decimal:
    return _EXACT.divide(Decimal(value.numerator), Decimal(value.denominator))


def _rounded_hz(value: Fraction) -> Fraction:
    return Fraction(_EXACT.quantize(_decimal(value), _MICRO))


def _rounded_volts(value: Decimal) -> float:
    return float(_EXACT.quantize(value, _MICRO))


FrequencyLaw = Annotated[GeometricLaw | LinearLaw | ListLaw, Field(discriminator="law")]
AmplitudeLaw = Annotated[RampLaw | ConstantLaw | TableLaw, Field(discriminator="law")]
