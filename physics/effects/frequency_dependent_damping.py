"""Losses that grow with frequency, where the twin has one loss factor."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, with_reed


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_reed(twin, loss_growth=twin.reed.loss_growth + values["exponent"])


EFFECT = Effect(
    id="frequency_dependent_damping",
    title="losses grow with frequency",
    stage=Stage.MECHANICS,
    parameters=(Parameter("exponent", "", 0.3, "loss tangents of wood from 1 to 20 kHz"),),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("air_load",),
    action="let modes ring down",
    reference="Ono and Norimoto, loss of spruce against frequency",
)
