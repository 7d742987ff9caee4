"""What frames without fringes tell: as it was drawn."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.inference.effect_scan import Start, scan_effect
from diagnosis.inference.nuisances import NUISANCES
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observables.sensor import (
    Specimens,
    dark_group,
    flat_group,
    local_oscillator_group,
)
from diagnosis.readings.camera import (
    LocalOscillatorFrames,
    half_m,
    read_dark,
    read_flat,
    read_local_oscillator,
)
from physics.effects.lo_misalignment import EFFECT as LO_MISALIGNMENT
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters, with_part
from protocols.bench_parameters import sensor_of_camera
from tests.diagnosis.toy import fitted

N = 96
SENSOR = Sensor(shape=(N, N))


def part(stacks, exposures):
    """Make a run that kept frames."""
    steps = [SimpleNamespace(position=k, verdict=SimpleNamespace(measured=True))
             for k in range(len(stacks))]  # fmt: skip
    run = SimpleNamespace(
        steps=steps,
        saturation_dn=4095,
        frames=lambda position: stacks[position],
        exposure_of=lambda step: exposures[step.position],
    )
    return SimpleNamespace(run=run)


def drawn(mean_e, seed=0, read_e=12.0, bend=0.0, rows_e=0.0):
    """Four frames of a linear camera of 4 electrons per number, or of one that bends."""
    rng = np.random.default_rng(seed)
    # Every sensor's pixels differ by some tenths of a per cent.
    mean_e = mean_e * (1 + 3e-3 * np.random.default_rng(77).standard_normal((N, N)))
    electrons = rng.poisson(np.broadcast_to(mean_e, (4, N, N))) + read_e * rng.standard_normal(
        (4, N, N)
    )
    electrons = electrons + rows_e * rng.standard_normal((4, N, 1))
    electrons = electrons * (1 - bend * np.clip(electrons, 0, None) / 16000)
    return np.clip(np.rint(electrons / 4 + 50), 0, 4095).astype(np.uint16)


def dark(**changes):
    return read_dark([part([drawn(0.0, seed, **changes) for seed in range(4)], [0.08] * 4)])


def flat(shape=1.0, bend=0.0):
    exposures = [0.02, 0.04, 0.06, 0.08]
    return read_flat(
        [part([drawn(75e3 * t * shape, k, bend=bend) for k, t in enumerate(exposures)], exposures)],
        50.0,
    )


def left(block, parameters=None):
    return dict(
        zip(
            [p.quantity + p.region for p in block.coordinates],
            block.whitened_residual(parameters or BenchParameters()),
            strict=True,
        )
    )


def test_a_camera_as_its_data_sheet_says_leaves_nothing() -> None:
    plain = dark()
    assert plain.offset_dn == pytest.approx(50, abs=0.1)
    assert plain.noise_dn == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.01)
    assert plain.hot == 0
    for block in (dark_group(plain, SENSOR), flat_group(flat(), plain, SENSOR)):
        assert np.abs(block.whitened_residual(BenchParameters())).max() < 4


def test_read_noise_is_found_by_its_factor() -> None:
    # Specimens differ by a quarter from their data sheet: half as much again is no gap.
    assert 1 < left(dark_group(dark(read_e=18.0), SENSOR))["read noise"] < 3
    block = dark_group(dark(read_e=60.0), SENSOR)
    assert left(block)["read noise"] > 5
    louder = with_part(BenchParameters(), "sensor", read_noise_e=5 * SENSOR.read_noise_e)
    assert abs(left(block, louder)["read noise"]) < 1


def test_hot_pixels_are_counted_and_no_noise() -> None:
    rng = np.random.default_rng(9)
    hot = rng.random((N, N)) < 0.01
    found = read_dark([part([drawn(240.0 * hot, seed) for seed in range(4)], [0.08] * 4)])
    assert found.hot == pytest.approx(hot.mean(), rel=0.02)
    assert found.noise_dn == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.01)
    named = replace(BenchParameters(), sensor=Sensor(hot=float(hot.mean())))
    assert left(dark_group(found, SENSOR))["hot pixels"] > 3
    assert abs(left(dark_group(found, SENSOR), named)["hot pixels"]) < 1


def test_noise_that_rows_have_in_common_shows_in_rows_alone() -> None:
    found = dark(rows_e=12.0)
    assert found.row_excess > 2
    assert abs(found.column_excess) < 0.3


def test_a_camera_that_bends_is_found_by_its_bend() -> None:
    block = flat_group(flat(bend=0.12), dark(), SENSOR)
    assert max(abs(v) for k, v in left(block).items() if k.startswith("linearity")) > 5
    bent = replace(BenchParameters(), sensor=Sensor(nonlinearity=0.12))
    assert np.abs(block.whitened_residual(bent)).max() < 4


def test_a_camera_that_bends_much_is_as_full_as_it_was_and_not_as_it_shows() -> None:
    block = flat_group(flat(bend=0.2), dark(), SENSOR)
    bent = replace(BenchParameters(), sensor=Sensor(nonlinearity=0.2))
    off = {k: v for k, v in left(block, bent).items() if k.startswith("linearity")}
    # To first order in what the camera shows, the fullest frames would be off by more than 5.
    assert np.abs(list(off.values())).max() < 2


def test_dark_corners_and_a_shifted_beam_are_found() -> None:
    at = np.linspace(-1, 1, N)
    corner = 1 - 0.2 * 0.5 * (at[:, None] ** 2 + at**2)
    block = flat_group(flat(corner), dark(), SENSOR)
    # A lamp is uneven by a twentieth.
    assert abs(left(block)["cornerscorners"]) > 3
    assert (
        abs(
            left(block, with_part(BenchParameters(), "optics.illumination", vignette=0.2))[
                "cornerscorners"
            ]
        )
        < 2
    )
    (half, _) = half_m(SENSOR)
    y, x = half * at[:, None], half * at
    beam = np.exp(-2 * ((y - 4e-3) ** 2 + (x + 2e-3) ** 2) / 15e-3**2)
    lo = read_local_oscillator([part([drawn(6000 * beam, k) for k in range(8)], [0.08] * 8)], 50.0)
    block = local_oscillator_group(lo, SENSOR)
    assert abs(left(block)["middlerows"]) > 3
    shifted = with_part(
        BenchParameters(), "optics.illumination", local_oscillator_shift_m=(4e-3, -2e-3)
    )
    assert np.abs(block.whitened_residual(shifted)).max() < 3


def beam_group(waist_m: float, shift_m: tuple[float, float]):
    """Numbers of a beam, by its formula."""
    half_m_each = np.array(half_m(SENSOR))
    tilt = 4 * half_m_each * shift_m / waist_m**2
    bend = -2 * np.sum(half_m_each**2) / waist_m**2
    return local_oscillator_group(LocalOscillatorFrames(tilt, float(bend), 1500.0), SENSOR)


OF_BEAM = tuple(n for n in NUISANCES if "local oscillator" in n.name)


@pytest.mark.parametrize(("waist_m", "gain"), [(6e-3, 4), (9e-3, 3), (15e-3, 1)])
def test_a_beam_far_out_of_the_middle_is_found_whatever_its_width(waist_m, gain) -> None:
    shift_m = 1e-3 * np.array([-4.0, 9.0])
    problem = InferenceProblem([beam_group(waist_m, shift_m)], BenchParameters(), OF_BEAM)
    null, found = fitted(problem), fitted(problem, LO_MISALIGNMENT)
    assert found.log_evidence > null.log_evidence + gain
    # No hand is as far off, though a narrower beam would tilt by more.
    assert null.chi2["local oscillator"] > 3
    assert found.chi2["local oscillator"] < 1
    for (size, z, error), true_m in zip(
        found.size_estimates["lo_misalignment"], shift_m, strict=True
    ):
        assert size.scale * z == pytest.approx(true_m, abs=2 * size.scale * error)
        # By a hand that puts it within a millimetre, and by a width that bends little.
        assert 0.5e-3 < size.scale * error < 4e-3


@pytest.mark.parametrize("shift_m", [(-2.1e-3, 5.5e-3), (-4e-3, 9e-3), (6e-3, 6e-3)])
def test_a_scan_loses_little_of_an_effect_between_two_directions(shift_m) -> None:
    problem = InferenceProblem([beam_group(6e-3, shift_m)], BenchParameters(), OF_BEAM)
    null, found = fitted(problem), fitted(problem, LO_MISALIGNMENT)
    scan = scan_effect(problem, Start.without(problem, null.estimate), LO_MISALIGNMENT)
    assert scan.log_evidence == pytest.approx(found.log_evidence, abs=2)


@pytest.mark.parametrize("waist_m", [6e-3, 9e-3, 15e-3, 25e-3])
def test_a_beam_that_is_put_on_the_middle_by_eye_is_not_misaligned(waist_m: float) -> None:
    group = beam_group(waist_m, (0.7e-3, -1.4e-3))
    problem = InferenceProblem([group], BenchParameters(), OF_BEAM)
    null = fitted(problem)
    scan = scan_effect(problem, Start.without(problem, null.estimate), LO_MISALIGNMENT)
    assert scan is not None
    assert scan.log_evidence < null.log_evidence
    assert null.chi2["local oscillator"] < 1


@pytest.mark.parametrize("dark_dn", [40, 50])
def test_a_beam_that_was_blocked_is_not_read(dark_dn: int) -> None:
    black = part([np.full((4, N, N), dark_dn, np.uint16)] * 4, [0.08] * 4)
    assert read_local_oscillator([black], 50.0) is None
    noise = part([drawn(0.0, k) for k in range(4)], [0.08] * 4)
    assert read_local_oscillator([noise], 50.0) is None


def test_frames_in_which_a_part_of_the_pixels_is_saturated_do_not_count() -> None:
    y, x = np.meshgrid(*[np.linspace(-1, 1, N)] * 2, indexing="ij")
    beam = np.exp(-((y - 0.3) ** 2 + x**2))
    good, high = drawn(9000 * beam), drawn(24000 * beam)
    assert 0.05 < np.mean(high == 4095) < 0.45
    lo = read_local_oscillator([part([good, high], [0.03, 0.08])], 50.0)
    alone = read_local_oscillator([part([good], [0.03])], 50.0)
    assert lo is not None
    assert alone is not None
    assert (*lo.tilt, lo.bend, lo.signal_dn) == (*alone.tilt, alone.bend, alone.signal_dn)
    assert read_local_oscillator([part([high], [0.08])], 50.0) is None
    lit = read_flat([part([good, high], [0.03, 0.08])], 50.0)
    assert lit is not None
    assert lit.exposure_s.tolist() == [0.03]


def test_hot_pixels_do_not_make_frames_saturated() -> None:
    hot = np.zeros((N, N), dtype=bool)
    hot[:2] = True
    frames = np.where(hot, 4095, drawn(3000.0))
    lo = read_local_oscillator([part([frames], [0.04])], 50.0, hot)
    assert lo is not None
    assert read_local_oscillator([part([frames], [0.04])], 50.0) is None


@pytest.mark.parametrize("waist_m", [5e-3, 9e-3, 15e-3, 60e-3])
def test_a_hand_that_is_a_millimetre_off_tilts_a_narrow_beam_by_more(waist_m: float) -> None:
    beam = with_part(BenchParameters(), "optics.illumination", local_oscillator_waist_m=waist_m)
    group = beam_group(waist_m, (0.0, 0.0))
    half_y, half_x = half_m(SENSOR)
    by_hand = [n for n in OF_BEAM if n.unit == "m"]
    moved = np.array([group.predict(n.change(beam, n.spread)) for n in by_hand])
    expected = 4 * 1e-3 * np.diag([half_y, half_x]) / waist_m**2
    np.testing.assert_allclose(moved[:, :2], expected, rtol=1e-6, atol=1e-12)


def test_rows_and_columns_of_a_sensor_that_is_not_square_are_as_far_as_they_are() -> None:
    sheet = Sensor(shape=(N, 2 * N))
    half_y, half_x = half_m(sheet)
    assert half_x == 2 * half_y
    y, x = half_y * np.linspace(-1, 1, N)[:, None], half_x * np.linspace(-1, 1, 2 * N)
    shift_m = 1e-3, -2e-3
    frames = 50 + 1500 * np.exp(-2 * ((y - shift_m[0]) ** 2 + (x - shift_m[1]) ** 2) / 15e-3**2)
    block = local_oscillator_group(
        read_local_oscillator([part([np.stack([frames] * 4)], [0.08])], 50.0), sheet
    )
    shifted = with_part(BenchParameters(), "optics.illumination", local_oscillator_shift_m=shift_m)
    assert np.abs(block.whitened_residual(shifted)).max() < 1.5
    # A shift along columns tilts twice as much there as one along rows does here.
    # Of a wide beam, whose paraboloid is the beam itself.
    wide = with_part(
        shifted, "optics.illumination",
        local_oscillator_waist_m=5.0,
    )  # fmt: skip
    tilt = block.predict(wide)[:2]
    assert tilt[1] / tilt[0] == pytest.approx(2 * shift_m[1] / shift_m[0])


def test_hot_pixels_are_no_nonlinearity() -> None:
    exposures = [0.02, 0.04, 0.06, 0.08]
    hot = np.random.default_rng(9).random((N, N)) < 0.01
    found = read_dark([part([drawn(9600.0 * hot, seed) for seed in range(4)], [0.08] * 4)])
    lit = [drawn(75e3 * t + 9600.0 * hot, k) for k, t in enumerate(exposures)]
    known = read_flat([part(lit, exposures)], 50.0, found.hot_pixels)
    linearity = [v for k, v in left(flat_group(known, found, SENSOR)).items() if "linearity" in k]
    assert np.abs(linearity).max() < 2
    # The test has something to find: without the map of hot pixels the camera seems to bend.
    blind = read_flat([part(lit, exposures)], 50.0)
    linearity = [v for k, v in left(flat_group(blind, found, SENSOR)).items() if "linearity" in k]
    assert np.abs(linearity).max() > 4


def deviations(group):
    """Standard deviations of noise, and of each nuisance, by number."""
    names = [p.quantity + p.region for p in group.coordinates]
    errors = group.errors

    def of(columns):
        return dict(zip(names, np.sqrt(np.sum(columns**2, axis=1)), strict=True))

    noise = dict(zip(names, np.sqrt(np.diag(errors.covariance())), strict=True))
    return noise, {each.name: of(each.columns) for each in errors.nuisances}


def test_what_dark_frames_measure_is_noise_and_what_cameras_differ_by_is_disorder() -> None:
    found = dark()
    noise, disorder = deviations(dark_group(found, SENSOR))
    assert noise["offset"] == pytest.approx(0.1)
    # The log of a standard deviation has half the error of that of a variance.
    of_rows = np.hypot(0.01, np.sqrt(2 / (N * (found.frames - 1))))
    assert noise["read noise"] == pytest.approx(0.005, rel=0.2)
    assert noise["noise of rows"] == pytest.approx(of_rows, rel=0.02)
    assert noise["hot pixels"] == 1
    # Forty stacks of dark frames scatter as stated.
    again = [read_dark([part([drawn(0.0, seed)], [0.08])]) for seed in range(20, 60)]
    scatter = np.std([each.row_excess for each in again])
    one = np.sqrt(2 / (N * (again[0].frames - 1)))
    assert scatter == pytest.approx(one, rel=0.35)
    assert disorder["black level"]["offset"] == 10
    assert disorder["noise of the camera"]["read noise"] == pytest.approx(np.hypot(0.25, 0.1))
    assert disorder["noise in common"]["noise of rows"] > 0.5
    for name, column in disorder.items():
        assert sum(value > 0 for value in column.values()) == (2 if "common" in name else 1)


def test_all_rates_of_light_share_the_error_of_the_shortest_exposure() -> None:
    group = flat_group(flat(), dark(), SENSOR)
    covariance = group.errors.covariance()
    rates = [k for k, p in enumerate(group.coordinates) if p.quantity.startswith("linearity")]
    shared = covariance[np.ix_(rates, rates)] - np.diag(np.diag(covariance)[rates])
    off = shared[~np.eye(len(rates), dtype=bool)]
    assert off == pytest.approx(off[0])
    assert 0 < off[0] < covariance[rates[0], rates[0]]
    _, disorder = deviations(group)
    # A lamp that drifts between two exposures.
    for k in rates:
        name = group.coordinates[k].quantity
        assert disorder["drift of the lamp"][name] == pytest.approx(3e-3 * np.sqrt(2))
    assert disorder["gain of the camera"]["electrons per number"] == pytest.approx(0.1)


def test_of_one_exposure_there_is_no_linearity() -> None:
    one = read_flat([part([drawn(3000.0)], [0.04])], 50.0)
    group = flat_group(one, dark(), SENSOR)
    assert not any(p.quantity.startswith("linearity") for p in group.coordinates)
    assert np.isfinite(group.whitened_residual(BenchParameters())).all()


def test_a_smooth_lamp_is_no_pattern_of_pixels() -> None:
    y, x = np.meshgrid(np.arange(N), np.arange(N), indexing="ij")
    waves = 1 + 0.03 * np.sin(2 * np.pi * y / 80) * np.cos(2 * np.pi * x / 110)
    even, wavy = flat().pattern, flat(waves).pattern
    assert even == pytest.approx(3e-3, rel=0.15)
    assert wavy == pytest.approx(even, rel=0.1)


ANY = Specimens.of(SimpleNamespace(data_sheet=False, nominal=BenchParameters()))


@pytest.mark.parametrize("off_dn", [-10.0, 20.0, 50.0])
def test_without_dark_frames_the_black_level_is_anyone_s(off_dn: float) -> None:
    """Numbers that a wrong offset moves are as uncertain as it is."""
    exposures = [0.02, 0.04, 0.06, 0.08]
    frames = [drawn(75e3 * t, k) + np.uint16(60) for k, t in enumerate(exposures)]
    found = read_flat([part(frames, exposures)], 110.0 - off_dn)
    for specimens, most in ((Specimens(), abs(off_dn) / 10), (ANY, abs(off_dn) / 82)):
        block = flat_group(found, None, SENSOR, specimens)
        off = block.whitened_residual(BenchParameters())
        # One amount explains all of it: by as many deviations as the black level is off.
        assert off @ off < 9 + 1.5 * most**2
    # It has something to find.
    sure = flat_group(found, dark(), SENSOR).whitened_residual(BenchParameters())
    assert sure @ sure > (9 + 1.5 * (off_dn / 10) ** 2 if abs(off_dn) > 10 else 9)


def test_a_camera_without_a_data_sheet_may_be_any() -> None:
    """Of 60 electrons per number and 8 bits."""
    rng = np.random.default_rng(3)

    def frames(mean_e):
        electrons = rng.poisson(np.full((4, N, N), mean_e)) + 20 * rng.standard_normal((4, N, N))
        return np.clip(np.rint(electrons / 60 + 4), 0, 255).astype(np.uint16)

    exposures = [0.02, 0.04, 0.06, 0.08]
    camera = SimpleNamespace(height=N, width=N, pixel_m=SENSOR.pixel_m, bits=8, data_sheet=None)
    nominal = replace(BenchParameters(), sensor=sensor_of_camera(camera))
    assert nominal.sensor.full_well_e / nominal.sensor.gain_e_dn == pytest.approx(250)
    specimens = Specimens.of(SimpleNamespace(data_sheet=False, nominal=nominal))
    dim = read_dark([part([frames(0.0) for _ in range(4)], [0.08] * 4)])
    lit = read_flat([part([frames(150e3 * t) for t in exposures], exposures)], dim.offset_dn)
    for block in (
        dark_group(dim, nominal.sensor, specimens),
        flat_group(lit, dim, nominal.sensor, specimens),
        flat_group(lit, None, nominal.sensor, specimens),
    ):
        assert np.abs(block.whitened_residual(nominal)).max() < 3
    # As the camera of the paper it would be beyond doubt another one.
    wrong = flat_group(lit, dim, Sensor(), Specimens())
    assert np.abs(wrong.whitened_residual(BenchParameters())).max() > 10


def test_more_read_noise_than_variance_leaves_numbers() -> None:
    found = flat()
    noisy = replace(found, variance_dn=np.full(len(found.exposure_s), 4.0))
    block = flat_group(noisy, None, SENSOR)
    assert np.isfinite(block.whitened_residual(BenchParameters())).all()


@pytest.mark.parametrize("waist_m", [4e-3, 6e-3, 15e-3])
def test_a_narrow_beam_is_predicted_as_it_is_measured(waist_m: float) -> None:
    """By the paraboloid nearest to it, which bends less than the middle of the beam."""
    sheet = Sensor(shape=(512, 640))
    half_y, half_x = half_m(sheet)
    y, x = half_y * np.linspace(-1, 1, 512)[:, None], half_x * np.linspace(-1, 1, 640)
    frames = 50 + 1500 * np.exp(-2 * (y**2 + x**2) / waist_m**2)
    lo = read_local_oscillator([part([np.stack([frames] * 4)], [0.08])], 50.0)
    named = with_part(BenchParameters(), "optics.illumination", local_oscillator_waist_m=waist_m)
    block = local_oscillator_group(lo, sheet)
    assert block.predict(named) == pytest.approx([*lo.tilt, lo.bend], abs=3e-3)
