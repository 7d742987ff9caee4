"""A small bench whose truth is known: straight lines with a few things that may be wrong."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from diagnosis.inference.candidate_search import search_alone
from diagnosis.inference.candidates import Candidate, refitted, without_effects
from diagnosis.inference.effect_scan import Start
from diagnosis.inference.nuisances import Nuisance
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Coordinates, Observable, observable_group
from physics.effects.effect import (
    Effect,
    Parameter,
    Stage,
)
from physics.parameters.clocks import Clocks
from physics.parameters.tree import BenchParameters, more, with_part

COUNT = 60
AT = np.linspace(-1, 1, COUNT)


def lines(parameters: BenchParameters) -> np.ndarray:
    """Numbers of the first tap: a level, a slope, a bump."""
    beams = parameters.optics.interference
    return beams.fade_per_h + beams.leak * AT + beams.crosstalk * np.exp(-((AT / 0.2) ** 2))


def clocks(parameters: BenchParameters) -> np.ndarray:
    """Numbers of the second tap."""
    clocks: Clocks = parameters.clocks
    return clocks.detuning_hz + 0.3 * parameters.optics.interference.leak * AT[:20]


LEVEL = Nuisance(
    "level", "", 2.0, lambda t, v: more(t, "optics.interference", fade_per_h=v), "anything"
)


def _changed(
    part: str, field: str, parameters: BenchParameters, values: Mapping[str, float]
) -> BenchParameters:
    return more(parameters, part, **{field: values["size"]})


def effect(name: str, part: str, field: str, positive: bool = False) -> Effect:
    """Make an effect that is one field of the parameters."""
    return Effect(
        id=name,
        title=name,
        stage=Stage.OPTICS,
        parameters=(Parameter("size", "", 1.0, "toy", positive, most=6.0),),
        change=partial(_changed, part, field),
        reference="",
    )


EFFECTS = (
    effect("slope", "optics.interference", "leak"),
    effect("bump", "optics.interference", "crosstalk", positive=True),
    effect("offset", "clocks", "detuning_hz"),
    effect("nothing", "sensor", "nonlinearity", positive=True),
)


def measured(
    seed: int,
    truth: BenchParameters,
    noise: float = 0.05,
    extra: float = 0.0,
    extra_clock: float = 0.0,
    clock_truth: BenchParameters | None = None,
) -> InferenceProblem:
    """Measure a bench; what is extra in lines or clocks no effect can make.

    The clocks may be those of another bench.
    """
    rng = np.random.default_rng(seed)
    y = lines(truth) + noise * rng.standard_normal(COUNT) + extra * np.sign(np.sin(40 * AT))
    y2 = clocks(clock_truth or truth) + noise * rng.standard_normal(20)
    y2 += extra_clock * np.sign(np.sin(40 * AT[:20]))
    places = [
        Coordinates("line", band="low" if a < 0 else "high", time=f"t{int(4 * abs(a))}") for a in AT
    ]
    both = [
        observable_group(
            "lines", Observable.MAPS, y, np.full(COUNT, noise), places, ("optics",), lines
        ),
        observable_group(
            "clocks",
            Observable.HOLOGRAM,
            y2,
            np.full(20, noise),
            [Coordinates("clock")] * 20,
            ("clocks", "optics"),
            clocks,
        ),
    ]
    return InferenceProblem(both, BenchParameters(), (LEVEL,))


def bench(**changes: float) -> BenchParameters:
    """Make a bench with some fields of its beams, or `detuning_hz`, changed."""
    parameters = BenchParameters()
    detuning = changes.pop("detuning_hz", 0.0)
    parameters = replace(parameters, clocks=replace(parameters.clocks, detuning_hz=detuning))
    return with_part(parameters, "optics.interference", **changes)


def fitted(problem: InferenceProblem, effect: Effect | None = None) -> Candidate:
    """Fit a problem in full, without effects or with one that changes something."""
    null = without_effects(problem, [np.zeros(len(problem.nuisances))])
    if effect is None:
        return null
    start = Start.without(problem, null.estimate)
    found = search_alone(problem, start, null, effect)
    assert found is not None
    return refitted(problem, found, [found.estimate.z])
