"""Something that sticks to the last 2 mm of the tip: moisture, wax."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.mechanics import TipMass
from physics.twin import Twin, with_alteration


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_alteration(twin, TipMass(), values["mass"])


EFFECT = Effect(
    id="tip_mass",
    title="mass on the tip",
    stage=Stage.MECHANICS,
    parameters=(Parameter("mass", "kg", 0.5e-6, "a drop of 1 mm has 0.5 mg", positive=True),),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("air_load", "thickness_wedge"),
    action="weigh the reed, or wipe its tip",
    reference="Rayleigh, Theory of Sound, section 91",
)
