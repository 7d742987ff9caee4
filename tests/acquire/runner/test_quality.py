"""Verdicts: each number on both sides of its limit, and the limits against statistics."""

import re
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.runner.frame_quality import (
    SATURATED_SHARE_MAX,
    frame_rate_hz,
    judge_consecutive,
    judge_fresh,
    judge_order,
    judge_saturation,
    judge_whole,
    saturated_share,
)
from acquire.runner.history import History
from acquire.runner.quality import (
    SEVERITY,
    LockCondition,
    Usual,
    judge_light,
    judge_lock,
    judge_settings,
    judge_shown,
    judge_signal,
    judge_steady,
    judge_turn,
    most_severe,
    signal_threshold,
)
from drivers.roles import Frame
from holography.fresnel import FresnelTransform
from holography.phase import (
    NO_TURN,
    SteadyTurn,
    steady_turn,
)
from holography.reconstruction import Reconstruction, mean_power
from holography.region import Region
from runs.verdict import (
    Judgement,
    ReadBack,
    Verdict,
)

RATE_HZ = Fraction(62, 5)
PERIOD_S = float(1 / RATE_HZ)
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
    """What is missing is dropped, what came twice or in another order is not in order."""
    found = most_severe(
        [judge_consecutive(frames_of(ids), 4), judge_order(frames_of(ids), PERIOD_S)]
    )
    if all(after - before == 1 for before, after in pairwise(ids)):
        assert found.verdict is Verdict.OK
    elif set(range(min(ids), max(ids))) <= set(ids):
        assert found.verdict is Verdict.DISORDERED
    else:
        assert found.verdict is Verdict.DROPPED


def test_the_numbers_of_frames_may_be_anything():
    assert judge_consecutive(frames_of((0, 2**62, 5, 6)), 4).verdict is Verdict.DROPPED


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


@given(st.permutations((7, 8, 9, 10)), st.integers(0, 20))
def test_a_frame_that_was_seen_before_is_stale(ids, seen):
    """Whichever it is, and whatever its time stamp says."""
    previous = Frame(seen, 100.0, np.zeros((2, 2), np.uint16))
    judgement = judge_fresh(frames_of(ids), 5.0 - 10.0, previous)
    assert (judgement is None) == (seen < 7)
    if judgement:
        assert judgement.verdict is Verdict.STALE
        assert f"frame 7 is not later than frame {seen} of the step before" in judgement.sentence


# --- Order -------------------------------------------------------------------------------------


def moved(frames, jumps_s):
    """Frames whose time stamps are off by as many seconds."""
    return [
        Frame(frame.id, frame.timestamp_s + jump_s, frame.image)
        for frame, jump_s in zip(frames, jumps_s, strict=True)
    ]


@given(
    st.permutations((7, 8, 9, 10)) | st.lists(st.integers(7, 10), min_size=4, max_size=4),
    st.booleans(),
)
def test_another_order_of_frames_is_disordered(ids, stamped_as_they_come):
    """Whether time stamps follow the numbers or the order in which the frames came."""
    frames = frames_of(ids)
    if stamped_as_they_come:
        starts_s = [5.0 + k * PERIOD_S for k in range(4)]
        frames = [
            Frame(id, start_s, frames[0].image) for id, start_s in zip(ids, starts_s, strict=True)
        ]
    judgement = judge_order(frames, PERIOD_S)
    assert (judgement is None) == (list(ids) == [7, 8, 9, 10])
    if judgement:
        assert judgement.verdict is Verdict.DISORDERED


@given(where=st.integers(1, 3), jump=st.floats(-20, 20), stays=st.booleans())
def test_a_clock_that_jumps_within_an_acquisition_is_disordered(where, jump, stays):
    """By more than half a period, forward or back, for one frame or for all that follow."""
    jumps = [jump * PERIOD_S if k == where or (stays and k > where) else 0.0 for k in range(4)]
    judgement = judge_order(moved(frames_of(), jumps), PERIOD_S)
    if abs(jump) > 0.501:
        assert judgement.verdict is Verdict.DISORDERED
        said = re.search(r"from frame (\d+) to (\d+) .* advanced by (\S+) ms", judgement.sentence)
        assert (int(said[1]), int(said[2])) == (6 + where, 7 + where)
        went_ms = 1e3 * (1 + jump) * PERIOD_S
        assert float(said[3]) == pytest.approx(went_ms, rel=1e-3, abs=1e-6)
        assert f"instead of {1e3 * PERIOD_S:.4g} ms" in judgement.sentence
    elif abs(jump) < 0.499:
        assert judgement is None


@given(gap=st.integers(1, 1000), jump=st.floats(-20, 20))
def test_a_clock_that_jumps_between_two_acquisitions_is_disordered(gap, jump):
    """But for a ten-thousandth of the time between them, by which clocks may drift."""
    previous = Frame(7 - gap, 5.0 - gap * PERIOD_S, np.zeros((2, 2), np.uint16))
    judgement = judge_order(moved(frames_of(), [jump * PERIOD_S] * 4), PERIOD_S, previous)
    allowed = 0.5 + 1e-4 * gap
    if abs(jump) > allowed + 1e-3:
        assert judgement.verdict is Verdict.DISORDERED
        assert f"from frame {7 - gap} to 7" in judgement.sentence
    elif abs(jump) < allowed - 1e-3:
        assert judgement is None


@pytest.mark.parametrize(("gap", "passes"), [(10, False), (490, False), (510, True)])
def test_clocks_may_drift_by_a_ten_thousandth(gap, passes):
    """Half a period and a twentieth more are too much, unless 500 periods went by."""
    previous = Frame(7 - gap, 5.0 - (gap + 0.55) * PERIOD_S, np.zeros((2, 2), np.uint16))
    assert (judge_order(frames_of(), PERIOD_S, previous) is None) == passes


def test_frames_that_were_lost_between_two_acquisitions_leave_no_jump():
    previous = Frame(2, 5.0 - 5 * PERIOD_S, np.zeros((2, 2), np.uint16))
    assert judge_order(frames_of(), PERIOD_S, previous) is None
    late = Frame(2, 5.0 - 4 * PERIOD_S, np.zeros((2, 2), np.uint16))
    assert judge_order(frames_of(), PERIOD_S, late).verdict is Verdict.DISORDERED


def test_a_number_that_was_seen_before_is_old_and_not_disordered():
    previous = Frame(8, 5.0 + PERIOD_S, np.zeros((2, 2), np.uint16))
    assert judge_order(frames_of(), PERIOD_S, previous) is None
    assert judge_fresh(frames_of(), 0.0, previous).verdict is Verdict.STALE


# --- Whole frames ------------------------------------------------------------------------------

SATURATED = 4095


def noisy(level_dn=1000.0, noise_dn=20.0, shape=(12, 40), seed=0):
    """Four frames of light and noise."""
    rng = np.random.default_rng(seed)
    images = np.clip(np.rint(rng.normal(level_dn, noise_dn, (4, *shape))), 0, SATURATED)
    return [Frame(7 + k, 5.0 + k * PERIOD_S, im) for k, im in enumerate(images.astype(np.uint16))]


@given(number=st.integers(0, 3), rows=st.integers(1, 11))
def test_a_frame_that_ends_in_zeros_is_partial(number, rows):
    frames = noisy()
    frames[number].image[-rows:] = 0
    judgement = judge_whole(frames, SATURATED)
    assert judgement.verdict is Verdict.PARTIAL
    assert f"{rows} of 12 rows of frame {7 + number} are empty" in judgement.sentence


@given(number=st.integers(1, 3), rows=st.integers(1, 12))
def test_a_frame_that_ends_as_the_one_before_is_partial(number, rows):
    frames = noisy()
    frames[number].image[-rows:] = frames[number - 1].image[-rows:]
    judgement = judge_whole(frames, SATURATED)
    assert judgement.verdict is Verdict.PARTIAL
    expected = f"{rows} of 12 rows of frame {7 + number} are equal to those of frame {6 + number}"
    assert expected in judgement.sentence


@pytest.mark.parametrize(
    ("level_dn", "noise_dn"),
    [
        (1000.0, 20.0),
        # All pixels of all frames at the limit, and all but a few.
        (9000.0, 20.0),
        (4150.0, 20.0),
        # No light: an offset with read noise, and a camera that subtracts its offset.
        (50.0, 1.0),
        (0.0, 1.0),
        (-100.0, 1.0),
    ],
)
def test_whole_frames_pass_however_bright(level_dn, noise_dn):
    for seed in range(20):
        assert judge_whole(noisy(level_dn, noise_dn, seed=seed), SATURATED) is None


def test_what_is_partial_counts_next_to_saturated_rows():
    frames = noisy()
    for frame in frames:
        frame.image[:4] = SATURATED
    assert judge_whole(frames, SATURATED) is None
    frames[2].image[-1] = frames[1].image[-1]
    assert "1 of 12 rows of frame 9" in judge_whole(frames, SATURATED).sentence


# --- The frame rate ----------------------------------------------------------------------------


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


# --- Settings ----------------------------------------------------------------------------------


def test_settings_as_planned_pass():
    assert judge_settings(DRIVE_HZ, 1.0, read_back(), read_back()) is None
    # The least amplitude of a generator stands for none.
    still = replace(read_back(), volts=0.001)
    assert judge_settings(DRIVE_HZ, 0.0, still, still) is None


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"volts": 0.5}, "generator"),
        ({"drive_hz": DRIVE_HZ / 2}, "generator"),
        ({"aom1_hz": Fraction(80_000_000)}, "synthesizers"),
    ],
)
def test_settings_that_change_during_the_frames_are_named(changes, named):
    found = judge_settings(DRIVE_HZ, 1.0, read_back(), replace(read_back(), **changes))
    assert found.verdict is Verdict.SETTINGS
    assert named in found.sentence


@pytest.mark.parametrize("changes", [{"volts": 0.9}, {"volts": np.nan}, {"drive_hz": DRIVE_HZ + 1}])
def test_settings_that_were_not_asked_for_are_wrong(changes):
    """A generator may limit itself, or a setting may not have arrived, and all else agree."""
    played = replace(read_back(), **changes)
    assert judge_settings(DRIVE_HZ, 1.0, played, played).verdict is Verdict.SETTINGS


# --- Brightness --------------------------------------------------------------------------------


def lit(*levels_dn):
    return [Frame(7 + k, 5.0, np.full((4, 5), level)) for k, level in enumerate(levels_dn)]


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize(
    ("factor", "passes"), [(1.01, True), (1.1, False), (0.9, False), (0, False)]
)
def test_a_frame_of_another_brightness_is_found(number, factor, passes):
    levels = [1000.0] * 4
    levels[number] *= factor
    found = judge_light(lit(*levels), 0.0, Usual())
    assert (found is None) == passes
    if found:
        assert found.verdict is Verdict.LIGHT
        assert f"frame {7 + number} " in found.sentence


def test_the_level_of_a_dark_frame_is_no_light():
    """Ten per cent of the light are one per cent of all numbers."""
    assert judge_light(lit(1000, 1000, 990, 1000), 0.0, Usual()) is None
    assert judge_light(lit(1000, 1000, 990, 1000), 900.0, Usual()) is not None
    # And what a dark level wanders is none either.
    assert judge_light(lit(901, 901, 901.5, 901), 900.0, Usual()) is None


@pytest.mark.parametrize(
    ("level", "passes"), [(1000, True), (1040, True), (1100, False), (500, False)]
)
def test_a_step_of_another_brightness_than_its_neighbours_is_found(level, passes):
    frames = lit(*[level] * 4)
    assert (judge_light(frames, 0.0, Usual(neighbours=5, brightness_dn=1000.0)) is None) == passes
    assert judge_light(frames, 0.0, Usual(neighbours=2, brightness_dn=1000.0)) is None


# --- Lock as the light shows it ----------------------------------------------------------------

STEADY = Usual(steps=30, turn_rad=0.0, turn_scatter_rad=0.002, unexplained=1e-4)


def turning(error_rad=0.0, se_rad=0.001, unexplained=0.0, ratio=100.0):
    return SteadyTurn(error_rad, se_rad, unexplained, 1e-4, ratio)


def verdict_of(turn, usual=None, leak=0.0):
    found = judge_turn(turn, CONDITION, leak, usual or Usual())
    return found and found.verdict


@pytest.mark.parametrize(("deviations", "verdict"), [(3.4, None), (5.5, Verdict.LOCK)])
def test_the_turn_of_noise_is_no_wrong_lock(deviations, verdict):
    """Noise has most of its power along some turn: of 4660 pixels up to some 4 deviations."""
    pixels = 4660
    ratio = deviations / np.sqrt(pixels)
    error = np.sqrt(2 / pixels) / ratio
    assert verdict_of(SteadyTurn(2.4, 0.18, 0.6, error, ratio)) is verdict


@pytest.mark.parametrize("sign", [1, -1])
def test_a_turn_counts_where_it_spoils_the_amplitude(sign):
    """By 2 %: |cos ε cos ε/2| of a hologram is left. Five standard errors and leaks are allowed."""
    spoiling_rad = 0.1789
    assert np.cos(spoiling_rad) * np.cos(spoiling_rad / 2) == pytest.approx(0.98, abs=5e-4)
    limit_rad = spoiling_rad + 5 * 0.001 + 0.0075
    assert verdict_of(turning(sign * 0.999 * limit_rad)) is None
    assert verdict_of(turning(sign * 1.001 * limit_rad)) is Verdict.LOCK


def test_what_the_carrier_may_leak_is_allowed():
    """It is the stronger the weaker the sideband: √(1000/9) times at a ratio of 9."""
    weak = turning(0.25, ratio=9.0)
    assert verdict_of(weak) is Verdict.LOCK
    assert verdict_of(weak, leak=0.002) is Verdict.LOCK
    assert verdict_of(weak, leak=0.003) is None


def test_an_ordinary_table_loses_no_step():
    """0.02 rad a frame of drift and 0.1 rad of jitter within four frames: 1000 steps."""
    rng, history = np.random.default_rng(1), History()
    lost = 0
    for _ in range(1000):
        phases = np.arange(4) * (np.pi / 2 + 0.02) + rng.normal(0, 0.1, 4)
        light = speckle(rng, (8, 30), 30.0)
        frames = [light * np.exp(-1j * phase) + speckle(rng, (8, 30), 1.0) for phase in phases]
        turn = steady_turn(*combinations(frames), 1.0)
        usual = history.usual(Fraction(1))
        lost += any((judge_turn(turn, CONDITION, 0.0, usual), judge_steady(turn, 0.0, usual)))
        history.add_turn(turn.error_rad, turn.unexplained)
    assert lost <= 5


def test_a_drift_that_spoils_some_steps_is_no_wrong_frequency():
    drifting = Usual(steps=30, turn_rad=0.01, turn_scatter_rad=0.1, unexplained=1e-3)
    assert verdict_of(turning(0.15), drifting) is None
    assert verdict_of(turning(0.25), drifting) is Verdict.UNSTEADY
    # Eight times what is usual is no drift any more.
    assert verdict_of(turning(0.8), drifting) is Verdict.LOCK


def test_a_wrong_frequency_is_the_same_at_every_step():
    detuned = Usual(steps=30, turn_rad=0.3, turn_scatter_rad=0.003, unexplained=1e-4)
    found = judge_turn(turning(0.301), CONDITION, 0.0, detuned)
    assert found.verdict is Verdict.LOCK
    assert "+0.594 Hz" in found.sentence
    assert "one clock" in found.sentence
    # What does not spoil the measurement costs no step.
    slightly = replace(detuned, turn_rad=0.02)
    assert verdict_of(turning(0.02), slightly) is None


def test_one_step_of_a_steady_run_that_turns_otherwise_is_found():
    """Less than would spoil a hologram, but fifty times the scatter: another pair was played."""
    assert verdict_of(turning(0.1), STEADY) is Verdict.LOCK
    assert verdict_of(turning(0.1), replace(STEADY, steps=7)) is None
    assert verdict_of(turning(0.015), STEADY) is None


@pytest.mark.parametrize("error_rad", [np.pi, -np.pi, 3.0])
def test_exchanged_modulators_are_named(error_rad):
    found = judge_turn(turning(error_rad), CONDITION, 0.0, Usual())
    assert found.verdict is Verdict.LOCK
    assert "AOM1 and AOM2 were exchanged" in found.sentence


def test_without_light_nothing_is_said_of_the_lock():
    assert verdict_of(NO_TURN) is None
    assert judge_steady(NO_TURN, 0.0, Usual()) is None
    assert verdict_of(turning(3.0, 0.201)) is None
    assert verdict_of(turning(3.0, 0.05)) is Verdict.LOCK


def test_noise_alone_is_never_taken_for_a_lost_lock():
    rng = np.random.default_rng(0)
    for _ in range(500):
        frames = [speckle(rng, (10, 20), 1.0) for _ in range(4)]
        turn = steady_turn(*combinations(frames), 1.0)
        assert verdict_of(turn) is None
        assert judge_steady(turn, 0.0, Usual()) is None
        assert judge_shown(turn, 0.0).verdict is Verdict.UNPROVEN


def test_a_lock_is_shown_by_light_enough():
    """A wrong pair would pass by chance once in twenty times: 0.157 rad of ±π."""
    assert judge_shown(turning(se_rad=0.029), 0.0) is None
    assert judge_shown(turning(se_rad=0.031), 0.0).verdict is Verdict.UNPROVEN
    assert judge_shown(NO_TURN, 0.0).verdict is Verdict.UNPROVEN
    # A carrier of 30 times the sideband may leak 0.12 rad: with the errors too much.
    assert judge_shown(turning(se_rad=0.01, ratio=1.0), 0.002).verdict is Verdict.UNPROVEN


# --- What a steady turn does not explain --------------------------------------------------------


def speckle(rng, shape, power):
    parts = rng.standard_normal((2, *shape))
    return np.sqrt(power / 2) * (parts[0] + 1j * parts[1])


def combinations(frames):
    first, second, third, fourth = frames
    parts = (first - third, second - fourth, first + third - second - fourth)
    return tuple(part.astype(np.complex64) for part in parts)


def four_frames(amplitudes=(1, 1, 1, 1), turns=(0, 1, 2, 3), seed=0):
    rng = np.random.default_rng(seed)
    light = speckle(rng, (12, 40), 50.0)
    return steady_turn(
        *combinations([
            amplitude * light * (-1j) ** turn + speckle(rng, (12, 40), 1.0)
            for amplitude, turn in zip(amplitudes, turns, strict=True)
        ]),
        1.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        {"amplitudes": (1, 1, 0.5, 0.5)},
        {"amplitudes": (1, 1, 0, 1)},
        {"turns": (0, 1, 3, 4)},
        {"turns": (0, 2, 3, 4)},
        {"turns": (0, 1, 1, 2)},
    ],
)
def test_frames_of_no_steady_image_are_found(changes):
    """Volts that halve, a dark frame, exposures that are missing or came twice."""
    assert judge_steady(four_frames(), 0.0, Usual()) is None
    turn = four_frames(**changes)
    found = judge_steady(turn, 0.0, Usual()) or judge_turn(turn, CONDITION, 0.0, Usual())
    assert found.verdict in (Verdict.UNSTEADY, Verdict.LOCK)


def test_what_is_unexplained_is_measured_by_what_is_usual():
    turn = turning(unexplained=0.01)
    assert judge_steady(turn, 0.0, Usual()) is None
    assert judge_steady(turn, 0.0, STEADY).verdict is Verdict.UNSTEADY
    assert judge_steady(turn, 0.0, replace(STEADY, unexplained=1e-3)) is None
    # However rough a table is, a fifth of the amplitude is too much.
    rough = replace(STEADY, unexplained=0.02)
    assert judge_steady(turning(unexplained=0.05), 0.0, rough).verdict is Verdict.UNSTEADY


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


# A sensor of 80 × 100 pixels, whose empty region is smaller than the reed's, so it decides.
SMALL = Reconstruction(FresnelTransform((80, 100), 6.7e-6, 650e-9, 0.1), Region(30, 4, 40, 92))


def test_noise_alone_has_the_statistics_of_the_threshold():
    """Of a thousand empty pictures, the ratios have the mean and deviation that it presumes."""
    rng = np.random.default_rng(0)
    ratios = np.empty(1000)
    for number in range(len(ratios)):
        parts = rng.standard_normal((2, 80, 100), dtype=np.float32)
        image = (parts[0] + 1j * parts[1]).astype(np.complex64)
        noise = mean_power(SMALL.only_noise(image))
        ratios[number] = mean_power(SMALL.region.crop(image)) / noise
    presumed = (signal_threshold(SMALL) - 1) / 5
    assert ratios.mean() == pytest.approx(1, abs=0.01)
    assert ratios.std() == pytest.approx(presumed, rel=0.1)
    assert all(judge_signal(ratio, SMALL) for ratio in ratios)


def test_a_dead_camera_gives_no_signal():
    # Its pictures have no noise either, so there is no ratio.
    assert judge_signal(np.nan, SMALL).verdict is Verdict.NO_SIGNAL
    assert judge_signal(0.0, SMALL).verdict is Verdict.NO_SIGNAL


def test_a_little_more_than_noise_is_a_signal():
    camera = Reconstruction(
        FresnelTransform((1024, 1280), 6.7e-6, 650e-9, 1.0), Region(400, 300, 170, 400)
    )
    threshold = signal_threshold(camera)
    assert 1.01 < threshold < 1.03
    assert judge_signal(threshold, camera).verdict is Verdict.NO_SIGNAL
    assert judge_signal(threshold * 1.001, camera) is None


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
