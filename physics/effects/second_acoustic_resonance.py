"""A second resonance of the air, that nobody has told of."""

import math
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

# Lines of Q 30 are no closer than half their width apart. Between two of them a line may be
# anywhere, and between two qualities.
_APART = 0.018
_HZ = tuple(float(hz) for hz in 2000.0 * (1 + _APART) ** np.arange(117))
_QUALITIES, _LOG_QUALITY = (18.0, 42.0), 0.35


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    if not values["strength"]:
        return twin
    drive = replace(
        twin.drive,
        second_strength=values["strength"],
        second_hz=values["hz"] * float(np.exp(values["log_hz"])),
        second_quality=values["quality"] * float(np.exp(values["log_quality"])),
    )
    return replace(twin, drive=drive)


EFFECT = Effect(
    id="second_acoustic_resonance",
    title="another line of the air",
    stage=Stage.ACOUSTICS,
    parameters=(
        Parameter("strength", "", 0.2, "like the known line of the device", positive=True),
        Parameter("log_hz", "", _APART / math.sqrt(12), "anywhere between two places"),
        Parameter("log_quality", "", _LOG_QUALITY, "small cavities with openings"),
        Parameter("hz", "Hz", 0.0, "anywhere in the sweep", places=_HZ),
        Parameter("quality", "", 0.0, "small cavities with openings", places=_QUALITIES),
    ),
    change=_change,
    single=True,
    moves=frozenset({Tap.DRIVE}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD, Tap.MODES}),
    neighbours=("acoustic_resonance",),
    action="change the volume of the chamber; another reed",
    reference="paper, section III",
)
