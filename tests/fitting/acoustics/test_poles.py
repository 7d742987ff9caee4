"""Poles of planted drives, whose gain is known by its formula."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from fitting.acoustics.poles import (
    _PHASES,
    _QUALITIES,
    DriveLines,
    _fit_of,
    find_excitation_peaks,
    height_db,
    lines_of_drive,
    log_gain,
)
from fitting.modal.drive.prior import quiet_ripple
from physics.drive import resonance_gain
from physics.parameters.drive import AcousticResonance
from tests.fitting.modal.test_fit import DRIVE_HZ as PLANTED_HZ
from tests.fitting.modal.test_fit import planted

HZ = 1400 * 2 ** (np.arange(1, 185) * 25 / 1200)
NONE = np.zeros((184, 184))
# Frequency, quality factor, strength. The first is that of the simulated bench.
BENCH = (4308.6, 25.0, 0.12)
BACKGROUND = np.linalg.cholesky(quiet_ripple(HZ).covariance)


def log_drive(*lines, seed=0, noise=0.005):
    """Log magnitude per volt: a loudspeaker as the prior has it, lines, and noise."""
    rng = np.random.default_rng(seed)
    smooth = BACKGROUND @ rng.standard_normal(len(HZ))
    for hz, quality, strength in lines:
        ratio = HZ / hz
        smooth += np.log(np.abs(1 + strength / (1 - ratio**2 + 1j * ratio / quality)))
    return smooth + noise * rng.standard_normal(len(HZ))


def found_in(*lines, seed=0, noise=0.005):
    return find_excitation_peaks(HZ, log_drive(*lines, seed=seed, noise=noise), NONE, noise)


LINES = np.array([[np.log(4300.0), np.log(20.0), 0.3, 0.1], [np.log(9000.0), 3.5, -0.1, 0.0]])


def lines_with_errors():
    root = 0.02 * np.random.default_rng(1).standard_normal((8, 12))
    return DriveLines(LINES, root @ root.T)


def test_the_covariance_of_a_gain_is_that_of_its_lines_to_first_order():
    lines, step = lines_with_errors(), 1e-5
    slopes = [
        (log_gain(LINES + move, HZ) - log_gain(LINES - move, HZ)) / (2 * step)
        for move in step * np.eye(8).reshape(8, 2, 4)
    ]
    expected = 9 * np.array(slopes).T @ lines.covariance @ np.array(slopes)
    accurate = 1e-6 * expected.max()
    assert lines.gain_covariance(HZ, 3.0) == pytest.approx(expected, rel=1e-5, abs=accurate)


def test_a_line_counts_as_one_that_could_have_been_anywhere():
    """A density as wide as the errors, times the weight, is the prior's density there."""
    lines, factor = lines_with_errors(), 2.0
    narrow = stats.multivariate_normal(LINES.ravel(), factor**2 * lines.covariance)
    anywhere = -np.log(np.log(HZ[-1] / HZ[0]))
    prior = sum(
        anywhere
        + stats.norm(np.log(17.0), 0.9).logpdf(log_quality)
        + stats.norm.logpdf(real)
        + stats.norm.logpdf(imaginary)
        for _, log_quality, real, imaginary in LINES
    )
    weighed = narrow.logpdf(LINES.ravel()) + lines.log_weight(HZ, factor)
    assert weighed == pytest.approx(prior, rel=1e-9)


def test_some_lines_have_the_errors_that_they_have_among_all():
    lines = lines_with_errors()
    second = lines.only(np.array([False, True]))
    assert second.parameters.tolist() == LINES[1:].tolist()
    assert second.covariance == pytest.approx(lines.covariance[4:, 4:])


def test_lines_of_a_drive_are_those_of_its_peaks():
    drive = log_drive(BENCH, (9000.0, 30.0, 0.2))
    lines = lines_of_drive(HZ, drive, NONE, 0.005)
    peaks = find_excitation_peaks(HZ, drive, NONE, 0.005)
    found = np.argsort(lines.parameters[:, 0])
    assert np.exp(lines.parameters[found, 0]) == pytest.approx([peak.hz for peak in peaks])
    assert [height_db(lines.parameters[n]) for n in found] == pytest.approx(
        [peak.height_db for peak in peaks]
    )
    errors = np.sqrt(np.diag(lines.covariance)).reshape(-1, 4)[found]
    hz_errors = [peak.error_hz / peak.hz for peak in peaks]
    assert errors[:, 0] == pytest.approx(hz_errors)
    assert errors[:, 1] == pytest.approx([peak.quality_error / peak.quality for peak in peaks])


def test_a_quiet_drive_has_no_lines_and_no_errors():
    lines = lines_of_drive(HZ, log_drive(), NONE, 0.005)
    assert lines.parameters.shape == (0, 4)
    assert lines.covariance.shape == (0, 0)


def test_a_drive_without_lines_has_none():
    heights = [peak.height_db for seed in range(20) for peak in found_in(seed=seed)]
    # Ripple of loudspeakers rarely looks like a line, and never like a high one.
    assert len(heights) <= 2
    assert max(heights, default=0) < 5


def test_the_pole_is_found_and_not_the_largest_drive():
    """The gain by the line of the simulated bench is largest 20 to 30 Hz below its pole."""
    clean = np.log(np.abs(resonance_gain(AcousticResonance(), HZ)))
    (peak,) = find_excitation_peaks(HZ, clean, NONE)
    assert HZ[np.argmax(clean)] < 4308.6 - 15 or HZ[np.argmax(clean)] == HZ[77]
    assert peak.hz == pytest.approx(4308.6, abs=1)
    assert peak.quality == pytest.approx(25, rel=0.02)
    assert peak.height_db == pytest.approx(20 * np.log10(np.exp(clean.max())), abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [BENCH, (2500.0, 50.0, -0.06), (3000.0, 60.0, 0.05j), (9000.0, 15.0, 0.2 - 0.1j)],
    ids=["bench", "opposite sign", "other phase", "wide"],
)
def test_standard_errors_are_those_of_many_drives(line):
    pulls = []
    for seed in range(24):
        peaks = found_in(line, seed=seed)
        peak = min(peaks, key=lambda each: abs(each.hz - line[0]))
        assert peak.error_hz < 0.01 * peak.hz
        pulls.append(
            [
                (peak.hz - line[0]) / peak.error_hz,
                np.log(peak.quality / line[1]) * peak.quality / peak.quality_error,
            ]
        )
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert ((rms > 0.6) & (rms < 1.4)).all(), rms


@pytest.mark.slow
def test_ripple_and_noise_have_their_parts_of_the_error():
    """Drives of one loudspeaker scatter by what is left without the ripple."""
    smooth = BACKGROUND @ np.random.default_rng(7).standard_normal(len(HZ))
    clean = smooth + np.log(np.abs(resonance_gain(AcousticResonance(), HZ)))
    rng, noise = np.random.default_rng(8), 0.02
    peaks = [
        find_excitation_peaks(HZ, clean + noise * rng.standard_normal(len(HZ)), NONE, noise)
        for _ in range(24)
    ]
    lines = [min(each, key=lambda peak: abs(peak.hz - 4308.6)) for each in peaks]
    own = np.sqrt(np.median([line.error_hz**2 - line.ripple_hz**2 for line in lines]))
    assert np.std([line.hz for line in lines]) == pytest.approx(own, rel=0.4)
    assert all(0 < line.ripple_hz < line.error_hz for line in lines)


def test_noise_widens_the_errors():
    quiet, loud = (found_in(BENCH, noise=noise)[0] for noise in (0.003, 0.05))
    assert loud.error_hz > 2 * quiet.error_hz
    assert abs(loud.hz - 4308.6) < 3 * loud.error_hz


def test_the_covariance_of_the_drive_widens_the_errors():
    drive = log_drive(BENCH)
    (certain,) = find_excitation_peaks(HZ, drive, NONE)
    (uncertain,) = find_excitation_peaks(HZ, drive, 0.05**2 * np.eye(184))
    assert uncertain.error_hz > 2 * certain.error_hz


def test_a_factor_common_to_all_steps_changes_nothing():
    drive = log_drive(BENCH)
    (one,), (other,) = (find_excitation_peaks(HZ, d, NONE) for d in (drive, drive + 3.0))
    assert other.hz == pytest.approx(one.hz, abs=0.05)
    assert other.height_db == pytest.approx(one.height_db, abs=0.05)


def test_an_outlier_is_no_line():
    drive = log_drive(BENCH)
    drive[120] += 2.0
    off = np.arange(184) == 120
    (peak,) = find_excitation_peaks(HZ, drive, NONE, 0.005, off)
    assert abs(peak.hz - 4308.6) < 4 * peak.error_hz


@pytest.mark.parametrize("other", [(6500.0, 40.0, 0.05), (4650.0, 30.0, 0.08)])
def test_two_lines_are_separated(other):
    first, second = found_in(BENCH, other, seed=2, noise=0.002)
    for peak, (hz, quality, _) in ((first, BENCH), (second, other)):
        assert abs(peak.hz - hz) < 3.5 * peak.error_hz
        assert abs(peak.quality - quality) < 3.5 * peak.quality_error


# --- Drives that a joint fit has found ---------------------------------------------------------


def with_line(sweep, line):
    """The same sweep, driven through an acoustic resonance too."""
    hz, quality, strength = line
    ratio = PLANTED_HZ / hz
    gain = np.abs(1 + strength / (1 - ratio**2 + 1j * ratio / quality))
    before = sweep.displacements
    louder = replace(
        before,
        amplitude_rad=before.amplitude_rad * gain[:, None],
        information=before.information / gain[:, None, None] ** 2,
    )
    return replace(sweep, displacements=louder)


def peaks_of(sweep):
    modal = sweep.fit()
    return find_excitation_peaks(
        PLANTED_HZ,
        np.log(np.abs(modal.drive) / sweep.volts),
        modal.log_drive_covariance,
        modal.state.gain,
        modal.off,
    )


@pytest.mark.slow
@pytest.mark.parametrize("line_hz", [3600.0, 4360.0], ids=["between modes", "at F2"])
def test_a_line_of_a_fitted_drive_is_where_it_was_put(line_hz):
    """F2 is at 4300 Hz."""
    pulls = []
    for seed in range(1, 6):
        sweep = with_line(planted(seed), (line_hz, 25.0, 0.12))
        peaks = peaks_of(sweep)
        assert peaks
        peak = min(peaks, key=lambda each: abs(each.hz - line_hz))
        pulls.append((peak.hz - line_hz) / peak.error_hz)
        assert peak.error_hz < 60
    assert np.abs(pulls).max() < 4


@pytest.mark.parametrize("seed", range(3, 10))
def test_the_best_start_ends_where_the_best_of_all_would(seed):
    """All starts are searched to the end here; the costs of their ends differ by up to 0.06."""
    rng = np.random.default_rng(seed)
    hz, quality = np.exp(rng.uniform(np.log([2000, 5]), np.log([15000, 50])))
    line = hz, quality, complex(*(0.2 * rng.standard_normal(2)))
    fit = _fit_of(HZ, log_drive(line, seed=seed), NONE, 0.005, None)
    none = np.zeros((0, 4))
    tops = [fit.likeliest_hz(none)]
    ends = []
    for start_quality, phase in product(_QUALITIES, _PHASES):
        strength = 2 / start_quality * np.exp(1j * phase)
        start = [np.log(tops[0]), np.log(start_quality), strength.real, strength.imag]
        ends.append(fit._minimum(np.array(start), tops).cost)  # noqa: SLF001  # without a limit
    found = fit.with_another(none, tops)
    cost = 0.5 * np.sum(fit.residual(found.ravel(), tops) ** 2)
    assert cost == pytest.approx(min(ends), abs=1e-3)


def test_derivatives_of_the_fit_of_lines_are_exact():
    hz = 2000 * 2 ** (np.arange(100) * 25 / 1200)
    rng = np.random.default_rng(4)
    fit = _fit_of(hz, rng.standard_normal(100), 1e-3 * np.eye(100), 0.01, None)
    lines = np.array([[np.log(2900.0), 3.0, 0.2, 0.1], [np.log(5100.0), 2.5, -0.1, 0.2]])
    tops, step = [2950.0, 5000.0], 1e-6
    moved = [
        (fit.residual(lines.ravel() + m, tops) - fit.residual(lines.ravel() - m, tops))
        for m in step * np.eye(8)
    ]
    exact = fit.jacobian(lines.ravel(), tops)
    np.testing.assert_allclose(exact, np.array(moved).T / (2 * step), rtol=1e-5, atol=1e-5)
