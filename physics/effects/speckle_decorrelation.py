"""Fringes that lose contrast where the reed moves most."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "optics", decorrelation_per_rad2=values["contrast_loss"])


EFFECT = Effect(
    id="speckle_decorrelation",
    title="fringes lose contrast with amplitude",
    stage=Stage.OPTICS,
    parameters=(
        Parameter(
            "contrast_loss",
            "1/rad2",
            0.001,
            "speckle that changes as the surface tilts",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MAPS}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.MODES}),
    neighbours=("sideband_crosstalk",),
    action="the same at half the amplitude",
    reference="Yamaguchi, Optica Acta 28 (1981): decorrelation by tilt",
)
