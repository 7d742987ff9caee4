"""Phase steps that are not a quarter of a turn, every other one."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "optics", quarter_error_rad=values["error"])


EFFECT = Effect(
    id="phase_step_error",
    title="phase steps unequal",
    stage=Stage.OPTICS,
    parameters=(Parameter("error", "rad", 0.15, "a tenth of a quarter turn"),),
    change=_change,
    moves=frozenset({Tap.HOLOGRAM}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.MODES}),
    neighbours=("synthesizer_detuning",),
    action="order 0: steps within an acquisition and between them",
    reference="phase-shifting holography",
)
