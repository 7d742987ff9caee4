"""Optics that keep light from the corners of the sensor."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

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
            "windows, mounts and beam splitters at the edge of the field; at "
            "most: corners of a third of the light",
            positive=True,
            most=0.7,
        ),
    ),
    change=additive("optics.illumination", vignette="fraction"),
    reference="frames of even light",
)
