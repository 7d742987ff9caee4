"""Lines of several reeds, and to what they belong."""

import json

import numpy as np
import pytest

from fitting.acoustics.lines import (
    NearMode,
    SeenPeak,
    SweepPeaks,
    Verdict,
    acoustic_lines,
    nearest_mode,
)
from fitting.acoustics.poles import ExcitationPeak


def peak(hz, error_hz=3.0, height_db=9.0, ripple_hz=0.0):
    return ExcitationPeak(hz, error_hz, 25.0, 1.0, ripple_hz, 0.5, height_db, 0.3)


def seen(reed, hz, mode=None, **of_peak):
    return SeenPeak(reed, f"{reed}.h5", peak(hz, **of_peak), mode)


def sweep(reed, *peaks, low_hz=1400.0, high_hz=20_000.0):
    return SweepPeaks(reed, low_hz, high_hz, tuple(peaks))


def bench_sweeps(count, seed=1, error_hz=3.0):
    """One line at 4308.6 Hz, and in each reed one that is nowhere else."""
    rng = np.random.default_rng(seed)
    return [
        sweep(
            f"R{k}",
            seen(f"R{k}", 4308.6 + error_hz * rng.standard_normal(), error_hz=error_hz),
            seen(f"R{k}", 2000.0 * 2 ** (k / 10)),
        )
        for k in range(count)
    ]


def test_a_line_of_all_reeds_belongs_to_the_bench():
    lines = acoustic_lines(bench_sweeps(6))
    assert len(lines) == 7
    (line,) = [line for line in lines if line.verdict is Verdict.BENCH]
    assert (line.reeds, line.of, line.reason) == (6, 6, "")
    assert line.error_hz == pytest.approx(3 / np.sqrt(6), rel=0.5)
    assert abs(line.hz - 4308.6) < 3 * line.error_hz
    assert [each.reed for each in line.seen] == [f"R{k}" for k in range(6)]
    assert {each.verdict for each in lines if each is not line} == {Verdict.SUSPECT}


def test_errors_of_the_mean_are_those_of_many_benches():
    pulls = []
    for seed in range(200):
        lines = acoustic_lines(bench_sweeps(5, seed))
        (line,) = [line for line in lines if line.verdict is Verdict.BENCH]
        pulls.append((line.hz - 4308.6) / line.error_hz)
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.2


def test_the_ripple_of_the_loudspeaker_is_the_same_with_every_reed():
    """3 of 5 Hz do not decrease with the number of reeds."""
    sweeps = [
        sweep(f"R{k}", seen(f"R{k}", 4308.6 + (-1) ** k, error_hz=5.0, ripple_hz=3.0))
        for k in range(16)
    ]
    (line,) = acoustic_lines(sweeps)
    assert line.error_hz == pytest.approx(np.hypot(3.0, 4.0 / 4), rel=0.01)
    assert line.quality_error == pytest.approx(np.hypot(0.5, np.sqrt(0.75) / 4), rel=0.01)


def test_a_certain_pole_counts_more():
    sweeps = [
        sweep("R1", seen("R1", 4309.0, error_hz=1.0)),
        sweep("R2", seen("R2", 4309.0, error_hz=1.0)),
        sweep("R3", seen("R3", 4350.0, error_hz=60.0)),
    ]
    (line,) = acoustic_lines(sweeps)
    assert line.hz == pytest.approx(4309, abs=0.5)
    assert line.reeds == 3


def test_scatter_beyond_the_errors_is_stated():
    sweeps = [sweep(f"R{k}", seen(f"R{k}", 4300.0 + 8 * k, error_hz=0.5)) for k in range(5)]
    (line,) = acoustic_lines(sweeps)
    assert line.scatter_cents > 3
    assert line.error_hz > 2


@pytest.mark.parametrize(("reeds", "verdict"), [(1, Verdict.UNDECIDED), (2, Verdict.UNDECIDED)])
def test_few_reeds_decide_nothing(reeds, verdict):
    sweeps = [sweep(f"R{k}", seen(f"R{k}", 4308.6)) for k in range(reeds)]
    (line,) = acoustic_lines(sweeps)
    assert (line.verdict, line.reeds, line.of) == (verdict, reeds, reeds)


def test_a_line_that_few_of_many_reeds_show_is_suspect():
    sweeps = [sweep(f"R{k}", *([seen(f"R{k}", 4308.6)] if k < 3 else [])) for k in range(10)]
    (line,) = acoustic_lines(sweeps)
    assert (line.verdict, line.reeds, line.of) == (Verdict.SUSPECT, 3, 10)


def test_reeds_whose_sweep_does_not_cover_a_line_do_not_count():
    short = [sweep(f"S{k}", high_hz=3000.0) for k in range(10)]
    (line,) = acoustic_lines([sweep(f"R{k}", seen(f"R{k}", 4308.6)) for k in range(3)] + short)
    assert (line.verdict, line.of) == (Verdict.BENCH, 3)


def test_several_sweeps_of_one_reed_are_one_reed():
    (line,) = acoustic_lines([sweep("R1", seen("R1", 4308.6)) for _ in range(5)])
    assert (line.reeds, line.of, line.verdict) == (1, 1, Verdict.UNDECIDED)


def test_a_line_of_the_bench_stays_where_modes_move():
    """F2 is next to it in every reed, at another distance."""
    away = (-60.0, -20.0, 35.0, 70.0)
    sweeps = [
        sweep(f"R{k}", seen(f"R{k}", 4308.6 + (-1) ** k, NearMode("F2", cents)))
        for k, cents in enumerate(away)
    ]
    (line,) = acoustic_lines(sweeps)
    assert line.verdict is Verdict.BENCH


def test_a_line_that_follows_a_mode_is_suspect():
    sweeps = [
        sweep(
            f"R{k}",
            seen(f"R{k}", 4300.0 * 2 ** (9 * k / 1200), NearMode("F2", 30.0 + (-1) ** k)),
        )
        for k in range(4)
    ]
    (line,) = acoustic_lines(sweeps)
    assert line.verdict is Verdict.SUSPECT
    assert "F2" in line.reason


@pytest.mark.parametrize(
    ("height_db", "cents", "suspect"),
    [(17.0, 40.0, True), (14.0, 40.0, False), (17.0, 60.0, False), (40.0, -51.0, True)],
)
def test_a_high_peak_next_to_a_mode_is_suspect(height_db, cents, suspect):
    one = seen("R1", 3200.0, NearMode("T1", cents), height_db=height_db)
    assert one.suspect is suspect
    (line,) = acoustic_lines([sweep("R1", one)])
    assert (line.verdict is Verdict.SUSPECT) is suspect


def test_the_nearest_mode_is_nearest_in_cents():
    near = nearest_mode(3000.0, {"F1": 2000.0, "T1": 3030.0, "F2": 5000.0})
    assert near.name == "T1"
    assert near.cents == pytest.approx(-17.2, abs=0.1)
    assert nearest_mode(3000.0, {}) is None


def test_lines_in_a_row_do_not_merge_to_one():
    hz = [4300.0, 4300.0 * 2 ** (30 / 1200), 4300.0 * 2 ** (60 / 1200), 4300.0 * 2 ** (90 / 1200)]
    sweeps = [sweep(f"R{k}", *(seen(f"R{k}", each, error_hz=0.1) for each in hz)) for k in range(4)]
    lines = acoustic_lines(sweeps)
    assert all(np.ptp([each.peak.hz for each in line.seen]) < 4300 * 0.024 for line in lines)
    assert len(lines) >= 2


def test_json_has_plain_values():
    sweeps = [sweep(f"R{k}", seen(f"R{k}", 4308.6, NearMode("F2", 50.0))) for k in range(3)]
    (line,) = acoustic_lines(sweeps)
    answer = json.loads(json.dumps(line.to_json(), allow_nan=False))
    assert answer["verdict"] == "bench"
    assert set(answer) == {
        "hz", "error_hz", "quality", "quality_error", "height_db", "scatter_cents", "reeds", "of",
        "verdict", "reason", "seen",
    }  # fmt: skip
    assert set(answer["seen"][0]) == {
        "reed", "run", "hz", "error_hz", "quality", "quality_error", "ripple_hz", "ripple_quality",
        "height_db", "height_error_db", "mode", "mode_cents", "suspect",
    }  # fmt: skip
