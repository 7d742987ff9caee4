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
    """Options of all GenICam cameras."""

    trigger: Trigger = "free"
    """What starts an exposure: the clock of the camera, this computer, or a rising edge at a
    line."""
    pulses: Literal["bench", "elsewhere"] = "bench"
    """Source of the edges at a line: an instrument of this bench, or a source that always runs."""
    pixel_format: PixelFormat = "Mono12"
    """Pixel format: as many bits as `bits` states, or Mono16 with the pixels in the lower bits."""
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    """Longest wait for a frame that is due, in s."""
    saturation_dn: Annotated[int, Field(ge=1, le=65_535)] | None = None
    """Digital number at which pixels saturate, if that is below the highest of the ADC."""
    buffer_s: Annotated[float, Field(ge=1, le=60)] = 1.5
    """Time in s for which frames are kept that nothing has asked for."""


class CameraLink(Protocol):
    """An open camera, and the stream of its frames.

    All methods may raise `InstrumentError` if the camera is gone or refuses.
    """

    @property
    def camera(self) -> str:
        """Name of the camera in messages."""
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
        """Whether a time stamp is the end of an exposure instead of its start."""
        ...

    @property
    def latch(self) -> Callable[[], float] | None:
        """Function that reads the clock of the camera in s; None if it cannot."""
        ...

    @property
    def first_number(self) -> int | None:
        """Number of the first frame after a start; None if the camera counts on."""
        ...

    @property
    def loss_remedy(self) -> str:
        """Remedy for frames that arrive incomplete."""
        ...

    def open_stream(self, buffers: int) -> None:
        """Prepare buffers for `buffers` frames, which come after `start` only."""
        ...

    def start(self) -> None:
        """Start the stream of frames."""
        ...

    def stop(self) -> None:
        """Stop the stream of frames."""
        ...

    def receive(self, timeout_s: float) -> Delivery | None:
        """Return the next frame of the stream, None if there is none after `timeout_s`."""
        ...

    def trigger(self) -> None:
        """Start one exposure."""
        ...

    def close(self) -> None:
        """Release the camera; raises nothing."""
        ...


def pulses_for(options: CameraOptions, context: BenchContext) -> CameraTrigger | None:
    """Return what plays pulses for a camera of these options; None if it needs none."""
    wanted = options.trigger not in ("free", "software") and options.pulses == "bench"
    return context.share(CameraTrigger) if wanted else None
