"""Air that moves along with the reed, and sound that it sends out."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, with_reed


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_reed(twin, air_share=twin.reed.air_share + values["fraction"])


EFFECT = Effect(
    id="air_load",
    title="air moves along",
    stage=Stage.ACOUSTICS,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.7,
            "1 is free air on both sides in a baffle; a mouthpiece is neither",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("viscoelastic_stiffening", "thickness_offset"),
    action="sweep at low pressure",
    reference="Rayleigh, Theory of Sound, section 302",
)
