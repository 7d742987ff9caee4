"""A reed that gets stiffer as it vibrates more."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "environment", hardening=values["fraction"])


EFFECT = Effect(
    id="hardening_nonlinearity",
    title="stiffer at large amplitude",
    stage=Stage.MECHANICS,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.002,
            "relative stiffening at a phase amplitude of 10 rad, half a micrometre",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD}),
    neighbours=("temperature_drift",),
    action="sweep at another drive level, in random order",
    reference="Duffing, Erzwungene Schwingungen, 1918",
)
