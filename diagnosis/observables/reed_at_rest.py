"""Holograms and field of the reed at rest: phase steps, brightness, speckle."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from diagnosis.observable_groups import (
    DISORDER,
    Coordinates,
    Errors,
    Observable,
    ObservableGroup,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.observables.brightness import acquired_until
from diagnosis.observables.frequency_lock import lock_scatter_hz, turn_of_unequal_steps
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.reed_at_rest import RestHolograms
from holography.arrays import Array
from holography.phase import TURN_OF_FRAMES
from physics.mechanics import ReedSolver
from physics.parameters.disorder import BY_NAME
from physics.parameters.optics import Interference
from physics.parameters.tree import BenchParameters

# Factor for the scatter of few numbers: Student's distribution of six degrees of freedom is as much
# wider than a normal one. Weight of the scatter by a phase walk, in numbers: chosen, that of the
# acquisitions of a short campaign.
_FEW, _BELIEVED = 1.2, 4.0
# Efficiency of the median of absolute deviations as a measure of scatter, for normal deviates
# (Rousseeuw and Croux, J. Am. Stat. Assoc. 88, 1273 (1993)).
_OF_MEDIAN = 0.37
# How phases of ordinary benches scatter, and the standard deviation of its log. Chosen: benches
# differ by a factor of two.
_ORDINARY = Interference(
    walk_rad_s=BY_NAME["path_walk"].ordinary.root_mean_square,
    jitter_rad=BY_NAME["path_jitter"].ordinary.root_mean_square,
    step_walk_rad=BY_NAME["path_step"].ordinary.root_mean_square,
)
_WALK = 0.7
# Scatter of the power of an ordinary laser from frame to frame, and degrees of freedom from which
# on acquisitions show their own: Student's distribution has a variance from three on.
_ORDINARY_LASER, _FEWEST = BY_NAME["laser_power"].ordinary.root_mean_square, 3
# Share of the light's correlation that an ordinary bench loses from one acquisition to the next.
_LOST = 0.5 * sum(
    BY_NAME[name].ordinary.root_mean_square ** 2 for name in ("speckle_renewal", "field_change")
)


def usual_scatter_hz(beams: Interference, rate_hz: float) -> float:
    """Scatter of the lock of acquisitions, by a phase that walks and jitters.

    The steady turn that fits four frames best is a third of what the phase turns by between the
    first and the last (`TURN_OF_FRAMES`).
    """
    walked = beams.walk_rad_s**2 / (len(TURN_OF_FRAMES) - 1) / rate_hz
    within = np.sqrt(walked + np.sum(np.square(TURN_OF_FRAMES)) * beams.jitter_rad**2)
    return float(within * rate_hz / (2 * np.pi))


def phase_turn_group(
    stills: Sequence[RestHolograms], scatter_hz: float, rate_hz: float
) -> ObservableGroup:
    """Compare the turn of light at rest within acquisitions, and between them.

    Parameters
    ----------
    stills : sequence of RestHolograms
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
        places.append(Coordinates("lock at rest, within acquisitions", time=when))
        inside.append(1.0)
        hours.append(float(np.mean(still.time_s)) / 3600)
        if not turn.size:
            continue
        values.append(-float(np.sum(turn) / np.sum(gap)) / (2 * np.pi))
        errors.append(_FEW * between / np.sqrt(len(turn)) / float(np.mean(gap)) / (2 * np.pi))
        places.append(Coordinates("lock at rest, between acquisitions", time=when))
        inside.append(0.0)
        hours.append(hours[-1])

    def predict(parameters: BenchParameters) -> Array:
        clocks, within = parameters.clocks, np.array(inside)
        lock = clocks.detuning_hz + clocks.detuning_hz_h * np.array(hours)
        return lock - within * turn_of_unequal_steps(parameters) * rate_hz / (2 * np.pi)

    parts = ("clocks", "optics")
    return observable_group(
        "light at rest", Observable.HOLOGRAM, values, np.array(errors), places, parts, predict
    )


def _spread_between(
    turns: Sequence[Array], gaps: Sequence[Array], within_rad: float, rate_hz: float
) -> float:
    """Scatter of phases from one acquisition to the next, by themselves and by a phase that walks.

    Few acquisitions hardly determine their own scatter, so that it is combined with the walk of the
    phase between them.
    """
    several = [turn for turn in turns if turn.size]
    if not several:
        # A single acquisition turns by nothing that could be seen.
        return np.inf
    left = np.concatenate([turn - turn.mean() for turn in several])
    freedoms = len(left) - len(several)
    each_frame = (len(TURN_OF_FRAMES) - 1) * within_rad**2
    walked = each_frame * rate_hz * float(np.mean(np.concatenate(gaps)))
    return float(np.sqrt((np.sum(left**2) + _BELIEVED * walked) / (freedoms + _BELIEVED)))


def stability_group(stills: Sequence[RestHolograms], acquired_s: Array) -> ObservableGroup:
    """Brightness of every other frame, and speckle that should be the same.

    Parameters
    ----------
    stills : sequence of RestHolograms
    acquired_s : (k,) float
        Times of all acquisitions of sweeps.
    """
    values, errors, places = [], [], []
    ratios = [still.frame_ratio for still in stills]
    flicker = _flicker(ratios)
    for still in stills:
        when = f"clamping {still.clamping + 1}"
        values.append(float(np.mean(still.frame_ratio)))
        own = max(flicker, still.frame_scatter) / np.sqrt(len(still.frame_ratio))
        errors.append(own)
        places.append(Coordinates("every other frame's brightness", time=when))
        for a in range(len(still.likeness)):
            for b in range(a):
                between = float(np.ptp(acquired_until(still.run_time_s[[a, b]], acquired_s)))
                values.append(1 - float(still.likeness[a, b]))
                errors.append(float(np.hypot(_LOST * max(between, 1), still.likeness_error)))
                places.append(Coordinates("speckle that has changed", time=when))

    def predict(_twin: BenchParameters) -> Array:
        return np.zeros(len(values))

    # How fast a surface changes is not known before: its scale is fitted.
    return observable_group(
        "still light", Observable.FIELD, values, Errors(np.array(errors), (), DISORDER), places,
        (), predict,
    )  # fmt: skip


def _flicker(ratios: Sequence[Array]) -> float:
    """Return by how much a laser flickers from frame to frame, as wide as it may be.

    Acquisitions of light at rest show it. Few of them agree by chance: the laser is then an
    ordinary one, at least.
    """
    freedoms = sum(len(ratio) - 1 for ratio in ratios)
    squares = sum(float(np.sum((ratio - ratio.mean()) ** 2)) for ratio in ratios)
    if freedoms < _FEWEST:
        return max(_FEW * float(np.sqrt(squares / max(freedoms, 1))), _ORDINARY_LASER)
    # Variance of Student's distribution.
    return float(np.sqrt(squares / (freedoms - 2)))


def phase_scatter_group(
    stills: Sequence[RestHolograms], lock_scatter_hz: float, locks: int, rate_hz: float
) -> ObservableGroup | None:
    """Scatter of phases, within acquisitions of all sweeps and between those of light at rest.

    None if too few of the latter are good.

    Parameters
    ----------
    stills : sequence of RestHolograms
    lock_scatter_hz : float
        By `lock_scatter_hz`.
    locks : int
        Number of locks that it is from.
    rate_hz : float
        Frames per second.
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

    def scatter(beams: Interference) -> Array:
        steps = beams.walk_rad_s**2 * gaps.mean() + 0.5 * beams.jitter_rad**2
        apart = np.sqrt(steps + beams.step_walk_rad**2)
        return np.array([usual_scatter_hz(beams, rate_hz), apart])

    ordinary = scatter(_ORDINARY)

    def predict(parameters: BenchParameters) -> Array:
        return np.log(np.hypot(scatter(parameters.optics.interference), ordinary))

    # A bench quieter than an ordinary one is not a gap.
    measured = np.array([max(lock_scatter_hz, 1e-9), max(between, 1e-9)])
    values = np.maximum(np.log(measured), predict(BenchParameters()))
    of_locks = 0.5 / (_OF_MEDIAN * locks)
    errors = np.sqrt([_WALK**2 + of_locks, _WALK**2 + 0.5 / freedoms])
    places = [Coordinates("phase within acquisitions"), Coordinates("phase between acquisitions")]
    return observable_group(
        "scatter of phases", Observable.HOLOGRAM, values, errors, places, ("optics",), predict,
    )  # fmt: skip


def _turns(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    if not readings.stills:
        return None
    usual_hz = usual_scatter_hz(readings.nominal.optics.interference, readings.rate_hz)
    scatter_hz = lock_scatter_hz(readings.beat) or usual_hz
    return phase_turn_group(readings.stills, scatter_hz, readings.rate_hz)


def _stability(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return stability_group(readings.stills, readings.beat.acquired_s) if readings.stills else None


def _scatter(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    scatter_hz = lock_scatter_hz(readings.beat)
    if not readings.stills or scatter_hz is None:
        return None
    locks = len(readings.beat.lock_hz)
    return phase_scatter_group(readings.stills, scatter_hz, locks, readings.rate_hz)


SOURCES: Final = (GroupSource(5, _turns), GroupSource(6, _stability), GroupSource(7, _scatter))
