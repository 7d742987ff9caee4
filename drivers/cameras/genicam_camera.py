"""The camera's role, for any camera that follows GenICam, on any link that carries its frames."""

import math
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.clock import (
    ArrivalClock,
    BoundedClock,
    CameraClock,
    LatchedClock,
)
from drivers.cameras.frames import FrameSequence
from drivers.cameras.genicam import (
    GenicamSettings,
    PixelFormat,
    apply_settings,
)
from drivers.cameras.genicam_options import CameraLink, CameraOptions
from drivers.cameras.trigger import CameraTrigger
from drivers.context import WallClock
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.roles import Clock, Frame
from protocols.bench import CameraSensor

# How often the link is looked at while nothing comes: bounds how well arrivals are known.
_POLL_S: Final = 0.01
# Two are filled or emptied, one is on its way.
_SPARE_BUFFERS: Final = 3


class GenicamCamera:
    """A camera on a link.

    ::

        idle ─ configure → configured ─ start → running ─ stop → configured

    Frames that arrive between two calls wait in the link's buffers; `grab` passes over those that
    began too early. A frame that arrived incomplete is never handed over; the gap in the ids shows
    it.

    Parameters
    ----------
    link : CameraLink
    entry : CameraSensor
    options : CameraOptions
    pulses : CameraTrigger, optional
        What to tell that the camera waits for pulses, see `pulses_for`.
    host : Clock, optional
        The computer's clock.

    Attributes
    ----------
    link : CameraLink
        For those who need more of the camera than its role.

    Raises
    ------
    BenchSetupError
        If the pixel format does not hold the bits that the bench file states.
    """

    def __init__(
        self,
        link: CameraLink,
        entry: CameraSensor,
        options: CameraOptions,
        pulses: CameraTrigger | None = None,
        host: Clock | None = None,
    ) -> None:
        _require_bits(entry.bits, options.pixel_format, link.camera)
        self.link, self._entry, self._options = link, entry, options
        self._pulses = pulses
        self._host: Clock = host or WallClock()
        self._settings: GenicamSettings | None = None
        self._clock: CameraClock = self._make_clock(0.0)
        self._running = False
        self._sequence = FrameSequence()
        self._absent_s = self._trigger_due_s = self._host.now_s()
        self._triggered = False

    @property
    def identity(self) -> str:
        """Maker, model, serial number and firmware, and what its times are."""
        return f"{self.link.identity}; {self._clock.name}"

    @property
    def saturation_dn(self) -> int:
        """Number at which a pixel is saturated."""
        most: int = 2**self._entry.bits - 1
        return min(most, self._options.saturation_dn or most)

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Set the camera up; see `Camera.configure`.

        Raises
        ------
        InstrumentError
            Also if the camera refuses a setting, or reads back otherwise than asked.
        """
        camera, options = self.link.camera, self._options
        if self._running:
            raise InstrumentError(
                f"camera ({camera}): is running, but was asked for other settings; stop it first"
            )
        _require_within(self._entry, frame_rate_hz, exposure_s, shape, camera)
        asked = GenicamSettings(
            frame_rate_hz, exposure_s, shape, options.pixel_format, options.trigger
        )
        before, self._settings = self._settings, None
        try:
            apply_settings(self.link.features, asked, camera)
        except LimitError:
            self._settings = before
            raise
        self._settings = asked
        self._clock = self._make_clock(float(1 / frame_rate_hz))

    def start(self) -> None:
        """Begin to take frames, from frame 0; see `Camera.start`."""
        if self._settings is None:
            raise InstrumentError(
                f"camera ({self.link.camera}): was asked to start without settings; call "
                "configure first"
            )
        if self._running:
            self.stop()
        self._sequence = FrameSequence(self.link.first_number)
        self._triggered = False
        self.link.open_stream(self._buffers(self._settings))
        self._absent_s = self._trigger_due_s = self._host.now_s()
        self._clock.started()
        # Before it is: what ends this in between must find a camera that it has to stop.
        self._running = True
        self.link.start()
        if self._pulses is not None:
            self._pulses.play(self._settings.frame_rate_hz)

    def stop(self) -> None:
        """Take no more frames, and let no pulses be played: another camera may have begun them."""
        try:
            if self._pulses is not None:
                self._pulses.stop()
        finally:
            if self._running:
                self.link.stop()
                self._running = False

    def grab(self, count: int, not_before_s: float) -> list[Frame]:
        """Return the next frames; see `Camera.grab`.

        Raises
        ------
        InstrumentError
            Also if frames arrive, but none whole, or none that is fresh, and if a frame is newer
            than the camera's clock.
        """
        settings = self._require_running()
        ahead_s = max(not_before_s - self.now_s(), 0.0)
        if settings.trigger == "software":
            self._host.wait(ahead_s)
            ahead_s = 0.0
        wait = self._new_wait(ahead_s)
        while True:
            gap_stays = wait.gap_stays(self._absent_s)
            frames = self._sequence.take(count, not_before_s, incomplete=gap_stays)
            if frames:
                self._require_past(frames)
                return frames
            began_s = self._take_in(_POLL_S)
            wait.note(began_s, not_before_s, enough=self._sequence.waiting >= count)
            if wait.over(self._absent_s):
                raise self._nothing_came(wait, not_before_s)

    def now_s(self) -> float:
        """Return the present time on the clock of the frames; see `Camera.now_s`.

        Raises
        ------
        InstrumentError
            Also if the camera does not tell its time and no frame comes that would.
        """
        if not self._clock.known:
            self._require_running()
            wait = self._new_wait(0.0)
            while not self._clock.known:
                wait.note(self._take_in(_POLL_S), -math.inf, enough=True)
                if wait.over(self._absent_s):
                    raise self._nothing_came(wait, -math.inf)
        return self._clock.now_s()

    def close(self) -> None:
        """Stop, and let go of the camera. May be called twice; raises nothing."""
        # A camera that is gone cannot be stopped.
        with suppress(InstrumentError):
            self.stop()
        self._settings = None
        self.link.close()

    def _make_clock(self, period_s: float) -> CameraClock:
        link, host_s = self.link, self._host.now_s
        if link.latch is not None:
            return LatchedClock(link.latch, stamped_at_end=link.stamped_at_end)
        if link.stamps_frames:
            return BoundedClock(host_s, stamped_at_end=link.stamped_at_end)
        # A camera that reads out longer than a period cannot keep its rate.
        return ArrivalClock(host_s, readout_s=period_s)

    def _new_wait(self, ahead_s: float) -> "_Wait":
        """Begin to wait for frames that begin `ahead_s` from now."""
        settings = self._require_running()
        period_s = 1 / float(settings.frame_rate_hz)
        quiet_s = self._options.timeout_s + period_s + float(settings.exposure_s)
        # Those that lie ready, those that come too early, and those of one timeout.
        useless_most = self._buffers(settings) + math.ceil((ahead_s + quiet_s) / period_s)
        return _Wait(self._host, quiet_s, period_s, useless_most)

    def _buffers(self, settings: GenicamSettings) -> int:
        return math.ceil(self._options.buffer_s * settings.frame_rate_hz) + _SPARE_BUFFERS

    def _take_in(self, timeout_s: float) -> float | None:
        """Wait for a frame; return when it began, NaN if it is broken, None if there is none."""
        settings = self._require_running()
        if settings.trigger == "software":
            self._trigger_when_due(1 / float(settings.frame_rate_hz))
        asked_s = self._host.now_s()
        delivery = self.link.receive(0.0)
        if delivery is None:
            # Whatever comes now was not there yet.
            self._absent_s = asked_s
            delivery = self.link.receive(timeout_s)
        if delivery is None:
            return None
        self._triggered = False
        if delivery.image is None:
            return math.nan
        if self.link.stamps_frames and delivery.stamp_s <= 0:
            raise InstrumentError(
                f"camera ({self.link.camera}): sent a frame without a time stamp, so its start is "
                "not known; switch its time stamps on"
            )
        image = self._checked(delivery.image, settings.shape)
        began_s = self._clock.began_s(delivery.stamp_s, self._absent_s, float(settings.exposure_s))
        self._sequence.add(delivery.number, began_s, image)
        return began_s

    def _trigger_when_due(self, period_s: float) -> None:
        if self._triggered:
            return
        self._host.wait(self._trigger_due_s - self._host.now_s())
        now_s = self._host.now_s()
        self.link.trigger()
        self._triggered = True
        # In step with the first trigger, unless a period was missed.
        on_time = now_s - self._trigger_due_s < period_s
        self._trigger_due_s = (self._trigger_due_s if on_time else now_s) + period_s

    def _checked(self, image: NDArray[Any], shape: tuple[int, int]) -> NDArray[np.uint16]:
        """Return the pixels as uint16; those of another size or with more bits are refused."""
        if image.shape != shape:
            raise InstrumentError(
                f"camera ({self.link.camera}): sent {image.shape[1]} x {image.shape[0]} pixels, "
                f"but was set to {shape[1]} x {shape[0]}; configure it again"
            )
        most = 2**self._entry.bits - 1
        if image.max() > most:
            raise InstrumentError(
                f"camera ({self.link.camera}): sent pixels up to {image.max()}, but has "
                f"{self._entry.bits} bits; correct instruments.camera.bits or options.pixel_format"
            )
        return image.astype(np.uint16, copy=False)

    def _require_running(self) -> GenicamSettings:
        if not self._running or self._settings is None:
            raise InstrumentError(
                f"camera ({self.link.camera}): is stopped, but was asked for frames or the time; "
                "call start first"
            )
        return self._settings

    def _require_past(self, frames: list[Frame]) -> None:
        """Refuse frames from the future: their stamps and the camera's clock disagree."""
        ahead_s = frames[-1].timestamp_s - self.now_s()
        if ahead_s > 0:
            raise InstrumentError(
                f"camera ({self.link.camera}): stamped a frame {ahead_s:.3g} s later than its "
                "clock says; switch its synchronisation (PTP) off, or restart it"
            )

    def _nothing_came(self, wait: "_Wait", not_before_s: float) -> InstrumentError:
        camera = self.link.camera
        if wait.broken:
            return InstrumentError(
                f"camera ({camera}): {wait.broken} frames arrived incomplete since the last whole "
                f"one; {self.link.loss_remedy}"
            )
        if wait.stale:
            return InstrumentError(
                f"camera ({camera}): {wait.stale} frames arrived, but all began before "
                f"{not_before_s:.6f} s on its clock; check its clock"
            )
        trigger = self._options.trigger
        what = (
            "the camera's cable and power"
            if trigger in ("free", "software")
            else f"the trigger cable at {trigger} and the generator that drives it"
        )
        return InstrumentError(
            f"camera ({camera}): no frame within {wait.quiet_s:.3g} s; check {what}"
        )


@dataclass
class _Wait:
    """Longest wait for frames.

    A time is over when no frame lay ready after it, so that a computer that was busy with
    something else gives up nothing that has come meanwhile.

    Attributes
    ----------
    host : Clock
    quiet_s : float
        For how long no frame may come.
    late_s : float
        How long after a full count one that is missing in between may still come.
    useless_most : int
        How many stale and broken frames may come in a row.
    stale, broken : int
        How many have.
    """

    host: Clock
    quiet_s: float
    late_s: float
    useless_most: int
    stale: int = 0
    broken: int = 0

    def __post_init__(self) -> None:
        self._last_s, self._full_s = self.host.now_s(), math.inf

    def note(self, began_s: float | None, not_before_s: float, *, enough: bool) -> None:
        """Take note of what `GenicamCamera` took in, and whether that makes a full count."""
        if began_s is None:
            return
        self._last_s = self.host.now_s()
        if math.isnan(began_s):
            self.broken += 1
        elif began_s < not_before_s:
            self.stale += 1
        else:
            self.stale = self.broken = 0
            if enough:
                self._full_s = min(self._full_s, self._last_s)

    def gap_stays(self, absent_s: float) -> bool:
        """Whether a missing frame will not come any more, if none lay ready at `absent_s`."""
        return absent_s > self._full_s + self.late_s

    def over(self, absent_s: float) -> bool:
        """Whether there is no point in waiting longer, if none lay ready at `absent_s`."""
        quiet = absent_s > self._last_s + self.quiet_s
        return quiet or self.stale + self.broken > self.useless_most


def _require_bits(bits: int, pixel_format: PixelFormat, camera: str) -> None:
    held = int(pixel_format.removeprefix("Mono"))
    if bits != held and not bits < held == 16:
        raise BenchSetupError(
            f"camera ({camera}): pixels {pixel_format} hold {held} bits, but instruments.camera."
            f"bits is {bits}; make both agree"
        )


def _require_within(
    entry: CameraSensor,
    frame_rate_hz: Fraction,
    exposure_s: Fraction,
    shape: tuple[int, int],
    camera: str,
) -> None:
    """Refuse what the bench file rules out, before anything is sent."""
    if not 0 < frame_rate_hz <= entry.max_frame_rate_hz:
        raise LimitError(
            f"camera ({camera}): was asked for {float(frame_rate_hz):g} frames per second, can do "
            f"up to {float(entry.max_frame_rate_hz):g}; lower camera.frame_rate"
        )
    if not 0 < exposure_s <= 1 / frame_rate_hz:
        raise LimitError(
            f"camera ({camera}): was asked to expose {float(exposure_s):g} s, can do up to the "
            f"period of {float(1 / frame_rate_hz):g} s; shorten camera.exposure"
        )
    if not (0 < shape[0] <= entry.height and 0 < shape[1] <= entry.width):
        raise LimitError(
            f"camera ({camera}): was asked for {shape[1]} x {shape[0]} pixels, has "
            f"{entry.width} x {entry.height}; lower camera.width and camera.height"
        )
