"""Drivers of the second laboratory, as a bench file names them: ``package.module:Class``."""

from abc import ABC, abstractmethod
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.context import BenchContext
from drivers.errors import InstrumentError, LimitError
from drivers.options import Options, read_options
from drivers.roles import Frame
from protocols.bench import CameraSensor, Generator, Synthesizers
from studies.second_laboratory.laboratory import Laboratory, Settings, solved
from studies.second_laboratory.light import Geometry
from studies.second_laboratory.parameters import Disorder, draw_bench, draw_reed


class LaboratoryOptions(Options):
    """Options of the camera, which describe the whole laboratory."""

    reed_seed: int
    """Seed from which the reed is drawn."""
    bench_seed: int
    """Seed from which loudspeaker, beams and camera are drawn."""
    series: Literal["A", "B"]
    """A: ambient reed, half of the chamber filled; B: dried reed, empty chamber."""
    disorder: dict[str, float]
    """Amounts by which ranges of disorder are multiplied; see `Disorder.scaled`."""


class VirtualClock:
    """Time that passes only in waits."""

    def __init__(self) -> None:
        self._now_s, self._begun = 0.0, datetime.now(UTC)

    def begin(self, date: datetime) -> None:
        """Take another date for the moment at which the laboratory was opened."""
        self._begun = date

    def now_s(self) -> float:
        """Return the time since the laboratory was opened."""
        return self._now_s

    def date(self) -> datetime:
        """Return when the laboratory was opened, later by the time that has passed since."""
        return self._begun + timedelta(seconds=self._now_s)

    def wait(self, seconds: float) -> None:
        """Let time pass; nothing if `seconds` is not positive."""
        self._now_s += max(seconds, 0.0)


class Shared:
    """The clock and the settings that all instruments of one bench share."""

    def __init__(self, context: BenchContext) -> None:
        description = context.description
        self.clock = VirtualClock()
        context.clock = self.clock
        centre_hz = description.instruments.synthesizers.centre_hz
        self.settings = Settings(centre_hz, centre_hz)


class SecondSynthesizers:
    """Two synthesizer channels that play any multiple of their step."""

    echoes_registers = False
    identity = "second laboratory, synthesizers"

    def __init__(self, entry: Synthesizers, context: BenchContext) -> None:
        self._entry, self._settings = entry, context.share(Shared).settings

    @property
    def step_hz(self) -> Fraction:
        """Spacing of the frequencies that both channels can play."""
        return self._entry.step_hz

    def set_pair(self, aom1_hz: Fraction, aom2_hz: Fraction) -> None:
        """Change both channels at once."""
        step, centre = self._entry.step_hz, self._entry.centre_hz
        pair = round(aom1_hz / step) * step, round(aom2_hz / step) * step
        for hz in pair:
            if abs(hz - centre) > self._entry.window_hz:
                raise LimitError(f"{float(hz)} Hz lies outside the window of the modulators")
        self._settings.aom1_hz, self._settings.aom2_hz = pair

    def read_pair(self) -> tuple[Fraction, Fraction]:
        """Return what both channels play."""
        return self._settings.aom1_hz, self._settings.aom2_hz

    def rf_on(self) -> None:
        """Let both modulators diffract."""
        self._settings.rf = True

    def rf_off(self) -> None:
        """Let no light through the modulators."""
        self._settings.rf = False

    def close(self) -> None:
        """Switch off."""
        self._settings.rf = False


class SecondGenerator:
    """A sine generator that plays any multiple of its step."""

    identity = "second laboratory, generator"

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        shared = context.share(Shared)
        self._entry, self._settings, self._clock = entry, shared.settings, shared.clock
        self._limits = context.description.limits

    def _require_volts(self, volts: float) -> None:
        limits = self._limits
        if not (volts == 0 or limits.volts_min_v <= volts <= limits.volts_max_v):
            raise LimitError(f"{volts} V lies outside the limits of the bench")

    def set_sine(self, frequency_hz: Fraction, volts: float) -> None:
        """Play a sine."""
        self._require_volts(volts)
        if not self._limits.drive_min_hz <= frequency_hz <= self._limits.drive_max_hz:
            raise LimitError(f"{float(frequency_hz)} Hz lies outside the limits of the bench")
        step = self._entry.step_hz
        self._settings.drive_hz = round(frequency_hz / step) * step
        self._settings.volts, self._settings.sounding = volts, True

    def ramp_to(self, volts: float, duration_s: float) -> None:
        """Change the volts; returns when they are reached."""
        self._require_volts(volts)
        if not self._settings.sounding:
            if volts:
                raise InstrumentError("the output is off; set a sine first")
            return
        self._clock.wait(duration_s)
        self._settings.volts = volts

    def output_off(self) -> None:
        """Disconnect the output."""
        self._settings.sounding = False

    def read(self) -> tuple[Fraction, float, bool]:
        """Return frequency, volts and whether the output is on."""
        now = self._settings
        return now.drive_hz, now.volts, now.sounding

    def close(self) -> None:
        """Switch off."""
        self._settings.sounding = False


class FreeRunningCamera(ABC):
    """A camera that runs freely on the laboratory's clock, whatever it sees.

    Parameters
    ----------
    entry : CameraSensor
    clock : VirtualClock
        Shared with the other instruments.
    """

    identity = "second laboratory, camera of 12 bits"

    def __init__(self, entry: CameraSensor, clock: VirtualClock) -> None:
        self._entry, self._clock = entry, clock
        self._period_s, self._exposure_s = Fraction(1), Fraction(1)
        self._configured = False
        self._started_s: float | None = None
        self._next = 0

    @abstractmethod
    def _prepare(self, shape: tuple[int, int]) -> None:
        """Make ready to expose this part of the sensor."""

    @abstractmethod
    def _expose(self, starts_s: list[float], exposure_s: float) -> list[NDArray[np.uint16]]:
        """Return the frames of consecutive exposures."""

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Set up the camera."""
        if self._started_s is not None:
            raise InstrumentError("the camera is running; stop it first")
        large = shape[0] > self._entry.height or shape[1] > self._entry.width
        if exposure_s * frame_rate_hz > 1 or large:
            raise LimitError("the camera has no such exposure or sensor")
        self._period_s, self._exposure_s = 1 / frame_rate_hz, exposure_s
        self._prepare(shape)
        self._configured = True

    def start(self) -> None:
        """Begin to take frames."""
        if not self._configured:
            raise InstrumentError("the camera is not configured; configure it first")
        self._started_s, self._next = self._clock.now_s(), 0

    def stop(self) -> None:
        """Take no more frames."""
        self._started_s = None

    def grab(self, count: int, not_before_s: float) -> list[Frame]:
        """Return the next frames whose exposures begin at a time or later."""
        if self._started_s is None:
            raise InstrumentError("the camera is stopped; start it first")
        period_s, exposure_s = float(self._period_s), float(self._exposure_s)
        # Rounding of times does not cost a frame.
        earliest = int(np.ceil((not_before_s - self._started_s) / period_s - 1e-9))
        first = max(self._next, earliest)
        starts = [self._started_s + k * period_s for k in range(first, first + count)]
        images = self._expose(starts, exposure_s)
        self._next = first + count
        self._clock.wait(starts[-1] + exposure_s - self._clock.now_s())
        return [Frame(first + k, starts[k], image) for k, image in enumerate(images)]

    def now_s(self) -> float:
        """Return the time of the laboratory."""
        return self._clock.now_s()

    def close(self) -> None:
        """Stop."""
        self._started_s = None


class SecondCamera(FreeRunningCamera):
    """The camera of sweeps, which builds the laboratory that it sees."""

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        shared = context.share(Shared)
        super().__init__(entry, shared.clock)
        self._context, self._settings = context, shared.settings
        self._options = read_options(
            LaboratoryOptions, entry.options, context.description.name, "instruments.camera.options"
        )
        disorder = Disorder().scaled(self._options.disorder)
        self._reed = draw_reed(disorder, self._options.series, self._options.reed_seed)
        self._bench = draw_bench(disorder, self._options.bench_seed)

    @property
    def saturation_dn(self) -> int:
        """Number at which a pixel stops growing with light."""
        p = self._bench.camera
        return min(4095, round(p.offset_dn + p.full_well_e / p.electrons_per_dn))

    def _prepare(self, shape: tuple[int, int]) -> None:
        optics = self._context.description.optics
        geometry = Geometry(
            shape,
            float(self._entry.pixel_m),
            float(optics.wavelength_m),
            float(optics.distance_m),
        )
        self._context.announce("solving the reed of the second laboratory")
        self._laboratory = Laboratory(
            solved(self._reed),
            self._bench,
            self._options.series == "A",
            geometry,
            (float(optics.reed_centre.y_m), float(optics.reed_centre.x_m)),
            self._settings,
            self._context.rng,
        )

    def _expose(self, starts_s: list[float], exposure_s: float) -> list[NDArray[np.uint16]]:
        return self._laboratory.expose(starts_s, exposure_s)
