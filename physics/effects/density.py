"""Cane denser or lighter than the reference material, as by moisture."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, with_cane


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_cane(twin, density=values["density"])


EFFECT = Effect(
    id="density",
    title="density of the cane",
    stage=Stage.MECHANICS,
    parameters=(Parameter("density", "", 0.1, "density of cane, 450 to 600 kg/m³"),),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("transverse_modulus",),
    action="weigh the reed",
    reference="paper, section III: density taken as constant",
)
