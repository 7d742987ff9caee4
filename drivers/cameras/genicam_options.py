"""Options of GenICam cameras and what a camera must be able to do."""

from collections.abc import Callable
from typing import Annotated, Literal, Protocol

from pydantic import Field

from drivers.cameras.frames import Delivery
from drivers.cameras.genicam import (
    Features,
    PixelFormat,
    Trigger,
)
from drivers.cameras.trigger import CameraTrigger
from drivers.context import BenchContext
from drivers.options import Options


class CameraOptions(Options):
    """Options that all GenICam cameras have.

    Attributes
    ----------
    trigger : {'free', 'software', 'Line0', 'Line1', 'Line2', 'Line3'}
        What starts an exposure: the camera's clock, this computer, or a rising edge at a line.
    pulses : {'bench', 'elsewhere'}
        Who plays the edges at a line: an instrument of this bench, which is told when to, or
        something that plays all the time.
    pixel_format : {'Mono8', 'Mono10', 'Mono12', 'Mono16'}
        As many bits as `bits` says, or Mono16 with the pixels in the lower bits.
    timeout_s : float
        How long a frame may be overdue.
    saturation_dn : int or None
        Number at which pixels stop growing with light, if that is below what the ADC can tell.
    buffer_s : float
        For how long frames are kept that nobody asks for.
    """

    trigger: Trigger = "free"
    pulses: Literal["bench", "elsewhere"] = "bench"
    pixel_format: PixelFormat = "Mono12"
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    saturation_dn: Annotated[int, Field(ge=1, le=65_535)] | None = None
    buffer_s: Annotated[float, Field(ge=1, le=60)] = 1.5


class CameraLink(Protocol):
    """An open camera, and the stream of its frames.

    All methods may raise `InstrumentError`: the camera is gone, or refuses.
    """

    @property
    def camera(self) -> str:
        """What to call the camera in messages."""
        ...

    @property
    def identity(self) -> str:
        """Maker, model, serial number and firmware."""
        ...

    @property
    def features(self) -> Features:
        """Its settings."""
        ...

    @property
    def stamps_frames(self) -> bool:
        """Whether frames carry time stamps."""
        ...

    @property
    def stamped_at_end(self) -> bool:
        """Whether a time stamp tells the end of an exposure instead of its start."""
        ...

    @property
    def latch(self) -> Callable[[], float] | None:
        """What asks the camera for its time in s, if it can tell."""
        ...

    @property
    def first_number(self) -> int | None:
        """What the camera calls the first frame since its start; None if it counts on."""
        ...

    @property
    def loss_remedy(self) -> str:
        """What to do if frames arrive incomplete."""
        ...

    def open_stream(self, buffers: int) -> None:
        """Make ready for so many frames to wait; they come after `start` only."""
        ...

    def start(self) -> None:
        """Tell the camera to take frames."""
        ...

    def stop(self) -> None:
        """Take no more frames."""
        ...

    def receive(self, timeout_s: float) -> Delivery | None:
        """Return the next frame of the stream, None if there is none after `timeout_s`."""
        ...

    def trigger(self) -> None:
        """Start one exposure."""
        ...

    def close(self) -> None:
        """Let go of the camera; raises nothing."""
        ...


def pulses_for(options: CameraOptions, context: BenchContext) -> CameraTrigger | None:
    """Return what plays pulses for a camera of these options; None if it needs none."""
    wanted = options.trigger not in ("free", "software") and options.pulses == "bench"
    return context.share(CameraTrigger) if wanted else None
