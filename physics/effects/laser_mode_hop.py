"""A laser that hops to another mode: fringes lose contrast at once, the light does not."""

from collections.abc import Mapping
from dataclasses import replace

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin

_SHARES = tuple(0.05 * k for k in range(1, 20))


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    if not values["contrast_loss"]:
        return twin
    return replace(
        twin,
        optics=replace(
            twin.optics, hop=values["contrast_loss"], hop_time_fraction=values["time_fraction"]
        ),
    )


EFFECT = Effect(
    id="laser_mode_hop",
    title="laser hops",
    stage=Stage.OPTICS,
    parameters=(
        Parameter("contrast_loss", "", 0.2, "from a little to most of the contrast", positive=True),
        Parameter("time_fraction", "", 0.0, "at any time", places=_SHARES),
    ),
    change=_change,
    single=True,
    moves=frozenset({Tap.FIELD}),
    keeps=frozenset({Tap.LOG, Tap.MODES, Tap.SENSOR}),
    neighbours=("laser_power_drift",),
    action="a reference picture at every step",
    reference="multimode diode lasers",
)
