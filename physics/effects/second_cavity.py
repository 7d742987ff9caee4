"""A second resonance of the air, that nobody has told of."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from physics.effects.form import Effect, Parameter, Stage, Tap
from physics.twin import Twin

# Lines of Q 30 are no closer than half their width apart.
_HZ = tuple(float(hz) for hz in 2000.0 * 1.018 ** np.arange(117))


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    if not values["strength"]:
        return twin
    drive = replace(
        twin.drive,
        second_line=values["strength"],
        second_hz=values["hz"],
        second_quality=values["quality"],
    )
    return replace(twin, drive=drive)


EFFECT = Effect(
    id="second_cavity",
    title="another line of the air",
    stage=Stage.ACOUSTICS,
    parameters=(
        Parameter("strength", "", 0.2, "like the known line of the device", positive=True),
        Parameter("hz", "Hz", 0.0, "anywhere in the sweep", places=_HZ),
        Parameter(
            "quality", "", 0.0, "small cavities with openings", places=(15.0, 25.0, 40.0, 60.0)
        ),
    ),
    change=_change,
    moves=frozenset({Tap.DRIVE}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD, Tap.MODES}),
    neighbours=("cavity_line",),
    action="change the volume of the chamber; another reed",
    reference="paper, section III",
)
