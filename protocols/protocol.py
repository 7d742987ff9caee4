"""Protocol files: what to measure, with the rules that every protocol obeys."""

from fractions import Fraction
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from protocols.errors import ProtocolError
from protocols.laws import AmplitudeLaw, FrequencyLaw
from protocols.units import (
    Angle,
    Frequency,
    Time,
)
from protocols.yaml_files.strict_yaml import (
    Description,
    Section,
    find_description,
    named_beside,
    shipped_files,
)

if TYPE_CHECKING:
    from protocols.reed import ReedFile


# Chosen: five hours of a camera with 12 frames a second.
MAX_STEPS: Final = 50_000


_Order = Annotated[int, Field(ge=0, le=100)]


class Sideband(Section):
    """Which sidebands of the light are recorded."""

    order: _Order = 1
    """Sideband that pictures show and that the drive frequency is locked for; 0 is the carrier."""
    orders: Annotated[tuple[_Order, ...], Field(strict=False)] | None = None
    """All recorded sidebands, in the order of recording at each frequency. Without this key only
    `order` is recorded."""

    @field_validator("orders")
    @classmethod
    def _each_once(
        cls, orders: tuple[int, ...] | None, info: ValidationInfo
    ) -> tuple[int, ...] | None:
        if orders is None:
            return None
        order = info.data.get("order")
        if order is not None and order not in orders:
            raise ValueError(f"lacks sideband.order, which is {order}; add {order}")
        twice = [each for k, each in enumerate(orders) if each in orders[:k]]
        if twice:
            raise ValueError(f"has {twice[0]} twice; write each order once")
        return orders

    @property
    def selected(self) -> tuple[int, ...]:
        """All recorded orders, in the order of recording at each frequency."""
        return self.orders or (self.order,)


class CameraSettings(Section):
    """Settings of the camera."""

    frames: int
    """Frames of one hologram; four-phase demodulation needs exactly 4."""
    frame_rate_hz: Annotated[Frequency, Field(alias="frame_rate", gt=0)]
    """Frames in a second. A quarter of it has to be a multiple of the synthesizers' step."""
    exposure_s: Annotated[Time | None, Field(alias="exposure", gt=0)] = None
    """Exposure of one frame. Without this key it is a whole frame period."""
    width: Annotated[int | None, Field(ge=16)] = None
    """Columns of pixels in the middle of the sensor. Without this key all are read."""
    height: Annotated[int | None, Field(ge=16)] = None
    """Rows of pixels in the middle of the sensor. Without this key all are read."""

    @field_validator("frames")
    @classmethod
    def _four_phases(cls, frames: int) -> int:
        if frames != 4:
            raise ValueError(
                f"{frames} frames make no hologram: (I0 − I2) + j(I1 − I3) takes four; write 4"
            )
        return frames

    @property
    def period_s(self) -> Fraction:
        """Time from the start of one frame to the start of the next."""
        return 1 / self.frame_rate_hz


class Tolerance(Section):
    """Errors that a plan may have."""

    lock_phase_rad: Annotated[Angle, Field(alias="lock_phase", ge=0)] = Fraction(1, 100)
    """Phase by which an imperfect frequency lock may turn the hologram over its four frames."""


class Policy(Section):
    """What happens after one kind of failure."""

    retries: Annotated[int, Field(ge=0, le=5)]
    """How often the step is measured again."""
    then: Literal["skip", "stop"]
    """What happens if all retries fail: `skip` continues with the next step, `stop` ends the
    run."""


class Policies(Section):
    """What happens when a step goes wrong."""

    bad_step: Policy = Policy(retries=1, then="skip")
    """The instruments worked, but the verdict of the step is not ok. With `skip`, bad steps are
    measured again after the last step; with `stop`, at once."""
    instrument_error: Policy = Policy(retries=0, then="stop")
    """An instrument failed. All instruments are switched off and on again before the next
    attempt."""
    give_up_after: Annotated[int, Field(ge=1, le=100_000)] = 8
    """Number of bad steps in a row after which the run stops, because a cable may be
    disconnected."""


class Calibration(Section):
    """Frames of something else than a driven reed."""

    kind: Literal["dark", "flat", "lo_only", "object_only", "order0"]
    """Light on the sensor: none, even light of a lamp, the local oscillator alone, the object beam
    alone, or both beams with the reed at rest."""
    count: Annotated[int, Field(ge=1, le=1000)] = 4
    """Number of acquisitions at each exposure."""
    exposures_s: Annotated[
        tuple[Annotated[Time, Field(gt=0)], ...] | None, Field(alias="exposures", strict=False)
    ] = None
    """Exposures, measured one after the other. Without this key, the exposure of the camera."""


class Protocol(Description):
    """One sweep: frequencies and volts of the drive, and how the holograms are recorded."""

    kind: ClassVar[str] = "protocol"
    folder: ClassVar[str] = "."

    name: Annotated[str, Field(min_length=1, max_length=80)]
    """Title in tables and reports."""
    series: Annotated[str, Field(min_length=1, max_length=40)]
    """Series that the sweep belongs to, such as A or B."""
    chamber: Literal["asymmetric", "symmetric"]
    """Excitation chamber: with its right half filled (series A) or empty (series B)."""
    reed: Annotated[str, Field(min_length=1, max_length=255)] = "clarinet"
    """Kind of reed that is measured: a reed file next to the protocol or in the current folder, or
    the name of a shipped reed."""
    sweep: FrequencyLaw
    """Drive frequencies of the steps."""
    drive: AmplitudeLaw
    """Peak volts at the loudspeaker."""
    sideband: Sideband = Sideband()
    """Which sidebands of the light are recorded."""
    camera: CameraSettings
    """Settings of the camera."""
    settle_s: Annotated[Time, Field(alias="settle", ge=0)]
    """Wait between a new setting and the first frame that counts."""
    tolerance: Tolerance = Tolerance()
    """Errors that a plan may have."""
    policy: Policies = Policies()
    """What happens when a step goes wrong."""
    keep: Literal["holograms", "frames"] = "holograms"
    """What the run file holds: the complex field around the reed, or all frames."""
    calibration: Calibration | None = None
    """Frames of something else than a driven reed, in place of the sweep. Needs `keep: frames`."""

    @field_validator("calibration")
    @classmethod
    def _keeps_frames(
        cls, calibration: Calibration | None, info: ValidationInfo
    ) -> Calibration | None:
        if calibration is not None and info.data.get("keep") == "holograms":
            raise ValueError("needs the frames themselves; write keep: frames")
        return calibration

    @model_validator(mode="after")
    def _require_few_steps(self) -> Self:
        key, steps = "sweep", len(self.sweep.indices) * len(self.sideband.selected)
        if self.calibration is not None:
            key, exposures = "calibration", self.calibration.exposures_s or (self.exposure_s,)
            steps = self.calibration.count * len(exposures)
        if steps > MAX_STEPS:
            raise self.error(key, f"makes {steps} steps; make at most {MAX_STEPS} in one run")
        return self

    @property
    def exposure_s(self) -> Fraction:
        """Exposure of one frame: as asked, or a whole frame period."""
        return self.camera.exposure_s or self.camera.period_s

    def reed_file(self) -> "ReedFile":
        """Read the file of the reed that this protocol is for.

        Raises
        ------
        ProtocolError
            If there is no such file or anything in it is wrong, or the reed is uneven.
        """
        # Imported here, because protocols are read without the libraries that compute reeds.
        from physics.reed.geometry import is_even
        from protocols.reed import ReedFile

        try:
            reed = ReedFile.from_file(named_beside(self.source, self.reed))
        except ProtocolError as error:
            raise self.error("reed", str(error)) from None
        if not is_even(reed.geometry()):
            raise self.error(
                "reed",
                f"{self.reed} has a thickness map with two different sides, and runs are fitted "
                "with even reeds only; give each y and -y the mean of their deviations",
            )
        return reed


def find_protocol(name_or_path: str | Path) -> Traversable:
    """Find a protocol by its path, or a shipped one by its name.

    Parameters
    ----------
    name_or_path : str or Path
        A path, or the name of a shipped protocol: ``seriesA``, ``seriesA.yaml`` and
        ``protocols/seriesA.yaml`` all find it from anywhere.

    Raises
    ------
    ProtocolError
        If there is neither; the message lists the shipped ones.
    """
    return find_description(str(name_or_path), Protocol.kind, Protocol.folder)


def shipped_protocols() -> tuple[str, ...]:
    """Return the names of the shipped protocols, sorted."""
    files = shipped_files(Protocol.folder).items()
    return tuple(sorted(name for name, file in files if not is_campaign(file.read_text("utf-8"))))


def is_campaign(text: str) -> bool:
    """Return whether the text of a file describes a campaign."""
    return any(line.startswith("parts:") for line in text.splitlines())
