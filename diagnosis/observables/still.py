"""Holograms and field of the reed at rest: phase steps, brightness, speckle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.block import (
    Block,
    Observable,
    Place,
    block,
    unknown,
)
from diagnosis.campaign import Part
from diagnosis.observables.beat import turn_of_unequal_steps
from holography.phase import TURN_OF_FRAMES
from physics.twin import OpticsParameters, Twin

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Still:
    """Holograms of the reed at rest, of one clamping, in the order of time.

    Attributes
    ----------
    clamping : int
    time_s : (s,) float
        Since the campaign began.
    advance_rad, advance_error : (s,) float
        By which the light turned from frame to frame more than a quarter, and standard errors.
    turn_rad : (s - 1,) float
        By which it turned from one acquisition to the next more than the settings say; NaN between
        runs.
    gap_s : (s - 1,) float
        Time between these.
    brightness : (s,) float
        Log of the light's amplitude, dn.
    frame_ratio : (s,) float
        Log of the brightness of the second and fourth frame over that of the first and third.
    frame_scatter : float
        Standard error of it, from the light's noise.
    likeness : (r, r) float
        Of the speckle of r runs, 1 is the same; noise taken out.
    likeness_error : float
        Standard error of it, from the noise.
    run : (s,) int
        Which of them an acquisition is of.
    run_time_s : (r,) float
    noise_dn2 : (s,) float
        Beside the image.
    """

    clamping: int
    time_s: Array
    advance_rad: Array
    advance_error: Array
    turn_rad: Array
    gap_s: Array
    brightness: Array
    frame_ratio: Array
    frame_scatter: float
    likeness: Array
    likeness_error: float
    run: NDArray[np.intp]
    run_time_s: Array
    noise_dn2: Array


def read_stills(parts: Sequence[Part]) -> list[Still]:
    """Read order 0 of the reed at rest, one record per clamping."""
    parts = [part for part in parts if part.good_steps]
    clampings = sorted({part.clamping for part in parts})
    return [_still([p for p in parts if p.clamping == c], c) for c in clampings]


def _still(parts: Sequence[Part], clamping: int) -> Still:
    rows: list[tuple[float, ...]] = []
    turns, gaps, means = [], [], []
    scatter = []
    for number, part in enumerate(parts):
        run, before = part.run, None
        fields = []
        for step in part.good_steps:
            frames = run.frames(step.position)
            halves = run.reconstruction.quadratures(frames)
            field, phase = halves.field, run.reconstruction.steady_turn(frames, halves)
            brightness = frames.reshape(4, -1).mean(axis=1, dtype=float)
            begun_s = step.timestamps_s[0] - part.clock_s
            signal = float(np.mean(np.abs(field) ** 2)) - halves.noise
            ratio = np.log(brightness[1] + brightness[3]) - np.log(brightness[0] + brightness[2])
            scatter.append(1 / np.sqrt(2 * frames[0].size * brightness.mean()))
            rows.append(
                (begun_s, phase.error_rad, phase.standard_error_rad, 0.5 * np.log(signal),
                 float(ratio), halves.noise)
            )  # fmt: skip
            turned = field * np.exp(2j * np.pi * float(step.difference_hz) * begun_s)
            if before is not None:
                turns.append(float(np.angle(np.vdot(before[1], turned))))
                gaps.append(begun_s - before[0])
            elif number:
                turns.append(np.nan)
                gaps.append(np.nan)
            before = begun_s, turned
            fields.append(turned)
        means.append((np.array(fields), rows[-1][-1]))
    time_s, advance, error, bright, ratio_, noise = np.array(rows).T
    likeness, likeness_error = _likeness(means)
    return Still(
        clamping=clamping,
        time_s=time_s,
        advance_rad=advance,
        advance_error=error,
        turn_rad=np.array(turns),
        gap_s=np.array(gaps),
        brightness=bright,
        frame_ratio=ratio_,
        frame_scatter=float(np.mean(scatter)),
        likeness=likeness,
        likeness_error=likeness_error,
        run=np.repeat(np.arange(len(parts)), [len(part.good_steps) for part in parts]),
        run_time_s=np.array(
            [np.mean([s.timestamps_s[0] for s in part.good_steps]) - part.clock_s for part in parts]
        ),
        noise_dn2=noise,
    )


def _likeness(runs: Sequence[tuple[Array, float]]) -> tuple[Array, float]:
    """Correlation (r, r) of the mean fields of runs, without their noise."""
    means, powers, errors = [], [], []
    for fields, noise in runs:
        phases = np.array([np.vdot(fields[0], field) for field in fields])
        aligned = fields * np.exp(-1j * np.angle(phases))[:, None, None]
        mean = aligned.mean(axis=0)
        power = float(np.mean(np.abs(mean) ** 2)) - noise / len(fields)
        means.append(mean)
        powers.append(power)
        errors.append(noise / len(fields) / power)
    n = len(means)
    table = np.eye(n)
    for a in range(n):
        for b in range(a):
            product = abs(np.vdot(means[a], means[b])) / means[a].size
            table[a, b] = table[b, a] = product / np.sqrt(powers[a] * powers[b])
    return table, float(np.mean(errors) / np.sqrt(means[0].size))


# --- Beside the twin ----------------------------------------------------------------------------
# How well few numbers tell their own scatter; and as of how many numbers that is which a walk says.
_FEW, _BELIEVED = 1.2, 4.0
# Log of how fast phases walk, and of what scatter of phases is beside that.
_WALK, _SCATTER = 0.4, 0.1
# Brightness of every other frame; speckle that has changed.
_FLICKER, _CHANGED = 2e-4, 1e-4


def usual_scatter_hz(beams: OpticsParameters, rate_hz: float) -> float:
    """Scatter of the lock of acquisitions, by a phase that walks and jitters.

    The steady turn that fits four frames best is a third of what the phase turns by between the
    first and the last (`TURN_OF_FRAMES`).
    """
    walked = beams.walk_rad_s**2 / (len(TURN_OF_FRAMES) - 1) / rate_hz
    within = np.sqrt(walked + np.sum(np.square(TURN_OF_FRAMES)) * beams.jitter_rad**2)
    return float(within * rate_hz / (2 * np.pi))


def turn_block(stills: Sequence[Still], scatter_hz: float, rate_hz: float) -> Block:
    """What light at rest turns by within acquisitions, and between them.

    Parameters
    ----------
    stills : sequence of Still
    scatter_hz : float
        Of the lock in sweeps.
    rate_hz : float
        Frames per second.
    """
    values, errors, places, inside, hours = [], [], [], [], []
    turns = [still.turn_rad[np.isfinite(still.turn_rad)] for still in stills]
    gaps = [still.gap_s[np.isfinite(still.gap_s)] for still in stills]
    between = _spread_between(turns, gaps, scatter_hz / rate_hz * 2 * np.pi, rate_hz)
    for still, turn, gap in zip(stills, turns, gaps, strict=True):
        turn_hz = rate_hz / (2 * np.pi)
        when = f"clamping {still.clamping + 1}"
        values.append(float(np.mean(still.advance_rad)) * turn_hz)
        errors.append(max(scatter_hz / np.sqrt(len(still.advance_rad)), 1e-4))
        places.append(Place("lock at rest, within acquisitions", time=when))
        inside.append(1.0)
        hours.append(float(np.mean(still.time_s)) / 3600)
        if not turn.size:
            continue
        values.append(-float(np.sum(turn) / np.sum(gap)) / (2 * np.pi))
        errors.append(_FEW * between / np.sqrt(len(turn)) / float(np.mean(gap)) / (2 * np.pi))
        places.append(Place("lock at rest, between acquisitions", time=when))
        inside.append(0.0)
        hours.append(hours[-1])

    def predict(twin: Twin) -> Array:
        clocks, within = twin.clocks, np.array(inside)
        lock = clocks.detuning_hz + clocks.detuning_hz_h * np.array(hours)
        return lock - within * turn_of_unequal_steps(twin) * rate_hz / (2 * np.pi)

    parts = ("clocks", "optics")
    return block(
        "light at rest", Observable.HOLOGRAM, values, np.array(errors), places, parts, predict
    )


def _spread_between(
    turns: Sequence[Array], gaps: Sequence[Array], within_rad: float, rate_hz: float
) -> float:
    """Scatter of phases from one acquisition to the next, by themselves and by a phase that walks.

    Few acquisitions hardly tell their own scatter; a phase that walks by so much within each of
    them walks by so much more between them.
    """
    left = np.concatenate([turn - turn.mean() for turn in turns])
    freedoms = max(len(left) - len(turns), 0)
    each_frame = (len(TURN_OF_FRAMES) - 1) * within_rad**2
    walked = each_frame * rate_hz * float(np.mean(np.concatenate(gaps)))
    return float(np.sqrt((np.sum(left**2) + _BELIEVED * walked) / (freedoms + _BELIEVED)))


def stability_block(stills: Sequence[Still]) -> Block:
    """Brightness of every other frame, and speckle that should be the same."""
    values, errors, places = [], [], []
    for still in stills:
        when = f"clamping {still.clamping + 1}"
        values.append(float(np.mean(still.frame_ratio)))
        own = still.frame_scatter / np.sqrt(len(still.frame_ratio))
        errors.append(float(np.hypot(own, _FLICKER)))
        places.append(Place("every other frame's brightness", time=when))
        for a in range(len(still.likeness)):
            for b in range(a):
                values.append(1 - float(still.likeness[a, b]))
                errors.append(_CHANGED)
                places.append(Place("speckle that has changed", time=when))

    def predict(_twin: Twin) -> Array:
        return np.zeros(len(values))

    return block("still light", Observable.FIELD, values, np.array(errors), places, (), predict)


def scatter_block(stills: Sequence[Still], lock_scatter_hz: float, rate_hz: float) -> Block | None:
    """Scatter of phases, within acquisitions of all sweeps and between those of light at rest.

    None if too few of the latter are good.
    """
    gaps = np.concatenate([still.gap_s[np.isfinite(still.gap_s)] for still in stills])
    each = [still.turn_rad[np.isfinite(still.turn_rad)] for still in stills]
    # What clampings differ by is the lock's, not scatter.
    each = [turns for turns in each if turns.size]
    freedoms = sum(len(turns) - 1 for turns in each)
    if freedoms < 1:
        return None
    left = np.concatenate([turns - turns.mean() for turns in each])
    between = float(np.sqrt(np.sum(left**2) / freedoms))
    walk = np.array([1.0, 1.0])

    def predict(twin: Twin) -> Array:
        beams = twin.optics
        apart = np.sqrt(beams.walk_rad_s**2 * gaps.mean() + 0.5 * beams.jitter_rad**2)
        return np.log([usual_scatter_hz(beams, rate_hz), apart])

    # A calmer bench than usual is no gap.
    usual = predict(Twin())
    values = np.maximum(np.log([max(lock_scatter_hz, 1e-9), max(between, 1e-9)]), usual - _WALK)
    errors = np.diag([_SCATTER**2, _SCATTER**2 + 0.5 / freedoms])
    covariance = errors + unknown((walk, _WALK))
    places = [Place("phase within acquisitions"), Place("phase between acquisitions")]
    return block(
        "scatter of phases", Observable.HOLOGRAM, values, covariance, places, ("optics",), predict,
    )  # fmt: skip
