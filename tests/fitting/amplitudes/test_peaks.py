"""Displacements in nm, of planted amplitudes and of the simulated bench."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.amplitudes.peaks import PeakAmplitudes, mode_amplitudes, peak_amplitudes
from fitting.amplitudes.response import Response
from fitting.amplitudes.vamp import VampPoints, vamp_points
from fitting.cane.fit_runs import fit_runs
from fitting.fringes.start_frequencies import middling_shapes
from fitting.reed_place import ReedPlace, nominal_place
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.geometry import half_width_m
from physics.reed.reduced.elastic import elastic_modes
from physics.reed.surface import surface_shapes
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from studies.amplitudes.comparison import compare_modes, compare_peaks, model_of, summary

WAVELENGTH_M = 650e-9
NM_PER_RAD = 650 / (4 * np.pi)


# --- Planted amplitudes ------------------------------------------------------------------------


def planted(amplitude_rad, spread_rad=0.01, shared=0.0):
    """A fit of two functions at three points, of which the second one moves most."""
    count = len(amplitude_rad)
    response = np.zeros((count, 4, 1))
    # The common-mode error scales all displacements.
    response[:, :, 0] = np.concatenate([amplitude_rad.real, amplitude_rad.imag], axis=1)
    return SimpleNamespace(
        displacements=SimpleNamespace(
            amplitude_rad=amplitude_rad,
            information=np.tile(np.eye(4) / spread_rad**2, (count, 1, 1)),
            common_mode=SimpleNamespace(
                response=response, whole=np.array([[1 / max(shared, 1e-9) ** 2]])
            ),
            reached=np.ones(count, dtype=bool),
        ),
        block_amplitudes=SimpleNamespace(place=nominal_place()),
        modal=SimpleNamespace(magnitude_error=np.zeros(count)),
    )


def nearby(count):
    """A mode at 2 kHz, holograms 25 cents apart around it, each with 3 rad."""
    fit = planted(np.tile([3.0, 0.0], (count, 1)).astype(complex), 1e-6)
    cents = 25 * (np.arange(count) - count // 2)
    fit.block_amplitudes.drive_hz = 2000.0 * 2 ** (cents / 1200)
    fit.block_amplitudes.volts = np.full(count, 2.0)
    fit.names, fit.modal = ("F1",), modal_of(2000.0, np.array([[3.0, 0.0]]), count=count)
    return fit


@pytest.mark.parametrize("how", ["unsolved", "unreached", "outlier"])
def test_a_mode_does_not_depend_on_a_hologram_that_is_not_explained(how):
    fit = nearby(5)
    right = mode_amplitudes(fit, POINTS, WAVELENGTH_M)["F1"]
    fit.displacements.amplitude_rad[2] = 0.0 if how == "unsolved" else 7.0
    if how == "unsolved":
        fit.displacements.information[2] = 0.0
        fit.displacements.common_mode.response[2] = 0.0
    fit.displacements.reached[2] = how == "outlier"
    fit.modal.off[2] = how == "outlier"
    assert mode_amplitudes(fit, POINTS, WAVELENGTH_M)["F1"] == right


def test_a_mode_in_a_sweep_that_nothing_explains_is_as_the_fit_of_modes_has_it():
    fit = nearby(3)
    fit.displacements.amplitude_rad[:] = 0.0
    fit.displacements.information[:] = 0.0
    fit.modal.off[:] = True
    mode = mode_amplitudes(fit, POINTS, WAVELENGTH_M)["F1"]
    assert mode.nm == pytest.approx(6 * NM_PER_RAD)
    assert np.isfinite(mode.nm_per_v_error)


def modal_of(hz, amplitude_rad, shift=0.0, variance=0.0, count=2):
    """Modes of a fit with one mode, whose drive scatters by 1 %."""
    return SimpleNamespace(
        hz=np.array([hz]),
        common_mode_shift=np.full((count, 1), shift),
        magnitude_error=np.zeros(count),
        off=np.zeros(count, dtype=bool),
        state=SimpleNamespace(gain=0.01),
        resonant=SimpleNamespace(
            amplitude_rad=amplitude_rad, covariance=variance * np.eye(2)[None]
        ),
    )


POINTS = VampPoints(
    np.array([1e-3, 0.0, 2e-3]),
    np.array([0.0, 5e-3, 0.0]),
    np.array([[1.0, 0.2], [2.0, 0.5], [0.3, 1.0]]),
    # The first function falls along x by 10 % a millimetre, and both rise along y by 20 %.
    np.array(
        [
            [[-100.0, 0.0], [-200.0, 0.0], [-30.0, 0.0]],
            [[200.0, 40.0], [400.0, 100.0], [60.0, 200.0]],
        ]
    ),
)


def test_a_displacement_is_the_phase_times_the_wavelength_over_4_pi():
    peaks = peak_amplitudes(planted(np.array([[3.0, 0.0], [0.0, 4j]])), POINTS, WAVELENGTH_M)
    assert peaks.nm == pytest.approx([6 * NM_PER_RAD, 4 * NM_PER_RAD])
    assert list(peaks.x_m) == [0.0, 2e-3]
    assert list(peaks.y_m) == [5e-3, 0.0]


def test_the_error_is_that_of_the_noise_at_the_largest_point():
    rng, spread = np.random.default_rng(3), 0.05
    true = np.tile([3.0 + 1j, 0.5], (4000, 1))
    noise = spread * (rng.standard_normal(true.shape) + 1j * rng.standard_normal(true.shape))
    peaks = peak_amplitudes(planted(true + noise, spread), POINTS, WAVELENGTH_M)
    assert np.std(peaks.nm) == pytest.approx(np.median(peaks.error_nm), rel=0.05)


def test_the_common_mode_error_adds_to_the_error():
    """All displacements are 2 % too large or too small; and 0.1 % from the continuation."""
    peaks = peak_amplitudes(planted(np.array([[30.0, 0.0]]), 1e-6, 0.02), POINTS, WAVELENGTH_M)
    assert peaks.error_nm == pytest.approx(np.hypot(0.02, 1e-3) * peaks.nm, rel=1e-6)


def test_light_that_may_be_brighter_adds_to_the_error():
    """By 3 % in the first hologram; the second one has fringes, and does not follow the light."""
    fit = planted(np.array([[3.0, 0.0], [3.0, 0.0]]), 1e-6)
    fit.displacements.common_mode.response[1] = 0.0
    fit.modal.magnitude_error = np.array([0.03, 0.03])
    peaks = peak_amplitudes(fit, POINTS, WAVELENGTH_M)
    assert peaks.error_nm == pytest.approx(np.hypot([0.03, 0.0], 1e-3) * peaks.nm, rel=1e-6)


def test_the_error_of_the_place_adds_to_the_error():
    """Along 0.01 mm, across 0.02 mm, a turn of 1 mrad, a size of 0.2 %, at x = 0, y = 5 mm."""
    fit = planted(np.array([[3.0j, 0.0]]), 1e-6)
    errors = 0.01e-3, 0.02e-3, 1e-3, 2e-3
    fit.block_amplitudes.place = ReedPlace(0, 0, 0, 0, np.diag(np.square(errors)))
    peaks = peak_amplitudes(fit, POINTS, WAVELENGTH_M)
    # Per millimetre it changes by 10 % and 20 %; the turn moves the point by 5 µm along x, and the
    # size by 10 µm along y.
    parts = 0.01 * 0.1, 0.02 * 0.2, 0.005 * 0.1, 0.01 * 0.2, 1e-3
    assert peaks.error_nm == pytest.approx(np.linalg.norm(parts) * peaks.nm, rel=1e-6)
    fit.block_amplitudes.drive_hz, fit.block_amplitudes.volts = np.array([2e3]), np.array([2.0])
    fit.names = ("F1",)
    fit.modal = modal_of(2e3, np.array([[3.0, 0.0]]))
    mode = mode_amplitudes(fit, POINTS, WAVELENGTH_M)["F1"]
    assert mode.error_nm == pytest.approx(np.linalg.norm(parts) * mode.nm, rel=1e-6)


@pytest.mark.parametrize(("hz", "share"), [(2000.0, 1.0), (np.sqrt(2000 * 2100), 0.5**0.5)])
def test_the_drive_s_scatter_adds_to_the_error_per_volt(hz, share):
    """In the middle between two holograms, the scatter of both is averaged."""
    fit = planted(np.array([[3.0, 0.0], [3.0, 0.0]]), 1e-6)
    fit.block_amplitudes.drive_hz = np.array([2000.0, 2100.0])
    fit.block_amplitudes.volts = np.array([2.0, 2.0])
    fit.names = ("F1",)
    fit.modal = modal_of(hz, np.array([[3.0, 0.0]]))
    mode = mode_amplitudes(fit, POINTS, WAVELENGTH_M)["F1"]
    assert mode.nm_per_v == pytest.approx(3 * NM_PER_RAD)
    error = np.hypot(mode.error_nm / mode.nm, share * fit.modal.state.gain)
    assert mode.nm_per_v_error == pytest.approx(error * mode.nm_per_v)
    assert error > 5 * mode.error_nm / mode.nm * share


def test_slopes_are_those_of_the_functions(reed, blocks):
    cane = viscoelastic_cane(Components(), Series.A)
    basis = middling_shapes(reed, cane, *blocks)
    points = vamp_points(reed, basis, *blocks)
    x_m, y_m = blocks
    # Blocks 0.6 mm apart, along x and along y, and the mean of their slopes.
    for axis, (along, other) in enumerate(((x_m, y_m), (y_m, x_m))):
        apart = np.isclose(along[:, None] + 0.6e-3, along) & np.isclose(other[:, None], other)
        first, second = np.nonzero(apart)
        assert first.size > 1000
        change = points.functions[second] - points.functions[first]
        mean = 0.5 * (points.slopes[axis, first] + points.slopes[axis, second])
        off = np.sqrt(np.mean((change - 0.6e-3 * mean) ** 2))
        # They are differences over 0.2 mm, and serve for errors.
        assert off < 0.15 * np.sqrt(np.mean(change**2))


def test_holograms_without_a_solution_have_no_displacement():
    fit = planted(np.array([[3.0, 0.0], [5.0, 0.0]]))
    fit.displacements.reached[1] = False
    peaks = peak_amplitudes(fit, POINTS, WAVELENGTH_M)
    assert np.isfinite(peaks.nm[0])
    assert np.isnan([peaks.nm[1], peaks.error_nm[1]]).all()


def response_of(nm, off=()):
    count = len(nm)
    nm = np.array(nm, float)
    return Response(
        drive_hz=1500.0 + 100 * np.arange(count),
        step_index=10 + np.arange(count),
        volts=np.full(count, 2.0),
        names=(),
        amplitude_nm=np.zeros((count, 0)),
        peak=PeakAmplitudes(nm, 0.01 * nm, np.full(count, 1e-3), np.full(count, -2e-3)),
        off=np.isin(np.arange(count), off),
        wavelength_m=WAVELENGTH_M,
    )


def test_the_largest_displacement_is_that_of_a_hologram_that_the_modes_explain():
    largest = response_of([10, np.nan, 70, 900], off=[3]).largest
    assert (largest.nm, largest.hz, largest.step_index) == (70, 1700, 12)
    assert (largest.error_nm, largest.x_mm, largest.y_mm) == pytest.approx((0.7, 1.0, -2.0))
    assert response_of([np.nan, 5], off=[1]).largest is None


def test_unknown_displacements_are_null_in_json():
    answer = json.loads(json.dumps(response_of([10, np.nan]).to_json(), allow_nan=False))
    assert answer["peak_nm"] == [10, None]
    assert answer["peak_error_nm"] == [0.1, None]


@pytest.mark.parametrize("turn_rad", [0.0, 0.3])
def test_a_turn_that_the_modal_fit_adds_to_all_displacements_changes_no_size(turn_rad):
    """It adds the turn as ``1 + iθ``, which is longer than 1."""
    fit = planted(np.array([[3.0, 0.0]]))
    fit.displacements.common_mode.response[0, :, 0] = [0.0, 0.0, 3.0, 0.0]
    stretched = 3.0 * abs(1 + 1j * turn_rad)
    fit.block_amplitudes = SimpleNamespace(
        drive_hz=np.array([2000.0]), volts=np.array([2.0]), place=nominal_place()
    )
    fit.names = ("F1",)
    fit.modal = modal_of(2000.0, np.array([[stretched, 0.0]]), turn_rad, 1e-4)
    found = mode_amplitudes(fit, POINTS, WAVELENGTH_M)["F1"]
    assert found.nm == pytest.approx(6 * NM_PER_RAD)
    assert (found.x_m, found.y_m, found.volts) == (0.0, 5e-3, 2.0)
    expected_rad = np.hypot(0.01 * np.hypot(2.0, 0.5), 1e-3 * 6.0)
    assert found.error_nm == pytest.approx(expected_rad * NM_PER_RAD)


# --- The whole vamp ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def blocks(reed):
    """Places of blocks, which end before the contour."""
    along, across = np.arange(0.7e-3, 35e-3, 0.6e-3), np.arange(-6.2e-3, 6.2e-3, 0.6e-3)
    x_m, y_m = (axis.ravel() for axis in np.meshgrid(along, across))
    inside = half_width_m(reed.geometry.outline, x_m) - np.abs(y_m) > 0.25e-3
    return x_m[inside], y_m[inside]


def test_shapes_are_continued_to_the_tip_and_the_sides(reed, blocks):
    cane = viscoelastic_cane(Components(), Series.A)
    basis = middling_shapes(reed, cane, *blocks)
    points = vamp_points(reed, basis, *blocks)
    assert points.x_m.min() == 0
    on_contour = np.arange(len(points.x_m)) >= len(blocks[0])
    half = half_width_m(reed.geometry.outline, points.x_m[on_contour])
    assert np.abs(points.y_m[on_contour]) == pytest.approx(half)
    modes = elastic_modes(reed, 1.36e10, 8.9e8)
    surface = surface_shapes(reed, points.x_m, points.y_m)
    for name, at_least in (("F1", 1.005), ("T1", 1.03), ("T2", 1.06)):
        true = surface[modes[name].part] @ modes[name].coordinates
        count = len(blocks[0])
        found = points.functions @ (points.functions[:count].T @ true[:count] / count)
        assert np.abs(found - true).max() < 0.003 * np.abs(true).max()
        # It moves more there than at any block.
        assert np.abs(true).max() > at_least * np.abs(true[:count]).max()


# --- The simulated bench -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured(sweep_a):
    return fit_runs([sweep_a]).sweeps[0]


@pytest.fixture(scope="module")
def bench_plan():
    small = {"camera.width": 640, "camera.height": 512, "sweep.stride": 2, "sweep.last": 173}
    return make_plan(Protocol.from_file("seriesA").replace(small), BenchFile.from_file())


@pytest.mark.slow
def test_displacements_are_those_from_which_frames_were_rendered(measured, bench_plan):
    """A quarter of the sensor, half of the steps, from 25 nm to 2.8 µm."""
    model = model_of(bench_plan, "R07")
    peaks = compare_peaks(measured, bench_plan, model)
    found = summary(peaks)
    assert found["count"] > 80
    assert abs(found["mean_relative"]) < 0.01
    assert 0.5 < found["coverage_68"] < 0.85
    below_2_um = [row for row in peaks if row.true_nm < 2000]
    assert max(abs(row.nm - row.true_nm) for row in below_2_um) < 15
    modes = compare_modes(measured, model)
    assert {row.name for row in modes} >= {"F1", "T1", "F2", "T2", "X1", "T3", "F3", "X2", "X3"}
    assert np.median([abs(row.pull) for row in modes]) < 1.5


@pytest.mark.slow
def test_twice_the_wavelength_would_be_seen(measured, bench_plan):
    """The comparison can fail."""
    response = measured.response
    twice = replace(response.peak, nm=2 * response.peak.nm)
    wrong = replace(measured, response=replace(response, peak=twice))
    found = summary(compare_peaks(wrong, bench_plan, model_of(bench_plan, "R07")))
    assert found["rms_pull"] > 10
