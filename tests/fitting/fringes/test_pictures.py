"""Brightness of points on the reed, read from a real run file."""

import numpy as np
import pytest

import acquire
from fitting.errors import FitError
from fitting.fringes.pictures import read_pictures
from physics.reed.geometry import Outline, half_width_m
from protocols.bench import BenchFile
from runs.reader import Run


@pytest.fixture(scope="module")
def pictures(sweep_a):
    with Run.open(sweep_a) as run:
        return read_pictures(run)


def read(path):
    with Run.open(path) as run:
        return read_pictures(run)


def test_runs_of_another_main_sideband_are_refused_with_the_remedy(changed, resealed):
    path = changed()
    with resealed(path) as file:
        file["entry/instrument/synthesizers/sideband_order"][...] = 2
    with pytest.raises(FitError, match="pictures are of sideband 2, and fits need the first; meas"):
        read(path)


def test_every_good_step_is_a_picture_in_order_of_frequency(sweep_a, pictures):
    with Run.open(sweep_a) as run:
        assert run.good.all()
        assert pictures.step_index.tolist() == [step.index for step in run]
        assert pictures.drive_hz == pytest.approx([float(s.read_drive_hz) for s in run], rel=1e-12)
    assert (np.diff(pictures.drive_hz) > 0).all()
    assert pictures.brightness.shape == (87, len(pictures.x_m))
    assert pictures.brightness.dtype == np.float32


def test_points_lie_on_the_visible_reed_and_cover_it(pictures):
    x, y = pictures.x_m, pictures.y_m
    assert (np.abs(y) < half_width_m(Outline(), x)).all()
    assert 0.3e-3 < x.min() < 1.5e-3
    assert 34e-3 < x.max() < 36e-3
    assert y.max() > 5e-3
    assert y.min() < -5e-3
    assert 500 < len(x) <= 1300


def test_brightness_is_the_mean_square_of_a_block_less_the_noise(sweep_a, pictures):
    with Run.open(sweep_a) as run:
        # 0.35 mm are two pixels of 151 µm along x, and two of 190 µm along y.
        pitch_y, pitch_x = abs(np.diff(run.y_m[:2])[0]), abs(np.diff(run.x_m[:2])[0])
        factors = round(0.35e-3 / pitch_y), round(0.35e-3 / pitch_x)
        assert factors == (2, 2)
        for picture, point in ((0, 0), (40, 100), (86, -1)):
            step = run.steps[picture]
            power = np.abs(run.field(step.position).astype(complex)) ** 2
            rows, columns = (
                np.argsort(np.abs(axis - at))[:2]
                for axis, at in ((run.y_m, pictures.y_m[point]), (run.x_m, pictures.x_m[point]))
            )
            block = power[np.ix_(rows, columns)].mean()
            expected = block - step.noise_level
            assert pictures.brightness[picture, point] == pytest.approx(expected, rel=1e-4)


def test_noise_is_taken_off_without_a_bias(changed, resealed):
    """Pictures of nothing have a mean brightness of zero."""
    path = changed(only=(1, 21))
    rng = np.random.default_rng(1)
    with resealed(path) as file:
        field, level = file["entry/data/field"], file["entry/steps/noise_level"]
        for position in range(11):
            pair = rng.standard_normal((2, *field.shape[1:]))
            field[position] = np.sqrt(level[position] / 2) * (pair[0] + 1j * pair[1])
        levels = level[:11]
    brightness = read(path).brightness
    assert brightness.shape[0] == 11
    relative = brightness.mean(axis=1) / levels
    # Some 1200 blocks of 4 pixels: the mean of their noise is good to 1.5 %.
    assert np.abs(relative).max() < 0.06


def test_the_order_of_steps_in_the_file_is_of_no_matter(pictures, changed):
    shuffled = read(changed(order=np.random.default_rng(2).permutation(87)))
    for name in ("brightness", "x_m", "y_m", "step_index", "drive_hz"):
        assert np.array_equal(getattr(shuffled, name), getattr(pictures, name))


def test_bad_steps_are_left_out_and_the_others_are_as_they_were(pictures, changed):
    bad = {5: "saturated", 59: "dropped", 61: "stale", 171: "lock", 173: "no_signal", 3: "pending"}
    left = read(changed(verdicts=bad))
    kept = ~np.isin(pictures.step_index, list(bad))
    assert np.array_equal(left.step_index, pictures.step_index[kept])
    assert np.array_equal(left.brightness, pictures.brightness[kept])


def test_too_few_pictures_are_refused_with_what_is_wrong(changed):
    verdicts = {15: "saturated", 17: "saturated", 19: "dropped"}
    path = changed(only=(1, 19), verdicts=verdicts)
    with pytest.raises(FitError) as refused:
        read(path)
    message = str(refused.value)
    assert message.startswith(f"{path}: 7 of 87 steps are good, a fit needs at least 8")
    assert "77 pending" in message
    assert "2 saturated" in message
    assert "1 dropped" in message
    assert message.isprintable()


def test_eight_pictures_are_enough(changed):
    assert len(read(changed(only=(1, 15))).drive_hz) == 8


def test_a_run_without_the_loudspeaker_has_no_pictures(tmp_path):
    bench = BenchFile.from_file().replace(twin={"faults": {"tweeter_unplugged": True}})
    protocol = acquire.load("quick").replace(
        {"sweep.last": 32, "camera.width": 320, "camera.height": 256}
    )
    path = tmp_path / "unplugged.h5"
    acquire.run(acquire.plan(protocol, bench).plan, path, reed="R07")
    with pytest.raises(FitError, match=r"0 of 11 steps are good.*\d+ no_signal.*'s cable"):
        read(path)
