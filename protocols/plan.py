"""The plan: all settings of a protocol on a bench, exact, before any instrument is touched."""

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final

from holography.demodulation import carrier_leak
from holography.region import Region
from physics.optics import reed_region
from physics.parameters.optics import Layout
from protocols.bench import BenchFile
from protocols.frequency_lock import (
    difference_hz,
    lock_residual_hz,
    nearest_multiple,
    snap_drive,
)
from protocols.preparation import Preparation
from protocols.protocol import (
    Calibration,
    Protocol,
)
from protocols.reed import ReedFile
from protocols.step import Step, Violation
from protocols.view import frame_shape, layout_of, object_transform
from protocols.violations import find_camera_violations, find_view_violations, find_violations

_BYTES_PER_HOLOGRAM_PIXEL: Final = 8  # complex64
_BYTES_PER_FRAME_PIXEL: Final = 2  # uint16
# Measured on frames of 12 bits; see `Plan.packed_size_bytes`.
_PACKED_FRACTION: Final = 0.61


# Chosen: any fixed seed, so that a shuffled sweep has the same order everywhere.
_SHUFFLE: Final = 20_080_403


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
        """Positions of the steps in the order of measurement."""
        return planned_sequence(self.protocol, len(self.steps))

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns ``(ny, nx)`` of one frame."""
        return frame_shape(self.protocol, self.bench)

    @property
    def region(self) -> Region:
        """Part of the reconstructed image that contains the reed."""
        return reed_region(self.layout, object_transform(self.protocol, self.bench))

    @property
    def layout(self) -> Layout:
        """Position of the reed in front of the sensor."""
        return layout_of(self.bench, self.reed)

    def preparation(self, reed: str) -> Preparation:
        """Return the preparation of the bench for a run of this plan on the reed `reed`."""
        protocol = self.protocol
        return Preparation(
            reed, protocol.series, protocol.chamber, self.reed.geometry(), self.reed.constants()
        )

    @property
    def max_retries(self) -> int:
        """Largest number of bad steps that are measured again after the last step.

        A tenth of the sweep and four: if more steps are bad, the cause lies elsewhere.
        """
        retries = len(self.steps) * self.protocol.policy.bad_step.retries
        return min(retries, len(self.steps) // 10 + 4)

    @property
    def spare_attempts(self) -> int:
        """Number of attempts that a run file can hold in addition to one for each step.

        They are the retries after the last step, and the bad steps in a row after which a run gives
        up, which are measured again once the cause is repaired.
        """
        if not self.max_retries:
            return 0
        return self.max_retries + min(self.protocol.policy.give_up_after, len(self.steps))

    @property
    def duration_s(self) -> float:
        """Duration with a real camera: settling, waiting for its next frame, and the frames."""
        period_s = self.protocol.camera.period_s
        periods = sum(math.ceil(step.settle_s / period_s) + step.frames for step in self.steps)
        return float(periods * period_s)

    @property
    def file_size_bytes(self) -> int:
        """Size of the data of all steps in the run file, before frames are packed."""
        return len(self.steps) * self._step_size_bytes

    @property
    def largest_size_bytes(self) -> int:
        """Size if the run needs all its spare attempts."""
        return (len(self.steps) + self.spare_attempts) * self._step_size_bytes

    @property
    def packed_size_bytes(self) -> int | None:
        """Approximate size after packing, which a complete run does; None without frames.

        One byte of each pixel is noise and cannot be compressed; the other holds the bits above 8
        and compresses well.
        """
        return (
            None
            if self.protocol.keep == "holograms"
            else round(_PACKED_FRACTION * self.file_size_bytes)
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
            "known": self.bench.known or {},
            "duration_s": self.duration_s,
            "file_size_bytes": self.file_size_bytes,
            "largest_size_bytes": self.largest_size_bytes,
            "packed_size_bytes": self.packed_size_bytes,
            "violations": [{"key": v.key, "message": v.message} for v in self.violations],
        }


def planned_sequence(protocol: Protocol, steps: int) -> tuple[int, ...]:
    """Return the positions of a number of steps in the order of measurement."""
    places = list(range(steps))
    if protocol.sweep.direction == "down":
        places.reverse()
    elif protocol.sweep.direction == "shuffled":
        random.Random(_SHUFFLE).shuffle(places)
    return tuple(places)


def make_plan(protocol: Protocol, bench: BenchFile) -> Plan:
    """Plan a sweep without touching an instrument.

    Parameters
    ----------
    protocol : Protocol
        The protocol.
    bench : BenchFile
        The bench.

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
        found = *find_camera_violations(protocol, bench, still), *find_view_violations(bench, reed)
        return Plan(protocol, reed, bench, still, found)
    steps = tuple(
        _step(protocol, bench, index, order)
        for index in protocol.sweep.indices
        for order in protocol.sideband.selected
    )
    violations = *find_violations(protocol, bench, steps), *find_view_violations(bench, reed)
    return Plan(protocol, reed, bench, steps, violations)


def _step(protocol: Protocol, bench: BenchFile, index: int, order: int) -> Step:
    synthesizers, generator = bench.instruments.synthesizers, bench.instruments.generator
    frame_rate_hz = protocol.camera.frame_rate_hz
    asked_hz = protocol.sweep.frequency_hz(index)
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
        volts=protocol.drive.volts(index, asked_hz),
        frames=protocol.camera.frames,
        settle_s=protocol.settle_s,
        exposure_s=protocol.exposure_s,
        carrier_leak=_leak(protocol, drive_hz, order),
    )


def _still_steps(protocol: Protocol, calibration: Calibration, bench: BenchFile) -> Iterator[Step]:
    """Yield acquisitions of a reed that is not driven, one exposure after the other."""
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
    # The reed stands off the axis, so the twin image of the carrier lies outside the kept part.
    leak = carrier_leak(
        float(drive_hz), float(frame_rate_hz), float(exposure_s), order, off_axis=True
    )
    return float(leak)
