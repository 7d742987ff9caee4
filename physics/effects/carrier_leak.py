"""Light that no vibration has shifted, in every sideband."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "optics", leak=values["fraction"])


EFFECT = Effect(
    id="carrier_leak",
    title="carrier leaks in",
    stage=Stage.OPTICS,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.03,
            "spurs of synthesizers lie 40 to 60 dB below their line; unshifted light adds to them",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MAPS}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.MODES}),
    neighbours=("sideband_crosstalk",),
    action="a sweep with the drive off",
    reference="data sheets of direct digital synthesizers",
)
