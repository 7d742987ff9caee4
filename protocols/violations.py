"""Violations: limits of a bench that a plan exceeds, each with its remedy."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

from protocols.bench import BenchFile
from protocols.frequency_lock import (
    phase_error_rad,
)
from protocols.protocol import (
    Protocol,
)
from protocols.reed import ReedFile
from protocols.step import Step, Violation
from protocols.view import layout_of

# Chosen: fraction of the view on either side of the axis that the image of a reed may fill.
_VIEW_FRACTION: Final = 0.45


def find_violations(
    protocol: Protocol, bench: BenchFile, steps: Sequence[Step]
) -> Iterator[Violation]:
    """Yield every limit of the bench that the steps exceed."""
    yield from _drive_violations(protocol, bench, steps)
    yield from _spacing_violations(protocol, bench, steps)
    yield from _volts_violations(protocol, bench)
    yield from find_camera_violations(protocol, bench, steps)
    yield from _lock_violations(protocol, bench, steps)
    yield from _synthesizer_violations(protocol, bench, steps)


def _drive_violations(
    protocol: Protocol, bench: BenchFile, steps: Sequence[Step]
) -> Iterator[Violation]:
    limits, sweep = bench.limits, protocol.sweep
    low = [step for step in steps if step.drive_hz < limits.drive_min_hz]
    high = [step for step in steps if step.drive_hz > limits.drive_max_hz]
    # Frequencies grow with the index, so what is possible lies between the two.
    possible = [step.index for step in steps[len(low) : len(steps) - len(high)]]
    none = sweep.scale_key, "no step of the sweep is possible, change it"
    if low:
        limit = f"below the {float(limits.drive_min_hz):.10g} Hz of limits.drive_min"
        key, remedy = sweep.remedy_to_begin_at(possible[0]) if possible else none
        yield _drive_violation(key, low[-1], limit, bench, remedy)
    if high:
        limit = f"above the {float(limits.drive_max_hz):.10g} Hz of limits.drive_max"
        key, remedy = sweep.remedy_to_end_at(possible[-1]) if possible else none
        yield _drive_violation(key, high[0], limit, bench, remedy)


def _drive_violation(key: str, step: Step, limit: str, bench: BenchFile, remedy: str) -> Violation:
    return Violation(
        f"sweep.{key}",
        f"step {step.index} is driven at {float(step.drive_hz):.10g} Hz, {limit} in bench file "
        f"{bench.source}; {remedy}",
    )


def _spacing_violations(
    protocol: Protocol, bench: BenchFile, steps: Sequence[Step]
) -> Iterator[Violation]:
    key, remedy = protocol.sweep.spacing
    # A drive never decreases when the asked one grows, so equal ones follow each other.
    for step, later in pairwise(steps):
        possible = step.drive_hz >= bench.limits.drive_min_hz
        if possible and step.index != later.index and step.drive_hz == later.drive_hz:
            yield Violation(
                f"sweep.{key}",
                f"steps {step.index} and {later.index} are both driven at "
                f"{float(step.drive_hz):.10g} Hz, the nearest that the generator of bench file "
                f"{bench.source} plays and the synthesizers lock to; {remedy}",
            )
            return


def _volts_violations(protocol: Protocol, bench: BenchFile) -> Iterator[Violation]:
    limits = bench.limits
    for key, volts in protocol.drive.extremes():
        if volts > limits.volts_max_v:
            word, limit_key, remedy = "above", "volts_max", "most"
            limit = math.floor(1000 * limits.volts_max_v) / 1000
        elif volts < limits.volts_min_v:
            word, limit_key, remedy = "below", "volts_min", "least"
            limit = math.ceil(1000 * limits.volts_min_v) / 1000
        else:
            continue
        yield Violation(
            f"drive.{key}",
            f"{float(volts):g} V is {word} the {limit:g} V (peak) of limits.{limit_key} in bench "
            f"file {bench.source}; write at {remedy} '{limit:g} V'",
        )


def find_camera_violations(
    protocol: Protocol, bench: BenchFile, steps: Sequence[Step]
) -> Iterator[Violation]:
    """Yield what the camera cannot do."""
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


def find_view_violations(bench: BenchFile, reed: ReedFile) -> Iterator[Violation]:
    """Yield a violation if the camera does not see the whole image of the reed."""
    optics, layout = bench.optics, layout_of(bench, reed)
    view_m = float(optics.wavelength_m * optics.distance_m / bench.instruments.camera.pixel_m)
    for axis, centre_m, size_m in zip("yx", layout.reed_centre_m, layout.reed_size_m, strict=True):
        edge_m = abs(centre_m) + size_m / 2
        # A margin of 5 % of the view, so that the region also fits on a coarser image.
        if edge_m > _VIEW_FRACTION * view_m:
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
            f"file {bench.source}; lower the order, or end the sweep at a lower frequency",
        )
