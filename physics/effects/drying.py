"""A moist reed that dries while it is measured."""

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
    if not values["fraction"]:
        return twin
    drying_s = twin.environment.drying_s * float(np.exp(values["log_time"]))
    drying = twin.environment.drying + values["fraction"]
    changed = replace(twin.environment, drying=drying, drying_s=drying_s)
    return replace(twin, environment=changed)


EFFECT = Effect(
    id="drying",
    title="reed dries",
    stage=Stage.ENVIRONMENT,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.25,
            "a reed that was moistened loses most of it in an hour",
            positive=True,
        ),
        Parameter(
            "log_time",
            "",
            0.5,
            "diffusion through half a millimetre of cane: a quarter of an hour to an hour",
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD}),
    neighbours=("temperature_drift",),
    action="wait for an hour and sweep again; weigh the reed",
    reference="paper, series B beside A; Obataya and Norimoto, Mokuzai Gakkaishi 41, 289 (1995)",
)
