"""The known resonance of the excitation device, stronger than it was."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "drive", resonance_excess=values["excess"])


EFFECT = Effect(
    id="acoustic_resonance",
    title="known line is stronger",
    stage=Stage.ACOUSTICS,
    parameters=(
        Parameter(
            "excess",
            "",
            1.0,
            "chambers are filled by hand: from nothing to some times as strong",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.DRIVE}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD, Tap.MODES}),
    neighbours=("second_acoustic_resonance",),
    action="change the volume of the chamber",
    reference="paper, section III: picture 78 of both series",
)
