"""Pictures of a sweep: brightness of the reed's image, averaged over its speckle."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitError
from holography.arrays import Array, Float32Array
from holography.fringes import block_mean
from physics.reed.geometry import half_width_m
from runs.reader import Run
from runs.records import StepRecord

# Side of the blocks over which speckle is averaged. The finest fringes are twice as wide.
_BLOCK_M = 0.35e-3
# Margin inside the contour: blocks on the edge contain less reed than others.
_EDGE_M = 0.25e-3
# Behind the vamp the clamp begins: the reed is dark there and does not move.
_BEHIND_VAMP_M = 1e-3
# Number of points: enough to separate fifteen shapes; more only cost time.
_MOST_POINTS = 1300
# Fewer pictures than this are no sweep: a resonance is 2 to 3 steps wide.
_LEAST_PICTURES = 8


@dataclass(frozen=True)
class Pictures:
    """Brightness of points on the reed in every good picture of a run.

    Attributes
    ----------
    brightness : (k, n) float32
        Block means of |H|², less the noise of the picture.
    x_m, y_m : (n,) float
        Reed coordinates of the blocks.
    step_index : (k,) int
        Index of each picture in the protocol.
    drive_hz : (k,) float
        Realised drive frequency of each picture, ascending.
    """

    brightness: Float32Array
    x_m: Array
    y_m: Array
    step_index: NDArray[np.intp]
    drive_hz: Array


def read_pictures(run: Run) -> Pictures:
    """Read the good pictures of a run, in order of frequency.

    Raises
    ------
    FitError
        If too few steps are good. The message lists the verdicts of the others.
    RunFileError
        If a step cannot be read.
    """
    good = good_steps(run)
    factors = [max(1, round(_BLOCK_M / abs(a[1] - a[0]))) for a in (run.y_m, run.x_m)]
    y, x = (_block_centres(a, f) for a, f in zip((run.y_m, run.x_m), factors, strict=True))
    Y, X = np.meshgrid(y, x, indexing="ij")
    reed = run.reed_file().geometry()
    inside_edge_m = half_width_m(reed.outline, X) - np.abs(Y)
    visible_m = reed.vamp_x_m[-1] + _BEHIND_VAMP_M
    inside = (inside_edge_m > _EDGE_M) & (X > 2 * _EDGE_M) & (visible_m > X)
    chosen = np.flatnonzero(inside)
    # A stride that shares no factor with the rows spreads the points over the reed.
    chosen = chosen[:: max(1, -(-len(chosen) // _MOST_POINTS))]
    brightness = np.empty((len(good), len(chosen)), np.float32)
    for row, step in enumerate(good):
        field = run.field(step.position)
        power = field.real**2 + field.imag**2
        brightness[row] = block_mean(power, *factors).ravel()[chosen] - step.noise_level
    return Pictures(
        brightness,
        X.ravel()[chosen],
        Y.ravel()[chosen],
        np.array([step.index for step in good]),
        np.array([float(step.read_drive_hz or step.drive_hz) for step in good]),
    )


def good_steps(run: Run) -> list[StepRecord]:
    """Steps of a run that hold good holograms of its main sideband, in order of frequency.

    Raises
    ------
    FitError
        If that is not the first sideband, or they are too few; says what the others suffer from.
    """
    if run.sideband_order != 1:
        raise FitError(
            f"{run.path}: its pictures are of sideband {run.sideband_order}, and fits need the "
            "first; measure with sideband.order 1, and list the others in sideband.orders"
        )
    of_order = [step for step in run.steps if step.order == run.sideband_order]
    good = sorted((s for s in of_order if s.verdict == "ok"), key=lambda step: step.drive_hz)
    if len(good) < _LEAST_PICTURES:
        troubles = _troubles(of_order)
        raise FitError(
            f"{run.path}: {len(good)} of {len(of_order)} steps are good, a fit needs at least "
            f"{_LEAST_PICTURES}" + (f" ({troubles})" if troubles else "")
        )
    return good


def _block_centres(axis_m: Array, factor: int) -> Array:
    whole = axis_m[: len(axis_m) // factor * factor]
    centres: Array = whole.reshape(-1, factor).mean(axis=1)
    return centres


def _troubles(steps: Sequence[StepRecord]) -> str:
    """Counts of the verdicts that are not ok, with the commonest sentence."""
    bad = [step for step in steps if step.verdict != "ok"]
    counts = {v: sum(s.verdict == v for s in bad) for v in {s.verdict for s in bad}}
    listed = ", ".join(f"{n} {v}" for v, n in sorted(counts.items(), key=lambda i: -i[1]))
    reason = next(
        (s.sentence for s in bad if s.sentence and counts[s.verdict] == max(counts.values())), ""
    )
    return f"{listed}: {reason}" if reason else listed
