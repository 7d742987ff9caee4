"""What no effect explains, and its signs, on a bench whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.block import Place
from diagnosis.discrepancy import (
    _gains,
    _Left,
    anything,
    discrepancies,
)
from diagnosis.rivals import (
    Comparison,
    Sized,
    compete,
)
from diagnosis.sampling import sampled
from diagnosis.triggers import triggers
from physics.twin import Twin
from tests.diagnosis.toy import EFFECTS, LEVEL, bench, measured

SLOPE, BUMP, OFFSET = (Sized(effect, {}) for effect in EFFECTS[:3])


def fitted(comparison, *effects):
    count = 1 + len(effects)
    return compete(comparison, effects, [np.full(count, 0.1)], exact=True)


def signs(comparison, *effects, condition=None):
    null, rival = fitted(comparison), fitted(comparison, *effects)
    groups = condition or [""] * len(null.left)
    return {sign.id: sign for sign in triggers(comparison, rival, groups)}


def test_something_unknown_is_likelier_only_where_numbers_are_off() -> None:
    calm, off = measured(1, bench()), measured(1, bench(), extra=0.4)
    assert anything(calm, fitted(calm)) < 0
    found = discrepancies(off, fitted(off))
    assert float(found["lines"][0]) > 20
    assert float(found["clocks"][0]) < 0


def test_an_effect_leaves_nothing_unknown_and_a_wrong_one_does() -> None:
    comparison = measured(2, bench(crosstalk=0.6))
    right = anything(comparison, fitted(comparison, BUMP))
    assert right < 0 < 20 < anything(comparison, fitted(comparison, SLOPE))


def test_one_time_may_be_moved_alone(monkeypatch) -> None:
    comparison = measured(2, bench())
    lines, clocks = comparison.blocks
    then = np.array([place.time == "t2" for place in lines.places])
    moved = replace(lines, values=lines.values + 0.07 * then)
    comparison = Comparison((moved, clocks), Twin(), (LEVEL,))
    rival = fitted(comparison)
    alone = float(discrepancies(comparison, rival)["lines"][0])
    monkeypatch.setattr("diagnosis.discrepancy._ONE_ALONE", ())
    assert alone > float(discrepancies(comparison, rival)["lines"][0]) + 1
    assert alone > 1


@pytest.mark.parametrize("deviation", [1.0, 1e4])
def test_where_nothing_is_off_nothing_unknown_gains(deviation: float) -> None:
    comparison = measured(2, bench())
    rival = fitted(comparison)
    residuals = np.zeros((len(rival.estimate.residuals), 1))
    left = _Left(residuals, rival.free, deviation * rival.deviation)
    for block in comparison.blocks:
        gains = [float(gain[0]) for gain, _ in _gains(left, comparison.slices[block.name], block)]
        assert max(gains) < 0


def test_what_moves_two_blocks_counts_once_for_each() -> None:
    both = measured(3, bench(crosstalk=0.6, detuning_hz=0.3))
    lines, clocks = (float(factor[0]) for factor in discrepancies(both, fitted(both)).values())
    total = anything(both, fitted(both))
    assert total > max(lines, clocks) + 10
    # No likelihood is greater than that of numbers that are where they should be.
    assert total + fitted(both).log_evidence < 0


@pytest.mark.parametrize("seed", range(4))
def test_chance_fires_no_sign_beside_the_truth(seed: int) -> None:
    found = signs(measured(seed, bench(crosstalk=0.5)), BUMP)
    assert set(found) == {"discrepancy", "largest", "implausible"}
    assert not any(sign.fired for sign in found.values())


def test_each_sign_fires_for_its_own_cause() -> None:
    comparison = measured(5, bench(), extra=0.4)
    assert signs(comparison, SLOPE)["discrepancy"].fired
    huge = measured(5, bench(detuning_hz=4.5))
    assert signs(huge, OFFSET)["implausible"].fired
    names = ["gone" if k >= 60 else "" for k in range(80)]
    assert signs(measured(5, bench(detuning_hz=0.4)), SLOPE, condition=names)["transfer"].fired
    assert not signs(measured(5, bench()), SLOPE, condition=names)["transfer"].fired


def test_sampled_evidence_of_a_straight_model_is_laplaces() -> None:
    comparison = measured(6, bench(leak=0.2))
    for effects in ((SLOPE,), (SLOPE, OFFSET)):
        found = sampled(comparison, fitted(comparison, *effects), draws=400)
        assert found.gain == pytest.approx(0.0, abs=0.15)
        assert found.effective > 100


def test_sampled_evidence_minds_a_bound() -> None:
    # A size that cannot be negative and is best at 0: half of its posterior is cut off.
    comparison = measured(7, bench())
    rival = fitted(comparison, BUMP)
    found = sampled(comparison, rival, draws=2000)
    assert found.gain == pytest.approx(0.0, abs=0.5)


def test_a_drift_that_no_effect_makes_is_looked_for_along_time() -> None:
    comparison = measured(8, bench())
    lines, clocks = comparison.blocks
    # In an order of time that no effect knows.
    order = np.random.default_rng(0).permutation(60)
    places = tuple(Place("line", time=f"t{k}") for k in range(60))
    still = replace(lines, places=places)
    slow = 0.1 * (np.arange(60) / 59 - 0.5)

    def found(values: np.ndarray) -> float:
        block = replace(still, values=values)
        moved = Comparison([block, clocks], Twin(), (LEVEL,))
        return float(discrepancies(moved, fitted(moved))["lines"][0])

    assert found(still.values) < 0
    assert found(still.values + slow) > 3
    assert found(still.values + slow[order]) < 1
