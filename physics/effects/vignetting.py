"""Optics that keep light from the corners of the sensor."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage, Tap

EFFECT = Effect(
    id="vignetting",
    title="corners of the image are dark",
    stage=Stage.CAMERA,
    position=0,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.15,
            "windows, mounts and beam splitters at the edge of the field",
            positive=True,
        ),
    ),
    change=additive("optics", vignette="fraction"),
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("lo_misalignment",),
    action="shift the camera",
    reference="frames of even light",
)
