"""What no effect explains, and its signs, on a bench whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.inference.discrepancy import (
    discrepancies_of,
    group_discrepancies,
    log_bayes_any_unknown,
)
from diagnosis.inference.predictive_checks import predictive_checks
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import BANDS, Coordinates
from physics.parameters.tree import BenchParameters
from tests.diagnosis.toy import EFFECTS, LEVEL, bench, fitted, measured

SLOPE, BUMP, OFFSET = EFFECTS[:3]


def signs(problem, effect, condition=None):
    null, candidate = fitted(problem), fitted(problem, effect)
    groups = condition or [""] * len(null.whitened_residual)
    return {sign.id: sign for sign in predictive_checks(problem, candidate, groups)}


def test_something_unknown_is_likelier_only_where_numbers_are_off() -> None:
    plain, off = measured(1, bench()), measured(1, bench(), extra=0.4)
    assert log_bayes_any_unknown(plain, fitted(plain)) < 0
    found = group_discrepancies(off, fitted(off))
    assert found["lines"] > 20
    assert found["clocks"] < 0


def test_an_effect_leaves_nothing_unknown_and_a_wrong_one_does() -> None:
    problem = measured(2, bench(crosstalk=0.6))
    right = log_bayes_any_unknown(problem, fitted(problem, BUMP))
    assert right < 0 < 20 < log_bayes_any_unknown(problem, fitted(problem, SLOPE))


def test_one_time_may_be_moved_alone(monkeypatch) -> None:
    problem = measured(2, bench())
    lines, clocks = problem.groups
    then = np.array([place.time == "t2" for place in lines.coordinates])
    moved = replace(lines, values=lines.values + 0.07 * then)
    problem = InferenceProblem((moved, clocks), BenchParameters(), (LEVEL,))
    candidate = fitted(problem)
    alone = group_discrepancies(problem, candidate)["lines"]
    monkeypatch.setattr("diagnosis.inference.discrepancy._FEWEST_OTHERS", np.inf)
    assert alone > group_discrepancies(problem, candidate)["lines"] + 1
    assert alone > 1


def test_where_nothing_is_off_nothing_unknown_gains() -> None:
    problem = measured(2, bench())
    candidate = fitted(problem)
    nothing = np.zeros((len(candidate.model.left), 1))
    assert all(factor < 0 for factor in discrepancies_of(problem, candidate, nothing).values())


def test_something_unknown_is_no_larger_noise() -> None:
    """Numbers that are all off by as much: the scale of the noise alone does not explain them."""
    problem = measured(1, bench(), extra=0.4)
    candidate = fitted(problem)
    assert candidate.weighed.scales.noise[0] > 1
    assert log_bayes_any_unknown(problem, candidate) > 20


def test_what_moves_two_blocks_counts_once_for_each() -> None:
    both = measured(3, bench(crosstalk=0.6, detuning_hz=0.3))
    lines, clocks = group_discrepancies(both, fitted(both)).values()
    total = log_bayes_any_unknown(both, fitted(both))
    assert total > max(lines, clocks) + 10


@pytest.mark.parametrize("seed", range(4))
def test_chance_fires_no_sign_next_to_the_truth(seed: int) -> None:
    found = signs(measured(seed, bench(crosstalk=0.5)), BUMP)
    assert set(found) == {"discrepancy", "largest"}
    assert not any(sign.significant for sign in found.values())


def test_each_sign_fires_for_its_own_cause() -> None:
    problem = measured(5, bench(), extra=0.4)
    assert signs(problem, SLOPE)["discrepancy"].significant
    names = ["gone" if k >= 60 else "" for k in range(80)]
    assert signs(measured(5, bench(detuning_hz=0.4)), SLOPE, condition=names)[
        "transfer"
    ].significant
    assert not signs(measured(5, bench()), SLOPE, condition=names)["transfer"].significant


def test_a_drift_that_no_effect_makes_is_looked_for_along_time() -> None:
    problem = measured(8, bench())
    lines, clocks = problem.groups
    # In an order of time that no effect knows.
    order = np.random.default_rng(0).permutation(60)
    places = tuple(Coordinates("line", time=f"t{k}") for k in range(60))
    still = replace(lines, coordinates=places)
    slow = 0.1 * (np.arange(60) / 59 - 0.5)

    def found(values: np.ndarray) -> float:
        block = replace(still, values=values)
        moved = InferenceProblem([block, clocks], BenchParameters(), (LEVEL,))
        return group_discrepancies(moved, fitted(moved))["lines"]

    assert found(still.values) < 0
    assert found(still.values + slow) > 3
    assert found(still.values + slow[order]) < 1


def test_what_grows_with_frequency_is_looked_for_along_bands() -> None:
    """Several numbers of each band, which a slope moves too little to be seen in one of them."""
    problem = measured(8, bench())
    lines, clocks = problem.groups
    number = np.arange(60) % len(BANDS)
    places = tuple(Coordinates("line", mode=f"m{k}", band=BANDS[n]) for k, n in enumerate(number))
    rising = 0.05 * (number / (len(BANDS) - 1) - 0.5)

    def found(values: np.ndarray, places: tuple[Coordinates, ...] = places) -> float:
        block = replace(lines, values=values, coordinates=places)
        moved = InferenceProblem([block, clocks], BenchParameters(), (LEVEL,))
        return group_discrepancies(moved, fitted(moved))["lines"]

    nowhere = tuple(replace(place, band="") for place in places)
    assert found(lines.values) < 0
    assert found(lines.values + rising) > found(lines.values + rising, nowhere) + 1


@pytest.mark.parametrize("where", ["region", "level"])
def test_one_place_or_level_may_be_moved(where: str) -> None:
    problem = measured(8, bench())
    lines, clocks = problem.groups
    third = np.arange(60) % 3
    moved = replace(
        lines,
        values=lines.values + 0.1 * (third == 1),
        coordinates=tuple(Coordinates("line", **{where: str(k)}) for k in third),
    )

    def found(block) -> float:
        off = InferenceProblem([block, clocks], BenchParameters(), (LEVEL,))
        return group_discrepancies(off, fitted(off))["lines"]

    nowhere = replace(moved, coordinates=(Coordinates("line"),) * 60)
    assert found(moved) > found(nowhere) + 1
