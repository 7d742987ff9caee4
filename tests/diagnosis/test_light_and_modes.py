"""Noise outside the image, light at rest, and levels of sweeps, compared with sums by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.inference.candidates import without_effects
from diagnosis.inference.effect_scan import Start, scan_effect
from diagnosis.inference.nuisances import Nuisance
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observables.brightness import (
    FIELD_CHANGE,
    _brightness,
    acquired_until,
    brightness_group,
    field_changing,
)
from diagnosis.observables.carrier import Leaks
from diagnosis.observables.drive import _torn
from diagnosis.observables.light import noise_group
from diagnosis.observables.modes import _of_leaks
from diagnosis.observables.reed_at_rest import stability_group
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import _doubt, at_highest_level, loudest
from physics.effects.catalogue import BY_ID
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters

COUNT = 184


def sweep(name, noise_dn2, fringe_dn2, clamping=0, loudness=1.0):
    """Say what a reading says of a sweep's noise, without one."""
    at = np.arange(COUNT, dtype=float)
    return SimpleNamespace(
        name=name, clamping=clamping, loudness=loudness, time_s=60.0 + at, volts=np.ones(COUNT),
        noise_dn2=noise_dn2 * np.exp(0.01 * np.sin(17 * at)),
        fringe_dn2=np.full(COUNT, float(fringe_dn2)),
        drive_hz=1000.0 * 2 ** (at / 48), signal=0.01 * np.sin(at),
        off=np.zeros(COUNT, bool),
    )  # fmt: skip


def test_pixels_that_differ_spread_fringes_by_the_square_of_what_they_differ_by() -> None:
    # Of two sweeps one has bright fringes; what p of them is spread out is p² of their power.
    p, noise, fringes = 0.05, 1600.0, 2e5
    sweeps = [sweep("dim", noise, 0.0), sweep("up", noise + p**2 * fringes, fringes)]
    block = noise_group(sweeps, dark_dn=2.0)
    half = len(block.values) // 2
    predicted = block.predict(BenchParameters(sensor=Sensor(pattern=p)))
    assert np.mean(predicted[half:]) - np.mean(predicted[:half]) == pytest.approx(
        np.log1p(p**2 * fringes / noise), abs=3e-3
    )
    assert (
        np.abs(
            block.values[half:] - predicted[half:] - block.values[:half] + predicted[:half]
        ).max()
        < 1e-2
    )
    assert np.ptp(block.predict(BenchParameters())) == pytest.approx(0.0, abs=1e-12)


def test_light_that_walks_differs_between_two_sweeps_by_what_it_walked_in_between() -> None:
    # Two sweeps of ten acquisitions: one upwards, one downwards a minute later.
    one, two = np.arange(10.0), 60.0 + np.arange(10.0)
    sweeps = [SimpleNamespace(time_s=one), SimpleNamespace(time_s=two)]
    times_s = [(one[[k]], two[[9 - k]]) for k in range(10)]
    columns = field_changing(times_s, sweeps, np.concatenate([one, two])).columns
    found = columns @ columns.T / FIELD_CHANGE**2
    # The pause between them counts as the fifty acquisitions that it would have had.
    steps = np.concatenate([one, two])
    walk = np.minimum.outer(steps, steps)
    apart = np.zeros((10, 20))
    apart[np.arange(10), np.arange(10)], apart[np.arange(10), 19 - np.arange(10)] = 1, -1
    # In addition, all of one sweep may differ from the other.
    assert found == pytest.approx(apart @ walk @ apart.T + len(steps) / 2, abs=1e-9)
    # What a faster sweep takes between them counts as well: 41 steps in 20 seconds.
    third = np.concatenate([one, 20.0 + 0.5 * np.arange(41.0), two])
    more = field_changing(times_s, sweeps, third).columns
    assert (more @ more.T / FIELD_CHANGE**2)[0, 0] > found[0, 0] + 20
    # What is 69 acquisitions apart differs by more than what is 51 apart.
    assert found[0, 0] - found[9, 9] == pytest.approx(18.0)


def test_acquisitions_are_counted_and_pauses_as_if_there_were_some() -> None:
    at = np.arange(10.0)
    assert acquired_until(np.array([2.0, 5.0, 9.0]), at) == pytest.approx([0, 3, 7])
    # An hour without any, and what is before the first and after the last.
    late = np.array([-5.0, 0.0, 4.0, 3604.0, 3609.0, 3619.0])
    steps = acquired_until(late, np.concatenate([at[:5], 3600.0 + at]))
    assert steps == pytest.approx([0, 5, 9, 3609, 3614, 3624])
    # No step of a sweep has a lock that is known: those of light at rest are 0.4 s apart.
    assert acquired_until(np.array([10.0, 30.0]), np.zeros(0)) == pytest.approx([0, 50])


def _still(turns=(), likeness=1.0, begun_s=(0.0, 100.0), ratios=(0.0,)):
    return SimpleNamespace(
        clamping=0, frame_ratio=np.array(ratios), frame_scatter=1e-5,
        likeness=np.array([[1.0, likeness], [likeness, 1.0]]), likeness_error=1e-5,
        run_time_s=np.array(begun_s),
    )  # fmt: skip


def test_speckle_may_have_changed_by_what_time_went_by() -> None:
    """Whether or not the acquisitions in between have a lock that is known."""
    sweep_s = 10.0 + 0.4 * np.arange(184)
    errors = [
        stability_group([_still(begun_s=(0.0, 90.0))], acquired_s).errors.noise[-1]
        for acquired_s in (sweep_s, np.zeros(0))
    ]
    assert errors[0] == pytest.approx(errors[1], rel=0.05)
    pause = stability_group([_still(begun_s=(0.0, 3600.0))], sweep_s).errors.noise[-1]
    assert pause / errors[0] == pytest.approx(3600 / 90, rel=0.05)


def test_few_acquisitions_do_not_show_how_a_laser_flickers() -> None:
    """An ordinary laser scatters by 0.2 %; one ratio of frames is no measure of it."""
    one = stability_group([_still(ratios=(0.004,))], np.zeros(0))
    assert abs(one.whitened_residual(BenchParameters())[0]) < 2.5
    three = stability_group([_still(ratios=(0.002, 0.002, 0.002))], np.zeros(0))
    assert abs(three.whitened_residual(BenchParameters())[0]) < 2.5
    # Many that agree are a quiet laser, and a common ratio a fault.
    rng = np.random.default_rng(1)
    many = 0.004 + 1e-4 * rng.standard_normal(16)
    assert (
        stability_group([_still(ratios=many)], np.zeros(0)).whitened_residual(BenchParameters())[0]
        > 50
    )


def test_brightness_that_walks_is_as_uncertain_as_walks_make_it() -> None:
    """Sweeps are compared with their mean: what the first of them shows is no start of a walk."""
    rng, names, k = np.random.default_rng(8), ("up", "down", "shuffled"), np.arange(COUNT)
    order = {"up": k, "down": k[::-1], "shuffled": rng.permutation(COUNT)}
    sums = []
    for _ in range(40):
        walk = np.cumsum(FIELD_CHANGE * rng.standard_normal(len(names) * COUNT))
        sweeps = [sweep(name, 1.0, 0.0) for name in names]
        for number, one in enumerate(sweeps):
            place = COUNT * number + order[one.name]
            one.time_s = 60.0 + place
            one.signal = np.sin(k / 20) + walk[place] + 1e-3 * rng.standard_normal(COUNT)
        block = brightness_group(sweeps, [])
        off = block.values - block.predict(BenchParameters())
        everywhere = [n for n in block.errors.nuisances if not n.name.startswith("locally")]
        covariance = block.errors.covariance(everywhere)
        sums.append(off @ np.linalg.solve(covariance, off) / len(off))
    # Whole sweeps differ by less than is allowed for; a sum of squares of 24 scatters by 0.29.
    assert np.mean(sums) == pytest.approx(0.9, abs=0.15)
    assert np.quantile(sums, 0.95) < 1.8


def test_of_two_sweeps_what_one_is_brighter_by_is_what_the_other_is_darker_by() -> None:
    """It counts once: up and down are both compared with their mean."""
    rng, k = np.random.default_rng(3), np.arange(COUNT)
    up, down = sweep("up", 1.0, 0.0), sweep("down", 1.0, 0.0)
    for one in (up, down):
        one.signal = 0.02 * rng.standard_normal(COUNT)
    down.time_s = 600.0 + k[::-1]
    block = brightness_group([up, down], [])
    noise = block.errors.covariance()
    deviation = np.sqrt(np.diag(noise))
    # The first eighth of the way up has the frequencies of the last one of the way down.
    for piece in range(8):
        correlation = noise[piece, 15 - piece] / (deviation[piece] * deviation[15 - piece])
        assert correlation == pytest.approx(-1 / (0.5 * np.pi), abs=0.05)
    # A mean of 23 holograms of 2 %, less that of both sweeps, and a median is less sure.
    usual = np.sqrt(3 * 0.5 * np.pi * 0.02**2 / 2 / 23)
    assert np.median(deviation) == pytest.approx(usual, rel=0.25)


def test_holograms_in_wrong_fringes_say_nothing_of_the_light() -> None:
    """Neither in their own sweep nor in those that are compared with it, which may run down."""
    up, down = sweep("up", 1.0, 0.0), sweep("down", 1.0, 0.0)
    down.time_s = 400.0 - down.time_s
    down.signal = 0.01 * np.sin(1.3 * np.arange(COUNT))
    clean = brightness_group([up, down], [])
    off = np.zeros(COUNT, bool)
    # More than half of a piece of 23.
    off[25:38] = True
    down.off, down.signal = off, down.signal - 0.5 * off
    marked = brightness_group([up, down], [])
    assert marked.coordinates == clean.coordinates
    assert marked.values == pytest.approx(clean.values, abs=5e-3)
    # What fewer holograms show has a larger error, in both sweeps.
    errors = np.diag(marked.errors.noise) / np.diag(clean.errors.noise)
    at = [place.time for place in marked.coordinates]
    assert errors[at.index("up 2")] > 1.2
    assert errors[at.index("down 7")] > 1.2
    # A third sweep has its own frequencies in between.
    third = sweep("third", 1.0, 0.0)
    third.drive_hz = third.drive_hz * 2 ** (0.5 / 48)
    shifted = brightness_group([up, down, third], [])
    at = [place.time for place in shifted.coordinates]
    assert shifted.values[at.index("third 2")] == pytest.approx(0.0, abs=5e-3)


def test_where_no_fringe_is_right_nothing_is_compared() -> None:
    up, down = sweep("up", 1.0, 0.0), sweep("down", 1.0, 0.0)
    up.off = np.arange(COUNT) % 2 == 0
    readings = SimpleNamespace(sweeps=[up, down], stills=[])
    assert _brightness(readings, None) is not None
    down.off = ~up.off
    assert _brightness(readings, None) is None


def test_light_that_walks_here_and_there_is_as_uncertain_as_walks_make_it() -> None:
    """Each of forty places walks by itself, and counts around frequencies of its own."""
    rng, names, k = np.random.default_rng(9), ("up", "down", "shuffled"), np.arange(COUNT)
    order = {"up": k, "down": k[::-1], "shuffled": rng.permutation(COUNT)}
    places = 40
    log_hz = np.log(sweep("up", 1.0, 0.0).drive_hz)
    off = []
    for _ in range(40):
        middle = rng.uniform(log_hz[0] - 0.5, log_hz[-1] + 0.5, places)
        # Their products are correlated over the mean distance of modes, 0.19.
        loads = np.exp(-(((log_hz[:, None] - middle) / 0.19) ** 2))
        loads *= rng.choice([-1, 1], places) / np.sqrt(np.mean(np.sum(loads**2, axis=1)))
        walk = np.cumsum(FIELD_CHANGE * rng.standard_normal((len(names) * COUNT, places)), axis=0)
        sweeps = [sweep(name, 1.0, 0.0) for name in names]
        for number, one in enumerate(sweeps):
            place = COUNT * number + order[one.name]
            one.time_s = 60.0 + place
            one.signal = np.sum(walk[place] * loads, axis=1)
        block = brightness_group(sweeps, [])
        off.append(block.values - block.predict(BenchParameters()))
    local = [each for each in block.errors.nuisances if each.name.startswith("locally")]
    stated = np.sum(local[0].columns ** 2, axis=1)
    found = np.mean(np.square(off), axis=0)
    assert found.mean() / stated.mean() == pytest.approx(1.0, abs=0.2)
    of_sweeps = found.reshape(3, 8).sum(axis=1) / stated.reshape(3, 8).sum(axis=1)
    assert of_sweeps == pytest.approx(np.ones(3), abs=0.35)


def test_runs_at_rest_are_averaged_by_themselves_however_long_they_are() -> None:
    still = SimpleNamespace(
        clamping=0, time_s=np.arange(12.0), brightness=np.r_[np.zeros(4), np.full(8, -0.2)],
        run=np.repeat([0, 1], [4, 8]), run_time_s=np.array([1.5, 7.5]),
    )  # fmt: skip
    block = brightness_group([sweep("up", 1.0, 0.0), sweep("down", 1.0, 0.0)], [still])
    rest = [
        v for v, p in zip(block.values, block.coordinates, strict=True) if p.quantity == "order 0"
    ]
    assert rest == pytest.approx([0.0, -0.2])


def test_acquisitions_that_are_equal_by_chance_are_no_surer_than_light_is() -> None:
    # Four at rest differ by nothing; light of the sweeps scatters by 3 %.
    rng = np.random.default_rng(4)
    sweeps = [sweep(name, 1.0, 0.0) for name in ("up", "down", "shuffled")]
    for one in sweeps:
        one.signal = 0.03 * rng.standard_normal(COUNT)
    still = SimpleNamespace(
        clamping=0, time_s=np.arange(8.0), brightness=np.repeat([0.0, 0.04], 4),
        run=np.repeat([0, 1], 4), run_time_s=np.array([1.5, 5.5]),
    )  # fmt: skip
    block = brightness_group(sweeps, [still])
    one, two = (k for k, place in enumerate(block.coordinates) if place.quantity == "order 0")
    C = block.covariance
    apart = C[one, one] + C[two, two] - 2 * C[one, two]
    # Two means of four, or a little less for what a mean of three sweeps takes along.
    assert np.sqrt(apart) > 0.03 * np.sqrt(2 / 4) * 0.7


def test_light_that_was_taken_off_makes_small_modes_uncertain() -> None:
    drive_hz = 1000.0 * 2 ** (np.arange(COUNT) / 48)
    sweep = SimpleNamespace(
        name="up", taken_off=0.02, drive_hz=drive_hz, hz=np.array([1500.0, 3000.0, 6000.0]),
        amplitude_rad=np.where(drive_hz < 4000, 1.0, 0.1),
    )  # fmt: skip
    leaks = Leaks({"up": 0.01}, 0.0)

    def errors(lowest):
        modes = np.arange(3)
        return np.sqrt(np.diag(_of_leaks(leaks, sweep, modes, modes == lowest)))

    found = errors(None)
    assert found[2] / found[1] == pytest.approx(10, rel=0.05)
    assert found[0] == found[1]
    ratio = errors(0) / found
    assert ratio[[0, 3]].min() > 3
    assert ratio[[1, 2, 4, 5]] == pytest.approx(1.0)
    sweep.taken_off = 0.0
    # Nothing was taken off: all modes equal, and next to nothing.
    assert errors(0)[:3] == pytest.approx(np.full(3, errors(0)[0]))
    assert errors(0)[0] < found[0]


def test_steps_far_from_a_resonance_are_near_it_if_none_is_nearer() -> None:
    sweep = SimpleNamespace(
        name="up", taken_off=0.02, drive_hz=np.array([1000.0, 2000.0, 4000.0]),
        hz=np.array([1450.0]), amplitude_rad=np.array([1.0, 0.5, 0.1]),
    )  # fmt: skip

    def cents():
        leaks = Leaks({"up": 0.01}, 0.0)
        return np.sqrt(_of_leaks(leaks, sweep, np.array([0]), [False])[0, 0])

    half = cents()
    sweep.amplitude_rad[1] = 0.2
    # Of what moves at 2 kHz, and of the middle: both are that step's.
    assert cents() == pytest.approx(half)
    sweep.amplitude_rad[2] = 0.4
    assert cents() > 1.5 * half


def test_a_drive_that_jumps_by_a_mode_leaves_its_force_open() -> None:
    at = np.arange(COUNT, dtype=float)
    drive_hz = 1000.0 * 2 ** (at / 48)
    smooth = np.sin(at / 20)
    jumping = smooth - 3.0 * (at == 60)
    hz = drive_hz[[60, 120]]
    torn = [_torn(SimpleNamespace(log_drive=log, drive_hz=drive_hz), hz)
            for log in (smooth, jumping)]  # fmt: skip
    np.testing.assert_array_equal(torn[0], 0.0)
    # Its second difference is twice the jump.
    assert torn[1] == pytest.approx([0.5 * (2 * 3.0 - 0.4), 0.0], abs=0.01)


def test_fits_of_few_modes_are_doubted_most() -> None:
    def fit(modes, discrepancy, off=0, bent=0.0):
        drive = np.exp(bent * np.random.default_rng(2).standard_normal(COUNT))
        return SimpleNamespace(
            resonances=dict.fromkeys(range(modes)),
            modal=SimpleNamespace(drive=drive, off=np.arange(COUNT) < off, discrepancy=discrepancy),
            block_amplitudes=SimpleNamespace(volts=np.ones(COUNT)),
        )

    # Five of a hundred displacements that are off by a fifth leave 0.2 √(0.05/2) = 0.032.
    good, smooth, torn, empty = (
        _doubt(fit(12, 0.03, bent=0.1)), _doubt(fit(12, 0.04)), _doubt(fit(12, 0.04, bent=0.1)),
        _doubt(fit(4, 1e-4)),
    )  # fmt: skip
    assert (good[0], smooth[0], torn[0], empty[0]) == (0, 0, 1, 2)
    assert max(good, smooth, torn) < empty
    few, many = (int(share * COUNT) for share in (0.04, 0.06))
    assert _doubt(fit(12, 3e-3, off=few, bent=0.1))[0] == 0
    assert _doubt(fit(12, 3e-3, off=many, bent=0.1))[0] == 1


def test_levels_count_once_whatever_a_few_lost_steps_do_to_their_mean() -> None:
    sweeps = [sweep("a", 1, 0), sweep("b", 1, 0, loudness=-0.4), sweep("c", 1, 0, clamping=1),
              sweep("d", 1, 0, loudness=1.05)]  # fmt: skip
    assert [s.name for s in at_highest_level(sweeps)] == ["a", "c", "d"]
    assert [s.name for s in loudest(sweeps)] == ["a", "d"]


def _hopped(after_s):
    """Return three sweeps in which fringes lose a fifth, and readings with their times."""
    rng, sweeps = np.random.default_rng(6), []
    k = np.arange(COUNT)
    for number, order in enumerate((k, k[::-1], rng.permutation(COUNT))):
        one = sweep(f"sweep {number}", 1.0, 0.0)
        one.time_s = 300.0 * number + 0.4 * order
        one.signal = np.log1p(-0.2) * (one.time_s > after_s) + 0.01 * rng.standard_normal(COUNT)
        sweeps.append(one)
    stills = [SimpleNamespace(time_s=np.array([1200.0, 1200.4]))]
    return sweeps, SimpleNamespace(sweeps=sweeps, stills=stills)


@pytest.mark.parametrize("after_s", [41.3, 352.1, 640.7, 450.0])
def test_a_laser_that_hops_within_a_sweep_or_between_two_is_found(after_s: float) -> None:
    """As well as if it were known when."""
    sweeps, readings = _hopped(after_s)
    moments_h = Readings.moments_h.fget(readings)
    assert len(moments_h) < 160
    # Every pause is one of them.
    assert {round(3600 * h) for h in moments_h} >= {187, 487, 937}
    nothing = Nuisance("nothing", "", 1.0, lambda parameters, _value: parameters, "toy")
    problem = InferenceProblem([brightness_group(sweeps, [])], BenchParameters(), (nothing,))
    start = Start.without(problem, without_effects(problem, [np.zeros(1)]).estimate)
    exact, found, grid = (
        scan_effect(problem, start, BY_ID["laser_mode_hop"].at_moments(hours))
        for hours in ((after_s / 3600,), moments_h, ())
    )
    gain = found.weighed.log_evidence - start.weighed.log_evidence
    assert gain > 8
    assert gain == pytest.approx(exact.weighed.log_evidence - start.weighed.log_evidence, rel=0.2)
    # Hours of bench files are too far apart to find most of those within a sweep.
    assert found.log_evidence > grid.log_evidence - (1 if after_s == 450.0 else 0)
