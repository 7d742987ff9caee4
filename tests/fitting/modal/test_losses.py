"""Modes that are not in phase, because of what shear and the clamp lose, and because of sound."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg
from scipy.optimize import linear_sum_assignment

from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import _COMPLIANCE_M_PA, _yielding, shape_basis
from fitting.modal import rounds
from fitting.modal.field_drift import FIRST_WALK
from fitting.modal.fit import _again, _model, fit_roughly
from fitting.modal.identify import MeasuredSweep, finished
from fitting.modal.losses import (
    between_modes,
    connected,
    forms_of,
    resonances,
    shared_drift,
    turned_shapes,
    with_loss_parameters,
)
from fitting.modal.model import Forms, expected_loss, own_resonances
from fitting.modal.rounds import Optimum, Scatter, one_round
from physics.reed.cane.material import terms_and_slopes
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.reduced.changes import yielding_clamp
from physics.reed.reduced.derivatives import DENSITY, derivatives
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.vibrations import vibrations
from tests.fitting.modal.test_fit import DRIVE_HZ, MODE_HZ, NAMES, planted, response
from tests.fitting.modal.test_rounds import begun
from tests.numbers import cents

# Loss factors of the literature differ by about this.
DIFFERENCE = 0.025


# Shapes of four masses: their frequencies, and their deflections for unit mass.
FEW_HZ, LARGEST = np.array([1000.0, 1700.0, 2500.0, 2520.0]), np.array([3.0, 5.0, 2.0, 7.0])
SQUARES = (2 * np.pi * FEW_HZ) ** 2


def few_forms(stiffness):
    """Forms of a part of the stiffness, between shapes of unit mass."""
    shares = stiffness / np.sqrt(np.outer(SQUARES, SQUARES))
    none = np.zeros((1, 4, 4))
    return Forms(np.stack([shares, 0 * shares]), none, LARGEST / np.sqrt(SQUARES))


def lossy_part(seed):
    root = np.random.default_rng(seed).standard_normal((4, 4))
    return root @ root.T * (2 * np.pi * 700) ** 2


@pytest.mark.parametrize("hz", [1000.0, 1690.0, 2510.0, 3000.0])
def test_modes_move_each_other_as_in_the_complex_stiffness(hz):
    """Compared with the response of a system of four masses."""
    part, loss = lossy_part(2), np.array([0.03, 0.02, 0.04, 0.03])
    (between, clamp), _ = between_modes(few_forms(part), np.eye(4))
    assert not clamp.any()
    force = np.array([1.0, -2.0, 0.5, 1.5])
    stiffness = np.diag(SQUARES * (1 + 1j * loss)) + 1j * DIFFERENCE * part
    exact = LARGEST * linalg.solve(stiffness - (2 * np.pi * hz) ** 2 * np.eye(4), force)
    dynamic = np.diag(1 + 1j * loss - (hz / FEW_HZ) ** 2) + 1j * DIFFERENCE * between
    assert linalg.solve(dynamic, force * LARGEST / SQUARES) == pytest.approx(exact, rel=1e-9)


def connected_model(close_hz):
    """A model and a state of modes that shear connects, of which two are close."""
    sweep = out_of_phase(
        2, mode_hz=np.array([2050.0, 3100.0, 4300.0, 6300.0 - close_hz, 6300.0, 11000.0])
    )
    model, _, state = begun(with_own_sound(sweep))
    shared = state.shared.copy()
    shared[:3] = DIFFERENCE, 0.01, 0.8
    return connected(model, state), replace(state, shared=shared)


@pytest.mark.parametrize("close_hz", [1000.0, 20.0])
def test_resonances_are_those_of_the_connected_modes(close_hz):
    """Determinants of the dynamic stiffness at complex frequencies; derivatives by differences."""
    model, state = connected_model(close_hz)
    found, count = resonances(model, state), len(model.active)
    own_hz, own_loss = own_resonances(model, state)
    moved = found.logs - np.log(np.concatenate([own_hz[:count], own_loss[:count]]))
    # Where modes are apart, connections are of second order.
    assert (np.abs(moved).max() < 1e-3) == (close_hz > 100)
    at = np.abs(np.log(model.hz[:, None] / own_hz)).argmin(axis=0)
    sound = model.sound[at, np.arange(len(at))]
    between = np.tensordot(state.shared[:2], model.losses, axes=1) + state.shared[2] * sound
    for log_hz, log_loss in found.logs.reshape(2, -1).T:
        square = np.exp(2 * log_hz) * (1 + 1j * np.exp(log_loss))
        dynamic = np.diag(1 + 1j * own_loss - square / own_hz**2) + 1j * between
        assert linalg.svdvals(dynamic)[-1] < 1e-12
    step, slopes = 1e-6, []
    for slot in range(2 * count + 3):
        ends = []
        for sign in (1, -1):
            x, shared = state.x.copy(), state.shared.copy()
            if slot < 2 * count:
                x[slot % count, 2 * model.powers.shape[1] + slot // count] += sign * step
            else:
                shared[slot - 2 * count] += sign * step
            ends.append(resonances(model, replace(state, x=x, shared=shared)).logs)
        slopes.append((ends[0] - ends[1]) / (2 * step))
    assert found.slopes == pytest.approx(np.array(slopes).T, abs=1e-6 * np.abs(slopes).max())


@pytest.mark.parametrize("turn", [-0.6, 0.1, 0.6, 1.2])
def test_losses_connect_modes_that_exchange_shapes_by_what_one_of_them_loses(turn):
    """Two shapes that no loss connects, of which one loses more, turned into each other."""
    part = np.diag(0.3 * SQUARES * np.array([1.0, 1.0, 0.5, 2.0]))
    modes = np.eye(4)
    modes[2:, 2:] = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    # A mode has 1 of its own shape, and shapes have a largest deflection of 1.
    mixing = modes / np.diag(modes)[:, None] * LARGEST / LARGEST[:, None] - np.eye(4)
    forms = few_forms(part)
    (between, _), _ = between_modes(forms, turned_shapes(mixing, forms.scale, FEW_HZ))
    expected = modes @ part @ modes.T / SQUARES[:, None] * LARGEST[:, None] / LARGEST
    # Both shapes are 14 cents apart, and two widths are 104.
    assert between == pytest.approx(expected, rel=0.05, abs=1e-9)
    assert np.count_nonzero(np.abs(between) > 1e-9) == 6


def test_wrong_shapes_turn_no_modes():
    hz, equal = np.array([1000.0, 1010.0, 1500.0]), np.ones(3)
    mixing = np.zeros((3, 3))
    # Each has as much of the other, with the same sign.
    mixing[0, 1] = mixing[1, 0] = 0.3
    assert turned_shapes(mixing, equal, hz) == pytest.approx(np.eye(3), abs=1e-12)
    # Little of the third mode is seen: a wrong shape in the first looks like much of its energy.
    mixing[0, 2], seen = 0.3, np.array([1.0, 1.0, 0.1])
    assert np.abs(turned_shapes(mixing, seen, np.full(3, 1e3))[0, 2]) < 1e-3
    # Modes far apart turn little.
    mixing[1, 0], mixing[2, 0] = -0.3, -0.3
    turned = turned_shapes(mixing, equal, hz)
    assert turned @ turned.T == pytest.approx(np.eye(3))
    assert turned[0, 1] == pytest.approx(np.sin(np.arctan(0.3)), rel=0.05)
    assert 0 < turned[0, 2] < 0.01


def test_they_are_known_as_well_as_literature_knows_them():
    common_mode = CommonModeError(
        np.ones((7, 4, 2)), np.tile(np.eye(2), (7, 1, 1)), np.full((7, 2), 5.0)
    )
    both = with_loss_parameters(common_mode)
    assert both.response.tolist() == common_mode.response.tolist()
    held = both.precision.sum(axis=0)[:5]
    errors = np.array([0.03, 0.03, 0.5, 0.012, 0.3])
    assert held[:, :5] == pytest.approx(np.diag(errors**-2))
    assert not held[:, 5:].any()
    # A free plate and dry cane are expected, and no difference.
    pulls = both.pull[:, :5].sum(axis=0)
    assert pulls == pytest.approx([0.0, 0.0, 0.5**-2, 0.03 / 0.012**2, 0.0])
    assert both.pull[:, 5:].tolist() == common_mode.pull.tolist()


def test_they_are_five_more_values_that_no_hologram_changes():
    displacements = planted().displacements
    drift = shared_drift(displacements)
    shift = drift.shift(np.arange(1.0, drift.parameters + 1))
    assert shift.shape == (len(DRIVE_HZ), 5)
    assert not np.ptp(shift, axis=0).any()


def test_modes_lose_what_cane_clamp_and_sound_lose():
    sweep = with_sound(2, 1.0)
    model, given, state = begun(sweep)
    shares = np.array([[0.1, 0.6, 0.2, 0.5, 0.3, 0.2], [0.02, 0.01, 0.05, 0.0, 0.0, 0.0]])
    sound = model.own_losses[2, :5]
    model = replace(model, own_losses=np.concatenate([shares, model.own_losses[2:]]))
    shared = state.shared.copy()
    shared[:5] = 0.02, -0.1, 0.7, 0.03, 0.25
    found = expected_loss(model, given.prior, replace(state, shared=shared))
    cane = (0.03 + 0.02 * shares[0] - 0.1 * shares[1])[:5]
    expected = cane * (model.reference_hz[:5] / 4000) ** 0.25 + 0.7 * sound
    assert np.exp(found.prior.centre[tuple(found.slots)]) == pytest.approx(expected, rel=1e-12)
    assert found.precision == pytest.approx(np.full(5, 0.15**-2))
    # Sound at the resonance takes what the resistance there does.
    at = np.log(model.reference_hz[4])
    basis = sweep.basis
    resistance = np.interp(at, np.log(basis.sound_hz), basis.sound[:, 4, 4])
    assert sound[4] == pytest.approx(resistance / (2 * np.pi * np.exp(at)), rel=0.05)
    # Nothing loses less than nothing.
    shared[3] = -1.0
    least = expected_loss(model, given.prior, replace(state, shared=shared))
    assert np.exp(least.prior.centre[tuple(least.slots)]) == pytest.approx(np.full(5, 0.003))
    assert not least.slopes.any()


def out_of_phase(seed, cause=0, turn=0.0, mode_hz=MODE_HZ):
    """A planted sweep whose modes are connected by what shear or the clamp loses.

    The last two modes within the sweep are turned into each other by an angle. The response is that
    of the whole system of modes, solved at each frequency.
    """
    sweep = planted(seed, noise=0.005, mixing=0.4 if turn else 0.1, mode_hz=mode_hz)
    count = len(sweep.hz)
    root = np.random.default_rng(100 + seed).uniform(-0.3, 0.3, (count, count))
    shares, modes = root + root.T, np.eye(count)
    np.fill_diagonal(shares, [0.1, 0.6, 0.3, 0.5, 0.2, 0.4])
    if turn:
        # They are of both symmetries.
        shares[3, 4] = shares[4, 3] = 0
        shares[3, 3], shares[4, 4] = 0.1, 0.7
        modes[3:5, 3:5] = [[1.0, np.tan(turn)], [-np.tan(turn), 1.0]]
    largest = 2 * np.pi * sweep.hz
    both = np.zeros((2, count, count))
    both[cause] = shares
    turned = modes / np.linalg.norm(modes, axis=1, keepdims=True)
    losses, _ = between_modes(Forms(both, np.zeros((1, count, count)), np.ones(count)), turned)
    lost = 0.022 * np.eye(count) + DIFFERENCE * losses[cause]
    squares, vectors = linalg.eig(sweep.hz[:, None] ** 2 * (np.eye(count) + 1j * lost))
    energy = np.abs(vectors / largest[:, None]) ** 2
    squares = squares[linear_sum_assignment(-energy / energy.sum(axis=0))[1]]
    shapes = modes @ sweep.shapes
    amplitude = []
    for k, hz in enumerate(DRIVE_HZ):
        system = np.diag(1 - (hz / sweep.hz) ** 2) + 1j * lost
        moved = linalg.solve(system, sweep.participation[k])
        amplitude.append(sweep.drive[k] * moved @ shapes)
    plain = response(sweep.hz, sweep.loss, sweep.participation, sweep.shapes, sweep.drive)
    noise = sweep.displacements.amplitude_rad - plain
    displacements = replace(sweep.displacements, amplitude_rad=np.array(amplitude) + noise)
    basis = replace(sweep.basis, shares=both, largest=largest)
    return replace(
        sweep, hz=np.sqrt(squares.real), loss=squares.imag / squares.real, shapes=shapes,
        displacements=displacements, basis=basis,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("seed", "cause"),
    [
        (3, 0),
        pytest.param(2, 0, marks=pytest.mark.slow),
        pytest.param(2, 1, marks=pytest.mark.slow),
    ],
)
def test_losses_are_right_where_modes_are_out_of_phase(seed, cause):
    sweep = out_of_phase(seed, cause)
    real = replace(sweep, basis=replace(sweep.basis, shares=np.zeros((2, 6, 6))))
    found, without = sweep.fit(), real.fit()
    pulls = [
        np.sqrt(np.mean((np.log(each.loss_factor / sweep.loss[:5]) / each.loss_error) ** 2))
        for each in (found, without)
    ]
    assert pulls[0] < 2
    assert pulls[1] > 4
    assert found.discrepancy < 0.3 * without.discrepancy
    assert found.state.loss_parameters[cause] == pytest.approx(DIFFERENCE, rel=0.1)
    # It is no error of the light.
    assert found.common_mode_shift.shape == (len(DRIVE_HZ), 0)
    assert found.common_mode_covariance.shape == (len(DRIVE_HZ), 0, 0)


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_modes_are_right_where_an_f_mode_and_a_t_mode_exchange_shapes(seed, monkeypatch):
    """What shear loses connects such modes, though it connects no shapes of both symmetries."""
    close_hz = np.array([2050.0, 3100.0, 4300.0, 6290.0, 6300.0, 11000.0])
    sweep = out_of_phase(seed, turn=0.6, mode_hz=close_hz)
    found = sweep.fit()
    monkeypatch.setattr(rounds, "connected", lambda model, _: model)
    without = sweep.fit()
    pulls = [
        np.abs(cents(each.hz, sweep.hz[:5]) / each.error_cents)[3:].max()
        for each in (found, without)
    ]
    assert pulls[0] < 3
    assert pulls[1] > 4
    lost = np.log(found.loss_factor / sweep.loss[:5]) / found.loss_error
    assert np.abs(lost).max() < 3


def test_a_known_fit_starts_with_what_its_modes_lose():
    sweep = out_of_phase(2)
    found, starts = sweep.fit(), dict(zip(NAMES[:5], MODE_HZ[:5].tolist(), strict=True))
    model, centre_hz = _model(sweep.basis, DRIVE_HZ, sweep.volts, starts)
    drift = shared_drift(sweep.displacements)
    _, _, state = _again(model, found, sweep.displacements, drift, centre_hz)
    assert found.state.loss_parameters[0] > 0.5 * DIFFERENCE
    assert state.loss_parameters.tolist() == found.state.loss_parameters.tolist()


def test_the_last_fit_does_not_depend_on_other_numbers_of_a_rough_one():
    sweep = out_of_phase(2)
    starts = dict(zip(NAMES[:5], MODE_HZ[:5].tolist(), strict=True))
    asked = sweep.displacements, sweep.basis, DRIVE_HZ, sweep.volts, starts
    rough = fit_roughly(*asked)
    blocks = SimpleNamespace(drive_hz=DRIVE_HZ, volts=sweep.volts)
    given = MeasuredSweep(blocks, sweep.basis, sweep.displacements, rough, starts)
    other = replace(rough.state, x=-rough.state.x, shared=-rough.state.shared)
    ends = [finished(replace(given, modal=replace(rough, state=s))) for s in (rough.state, other)]
    assert ends[0].modal.hz.tolist() == ends[1].modal.hz.tolist()
    assert ends[0].start_hz == starts
    # Rough frequencies are a start, from which the same is found.
    moved = finished(replace(given, modal=replace(rough, hz=rough.hz * 1.01))).modal
    assert 0 < np.abs(cents(moved.hz, ends[0].modal.hz)).max() < 0.5


# --- Clamp ---------------------------------------------------------------------------------------


def test_the_clamp_takes_from_modes_what_lowers_them_if_it_yields(reed):
    cane = viscoelastic_cane(Components(), Series.A)
    found = vibrations(reed, State(CaneLaw(reed.cane, cane), air_fraction=0.0), 12e3)
    unit = derivatives(found, [yielding_clamp(reed, _COMPLIANCE_M_PA, _COMPLIANCE_M_PA)]).ln_hz
    # What a change of stiffness by its energy does: that of mass is as large.
    expected = unit[:, -1] / unit[:, DENSITY]
    taken, lowest = _yielding(reed), np.zeros(len(found.hz))
    terms, _ = terms_and_slopes(found.state.law.constants_at(found.hz))
    for start, (key, part) in zip(reed.starts, reed.loose.items(), strict=True):
        rows = found.coordinates[start : start + part.held]
        for m in np.flatnonzero(np.abs(rows).max(axis=0) > 0):
            energy = taken(key, terms[m], found.hz[[m]], rows[:, [m]])
            lowest[m] = energy[0, 0] / (2 * np.pi * found.hz[m]) ** 2
    assert np.all(expected > 0)
    assert lowest == pytest.approx(expected, rel=1e-6)


def test_shapes_come_with_what_shear_and_then_the_clamp_mixes(reed, monkeypatch):
    x, y = np.meshgrid(np.linspace(1e-3, 30e-3, 12), np.linspace(-5e-3, 5e-3, 7))
    asked = reed, 14e9, 0.8e9, x.ravel(), y.ravel()
    yielding = shape_basis(*asked).shares
    monkeypatch.setattr("fitting.holograms.shape_basis._COMPLIANCE_M_PA", 0.0)
    rigid = shape_basis(*asked).shares
    assert np.array_equal(rigid[0], yielding[0])
    assert not rigid[1].any()
    assert np.count_nonzero(yielding[1]) == np.count_nonzero(yielding[0]) > 0


# --- Sound ---------------------------------------------------------------------------------------


def with_own_sound(sweep):
    """The same sweep with a basis whose modes send each other sound."""
    rng, count = np.random.default_rng(3), len(sweep.hz)
    sends = rng.uniform(0.5, 1, count) * np.array([1, -1, 1, -1, 1, 1])[:count]
    strength = 0.005 * 2 * np.pi * DRIVE_HZ[[0, -1]]
    sound = strength[:, None, None] * np.outer(sends, sends)
    return replace(sweep, basis=replace(sweep.basis, sound=sound))


def sound_between(basis, hz, drive_hz):
    """Return B of sound between the shapes of a basis."""
    return between_modes(forms_of(basis, hz, drive_hz), np.eye(len(hz)))[1]


def with_sound(seed, share):
    """A planted sweep whose modes send each other `share` of the sound that the basis expects.

    The response is that of the whole system of modes, solved at each frequency.
    """
    sweep = planted(seed, noise=0.005, mixing=0.1)
    count = len(sweep.hz)
    rng = np.random.default_rng(200 + seed)
    sends = rng.uniform(0.5, 1, count) * np.array([1, -1, 1, -1, 1, 1])[:count]
    # Loss factors by sound grow with frequency up to half of those of cane.
    sound_hz = np.geomspace(1000.0, 12_000.0, 9)
    strength = 0.015 * 2 * np.pi * sound_hz * (sound_hz / 6000) ** 2
    basis = replace(
        sweep.basis, sound_hz=sound_hz, sound=strength[:, None, None] * np.outer(sends, sends)
    )
    between = share * sound_between(basis, sweep.hz, DRIVE_HZ)
    amplitude = []
    for k, hz in enumerate(DRIVE_HZ):
        stiffness = np.diag(1 + 1j * sweep.loss - (hz / sweep.hz) ** 2) + 1j * between[k]
        moved = linalg.solve(stiffness, sweep.participation[k])
        amplitude.append(sweep.drive[k] * moved @ sweep.shapes)
    plain = response(sweep.hz, sweep.loss, sweep.participation, sweep.shapes, sweep.drive)
    noise = sweep.displacements.amplitude_rad - plain
    displacements = replace(sweep.displacements, amplitude_rad=np.array(amplitude) + noise)
    at = np.abs(np.log(DRIVE_HZ[:, None] / sweep.hz)).argmin(axis=0)
    modes = np.arange(count)
    loss = sweep.loss + between[at, modes, modes]
    return replace(sweep, loss=loss, displacements=displacements, basis=basis)


@pytest.mark.parametrize(
    ("seed", "share"), [pytest.param(2, 1.0, marks=pytest.mark.slow), (3, 0.6)]
)
def test_modes_are_right_where_they_send_each_other_sound(seed, share):
    sweep = with_sound(seed, share)
    silent = replace(sweep, basis=replace(sweep.basis, sound=np.zeros_like(sweep.basis.sound)))
    found, without = sweep.fit(), silent.fit()
    cents = [1200 * np.log2(each.hz / sweep.hz[:5]) / each.error_cents for each in (found, without)]
    rms = [float(np.sqrt(np.mean(each**2))) for each in cents]
    assert rms[0] < 2
    assert rms[1] > 3
    assert found.discrepancy < without.discrepancy
    assert found.state.loss_parameters[2] == pytest.approx(share, abs=0.15)


def test_others_add_to_a_participation_only_where_something_connects_modes():
    alone = planted(2, noise=0.005, mixing=0.1).fit()
    assert alone.by_pressure == pytest.approx(alone.participation)
    assert alone.by_pressure_error == pytest.approx(alone.participation_error)
    sweep = with_sound(2, 1.0)
    found = sweep.fit()
    at = np.abs(np.log(DRIVE_HZ[:, None] / found.hz)).argmin(axis=0)
    between = sound_between(sweep.basis, sweep.hz, DRIVE_HZ)
    added = []
    for m, k in enumerate(at):
        own = sweep.loss[m] - between[k, m, m]
        dynamic = np.diag(1 + 1j * own - (DRIVE_HZ[k] / sweep.hz) ** 2) + 1j * between[k]
        moved = linalg.solve(dynamic, sweep.participation[k])
        added.append(dynamic[m, m] * moved[m] / sweep.participation[k, m] - 1)
    assert np.abs(added).max() > 0.02
    errors = found.by_pressure_error / np.abs(found.by_pressure)
    off = found.participation / found.by_pressure - 1 - np.array(added)
    assert np.all(np.abs(off) < 3 * errors)


def test_no_mode_is_connected_with_itself():
    """What it loses by itself is part of its loss factor."""
    model, _, state = begun(with_sound(2, 1.0))
    for each in (model, connected(model, state)):
        assert each.sound.shape == (len(DRIVE_HZ), 6, 6)
        assert np.all(each.sound[:, 0, 1] < 0)
        assert not np.diagonal(each.sound, axis1=1, axis2=2).any()
        assert not np.diagonal(each.losses, axis1=1, axis2=2).any()
        assert np.all(each.own_losses[2] > 0)


def test_sound_beyond_the_frequencies_of_the_basis_has_the_resistance_of_their_end():
    basis = with_sound(2, 1.0).basis
    last_hz = basis.sound_hz[-1]
    at_end, beyond = sound_between(basis, MODE_HZ, np.array([last_hz, 2 * last_hz]))
    assert beyond == pytest.approx(2 * at_end)


def test_rounds_end_where_modes_send_each_other_sound():
    """Each round begins where the one before ended, and has nothing left to do."""
    sweep = with_sound(2, 1.0)
    model, given, state = begun(sweep)
    scatter = Scatter(0.01, FIRST_WALK)
    places = []
    for _ in range(5):
        end = one_round(model, given, state, scatter, 30)
        state = end.state
        places.append(Optimum.of(end))
    for one, other in pairwise(places[1:]):
        moved = np.abs(one.logs - other.logs) / np.sqrt(np.diag(one.covariance))
        # A search ends where a step gains less than what one standard error costs.
        assert moved.max() < 0.5
        assert abs(other.log_evidence - one.log_evidence) < 0.5
