"""Modulators whose difference drifts."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "clocks", detuning_hz_h=values["rate"])


EFFECT = Effect(
    id="synthesizer_drift",
    title="modulators drift apart",
    stage=Stage.TIMING,
    parameters=(Parameter("rate", "Hz/h", 0.15, "oscillators that warm up"),),
    change=_change,
    moves=frozenset({Tap.HOLOGRAM}),
    keeps=frozenset({Tap.SENSOR, Tap.MODES}),
    neighbours=("synthesizer_detuning",),
    action="wait until they are warm",
    reference="data sheets of quartz oscillators",
)
