"""Block amplitudes of planted matrices of rank one, and of run files made for the test."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import yaml
from scipy.linalg import toeplitz
from scipy.special import j0, j1, jv

import acquire
from fitting.errors import FitError
from fitting.holograms.block_amplitudes import (
    UnshiftedLight,
    _blocks,
    _in_blocks,
    _leading,
    read_block_amplitudes,
)
from fitting.reed_place import nominal_place
from holography.apodisation import Taper
from physics.reed.geometry import Outline, half_width_m
from protocols.protocol import Protocol
from runs.reader import Run
from tests.numbers import complex_normal

# Side of a block and margin inside the contour, as the module promises them.
BLOCK_M, EDGE_M = 0.38e-3, 0.25e-3
NUMBERS = {"holograms": 50, "pixels": 6, "blocks": 300}


def leading(holograms):
    """Block amplitudes, and shares of light."""
    value, vectors = _leading(holograms)
    return value, np.abs(vectors) ** 2


def read(path):
    with Run.open(path) as run:
        return read_block_amplitudes(run)


# Windows of blocks of two and three pixels: 0.25 % of the light comes from beyond a side.
TAPERS = (Taper(0.906), Taper(0.560))

# --- Matrices of rank one ----------------------------------------------------------------------


def planted(light, seed=0, **numbers):
    """Block amplitudes (n, k), speckle field (n, p) of a given norm, and noisy holograms."""
    rng = np.random.default_rng(seed)
    size = {**NUMBERS, **numbers}
    n, k, p = size["blocks"], size["holograms"], size["pixels"]
    phasor = rng.uniform(0, 0.58, (n, k)) * np.exp(2j * np.pi * rng.uniform(size=(n, k)))
    a = complex_normal(rng, n, p)
    a *= light / np.linalg.norm(a, axis=1, keepdims=True)
    holograms = phasor[:, :, None] * a[:, None, :] + complex_normal(rng, n, k, p)
    return phasor, a, holograms.astype(np.complex64)


def apart(value, phasor):
    """What is left (n, k) of values when each block's best complex multiple is taken off."""
    power = np.sum(np.abs(phasor) ** 2, axis=1, keepdims=True)
    factor = np.sum(phasor.conj() * value, axis=1, keepdims=True) / power
    return value - factor * phasor, np.abs(factor[:, 0])


def test_without_noise_phasors_come_out_up_to_one_factor_for_each_block():
    phasor, a, _ = planted(30.0)
    value, share = leading((phasor[:, :, None] * a[:, None, :]).astype(np.complex64))
    left, factor = apart(value, phasor)
    assert np.abs(left).max() < 1e-4
    assert factor == pytest.approx(30, rel=1e-5)
    assert share == pytest.approx(np.abs(a / 30) ** 2, abs=1e-5)


@pytest.mark.parametrize("light", [30.0, 100.0, 300.0])
def test_noise_of_a_phasor_is_that_of_one_pixel_and_light_that_of_all(light):
    phasor, _, holograms = planted(light)
    left, factor = apart(leading(holograms)[0], phasor)
    # One complex factor of 50 numbers is fitted.
    assert np.mean(np.abs(left) ** 2) * 50 / 49 == pytest.approx(1, abs=0.03)
    assert np.mean(left**2) == pytest.approx(0, abs=0.03)
    assert factor == pytest.approx(light, rel=4 / light)


def test_the_error_of_a_phasor_is_noise_over_light():
    errors = []
    for light in (50.0, 200.0):
        phasor, _, holograms = planted(light)
        left, factor = apart(leading(holograms)[0], phasor)
        errors.append(np.sqrt(np.mean(np.abs(left / factor[:, None]) ** 2)))
    assert errors[0] == pytest.approx(1 / 50, rel=0.03)
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.03)


def test_where_nothing_moves_there_is_noise_of_variance_one():
    _, _, holograms = planted(40.0)
    rng = np.random.default_rng(9)
    holograms[:, ::5] = complex_normal(rng, *holograms[:, ::5].shape)
    value, _ = leading(holograms)
    assert np.mean(np.abs(value[:, ::5]) ** 2) == pytest.approx(1, abs=0.06)


def test_shares_are_those_of_the_light_and_add_up_to_one():
    _, a, holograms = planted(100.0)
    _, share = leading(holograms)
    assert share.shape == a.shape
    assert share.sum(axis=1) == pytest.approx(1, abs=1e-5)
    # Relative error of a pixel's light is one over the root of Σ|F|² = 5.6, over 100.
    assert share == pytest.approx(np.abs(a / 100) ** 2, abs=0.02)


def test_blocks_know_nothing_of_each_other():
    _, _, holograms = planted(40.0, blocks=20)
    value, share = leading(holograms)
    for n in (0, 7, 19):
        alone, its_share = leading(holograms[n : n + 1])
        assert np.abs(alone[0]) == pytest.approx(np.abs(value[n]), rel=1e-4, abs=1e-4)
        assert its_share[0] == pytest.approx(share[n], abs=1e-5)


def test_one_pixel_is_its_own_phasor():
    _, _, holograms = planted(40.0, pixels=1, blocks=10)
    value, share = leading(holograms)
    assert np.abs(value) == pytest.approx(np.abs(holograms[..., 0]), rel=1e-5)
    assert share == pytest.approx(1, abs=1e-6)
    turn = value / holograms[..., 0]
    assert turn == pytest.approx(np.broadcast_to(turn[:, :1], turn.shape), abs=1e-4)


def test_axes_are_cut_into_whole_blocks():
    axis = np.arange(11) * 0.1
    blocks = _in_blocks(axis, 3)
    assert blocks == pytest.approx(np.arange(9).reshape(3, 3) * 0.1)
    assert _in_blocks(axis, 1).shape == (11, 1)


# --- Run files ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def block_amplitudes(sweep_a):
    return read(sweep_a)


@pytest.fixture(scope="module")
def axes(sweep_a):
    """Coordinates of rows and columns, and how many of each make up a block."""
    with Run.open(sweep_a) as run:
        y, x = run.y_m, run.x_m
    return y, x, *(round(BLOCK_M / abs(axis[1] - axis[0])) for axis in (y, x))


@pytest.fixture
def at_nominal_place(monkeypatch):
    """Light without edges, which tells no place."""
    monkeypatch.setattr(
        "fitting.holograms.block_amplitudes.reed_place", lambda _run, _steps: nominal_place()
    )


@pytest.fixture
def rectangular(monkeypatch):
    """A sensor without a window: no pixel shows light of another one."""
    monkeypatch.setattr("fitting.holograms.block_amplitudes._FROM_BEYOND", 1.0)


@pytest.fixture(scope="module")
def write_fields(resealed):
    """Put fields (k, y, x) in units of noise into a run file."""

    def write(path, fields):
        with resealed(path) as file:
            level = file["entry/steps/noise_level"][: len(fields)]
            kept = file["entry/data/field"]
            kept[: len(fields)] = fields * np.sqrt(level)[:, None, None]

    return write


def test_every_good_step_is_a_hologram_in_order_of_frequency(sweep_a, block_amplitudes):
    with Run.open(sweep_a) as run:
        assert run.good.all()
        assert block_amplitudes.step_index.tolist() == [step.index for step in run]
        assert block_amplitudes.drive_hz == pytest.approx(
            [float(s.read_drive_hz) for s in run], rel=1e-12
        )
        assert block_amplitudes.volts == pytest.approx([step.volts for step in run], rel=1e-12)
    assert (np.diff(block_amplitudes.drive_hz) > 0).all()
    assert block_amplitudes.value.shape == (len(block_amplitudes.x_m), 87)
    assert block_amplitudes.value.dtype == np.complex64


def test_bad_steps_are_left_out_and_the_order_of_the_file_is_of_no_matter(
    changed, axes, block_amplitudes, monkeypatch
):
    # Few holograms tell the place a little differently, and other blocks lie on the reed.
    monkeypatch.setattr(
        "fitting.holograms.block_amplitudes.reed_place", lambda *_: block_amplitudes.place
    )
    order = np.random.default_rng(3).permutation(87)
    path = changed(only=(21, 61), verdicts={31: "saturated", 45: "pending"}, order=order)
    few = read(path)
    kept = [k for k in range(21, 62, 2) if k not in (31, 45)]
    assert few.step_index.tolist() == kept
    columns = np.searchsorted(block_amplitudes.step_index, kept)
    assert few.drive_hz == pytest.approx(block_amplitudes.drive_hz[columns], rel=1e-12)
    assert few.volts == pytest.approx(block_amplitudes.volts[columns], rel=1e-12)
    # Fewer holograms weigh pixels a little differently: where there is light, all but the same.
    there, here = np.abs(block_amplitudes.value[:, columns]), np.abs(few.value)
    overlap = np.sum(there * here, axis=0) / np.linalg.norm(there, axis=0)
    assert overlap / np.linalg.norm(here, axis=0) == pytest.approx(1, abs=0.02)


def test_too_few_good_steps_are_refused_with_what_is_wrong(changed):
    with pytest.raises(FitError, match="7 of 87 steps are good"):
        read(changed(only=(21, 34)))


def test_places_lie_inside_the_visible_reed_and_inside_their_blocks(block_amplitudes, axes):
    y_m, x_m, high, wide = axes
    assert (high, wide) == (2, 3)
    # In the image: the reed is turned so little that its place has an inverse with other signs.
    place = block_amplitudes.place
    back = replace(place, along_m=0, across_m=0, turn_rad=-place.turn_rad)
    x, y = back.on_reed(block_amplitudes.x_m, block_amplitudes.y_m)
    for axis, places, size in (
        (y_m, y + place.across_m, high),
        (x_m, x + place.along_m, wide),
    ):
        whole = axis[: len(axis) // size * size].reshape(-1, size)
        # Some block has a place between its edges, half a pixel outside its outermost pixels.
        low, up = np.sort(whole[:, [0, -1]], axis=1).T
        half = 0.5 * abs(axis[1] - axis[0])
        inside = (places[:, None] > low - half) & (places[:, None] < up + half)
        assert (inside.sum(axis=1) == 1).all()
    assert (np.abs(block_amplitudes.y_m) < half_width_m(Outline(), block_amplitudes.x_m)).all()
    assert block_amplitudes.x_m.min() > EDGE_M
    assert 34e-3 < block_amplitudes.x_m.max() < 36e-3
    assert block_amplitudes.y_m.max() > 5e-3
    assert block_amplitudes.y_m.min() < -5e-3


def test_blocks_cover_the_reed_without_gaps(block_amplitudes):
    # Area of the outline inside the margin, over that of a block.
    x = np.linspace(2 * EDGE_M, 35e-3, 2000)
    wide = np.maximum(half_width_m(Outline(), x) - EDGE_M, 0) * 2
    area = np.trapezoid(wide, x)
    assert len(block_amplitudes.x_m) * 2 * 3 * 189.5e-6 * 151.6e-6 == pytest.approx(area, rel=0.08)


@pytest.mark.parametrize("coarser", [2, 3])
def test_blocks_of_coarse_images_have_pixels_on_both_sides_of_their_middle(sweep_a, coarser):
    """A block of one pixel would not show where in it the light is."""
    with Run.open(sweep_a) as run:
        coarse = SimpleNamespace(
            x_m=run.x_m[::coarser], y_m=run.y_m[::coarser], reed_file=run.reed_file
        )
        blocks = _blocks(coarse, nominal_place())
    assert (blocks.high, blocks.wide) == (2, 2)
    for places in (blocks.x_m, blocks.y_m):
        assert (np.ptp(places, axis=1) > 0).all()


def test_places_are_those_of_the_pixels_with_light(
    changed, axes, write_fields, rectangular, at_nominal_place
):
    """One pixel of each block is lit, then two, one of them with four times the power."""
    y_m, x_m, high, wide = axes
    rng = np.random.default_rng(4)
    with Run.open(changed()) as run:
        shape = run.field(0).shape
    common = 20 * np.exp(2j * np.pi * rng.uniform(size=(87, 1, 1)))
    lit = np.zeros(shape)
    lit[1::high, 1::wide] = 1
    path = changed("one.h5")
    write_fields(path, (common * lit).astype(np.complex64))
    one = read(path)
    for found, lit_m in ((one.y_m, y_m[1::high]), (one.x_m, x_m[1::wide])):
        assert np.abs(np.subtract.outer(found, lit_m)).min(axis=1).max() < 2e-8
    lit[0::high, 2::wide] = 2
    path = changed("two.h5")
    write_fields(path, (common * lit).astype(np.complex64))
    two = read(path)
    # Four fifths of the way from the one to the other.
    pitch_y, pitch_x = y_m[0] - y_m[1], x_m[2] - x_m[1]
    assert two.y_m - one.y_m == pytest.approx(0.8 * pitch_y, rel=1e-3)
    assert two.x_m - one.x_m == pytest.approx(0.8 * pitch_x, rel=1e-3)


@pytest.fixture
def plain(changed, write_fields, at_nominal_place):
    """Make a run of rank one, with an amplitude of each hologram, as if all blocks moved equally.

    The light of each pixel has a mean power of 900, and noise one of 1.
    """
    rng = np.random.default_rng(5)
    path = changed()
    with Run.open(path) as run:
        shape = run.field(0).shape
    phasor = rng.uniform(0.1, 0.58, 87) * np.exp(2j * np.pi * rng.uniform(size=87))
    a = 30 * complex_normal(rng, *shape)
    write_fields(
        path, (phasor[:, None, None] * a + complex_normal(rng, 87, *shape)).astype(np.complex64)
    )
    return path, phasor


def test_phasors_of_a_planted_run_are_the_planted_ones_in_units_of_noise(plain, rectangular):
    path, phasor = plain
    value = read(path).value
    left, factor = apart(value, np.broadcast_to(phasor, value.shape))
    assert np.mean(np.abs(left) ** 2) * 87 / 86 == pytest.approx(1, abs=0.02)
    # Six pixels of mean power 900 each.
    assert np.mean(factor**2) == pytest.approx(6 * 900, rel=0.03)


def test_under_a_window_noise_is_one_and_light_that_of_independent_pixels(plain):
    path, phasor = plain
    found = read(path)
    left, factor = apart(found.value, np.broadcast_to(phasor, found.value.shape))
    assert np.mean(np.abs(left) ** 2) * 87 / 86 == pytest.approx(1, abs=0.02)
    # The power of light is that of all pixels, also where their noise is shared.
    assert np.mean(found.noise_variance * factor**2) == pytest.approx(6 * 900, rel=0.03)
    # Of two by three pixels, the window leaves this many independent.
    windows = [taper.window(4096) for taper in TAPERS]
    pixels = 6 / np.prod([np.mean(window**4) for window in windows])
    assert 0.35 * 6 < pixels < 0.4 * 6
    assert found.independent_fraction * np.mean(factor**2) == pytest.approx(900 * pixels, rel=0.05)


def test_blocks_are_as_large_as_they_are_on_the_reed(plain, monkeypatch):
    path, _ = plain
    module = "fitting.holograms.block_amplitudes"
    wide = [
        np.array(read_at(path, replace(nominal_place(), larger=larger), module, monkeypatch).size_m)
        for larger in (0.0, 0.04)
    ]
    assert wide[0] / wide[1] == pytest.approx([1.04, 1.04])


def read_at(path, place, module, monkeypatch):
    """Read a run whose reed lies at a place, whatever its edges say."""
    monkeypatch.setattr(f"{module}.reed_place", lambda *_: place)
    return read(path)


def test_light_spreads_along_each_axis_as_its_pixels_say(plain):
    """Together, all blocks spread as far as pixels and their window do."""
    path, phasor = plain
    found = read(path)
    _, factor = apart(found.value, np.broadcast_to(phasor, found.value.shape))
    power = found.noise_variance * factor**2
    with Run.open(path) as run:
        blocks = _blocks(run, nominal_place())
    middle_m = np.stack([blocks.x_m.mean(axis=1), blocks.y_m.mean(axis=1)])
    off = (np.stack([found.x_m, found.y_m]) - middle_m) / np.reshape(found.size_m, (2, 1))
    # Three pixels along x, two along y.
    assert found.size_m[0] > found.size_m[1]
    for axis, (taper, pixels) in enumerate(((TAPERS[1], 3), (TAPERS[0], 2))):
        mean, square = taper.light_moments(pixels)
        farthest = np.linalg.eigvalsh(0.5 * (mean + mean.T)).max() / pixels
        assert 0.8 * farthest < np.abs(off[axis]).max() < farthest
        whole = np.average(off[axis] ** 2 + found.spread[axis] ** 2, weights=power)
        correlation = toeplitz(taper.noise_correlation(pixels))
        assert whole == pytest.approx(np.trace(square @ correlation) / pixels**3, rel=0.02)
        assert np.average(off[axis], weights=power) == pytest.approx(0, abs=0.01)
        # Of blocks whose light is in one of their pixels it spreads less.
        assert found.spread[axis].min() < 0.7 * found.spread[axis].max()


def test_unshifted_light_passes_the_same_window(plain):
    """White light has the correlation of noise: in its units, any block has its power."""
    path, _ = plain
    with Run.open(path) as run:
        light = 3 * complex_normal(np.random.default_rng(6), *run.field(0).shape)
        shares = {step.position: 0.5 * np.sqrt(step.noise_level) for step in run.steps}
        found = read_block_amplitudes(run, UnshiftedLight(light.astype(np.complex64), shares))
    assert np.mean(np.abs(found.subtracted) ** 2) == pytest.approx(9 * 0.25, rel=0.05)


def test_neighbouring_blocks_share_noise_as_is_stated(plain):
    """Noise of sums over blocks, weighted with light and slow waves, is larger by this factor."""
    path, phasor = plain
    found = read(path)
    left, _ = apart(found.value, np.broadcast_to(phasor, found.value.shape))
    light = found.value @ phasor.conj()
    x, y = ((at - at.min()) / np.ptp(at) for at in (found.x_m, found.y_m))
    waves = [np.exp(2j * np.pi * (p * x + q * y)) for p in (-1, 0, 1) for q in (-1, 0, 1)]
    sums = np.array(waves) * (light.conj() / np.linalg.norm(light)) @ left
    power = np.mean(np.abs(sums) ** 2) * 87 / 86
    assert power * found.independent_fraction == pytest.approx(1, abs=0.1)
    assert found.independent_fraction < 0.8


def test_noise_is_one_where_the_run_shows_nothing_but_noise(changed, resealed, block_amplitudes):
    """Some holograms become what the run's own noise is, at the level that its steps state."""
    path = changed()
    rng = np.random.default_rng(6)
    still = np.arange(3, 87, 9)
    with resealed(path) as file:
        field, level = file["entry/data/field"], file["entry/steps/noise_level"]
        for position in still:
            noise = complex_normal(rng, *field.shape[1:])
            field[position] = np.sqrt(level[position]) * noise
    value = read(path).value
    # A little of it is taken for light, in blocks that have next to none.
    assert np.mean(np.abs(value[:, still]) ** 2, axis=0) == pytest.approx(1, abs=0.12)
    moving = np.setdiff1d(np.arange(87), still)
    assert np.sum(np.abs(value[:, moving]) ** 2) == pytest.approx(
        np.sum(np.abs(block_amplitudes.value[:, moving]) ** 2), rel=0.01
    )


def test_noise_of_the_simulated_camera_is_one(block_amplitudes):
    """Near the clamp holograms of small amplitude are light times almost no motion, and noise."""
    clamped = (block_amplitudes.x_m > 33e-3) & (np.abs(block_amplitudes.y_m) < 4e-3)
    value = block_amplitudes.value[np.ix_(clamped, block_amplitudes.volts < 1.0)]
    blocks, holograms = value.shape
    assert holograms > 5
    # The motion there is bending. A second direction would be that of most noise.
    rest = np.linalg.svd(value, compute_uv=False)[1:]
    noise = np.sum(rest.astype(float) ** 2) / ((blocks - 1) * (holograms - 1))
    assert noise == pytest.approx(1, abs=0.1)


def test_a_run_that_kept_frames_gives_the_same_phasors(tmp_path):
    small = {"camera.width": 320, "camera.height": 256, "sweep.first": 14, "sweep.last": 30}
    found = []
    for keep in ("holograms", "frames"):
        protocol = acquire.load("quick").replace({**small, "keep": keep})
        acquire.run(acquire.plan(protocol).plan, tmp_path / f"{keep}.h5", reed="R07", seed=3)
        found.append(read(tmp_path / f"{keep}.h5"))
    held, kept = found
    assert held.step_index.tolist() == kept.step_index.tolist() == list(range(14, 31, 2))
    # Pixels are 0.3 by 0.38 mm: each is a block, and places are the pixels' own.
    assert kept.x_m == pytest.approx(held.x_m, abs=1e-9)
    assert kept.y_m == pytest.approx(held.y_m, abs=1e-9)
    # Fields are kept in half the digits of single precision at most.
    assert np.abs(kept.value) == pytest.approx(np.abs(held.value), rel=0.01, abs=0.02)


# --- Order of recording ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shuffled(tmp_path_factory):
    """Plan and run file of sixteen holograms that were recorded in another order."""
    small = {"camera.width": 320, "camera.height": 256, "sweep.first": 14, "sweep.last": 44}
    protocol = acquire.load("quick").replace({**small, "sweep.direction": "shuffled"})
    plan, path = acquire.plan(protocol).plan, tmp_path_factory.mktemp("order") / "shuffled.h5"
    acquire.run(plan, path, reed="R07", seed=3)
    return plan, path


def test_holograms_rank_in_the_order_of_recording(shuffled):
    plan, path = shuffled
    found = read(path)
    assert sorted(plan.sequence) == list(range(16))
    assert list(plan.sequence) != sorted(plan.sequence)
    assert (np.diff(found.drive_hz) > 0).all()
    assert np.argsort(found.recording_rank).tolist() == list(plan.sequence)


def test_a_hologram_that_is_recorded_again_ranks_last(shuffled, tmp_path, resealed):
    plan, path = shuffled
    again = plan.sequence[3]
    with resealed(Path(shutil.copy(path, tmp_path / "again.h5"))) as file:
        stamps = file["entry/steps/timestamp_s"]
        stamps[again] = stamps[()].max() + 1 + np.arange(4)
    expected = [*(place for place in plan.sequence if place != again), again]
    assert np.argsort(read(tmp_path / "again.h5").recording_rank).tolist() == expected


def test_ranks_count_what_would_have_been_recorded_in_a_pause(shuffled, tmp_path, resealed):
    plan, path = shuffled
    for pause_steps, counted in ((2.0, 3), (500.0, 4)):
        copy = Path(shutil.copy(path, tmp_path / f"{counted}.h5"))
        with resealed(copy) as file:
            stamps, later = file["entry/steps/timestamp_s"], np.array(plan.sequence[9:])
            shifted = stamps[()]
            step_s = np.median(np.diff(np.sort(shifted[:, 0])))
            shifted[later] += pause_steps * step_s
            stamps[...] = shifted
        ranks = np.sort(read(copy).recording_rank)
        # Of sixteen holograms, a pause is four at most.
        assert np.diff(ranks).tolist() == [1] * 8 + [counted] + [1] * 6


@pytest.fixture
def continued(shuffled, tmp_path, resealed):
    """The same, interrupted after seven holograms; the camera's clock began again."""
    plan, path = shuffled
    with resealed(Path(shutil.copy(path, tmp_path / "continued.h5"))) as file:
        stamps, later = file["entry/steps/timestamp_s"], np.array(plan.sequence[7:])
        shifted = stamps[()]
        shifted[later] -= shifted[later].min()
        stamps[...] = shifted
        rows = file["entry/interruptions"]
        rows["position"][0] = min(later)
        for key, text in (("kind", "resumed"), ("began", "?"), ("ended", "?"), ("reason", "?")):
            rows[key][0] = text
    return tmp_path / "continued.h5"


def test_a_clock_that_begins_again_with_a_continued_run_is_not_believed(shuffled, continued):
    plan, _ = shuffled
    ranks = read(continued).recording_rank
    assert np.argsort(ranks).tolist() == list(plan.sequence)
    # Nobody knows how long it was interrupted.
    assert np.diff(np.sort(ranks)).tolist() == [1] * 6 + [4] + [1] * 8


def test_an_interrupted_run_whose_order_is_not_known_is_refused(continued, resealed):
    with resealed(continued) as file:
        origin = file["entry/provenance"]
        del origin["protocol"]
        origin["protocol"] = "sweep: ?"
    with pytest.raises(FitError, match="protocol"):
        read(continued)


# --- Other sidebands ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def three_sidebands(tmp_path_factory):
    """Run file of sidebands 0, 1 and 2 of sixteen vibrations, from small ones to many fringes."""
    small = {"camera.width": 320, "camera.height": 256, "sweep.first": 14, "sweep.last": 44}
    small["drive.from"] = "0.1 V"
    content = {**acquire.load("quick").replace(small).content(), "sideband": {"orders": [0, 1, 2]}}
    path = tmp_path_factory.mktemp("orders") / "three.h5"
    plan = acquire.plan(Protocol.from_text(yaml.safe_dump(content))).plan
    acquire.run(plan, path, reed="R07", seed=3)
    return path


def with_verdicts(path, to, verdicts):
    """Copy with verdicts of steps, by index and order."""
    shutil.copy(path, to)
    with h5py.File(to, "r+") as file:
        steps = file["entry/steps"]
        index, order, said = (steps[key][()] for key in ("index", "order", "verdict"))
        for (k, n), verdict in verdicts.items():
            said[(index == k) & (order == n)] = verdict.encode()
        steps["verdict"][...] = said
    return to


def test_other_sidebands_are_next_to_the_first(three_sidebands):
    found = read(three_sidebands)
    assert found.step_index.tolist() == list(range(14, 45, 2))
    assert sorted(other.order for other in found.others) == [0, 2]
    for other in found.others:
        assert other.value.shape == found.value.shape
        assert other.present.all()


def test_sidebands_of_one_vibration_are_bessel_functions_of_it(three_sidebands):
    """Of the phase amplitude that the first two show, the third has the magnitude and the phase."""
    found = read(three_sidebands)
    carrier, second = (
        next(other.value for other in found.others if other.order == n).astype(complex)
        for n in (0, 2)
    )
    first = found.value.astype(complex)
    # Up to the first zero of J₀ the ratio J₁/J₀ grows.
    phi = np.linspace(0, 2, 400)
    u = np.interp(np.abs(first) / np.abs(carrier), j1(phi) / j0(phi), phi)
    lit = np.abs(carrier) > np.median(np.abs(carrier))
    largest = np.array([np.percentile(u[lit[:, k], k], 98) for k in range(16)])
    # The light cancels, and so do turns by the direction of u: A F₀ A F₂ and (A F₁)².
    seen = np.sum(np.where(lit, carrier * second * first.conj() ** 2, 0), axis=0)
    expected = np.sum(
        np.where(lit, np.abs(carrier) ** 2 * jv(2, u) / j0(u) * np.abs(first) ** 2, 0), axis=0
    )
    noise = np.sqrt(np.sum(np.where(lit, np.abs(carrier) ** 2 * np.abs(first) ** 4, 0), axis=0))
    shown = (largest > 0.4) & (largest < 1.4) & (noise < 0.05 * expected)
    assert shown.sum() >= 10
    assert np.abs(seen)[shown] / expected[shown] == pytest.approx(1, abs=0.1)


def test_bad_holograms_of_other_sidebands_are_absent(three_sidebands, tmp_path, monkeypatch):
    """A bad one of the first takes the others of that vibration with it."""
    path = with_verdicts(
        three_sidebands,
        tmp_path / "bad.h5",
        {(20, 0): "saturated", (26, 2): "lock", (30, 1): "dropped"},
    )
    whole = read(three_sidebands)
    # Fewer holograms tell the place a little differently, and other blocks lie on the reed.
    monkeypatch.setattr("fitting.holograms.block_amplitudes.reed_place", lambda *_: whole.place)
    found = read(path)
    kept = [k for k in range(14, 45, 2) if k != 30]
    assert found.step_index.tolist() == kept
    lost = {0: 20, 2: 26}
    before = {other.order: other.value for other in whole.others}
    columns = np.searchsorted(whole.step_index, kept)
    for other in found.others:
        present = np.array([k != lost[other.order] for k in kept])
        assert other.present.tolist() == present.tolist()
        assert not other.value[:, ~present].any()
        # Each in its own place: pixels are weighed a little differently, no more.
        there, here = np.abs(before[other.order][:, columns]), np.abs(other.value)
        overlap = np.sum(there * here, axis=0)[present]
        norms = np.linalg.norm(there, axis=0) * np.linalg.norm(here, axis=0)
        assert overlap / norms[present] == pytest.approx(1, abs=0.02)


def test_a_sideband_of_which_nothing_is_good_is_none(three_sidebands, tmp_path):
    gone = {(k, 2): "saturated" for k in range(14, 45, 2)}
    found = read(with_verdicts(three_sidebands, tmp_path / "gone.h5", gone))
    assert [other.order for other in found.others] == [0]
