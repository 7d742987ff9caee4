"""Take the shot of a bench check: one locked step with few volts, judged as in a sweep."""

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from acquire.bench.findings import Finding, failed
from acquire.runner.orders import Orders
from acquire.runner.runner import run as measure
from acquire.runner.summary import RunState
from drivers.roles import Bench
from protocols.bench import BenchFile
from protocols.errors import ProtocolError
from protocols.plan import Plan, make_plan
from protocols.protocol import Protocol
from runs.reader import Run
from runs.records import StepRecord
from runs.verdict import Verdict

_CHECK: Final = "shot"
# Near the first bending resonance of a clarinet reed, where the smallest volts of the shipped
# protocols give the most light: signal to noise is 75 on the simulated bench, and 1.2 in mid-sweep.
DEFAULT_HZ: Final = 2000.0
# Volts at which the ramps of the shipped protocols begin.
DEFAULT_VOLTS: Final = 0.5
# Frame rate of the shipped protocols; slower if the camera is slower.
_FRAME_RATE_HZ: Final = Fraction("12.4")
# Exposure as a fraction of the frame period. Chosen: half, because most real cameras cannot expose
# for a whole period.
_EXPOSED_FRACTION: Final = Fraction(1, 2)
# Part of the sensor that the protocol `quick` reads.
_WIDTH, _HEIGHT = 640, 512


@dataclass(frozen=True, slots=True)
class Shot:
    """Result of the locked shot of four frames.

    Attributes
    ----------
    drive_hz, volts : float
        Drive frequency, and peak volts at the tweeter.
    verdict : Verdict
    sentence : str
        Reason of the verdict.
    lock_error_hz, lock_error_se_hz : float
        Deviation of the light from the frequency lock, and its standard error, in Hz.
    signal_to_noise, brightness_dn, saturated_share : float
        See `runs.records.StepRecord`.
    """

    drive_hz: float
    volts: float
    verdict: Verdict
    sentence: str
    lock_error_hz: float
    lock_error_se_hz: float
    signal_to_noise: float
    brightness_dn: float
    saturated_share: float

    def to_json(self) -> dict[str, Any]:
        """Return the shot as JSON values with stable keys; None for unknown numbers."""
        return {
            "drive_hz": self.drive_hz,
            "volts": self.volts,
            "verdict": str(self.verdict),
            "sentence": self.sentence,
            "lock_error_hz": _number(self.lock_error_hz),
            "lock_error_se_hz": _number(self.lock_error_se_hz),
            "signal_to_noise": _number(self.signal_to_noise),
            "brightness_dn": _number(self.brightness_dn),
            "saturated_share": _number(self.saturated_share),
        }


def shot_plan(bench: BenchFile, hz: float | None = None, volts: float | None = None) -> Plan:
    """Plan one locked step with few volts.

    Parameters
    ----------
    bench : BenchFile
    hz, volts : float, optional
        Drive frequency, and peak volts at the tweeter. Default: `DEFAULT_HZ` and `DEFAULT_VOLTS`,
        or the nearest values that the bench allows.

    Returns
    -------
    Plan
        Plan of one step; it has `violations` if the bench cannot carry it out.

    Raises
    ------
    ProtocolError
        If `hz` or `volts` is outside the limits of the bench file.
    """
    limits = bench.limits
    drive_hz = _within("--hz", hz, DEFAULT_HZ, limits.drive_min_hz, limits.drive_max_hz, "Hz")
    peak_v = _within("--volts", volts, DEFAULT_VOLTS, limits.volts_min_v, limits.volts_max_v, "V")
    camera = bench.instruments.camera
    rate_hz = _frame_rate_hz(bench)
    exposure_ms = max(math.floor(1000 * _EXPOSED_FRACTION / rate_hz), 1)
    return make_plan(
        Protocol.from_file("quick").replace(
            {
                "name": "Bench check",
                "sweep": {"law": "list", "frequencies": [f"{drive_hz:.6f} Hz"]},
                "drive": {"law": "constant", "volts": f"{peak_v:.6f} V"},
                "camera": {
                    "frames": 4,
                    "frame_rate": f"{float(rate_hz):.6f} Hz",
                    "exposure": f"{exposure_ms} ms",
                    "width": min(_WIDTH, camera.width),
                    "height": min(_HEIGHT, camera.height),
                },
                "policy": {"bad_step": {"retries": 0, "then": "skip"}},
            }
        ),
        bench,
    )


def _within(
    option: str,
    asked: float | None,
    default: float,
    least: Fraction,
    most: Fraction,
    unit: str,
) -> float:
    """Return the requested value, or the allowed value nearest to the default."""
    low, high = float(least), float(most)
    if asked is None:
        return min(max(default, low), high)
    # Negated, so that NaN is refused. Plans round to 1 µV, and 0 V would not drive the reed.
    if not (low <= asked <= high and round(asked, 6) > 0):
        raise ProtocolError(
            f"{option}: {asked:g} {unit} is outside the limits of the bench file; write a value "
            f"above 0 and between {low:g} and {high:g}"
        )
    return asked


def _frame_rate_hz(bench: BenchFile) -> Fraction:
    """Return a frame rate whose quarter is on the synthesizers' grid, if the camera has one."""
    most_hz = bench.instruments.camera.max_frame_rate_hz
    if most_hz >= _FRAME_RATE_HZ:
        return _FRAME_RATE_HZ
    grid_hz = 4 * bench.instruments.synthesizers.step_hz
    return math.floor(most_hz / grid_hz) * grid_hz or most_hz


def take_shot(
    plan: Plan, bench: Bench, orders: Orders, announce: Callable[[str], None]
) -> tuple[Finding, Shot | None]:
    """Measure the planned step as in a sweep, to a temporary file.

    Parameters
    ----------
    plan : Plan
        Plan of the shot, see `shot_plan`.
    bench : Bench
        Open bench. Its outputs are off afterwards, as after every run.
    orders : Orders
    announce : callable

    Returns
    -------
    Finding
        Passes if the verdict is ok.
    Shot or None
        None if no shot was recorded.
    """
    announce("taking one locked shot of four frames")
    try:
        with tempfile.TemporaryDirectory(prefix="reedbench-check-") as folder:
            path = Path(folder, "check.h5")
            summary = measure(plan, bench, path, announce=announce, orders=orders)
            if summary.status is not RunState.COMPLETE:
                return Finding(_CHECK, "bench", "skipped", summary.reason), None
            with Run.open(path) as run:
                shot = _shot_of(run.steps[0])
    except Exception as error:  # noqa: BLE001  # whatever a driver raises, switch off and say so
        return failed(_CHECK, "bench", error), None
    return _judged(shot), shot


def _shot_of(step: StepRecord) -> Shot:
    return Shot(
        drive_hz=float(step.drive_hz),
        volts=step.volts,
        verdict=step.verdict,
        sentence=step.sentence,
        lock_error_hz=step.lock_error_hz,
        lock_error_se_hz=step.lock_error_se_hz,
        signal_to_noise=step.signal_to_noise,
        brightness_dn=step.brightness_dn,
        saturated_share=step.saturated_share,
    )


def _judged(shot: Shot) -> Finding:
    numbers = (
        f"{shot.drive_hz:.6g} Hz at {shot.volts:g} V: lock error {shot.lock_error_hz:+.2g} ± "
        f"{shot.lock_error_se_hz:.1g} Hz, signal to noise {shot.signal_to_noise:.3g}, brightness "
        f"{shot.brightness_dn:.0f} DN"
    )
    if shot.verdict is Verdict.OK:
        return Finding(_CHECK, "bench", "pass", f"ok; {numbers}")
    sentence, _, remedy = shot.sentence.partition("; ")
    if shot.verdict in (Verdict.NO_SIGNAL, Verdict.UNPROVEN):
        remedy += "; or try a resonance of this reed and more volts: --hz, --volts"
    return Finding(_CHECK, "bench", "fail", f"{shot.verdict}: {sentence}; {numbers}", remedy)


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
