"""Simulated instruments with the manners of real ones.

They round to their grids, refuse what is out of limits before anything changes, take time to
answer, and the camera runs freely whether or not its frames are read.
"""

import math
from dataclasses import replace
from fractions import Fraction
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.context import BenchContext
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.roles import Frame
from drivers.simulated.lab import SimulatedLab
from physics.sensor import saturation_dn
from protocols.bench import (
    CameraSensor,
    Generator,
    InstrumentEntry,
    Synthesizers,
)

# A frequency and an update with their answers, 28 characters at 19 200 baud; a few milliseconds of
# USB; an output relay.
_SERIAL_S: Final = 0.015
_USB_S: Final = 0.005
_RELAY_S: Final = 0.1
_RAMP_STEPS: Final = 20
_BUFFER_S: Final = 1.0
# Light of a frame that blinks; see `drivers.simulated.settings.Faults`.
_BLINK: Final = 0.9


class SimulatedSynthesizers:
    """A two-channel synthesizer whose update changes both channels at the same moment.

    Attributes
    ----------
    lab : SimulatedLab
        Laboratory that it belongs to.
    echoes_registers : bool
        False: what it says is what the laboratory's modulators get.
    """

    echoes_registers = False

    def __init__(self, entry: Synthesizers, context: BenchContext) -> None:
        _require_no_options("synthesizers", entry)
        self._entry = entry
        self.lab = context.share(SimulatedLab)
        self._pair_hz = (self._on_grid(entry.centre_hz),) * 2

    @property
    def identity(self) -> str:
        """Name of the simulation."""
        return f"simulated synthesizer pair, {float(self.step_hz):g} Hz steps"

    @property
    def step_hz(self) -> Fraction:
        """Spacing of the frequencies."""
        return self._entry.step_hz

    def set_pair(self, aom1_hz: Fraction, aom2_hz: Fraction) -> None:
        """Change both channels; see `SynthesizerPair.set_pair`."""
        centre_hz, window_hz = self._entry.centre_hz, self._entry.window_hz
        for name, hz in (("AOM1", aom1_hz), ("AOM2", aom2_hz)):
            if abs(hz - centre_hz) > window_hz:
                raise LimitError(
                    f"synthesizers (simulated): {name} was asked for {float(hz):.10g} Hz, more "
                    f"than {float(window_hz):.10g} Hz from {float(centre_hz):.10g} Hz; keep it "
                    "inside the window"
                )
        self.lab.clock.wait(_SERIAL_S)
        self._pair_hz = (self._on_grid(aom1_hz), self._on_grid(aom2_hz))
        self.lab.change(difference_hz=self._pair_hz[0] - self._pair_hz[1])

    def read_pair(self) -> tuple[Fraction, Fraction]:
        """Return what both channels play."""
        self.lab.clock.wait(_SERIAL_S)
        return self._pair_hz

    def rf_on(self) -> None:
        """Let light through."""
        self.lab.clock.wait(_SERIAL_S)
        self.lab.change(rf_on=True)

    def rf_off(self) -> None:
        """Let no light through."""
        self.lab.clock.wait(_SERIAL_S)
        self.lab.change(rf_on=False)

    def close(self) -> None:
        """Nothing to release."""

    def _on_grid(self, hz: Fraction) -> Fraction:
        return round(hz / self.step_hz) * self.step_hz


class SimulatedGenerator:
    """A generator with an output relay, and limits at the load.

    Attributes
    ----------
    lab : SimulatedLab
        Laboratory that it belongs to.
    """

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        _require_no_options("generator", entry)
        self._step_hz = entry.step_hz
        self._limits = context.description.limits
        self.lab = context.share(SimulatedLab)
        self._frequency_hz, self._volts, self._on = Fraction(1000), 0.0, False

    @property
    def identity(self) -> str:
        """Name of the simulation."""
        return f"simulated signal generator, {float(self._step_hz):g} Hz steps"

    def set_sine(self, frequency_hz: Fraction, volts: float) -> None:
        """Play a sine; see `SignalGenerator.set_sine`."""
        low_hz, high_hz = self._limits.drive_min_hz, self._limits.drive_max_hz
        if not low_hz <= frequency_hz <= high_hz:
            raise LimitError(
                f"generator (simulated): was asked for {float(frequency_hz):.10g} Hz, outside "
                f"{float(low_hz):.10g} to {float(high_hz):.10g} Hz; change the sweep or the limits"
            )
        self._require_volts(volts)
        self.lab.clock.wait(_USB_S if self._on else _USB_S + _RELAY_S)
        self._frequency_hz = round(frequency_hz / self._step_hz) * self._step_hz
        self._volts, self._on = float(volts), True
        self.lab.change(drive_hz=self._frequency_hz, drive_v=self._volts)

    def ramp_to(self, volts: float, duration_s: float) -> None:
        """Change the volts in small steps; see `SignalGenerator.ramp_to`."""
        self._require_volts(volts)
        if not 0 <= duration_s < math.inf:
            raise LimitError(
                f"generator (simulated): was asked to ramp over {duration_s} s; give a time"
            )
        if not self._on:
            if volts == 0:
                return
            raise InstrumentError(
                f"generator (simulated): its output is off, but was asked to ramp to {volts:g} V; "
                "call set_sine first"
            )
        start_v = self._volts
        for part in range(1, _RAMP_STEPS + 1):
            self.lab.clock.wait(max(duration_s / _RAMP_STEPS, _USB_S / _RAMP_STEPS))
            self._volts = start_v + (float(volts) - start_v) * part / _RAMP_STEPS
            self.lab.change(drive_v=self._volts)

    def output_off(self) -> None:
        """Open the relay."""
        self.lab.clock.wait(_USB_S)
        self._on = False
        self.lab.change(drive_v=0.0)
        self.lab.clock.wait(_RELAY_S)

    def read(self) -> tuple[Fraction, float, bool]:
        """Return what is played; see `SignalGenerator.read`."""
        self.lab.clock.wait(_USB_S)
        return self._frequency_hz, self._volts, self._on

    def close(self) -> None:
        """Nothing to release."""

    def _require_volts(self, volts: float) -> None:
        least, most = float(self._limits.volts_min_v), float(self._limits.volts_max_v)
        if not (volts == 0 or least <= volts <= most):
            raise LimitError(
                f"generator (simulated): was asked for {volts} V, outside {least:g} to {most:g} V; "
                "change the protocol's drive or the limits of the bench file"
            )


class SimulatedCamera:
    """A camera that runs freely: frame k begins k frame periods after `start`.

    Attributes
    ----------
    lab : SimulatedLab
        Laboratory that it belongs to.
    """

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        _require_no_options("camera", entry)
        self._entry = entry
        self.lab = context.share(SimulatedLab)
        # Whoever simulates the light that falls on the camera has its shutters and lamp.
        context.surroundings = self.lab
        self._rate_hz: Fraction | None = None
        self._exposure_s = Fraction(0)
        self._started_s: float | None = None
        self._next_id = 0
        self._acquisitions = 0
        self._clock_offset_s = 0.0

    @property
    def identity(self) -> str:
        """Name of the simulation."""
        entry = self._entry
        return f"simulated camera, {entry.width} x {entry.height} pixels, {entry.bits} bit"

    @property
    def saturation_dn(self) -> int:
        """Number at which a pixel is saturated."""
        return saturation_dn(self.lab.sensor)

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Set the camera up; see `Camera.configure`."""
        if self._started_s is not None:
            raise InstrumentError(
                "camera (simulated): is running, but was asked for other settings; stop it first"
            )
        self._require_possible(frame_rate_hz, exposure_s, shape)
        error = Fraction(self.lab.faults.frame_rate_error_ppm) / 1_000_000
        self._rate_hz = frame_rate_hz * (1 + error)
        self._exposure_s = min(exposure_s, 1 / self._rate_hz)
        self.lab.prepare_sensor(shape)

    def start(self) -> None:
        """Begin with frame 0 now."""
        if self._rate_hz is None:
            raise InstrumentError(
                "camera (simulated): was asked to start without settings; call configure first"
            )
        self._started_s, self._next_id = self.lab.clock.now_s(), 0

    def stop(self) -> None:
        """Take no more frames."""
        self._started_s = None

    def grab(self, count: int, not_before_s: float) -> list[Frame]:
        """Return the next frames; see `Camera.grab`."""
        self._acquisitions += 1
        faults = self.lab.faults
        if faults.no_frame_from is not None and self._acquisitions >= faults.no_frame_from:
            raise InstrumentError(
                "camera (simulated): no frame within 2 s of being asked; check the trigger's cable"
            )
        # Here times are the laboratory's; outside they are the camera's.
        not_before_s -= self._clock_offset_s
        # Frames of the last second are still in the camera's buffer.
        earliest_s = max(not_before_s, self.lab.clock.now_s() - _BUFFER_S)
        if self._acquisitions in faults.stale_frame_at and self._rate_hz is not None:
            earliest_s = not_before_s - 2 / float(self._rate_hz)
        first = self._first_id_from(earliest_s)
        ids = list(range(first, first + count))
        if self._acquisitions in faults.drop_frame_at or self.lab.loses_frame():
            ids = [id if id < first + 2 else id + 1 for id in ids]
        starts_s = [self._start_of(id) for id in ids]
        exposure_s = float(self._exposure_s)
        exposures = [(start_s, start_s + exposure_s) for start_s in starts_s]
        # Rendered while they are exposed, so that at a real pace they come when they are over.
        settings, images = self.lab.state, self._exposed(exposures)
        self.lab.clock.wait(exposures[-1][1] - self.lab.clock.now_s())
        if self.lab.state is not settings:
            images = self._exposed(exposures)
        self._next_id = ids[-1] + 1
        if self._acquisitions == faults.clock_jump_at:
            self._clock_offset_s += faults.clock_jump_s
        stamps_s = [start_s + self._clock_offset_s for start_s in starts_s]
        self.lab.exposed_s |= dict(zip(zip(ids, stamps_s, strict=True), starts_s, strict=True))
        return self._spoilt([Frame(*parts) for parts in zip(ids, stamps_s, images, strict=True)])

    def now_s(self) -> float:
        """Return the laboratory's time, but for what the camera's clock is off."""
        return self.lab.clock.now_s() + self._clock_offset_s

    def close(self) -> None:
        """Stop."""
        self.stop()

    def _exposed(self, exposures_s: list[tuple[float, float]]) -> list[NDArray[np.uint16]]:
        """Images of an acquisition, if something is to go wrong with its light."""
        faults, now = self.lab.faults, self._acquisitions
        if now in faults.advance_frames_at and self._rate_hz is not None:
            period_s = float(1 / self._rate_hz)
            late_s = [(start_s + period_s, end_s + period_s) for start_s, end_s in exposures_s[2:]]
            exposures_s = [*exposures_s[:2], *late_s]
        images = self.lab.expose(
            exposures_s,
            dark=2 if now in faults.dark_frame_at else None,
            sagging_from=2 if now in faults.sag_at else None,
        )
        if now in faults.blink_at:
            offset_dn = self.lab.sensor.offset_dn
            dimmed = offset_dn + _BLINK * (images[2] - offset_dn)
            images[2] = np.clip(np.rint(dimmed), 0, None).astype(np.uint16)
        return images

    def _spoilt(self, frames: list[Frame]) -> list[Frame]:
        """Frames as they come, if something is to go wrong with the third one."""
        faults, now = self.lab.faults, self._acquisitions
        if now in faults.duplicate_frame_at:
            frames[2] = frames[1]
        if now in faults.reorder_frames_at:
            frames[1:3] = frames[2], frames[1]
        if now in faults.partial_frame_at:
            rows = len(frames[2].image) // 2
            image = np.vstack([frames[2].image[:rows], frames[1].image[rows:]])
            frames[2] = replace(frames[2], image=image)
        if now in faults.late_frame_at and self._rate_hz is not None:
            late_s = frames[2].timestamp_s + 0.7 / float(self._rate_hz)
            frames[2] = replace(frames[2], timestamp_s=late_s)
        return frames

    def _start_of(self, id: int) -> float:
        """Time at which the exposure of a frame begins."""
        if self._rate_hz is None or self._started_s is None:
            raise InstrumentError(
                "camera (simulated): is stopped, but was asked for frames; call start first"
            )
        return self._started_s + float(id / self._rate_hz)

    def _first_id_from(self, time_s: float) -> int:
        elapsed_s = Fraction(max(time_s - self._start_of(0), 0.0))
        id = max(self._next_id, math.ceil(elapsed_s * (self._rate_hz or 0)))
        # The last bit of a start time may be rounded down.
        return id if self._start_of(id) >= time_s else id + 1

    def _require_possible(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        entry = self._entry
        if not 0 < frame_rate_hz <= entry.max_frame_rate_hz:
            raise LimitError(
                f"camera (simulated): was asked for {float(frame_rate_hz):g} frames per second, "
                f"can do up to {float(entry.max_frame_rate_hz):g}; lower camera.frame_rate"
            )
        if not 0 < exposure_s <= 1 / frame_rate_hz:
            raise LimitError(
                f"camera (simulated): was asked to expose {float(exposure_s):g} s, can do up to "
                f"the period of {float(1 / frame_rate_hz):g} s; shorten camera.exposure"
            )
        if not (0 < shape[0] <= entry.height and 0 < shape[1] <= entry.width):
            raise LimitError(
                f"camera (simulated): was asked for {shape[1]} x {shape[0]} pixels, has "
                f"{entry.width} x {entry.height}; lower camera.width and camera.height"
            )


def _require_no_options(role: str, entry: InstrumentEntry) -> None:
    if entry.options:
        raise BenchSetupError(
            f"instruments.{role}.options: the simulated driver knows no option "
            f"{', '.join(sorted(entry.options))}; write settings of the simulated bench under "
            "twin:"
        )
