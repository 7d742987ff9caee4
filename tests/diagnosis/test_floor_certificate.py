"""Floor certificate: repeated numbers against their errors."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.campaign_diagnosis import CampaignSummary, diagnose_problem
from diagnosis.floor_certificate import Floor, certified, floor_certificate
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Coordinates, Observable, observable_group
from physics.parameters.tree import BenchParameters
from reports.diagnosis_json import to_json
from reports.diagnosis_page import document
from tests.diagnosis.toy import AT, EFFECTS, LEVEL, bench, fitted, measured


def repeated(scatter: float, errors: float = 1.0, seed: int = 5) -> InferenceProblem:
    """Four modes in six sweeps, with a level that is a nuisance, and clocks that are read once."""
    rng = np.random.default_rng(seed)
    places = [
        Coordinates("hz", mode=f"F{m}", time=f"sweep {k}") for k in range(6) for m in range(4)
    ]
    values = 3.0 + scatter * rng.standard_normal(24)
    many = observable_group(
        "modes", Observable.MODES, values, np.full(24, errors), places, ("optics",),
        lambda parameters: np.full(24, parameters.optics.interference.fade_per_h),
    )  # fmt: skip
    once = observable_group(
        "clock", Observable.LOG, [0.1], np.array([0.2]), [Coordinates("clock")], ("clocks",),
        lambda parameters: np.array([parameters.clocks.detuning_hz]),
    )  # fmt: skip
    return InferenceProblem([many, once], BenchParameters(), (replace(LEVEL, spread=10.0),))


def floors_of(problem: InferenceProblem) -> dict[str, Floor]:
    return {floor.group: floor for floor in floor_certificate(problem, fitted(problem))}


def test_numbers_that_scatter_as_their_errors_say_are_trusted() -> None:
    found = floors_of(repeated(1.0))
    assert found["modes"].trusted
    assert (found["modes"].count, found["modes"].replicates) == (24, 20)
    assert found["modes"].scatter == pytest.approx(1.0, abs=3 / np.sqrt(2 * 20))
    assert found["modes"].chance > 0.01


def test_chances_are_evenly_distributed_where_errors_are_right() -> None:
    chances = np.sort([floors_of(repeated(1.0, seed=seed))["modes"].chance for seed in range(60)])
    # Kolmogorov's 1 % limit for 60 numbers.
    assert np.abs(chances - (np.arange(60) + 0.5) / 60).max() < 1.63 / np.sqrt(60)


def test_numbers_that_scatter_three_times_as_much_are_not_trusted() -> None:
    found = floors_of(repeated(3.0))
    assert not found["modes"].trusted
    assert found["modes"].scatter == pytest.approx(3.0, rel=3 / np.sqrt(2 * 20))
    assert found["modes"].chance < 1e-6
    assert found["modes"].factor > 1.5
    assert found["clock"].trusted


def test_what_is_measured_once_has_no_replicates() -> None:
    clock = floors_of(repeated(1.0))["clock"]
    assert (clock.replicates, clock.chance) == (0, 1.0)
    assert np.isnan(clock.scatter)


def test_what_replicates_have_in_common_does_not_count() -> None:
    problem = repeated(1.0)
    (modes, clock), shift = problem.groups, np.tile([0.0, 40.0, -30.0, 7.0], 6)
    moved = replace(modes, values=modes.values + shift)
    other = InferenceProblem([moved, clock], problem.base, problem.nuisances)
    one, two = (floors_of(each)["modes"].scatter for each in (problem, other))
    assert one == pytest.approx(two, rel=1e-6)


def test_a_deviation_from_the_form_of_an_effect_is_no_scatter() -> None:
    """What the effect does is 6 % more or less than in its file, from time to time."""
    problem = measured(3, bench(leak=2.0))
    lines, clocks = problem.groups
    sign = np.array([1 if place.time in {"t0", "t2"} else -1 for place in lines.coordinates])
    moved = replace(lines, values=lines.values + 0.06 * 2.0 * AT * sign)
    other = InferenceProblem([moved, clocks], problem.base, problem.nuisances)
    candidate = fitted(other, EFFECTS[0])
    assert floor_certificate(other, candidate)[0].chance > 0.01
    exact = np.zeros_like(candidate.weighed.nuisances)
    plain = replace(
        candidate,
        estimate=replace(candidate.estimate, residuals=candidate.whitened_residual),
        weighed=replace(candidate.weighed, nuisances=exact),
    )
    assert floor_certificate(other, plain)[0].chance < 1e-6


def drifting(per_sweep: float) -> InferenceProblem:
    """The same modes, of which all drift from sweep to sweep."""
    problem = repeated(1.0)
    (modes, clock), drift = problem.groups, per_sweep * np.repeat(np.arange(6.0), 4)
    moved = replace(modes, values=modes.values + drift)
    return InferenceProblem([moved, clock], problem.base, problem.nuisances)


def test_errors_that_are_too_small_are_made_larger_before_any_cause_is_tried() -> None:
    problem = repeated(3.0)
    other, factors = certified(problem, fitted(problem))
    assert list(factors) == ["modes"]
    # The least if any one sweep is left out.
    assert factors["modes"] == pytest.approx(2.8, rel=3 / np.sqrt(2 * 16))
    modes, clock = other.groups
    np.testing.assert_allclose(modes.errors.noise, factors["modes"])
    np.testing.assert_allclose(modes.covariance, factors["modes"] ** 2 * np.eye(24))
    assert clock is problem.groups[1]
    assert floor_certificate(other, fitted(other))[0].scatter == pytest.approx(1.0, abs=0.15)


def test_errors_that_are_right_stay() -> None:
    problem = repeated(1.0)
    other, factors = certified(problem, fitted(problem))
    assert factors == {}
    assert other is problem


def test_a_drift_is_no_noise() -> None:
    """An effect may make it; errors that are made larger would hide that."""
    problem = drifting(2.0)
    found = floors_of(problem)["modes"]
    assert found.chance < 1e-6
    assert found.order_chance < 0.05
    assert not found.too_small
    assert certified(problem, fitted(problem))[1] == {}


def test_one_sweep_that_is_off_is_no_noise() -> None:
    problem = repeated(1.0)
    (modes, clock), off = problem.groups, np.where(np.arange(24) // 4 == 3, 9.0, 0.0)
    other = problem.with_groups([replace(modes, values=modes.values + off), clock])
    found = floors_of(other)["modes"]
    assert found.chance < 1e-6
    assert found.in_no_order
    assert found.even_chance > 0.01
    assert certified(other, fitted(other))[1] == {}


def test_order_chances_are_evenly_distributed_where_there_is_no_order() -> None:
    found = [floors_of(repeated(1.0, seed=seed))["modes"].order_chance for seed in range(60)]
    chances = np.sort(found)
    assert np.abs(chances - (np.arange(60) + 0.5) / 60).max() < 1.63 / np.sqrt(60)


def test_few_times_have_no_order() -> None:
    """Lines have five times, clocks none."""
    problem = measured(3, bench())
    lines, clocks = floor_certificate(problem, fitted(problem))
    assert (lines.times, clocks.times) == (5, 0)
    assert 2 / 120 <= lines.order_chance <= 1
    assert np.isnan(clocks.order_chance)
    assert not clocks.too_small


@pytest.mark.slow
def test_a_bench_that_scatters_more_is_no_reason_for_an_alarm() -> None:
    """Clocks are read in six sweeps and scatter three times as much as their errors say."""
    alarms, inflated = 0, 0
    for seed in range(12):
        problem = measured(seed, bench())
        rng = np.random.default_rng(100 + seed)
        lines, clocks = problem.groups
        loud = replace(
            clocks,
            values=clocks.values + 0.14 * rng.standard_normal(20),
            coordinates=tuple(Coordinates("clock", time=f"sweep {k}") for k in range(20)),
        )
        verdict = diagnose_problem(problem.with_groups([lines, loud]), CampaignSummary(""))
        floors = {floor.group: floor for floor in verdict.floor}
        assert not floors["clocks"].trusted
        inflated += floors["clocks"].inflated > 1.8
        alarms += verdict.kind != "none"
    # One in twenty is as smooth as a drift by chance, and then has its errors as they were.
    assert alarms <= 1
    assert inflated >= 11


def test_page_and_json_name_groups_that_are_not_trusted() -> None:
    verdict = diagnose_problem(measured(3, bench(leak=0.3)), CampaignSummary("t3"))
    assert [floor["group"] for floor in to_json(verdict)["floor"]] == ["lines", "clocks"]
    assert all(floor["trusted"] for floor in to_json(verdict)["floor"])
    bad = Floor("lines", 60, 52, 2.46, 1e-9, 4, 2.4, 1e-9, 0.01, 1.9)
    page = document(replace(verdict, floor=(bad, *verdict.floor[1:])), "A reed")
    assert "lines (repeated numbers scatter 2.5 times as much)" in page
