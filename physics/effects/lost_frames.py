"""Frames that are lost, or come twice."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "clocks", lost_fraction=values["fraction"])


EFFECT = Effect(
    id="lost_frames",
    title="frames lost",
    stage=Stage.TIMING,
    parameters=(
        Parameter(
            "fraction", "", 0.03, "of the acquisitions, on a bus that others use", positive=True
        ),
    ),
    change=_change,
    moves=frozenset({Tap.LOG}),
    keeps=frozenset({Tap.SENSOR, Tap.MODES, Tap.FIELD}),
    neighbours=(),
    action="look at the camera's frame counter",
    reference="the frame numbers of every acquisition",
)
