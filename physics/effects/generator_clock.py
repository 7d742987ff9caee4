"""A drive generator whose clock differs from the synthesizers' clock."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="generator_clock",
    title="generator and synthesizer clocks disagree",
    stage=Stage.TIMING,
    position=2,
    parameters=(
        Parameter(
            "ratio",
            "ppm",
            5.0,
            "crystal oscillators agree within a few parts per million; at most: "
            "the cheapest crystals",
            most=100.0,
        ),
    ),
    change=additive("clocks", generator_ppm="ratio"),
    reference="data sheets of quartz oscillators",
)
