"""Settings of cameras that follow GenICam, whatever carries them (pylon, Aravis).

Names of features are those of the Standard Features Naming Convention, or older ones that makers
still use. Cameras round what they are asked for without a word, so all is read back.
"""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, Literal, Protocol

from drivers.errors import InstrumentError, LimitError

Trigger = Literal["free", "software", "Line0", "Line1", "Line2", "Line3"]
PixelFormat = Literal["Mono8", "Mono10", "Mono12", "Mono16"]

_EXPOSURE: Final = ("ExposureTime", "ExposureTimeAbs")
_RATE: Final = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_RATE_SWITCH: Final = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
_POSSIBLE_RATE: Final = (
    "ResultingFrameRate",
    "ResultingFrameRateAbs",
    "BslResultingAcquisitionFrameRate",
)
_AUTOMATICS: Final = ("ExposureAuto", "GainAuto", "BlackLevelAuto")

# A rate that is off by 1e-4 turns the phase by 6e-4 rad in four frames; cameras count whole µs.
RATE_TOLERANCE: Final = 1e-4
# Of the exposure; changes the brightness by as much, and the sidebands by less.
EXPOSURE_TOLERANCE: Final = 5e-3


class Features(Protocol):
    """The features of an open camera. All methods raise `InstrumentError` if the camera refuses."""

    def has(self, name: str) -> bool:
        """Return whether the feature is there, with the present settings."""
        ...

    def writable(self, name: str) -> bool:
        """Return whether the feature is there and may be changed, with the present settings."""
        ...

    def integer(self, name: str) -> int:
        """Read an integer."""
        ...

    def set_integer(self, name: str, value: int) -> None:
        """Write an integer."""
        ...

    def integer_range(self, name: str) -> tuple[int, int, int]:
        """Return least, most and increment of an integer."""
        ...

    def real(self, name: str) -> float:
        """Read a float."""
        ...

    def set_real(self, name: str, value: float) -> None:
        """Write a float."""
        ...

    def real_range(self, name: str) -> tuple[float, float]:
        """Return least and most of a float."""
        ...

    def text(self, name: str) -> str:
        """Read an enumeration or a string."""
        ...

    def set_text(self, name: str, value: str) -> None:
        """Write an enumeration or a string."""
        ...

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values of an enumeration that may be set at present."""
        ...

    def set_switch(self, name: str, on: bool) -> None:
        """Write a Boolean."""
        ...

    def execute(self, name: str) -> None:
        """Carry out a command."""
        ...


@dataclass(frozen=True, slots=True)
class GenicamSettings:
    """Settings of a running camera.

    Attributes
    ----------
    frame_rate_hz : Fraction
        Of a camera that is triggered from outside, the rate of the trigger.
    exposure_s : Fraction
    shape : (int, int)
        Rows and columns of the middle part of the sensor.
    pixel_format : {'Mono8', 'Mono10', 'Mono12', 'Mono16'}
        Unpacked.
    trigger : {'free', 'software', 'Line0', 'Line1', 'Line2', 'Line3'}
        What starts an exposure: the camera's own clock, a command, or a rising edge.
    """

    frame_rate_hz: Fraction
    exposure_s: Fraction
    shape: tuple[int, int]
    pixel_format: PixelFormat
    trigger: Trigger


def apply_settings(features: Features, asked: GenicamSettings, camera: str) -> None:
    """Set a stopped camera up, and read back that it took everything as asked.

    Parameters
    ----------
    features : Features
    asked : GenicamSettings
    camera : str
        What to call it in messages.

    Raises
    ------
    LimitError
        If size, exposure, pixel format or trigger are none that the camera knows; nothing has
        changed then.
    InstrumentError
        If the camera refuses, or runs otherwise than asked; its settings are then anyhow.
    """
    _require_known(features, asked, camera)
    for name in _AUTOMATICS:
        if features.writable(name):
            features.set_text(name, "Off")
    features.set_text("AcquisitionMode", "Continuous")
    features.set_text("PixelFormat", asked.pixel_format)
    _set_region(features, asked.shape)
    _set_times(features, asked, camera)
    _set_trigger(features, asked.trigger)
    differing = _differing(features, asked, camera)
    if differing:
        raise InstrumentError(
            f"camera ({camera}): took its settings otherwise than asked: {'; '.join(differing)}; "
            "ask for what the camera can do"
        )
    _require_rate(features, asked, camera)


def timestamp_latch(features: Features) -> Callable[[], float] | None:
    """Return what asks a camera for its time in s, or None if there is no such feature."""
    if features.has("GevTimestampControlLatch"):
        per_s = features.integer("GevTimestampTickFrequency")
        return lambda: _latched(features, "GevTimestampControlLatch", "GevTimestampValue", per_s)
    if features.has("TimestampLatch"):
        # By the naming convention, nanoseconds.
        return lambda: _latched(features, "TimestampLatch", "TimestampLatchValue", 1_000_000_000)
    return None


def _latched(features: Features, latch: str, value: str, per_s: int) -> float:
    features.execute(latch)
    return features.integer(value) / per_s


def _first(features: Features, names: tuple[str, ...]) -> str | None:
    """Return the first name that the camera knows."""
    return next((name for name in names if features.has(name)), None)


def _required(features: Features, names: tuple[str, ...], camera: str) -> str:
    """Return the first name that the camera knows; it has to know one."""
    name = _first(features, names)
    if name is None:
        raise LimitError(
            f"camera ({camera}): has no {names[0]}, which has to be set; use another camera, or "
            "another options.trigger"
        )
    return name


def _sensor(features: Features, side: str) -> int:
    """Pixels of the sensor along a side."""
    name = _first(features, (f"{side}Max", f"Sensor{side}"))
    return features.integer(name) if name else features.integer_range(side)[1]


def _require_known(features: Features, asked: GenicamSettings, camera: str) -> None:
    for side, pixels in (("Height", asked.shape[0]), ("Width", asked.shape[1])):
        (least, _, step), most = features.integer_range(side), _sensor(features, side)
        if not least <= pixels <= most or (pixels - least) % step:
            raise LimitError(
                f"camera ({camera}): was asked for a {side} of {pixels} pixels, has {least} to "
                f"{most} in steps of {step}; change camera.{side.lower()}"
            )
    least_us, most_us = features.real_range(_required(features, _EXPOSURE, camera))
    if not least_us <= 1e6 * float(asked.exposure_s) <= most_us:
        raise LimitError(
            f"camera ({camera}): was asked to expose {1e6 * float(asked.exposure_s):.7g} µs, "
            f"has {least_us:g} to {most_us:g} µs; change camera.exposure"
        )
    if asked.trigger == "free":
        _required(features, _RATE, camera)
    formats = features.choices("PixelFormat")
    if asked.pixel_format not in formats:
        raise LimitError(
            f"camera ({camera}): was asked for pixels {asked.pixel_format}, has "
            f"{', '.join(formats)}; change instruments.camera.options.pixel_format"
        )
    sources = features.choices("TriggerSource") if features.has("TriggerSource") else ()
    if asked.trigger != "free" and _source(asked.trigger) not in sources:
        raise LimitError(
            f"camera ({camera}): was asked to be triggered by {asked.trigger}, has "
            f"{', '.join(sources) or 'no trigger'}; change instruments.camera.options.trigger"
        )


def _source(trigger: Trigger) -> str:
    return "Software" if trigger == "software" else trigger


def _set_region(features: Features, shape: tuple[int, int]) -> None:
    """Read out the middle of the sensor, as nearly as the camera's increments allow."""
    sides = (("Height", "OffsetY", shape[0]), ("Width", "OffsetX", shape[1]))
    # A part that does not begin at the edge has less space to grow.
    for _, offset, _ in sides:
        if features.writable(offset):
            features.set_integer(offset, features.integer_range(offset)[0])
    for side, _, pixels in sides:
        features.set_integer(side, pixels)
    for side, offset, pixels in sides:
        if features.writable(offset):
            least, _, step = features.integer_range(offset)
            rest = _sensor(features, side) - pixels
            features.set_integer(offset, least + (rest // 2 - least) // step * step)


def _set_times(features: Features, asked: GenicamSettings, camera: str) -> None:
    """Set exposure and rate; each may bound the other, so the old rate is switched off first."""
    switch = _first(features, _RATE_SWITCH)
    if switch:
        features.set_switch(switch, on=False)
    if features.writable("ExposureMode"):
        features.set_text("ExposureMode", "Timed")
    features.set_real(_required(features, _EXPOSURE, camera), 1e6 * float(asked.exposure_s))
    if asked.trigger != "free":
        return
    if switch:
        features.set_switch(switch, on=True)
    features.set_real(_required(features, _RATE, camera), float(asked.frame_rate_hz))


def _set_trigger(features: Features, trigger: Trigger) -> None:
    """Switch all triggers off but the one that starts a frame, if it is asked for."""
    if features.writable("TriggerSelector"):
        for selector in features.choices("TriggerSelector"):
            features.set_text("TriggerSelector", selector)
            if features.writable("TriggerMode"):
                features.set_text("TriggerMode", "Off")
        features.set_text("TriggerSelector", "FrameStart")
    elif features.writable("TriggerMode"):
        features.set_text("TriggerMode", "Off")
    if trigger == "free":
        return
    features.set_text("TriggerSource", _source(trigger))
    if trigger != "software" and features.writable("TriggerActivation"):
        features.set_text("TriggerActivation", "RisingEdge")
    features.set_text("TriggerMode", "On")


def _differing(features: Features, asked: GenicamSettings, camera: str) -> list[str]:
    """Return the settings that read back differently, each in a few words."""
    texts = {"PixelFormat": asked.pixel_format, "AcquisitionMode": "Continuous"}
    if features.has("TriggerMode"):
        texts["TriggerMode"] = "Off" if asked.trigger == "free" else "On"
    if asked.trigger != "free":
        texts["TriggerSource"] = _source(asked.trigger)
    exposure, exposure_us = _required(features, _EXPOSURE, camera), 1e6 * float(asked.exposure_s)
    numbers = [
        ("Height", features.integer("Height"), asked.shape[0], 0.0),
        ("Width", features.integer("Width"), asked.shape[1], 0.0),
        (exposure, features.real(exposure), exposure_us, EXPOSURE_TOLERANCE),
    ]
    if asked.trigger == "free":
        rate = _required(features, _RATE, camera)
        numbers.append((rate, features.real(rate), float(asked.frame_rate_hz), RATE_TOLERANCE))
    wrong = [
        f"{name} {got} instead of {text}"
        for name, text in texts.items()
        if (got := features.text(name)) != text
    ]
    return wrong + [
        f"{name} {got:.8g} instead of {number:.8g}"
        for name, got, number, tolerance in numbers
        if not abs(got - number) <= tolerance * number
    ]


def _require_rate(features: Features, asked: GenicamSettings, camera: str) -> None:
    """Refuse if the camera says that it cannot keep up with these settings."""
    name = _first(features, _POSSIBLE_RATE)
    if name is None:
        return
    possible_hz = features.real(name)
    if possible_hz < float(asked.frame_rate_hz) * (1 - RATE_TOLERANCE):
        raise InstrumentError(
            f"camera ({camera}): takes {possible_hz:.7g} frames per second with an exposure of "
            f"{float(asked.exposure_s):g} s, but was asked for {float(asked.frame_rate_hz):.7g}; "
            "shorten camera.exposure, or lower camera.width and camera.height"
        )
