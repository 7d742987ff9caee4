"""The plan: a protocol on a bench, worked out exactly before any instrument is touched."""

import decimal
import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise
from typing import Any, Final

from holography.demodulation import carrier_leak
from holography.fresnel import FresnelTransform
from holography.region import Region
from physics.optics import (
    Layout,
    reed_region,
    visible_size_m,
)
from protocols.bench import BenchFile
from protocols.frequency_lock import (
    difference_hz,
    lock_residual_hz,
    nearest_multiple,
    phase_error_rad,
    snap_drive,
)
from protocols.preparation import Preparation
from protocols.protocol import (
    Calibration,
    Protocol,
    Ramp,
    Sweep,
)
from protocols.reed import ReedFile
from protocols.units import exact_decimal

_BYTES_PER_HOLOGRAM_PIXEL: Final = 8  # complex64
_BYTES_PER_FRAME_PIXEL: Final = 2  # uint16
# Of frames of 12 bits, see `Plan.packed_size_bytes`.
_PACKED_SHARE: Final = 0.61

# Part of the view, to either side of the axis, in which a reed's image may lie.
_VIEW_SHARE: Final = 0.45

# A shuffled sweep has the same order everywhere and always.
_SHUFFLE: Final = 20_080_403

_MICRO: Final = Decimal("1e-6")
# Decimal powers are correctly rounded, so a plan is the same on every machine; those of floats
# are not. 40 digits leave a µHz exact at any frequency that a protocol can express.
_EXACT: Final = decimal.Context(prec=40)


@dataclass(frozen=True, slots=True)
class Step:
    """One line of the plan.

    Attributes
    ----------
    index : int
        k of the protocol's sweep.
    order : int
        Sideband that the synthesizers select.
    asked_hz : Fraction
        What the protocol asks for, to 1 µHz.
    drive_hz : Fraction
        What the tweeter gets: the nearest frequency that can be locked to.
    aom1_hz, aom2_hz, difference_hz : Fraction
        Both synthesizers, and AOM1 − AOM2.
    lock_residual_hz : Fraction
        By how much `difference_hz` misses the lock; 0 is a perfect lock.
    volts : float
        Peak volts at the load, to 1 µV.
    frames : int
        Frames of the acquisition.
    settle_s, exposure_s : Fraction
        Wait after setting, and exposure of one frame.
    carrier_leak : float
        Amplitude of the carrier in the hologram, relative to what the sideband gives per unit
        amplitude, see `holography.demodulation.carrier_leak`.
    """

    index: int
    order: int
    asked_hz: Fraction
    drive_hz: Fraction
    aom1_hz: Fraction
    aom2_hz: Fraction
    difference_hz: Fraction
    lock_residual_hz: Fraction
    volts: float
    frames: int
    settle_s: Fraction
    exposure_s: Fraction
    carrier_leak: float

    def to_json(self) -> dict[str, Any]:
        """Return the step with stable keys, frequencies as exact decimal strings."""
        return {
            "index": self.index,
            "order": self.order,
            "asked_hz": exact_decimal(self.asked_hz),
            "drive_hz": exact_decimal(self.drive_hz),
            "aom1_hz": exact_decimal(self.aom1_hz),
            "aom2_hz": exact_decimal(self.aom2_hz),
            "difference_hz": exact_decimal(self.difference_hz),
            "lock_residual_hz": exact_decimal(self.lock_residual_hz),
            "volts": self.volts,
            "frames": self.frames,
            "carrier_leak": self.carrier_leak,
        }


@dataclass(frozen=True, slots=True)
class Violation:
    """One reason why a plan cannot run.

    Attributes
    ----------
    key : str
        Key path in the protocol that would mend it, such as ``drive.ramp.to``.
    message : str
        What is wrong and what to write.
    """

    key: str
    message: str


@dataclass(frozen=True)
class Plan:
    """A protocol on a bench: every setting of every step, and whether the bench can do it.

    Attributes
    ----------
    protocol : Protocol
    reed : ReedFile
        Kind of reed that the protocol is for.
    bench : BenchFile
    steps : tuple of Step
        In the order of the sweep.
    violations : tuple of Violation
        Empty if the plan can run.
    """

    protocol: Protocol
    reed: ReedFile
    bench: BenchFile
    steps: tuple[Step, ...]
    violations: tuple[Violation, ...]

    @property
    def sequence(self) -> tuple[int, ...]:
        """Places of the steps in the order in which they are taken."""
        places = list(range(len(self.steps)))
        if self.protocol.sweep.direction == "down":
            places.reverse()
        elif self.protocol.sweep.direction == "shuffled":
            random.Random(_SHUFFLE).shuffle(places)
        return tuple(places)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns ``(ny, nx)`` of one frame."""
        return frame_shape(self.protocol, self.bench)

    @property
    def region(self) -> Region:
        """Part of the reconstructed image that holds the reed."""
        return reed_region(self.layout, object_transform(self.protocol, self.bench))

    @property
    def layout(self) -> Layout:
        """Where the reed stands before the sensor."""
        return layout_of(self.bench, self.reed)

    def preparation(self, reed: str) -> Preparation:
        """What stands on the bench when this plan is run on the reed of a name."""
        protocol = self.protocol
        return Preparation(
            reed, protocol.series, protocol.chamber, self.reed.geometry(), self.reed.constants()
        )

    @property
    def most_retakes(self) -> int:
        """How many bad steps are taken again after the last one.

        A tenth of the sweep, and a few: if more steps are bad, the trouble is not theirs.
        """
        retries = len(self.steps) * self.protocol.policy.bad_pictures.retry
        return min(retries, len(self.steps) // 10 + 4)

    @property
    def spare_takes(self) -> int:
        """How many takes a run file has room for besides one of each step.

        Those that are taken again after the last step, and those after which a run gives up: they
        are taken again once the trouble is mended.
        """
        if not self.most_retakes:
            return 0
        return self.most_retakes + min(self.protocol.policy.give_up_after, len(self.steps))

    @property
    def duration_s(self) -> float:
        """Time that a real camera takes: settling, waiting for its next frame, and the frames."""
        period_s = self.protocol.camera.period_s
        periods = sum(math.ceil(step.settle_s / period_s) + step.frames for step in self.steps)
        return float(periods * period_s)

    @property
    def file_size_bytes(self) -> int:
        """Size of what the run file keeps of all steps, before frames are packed."""
        return len(self.steps) * self._step_size_bytes

    @property
    def largest_size_bytes(self) -> int:
        """Size if the run needs every place that it has for steps taken again."""
        return (len(self.steps) + self.spare_takes) * self._step_size_bytes

    @property
    def packed_size_bytes(self) -> int | None:
        """About the size once frames are packed, which a complete run's are; None without frames.

        One byte of each pixel is noise, which nothing shrinks; of the other, which has the bits
        above 8, little is left.
        """
        return (
            None
            if self.protocol.keep == "holograms"
            else round(_PACKED_SHARE * self.file_size_bytes)
        )

    @property
    def _step_size_bytes(self) -> int:
        if self.protocol.keep == "holograms":
            try:
                region = self.region
            except ValueError:
                # There is none: the reed lies outside the view, which is a violation.
                return 0
            return region.height * region.width * _BYTES_PER_HOLOGRAM_PIXEL
        rows, columns = self.frame_shape
        frames = max(step.frames for step in self.steps)
        return frames * rows * columns * _BYTES_PER_FRAME_PIXEL

    def require_possible(self) -> None:
        """Refuse a plan that the bench cannot carry out.

        Raises
        ------
        ProtocolError
            One line: the first violation with file and key path, and how many more there are.
        """
        if not self.violations:
            return
        first, others = self.violations[0], len(self.violations) - 1
        more = f" (and {others} more)" if others else ""
        raise self.protocol.error(first.key, first.message + more)

    def to_json(self) -> dict[str, Any]:
        """Return the plan as plain values with stable keys; exact frequencies are strings."""
        return {
            "protocol": self.protocol.name,
            "reed": self.reed.name,
            "bench": self.bench.name,
            "steps": [step.to_json() for step in self.steps],
            "duration_s": self.duration_s,
            "file_size_bytes": self.file_size_bytes,
            "largest_size_bytes": self.largest_size_bytes,
            "packed_size_bytes": self.packed_size_bytes,
            "violations": [{"key": v.key, "message": v.message} for v in self.violations],
        }


def make_plan(protocol: Protocol, bench: BenchFile) -> Plan:
    """Work out a sweep without touching an instrument.

    Parameters
    ----------
    protocol : Protocol
        What is asked for.
    bench : BenchFile
        What there is.

    Returns
    -------
    Plan
        Complete even if the bench cannot do it: then `Plan.violations` holds every reason, and
        `Plan.require_possible` raises.

    Raises
    ------
    ProtocolError
        If the file of the protocol's reed is wrong.
    """
    reed = protocol.reed_file()
    if protocol.calibration is not None:
        still = tuple(_still_steps(protocol, protocol.calibration, bench))
        found = *_camera_violations(protocol, bench, still), *_view_violations(bench, reed)
        return Plan(protocol, reed, bench, still, found)
    steps = tuple(
        _step(protocol, bench, index, order)
        for index in protocol.sweep.indices
        for order in protocol.sideband.selected
    )
    violations = *_violations(protocol, bench, steps), *_view_violations(bench, reed)
    return Plan(protocol, reed, bench, steps, violations)


def sweep_frequency_hz(sweep: Sweep, index: int) -> Fraction:
    """Return f_k = reference · 2^(interval·k / 1200 cents), to 1 µHz.

    Parameters
    ----------
    sweep : Sweep
    index : int
        k.

    Returns
    -------
    Fraction
    """
    octaves = _decimal(sweep.interval_cents * index / 1200)
    ratio = _EXACT.power(Decimal(2), octaves)
    asked_hz = _EXACT.multiply(_decimal(sweep.reference_hz), ratio)
    return Fraction(_EXACT.quantize(asked_hz, _MICRO))


def ramp_volts(ramp: Ramp, index: int) -> float:
    """Return the peak volts of step `index`, to 1 µV.

    Parameters
    ----------
    ramp : Ramp
    index : int
        k.

    Returns
    -------
    float
        Growing by ``(to/from)^(1/(last − first))`` per index inside the ramp, constant outside.
    """
    inside = min(max(index, ramp.first), ramp.last)
    share = _decimal(Fraction(inside - ramp.first, ramp.last - ramp.first))
    ratio = _EXACT.power(_decimal(ramp.to_v / ramp.from_v), share)
    volts = _EXACT.multiply(_decimal(ramp.from_v), ratio)
    return float(_EXACT.quantize(volts, _MICRO))


def frame_shape(protocol: Protocol, bench: BenchFile) -> tuple[int, int]:
    """Rows and columns ``(ny, nx)`` of one frame: the sensor, or its middle part."""
    sensor, asked = bench.instruments.camera, protocol.camera
    return (asked.height or sensor.height, asked.width or sensor.width)


def object_transform(protocol: Protocol, bench: BenchFile) -> FresnelTransform:
    """Transform between the part of the sensor that a protocol uses and the object plane."""
    return FresnelTransform(
        shape=frame_shape(protocol, bench),
        pixel_m=float(bench.instruments.camera.pixel_m),
        wavelength_m=float(bench.optics.wavelength_m),
        distance_m=float(bench.optics.distance_m),
    )


def layout_of(bench: BenchFile, reed: ReedFile) -> Layout:
    """Return where the reed stands before the sensor, and how much of its image is kept."""
    optics, size = bench.optics, bench.optics.reed_size
    return Layout(
        wavelength_m=float(optics.wavelength_m),
        distance_m=float(optics.distance_m),
        reed_centre_m=(float(optics.reed_centre.y_m), float(optics.reed_centre.x_m)),
        reed_size_m=(
            (float(size.y_m), float(size.x_m)) if size else visible_size_m(reed.geometry())
        ),
    )


def _decimal(value: Fraction) -> Decimal:
    return _EXACT.divide(Decimal(value.numerator), Decimal(value.denominator))


def _step(protocol: Protocol, bench: BenchFile, index: int, order: int) -> Step:
    synthesizers, generator = bench.instruments.synthesizers, bench.instruments.generator
    frame_rate_hz = protocol.camera.frame_rate_hz
    asked_hz = sweep_frequency_hz(protocol.sweep, index)
    # The drive is the same for all orders: only then do they show the same vibration.
    drive_hz = snap_drive(
        asked_hz, protocol.sideband.order, frame_rate_hz, synthesizers.step_hz, generator.step_hz
    )
    realised_hz = difference_hz(drive_hz, order, frame_rate_hz, synthesizers.step_hz)
    # On one clock only the difference of the tuning words counts, so AOM2 may be rounded.
    aom2_hz = nearest_multiple(synthesizers.centre_hz, synthesizers.step_hz)
    return Step(
        index=index,
        order=order,
        asked_hz=asked_hz,
        drive_hz=drive_hz,
        aom1_hz=aom2_hz + realised_hz,
        aom2_hz=aom2_hz,
        difference_hz=realised_hz,
        lock_residual_hz=lock_residual_hz(drive_hz, order, frame_rate_hz, realised_hz),
        volts=ramp_volts(protocol.drive.ramp, index),
        frames=protocol.camera.frames,
        settle_s=protocol.settle_s,
        exposure_s=protocol.exposure_s,
        carrier_leak=_leak(protocol, drive_hz, order),
    )


def _still_steps(protocol: Protocol, calibration: Calibration, bench: BenchFile) -> Iterator[Step]:
    """Acquisitions of a reed that is not driven, at one exposure after the other."""
    synthesizers = bench.instruments.synthesizers
    aom2_hz = nearest_multiple(synthesizers.centre_hz, synthesizers.step_hz)
    frame_rate_hz = protocol.camera.frame_rate_hz
    realised_hz = difference_hz(Fraction(0), 0, frame_rate_hz, synthesizers.step_hz)
    exposures_s = calibration.exposures_s or (protocol.exposure_s,)
    for number in range(calibration.count * len(exposures_s)):
        yield Step(
            index=number + 1,
            order=0,
            asked_hz=Fraction(0),
            drive_hz=Fraction(0),
            aom1_hz=aom2_hz + realised_hz,
            aom2_hz=aom2_hz,
            difference_hz=realised_hz,
            lock_residual_hz=lock_residual_hz(Fraction(0), 0, frame_rate_hz, realised_hz),
            volts=0.0,
            frames=protocol.camera.frames,
            settle_s=protocol.settle_s,
            exposure_s=exposures_s[number // calibration.count],
            carrier_leak=0.0,
        )


def _leak(protocol: Protocol, drive_hz: Fraction, order: int) -> float:
    # Frames cannot overlap: an exposure beyond the period is a violation, and counts as a period.
    exposure_s = min(protocol.exposure_s, protocol.camera.period_s)
    frame_rate_hz = protocol.camera.frame_rate_hz
    # The reed stands off the axis: the carrier's twin falls beside what is kept of the image.
    leak = carrier_leak(
        float(drive_hz), float(frame_rate_hz), float(exposure_s), order, off_axis=True
    )
    return float(leak)


# --- What the bench cannot do ------------------------------------------------------------------


def _violations(protocol: Protocol, bench: BenchFile, steps: Sequence[Step]) -> Iterator[Violation]:
    yield from _drive_violations(bench, steps)
    yield from _spacing_violations(bench, steps)
    yield from _volts_violations(protocol, bench)
    yield from _camera_violations(protocol, bench, steps)
    yield from _lock_violations(protocol, bench, steps)
    yield from _synthesizer_violations(protocol, bench, steps)


def _drive_violations(bench: BenchFile, steps: Sequence[Step]) -> Iterator[Violation]:
    limits = bench.limits
    low = [step for step in steps if step.drive_hz < limits.drive_min_hz]
    high = [step for step in steps if step.drive_hz > limits.drive_max_hz]
    # Frequencies grow with the index, so what is possible lies between the two.
    possible = [step.index for step in steps[len(low) : len(steps) - len(high)]]
    if low:
        limit = f"below the {float(limits.drive_min_hz):.10g} Hz of limits.drive_min"
        yield _drive_violation("sweep.first", low[-1], limit, bench, possible[:1])
    if high:
        limit = f"above the {float(limits.drive_max_hz):.10g} Hz of limits.drive_max"
        yield _drive_violation("sweep.last", high[0], limit, bench, possible[-1:])


def _drive_violation(
    key: str, step: Step, limit: str, bench: BenchFile, possible: Sequence[int]
) -> Violation:
    remedy = f"write {possible[0]}" if possible else "no step of the sweep is possible, change it"
    return Violation(
        key if possible else "sweep.reference",
        f"step {step.index} is driven at {float(step.drive_hz):.10g} Hz, {limit} in bench file "
        f"{bench.source}; {remedy}",
    )


def _spacing_violations(bench: BenchFile, steps: Sequence[Step]) -> Iterator[Violation]:
    # A drive never decreases when the asked one grows, so equal ones follow each other.
    for step, later in pairwise(steps):
        possible = step.drive_hz >= bench.limits.drive_min_hz
        if possible and step.index != later.index and step.drive_hz == later.drive_hz:
            yield Violation(
                "sweep.interval",
                f"steps {step.index} and {later.index} are both driven at "
                f"{float(step.drive_hz):.10g} Hz, the nearest that the generator of bench file "
                f"{bench.source} plays and the synthesizers lock to; write a larger interval",
            )
            return


def _volts_violations(protocol: Protocol, bench: BenchFile) -> Iterator[Violation]:
    limits, ramp = bench.limits, protocol.drive.ramp
    for key, volts in (("drive.ramp.from", ramp.from_v), ("drive.ramp.to", ramp.to_v)):
        if volts > limits.volts_max_v:
            word, limit_key, remedy = "above", "volts_max", "most"
            limit = math.floor(1000 * limits.volts_max_v) / 1000
        elif volts < limits.volts_min_v:
            word, limit_key, remedy = "below", "volts_min", "least"
            limit = math.ceil(1000 * limits.volts_min_v) / 1000
        else:
            continue
        yield Violation(
            key,
            f"{float(volts):g} V is {word} the {limit:g} V (peak) of limits.{limit_key} in bench "
            f"file {bench.source}; write at {remedy} '{limit:g} V'",
        )


def _camera_violations(
    protocol: Protocol, bench: BenchFile, steps: Sequence[Step]
) -> Iterator[Violation]:
    camera, sensor = protocol.camera, bench.instruments.camera
    if camera.frame_rate_hz > sensor.max_frame_rate_hz:
        rate, fastest = float(camera.frame_rate_hz), float(sensor.max_frame_rate_hz)
        yield Violation(
            "camera.frame_rate",
            f"{rate:g} Hz is faster than the {fastest:g} Hz of the camera in bench file "
            f"{bench.source}; write at most '{fastest:g} Hz'",
        )
    longest_s = max(step.exposure_s for step in steps)
    if longest_s > camera.period_s:
        exposure, period = float(longest_s) * 1e3, float(camera.period_s) * 1e3
        several = protocol.calibration is not None and protocol.calibration.exposures_s
        yield Violation(
            "calibration.exposures" if several else "camera.exposure",
            f"{exposure:g} ms is longer than the frame period of {period:.4g} ms; "
            "leave it out to expose the whole period",
        )
    for key, asked, size in (
        ("camera.width", camera.width, sensor.width),
        ("camera.height", camera.height, sensor.height),
    ):
        if asked is not None and asked > size:
            yield Violation(
                key,
                f"{asked} pixels are more than the sensor has in bench file {bench.source}; write "
                f"at most {size}",
            )


def _view_violations(bench: BenchFile, reed: ReedFile) -> Iterator[Violation]:
    optics, layout = bench.optics, layout_of(bench, reed)
    view_m = float(optics.wavelength_m * optics.distance_m / bench.instruments.camera.pixel_m)
    for axis, centre_m, size_m in zip("yx", layout.reed_centre_m, layout.reed_size_m, strict=True):
        edge_m = abs(centre_m) + size_m / 2
        # A margin of 5 % of the view, so that the region also fits on a coarser image.
        if edge_m > _VIEW_SHARE * view_m:
            yield Violation(
                "reed",
                f"the image of the {reed.name} reed reaches {edge_m:.4g} m from the axis in "
                f"{axis}, but the view is {view_m:.4g} m wide; move optics.reed_centre or raise "
                f"optics.distance in bench file {bench.source}",
            )


def _lock_violations(
    protocol: Protocol, bench: BenchFile, steps: Sequence[Step]
) -> Iterator[Violation]:
    frame_rate_hz = protocol.camera.frame_rate_hz
    worst = max(steps, key=lambda step: abs(step.lock_residual_hz))
    turn_rad = phase_error_rad(worst.lock_residual_hz, worst.frames, frame_rate_hz)
    allowed_rad = float(protocol.tolerance.lock_phase_rad)
    if turn_rad > allowed_rad:
        # A quarter of the frame rate on the synthesizers' grid makes every order exact.
        grid_hz = 4 * bench.instruments.synthesizers.step_hz
        better_hz = max(math.floor(frame_rate_hz / grid_hz), 1) * grid_hz
        remedy = f"write '{float(better_hz):.10g} Hz', which the synthesizers' steps allow"
        if better_hz == frame_rate_hz:
            remedy = "make the generator's step a multiple or a whole part of the synthesizers'"
        yield Violation(
            "camera.frame_rate",
            f"at step {worst.index} the lock misses by {float(worst.lock_residual_hz):.3g} Hz and "
            f"turns the phase by {turn_rad:.3g} rad, more than the {allowed_rad:g} rad of "
            f"tolerance.lock_phase, with the steps of bench file {bench.source}; {remedy}",
        )


def _synthesizer_violations(
    protocol: Protocol, bench: BenchFile, steps: Sequence[Step]
) -> Iterator[Violation]:
    synthesizers = bench.instruments.synthesizers
    widest = max(steps, key=lambda step: abs(step.aom1_hz - synthesizers.centre_hz))
    if abs(widest.aom1_hz - synthesizers.centre_hz) > synthesizers.window_hz:
        yield Violation(
            "sideband.orders" if protocol.sideband.orders else "sideband.order",
            f"at step {widest.index} AOM1 would stand {float(widest.difference_hz):.10g} Hz from "
            f"the centre, outside the window of {float(synthesizers.window_hz):.10g} Hz in bench "
            f"file {bench.source}; lower the order or sweep.last",
        )
