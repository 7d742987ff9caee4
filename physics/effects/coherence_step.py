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
    if not values["hop"]:
        return twin
    return replace(twin, beams=replace(twin.beams, hop=values["hop"], hop_share=values["share"]))


EFFECT = Effect(
    id="coherence_step",
    title="laser hops",
    stage=Stage.OPTICS,
    parameters=(
        Parameter("hop", "", 0.2, "from a little to most of the contrast", positive=True),
        Parameter("share", "", 0.0, "at any time", places=_SHARES),
    ),
    change=_change,
    single=True,
    moves=frozenset({Tap.FIELD}),
    keeps=frozenset({Tap.LOG, Tap.MODES, Tap.SENSOR}),
    neighbours=("laser_drift",),
    action="a reference picture at every step",
    reference="multimode diode lasers",
)
