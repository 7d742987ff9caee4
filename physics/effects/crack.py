"""A crack, or separated fibres, under the bark side."""

from collections.abc import Mapping

from physics.alterations import SoftSpot
from physics.effects.effect import Effect, Parameter, Stage
from physics.parameters.tree import BenchParameters, with_alteration


def _change(parameters: BenchParameters, values: Mapping[str, float]) -> BenchParameters:
    return with_alteration(parameters, SoftSpot(values["x"], values["y"]), values["depth"])


EFFECT = Effect(
    id="crack",
    title="crack in the vamp",
    stage=Stage.MECHANICS,
    position=12,
    parameters=(
        Parameter(
            "depth",
            "m",
            6e-05,
            "a tenth of the thickness in the middle of the vamp; at most: two "
            "thirds of the thickness there",
            positive=True,
            most=0.0004,
        ),
        Parameter(
            "x", "m", 0.0, "anywhere on the vamp", grid=(8e-3, 12e-3, 16e-3, 20e-3, 24e-3, 28e-3)
        ),
        Parameter("y", "m", 0.0, "anywhere on the vamp", grid=(-4e-3, -2e-3, 0.0, 2e-3, 4e-3)),
    ),
    change=_change,
    reference="Rayleigh, Theory of Sound, section 88: a change of stiffness",
)
