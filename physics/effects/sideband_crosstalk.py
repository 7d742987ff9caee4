"""The next sideband in every sideband."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "optics", crosstalk=values["fraction"])


EFFECT = Effect(
    id="sideband_crosstalk",
    title="next sideband leaks in",
    stage=Stage.OPTICS,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.08,
            "the camera integrates over an exposure: sidebands far apart vanish, spurs do not",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MAPS}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.MODES}),
    neighbours=(
        "speckle_decorrelation",
        "carrier_leak",
    ),
    action="look at the second sideband",
    reference="paper, section II.A",
)
