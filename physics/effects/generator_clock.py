"""A drive whose clock is not the modulators' one."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "clocks", generator_ppm=values["ratio"])


EFFECT = Effect(
    id="generator_clock",
    title="clocks disagree",
    stage=Stage.TIMING,
    parameters=(
        Parameter("ratio", "ppm", 5.0, "crystal oscillators keep within some parts per million"),
    ),
    change=_change,
    moves=frozenset({Tap.HOLOGRAM}),
    keeps=frozenset({Tap.SENSOR, Tap.MODES}),
    neighbours=("synthesizer_detuning",),
    action="one clock for all instruments",
    reference="data sheets of quartz oscillators",
)
