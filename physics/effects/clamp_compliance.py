"""A clamp that yields: strips on elastic beds."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.mechanics import YieldingClamp
from physics.twin import Twin, with_alteration


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_alteration(twin, YieldingClamp(), values["compliance"])


EFFECT = Effect(
    id="clamp_compliance",
    title="clamp yields",
    stage=Stage.MECHANICS,
    parameters=(
        Parameter(
            "compliance",
            "m/Pa",
            2e-13,
            "0.5 mm of hard plastic, 2.5 GPa, under each strip",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("viscoelastic_stiffening", "transverse_shear"),
    action="clamp the reed again, harder",
    reference="paper, section III: strips hold the reed fast",
)
