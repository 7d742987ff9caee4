"""What a sweep is: the protocol and the rules that every protocol file obeys."""

from fractions import Fraction
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from protocols.errors import ProtocolError
from protocols.strict_yaml import (
    Description,
    Section,
    find_description,
    named_beside,
    shipped_files,
)
from protocols.units import (
    Angle,
    Frequency,
    Interval,
    Time,
    Voltage,
)

if TYPE_CHECKING:
    from protocols.reed import ReedFile


# Chosen: five hours of a camera with 12 frames a second.
MAX_STEPS: Final = 50_000


class Sweep(Section):
    """The drive frequencies: f_k = reference · 2^(interval·k / 1200 cents), k = first … last.

    Attributes
    ----------
    direction : {'up', 'down', 'shuffled'}, optional
        In which order steps are taken, up by default. Shuffled is always the same order.
    """

    reference_hz: Annotated[Frequency, Field(alias="reference", gt=0, le=10**9)]
    interval_cents: Annotated[Interval, Field(alias="interval", gt=0, le=1200)]
    first: Annotated[int, Field(ge=-100_000, le=100_000)]
    last: Annotated[int, Field(ge=-100_000, le=100_000)]
    stride: Annotated[int, Field(ge=1)] = 1
    direction: Literal["up", "down", "shuffled"] | None = None

    @field_validator("first", "last")
    @classmethod
    def _near_reference(cls, index: int, info: ValidationInfo) -> int:
        interval_cents = info.data.get("interval_cents")
        if interval_cents is not None and abs(index) * interval_cents > 20 * 1200:
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


class Ramp(Section):
    """Peak volts at the load, growing by a constant ratio per index, constant outside."""

    from_v: Annotated[Voltage, Field(alias="from", gt=0, le=1000)]
    to_v: Annotated[Voltage, Field(alias="to", gt=0, le=1000)]
    first: int
    last: int

    @field_validator("last")
    @classmethod
    def _rises_over_steps(cls, last: int, info: ValidationInfo) -> int:
        first = info.data.get("first")
        if first is not None and last <= first:
            raise ValueError(f"{last} is not above drive.ramp.first {first}; write a later index")
        return last


class Drive(Section):
    """What the tweeter gets."""

    ramp: Ramp


_Order = Annotated[int, Field(ge=0, le=100)]


class Sideband(Section):
    """Which sideband the difference of the synthesizers selects; 0 is the carrier.

    Attributes
    ----------
    order : int
        The one that pictures are made of, and that the drive's frequency is locked by.
    orders : tuple of int, optional
        All that are recorded, in their sequence at each frequency; that one alone by default.
    """

    order: _Order = 1
    orders: Annotated[tuple[_Order, ...], Field(strict=False)] | None = None

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
        """All orders, in their sequence at each frequency."""
        return self.orders or (self.order,)


class CameraSettings(Section):
    """How the camera is run. Without `exposure`, each frame integrates a whole period."""

    frames: int
    frame_rate_hz: Annotated[Frequency, Field(alias="frame_rate", gt=0)]
    exposure_s: Annotated[Time | None, Field(alias="exposure", gt=0)] = None
    width: Annotated[int | None, Field(ge=16)] = None
    height: Annotated[int | None, Field(ge=16)] = None

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
    """What the plan may leave imperfect."""

    lock_phase_rad: Annotated[Angle, Field(alias="lock_phase", ge=0)] = Fraction(1, 100)


class Policy(Section):
    """What becomes of a step that goes wrong: tried again so often, and what then."""

    retry: Annotated[int, Field(ge=0, le=5)]
    then: Literal["skip", "stop"]


class Policies(Section):
    """What happens when a step goes wrong.

    Attributes
    ----------
    bad_pictures : Policy
        The instruments did as asked, but the step's verdict is not ok. ``skip`` goes on, and takes
        bad steps again after the last one; ``stop`` takes them again at once, and ends the run.
    instrument_error : Policy
        An instrument failed. Before the step is tried again, or the next one begun, all is switched
        off and on again.
    give_up_after : int
        Steps that may be bad one after another; then the run stops, because a cable may be off.
    """

    bad_pictures: Policy = Policy(retry=1, then="skip")
    instrument_error: Policy = Policy(retry=0, then="stop")
    give_up_after: Annotated[int, Field(ge=1, le=100_000)] = 8


class Calibration(Section):
    """Frames of something else than a driven reed.

    Attributes
    ----------
    kind : {'dark', 'flat', 'lo_only', 'object_only', 'order0'}
        No light; even light of a lamp; local oscillator alone; object beam alone; holograms of the
        reed at rest.
    count : int
        Acquisitions of each exposure.
    exposures_s : tuple, optional
        One after the other; that of the camera if not given.
    """

    kind: Literal["dark", "flat", "lo_only", "object_only", "order0"]
    count: Annotated[int, Field(ge=1, le=1000)] = 4
    exposures_s: Annotated[
        tuple[Annotated[Time, Field(gt=0)], ...] | None, Field(alias="exposures", strict=False)
    ] = None


class Protocol(Description):
    """One sweep: which drives, how loud, how they are recorded.

    Attributes
    ----------
    name : str
        For people.
    series : str
        Series that the sweep belongs to, such as A or B.
    chamber : {'asymmetric', 'symmetric'}
        Excitation chamber: its right half filled (series A) or empty (series B).
    reed : str
        Kind of reed that is measured: a reed file (beside the protocol, or from where the program
        is started), or the name of a shipped one. See `reed_file`.
    sweep, drive, sideband, camera, tolerance, policy
        Sections, see their classes.
    settle_s : Fraction
        Wait between a new setting and the first frame that counts.
    keep : {'holograms', 'frames'}
        What the run file holds: the complex field around the reed, or the raw frames.
    calibration : Calibration, optional
        Takes the place of the sweep; its frames are kept.
    """

    kind: ClassVar[str] = "protocol"
    folder: ClassVar[str] = "."

    name: Annotated[str, Field(min_length=1, max_length=80)]
    series: Annotated[str, Field(min_length=1, max_length=40)]
    chamber: Literal["asymmetric", "symmetric"]
    reed: Annotated[str, Field(min_length=1, max_length=255)] = "clarinet"
    sweep: Sweep
    drive: Drive
    sideband: Sideband = Sideband()
    camera: CameraSettings
    settle_s: Annotated[Time, Field(alias="settle", ge=0)]
    tolerance: Tolerance = Tolerance()
    policy: Policies = Policies()
    keep: Literal["holograms", "frames"] = "holograms"
    calibration: Calibration | None = None

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
        # Not with the module: a protocol is read without the libraries that compute reeds.
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
    """Find a protocol: a file of yours first, then a shipped one by name.

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
    """Names of the protocols that come with the software, sorted."""
    files = shipped_files(Protocol.folder).items()
    return tuple(sorted(name for name, file in files if not is_campaign(file.read_text("utf-8"))))


def is_campaign(text: str) -> bool:
    """Whether the text of a file describes a campaign: several protocols, part by part."""
    return any(line.startswith("parts:") for line in text.splitlines())
