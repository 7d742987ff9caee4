"""Modulators that are apart by something else than they are set to."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "clocks", detuning_hz=values["offset"])


EFFECT = Effect(
    id="synthesizer_detuning",
    title="modulators detuned",
    stage=Stage.TIMING,
    parameters=(
        Parameter(
            "offset", "Hz", 0.03, "a step of a synthesizer of 32 bits at 80 MHz is 0.02 to 0.1 Hz"
        ),
    ),
    change=_change,
    moves=frozenset({Tap.HOLOGRAM}),
    keeps=frozenset({Tap.SENSOR, Tap.MODES}),
    neighbours=("phase_step_error",),
    action="compare both tuning words; order 0 over minutes",
    reference="paper, equation 3",
)
