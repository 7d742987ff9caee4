"""A clamp with one compliant strip: the left one, or the right one if the size is negative."""

from collections.abc import Mapping

from physics.alterations import YieldingClamp
from physics.effects.effect import Effect, Parameter, Stage
from physics.parameters.tree import BenchParameters, with_alteration


def _change(parameters: BenchParameters, values: Mapping[str, float]) -> BenchParameters:
    compliance = values["compliance"]
    return with_alteration(parameters, YieldingClamp(1 if compliance > 0 else -1), abs(compliance))


EFFECT = Effect(
    id="clamp_asymmetry",
    title="one strip of the clamp is compliant",
    stage=Stage.MECHANICS,
    position=11,
    parameters=(
        Parameter(
            "compliance",
            "m/Pa",
            2e-13,
            "0.5 mm of hard plastic, 2.5 GPa, under one strip; at most: 0.2 mm of rubber, 50 MPa",
            most=4e-12,
        ),
    ),
    change=_change,
    reference="paper, section III",
)
