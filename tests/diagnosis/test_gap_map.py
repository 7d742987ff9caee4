"""Where a gap lies and how far it shrinks, on a bench whose truth is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.campaign_diagnosis import _only
from diagnosis.explained_fraction import _Predicted, explained_fraction
from diagnosis.gap_map import gap_map
from diagnosis.inference.nuisances import Nuisance
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import (
    DISORDER,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    observable_group,
)
from physics.parameters.tree import BenchParameters, more
from tests.diagnosis.toy import COUNT, EFFECTS, bench, fitted, measured


def groups(problem):
    return [f"{b.name} {p.time or p.quantity}" for b in problem.groups for p in b.coordinates]


def test_chance_of_a_gap_is_uniform_where_nothing_is_wrong() -> None:
    rng = np.random.default_rng(0)
    chances, failing = [], 0
    for seed in range(60):
        # The level is drawn from its prior: it is unknown, not wrong.
        found = gap_map(measured(seed, bench(fade_per_h=2.0 * rng.standard_normal())))
        whole = next(c for c in found.cells if c.axis == "group" and c.group == "lines")
        chances.append(whole.chance)
        failing += found.first_failing is not None
    # Means of 60 uniform numbers scatter by 0.037, and 6 ± 2.3 of them lie below 0.1.
    assert np.mean(chances) == pytest.approx(0.5, abs=0.13)
    assert np.count_nonzero(np.array(chances) < 0.1) <= 14
    # Of 60 campaigns 0.6 fail by chance, however many cells there are.
    assert failing <= 4


def test_the_first_failing_tap_is_where_the_cause_shows_first() -> None:
    assert gap_map(measured(1, bench())).first_failing is None
    assert gap_map(measured(1, bench(detuning_hz=0.3))).first_failing is Observable.HOLOGRAM
    assert gap_map(measured(1, bench(crosstalk=0.6))).first_failing is Observable.MAPS


def test_cells_tell_the_band() -> None:
    found = gap_map(measured(2, bench(leak=0.0, crosstalk=0.0), extra=0.0))
    assert not any(cell.resolvable for cell in found.cells)
    clear = gap_map(measured(2, bench(crosstalk=0.8)))
    by_time = {c.label: c for c in clear.cells if c.axis == "time"}
    # The bump is in the middle, whose numbers are of time 0.
    assert by_time["t0"].resolvable
    assert not by_time["t3"].resolvable
    assert sum(c.count for c in clear.cells if c.axis == "time") == COUNT


def test_the_map_does_not_depend_on_what_was_fitted_before() -> None:
    curved = Nuisance(
        "level", "", 1.0, lambda t, v: more(t, "optics.interference", fade_per_h=v + v**3), ""
    )
    blocks = measured(2, bench(crosstalk=0.8)).groups
    fresh, used = (InferenceProblem(blocks, BenchParameters(), (curved,)) for _ in range(2))
    used.jacobian(np.array([1.0]))
    assert gap_map(used) == gap_map(fresh)


def test_a_sweep_is_left_out_wherever_it_has_numbers_of_its_own() -> None:
    places = [
        Coordinates("lock", time="again"),
        Coordinates("carrier", level="again"),
        Coordinates("line"),
        Coordinates("fringes", time="again 2"),
        Coordinates("force", time="up", level="up"),
    ]
    blocks = [SimpleNamespace(coordinates=places)]
    left = _only(SimpleNamespace(groups=blocks), "again")
    assert left == ["again", "again", "", "again", ""]


def test_the_right_effect_closes_the_gap_and_a_wrong_one_does_not() -> None:
    problem = measured(3, bench(fade_per_h=0.4, crosstalk=0.5))
    null = fitted(problem)
    right, wrong = (fitted(problem, EFFECTS[k]) for k in (1, 0))
    closed = explained_fraction(problem, null, right, groups(problem))
    assert closed.fraction == pytest.approx(1.0, abs=0.15)
    assert closed.low <= closed.fraction <= closed.high
    assert explained_fraction(problem, null, wrong, groups(problem)).fraction < 0.2


def test_no_gap_is_not_resolvable_rather_than_closed() -> None:
    for seed in range(6):
        problem = measured(seed, bench())
        null = fitted(problem)
        slope = fitted(problem, EFFECTS[0])
        closed = explained_fraction(problem, null, slope, groups(problem))
        # Where chance leaves a gap above the floor, it is none that could surely be closed.
        assert np.isnan(closed.fraction) or np.isnan(closed.low) or closed.low < 0.2


def test_shares_of_the_ladder_add_up_either_way_and_name_the_stage() -> None:
    ladder = gap_map(measured(4, bench(detuning_hz=0.4))).ladder
    assert sum(rung.forward for rung in ladder) == pytest.approx(1.0)
    assert sum(rung.backward for rung in ladder) == pytest.approx(1.0)
    share = {rung.observable: rung.forward for rung in ladder}
    assert share[Observable.HOLOGRAM] == pytest.approx(1.0, abs=0.05)
    assert share[Observable.MAPS] == pytest.approx(0.0, abs=0.05)


def test_where_nothing_is_wrong_no_stage_has_a_share() -> None:
    assert gap_map(measured(1, bench())).ladder == ()


def test_an_earlier_stage_that_fixes_the_level_takes_the_later_ones_share() -> None:
    # Both taps are off equally by what an unknown level makes of the later one alone.
    both = gap_map(measured(5, bench(leak=1.0)))
    share = {rung.observable: (rung.forward, rung.backward) for rung in both.ladder}
    assert share[Observable.MAPS][0] > 0.5
    assert share[Observable.HOLOGRAM][1] > 0.0


def test_what_one_stage_says_of_another_is_its_own_fraction() -> None:
    # Two stages off equally, by what an unlikely level makes of both: whichever is measured first
    # has it all, and the other one follows.
    level = Nuisance(
        "level", "", 0.05, lambda t, v: more(t, "optics.interference", fade_per_h=v), ""
    )
    both = [
        observable_group(
            tap,
            tap,
            np.full(20, 0.5),
            np.full(20, 0.05),
            [Coordinates("level")] * 20,
            ("optics",),
            lambda parameters: np.full(20, parameters.optics.interference.fade_per_h),
        )
        for tap in (Observable.HOLOGRAM, Observable.MAPS)
    ]
    first, second = gap_map(InferenceProblem(both, BenchParameters(), (level,))).ladder
    # Of one stage alone the square of the gap is 2000·400/8400, of both 4000·400/16400.
    assert first.forward > 0.95
    assert second.forward < 0.05
    assert (first.backward, second.backward) == pytest.approx((second.forward, first.forward))


def test_the_chance_of_a_tap_is_that_of_any_cell_of_any_tap() -> None:
    found = gap_map(measured(2, bench(crosstalk=0.1)))
    for tap, worst in found.observables.items():
        own = [cell.chance for cell in found.cells if cell.observable is tap]
        assert worst.chance == pytest.approx(min(1.0, len(found.observables) * len(own) * min(own)))


def test_a_share_is_of_the_gap_above_its_floor() -> None:
    problem = measured(3, bench(crosstalk=0.15))
    null = fitted(problem)
    half = fitted(problem, EFFECTS[1])
    closed = explained_fraction(problem, null, half, groups(problem))
    assert closed.floor == 1.0
    assert closed.before < 4
    share = (closed.before - closed.after) / (closed.before - 1.0)
    assert closed.fraction == pytest.approx(share)


def test_what_is_left_out_counts_by_what_it_could_be_predicted_to() -> None:
    """Of a mean of n numbers, one left out is that of n - 1 more uncertain by a root."""
    n, away = 5, 3.0
    values = np.zeros(n)
    values[0] = away
    level = Nuisance(
        "level", "", 1e3, lambda t, v: more(t, "optics.interference", fade_per_h=v), ""
    )
    numbers = observable_group(
        "all",
        Observable.MAPS,
        values,
        np.ones(n),
        [Coordinates("level")] * n,
        ("optics",),
        lambda parameters: np.full(n, parameters.optics.interference.fade_per_h),
    )
    problem = InferenceProblem([numbers], BenchParameters(), (level,))
    predicted = _Predicted.of(problem, fitted(problem))
    square = predicted.square(np.arange(n) == 0)
    assert square == pytest.approx(away**2 / (1 + 1 / (n - 1)), rel=1e-3)


@pytest.mark.parametrize("common", ["noise", "nuisance of the group"])
def test_what_numbers_have_in_common_is_predicted_by_those_that_are_not_left_out(common) -> None:
    """Two numbers with an error of 1 in common and 0.1 of their own, both 3 off."""
    both = np.ones((2, 1))
    errors = (
        Errors(0.01 * np.eye(2) + both @ both.T)
        if common == "noise"
        else Errors(np.full(2, 0.1), (GroupNuisances("common", both, DISORDER, "toy"),))
    )
    group = observable_group(
        "both", Observable.MAPS, [3.0, 3.0], errors, [Coordinates("level")] * 2, ("optics",),
        lambda _parameters: np.zeros(2),
    )  # fmt: skip
    none = Nuisance("none", "", 1.0, lambda parameters, _: parameters, "nothing")
    problem = InferenceProblem([group], BenchParameters(), (none,))
    predicted = _Predicted.of(problem, fitted(problem))
    # The other one says 3/1.01, with a variance of 1.01 - 1/1.01.
    expected = (3 - 3 / 1.01) ** 2 / (1.01 - 1 / 1.01)
    for chosen in ([True, False], [False, True]):
        assert predicted.square(np.array(chosen)) == pytest.approx(expected, rel=1e-6)
    assert predicted.square(np.ones(2, bool)) == pytest.approx(
        np.array([3, 3]) @ np.linalg.solve(0.01 * np.eye(2) + 1, [3, 3])
    )
