"""A drive with several acoustic resonances that no bench file lists."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.inference.model_selection import select_model, tried_alone
from diagnosis.inference.nuisances import Nuisance
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Coordinates, Observable, observable_group
from physics.drive import acoustic_gain
from physics.effects.catalogue import BY_ID
from physics.parameters.drive import AcousticResonance
from physics.parameters.tree import BenchParameters, more, with_part
from tests.diagnosis.toy import EFFECTS

HZ = np.geomspace(2e3, 16e3, 150)
NOISE = 0.03
SECOND, THIRD = BY_ID["second_acoustic_resonance"], BY_ID["third_acoustic_resonance"]
TRIED = (SECOND, THIRD, EFFECTS[0])
LEVEL = Nuisance(
    "level", "", 0.5, lambda t, v: more(t, "optics.interference", fade_per_h=v), "anything"
)


def gain(parameters: BenchParameters) -> np.ndarray:
    """Log magnitude of a drive, at a level that is not known."""
    level = parameters.optics.interference.fade_per_h
    return np.log(np.abs(acoustic_gain(parameters.drive, HZ))) + level


def beams(parameters: BenchParameters) -> np.ndarray:
    """Numbers that no resonance changes."""
    return parameters.optics.interference.leak * np.ones(5)


def measured(seed: int, lines_hz: tuple[float, ...]) -> InferenceProblem:
    """Measure a drive with these lines, of a quality of 30: 12 dB."""
    fields = ("second_resonance", "third_resonance")
    lines = {
        field: AcousticResonance(hz, 30.0, 0.1) for field, hz in zip(fields, lines_hz, strict=False)
    }
    rng, truth = np.random.default_rng(seed), with_part(BenchParameters(), "drive", **lines)
    groups = [
        observable_group(
            name, Observable.DRIVE, number(truth) + NOISE * rng.standard_normal(count),
            np.full(count, NOISE), [Coordinates(name)] * count, of, number,
        )
        for name, number, count, of in (
            ("drive", gain, len(HZ), ("drive", "optics")), ("beams", beams, 5, ("optics",))
        )
    ]  # fmt: skip
    return InferenceProblem(groups, BenchParameters(), (LEVEL,))


def test_one_line_is_one_and_two_are_two() -> None:
    one = select_model(measured(1, (5200.0,)), TRIED)
    assert one.probability_of_what_shows[SECOND.id] > 0.9
    two = select_model(measured(2, (5200.0, 9100.0)), TRIED)
    name = f"{SECOND.id}+{THIRD.id}"
    assert two.probability_of_what_shows[name] > 0.9
    found_hz = sorted(located.location["hz"] for located in two.pairs[name].effects)
    assert found_hz == pytest.approx([5200.0, 9100.0], rel=0.03)
    # Another line is no line by itself.
    assert set(two.single) == {SECOND.id, "slope"}
    assert two.count == 2


def test_a_line_next_to_one_that_is_known_is_tried_alone() -> None:
    assert tried_alone(TRIED) == [SECOND, EFFECTS[0]]
    assert tried_alone(TRIED[1:]) == [THIRD, EFFECTS[0]]
    known = with_part(
        BenchParameters(), "drive", second_resonance=AcousticResonance(5200.0, 30.0, 0.1)
    )
    problem = measured(2, (5200.0, 9100.0))
    problem = InferenceProblem(problem.groups, known, problem.nuisances)
    found = select_model(problem, TRIED[1:])
    assert found.probability_of_what_shows[THIRD.id] > 0.9


def test_two_of_a_kind_are_half_as_likely_beforehand_as_two_kinds() -> None:
    found = select_model(measured(2, (5200.0, 9100.0)), TRIED)
    kind = found.pairs[f"{SECOND.id}+{THIRD.id}"]
    # The same evidence for what is no second of its kind.
    located = replace(kind.effects[1], effect=replace(THIRD, after=""))
    stranger = replace(kind, effects=(kind.effects[0], located))
    other = replace(found, pairs={**found.pairs, "stranger": stranger})
    odds = other.log_probability["stranger"] - other.log_probability[f"{SECOND.id}+{THIRD.id}"]
    assert odds == pytest.approx(np.log(2))
