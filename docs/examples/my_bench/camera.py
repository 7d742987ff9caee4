"""Template of a driver for the camera."""

from fractions import Fraction
from typing import Literal

from drivers.context import BenchContext
from drivers.errors import BenchSetupError, InstrumentError, LimitError
from drivers.roles import Frame
from my_bench.pretended import PretendedLaboratory
from protocols.bench import CameraSensor

# Frames stay in the camera for this time, in s. The program requires at least 1 s.
_BUFFER_S = 1.0


class MyCamera:
    """A camera that takes frames all the time between `start` and `stop`."""

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        if entry.data_sheet is None:
            raise BenchSetupError("instruments.camera.data_sheet: is missing; write it")
        self._entry, self._sheet = entry, entry.data_sheet
        self._laboratory = context.share(PretendedLaboratory)
        self._period_s: float | None = None
        self._exposure_s = 0.0
        self._started_s: float | None = None
        self._next_id = 0

    @property
    def identity(self) -> str:
        """Maker, model, serial number and firmware; the same text for as long as it is open."""
        return f"pretended camera, {self._entry.width} x {self._entry.height} pixels"

    @property
    def saturation_dn(self) -> int:
        """Value that a full pixel really shows. Known from opening on, before `configure`."""
        full_well_dn = self._sheet.offset_dn + self._sheet.full_well_e / self._sheet.gain_e_dn
        return int(min(full_well_dn, 2**self._entry.bits - 1))

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Check everything first, then change it; `shape` is (rows, columns) of the middle."""
        if self._started_s is not None:
            raise InstrumentError("camera: is running; stop it before you configure it")
        fits = shape[0] <= self._entry.height and shape[1] <= self._entry.width
        if not (fits and 0 < frame_rate_hz <= self._entry.max_frame_rate_hz):
            raise LimitError("camera: has no such size or frame rate; change the protocol")
        if not 0 < exposure_s <= 1 / frame_rate_hz:
            raise LimitError("camera: the exposure is longer than a frame; change the protocol")
        self._period_s, self._exposure_s = float(1 / frame_rate_hz), float(exposure_s)
        self._laboratory.prepare(shape)

    def start(self) -> None:
        """Begin with frame 0."""
        if self._period_s is None:
            raise InstrumentError("camera: is not configured; call configure before start")
        self._started_s, self._next_id = self.now_s(), 0

    def stop(self) -> None:
        """Take no more frames. Called from any thread, and also if it is stopped."""
        self._started_s = None

    def grab(self, count: int, not_before_s: float) -> list[Frame]:
        """Return the next frames whose exposures began at `not_before_s` or later."""
        started_s, period_s = self._started_s, self._period_s
        if started_s is None or period_s is None:
            raise InstrumentError("camera: is stopped; start it before you ask for frames")
        first, oldest_s = self._next_id, max(not_before_s, self.now_s() - _BUFFER_S)
        while started_s + first * period_s < oldest_s:
            first += 1
        frames = []
        for number in range(first, first + count):
            start_s = started_s + number * period_s
            self._laboratory.clock.wait(start_s + self._exposure_s - self.now_s())
            image = self._laboratory.expose(start_s, self._exposure_s, self._sheet, self._entry)
            frames.append(Frame(number, start_s, image))
        self._next_id = first + count
        return frames

    def now_s(self) -> float:
        """Return the time of the clock that stamps frames. It never restarts."""
        return self._laboratory.clock.now_s()

    def reference_clock(self) -> Literal["external", "own", "unknown"]:
        """Say which clock it uses (optional), for `acquire bench check`."""
        return "external"

    def close(self) -> None:
        """Release the connection. A real driver also stops the camera."""
        self.stop()
