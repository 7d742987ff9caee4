"""Light that does not reach the corners of the sensor."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "optics", vignette=values["fraction"])


EFFECT = Effect(
    id="vignetting",
    title="corners are dark",
    stage=Stage.CAMERA,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.15,
            "windows, mounts and beam splitters at the edge of the field",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("lo_misalignment",),
    action="shift the camera",
    reference="frames of even light",
)
