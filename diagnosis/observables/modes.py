"""Frequencies and losses of all modes in all sweeps."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from diagnosis.observable_groups import (
    Coordinates,
    Observable,
    ObservableGroup,
    band_of,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.observables.carrier import Leaks
from diagnosis.observables.light import leaks_of
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import SAME_LEVEL, SweepReading, common_modes, loudest
from holography.arrays import Array
from physics.conditions import change_of_cane, condition_at, hardened
from physics.errors import ImpossibleReedError
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters, with_cane

CENTS = 1200 / np.log(2)
# What fits of the same vibration differ by, over their errors, and at least: cents, per cent.
_REPEATS, _REPEATS_LOSS, _LEAST_CENTS, _LEAST_LOSS = 0.4, 0.6, 0.15, 0.4
# Frequencies of sweeps that are quieter than others, over their errors.
_REPEATS_QUIET = 0.7
# What the method and the elements are off by in every mode, cents: below and above 12 kHz; and what
# losses of modes differ by in one cane, per cent.
_METHOD_CENTS, _METHOD_HIGH_CENTS, _LOSS = 2.2, 4.0, 6.0
# The lowest mode has none below it that would tell its loss.
_LOWEST_CENTS, _LOWEST_LOSS = 3.0, 20.0
# The second's loss leans on what the lowest is taken for: in every sweep; in every condition.
_SECOND_LEAST, _SECOND_LOSS = 1.0, 4.5
# A new clamping: cents, less for each mode above the first, and of each mode by itself; per cent.
_CLAMP_CENTS, _CLAMP_FALL, _CLAMP_OWN, _CLAMP_LOSS = 2.5, 4.0, 0.5, 1.5
# Light that leaks in, per its share of what moves: cents, per cent.
_LEAK_CENTS, _LEAK_LOSS = 15.0, 40.0
# What may stay of light that was taken off, per its share of what moves near a resonance: cents,
# per cent; by how much more of the lowest mode; and how near, in octaves.
_STAYS_CENTS, _STAYS_LOSS, _STAYS_LOWEST, _NEAR = 60.0, 50.0, 4.0, 0.15
# Sweeps of other volts: cents, per cent.
_LEVEL_CENTS, _LEVEL_LOSS = 0.6, 1.1
# Usual difference of fits of equal sweeps: cents, per cent.
_USUAL_CENTS, _USUAL_LOSS = 0.25, 0.4
_QUANTITIES = "frequency, cents", "loss, %"
# So near in log frequency the reed moves as much as at its resonance.
_AT_RESONANCE = 0.03
_STEP = 0.01


def modes_group(
    sweeps: Sequence[SweepReading], reed_solver: ReedSolver, leaks: Leaks
) -> ObservableGroup | None:
    """Compare frequencies (cents) and losses (per cent) of all sweeps with the model.

    None if sweeps have no mode in common.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    reed_solver : ReedSolver
    leaks : Leaks
    """
    known = reed_solver.modes(BenchParameters().reed)
    common = [name for name in common_modes(sweeps) if name in known]
    if not common:
        return None
    values, places, rows = [], [], []
    pieces = []
    highest = max(sweep.loudness for sweep in sweeps)
    for number, sweep in enumerate(sweeps):
        here = [name for name in common if name in sweep.names]
        at = np.array([sweep.names.index(name) for name in here], dtype=int)
        both = np.concatenate([at, len(sweep.names) + at])
        unit = np.concatenate([np.full(len(at), CENTS), np.full(len(at), 100.0)])
        values += list(CENTS * np.log(sweep.hz[at])) + list(100 * np.log(sweep.loss_factor[at]))
        for what in _QUANTITIES:
            for name, hz in zip(here, sweep.hz[at], strict=True):
                places.append(
                    Coordinates(what, mode=name, band=band_of(float(hz)), time=sweep.name)
                )
                rows.append((number, name, what))
        repeats = _REPEATS if sweep.loudness > highest - SAME_LEVEL else _REPEATS_QUIET
        own = np.concatenate([np.full(len(at), repeats), np.full(len(at), _REPEATS_LOSS)])
        pieces.append(_of_fit(sweep, both, own * unit, here, common))
        pieces[-1] += _of_leaks(leaks, sweep, at, [name == common[0] for name in here])
    covariance = np.zeros((len(values),) * 2)
    start = 0
    for piece in pieces:
        covariance[start : start + len(piece), start : start + len(piece)] = piece
        start += len(piece)
    covariance += _in_common(rows, common, sweeps)
    astray = {what: _astray(sweeps, common, loss=what.startswith("loss")) for what in _QUANTITIES}
    covariance += np.diag([astray[what][common.index(name)] ** 2 for _, name, what in rows])
    predict = _prediction(rows, common, sweeps, reed_solver)
    parts = ("reed", "environment", "fit_bias")
    return observable_group("modes", Observable.MODES, values, covariance, places, parts, predict)


def _of_fit(
    sweep: SweepReading, both: Array, share: Array, here: Sequence[str], common: Sequence[str]
) -> Array:
    """Covariance of what one sweep's fit adds, whose errors count to such a share."""
    count = len(here)
    covariance = share[:, None] * sweep.covariance[np.ix_(both, both)] * share
    least = np.concatenate([np.full(count, _LEAST_CENTS), np.full(count, _LEAST_LOSS)])
    if common[0] in here:
        lowest = list(here).index(common[0])
        least[lowest], least[count + lowest] = _LOWEST_CENTS, _LOWEST_LOSS
    if common[1:2] and common[1] in here:
        least[count + list(here).index(common[1])] = _SECOND_LEAST
    whole: Array = covariance + np.diag(least**2)
    return whole


def _astray(sweeps: Sequence[SweepReading], names: Sequence[str], *, loss: bool) -> Array:
    """Return by how much fits of equal sweeps contradict each other in each mode (a,).

    What all modes of a sweep differ by is the reed's, and does not count.
    """
    alike = loudest(sweeps)
    table = np.full((len(alike), len(names)), np.nan)
    for row, sweep in zip(table, alike, strict=True):
        for column, name in enumerate(names):
            if name in sweep.names:
                at = sweep.names.index(name)
                row[column] = (
                    100 * np.log(sweep.loss_factor[at]) if loss else CENTS * np.log(sweep.hz[at])
                )
    told = np.isfinite(table).sum(axis=0) > 1
    if not told.any():
        return np.zeros(len(names))
    table = table[np.isfinite(table[:, told]).any(axis=1)]
    apart = np.zeros_like(table)
    apart[:, told] = table[:, told] - np.nanmean(table[:, told], axis=0)
    apart -= np.nanmedian(apart[:, told], axis=1, keepdims=True)
    scatter = np.sqrt(np.nanmean(np.where(told, apart, 0.0) ** 2, axis=0))
    usual = _USUAL_LOSS if loss else _USUAL_CENTS
    astray: Array = np.where(scatter > 3 * usual, scatter, 0.0)
    return astray


def _of_leaks(
    leaks: Leaks, sweep: SweepReading, modes: NDArray[np.intp], lowest: Sequence[bool]
) -> Array:
    """Covariance of what leaks in makes of one sweep's fit.

    Parameters
    ----------
    leaks : Leaks
    sweep : SweepReading
    modes : (a,) int
        Which of its modes.
    lowest : (a,) bool
        Whether it is the lowest of all sweeps.
    """
    carrier = leaks.carrier.get(sweep.name, 0.0)
    share = np.hypot(carrier, leaks.mixing)
    errors = np.repeat([_LEAK_CENTS * share, _LEAK_LOSS * share], len(modes))
    if sweep.taken_off:
        near = _near(np.log2(sweep.drive_hz / sweep.hz[modes, None]), _NEAR)
        moves = [np.median(sweep.amplitude_rad[there]) for there in near]
        stays = carrier * np.median(sweep.amplitude_rad) / np.array(moves)
        stays *= np.where(lowest, _STAYS_LOWEST, 1.0)
        errors = np.hypot(errors, np.concatenate([_STAYS_CENTS * stays, _STAYS_LOSS * stays]))
    return np.diag(np.square(errors))


def _near(apart: Array, limit: float) -> NDArray[np.bool_]:
    """Which steps (..., k) are near, and at least the nearest: they may all be wider apart."""
    distance = np.abs(apart)
    near: NDArray[np.bool_] = (distance < limit) | (
        distance == distance.min(axis=-1, keepdims=True)
    )
    return near


def _in_common(
    rows: Sequence[tuple[int, str, str]], common: Sequence[str], sweeps: Sequence[SweepReading]
) -> Array:
    """Covariance of what all sweeps, those of one clamping and of one level have in common."""
    names = np.array([common.index(name) for _, name, _ in rows])
    loss = np.array([what.startswith("loss") for _, _, what in rows])
    sweep = np.array([number for number, _, _ in rows])
    hz = np.array([sweeps[0].hz[sweeps[0].names.index(name)] for name in common])[names]
    same = (names[:, None] == names) & (loss[:, None] == loss)
    method = np.where(loss, _LOSS, np.where(hz > 12e3, _METHOD_HIGH_CENTS, _METHOD_CENTS))
    method = np.where((names == 0) & loss, _LOWEST_LOSS, method)
    covariance = same * method[:, None] * method
    clamping = np.array([s.clamping for s in sweeps])[sweep]
    for one in sorted(set(clamping.tolist()) - {0}):
        there = (clamping == one) & ~loss
        bends = there * _CLAMP_CENTS / (1 + names / _CLAMP_FALL)
        lossy = np.where(names == 1, _SECOND_LOSS, _CLAMP_LOSS)
        own = np.where(clamping == one, np.where(loss, lossy, _CLAMP_OWN), 0.0)
        covariance += np.multiply.outer(bends, bends) + same * np.multiply.outer(own, own)
    levels = _levels([s.loudness for s in sweeps])
    level = levels[sweep]
    for one in range(int(levels.max())):
        lossy = np.where(names == 1, _SECOND_LOSS, _LEVEL_LOSS)
        own = np.where(loss, lossy, _LEVEL_CENTS)
        there = np.where(level == one, own, 0.0)
        covariance += same * np.multiply.outer(there, there)
    return np.asarray(covariance)


def _levels(loudness: Sequence[float]) -> NDArray[np.intp]:
    """Number of each sweep's level (s,), the quietest first."""
    order = np.argsort(loudness)
    steps = np.diff(np.array(loudness)[order]) > SAME_LEVEL
    levels = np.zeros(len(order), dtype=np.intp)
    levels[order[1:]] = np.cumsum(steps)
    return levels


def _prediction(
    rows: Sequence[tuple[int, str, str]],
    common: Sequence[str],
    sweeps: Sequence[SweepReading],
    reed_solver: ReedSolver,
) -> Callable[[BenchParameters], Array]:
    names = np.array([common.index(name) for _, name, _ in rows])
    loss = np.array([what.startswith("loss") for _, _, what in rows])
    found = [dict(zip(s.names, s.hz.tolist(), strict=True)) for s in sweeps]
    times_s, deepest_rad = np.empty(len(rows)), np.empty(len(rows))
    for r, (s, name, _) in enumerate(rows):
        sweep, log_hz = sweeps[s], np.log(found[s][name])
        times_s[r] = float(np.interp(log_hz, np.log(sweep.drive_hz), sweep.time_s))
        near = _near(np.log(sweep.drive_hz) - log_hz, _AT_RESONANCE)
        deepest_rad[r] = float(np.max(sweep.deepest_rad[near]))
    nominal = BenchParameters()
    by_E, by_G = (_slope(reed_solver, nominal, modulus, common) for modulus in ("E_L", "G_LT"))

    def predict(parameters: BenchParameters) -> Array:
        modes = reed_solver.modes(parameters.reed)
        missing = [name for name in common if name not in modes]
        if missing:
            raise ImpossibleReedError(f"a reed of this kind has no mode {missing[0]}")
        hz = np.array([modes[name].hz for name in common])[names]
        eta = np.array([modes[name].loss_factor for name in common])[names]
        around = parameters.environment
        change = change_of_cane(parameters.reed.cane, around, condition_at(around, times_s), hz)
        shift = by_E[names] * change.E_L + by_G[names] * change.G_LT
        shift = shift + 0.5 * hardened(around, deepest_rad)
        cents, log = np.array([parameters.fit_bias.of(name) for name in common]).T
        answer: Array = np.where(
            loss,
            100 * (np.log(eta) + change.loss + log[names]),
            CENTS * (np.log(hz) + shift) + cents[names],
        )
        return answer

    return predict


def _slope(
    reed_solver: ReedSolver, parameters: BenchParameters, modulus: str, names: Sequence[str]
) -> Array:
    """Derivatives of log frequencies by the log of a modulus."""
    ahead, behind = (
        reed_solver.modes(with_cane(parameters, **{modulus: sign * _STEP}).reed) for sign in (1, -1)
    )
    return np.array([np.log(ahead[n].hz / behind[n].hz) / (2 * _STEP) for n in names])


def _modes(readings: Readings, reed_solver: ReedSolver) -> ObservableGroup | None:
    sweeps = readings.sweeps
    return modes_group(sweeps, reed_solver, leaks_of(readings)) if sweeps else None


SOURCES: Final = (GroupSource(16, _modes),)
