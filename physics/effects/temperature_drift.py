"""Cane that warms up, or cools down, while it is measured."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    if not values["rate"]:
        return twin
    loss = twin.environment.loss_per_c * float(np.exp(values["log_loss"]))
    changed = replace(
        twin.environment,
        warming_c_h=twin.environment.warming_c_h + values["rate"],
        loss_per_c=loss,
    )
    return replace(twin, environment=changed)


EFFECT = Effect(
    id="temperature_drift",
    title="temperature drifts",
    stage=Stage.ENVIRONMENT,
    parameters=(
        Parameter("rate", "degC/h", 6.0, "rooms, and reeds beside lamps and lasers"),
        Parameter(
            "log_loss",
            "",
            0.5,
            "how the loss of wood follows temperature differs from piece to piece",
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD}),
    neighbours=("drying",),
    action="sweep up and down, and again after an hour",
    reference="Weidenfeller et al., Mater. Res. 21, e20170795 (2018)",
)
