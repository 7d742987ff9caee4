"""Tests of an object field that drifts smoothly from hologram to hologram."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.holograms.object_field import (
    CommonModeError,
    log_field_factor,
    of_low_degree,
    smooth_functions,
)
from fitting.modal.field_drift import (
    covariance_by_other_changes,
    field_drift,
    found_walk,
    likeliest_step,
    magnitude_error,
    shared_error,
    steady,
)
from fitting.modal.fit import _begun, _model, fit_roughly
from fitting.modal.losses import shared_drift
from tests.fitting.modal.test_fit import DRIVE_HZ, MODE_HZ, NAMES, planted

HOLOGRAMS, AMPLITUDES, ERRORS = 61, 4, 131


@pytest.fixture
def common_mode():
    rng = np.random.default_rng(2)
    root = rng.standard_normal((HOLOGRAMS, ERRORS, 3))
    return CommonModeError(
        rng.standard_normal((HOLOGRAMS, 2 * AMPLITUDES, ERRORS)),
        root @ root.swapaxes(1, 2),
        rng.standard_normal((HOLOGRAMS, ERRORS)),
    )


@pytest.fixture
def drift(common_mode):
    return field_drift(common_mode, np.random.default_rng(3).permutation(HOLOGRAMS))


def test_errors_of_a_hologram_are_its_response_to_the_shift_there(common_mode, drift):
    parameters = np.random.default_rng(4).standard_normal(drift.constant + 6 * len(drift.drifting))
    shared = shared_error(common_mode, drift, 1e-3)
    expected = np.einsum("kxq,kq->kx", common_mode.response, drift.shift(parameters))
    columns = drift.columns(shared.response.transpose(2, 1, 0))
    assert np.einsum("pxk,p->kx", columns, parameters) == pytest.approx(expected)


def test_sums_over_holograms_are_those_of_the_columns(common_mode, drift):
    values = common_mode.response.transpose(2, 1, 0)
    columns = drift.columns(values)
    assert len(columns) == drift.parameters
    gathered = drift.gathered(values.swapaxes(0, 1))
    assert gathered == pytest.approx(columns.sum(axis=-1).T)
    products = np.einsum("qxk,rxk->qrk", values, values)
    expected = np.einsum("pxk,sxk->ps", columns, columns)
    assert drift.products(products) == pytest.approx(expected)


def test_the_covariance_of_a_shift_is_that_of_its_combinations(drift):
    size = drift.constant + 6 * len(drift.drifting)
    root = np.random.default_rng(7).standard_normal((size, 3))
    shifts = np.stack([drift.shift(column) for column in root.T])
    expected = np.einsum("skq,skr->kqr", shifts, shifts)
    assert drift.covariance(root @ root.T) == pytest.approx(expected)


def test_the_precision_is_that_of_holograms_and_of_the_walk(common_mode, drift):
    """Squares of the shift as each hologram counts them, and of the changes between nodes."""
    walk = 3e-3
    parameters = np.random.default_rng(5).standard_normal(drift.constant + 6 * len(drift.drifting))
    shift, nodes = drift.shift(parameters), parameters[drift.constant :].reshape(6, -1)
    by_holograms = np.einsum("kq,kqr,kr->", shift, common_mode.precision, shift)
    constant = np.sum(parameters[: drift.constant] ** 2)
    by_walk = np.sum(np.diff(nodes, axis=0) ** 2) / drift.spacing / walk**2
    by_mean = np.sum(nodes.mean(axis=0) ** 2) / walk**2
    found = parameters @ shared_error(common_mode, drift, walk).precision @ parameters
    assert found == pytest.approx(by_holograms + constant + by_walk + by_mean)


def test_the_pull_of_holograms_is_gathered_along_the_drift(common_mode, drift):
    parameters = np.random.default_rng(9).standard_normal(drift.constant + 6 * len(drift.drifting))
    expected = np.sum(common_mode.pull * drift.shift(parameters))
    assert parameters @ shared_error(common_mode, drift, 1e-3).pull == pytest.approx(expected)


def test_holograms_recorded_one_after_the_other_have_nearly_the_same_shift(common_mode):
    ranks = np.random.default_rng(8).permutation(HOLOGRAMS)
    drift = field_drift(common_mode, ranks)
    assert drift.share.sum(axis=1) == pytest.approx(np.ones(HOLOGRAMS))
    in_order = drift.share[np.argsort(ranks)]
    assert np.abs(np.diff(in_order, axis=0)).max() == pytest.approx(1 / drift.spacing)
    assert in_order[0, 0] == in_order[-1, -1] == 1


def test_what_drifts_are_polynomials_of_the_first_to_the_third_degree():
    rng = np.random.default_rng(9)
    x, y = rng.uniform(-1, 1, (2, 300))
    cubic = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    smooth, low = smooth_functions(x, y), of_low_degree(3)
    assert len(low) == 9 + 9
    for parameter in range(ERRORS):
        log_factor = log_field_factor(smooth, np.eye(ERRORS)[parameter])
        left = log_factor - cubic @ np.linalg.lstsq(cubic, log_factor, rcond=None)[0]
        # A uniform magnitude would shrink displacements and their residuals together.
        uniform = np.abs(log_factor - log_factor.mean()).max() < 1e-9
        assert (np.abs(left).max() < 1e-9 and not uniform) == (parameter in low)


def test_the_walk_is_found_from_what_is_known_of_it(drift):
    rng = np.random.default_rng(6)
    count, walk = len(drift.drifting), 4e-3
    parameters = np.zeros(drift.constant + 6 * count)
    changes = walk * np.sqrt(drift.spacing) * rng.standard_normal((5, count))
    parameters[drift.constant :] = np.concatenate(
        [np.zeros((1, count)), np.cumsum(changes, axis=0)]
    ).ravel()
    known = np.zeros((len(parameters), len(parameters)))
    for start in (1e-3, 1e-2):
        assert found_walk(drift, parameters, known, start) == pytest.approx(walk, rel=0.15)


def test_the_magnitude_is_known_near_holograms_that_tell_it(common_mode):
    """From there it walks, as far as the parts that change along an axis do, whatever others do."""
    rng, ranks = np.random.default_rng(8), np.random.default_rng(9).permutation(HOLOGRAMS)
    drift, step = field_drift(common_mode, ranks), 4e-3
    nodes = drift.share.shape[1]
    along = np.isin(drift.drifting, of_low_degree(1))
    assert np.count_nonzero(along) == 4
    size = np.where(along, step, 0.1 * step) * np.sqrt(drift.spacing)
    walks = np.cumsum(size * rng.standard_normal((nodes, len(along))), axis=0)
    walks -= walks.mean(axis=0)
    parameters = np.concatenate([np.zeros(drift.constant), walks.ravel()])
    sure = 1e-10 * np.eye(len(parameters))
    telling = replace(common_mode, precision=np.zeros_like(common_mode.precision))
    telling.precision[np.flatnonzero(ranks < 20), 0, 0] = 0.02**-2
    found = magnitude_error(drift, telling, ranks, parameters, sure, 1e-3)
    walked = found_walk(drift, parameters, sure, 1e-3)
    in_turn = found[np.argsort(ranks)]
    # Long after the last of them it is known as there, and as far as it may have walked since.
    used = np.sqrt((in_turn[60] ** 2 - in_turn[19] ** 2) / 41)
    assert used == pytest.approx(step, rel=0.4)
    assert used > 1.5 * walked
    later = in_turn[19:] ** 2 - in_turn[19] ** 2
    assert later == pytest.approx(used**2 * np.arange(42), rel=1e-3, abs=1e-12)
    # Among them, as well as what some of them say together.
    assert 0.2 * 0.02 < in_turn[10] < 0.7 * 0.02


@pytest.mark.parametrize("fitted_with", [5e-4, 2e-3, 8e-3])
def test_the_step_of_some_values_is_found_whatever_they_were_fitted_with(drift, fitted_with):
    """Nodes are measured with errors as large as their steps, and fitted with another prior."""
    rng, count, nodes, step = np.random.default_rng(10), len(drift.drifting), 6, 3e-3
    some = np.arange(0, count, 2)
    walks = step * np.sqrt(drift.spacing) * rng.standard_normal((nodes, count))
    true = np.cumsum(walks, axis=0)
    true -= true.mean(axis=0)
    error = 0.7 * step * np.sqrt(drift.spacing)
    measured = true + error * rng.standard_normal(true.shape)
    differences = np.diff(np.eye(nodes), axis=0)
    held = differences.T @ differences / drift.spacing + np.full((nodes, nodes), 1 / nodes**2)
    posterior = np.linalg.inv(np.eye(nodes) / error**2 + held / fitted_with**2)
    parameters = np.concatenate(
        [np.zeros(drift.constant), (posterior @ measured / error**2).ravel()]
    )
    covariance = np.eye(len(parameters))
    covariance[drift.constant :, drift.constant :] = np.kron(posterior, np.eye(count))
    found = likeliest_step(drift, parameters, covariance, fitted_with, some)
    assert found == pytest.approx(step, rel=0.3)


def test_nothing_drifts_where_nothing_is_shared():
    nothing = CommonModeError(np.zeros((9, 8, 0)), np.zeros((9, 0, 0)), np.zeros((9, 0)))
    drift = field_drift(nothing, np.arange(9))
    assert drift.shift(np.zeros(0)).shape == (9, 0)
    assert shared_error(nothing, drift, 1e-3).precision.shape == (0, 0)
    assert found_walk(drift, np.zeros(0), np.zeros((0, 0)), 2e-3) == 2e-3


@pytest.mark.parametrize("before", [0, 3])
def test_changes_that_nodes_do_not_follow_are_errors_of_what_follows_light(common_mode, before):
    rng, walk, draws, numbers = np.random.default_rng(10), 4e-3, 1500, 3
    ranks = rng.permutation(HOLOGRAMS)
    drift = field_drift(common_mode, ranks)
    own = drift.drifting
    others = np.setdiff1d(np.arange(1, ERRORS), own)
    root = 1e-3 * rng.standard_normal((ERRORS, ERRORS))
    following = rng.standard_normal((numbers, HOLOGRAMS, ERRORS))
    # Each number follows some neighbours, as that of a mode does.
    following *= np.exp(-0.5 * ((np.arange(HOLOGRAMS) - 30) / 4) ** 2)[:, None]
    drawn = np.zeros((draws, numbers))
    for draw in drawn:
        steps = rng.standard_normal((HOLOGRAMS, ERRORS))
        light = np.cumsum(steps @ root.T, axis=0)[ranks]
        light[:, own] = np.cumsum(walk * steps[:, own], axis=0)[ranks]
        nodes = np.linalg.lstsq(drift.share, light[:, own], rcond=None)[0]
        light[:, own] -= drift.share @ nodes
        light[:, others] -= light[:, others].mean(axis=0)
        light[:, 0] = 0
        draw[:] = np.sum(following * light, axis=(1, 2))
    shared = replace(drift, constant=ERRORS + before, drifting=own + before)
    found = covariance_by_other_changes(shared, ranks, root @ root.T, walk, following)
    size = np.sqrt(np.diag(found))
    # 1500 draws: a covariance has a standard error of 4 %.
    assert np.cov(drawn.T) / np.outer(size, size) == pytest.approx(
        found / np.outer(size, size), abs=0.15
    )


def test_the_power_of_the_laser_is_no_change_of_light(drift):
    """It is the uniform magnitude, the first parameter, and a gain of each hologram."""
    following = np.zeros((1, HOLOGRAMS, ERRORS))
    following[:, ::2, 0] = 1.0
    ranks, renewal = np.arange(HOLOGRAMS), np.eye(ERRORS)
    assert not covariance_by_other_changes(drift, ranks, renewal, 1e-3, following).any()
    following[:, ::2, ERRORS - 1] = 1.0
    assert covariance_by_other_changes(drift, ranks, renewal, 1e-3, following) > 0


def test_a_fit_begins_in_steady_light(common_mode):
    """Drift begins at none, with what all holograms share as it was found without."""
    sweep, rng = planted(2), np.random.default_rng(12)
    found, starts = sweep.displacements, dict(zip(NAMES[:5], MODE_HZ[:5].tolist(), strict=True))
    holograms, size = len(DRIVE_HZ), 2 * found.amplitude_rad.shape[1]
    light = CommonModeError(
        0.1 * rng.standard_normal((holograms, size, ERRORS)),
        np.tile(100 * np.eye(ERRORS), (holograms, 1, 1)),
        rng.standard_normal((holograms, ERRORS)),
    )
    found = replace(found, common_mode=light, recording_rank=np.arange(holograms))
    drift = shared_drift(found)
    assert drift.parameters > drift.constant > ERRORS
    states = []
    for each in (drift, steady(drift)):
        model, centre_hz = _model(sweep.basis, DRIVE_HZ, sweep.volts, starts)
        _, given, state = _begun(model, found, each, centre_hz)
        assert given.drift is each
        assert len(state.shared) == each.parameters
        states.append(state)
    assert not states[0].shared[drift.constant :].any()
    assert np.count_nonzero(states[0].shared[: drift.constant]) > 100
    assert states[0].shared[: drift.constant].tolist() == states[1].shared.tolist()
    assert states[0].x.tolist() == states[1].x.tolist()
    rough = fit_roughly(found, sweep.basis, DRIVE_HZ, sweep.volts, starts)
    assert np.ptp(rough.common_mode_shift, axis=0).max() > 0
