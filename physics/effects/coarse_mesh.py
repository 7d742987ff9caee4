"""A mesh too coarse, whose elements are stiffer than what they stand for."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, with_reed


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_reed(twin, coarse_share=twin.reed.coarse_share + values["fraction"])


EFFECT = Effect(
    id="coarse_mesh",
    title="mesh too coarse",
    stage=Stage.NUMERICS,
    parameters=(
        Parameter("fraction", "", 1.0, "1 is quadratic tetrahedra of 2 mm, 1 mm at the tip"),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("transverse_modulus",),
    action="halve the mesh",
    reference="paper, section IV: parabolic tetrahedra, 5927 points",
)
