"""Verdicts: each number on both sides of its limit, and the limits against statistics."""

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.quality import (
    SATURATED_SHARE_MAX,
    SEVERITY,
    Judgement,
    LockCondition,
    ReadBack,
    Verdict,
    frame_rate_hz,
    judge_consecutive,
    judge_fresh,
    judge_lock,
    judge_saturation,
    judge_signal,
    most_severe,
    saturated_share,
    signal_and_noise,
    signal_threshold,
)
from acquire.reconstruction import empty_region
from drivers.roles import Frame
from holography.region import Region

RATE_HZ = Fraction(62, 5)
DRIVE_HZ = Fraction(20001, 10)
CONDITION = LockCondition(order=1, frame_rate_hz=RATE_HZ, tolerance_rad=0.01)


def frames_of(ids=(7, 8, 9, 10), rate_hz=float(RATE_HZ), start_s=5.0):
    image = np.zeros((2, 2), np.uint16)
    return [Frame(id, start_s + (id - ids[0]) / rate_hz, image) for id in ids]


def read_back(residual_hz=Fraction(0), order=1):
    aom2_hz = Fraction(80_000_000)
    aom1_hz = aom2_hz + order * DRIVE_HZ + RATE_HZ / 4 + residual_hz
    return ReadBack(aom1_hz, aom2_hz, DRIVE_HZ, 1.0)


# --- Frames ------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 20), min_size=4, max_size=4))
def test_only_consecutive_ids_pass(ids):
    consecutive = all(after - before == 1 for before, after in pairwise(ids))
    judgement = judge_consecutive(frames_of(ids), 4)
    assert (judgement is None) == consecutive
    if judgement:
        assert judgement.verdict is Verdict.DROPPED


@pytest.mark.parametrize("ids", [(), (1,), (1, 2, 3), (1, 2, 3, 4, 5)])
def test_a_wrong_number_of_frames_is_dropped(ids):
    judgement = judge_consecutive(frames_of(ids), 4)
    assert judgement.verdict is Verdict.DROPPED
    assert f"{len(ids)} frames came instead of 4" in judgement.sentence


def test_a_frame_from_before_the_setting_settled_is_stale():
    frames = frames_of(start_s=5.0)
    assert judge_fresh(frames, 5.0) is None
    judgement = judge_fresh(frames, 5.012)
    assert judgement.verdict is Verdict.STALE
    assert "12 ms before" in judgement.sentence
    assert judge_fresh(frames[::-1], 5.012) is not None, "whichever frame comes first"


def test_the_frame_rate_comes_from_ids_and_time_stamps():
    assert frame_rate_hz(frames_of((1, 2, 3, 4), 12.0)) == pytest.approx(12.0)
    assert frame_rate_hz(frames_of((1, 2, 4, 5), 12.0)) == pytest.approx(12.0)
    assert frame_rate_hz(frames_of((1,))) is None


# --- Lock --------------------------------------------------------------------------------------


def test_an_exact_lock_passes():
    assert judge_lock(read_back(), frames_of(), CONDITION) is None


@pytest.mark.parametrize("sign", [1, -1])
def test_the_lock_may_turn_the_phase_up_to_the_tolerance(sign):
    # 2π · r · 4/f_CCD = 0.01 rad at r = 4.934 mHz.
    limit_hz = 0.01 / (2 * np.pi * 4) * float(RATE_HZ)
    for factor, passes in ((0.999, True), (1.001, False)):
        residual_hz = sign * Fraction(factor * limit_hz)
        judgement = judge_lock(read_back(residual_hz), frames_of(), CONDITION)
        assert (judgement is None) == passes
        if judgement:
            assert judgement.verdict is Verdict.LOCK
            assert "check both synthesizers" in judgement.sentence


def test_the_printed_formula_of_the_paper_is_no_lock():
    aom2_hz = Fraction(80_000_000)
    printed = ReadBack(aom2_hz + (DRIVE_HZ + RATE_HZ) / 4, aom2_hz, DRIVE_HZ, 1.0)
    assert judge_lock(printed, frames_of(), CONDITION).verdict is Verdict.LOCK


def test_a_drive_that_is_not_played_as_asked_is_no_lock():
    asked = read_back()
    played = ReadBack(asked.aom1_hz, asked.aom2_hz, DRIVE_HZ + Fraction(1, 100), 1.0)
    assert judge_lock(played, frames_of(), CONDITION).verdict is Verdict.LOCK


@pytest.mark.parametrize(("error_ppm", "passes"), [(1500, True), (1700, False), (-1700, False)])
def test_a_camera_of_another_rate_is_no_lock(error_ppm, passes):
    # The sideband is offset by a quarter of the error: 2π · 1e-6 · ppm over four frames.
    frames = frames_of(rate_hz=float(RATE_HZ) * (1 + 1e-6 * error_ppm))
    judgement = judge_lock(read_back(), frames, CONDITION)
    assert (judgement is None) == passes
    if judgement:
        assert "frames per second instead of 12.4" in judgement.sentence


def test_the_carrier_has_a_lock_of_its_own():
    carrier = LockCondition(order=0, frame_rate_hz=RATE_HZ, tolerance_rad=0.01)
    assert judge_lock(read_back(order=0), frames_of(), carrier) is None
    assert judge_lock(read_back(order=1), frames_of(), carrier) is not None


# --- Light -------------------------------------------------------------------------------------


def test_saturated_pixels_are_counted_over_all_frames():
    images = np.zeros((4, 10, 10), np.uint16)
    images[0, :2] = 4050
    images[1, 0] = 4095
    frames = [Frame(k, 0.0, image) for k, image in enumerate(images)]
    assert saturated_share(frames, 4050) == pytest.approx(30 / 400)
    assert saturated_share(frames, 4095) == pytest.approx(10 / 400)


def test_a_few_hot_pixels_do_not_saturate():
    assert judge_saturation(SATURATED_SHARE_MAX) is None
    assert judge_saturation(1.01 * SATURATED_SHARE_MAX).verdict is Verdict.SATURATED


def test_noise_alone_has_the_statistics_of_the_threshold():
    """Of a thousand empty pictures, the ratios have the mean and deviation that it presumes."""
    rng = np.random.default_rng(0)
    parts = rng.standard_normal((1000, 2, 40, 50), dtype=np.float32)
    images = (parts[:, 0] + 1j * parts[:, 1]).astype(np.complex64)
    reed, empty = Region(2, 3, 20, 15), Region(0, 30, 40, 20)
    ratios = np.array([signal_and_noise(image, reed, empty)[0] for image in images])
    presumed = (signal_threshold(300, 800) - 1) / 5
    assert ratios.mean() == pytest.approx(1, abs=0.01)
    assert ratios.std() == pytest.approx(presumed, rel=0.1)
    assert all(judge_signal(ratio, 300, 800) for ratio in ratios)


def test_signal_and_noise_are_mean_powers():
    image = np.full((8, 10), 2 + 0j, np.complex64)
    image[1:3, 1:4] = 3 + 4j
    ratio, noise = signal_and_noise(image, Region(1, 1, 2, 3), Region(5, 0, 2, 10))
    assert (ratio, noise) == pytest.approx((25 / 4, 4))
    ratio, noise = signal_and_noise(0 * image, Region(1, 1, 2, 3), Region(5, 0, 2, 10))
    assert judge_signal(ratio, 6, 20).verdict is Verdict.NO_SIGNAL, "a dead camera"


def test_a_little_more_than_noise_is_a_signal():
    threshold = signal_threshold(70_000, 200_000)
    assert 1.01 < threshold < 1.03
    assert judge_signal(threshold, 70_000, 200_000).verdict is Verdict.NO_SIGNAL
    assert judge_signal(threshold * 1.001, 70_000, 200_000) is None


@given(
    shape=st.tuples(st.integers(16, 200), st.integers(16, 200)),
    centre=st.tuples(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25)),
    size=st.tuples(st.floats(0.05, 0.35), st.floats(0.05, 0.35)),
)
def test_the_empty_region_meets_neither_image_nor_twin(shape, centre, size):
    starts, counts = [], []
    for count, middle, extent in zip(shape, centre, size, strict=True):
        starts.append(int((0.5 + middle - extent / 2) * count))
        counts.append(max(int(extent * count), 1))
    region = Region(*starts, *counts)
    empty = empty_region(shape, region)
    image = np.zeros(shape, bool)
    empty.crop(image)[...] = True
    rows, columns = np.nonzero(image)
    assert len(rows) == empty.height * empty.width > 0
    for sign in (1, -1):
        # Pixels are reflected in the optical axis at (ny//2, nx//2).
        r = sign * (rows - shape[0] // 2) + shape[0] // 2 - region.row
        c = sign * (columns - shape[1] // 2) + shape[1] // 2 - region.column
        assert not ((r >= 0) & (r < region.height) & (c >= 0) & (c < region.width)).any()


# --- Severity ----------------------------------------------------------------------------------


def test_every_verdict_of_a_measured_step_has_a_severity():
    assert set(SEVERITY) == {verdict for verdict in Verdict if verdict.measured}


@given(st.lists(st.none() | st.sampled_from(SEVERITY)))
def test_the_most_severe_judgement_is_the_verdict(verdicts):
    judgements = [verdict and Judgement(verdict, f"because {verdict}") for verdict in verdicts]
    result = most_severe(judgements)
    found = [SEVERITY.index(verdict) for verdict in verdicts if verdict]
    assert SEVERITY.index(result.verdict) == min(found, default=SEVERITY.index(Verdict.OK))
    assert result in judgements or result.verdict is Verdict.OK
