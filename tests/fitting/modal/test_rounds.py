"""Evidence of rounds of the modal fit: it compares explanations of the same displacements."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from fitting.holograms.object_field import CommonModeError
from fitting.modal import search
from fitting.modal.expected.prior import Prior
from fitting.modal.field_drift import FIRST_WALK
from fitting.modal.first_state import at_level, first_state, participation_scale
from fitting.modal.fit import _as_others, _model
from fitting.modal.losses import expected_shared, shared_drift
from fitting.modal.model import (
    CONNECTING,
    LOSS_PARAMETERS,
    TAIL_TERMS,
    rescaled,
    stage_prior,
    terms,
)
from fitting.modal.noise import noise_of
from fitting.modal.normal_equations import evaluate, negative_gradient
from fitting.modal.posterior import Posterior, resonant_displacements
from fitting.modal.rounds import (
    LAST,
    Given,
    Optimum,
    Scatter,
    _found_mixing,
    _with_mixing,
    among_parameters,
    in_rounds,
    influence,
    one_round,
    probabilities,
    shared_at,
)
from fitting.modal.search import Search, _compared
from tests.fitting.modal.test_fit import DRIVE_HZ, FUNCTIONS, planted
from tests.numbers import complex_normal

# Discrepancies below the noise, so that noise alone is the scatter.
NOISE_ALONE = Scatter(1e-4, FIRST_WALK)


def begun(sweep, factor=1.0, inflation=1.0):
    """Begin a fit with participations that are `factor` times as large, and a smaller drive.

    Returns the model, what rounds have in common, and the state.
    """
    displacements = sweep.displacements
    model, centre_hz = _model(sweep.basis, DRIVE_HZ, sweep.volts, sweep.start_hz)
    drift = shared_drift(displacements)
    state, scale = first_state(model, displacements, expected_shared(drift))
    x, active, powers = state.x.copy(), len(model.active), model.powers.shape[1]
    x[:active, : 2 * powers] *= factor
    x[active + model.passive, active : active + 2 * TAIL_TERMS] *= factor
    state = replace(state, x=x, log_drive=state.log_drive - np.log(factor))
    model = at_level(model, state)
    noise = noise_of(displacements)
    noise = replace(noise, inflation=np.full(len(DRIVE_HZ), inflation))
    prior = stage_prior(model, LAST, centre_hz, factor * scale)
    return model, Given(displacements, drift, noise, prior), state


def a_round(sweep, factor=1.0, inflation=1.0, iterations=40):
    """Fit from such a beginning."""
    model, given, state = begun(sweep, factor, inflation)
    for scatter in (Scatter(0.1, FIRST_WALK), NOISE_ALONE):
        end = one_round(model, given, state, scatter, iterations)
        state = end.state
    return end


@pytest.fixture(scope="module")
def sweep():
    return planted(3)


def test_what_is_drive_and_what_participation_does_not_change_the_evidence(sweep):
    plain = a_round(sweep)
    for factor in (0.2, 7.0):
        assert a_round(sweep, factor).log_evidence == pytest.approx(plain.log_evidence, abs=0.3)


def test_the_scale_of_a_start_does_not_change_what_is_compared(sweep):
    """An explanation that was found with a wider prior of participations is as probable."""
    before, after = [], []
    for wider in (1.0, 3.0):
        model, given, state = begun(sweep)
        scale = wider * participation_scale(model, state)
        given = replace(given, prior=rescaled(given.prior, model, LAST, scale))
        found = Optimum.of(one_round(model, given, state, NOISE_ALONE, 40))
        again = _compared(Search(model, given, [found]), NOISE_ALONE).optima[0]
        before.append(found.log_evidence)
        after.append(again.log_evidence)
    assert before[0] - before[1] > 30
    # Weak modes keep a part of it.
    assert abs(after[0] - after[1]) < 0.2 * (before[0] - before[1])


@pytest.mark.parametrize(("weight", "looked"), [(0.0, 1), (-19.0, 0)])
def test_lines_are_looked_for_only_where_none_is_expected_yet(sweep, monkeypatch, weight, looked):
    model, given, state = begun(sweep)
    found = Optimum.of(one_round(model, given, state, NOISE_ALONE, 3))
    found = replace(found, model=replace(model, line_weight=weight))
    asked = []

    def explained(at, *_):
        asked.append(at)
        return [at]

    monkeypatch.setattr(search, "explained_by_lines", explained)
    optima = _compared(Search(model, given, [found]), NOISE_ALONE).optima
    assert len(asked) == looked
    assert len(optima) == 1 + looked
    assert optima[0].model.line_weight == weight


def test_another_scale_changes_the_prior_of_participations_only(sweep):
    model, given, state = begun(sweep)
    prior, scale = given.prior, participation_scale(model, state)
    other = rescaled(prior, model, LAST, 2 * scale)
    both = rescaled(other, model, LAST, scale)
    assert both.precision == pytest.approx(rescaled(prior, model, LAST, scale).precision)
    changed = other.precision != both.precision
    active, powers = len(model.active), model.powers.shape[1]
    expected = np.zeros_like(changed)
    expected[:active, : 2 * powers] = True
    expected[active + model.passive, active : active + 2 * TAIL_TERMS] = True
    assert np.array_equal(changed, expected)
    assert other.precision[changed] == pytest.approx(both.precision[changed] / 4)
    assert np.array_equal(other.centre, prior.centre)


def test_weak_modes_have_the_same_share_of_the_largest_scale_at_any_level(sweep):
    scales = []
    for factor in (1.0, 1e-3):
        model, _, state = begun(sweep, factor)
        state.x[0] = 0.0
        scales.append(participation_scale(model, state))
    assert scales[1] == pytest.approx(1e-3 * scales[0])
    assert scales[0][model.active[0]] == pytest.approx(3e-3 * scales[0].max())


def test_noise_that_is_too_large_or_too_small_has_less_evidence(sweep):
    small, right, large = (a_round(sweep, inflation=i).log_evidence for i in (0.6, 1.0, 1.6))
    assert small < right - 5
    assert large < right - 5


def test_cost_and_volume_of_a_prior_are_its_density():
    rng = np.random.default_rng(1)
    centre, precision = rng.standard_normal((3, 4)), rng.uniform(0.5, 4, (3, 4))
    precision[1, 2] = np.inf
    prior, x = Prior(centre, precision), rng.standard_normal((3, 4))
    x[1, 2] = centre[1, 2]
    free = prior.free
    density = stats.norm(centre[free], precision[free] ** -0.5).logpdf(x[free]).sum()
    constant = -0.5 * np.count_nonzero(free) * np.log(2 * np.pi)
    assert 0.5 * (prior.log_volume - prior.cost(x)) + constant == pytest.approx(density)


def test_displacements_respond_as_a_state_would_in_the_light_in_which_they_were_measured(sweep):
    """Light is 5 % brighter in the state: what was measured in darker light is larger by that."""
    model, given, state = begun(sweep)
    brighter, rng = 0.05, np.random.default_rng(5)
    small = np.zeros((131, FUNCTIONS, FUNCTIONS), complex)
    small[0] = -np.eye(FUNCTIONS)
    modelled = terms(model, state).amplitude
    true = modelled / (1 - brighter)
    measured = true * (1 + 0.3 * rng.standard_normal(true.shape))
    response = np.zeros((len(measured), 2 * FUNCTIONS, 131))
    response[:, :, 0] = -np.concatenate([measured.real, measured.imag], axis=1)
    nothing = np.zeros((len(measured), 131))
    error = CommonModeError(response, np.zeros((len(measured), 131, 131)), nothing, small)
    displacements = replace(given.displacements, amplitude_rad=measured, common_mode=error)
    drift = shared_drift(displacements)
    shared = np.zeros(drift.parameters)
    shared[LOSS_PARAMETERS] = brighter
    there = replace(given, displacements=displacements, drift=drift)
    found = shared_at(model, there, replace(state, shared=shared), FIRST_WALK).response[:, :, 0]
    expected = -np.concatenate([true.real, true.imag], axis=1)
    assert found == pytest.approx(expected, rel=2 * brighter**2)


def test_logs_follow_amplitudes_as_a_step_to_other_amplitudes_moves_them(sweep):
    model, given, state = begun(sweep)
    for scatter in (Scatter(0.1, FIRST_WALK), NOISE_ALONE):
        end = one_round(model, given, state, scatter, 40)
        state = end.state
    own, data = among_parameters(model, end.prior), end.data
    change = 0.01 * complex_normal(np.random.default_rng(6), *data.amplitude.shape)
    other = replace(data, amplitude=data.amplitude + change)
    forces = [
        negative_gradient(model, each, end.prior, evaluate(model, each, end.prior, end.state))
        for each in (data, other)
    ]
    force, of_drive = np.split(forces[1] - forces[0], [len(end.covariance)])
    posterior = Posterior.of(end.here, end.covariance, 1.0)
    at = Optimum.of(end)
    expected = at.slopes @ end.covariance[own] @ (force - posterior.response @ of_drive)
    along = np.concatenate([change.real, change.imag], axis=1)
    resonant = resonant_at(end, posterior)
    follow = influence(at, resonant)
    logs, displacements = np.split(np.sum(follow.amplitudes * along, axis=(1, 2)), [len(expected)])
    assert logs == pytest.approx(expected, rel=1e-4, abs=1e-4 * np.abs(expected).max())
    # What all unknowns do, by the equations as a whole.
    here = end.here
    whole = np.block([[here.matrix, here.coupling], [here.coupling.T, here.drive_matrix]])
    step = np.linalg.solve(whole, np.concatenate([force, of_drive]))
    by_step = np.concatenate([resonant.log_by_parameters, resonant.log_by_drive], axis=1) @ step
    assert displacements == pytest.approx(by_step, rel=1e-3, abs=1e-3 * np.abs(by_step).max())
    # A small part of that step changes the displacements as their derivatives say.
    part, first = 1e-3, np.count_nonzero(end.prior.free)
    own, shared, magnitude, phase = np.split(
        part * step,
        np.cumsum([first, len(step) - first - 2 * len(DRIVE_HZ), len(DRIVE_HZ)]),
    )
    x = end.state.x.copy()
    x[end.prior.free] += own
    moved = replace(
        end.state, x=x, shared=end.state.shared + shared,
        log_drive=end.state.log_drive + magnitude + 1j * phase,
    )  # fmt: skip
    there = resonant_at(replace(end, state=moved), posterior).amplitude_rad
    sizes = [np.linalg.norm(each, axis=1) for each in (resonant.amplitude_rad, there)]
    assert np.log(sizes[1] / sizes[0]) == pytest.approx(
        part * by_step, rel=1e-2, abs=1e-2 * part * np.abs(by_step).max()
    )


def resonant_at(end, posterior, off=None):
    """Displacements of all modes at their resonances."""
    now = terms(end.model, end.state)
    return resonant_displacements(end.model, end.prior, end.state, now, posterior, off)


def test_the_drive_of_an_outlier_does_not_count_for_displacements(sweep):
    """It follows the displacement of a wrong fringe, here of half the size."""
    model, given, state = begun(sweep)
    end = one_round(model, given, state, NOISE_ALONE, 40)
    posterior = Posterior.of(end.here, end.covariance, 1.0)
    mode_hz = np.exp(end.state.x[0, 2 * model.powers.shape[1]])
    wrong = np.arange(len(model.hz)) == np.argmin(np.abs(np.log(model.hz / mode_hz)))
    halved = replace(end.state, log_drive=end.state.log_drive - np.log(2) * wrong)
    sizes = [
        np.linalg.norm(resonant_at(replace(end, state=one), posterior, off).amplitude_rad[0])
        for one in (end.state, halved)
        for off in (None, wrong)
    ]
    assert sizes[2] < 0.8 * sizes[0]
    assert sizes[3] == pytest.approx(sizes[1])
    # Interpolated between its neighbours, it is the same within some per cent.
    assert sizes[1] == pytest.approx(sizes[0], rel=0.1)


@pytest.mark.parametrize("share", [0.4, 0.005])
def test_displacements_are_averages_over_all_explanations(sweep, share):
    """Of a second one, in which the first mode loses a fifth more, and moves as much less."""
    model, given, state = begun(sweep)
    end = one_round(model, given, state, NOISE_ALONE, 40)
    x, loss = end.state.x.copy(), 2 * model.powers.shape[1] + 1
    x[0, loss] += np.log(1.2)
    optima = [Optimum.of(each) for each in (end, replace(end, state=replace(end.state, x=x)))]
    optima[1] = replace(optima[1], log_evidence=optima[0].log_evidence - 1)
    posterior = Posterior.of(end.here, end.covariance, optima[0].factor)
    alone = resonant_at(end, posterior)
    found = _as_others(sweep.displacements, optima, np.array([1 - share, share]), alone)
    logs = [np.log(np.linalg.norm(each.amplitude_rad, axis=1)) for each in (alone, found)]
    counts = share if share > 0.01 else 0.0
    moved = -counts * np.log(1.2)
    assert logs[1][0] - logs[0][0] == pytest.approx(moved, abs=0.01 * abs(moved) + 1e-12)
    along = found.amplitude_rad[0] / np.linalg.norm(found.amplitude_rad[0]) ** 2
    own = alone.amplitude_rad[0] / np.linalg.norm(alone.amplitude_rad[0]) ** 2
    more = along @ found.covariance[0] @ along - own @ alone.covariance[0] @ own
    between = counts * (1 - counts) * np.log(1.2) ** 2
    assert more == pytest.approx(between, rel=0.05, abs=1e-9)
    # Modes that are the same in both explanations keep their size.
    assert logs[1][1:] == pytest.approx(logs[0][1:], abs=0.02)


def test_logs_follow_light_by_the_amplitudes_that_respond_to_it(sweep):
    rng, count = np.random.default_rng(7), len(DRIVE_HZ)
    response = 0.1 * rng.standard_normal((count, 2 * FUNCTIONS, 131))
    error = CommonModeError(response, np.tile(np.eye(131), (count, 1, 1)), np.zeros((count, 131)))
    lit = SimpleNamespace(
        displacements=replace(sweep.displacements, common_mode=error),
        basis=sweep.basis, volts=sweep.volts, start_hz=sweep.start_hz,
    )  # fmt: skip
    model, given, state = begun(lit)
    end = one_round(model, given, state, NOISE_ALONE, 2)
    posterior = Posterior.of(end.here, end.covariance, 1.0)
    follow = influence(Optimum.of(end), resonant_at(end, posterior))
    light = 0.01 * rng.standard_normal((count, 131))
    moved = np.linalg.solve(end.data.root, end.data.response @ light[..., None])[..., 0]
    by_amplitudes = np.sum(follow.amplitudes * moved, axis=(1, 2))
    assert np.all(by_amplitudes != 0)
    found = np.sum(follow.light * light, axis=(1, 2))
    assert found == pytest.approx(by_amplitudes, rel=1e-6)


def test_noise_counts_once_and_a_discrepancy_as_often_as_holograms_share_it(sweep):
    model, given, state = begun(sweep)
    state = one_round(model, given, state, NOISE_ALONE, 40).state
    own = among_parameters(model, given.prior)[:-CONNECTING]
    quiet = replace(given, noise=replace(given.noise, variance=1e-8 * given.noise.variance))

    def errors(given, discrepancy, sharing):
        scatter = Scatter(discrepancy, FIRST_WALK, sharing)
        return np.sqrt(np.diag(one_round(model, given, state, scatter, 20).covariance)[own])

    three = errors(quiet, 1e-3, 9.0) / errors(quiet, 1e-3, 1.0)
    assert three == pytest.approx(np.full(len(own), 3.0), rel=0.1)
    assert errors(given, 1e-4, 9.0) == pytest.approx(errors(given, 1e-4, 1.0), rel=0.02)


@pytest.fixture(scope="module")
def shared_sweep(sweep):
    """The same displacements with a discrepancy of 3 % that some neighbours share."""
    model, given, state = begun(sweep)
    drive = one_round(model, given, state, NOISE_ALONE, 40).state.log_drive
    found, rng = sweep.displacements, np.random.default_rng(5)
    normal = complex_normal(rng, *found.amplitude_rad.shape)
    walk = lfilter([np.sqrt(1 - 0.9**2)], [1, -0.9], normal, axis=0)
    rms = np.sqrt(np.mean(np.abs(found.amplitude_rad) ** 2, axis=1, keepdims=True))
    turned = 0.03 * np.sqrt(2) * rms * np.exp(1j * drive.imag)[:, None] * walk
    return replace(sweep, displacements=replace(found, amplitude_rad=found.amplitude_rad + turned))


def test_holograms_without_a_solution_make_the_discrepancy_no_smaller(sweep):
    """A fifth of them, spread over the sweep: they say nothing of how far others scatter."""
    found, rng = sweep.displacements, np.random.default_rng(5)
    normal = complex_normal(rng, *found.amplitude_rad.shape)
    rms = np.sqrt(np.mean(np.abs(found.amplitude_rad) ** 2, axis=1, keepdims=True))
    scattered = found.amplitude_rad + 0.03 * np.sqrt(2) * rms * normal
    for lost in (np.zeros(len(DRIVE_HZ), dtype=bool), np.arange(len(DRIVE_HZ)) % 5 == 2):
        displacements = replace(
            found,
            amplitude_rad=np.where(lost[:, None], 0.0, scattered),
            information=np.where(lost[:, None, None], 0.0, found.information),
        )
        model, given, state = begun(replace(sweep, displacements=displacements))
        scatter = Scatter(0.03, FIRST_WALK)
        for _ in range(4):
            end = one_round(model, given, state, scatter, 40)
            state, scatter = end.state, replace(end.next_scatter, sharing=1.0)
        assert scatter.discrepancy == pytest.approx(0.03, rel=0.08)


def test_the_discrepancy_and_who_shares_it_do_not_depend_on_what_was_assumed(shared_sweep):
    model, given, state = begun(shared_sweep)
    state = one_round(model, given, state, Scatter(0.03, FIRST_WALK), 40).state
    ends = [
        one_round(model, given, state, Scatter(0.03, FIRST_WALK, sharing), 20)
        for sharing in (1.0, 9.0)
    ]
    # Modes take a part of what neighbours share.
    for end in ends:
        assert 0.022 < end.next_scatter.discrepancy < 0.033
        assert 0.6 < end.misfit < 1.2
    first, second = (end.next_scatter.sharing for end in ends)
    assert second == pytest.approx(first, rel=0.3)
    assert 1.5 < first < 8


def test_the_likelihood_of_a_hologram_is_that_of_its_residuals(shared_sweep):
    model, given, state = begun(shared_sweep)
    scatter = Scatter(0.03, FIRST_WALK, 4.0)
    end = one_round(model, given, state, scatter, 20)
    left = end.whitened_residual * given.noise.deviation(0.03)
    density = stats.norm.logpdf(left, scale=given.noise.deviation(0.03, 4.0))
    known = end.log_likelihood - 0.5 * np.log(2 * np.pi) * left.shape[1]
    np.testing.assert_allclose(known, density.sum(axis=1), rtol=1e-9)


def test_errors_are_as_large_as_residuals_show(sweep):
    model, given, state = begun(sweep)
    end = one_round(model, given, state, NOISE_ALONE, 20)
    own = among_parameters(model, given.prior)[:-CONNECTING]
    found = Optimum.of(replace(end, misfit=4.0))
    # No losses connect these modes.
    np.testing.assert_allclose(found.covariance, 4 * end.covariance[np.ix_(own, own)], rtol=1e-6)
    np.testing.assert_allclose(
        found.magnitude_covariance,
        4 * Optimum.of(replace(end, misfit=1.0)).magnitude_covariance,
    )


# --- How sure a difference of two evidences is ---------------------------------------------------


def explanations(*log_likelihoods, sharing=1.0):
    """Explanations whose evidence is what their holograms (k,) add up to."""
    scatter = SimpleNamespace(sharing=sharing)
    return [
        SimpleNamespace(
            log_evidence=float(np.sum(each)),
            end=SimpleNamespace(log_likelihood=each, scatter=scatter),
        )
        for each in log_likelihoods
    ]


def test_a_difference_that_every_hologram_shows_alike_is_sure():
    worse = np.zeros(100)
    found = probabilities(explanations(worse, worse + 0.05))
    assert found[1] / found[0] == pytest.approx(np.exp(5))
    assert found.sum() == pytest.approx(1)


@pytest.mark.parametrize("less", [0.0, 10.0, 30.0, 60.0])
def test_a_difference_that_holograms_dispute_is_as_sure_as_its_standard_error(less):
    """Normal distribution of a sum of 400 independent differences of 1.5: ± 30."""
    disputed = 1.5 * np.random.default_rng(3).permutation(np.repeat([-1.0, 1.0], 200))
    found = probabilities(explanations(np.zeros(400), disputed - less / 400))
    assert found[0] == pytest.approx(stats.norm.cdf(less / 30), abs=0.012)


def test_what_neighbours_dispute_together_counts_once():
    """Three successive holograms with the same difference: a sum of 200 independent triples."""
    triples = np.repeat(np.random.default_rng(4).permutation(np.repeat([-1.0, 1.0], 100)), 3)
    alone, together = (
        probabilities(explanations(np.zeros(600), triples - 60 / 600, sharing=sharing))[0]
        for sharing in (1.0, 6.0)
    )
    true = stats.norm.cdf(60 / (3 * np.sqrt(200)))
    assert together == pytest.approx(true, abs=0.03)
    assert alone > true + 0.03


def test_fewer_holograms_than_share_still_have_a_standard_error():
    found = probabilities(explanations(np.zeros(3), np.array([2.0, -3.0, 0.5]), sharing=9.0))
    assert found.sum() == pytest.approx(1)
    assert found[0] > found[1] > 0.2


def prior_of(spread):
    """The prior of 2 modes with 3 other parameters each, and of 4 shapes mixed into them."""
    precision = np.full((6, 3), 1.0)
    precision[2:, :2] = spread**-2.0
    precision[2:, 2] = np.inf
    return Prior(np.zeros((6, 3)), precision)


@pytest.mark.parametrize("factor", [0.3, 1.0, 2.5])
def test_mixings_that_data_determine_show_how_large_they_are(factor):
    rng = np.random.default_rng(5)
    spread = rng.uniform(0.01, 0.1, (4, 2))
    prior = prior_of(spread)
    x = np.zeros((6, 3))
    # Mean square 1 in units of the prior, and numbers of no matter elsewhere.
    x[2:, :2] = factor * spread * rng.choice([-1, 1], (4, 2))
    x[:2] = 7.0
    free = np.count_nonzero(prior.free)
    used = _with_mixing(prior, 2, 0.7)
    known = _found_mixing(prior, used, 2, SimpleNamespace(x=x), 1e-12 * np.eye(free + 5))
    assert known == pytest.approx(np.sqrt((8 * factor**2 + 4) / (8 + 4)))


def test_mixings_of_which_nothing_is_known_stay_as_expected():
    prior = prior_of(np.full((4, 2), 0.05))
    for factor in (0.4, 1.0, 3.0):
        used = _with_mixing(prior, 2, factor)
        # A posterior that is the prior: the expectations are 0, and say nothing.
        covariance = np.diag(1 / used.precision[used.free])
        found = _found_mixing(prior, used, 2, SimpleNamespace(x=np.zeros((6, 3))), covariance)
        assert found == pytest.approx(1.0)


def test_the_factor_changes_the_prior_of_mixings_only(sweep):
    model, given, state = begun(sweep)
    count = len(model.active)
    ends = [one_round(model, given, state, replace(NOISE_ALONE, mixing=f)) for f in (1.0, 2.0)]
    one, two = (end.prior.precision for end in ends)
    expected = np.ones(one.shape)
    expected[count:, :count] = 4.0
    free = ends[0].prior.free
    assert one[free] / two[free] == pytest.approx(expected[free])
    assert np.array_equal(ends[1].prior.free, free)


@pytest.mark.parametrize(("mixing", "expected"), [(0.1, 0.1 / 3**0.5), (4.0, 4.0 / 3**0.5)])
def test_mixings_are_found_as_large_as_they_are(mixing, expected):
    """Those of these reeds are uniform, between as much and as little as the factor says."""
    factors = []
    for seed in range(2):
        model, given, state = begun(planted(seed, mixing=mixing))
        end, _ = in_rounds(model, given, state, Scatter(0.02, FIRST_WALK), 4)
        factors.append(end.next_scatter.mixing)
    # What is expected beforehand counts as four of some twenty mixings.
    most = np.sqrt((20 * expected**2 + 4) / 24)
    assert np.mean(factors) == pytest.approx(most, rel=0.4)
