"""Modes found in planted sweeps, whose displacements are made by the formula alone."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.errors import FitError
from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from fitting.modal.drive.prior import HELD_LEVEL, DriveForm, quiet_ripple, smooth_ripple
from fitting.modal.field_drift import FieldDrift
from fitting.modal.first_state import at_level
from fitting.modal.fit import (
    _drive_forms,
    _mixture,
    _model,
    _scatter_of,
    fit_modes,
    fit_modes_with_known_drive,
    fit_roughly,
)
from fitting.modal.model import (
    DRIVE_DOF,
    LOSS_PARAMETERS,
    Forms,
    Model,
    State,
    _degrees,
    drive_prior_at,
    expected_loss,
    scalars,
    stage_prior,
    terms,
)
from fitting.modal.noise import Data
from fitting.modal.normal_equations import (
    equations,
    evaluate,
    negative_gradient,
)
from fitting.modal.optimiser import _moved as step_from
from fitting.modal.optimiser import inverse, log_determinant, minimise_cost, without_drive
from fitting.modal.posterior import Posterior, _by_parameters
from fitting.modal.refit import _moved
from fitting.modal.rounds import LAST, one_round
from tests.numbers import cents, complex_normal

# Six modes, the last one beyond the sweep.
NAMES = ("F1", "T1", "F2", "T2", "X1", "symmetric 9")
MODE_HZ = np.array([2050.0, 3100.0, 4300.0, 5000.0, 6300.0, 11000.0])
LOSS = np.array([0.028, 0.034, 0.031, 0.025, 0.036, 0.03])
PARTICIPATION = np.array([1.0, 0.5j, 0.7 - 0.2j, 0.4, 0.5 + 0.3j, 0.6])
DRIVE_HZ = 1500 * 2 ** (np.arange(104) * 25 / 1200)
FUNCTIONS = 7
# Holograms are other and calmer by chance: standard deviation in nepers.
GAIN = 0.01
# What amplitudes are off, as a share of the root mean square of a hologram.
NOISE = 0.04


@dataclass(frozen=True)
class Planted:
    """The truth of a sweep."""

    hz: np.ndarray
    loss: np.ndarray
    shapes: np.ndarray
    participation: np.ndarray
    drive: np.ndarray
    volts: np.ndarray
    displacements: Displacements
    basis: ShapeBasis

    @property
    def start_hz(self):
        """Where finite elements of another cane have the modes within the sweep."""
        within = self.hz < DRIVE_HZ[-1]
        return {
            name: hz
            for name, hz, counts in zip(self.basis.names, self.basis.hz, within, strict=True)
            if counts
        }

    def fit(self, **changed):
        found = replace(self.displacements, **changed)
        return fit_modes(found, self.basis, DRIVE_HZ, self.volts, self.start_hz)


def response(hz, loss, participation, shapes, drive):
    """Displacements (k, j) by the formula, mode by mode."""
    a = np.zeros((len(DRIVE_HZ), shapes.shape[1]), complex)
    for m in range(len(hz)):
        h = 1 / (1 + 1j * loss[m] - (DRIVE_HZ / hz[m]) ** 2)
        a += np.outer(drive * h * participation[:, m], shapes[m])
    return a


def planted(
    seed=0,
    noise=NOISE,
    mode_hz=MODE_HZ,
    strength=PARTICIPATION,
    off_cents=8.0,
    drive_dof=(),
    mixing=0.5,
    gain_nepers=GAIN,
):
    """Draw a sweep; the frequencies that the search starts from are off by `off_cents`."""
    rng = np.random.default_rng(seed)
    modes, octaves = len(mode_hz), np.log2(DRIVE_HZ / 3000)
    reference = np.eye(modes, FUNCTIONS) + 0.1 * rng.standard_normal((modes, FUNCTIONS))
    hz = np.array(mode_hz)
    start = hz * 2 ** (off_cents / 1200 * rng.uniform(-1, 1, modes))
    # Shapes mix as neighbours do: the more, the closer their frequencies are. Each two of one mass
    # contain as much of each other, with opposite signs: modes are orthogonal.
    squares = hz[:, None] ** 2
    near = np.sqrt(squares * squares.T) / (np.abs(squares - squares.T) + np.eye(modes))
    mix = mixing * np.minimum(0.08 * near, 0.2) * (1 - np.eye(modes))
    drawn = np.triu(rng.uniform(-1, 1, mix.shape))
    shapes = reference + (mix * (drawn - drawn.T)) @ reference
    bends = 0.4 ** np.arange(1, 5)[:, None] * complex_normal(rng, 4, modes)
    along = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, len(DRIVE_HZ)), 4)[:, 1:]
    p = np.array(strength) * (1 + along @ bends)
    volts = np.minimum(16, 0.5 * 2 ** (np.arange(len(DRIVE_HZ)) / 15))
    gain = np.exp(gain_nepers * rng.standard_normal(len(DRIVE_HZ)))
    magnitude = 0.1 * volts * (1 + 0.2 * np.sin(octaves)) * gain
    for k, factor in drive_dof:
        magnitude[k] *= factor
    drive = magnitude * np.exp(2j * np.pi * rng.uniform(size=len(DRIVE_HZ)))
    a = response(hz, LOSS[:modes], p, shapes, drive)
    size = 2 * FUNCTIONS
    spread = noise * np.sqrt(np.mean(np.abs(a) ** 2, axis=1))
    # Errors of some directions are larger than those of others, and correlated.
    mixed = np.eye(size) + 0.3 * rng.standard_normal((len(a), size, size)) / np.sqrt(size)
    root = spread[:, None, None] * mixed
    error = np.einsum("kij,kj->ki", root, rng.standard_normal((len(a), size)))
    information = np.linalg.inv(root @ root.swapaxes(1, 2))
    a = a + error[:, :FUNCTIONS] + 1j * error[:, FUNCTIONS:]
    common_mode = CommonModeError(
        np.zeros((len(a), size, 0)), np.zeros((len(a), 0, 0)), np.zeros((len(a), 0))
    )
    displacements = Displacements(
        amplitude_rad=a,
        information=information,
        common_mode=common_mode,
        misfit=np.ones(len(a)),
        gain=np.zeros(len(a)),
        gain_nepers=0.05,
        object_field=np.ones(10, np.complex64),
        field_variance=None,
        change=None,
        recording_rank=np.arange(len(a)),
        reached=np.ones(len(a), dtype=bool),
    )
    basis = ShapeBasis(
        np.zeros((10, FUNCTIONS), np.float32),
        reference,
        NAMES[:modes],
        start,
        np.zeros(modes),
        np.zeros((2, modes, modes)),
        DRIVE_HZ[[0, -1]],
        np.zeros((2, modes, modes)),
        np.ones(modes),
        {},
    )
    return Planted(hz, LOSS[:modes], shapes, p, drive, volts, displacements, basis)


def mac(one, other):
    return (one @ other) ** 2 / ((one @ one) * (other @ other))


@pytest.fixture(scope="module")
def sweep():
    return planted()


@pytest.fixture(scope="module")
def found(sweep):
    return sweep.fit()


@pytest.fixture(scope="module")
def many():
    """Sweeps of other shapes, noise and starts, each with what was found in it."""
    return [(p, p.fit()) for p in (planted(seed) for seed in range(1, 12))]


# --- One sweep ---------------------------------------------------------------------------------


def test_modes_within_the_sweep_are_fitted_in_order(sweep, found):
    assert found.names == NAMES[:5]
    assert len(found.hz) == len(found.loss_factor) == len(found.error_cents) == 5
    assert found.shapes.shape == (5, FUNCTIONS)
    assert found.modal_rad.shape == (104, 5)


def test_frequencies_are_found_within_three_standard_errors(sweep, found):
    error = np.abs(cents(found.hz, sweep.hz[:5]))
    assert (error < 3 * found.error_cents).all()
    assert (found.error_cents < 2).all()


def test_losses_are_found_within_three_standard_errors(sweep, found):
    error = np.abs(np.log(found.loss_factor / sweep.loss[:5]))
    assert (error < 3 * found.loss_error).all()
    assert (found.loss_error < 0.1).all()


def test_shapes_are_found_and_not_only_taken_for_granted(sweep, found):
    for m in range(5):
        expected = mac(sweep.basis.shapes[m], sweep.shapes[m])
        assert 1 - mac(found.shapes[m], sweep.shapes[m]) < 0.002
        assert 1 - mac(found.shapes[m], sweep.shapes[m]) < 0.5 * (1 - expected)


def test_what_is_left_is_noise_and_next_to_no_discrepancy(found):
    assert found.misfit == pytest.approx(1, abs=0.15)
    assert found.discrepancy < 0.028


def test_the_model_gives_the_amplitudes_back(sweep, found):
    clean = response(sweep.hz, sweep.loss, sweep.participation, sweep.shapes, sweep.drive)
    left = np.linalg.norm(found.amplitude_rad - clean, axis=1) / np.linalg.norm(clean, axis=1)
    # Fifteen numbers of each hologram are averaged, but a complex factor is its own.
    assert np.median(left) < NOISE
    turn = np.exp(1j * np.angle(np.sum(clean.conj() * found.amplitude_rad, axis=1)))
    left = np.linalg.norm(found.amplitude_rad - clean * turn[:, None], axis=1)
    assert np.median(left / np.linalg.norm(clean, axis=1)) < 0.75 * NOISE


def test_the_drive_follows_phase_and_magnitude_of_every_hologram(sweep, found):
    ratio = np.log(
        found.drive / sweep.drive * np.exp(-1j * np.angle(np.vdot(sweep.drive, found.drive)))
    )
    # Participations may have any smooth factor that the drive has not.
    along = np.linspace(-1, 1, 104)
    smooth = np.polynomial.chebyshev.chebfit(along, ratio, 4)
    rough = ratio - np.polynomial.chebyshev.chebval(along, smooth)
    assert np.sqrt(np.mean(rough.real**2)) < NOISE / 2
    assert np.sqrt(np.mean(rough.imag**2)) < NOISE / 2


def test_modal_amplitudes_are_drive_times_resonance(sweep, found):
    k = np.array([np.abs(np.log(DRIVE_HZ / hz)).argmin() for hz in sweep.hz[:5]])
    for m in range(5):
        h = 1 / (1 + 1j * sweep.loss[m] - (DRIVE_HZ[k[m]] / sweep.hz[m]) ** 2)
        expected = np.abs(sweep.drive[k[m]] * h * sweep.participation[k[m], m])
        assert np.abs(found.modal_rad[k[m], m]) == pytest.approx(expected, rel=0.05)


# --- Many sweeps -------------------------------------------------------------------------------


def assert_honest(normalised):
    """Assert that errors over their standard errors have mean 0 and standard deviation 1."""
    assert np.abs(np.mean(normalised)) < 4 / np.sqrt(normalised.size) + 0.05
    assert 0.7 < np.std(normalised) < 1.4
    assert np.abs(normalised).max() < 4.5


def test_errors_of_frequencies_are_honest(many):
    assert_honest(np.array([cents(fit.hz, sweep.hz[:5]) / fit.error_cents for sweep, fit in many]))


def test_errors_of_losses_are_honest(many):
    assert_honest(
        np.array([np.log(fit.loss_factor / s.loss[:5]) / fit.loss_error for s, fit in many])
    )


def test_errors_are_honest_where_holograms_are_other_by_chance():
    sweeps = [planted(seed, gain_nepers=0.05) for seed in range(4)]
    errors = []
    for sweep in sweeps:
        fit = sweep.fit()
        errors.append(cents(fit.hz, sweep.hz[:5]) / fit.error_cents)
    assert_honest(np.array(errors))


def test_less_noise_makes_errors_smaller():
    rough, fine = (planted(3, noise=noise).fit() for noise in (0.08, 0.04))
    assert np.median(rough.error_cents / fine.error_cents) == pytest.approx(2, rel=0.25)


# --- Modes that are hard to see ----------------------------------------------------------------


def test_two_modes_sixty_cents_apart_are_distinguished():
    close_hz = MODE_HZ.copy()
    close_hz[3] = close_hz[2] * 2 ** (60 / 1200)
    sweep = planted(5, mode_hz=close_hz, off_cents=6.0)
    fit = sweep.fit()
    error = np.abs(cents(fit.hz, sweep.hz[:5]))
    assert (error < 3 * fit.error_cents).all()
    assert error[2:4].max() < 10
    assert (fit.hz[3] > fit.hz[2]).all()
    assert (np.abs(fit.participation[2:4]) > 5 * fit.participation_error[2:4]).all()


def without(silent, seed):
    """Draw a sweep in which nothing excites a mode."""
    strength = PARTICIPATION.copy()
    strength[silent] = 0
    return planted(seed, strength=strength, mixing=0.0)


@pytest.mark.parametrize("silent", [1, 4])
def test_a_mode_that_nothing_excites_takes_no_part(silent):
    ratios = []
    for seed in range(3):
        fit = without(silent, seed).fit()
        ratios.append(np.abs(fit.participation) / fit.participation_error)
    ratios = np.array(ratios)
    assert (ratios[:, silent] < 4).all()
    # Their mean square is that of a complex number over its standard deviation.
    assert 0.5 < np.sqrt(np.mean(ratios[:, silent] ** 2)) < 2
    assert (np.delete(ratios, silent, axis=1) > 10).all()


def test_the_frequency_of_a_mode_that_nothing_excites_is_not_known():
    fit = without(3, seed=2).fit()
    others = np.delete(fit.error_cents, 3)
    assert fit.error_cents[3] > 15 > others.max()


def test_a_mode_beyond_the_sweep_is_none_of_the_modes(found):
    assert "symmetric 9" not in found.names


@pytest.mark.parametrize("factor", [0.4, 3.0])
def test_a_line_of_the_air_between_modes_moves_none(factor):
    between = int(np.abs(np.log(DRIVE_HZ / 3650)).argmin())
    drive_dof = [(between, factor), (between + 1, np.sqrt(factor))]
    with_line, plain = planted(6, noise=0.01, drive_dof=drive_dof), planted(6, noise=0.01)
    fit, before = with_line.fit(), plain.fit()
    assert (np.abs(cents(fit.hz, with_line.hz[:5])) < 3 * fit.error_cents).all()
    ratio = np.abs(fit.drive / before.drive)
    assert ratio[between] / np.median(ratio) == pytest.approx(factor, rel=0.05)


@pytest.mark.parametrize("factor", [1.5, 3.0])
def test_an_acoustic_line_near_a_resonance_moves_it_by_no_more_than_the_stated_error(factor):
    near = int(np.abs(np.log(DRIVE_HZ / MODE_HZ[2])).argmin()) + 1
    sweep = planted(6, noise=0.02, drive_dof=[(near, factor), (near + 1, np.sqrt(factor))])
    fit = sweep.fit()
    assert (np.abs(cents(fit.hz, sweep.hz[:5])) < 4 * fit.error_cents).all()


# --- What amplitudes are off beyond their noise -----------------------------------------------


def test_what_amplitudes_are_off_beyond_their_noise_is_estimated(sweep):
    fit = sweep.fit(information=100 * sweep.displacements.information)
    assert fit.misfit == pytest.approx(1, abs=0.15)
    # Of either part of each number, as a share of the root mean square of its hologram.
    assert fit.discrepancy == pytest.approx(NOISE, rel=0.1)
    assert (np.abs(cents(fit.hz, sweep.hz[:5])) < 3 * fit.error_cents).all()


def test_without_discrepancy_what_is_left_is_noise():
    fit = planted(0, noise=0.01).fit()
    assert fit.misfit == pytest.approx(1, abs=0.15)


def test_a_hologram_of_something_else_is_off_and_moves_no_mode(sweep, found):
    amplitude = sweep.displacements.amplitude_rad.copy()
    amplitude[40] = np.linalg.norm(amplitude[40]) * complex_normal(np.random.default_rng(7), 7)
    fit = sweep.fit(amplitude_rad=amplitude)
    assert np.flatnonzero(fit.off).tolist() == [40]
    assert not found.off.any()
    assert (np.abs(cents(fit.hz, sweep.hz[:5])) < 3 * fit.error_cents).all()


def test_a_hologram_without_information_is_off(sweep):
    amplitude = sweep.displacements.amplitude_rad.copy()
    information = sweep.displacements.information.copy()
    amplitude[20], information[20] = 0, 0
    fit = sweep.fit(amplitude_rad=amplitude, information=information)
    assert np.flatnonzero(fit.off).tolist() == [20]
    assert (np.abs(cents(fit.hz, sweep.hz[:5])) < 3 * fit.error_cents).all()


def test_an_error_that_all_displacements_share_is_found(sweep):
    rng = np.random.default_rng(12)
    holograms, size = len(DRIVE_HZ), 2 * FUNCTIONS
    power = np.sqrt(np.mean(np.abs(sweep.displacements.amplitude_rad) ** 2, axis=1))
    # 131 is the number of parameters of an object field's smooth factor.
    response = power[:, None, None] * rng.standard_normal((holograms, size, 131))
    planted_error = 0.03 * rng.standard_normal(131)
    moved = np.einsum("kxq,q->kx", response, planted_error)
    amplitude = sweep.displacements.amplitude_rad - moved[:, :FUNCTIONS]
    amplitude = amplitude - 1j * moved[:, FUNCTIONS:]
    nothing = np.zeros((holograms, 131))
    error = CommonModeError(response, np.zeros((holograms, 131, 131)), nothing)
    fit = sweep.fit(amplitude_rad=amplitude, common_mode=error)
    assert fit.common_mode_shift.shape == (holograms, 131)
    off = fit.common_mode_shift - planted_error
    assert np.sqrt(np.mean(off**2)) < 0.2 * np.sqrt(np.mean(planted_error**2))
    assert (np.abs(cents(fit.hz, sweep.hz[:5])) < 3.5 * fit.error_cents).all()


def test_what_light_says_of_that_error_counts_wherever_displacements_were_linearised(sweep):
    """Light expects the error to be there, or displacements have it already and light expects 0."""
    rng = np.random.default_rng(13)
    holograms, size = len(DRIVE_HZ), 2 * FUNCTIONS
    power = np.sqrt(np.mean(np.abs(sweep.displacements.amplitude_rad) ** 2, axis=1))
    response = power[:, None, None] * rng.standard_normal((holograms, size, 131))
    expected, own = 0.02 * rng.standard_normal(131), 40.0 * np.eye(131)
    moved = np.einsum("kxq,q->kx", response, expected)
    precision, before = np.tile(own, (holograms, 1, 1)), sweep.displacements.amplitude_rad
    pull = np.tile(own @ expected, (holograms, 1))
    ahead = sweep.fit(
        amplitude_rad=before - moved[:, :FUNCTIONS] - 1j * moved[:, FUNCTIONS:],
        common_mode=CommonModeError(response, precision, pull),
    )
    there = sweep.fit(common_mode=CommonModeError(response, precision, 0 * pull))
    assert cents(ahead.hz, there.hz) == pytest.approx(
        np.zeros(5), abs=0.1 * ahead.error_cents.min()
    )
    off = ahead.common_mode_shift - there.common_mode_shift
    assert off == pytest.approx(np.tile(expected, (holograms, 1)), abs=2e-3)


def test_noise_of_displacements_does_not_brighten_the_object_field():
    """With responses of noisy amplitudes, brighter light makes the noise itself smaller."""
    noisy, light, errors = planted(noise=0.4), [], []
    measured = noisy.displacements.amplitude_rad
    small = 0.2 * np.random.default_rng(14).standard_normal((131, FUNCTIONS, FUNCTIONS)) + 0j
    # The first parameter is the magnitude of all light.
    small[0] = -np.eye(FUNCTIONS)
    each = np.einsum("qij,kj->kiq", small, measured)
    response = np.concatenate([each.real, each.imag], axis=1)
    precision = np.tile(2.0 * np.eye(131), (len(measured), 1, 1))
    for known in (small, None):
        error = CommonModeError(response, precision, np.zeros(response.shape[::2]), known)
        fit = noisy.fit(common_mode=error)
        light.append(fit.common_mode_shift[:, 0].mean())
        errors.append(np.sqrt(fit.common_mode_covariance[:, 0, 0].mean()))
    assert abs(light[0]) < 3 * errors[0]
    # Noise that can be made smaller is, whatever light says.
    assert light[1] > 0.5 > 50 * errors[1]


def test_a_pole_of_the_chamber_adds_to_the_errors_of_modes_next_to_it_only():
    pole_hz = 1.02 * MODE_HZ[3]
    pole = np.abs(1 + 0.3 / (1 - (DRIVE_HZ / pole_hz) ** 2 + 1j * DRIVE_HZ / pole_hz / 20))
    plain, strong = planted(6), planted(6, drive_dof=list(enumerate(pole)))
    fits = [each.fit() for each in (plain, strong)]
    for each, fit in zip((plain, strong), fits, strict=True):
        assert (np.abs(cents(fit.hz, each.hz[:5])) < 3 * fit.error_cents).all()
    more = fits[1].error_cents / fits[0].error_cents
    far = np.abs(np.log(MODE_HZ[:5] / pole_hz)) > 0.25
    assert far.any()
    assert (more[far] < 1.2).all()
    assert more[3] > 1.3


def test_equal_errors_of_neighbours_count_less(sweep):
    """The same discrepancy in runs of eight holograms, and one that is new in each.

    The drive is known: what is not known of it would add to the errors of both.
    """
    errors, known = [], exactly_driven(sweep.fit(), np.abs(sweep.drive))
    for together in (1, 8):
        rng = np.random.default_rng(8)
        drawn = np.repeat(complex_normal(rng, 104 // together, FUNCTIONS), together, axis=0)
        size = np.sqrt(np.mean(np.abs(sweep.displacements.amplitude_rad) ** 2, axis=1))
        moved = (0.2 * sweep.drive / np.abs(sweep.drive) * size)[:, None] * drawn
        displacements = replace(
            sweep.displacements, amplitude_rad=sweep.displacements.amplitude_rad + moved
        )
        fit = fit_modes_with_known_drive(
            displacements, sweep.basis, DRIVE_HZ, sweep.start_hz, known
        )
        assert (np.abs(cents(fit.hz, sweep.hz[:5])) < 3 * fit.error_cents).all()
        errors.append(fit.error_cents)
    assert np.median(errors[1] / errors[0]) > 1.4


def exactly_driven(fit, drive):
    """Return a fit that expects this drive (k,), with a ripple of almost nothing."""
    ripple = smooth_ripple(quiet_ripple(DRIVE_HZ, HELD_LEVEL))
    nothing = replace(ripple, coarse=1e-8 * np.eye(len(DRIVE_HZ)))
    return replace(fit, drive_forms=(DriveForm(np.log(drive), nothing, 0.0),))


def test_what_is_not_known_of_a_drive_adds_to_the_errors_of_modes():
    """Of a sweep whose drive is that of another one, with a pole of the chamber next to a mode."""
    pole_hz = 1.02 * MODE_HZ[3]
    pole = np.abs(1 + 0.3 / (1 - (DRIVE_HZ / pole_hz) ** 2 + 1j * DRIVE_HZ / pole_hz / 20))
    sweep = planted(6, drive_dof=list(enumerate(pole)))
    known = sweep.fit()
    fits = [
        fit_modes_with_known_drive(
            sweep.displacements, sweep.basis, DRIVE_HZ, sweep.start_hz, before
        )
        for before in (exactly_driven(known, np.abs(sweep.drive)), known)
    ]
    more = fits[1].error_cents / fits[0].error_cents
    assert (more > 0.95).all()
    assert more[3] > 1.1
    for fit in fits:
        assert (np.abs(cents(fit.hz, sweep.hz[:5])) < 3 * fit.error_cents).all()


def test_a_sweep_tells_as_much_if_the_form_of_its_drive_is_known_as_if_it_is_found():
    """A pole of the chamber lies next to a mode."""
    pole_hz = 1.02 * MODE_HZ[3]
    pole = np.abs(1 + 0.3 / (1 - (DRIVE_HZ / pole_hz) ** 2 + 1j * DRIVE_HZ / pole_hz / 20))
    sweep = planted(6, drive_dof=list(enumerate(pole)))
    found = sweep.fit()
    again = fit_modes_with_known_drive(
        sweep.displacements, sweep.basis, DRIVE_HZ, sweep.start_hz, found
    )
    assert (np.abs(cents(again.hz, found.hz)) < 0.5 * found.error_cents).all()
    assert again.error_cents == pytest.approx(found.error_cents, rel=0.35)


@pytest.mark.parametrize("missing", [(), (3,), (0, 50, 51, 103)])
def test_another_sweep_may_have_other_steps(missing):
    """Steps are bad in one sweep and good in another, and may be at another level."""
    sweep = planted(6)
    found, steps = sweep.fit(), np.delete(np.arange(len(DRIVE_HZ)), missing)
    before, now = (
        SimpleNamespace(drive_hz=DRIVE_HZ[at], volts=volts * np.ones(len(at)))
        for at, volts in ((np.arange(len(DRIVE_HZ)), 1.0), (steps, 0.5))
    )
    known = _moved(found, before, now)
    assert len(known.state.scatter) == len(known.state.log_drive) == len(steps)
    whole = sweep.displacements
    fields = {
        name: getattr(whole, name)[steps]
        for name in ("information", "recording_rank", "misfit", "gain", "reached")
    }
    error = whole.common_mode
    fewer = replace(
        whole,
        amplitude_rad=0.5 * whole.amplitude_rad[steps],
        common_mode=CommonModeError(
            error.response[steps], error.precision[steps], error.pull[steps]
        ),
        **(fields | {"information": 4 * fields["information"]}),
    )
    again = fit_modes_with_known_drive(fewer, sweep.basis, now.drive_hz, sweep.start_hz, known)
    assert (np.abs(cents(again.hz, found.hz)) < found.error_cents).all()
    back = fit_modes_with_known_drive(
        whole, sweep.basis, DRIVE_HZ, sweep.start_hz, _moved(again, now, before)
    )
    assert (np.abs(cents(back.hz, found.hz)) < found.error_cents).all()


def test_explanations_of_a_drive_keep_their_probabilities(sweep):
    """Those of two that explain another sweep equally well stay as they are."""
    found = sweep.fit()
    form = replace(found.drive_forms[0], log_probability=np.log(0.8))
    other = replace(form, log_probability=np.log(0.2))
    again = fit_modes_with_known_drive(
        sweep.displacements,
        sweep.basis,
        DRIVE_HZ,
        sweep.start_hz,
        replace(found, drive_forms=(form, other)),
    )
    kept = [each.log_probability for each in again.drive_forms]
    assert kept == pytest.approx(np.log([0.8, 0.2]), abs=1e-6)


def test_only_improbable_explanations_of_a_drive_are_forgotten():
    optima = [
        SimpleNamespace(
            log_evidence=log, model=SimpleNamespace(log_volts=log, ripple=quiet_ripple(DRIVE_HZ))
        )
        for log in (-1.0, 0.0, -8.0)
    ]
    forms = _drive_forms(optima, np.array([0.3, 0.6995, 0.0005]))
    assert [form.log_magnitude for form in forms] == [0.0, -1.0]
    assert [form.log_probability for form in forms] == pytest.approx(np.log([0.6995, 0.3]))


def test_a_form_of_the_drive_is_taken_at_other_steps_and_volts():
    ripple = quiet_ripple(DRIVE_HZ)
    form = DriveForm(np.log(np.arange(1.0, 105)), ripple, -0.5)
    steps, louder = np.arange(0, 104, 3), np.full(35, 2.0)
    other = form.at(steps, louder)
    assert np.exp(other.log_magnitude) == pytest.approx(2 * (1 + steps))
    np.testing.assert_allclose(
        other.ripple.covariance, ripple.covariance[np.ix_(steps, steps)], rtol=1e-12
    )


def test_participations_are_polynomials_of_frequency(sweep):
    """Over the same octave, they may change less at low frequencies than at high ones."""
    model, _ = _model(sweep.basis, DRIVE_HZ, sweep.volts, sweep.start_hz)
    first = np.polynomial.Polynomial.fit(DRIVE_HZ, model.powers[:, 1], 1)
    np.testing.assert_allclose(first(DRIVE_HZ), model.powers[:, 1], atol=1e-12)
    assert model.powers[[0, -1], 1] == pytest.approx([-1, 1])
    assert model.powers.shape[1] == 7


def test_participations_may_change_as_those_of_a_wave_under_half_the_window():
    """Chebyshev coefficients of its cosine and sine, by a fit on the frequencies of a sweep."""
    hz = 1417.0 * 2 ** (np.arange(184) * 25 / 1200)
    spread = _degrees(hz, LAST.decay, 9)
    wave = np.exp(2j * np.pi * hz / 343.0 * 16.5e-3)
    middle = (hz - hz[0]) / (hz[-1] - hz[0]) * 2 - 1
    own = np.abs(np.polynomial.chebyshev.chebfit(middle, wave, 14))[:9]
    assert spread[0] == 3.0
    # Below the degree of half the change of its phase, any wave may have any of them.
    assert spread[1:3] == pytest.approx(LAST.decay ** np.arange(1, 3))
    assert spread[3:] == pytest.approx(
        np.minimum(LAST.decay ** np.arange(3, 9), np.hypot(own[3:], 0.03)), rel=1e-3
    )
    # Over an octave at low frequencies there is little to change.
    octave = _degrees(hz[:49], LAST.decay, 7)
    assert octave[1] < 0.4 * LAST.decay
    assert octave[2:] == pytest.approx(np.full(5, 0.03), rel=0.1)


def test_a_mixture_has_the_moments_of_what_is_drawn_from_it():
    rng = np.random.default_rng(3)
    parts = [(np.array([1.0, -2.0]), np.diag([1.0, 4.0])), (np.array([3.0, 0.0]), np.eye(2))]
    mean, covariance = _mixture(np.array([0.25, 0.75]), parts)
    which = rng.uniform(size=400_000) < 0.25
    drawn = [rng.multivariate_normal(*part, size=len(which)) for part in parts]
    drawn = np.where(which[:, None], *drawn)
    np.testing.assert_allclose(mean, drawn.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(covariance, np.cov(drawn.T), atol=0.03)


def test_first_rounds_count_as_one_what_shows_one_mode(sweep, monkeypatch):
    """A wrong shape shows in all holograms within two widths of a mode, 25 cents apart."""
    scatters = []

    def watched(model, given, state, scatter, *steps):
        scatters.append(scatter)
        return one_round(model, given, state, scatter, *steps)

    monkeypatch.setattr("fitting.modal.rounds.one_round", watched)
    given = sweep.displacements, sweep.basis, DRIVE_HZ, sweep.volts, sweep.start_hz
    known = fit_roughly(*given)
    again = len(scatters)
    fit_roughly(*given, known)
    holograms = 2 * 1200 * np.log2(1 + 0.03) / 25
    for first in (scatters[0], scatters[again]):
        assert first.sharing == pytest.approx(holograms, abs=0.2)


def test_a_fit_starts_from_what_scatters_in_the_one_that_is_known():
    known = SimpleNamespace(discrepancy=0.013, field_walk=0.004, mixing_factor=2.5)
    found = _scatter_of(known)
    assert (found.discrepancy, found.walk, found.mixing) == (0.013, 0.004, 2.5)


def test_the_prior_of_mixings_has_the_factor_that_was_found(sweep):
    given = sweep.displacements, sweep.basis, DRIVE_HZ, sweep.volts, sweep.start_hz
    found = fit_roughly(*given)
    model, centre_hz = _model(*given[1:])
    prior = stage_prior(model, LAST, centre_hz, np.ones(len(model.reference)))
    count, mixes = len(found.names), found.mixing_spread > 0
    expected = prior.spread[count:, :count][mixes]
    assert found.mixing_factor != 1.0
    assert found.mixing_spread[mixes] == pytest.approx(found.mixing_factor * expected)


# --- Invariance --------------------------------------------------------------------------------


def test_the_sensitivity_of_the_drive_changes_nothing(sweep):
    plain, louder = (
        fit_modes(sweep.displacements, sweep.basis, DRIVE_HZ, factor * sweep.volts, sweep.start_hz)
        for factor in (1.0, 1e4)
    )
    # Steps are found in single precision: where they end is known to a small part of an error.
    assert np.abs(cents(louder.hz, plain.hz) / plain.error_cents).max() < 2e-3
    np.testing.assert_allclose(louder.error_cents, plain.error_cents, rtol=1e-3)
    np.testing.assert_allclose(louder.participation, plain.participation, rtol=1e-4)


def turned(sweep, turn):
    """Amplitudes and information of holograms that are turned and scaled."""
    c, s = turn.real, turn.imag
    eye = np.eye(FUNCTIONS)
    rotation = np.block(
        [
            [c[:, None, None] * eye, -s[:, None, None] * eye],
            [s[:, None, None] * eye, c[:, None, None] * eye],
        ]
    )
    back = np.linalg.inv(rotation)
    information = back.swapaxes(1, 2) @ sweep.displacements.information @ back
    return {
        "amplitude_rad": sweep.displacements.amplitude_rad * turn[:, None],
        "information": information,
    }


def assert_same(fit, found):
    assert np.abs(cents(fit.hz, found.hz)).max() < 0.05 * found.error_cents.min()
    assert fit.loss_factor == pytest.approx(found.loss_factor, rel=2e-3)
    assert fit.error_cents == pytest.approx(found.error_cents, rel=0.02)
    for m in range(5):
        assert mac(fit.shapes[m], found.shapes[m]) == pytest.approx(1, abs=1e-4)


def test_phases_of_holograms_are_of_no_matter(sweep, found):
    turn = np.exp(2j * np.pi * np.random.default_rng(4).uniform(size=104))
    fit = sweep.fit(**turned(sweep, turn))
    assert_same(fit, found)
    # Not the drive by itself: it may take from participations what changes slowly with frequency.
    assert np.abs(fit.modal_rad / (found.modal_rad * turn[:, None]) - 1).max() < 5e-3


@pytest.mark.parametrize("factor", [1 / 30, 5.0])
def test_a_common_factor_of_all_holograms_is_of_no_matter(sweep, found, factor):
    fit = sweep.fit(**turned(sweep, np.full(104, factor, complex)))
    assert_same(fit, found)
    modal = np.abs(fit.modal_rad) / np.abs(found.modal_rad)
    assert np.median(modal) == pytest.approx(factor, rel=1e-3)


def test_functions_may_be_turned_into_each_other(sweep, found):
    """Another orthonormal basis of the same shapes."""
    rotation = np.linalg.qr(np.random.default_rng(5).standard_normal((FUNCTIONS, FUNCTIONS)))[0]
    both = np.kron(np.eye(2), rotation)
    old = sweep.displacements
    other = replace(
        sweep,
        basis=replace(sweep.basis, shapes=sweep.basis.shapes @ rotation),
        displacements=replace(
            old,
            amplitude_rad=old.amplitude_rad @ rotation,
            information=both.T @ old.information @ both,
        ),
    )
    fit = other.fit()
    assert_same(replace(fit, shapes=fit.shapes @ rotation.T), found)


# --- Derivatives -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Point:
    """A model and some state of it, no optimum."""

    model: Model
    state: State
    data: Data

    @property
    def prior(self):
        active = self.model.active
        scale = np.full(len(self.model.reference), 0.5)
        return stage_prior(self.model, LAST, self.model.reference_hz[active] * 1.003, scale)

    def amplitude(self, x):
        state = replace(self.state, x=x)
        return terms(self.model, state).amplitude

    def cost(self, state):
        amplitude = terms(self.model, state).amplitude
        misfit = float(np.sum(self.data.whitened_residual(amplitude, state.shared) ** 2))
        known = state.shared @ (self.data.precision @ state.shared - 2 * self.data.pull)
        prior = expected_loss(self.model, self.prior, state).prior
        return misfit + known + prior.cost(state.x) + drive_prior_at(self.model, state).cost


@pytest.fixture(scope="module")
def point():
    rng = np.random.default_rng(6)
    k, j = np.arange(2, 104, 9), 4
    hz, active = DRIVE_HZ[k], np.array([0, 2, 3])
    reference = rng.standard_normal((5, j))
    powers = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, len(k)), 4)
    stiffening = np.array([0.1, 0.0, 0.2, 0.15, 0.1])
    model = Model(
        hz,
        np.log(np.full(len(k), 3.0)),
        DRIVE_DOF,
        quiet_ripple(hz),
        powers,
        reference,
        MODE_HZ[:5],
        stiffening,
        active,
        Forms(np.zeros((2, 5, 5)), np.zeros((len(k), 5, 5)), np.ones(5)),
        0.1 * rng.standard_normal((2, 5, 5)) * (1 - np.eye(5)),
        0.005 * rng.standard_normal((len(k), 5, 5)) * (1 - np.eye(5)),
        rng.uniform(0, [[0.5], [0.2], [0.01]], (3, 5)),
    )
    x = 0.1 * rng.standard_normal((3 + 5, model.slots))
    x[:3, 10] = np.log(MODE_HZ[active]) + 0.004 * rng.standard_normal(3)
    x[:3, 11] = np.log(0.03) + 0.1 * rng.standard_normal(3)
    drive = 1 + 0.2 * rng.standard_normal(len(k)) + 2j * np.pi * rng.uniform(size=len(k))
    root = rng.standard_normal((len(k), 2 * j, 2 * j))
    response = rng.standard_normal((len(k), 2 * j, 3))
    drift = FieldDrift(rng.uniform(0, 1, (len(k), 2)), np.array([5, 7]), 8, 6.0)
    half = rng.standard_normal((12, 12))
    amplitude = 5 * (rng.standard_normal((len(k), j)) + 1j * rng.standard_normal((len(k), j)))
    shared = np.concatenate([[0.03, -0.02, 1.2, 0.02, 0.3], rng.standard_normal(7)])
    # What modes lose is known as in a fit.
    known = np.concatenate([[0.03, 0.03, 0.5, 0.012, 0.3], np.ones(7)])
    precision = half @ half.T + np.diag(known**-2)
    pull = precision @ shared + rng.standard_normal(12)
    data = Data(amplitude, root, response, drift, precision, pull)
    point = Point(model, State(x, drive, shared, np.zeros(len(k))), data)
    x = np.where(point.prior.free, x, point.prior.centre)
    return replace(point, state=replace(point.state, x=x))


def in_phase(point):
    """The same, without losses and sound by which modes are out of phase."""
    none = np.zeros_like(point.model.losses), np.zeros_like(point.model.sound)
    return terms(replace(point.model, losses=none[0], sound=none[1]), point.state)


def differences(function, x, step=1e-6):
    """Central differences of a function by all elements of x, the latter in front."""
    slopes = []
    for index in np.ndindex(x.shape):
        move = np.zeros_like(x)
        move[index] = step
        slopes.append((function(x + move) - function(x - move)) / (2 * step))
    return np.array(slopes).reshape(*x.shape, *np.shape(slopes[0]))


def test_derivatives_are_scalars_times_vectors(point):
    """Those of participations and logarithms times what forces move, those of mixings times S."""
    model, state = point.model, point.state
    now, count = terms(model, state), len(model.active)
    by_force = now.moved_by_forces()
    assert np.abs(by_force - in_phase(point).moved_by_forces()).max() > 0.1
    vectors = np.concatenate([by_force[:, model.active], by_force], axis=1)
    own = scalars(model, state, now)
    given = np.einsum("kvp,kvj->vpkj", own, vectors)
    mixing = np.einsum("kvp,vj->vpkj", own[:, count:, :count], model.reference)
    given[count:, :count] = mixing
    expected = differences(point.amplitude, state.x)
    free = point.prior.free
    assert np.count_nonzero(free) > 45
    scale = np.abs(expected[free]).max()
    assert given[free] == pytest.approx(expected[free], abs=1e-6 * scale)


def test_what_a_mode_receives_has_the_derivatives_of_all_that_moves_it(point):
    """Its own participation, and what the others add out of phase."""
    model, state, free = point.model, point.state, point.prior.free
    now = terms(model, state)
    assert np.abs(now.received(state) / now.participation - 1).max() > 0.01
    for a, k in ((0, 2), (2, 7)):

        def force(other, a=a, k=k):
            there = terms(model, other)
            return (there.received(other) * np.exp(other.log_drive)[:, None])[k, model.active[a]]

        by_x = differences(lambda x, force=force: force(replace(state, x=x)), state.x)
        by_all = differences(lambda z, force=force: force(replace(state, shared=z)), state.shared)
        expected = np.concatenate([by_x[free], by_all[:LOSS_PARAMETERS]])
        given = _by_parameters(model, point.prior, state, now, a, k)
        assert given == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


def test_gradients_are_minus_half_the_slope_of_the_cost(point):
    state, free = point.state, point.prior.free
    here = evaluate(point.model, point.data, point.prior, state)
    assert here.cost == pytest.approx(point.cost(state), rel=1e-12)
    down = negative_gradient(point.model, point.data, point.prior, here)
    by_x = differences(lambda x: point.cost(replace(state, x=x)), state.x)[free]
    by_all = differences(lambda z: point.cost(replace(state, shared=z)), state.shared)
    slopes = np.concatenate([by_x, by_all])
    count = 2 * len(state.log_drive)
    assert down[:-count] == pytest.approx(-0.5 * slopes, abs=1e-5 * np.abs(slopes).max())
    own = down[len(by_x) : -count]
    assert own == pytest.approx(-0.5 * by_all, abs=1e-6 * np.abs(by_all).max())
    log = state.log_drive

    def at(parts):
        return point.cost(replace(state, log_drive=log + parts[0] + 1j * parts[1]))

    by_drive = differences(at, np.zeros((2, len(log))))
    assert down[-count:] == pytest.approx(
        -0.5 * by_drive.ravel(), abs=1e-3 * np.abs(by_drive).max()
    )


def by_expected_loss(point):
    """Products of the derivatives of what modes lose, but for those by their own loss factors."""
    state, free = point.state, point.prior.free

    def off(shared):
        prior = expected_loss(point.model, point.prior, replace(state, shared=shared)).prior
        return np.sqrt(prior.precision[free]) * (state.x - prior.centre)[free]

    own = np.diag(np.sqrt(point.prior.precision[free]))
    slopes = np.concatenate([own, differences(off, state.shared)])
    known = slopes @ slopes.T
    known[: len(own), : len(own)] = 0
    return known


def test_matrices_are_those_of_the_derivatives(point):
    """Of Gauss and Newton: products of derivatives through the information."""
    model, data = point.model, point.data
    state = point.state
    here = equations(model, data, point.prior, evaluate(model, data, point.prior, state))
    by_x = differences(point.amplitude, state.x)[point.prior.free]
    amplitude = terms(model, state).amplitude

    def at_phase(z):
        return terms(model, replace(state, shared=z)).amplitude

    eye = np.eye(len(amplitude))
    by_drive = np.concatenate([eye[:, :, None] * amplitude, 1j * eye[:, :, None] * amplitude])

    def seen(derivatives):
        parts = np.concatenate([derivatives.real, derivatives.imag], axis=2)
        return np.einsum("kxy,aky->akx", data.root, parts)

    # What all are off together moves the amplitudes as if the model moved the other way.
    light = -data.response.transpose(2, 1, 0)
    by_phase = seen(differences(at_phase, state.shared)[:LOSS_PARAMETERS]).swapaxes(1, 2)
    shared = data.drift.columns(np.concatenate([by_phase, light])).swapaxes(1, 2)
    own = np.concatenate([seen(by_x), shared])
    drive = seen(by_drive)
    held = np.zeros((len(own), len(own)))
    held[: len(by_x), : len(by_x)] = np.diag(point.prior.precision[point.prior.free])
    held[len(by_x) :, len(by_x) :] = data.precision
    held += by_expected_loss(point)
    count = len(amplitude)
    bent = np.zeros((2 * count, 2 * count))
    bent[:count, :count] = drive_prior_at(model, state).curvature
    for given, one, other, known in (
        (here.matrix, own, own, held),
        (here.coupling, own, drive, 0),
        (here.drive_matrix, drive, drive, bent),
    ):
        expected = np.einsum("akx,bkx->ab", one, other) + known
        assert given == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def settled(point, monkeypatch, iterations, following):
    """Cost and gradient after some of Newton's steps, each with the number that follow it."""
    monkeypatch.setattr("fitting.modal.optimiser._FOLLOWING", following)
    state = minimise_cost(point.model, point.data, point.prior, point.state, iterations)
    return evaluate(point.model, point.data, point.prior, state)


def test_parameters_follow_the_ripple_as_their_derivatives_say(point):
    """A step of Newton from where the gradient of the cost is changed by another ripple."""
    # The scatter is normal: its variance does not change with the ripple.
    model = at_level(replace(point.model, drive_dof=1e9), point.state)
    ripple = quiet_ripple(model.hz, HELD_LEVEL)
    model, free, count = replace(model, ripple=ripple), point.prior.free, len(model.hz)
    state = minimise_cost(model, point.data, point.prior, point.state, 20)

    def down(log_size):
        other = replace(model, ripple=replace(ripple, log_size=log_size))
        here = evaluate(other, point.data, point.prior, state)
        return negative_gradient(other, point.data, point.prior, here)

    here = equations(
        model, point.data, point.prior, evaluate(model, point.data, point.prior, state)
    )
    whole = np.block([[here.matrix, here.coupling], [here.coupling.T, here.drive_matrix]])
    expected = np.linalg.solve(whole, differences(down, ripple.log_size, 1e-4).T)
    posterior = Posterior.of(here, inverse(without_drive(here, 0.0)[0]), 1.0)
    parameters, log_magnitude = posterior.with_ripple(model, state)
    for given, rows in (
        (parameters, slice(np.count_nonzero(free))),
        (log_magnitude, slice(-2 * count, -count)),
    ):
        assert given[: len(expected[rows])] == pytest.approx(
            expected[rows], abs=1e-3 * np.abs(expected[rows]).max()
        )
        assert np.abs(expected[rows]).max() > 1e-4


def test_steps_that_follow_newtons_get_farther_on_the_same_equations(point, monkeypatch):
    start = point.cost(point.state)
    for iterations in (1, 3):
        costs = {n: settled(point, monkeypatch, iterations, n).cost for n in (0, 3, 12)}
        assert start > costs[0] > costs[3] > costs[12]


def test_nothing_is_gained_by_beginning_again_at_the_end(point, monkeypatch):
    monkeypatch.setattr("fitting.modal.optimiser._LEAST_PROGRESS", 1e-6)
    monkeypatch.setattr("fitting.modal.optimiser._LEAST_GAIN", 1e-7)
    # Of data that the model can explain, up to noise: others may have a valley without an end.
    noise = complex_normal(np.random.default_rng(11), *point.data.amplitude.shape)
    data = replace(point.data, amplitude=point.amplitude(point.state.x) + noise)
    x = point.state.x + 0.05 * point.prior.free
    x[:3, 10:] = point.state.x[:3, 10:] + 0.003
    point = replace(point, data=data, state=replace(point.state, x=x))
    end = settled(point, monkeypatch, 60, 12)
    again = settled(replace(point, state=end.state), monkeypatch, 60, 12)
    start = point.cost(point.state)
    assert end.cost - again.cost < 1e-4 * (start - end.cost)


def test_the_scatter_that_another_ripple_left_does_not_matter(point):
    scatter = 3.0 * (np.arange(len(point.state.log_drive)) % 3 == 0)
    other = replace(point.state, scatter=scatter)
    ends = [
        minimise_cost(point.model, point.data, point.prior, start, 2)
        for start in (point.state, other)
    ]
    assert np.array_equal(ends[0].x, ends[1].x)
    assert np.array_equal(ends[0].scatter, ends[1].scatter)


def test_a_step_that_overflows_is_cut(point):
    """Log losses that would run away, as in a valley without an end."""
    far = point.state.x.copy()
    far[:3, 11] += 6.0
    lost = replace(point.state, x=far)
    state = minimise_cost(point.model, point.data, point.prior, lost, 8)
    assert np.isfinite(point.cost(state))
    assert point.cost(state) < point.cost(lost)


def test_an_exponent_moves_by_no_more_than_one_in_a_step(point):
    """Losses grow with a power of frequency, which would overflow; the other numbers are linear."""
    here = evaluate(point.model, point.data, point.prior, point.state)
    count, first = len(point.model.hz), np.count_nonzero(point.prior.free)
    move = np.zeros(first + len(point.state.shared) + 2 * count)
    move[first : first + LOSS_PARAMETERS] = 900.0
    state = step_from(point.model, point.data, point.prior, here, move)
    assert (state.shared - point.state.shared)[:LOSS_PARAMETERS] == pytest.approx([900.0] * 4 + [1])


def test_what_has_no_inverse_is_said_with_the_remedy():
    matrix = np.diag([1.0, 2.0, 3.0])
    matrix[0, 1] = matrix[1, 0] = 0.3
    assert inverse(matrix) == pytest.approx(np.linalg.inv(matrix))
    assert log_determinant(matrix) == pytest.approx(np.linalg.slogdet(matrix)[1])
    matrix[0, 1] = matrix[1, 0] = 2.0
    with pytest.raises(FitError, match="--method picture"):
        inverse(matrix)
    with pytest.raises(FitError, match="--method picture"):
        inverse(np.diag([1.0, -1e-9]))


def test_a_matrix_that_is_wrong_is_no_fit_that_failed():
    """Its shape and its numbers are mistakes of the program, and not of the holograms."""
    with pytest.raises(ValueError, match="broadcast"):
        inverse(np.ones((2, 3)))
    with pytest.raises(ValueError, match="NaN"):
        inverse(np.array([[1.0, np.nan], [np.nan, 1.0]]))
