"""A local oscillator that does not fall on the middle of the sensor."""

from collections.abc import Mapping
from dataclasses import replace

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    y_m, x_m = twin.optics.shift_m
    moved = y_m + values["down"], x_m + values["right"]
    return replace(twin, optics=replace(twin.optics, shift_m=moved))


EFFECT = Effect(
    id="lo_misalignment",
    title="local oscillator off centre",
    stage=Stage.OPTICS,
    parameters=(
        Parameter("down", "m", 0.0008, "a turn of a mirror mount"),
        Parameter("right", "m", 0.0008, "a turn of a mirror mount"),
    ),
    change=_change,
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("vignetting",),
    action="frames of the local oscillator alone",
    reference="Gaussian beams",
)
