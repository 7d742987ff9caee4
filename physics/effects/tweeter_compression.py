"""A tweeter whose gain falls as its coil moves farther."""

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
    corner_hz = twin.drive.compression_hz * float(np.exp(values["log_corner"]))
    changed = replace(twin.drive, compression=twin.drive.compression + values["fraction"])
    return replace(twin, drive=replace(changed, compression_hz=corner_hz))


EFFECT = Effect(
    id="tweeter_compression",
    title="tweeter compresses",
    stage=Stage.DRIVE,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.3,
            "a dome tweeter near its rated power loses 1 to 3 dB",
            positive=True,
        ),
        Parameter(
            "log_corner",
            "",
            0.4,
            "the coil moves most where the dome is driven by its stiffness, up to some kHz",
        ),
    ),
    change=_change,
    moves=frozenset({Tap.DRIVE, Tap.RESPONSE}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD}),
    neighbours=("hardening_nonlinearity",),
    action="sweep at another drive level, a microphone next to it",
    reference="paper, section II.B: amplitudes ramped to 16 V",
)
