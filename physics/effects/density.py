"""Cane denser or lighter than the reference material, for example because it is moist."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="density",
    title="density of the cane differs",
    stage=Stage.MECHANICS,
    position=2,
    parameters=(
        Parameter(
            "density",
            "",
            0.1,
            "density of cane, 450 to 600 kg/m³; at most: cane of 350 to 850 kg/m³",
            most=0.4,
        ),
    ),
    change=additive("reed.shift", density="density"),
    reference="paper, section III: density taken as constant",
)
