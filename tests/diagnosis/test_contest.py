"""Rivals on a bench whose truth is known."""

import numpy as np
import pytest

from diagnosis.contest import NONE, UNKNOWN, contest
from diagnosis.rivals import Sized, compete
from physics.twin import Twin
from tests.diagnosis.toy import EFFECTS, bench, measured


def probabilities(comparison):
    return {name: np.exp(log) for name, log in contest(comparison, EFFECTS).log_probability.items()}


def test_probabilities_sum_to_one() -> None:
    assert sum(probabilities(measured(1, bench())).values()) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_named_on_a_bench_with_nothing_wrong(seed: int) -> None:
    found = probabilities(measured(seed, bench(fade_per_h=1.3)))
    assert max(found, key=found.get) == NONE


@pytest.mark.parametrize(
    ("changes", "name"),
    [({"leak": 0.4}, "slope"), ({"leak": -0.4}, "slope"), ({"mixing": 0.5}, "bump"),
     ({"detuning_hz": -0.3}, "offset")],
)  # fmt: skip
def test_what_is_wrong_is_named(changes: dict[str, float], name: str) -> None:
    found = probabilities(measured(3, bench(fade_per_h=-0.7, **changes)))
    assert found[name] > 0.8


def test_two_things_are_named_together() -> None:
    found = probabilities(measured(4, bench(mixing=0.6, detuning_hz=0.3)))
    best = max(found, key=found.get)
    assert set(best.split("+")) == {"bump", "offset"}


def test_what_no_effect_makes_is_unknown() -> None:
    found = probabilities(measured(5, bench(), extra=0.4))
    assert found[UNKNOWN] > 0.9


def test_effects_that_move_nothing_do_not_compete() -> None:
    found = contest(measured(6, bench()), EFFECTS)
    assert "nothing" not in found.alone
    assert set(found.signatures) == {"slope", "bump", "offset"}


def test_sizes_come_back_within_their_errors() -> None:
    comparison = measured(7, bench(fade_per_h=0.5, leak=0.3))
    slope = Sized(EFFECTS[0], {})
    found = compete(comparison, (slope,), [np.zeros(2)])
    error = np.sqrt(found.estimate.covariance[1, 1])
    assert found.estimate.z[1] == pytest.approx(0.3, abs=4 * error)
    assert error < 0.02
    assert found.names == ("slope",)


def test_a_louder_noise_than_told_is_no_effect() -> None:
    # Replicates that were a third too quiet: everything is off by a little more than it should be.
    comparison = measured(8, Twin(), noise=0.05)
    louder = measured(8, Twin(), noise=0.065)
    blocks = [
        type(b)(**{**vars(b), "covariance": a.covariance, "root": a.root})
        for a, b in zip(comparison.blocks, louder.blocks, strict=True)
    ]
    found = probabilities(type(comparison)(blocks, Twin(), comparison.nuisances))
    assert max(found, key=found.get) == NONE
