"""Frequencies and losses of all modes in all sweeps."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from diagnosis.inference.nuisances import USUAL_COMPLIANCE_M_PA
from diagnosis.observable_groups import (
    DISORDER,
    MEASURED,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    ObservableGroup,
    band_of,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.observables.carrier import Leaks
from diagnosis.observables.light import leaks_of
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import SweepReading, common_modes, loudest, reference_of
from holography.arrays import Array
from physics.alterations import MovedClamp, YieldingClamp
from physics.conditions import change_of_cane, condition_at, hardened
from physics.errors import ImpossibleReedError
from physics.mechanics import ReedSolver
from physics.parameters.disorder import BY_NAME
from physics.parameters.tree import BenchParameters, with_alteration, with_cane

CENTS = 1200 / np.log(2)
# Error of a fit that another sweep of the same reed does not share, as a share of its standard
# error, with the weight of four degrees of freedom (decision 0047: light and vibration are
# confounded in the same way in all sweeps). Chosen where sweeps are few; replicates take over.
_OWN, _BELIEVED = 0.5, 4.0
# Largest such share of which the rest is shared. Chosen: the rest must not vanish.
_MOST_OWN = 0.99
# Conditions that differ by less than this share are one. Chosen: rounding.
_SEPARATE = 1e-9
# Fits agree at least to this: cents, per cent. Chosen: rounding of the search.
_LEAST_CENTS, _LEAST_LOSS = 0.05, 0.1
# Temperature of a room from sweep to sweep, and what frequencies and losses follow it by: moduli of
# wood fall by 0.2 to 0.5 % per degree (Gerhards, Wood Fiber 14, 4 (1982)).
_ROOM_C, _CENTS_C, _LOSS_C = 0.5, 3.0, 1.0
# What a mode is off by although the reed is right: finer maps of thickness than the nuisances have
# (decision 0024: elements by 0.5), cents; losses of modes in one cane, per cent: clamp and air.
_DETAIL_CENTS, _LOSS = 2.0, 6.0
# A person puts a reed back within this share of what clamps of several people differ by; and of
# each mode by itself: cents, per cent.
_PUT_BACK, _CLAMP_CENTS, _CLAMP_LOSS = 0.5, 0.5, 1.5
# Light that leaks in, per its share of what moves: cents, per cent.
_LEAK_CENTS, _LEAK_LOSS = 15.0, 40.0
# What may stay of light that was taken off, per its share of what moves near a resonance: cents,
# per cent; by how much more of the lowest mode; and how near, in octaves.
_STAYS_CENTS, _STAYS_LOSS, _STAYS_LOWEST, _NEAR = 60.0, 50.0, 4.0, 0.15
_QUANTITIES = "frequency, cents", "loss, %"
# So near in log frequency the reed moves as much as at its resonance.
_AT_RESONANCE = 0.03
_STEP = 0.01
# Moduli that the condition of a reed changes, those that change together in one entry.
_MODULI = ("E_L",), ("G_LT",), ("E_T", "E_R", "G_LR", "G_TR")


def modes_group(
    sweeps: Sequence[SweepReading], reed_solver: ReedSolver, leaks: Leaks, nominal: BenchParameters
) -> ObservableGroup | None:
    """Compare frequencies (cents) and losses (per cent) of all sweeps with the model.

    None if sweeps have no mode in common.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    reed_solver : ReedSolver
    leaks : Leaks
    nominal : BenchParameters
        With the cane of the sweeps' series.
    """
    known = reed_solver.modes(nominal.reed)
    common = [name for name in common_modes(sweeps) if name in known]
    if not common:
        return None
    moved = np.stack([_slope(reed_solver, nominal, own, common) for own in _MODULI], axis=1)
    # The other moduli move little, and few modes do not tell them apart.
    shares = _own_shares(sweeps, common, moved[:, :2])
    values, places, rows, pieces = [], [], [], []
    loud = loudest(sweeps)
    for number, sweep in enumerate(sweeps):
        here = [name for name in common if name in sweep.names]
        at = np.array([sweep.names.index(name) for name in here], dtype=int)
        values += list(CENTS * np.log(sweep.hz[at])) + list(100 * np.log(sweep.loss_factor[at]))
        for what in _QUANTITIES:
            for name, hz in zip(here, sweep.hz[at], strict=True):
                places.append(
                    Coordinates(what, mode=name, band=band_of(float(hz)), time=sweep.name)
                )
                rows.append((number, name, what))
        # Sweeps of another level or clamping end in optima of their own.
        own = _of_modes(shares, [common.index(name) for name in here])
        own = own if sweep in loud else np.maximum(own, 1.0)
        pieces.append(own[:, None] * _of_fit(sweep, at) * own)
        pieces[-1] += _of_leaks(leaks, sweep, at, [name == common[0] for name in here])
    noise = block_diag(*pieces)
    nuisances = _nuisances(rows, common, sweeps, reed_solver, nominal, shares)
    predict = _prediction(rows, common, sweeps, reed_solver, moved)
    parts = ("reed", "environment")
    errors = Errors(noise, nuisances, of_fits=True)
    return observable_group("modes", Observable.MODES, values, errors, places, parts, predict)


def _of_fit(sweep: SweepReading, at: NDArray[np.intp]) -> Array:
    """Covariance (2a, 2a) of one sweep's fit, of chosen modes, in cents and per cent."""
    both = np.concatenate([at, len(sweep.names) + at])
    unit = np.concatenate([np.full(len(at), CENTS), np.full(len(at), 100.0)])
    least = np.concatenate([np.full(len(at), _LEAST_CENTS), np.full(len(at), _LEAST_LOSS)])
    whole: Array = unit[:, None] * sweep.covariance[np.ix_(both, both)] * unit + np.diag(least**2)
    return whole


def _of_modes(shares: Array, modes: Sequence[int]) -> Array:
    """Return shares (2a,) of frequencies and losses of chosen modes."""
    return np.asarray(shares.reshape(2, -1)[:, list(modes)].ravel())


def _own_shares(sweeps: Sequence[SweepReading], common: Sequence[str], moved: Array) -> Array:
    """Return shares (2m,) of fits' standard errors that sweeps do not share with each other.

    Those of the frequencies of all modes, then of their losses, from sweeps of one clamping and
    level: what all modes scatter by together, and each by itself. A fit that has gone wrong in one
    mode of one sweep is seen here, whatever the model says. What changes of moduli move in a sweep
    is the reed's condition, and does not count; that of E_L may grow with frequency, as by drying.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    common : sequence of str
        The m modes.
    moved : (m, 2) float
        Change of log frequencies by the logs of E_L and of G_LT.
    """
    loud = loudest(sweeps)
    found = np.ones((2, len(common)))
    kept = [m for m, name in enumerate(common) if all(name in sweep.names for sweep in loud)]
    at = np.array([[sweep.names.index(common[m]) for m in kept] for sweep in loud], dtype=int)
    hz = np.array([loud[0].hz[loud[0].names.index(common[m])] for m in kept])
    grown = moved[kept, 0] * np.log(hz)
    conditions = np.column_stack([moved[kept], grown]), np.ones((len(kept), 1))
    for number, explained in enumerate(conditions):
        if len(loud) < 2 or len(kept) <= explained.shape[1]:
            continue
        each = [(s.hz, s.loss_factor)[number][i] for s, i in zip(loud, at, strict=True)]
        table = np.log(np.array(each))
        places = [number * len(s.names) + i for s, i in zip(loud, at, strict=True)]
        error = np.array(
            [np.sqrt(np.diag(s.covariance)[i]) for s, i in zip(loud, places, strict=True)]
        )
        squares, freedoms = _scatter(table, error, explained)
        all_squares = np.sum(squares) + _BELIEVED * _OWN**2
        every = np.minimum(all_squares / (np.sum(freedoms) + _BELIEVED), 1.0)
        found[number] = np.sqrt(every)
        found[number, kept] = np.sqrt((squares + _BELIEVED * every) / (freedoms + _BELIEVED))
    return np.asarray(found.ravel())


def _scatter(table: Array, error: Array, explained: Array) -> tuple[Array, Array]:
    """Return squares (m,) of what m numbers scatter by over sweeps (s, m), and their freedoms.

    In units of the errors, without the mean of each number and what columns (m, c) explain of all
    numbers of a sweep.
    """
    apart = table - np.average(table, axis=0, weights=error**-2)
    squares, freedoms = np.zeros(table.shape[1]), np.zeros(table.shape[1])
    for one, own in zip(apart, error, strict=True):
        axes, sizes, _ = np.linalg.svd(explained / own[:, None], full_matrices=False)
        axes = axes[:, sizes > _SEPARATE * sizes[0]]
        left = one / own - axes @ (axes.T @ (one / own))
        squares += left**2
        freedoms += 1 - np.sum(axes**2, axis=1)
    return squares, freedoms * (1 - 1 / len(table))


def _nuisances(
    rows: Sequence[tuple[int, str, str]],
    common: Sequence[str],
    sweeps: Sequence[SweepReading],
    reed_solver: ReedSolver,
    nominal: BenchParameters,
    shares: Array,
) -> tuple[GroupNuisances, ...]:
    """Return what sweeps have in common, and what a new clamping changes."""
    modes = np.array([common.index(name) for _, name, _ in rows])
    loss = np.array([what.startswith("loss") for _, _, what in rows])
    sweep = np.array([number for number, _, _ in rows])
    each = np.eye(2 * len(common))[modes + len(common) * loss]
    reference = reference_of(sweeps)
    at = np.array([reference.names.index(name) for name in common], dtype=int)
    in_common = np.sqrt(1 - np.minimum(shares, _MOST_OWN) ** 2)
    fit = in_common[:, None] * np.linalg.cholesky(_of_fit(reference, at))
    detail = np.where(loss, _LOSS, _DETAIL_CENTS)[:, None] * each
    warmth = np.where(loss, _LOSS_C, _CENTS_C)[:, None] * np.eye(len(sweeps))[sweep] * _ROOM_C
    found = [
        GroupNuisances("fit", each @ fit, MEASURED, "standard errors of fits, by coverage"),
        GroupNuisances("detail of the reed", detail, DISORDER, "decision 0024"),
        GroupNuisances("temperature of sweeps", warmth, DISORDER, "Gerhards (1982)"),
    ]
    clamping = np.array([s.clamping for s in sweeps])[sweep]
    columns = []
    for one in sorted(set(clamping.tolist()) - {0}):
        there = clamping == one
        own = np.where(loss, _CLAMP_LOSS, _CLAMP_CENTS)[:, None] * each * there[:, None]
        columns += [*_put_back(reed_solver, nominal, common)[:, modes] * (there & ~loss), *own.T]
    if columns:
        table = np.stack(columns, axis=1)
        found.append(GroupNuisances("clamping", table, DISORDER, "reeds are put back by hand"))
    return tuple(found)


def _put_back(reed_solver: ReedSolver, nominal: BenchParameters, names: Sequence[str]) -> Array:
    """Return cents (c, m) by which modes move if a reed is clamped a little differently."""
    place = BY_NAME["clamp_shift"].ordinary.deviation
    yielding = USUAL_COMPLIANCE_M_PA
    moved = [
        with_alteration(nominal, MovedClamp(), _PUT_BACK * place),
        with_alteration(nominal, YieldingClamp(), _PUT_BACK * yielding),
    ]
    at_rest = reed_solver.modes(nominal.reed)
    return np.array(
        [
            [CENTS * np.log(reed_solver.modes(each.reed)[n].hz / at_rest[n].hz) for n in names]
            for each in moved
        ]
    )


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


def _prediction(
    rows: Sequence[tuple[int, str, str]],
    common: Sequence[str],
    sweeps: Sequence[SweepReading],
    reed_solver: ReedSolver,
    moved: Array,
) -> Callable[[BenchParameters], Array]:
    names = np.array([common.index(name) for _, name, _ in rows])
    loss = np.array([what.startswith("loss") for _, _, what in rows])
    found = [dict(zip(s.names, s.hz.tolist(), strict=True)) for s in sweeps]
    times_s, deepest_rad, assumed = (np.empty(len(rows)) for _ in range(3))
    for r, (s, name, _) in enumerate(rows):
        assumed[r] = sweeps[s].stiffening[sweeps[s].names.index(name)]
        sweep, log_hz = sweeps[s], np.log(found[s][name])
        times_s[r] = float(np.interp(log_hz, np.log(sweep.drive_hz), sweep.time_s))
        near = _near(np.log(sweep.drive_hz) - log_hz, _AT_RESONANCE)
        deepest_rad[r] = float(np.max(sweep.deepest_rad[near]))
    by_E, by_G, by_others = moved.T

    def predict(parameters: BenchParameters) -> Array:
        modes = reed_solver.modes(parameters.reed)
        missing = [name for name in common if name not in modes]
        if missing:
            raise ImpossibleReedError(f"a reed of this kind has no mode {missing[0]}")
        hz = np.array([modes[name].hz for name in common])[names]
        grown = np.array([modes[name].stiffening for name in common])[names]
        eta = np.array([modes[name].loss_factor for name in common])[names]
        # As fits see it, which take the growth of mean cane.
        eta = eta * (2 - assumed) / (2 - grown)
        around = parameters.environment
        change = change_of_cane(parameters.reed.cane, around, condition_at(around, times_s), hz)
        shift = by_E[names] * change.E_L + by_G[names] * change.G_LT
        shift = shift + by_others[names] * change.others
        shift = shift + 0.5 * hardened(around, deepest_rad)
        answer: Array = np.where(
            loss, 100 * (np.log(eta) + change.loss), CENTS * (np.log(hz) + shift)
        )
        return answer

    return predict


def _slope(
    reed_solver: ReedSolver,
    parameters: BenchParameters,
    moduli: Sequence[str],
    names: Sequence[str],
) -> Array:
    """Derivatives of log frequencies by the logs of moduli that change together."""
    ahead, behind = (
        reed_solver.modes(with_cane(parameters, **dict.fromkeys(moduli, sign * _STEP)).reed)
        for sign in (1, -1)
    )
    return np.array([np.log(ahead[n].hz / behind[n].hz) / (2 * _STEP) for n in names])


def _modes(readings: Readings, reed_solver: ReedSolver) -> ObservableGroup | None:
    sweeps = readings.sweeps
    if not sweeps:
        return None
    return modes_group(sweeps, reed_solver, leaks_of(readings), readings.nominal)


SOURCES: Final = (GroupSource(16, _modes),)
