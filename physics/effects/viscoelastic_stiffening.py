"""Cane whose moduli grow with frequency: viscoelastic stiffening beyond what the twin has."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, with_cane


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_cane(twin, growth_E_L=values["E_L"], growth_G_LT=values["G_LT"])


EFFECT = Effect(
    id="viscoelastic_stiffening",
    title="moduli grow with frequency",
    stage=Stage.MECHANICS,
    parameters=(
        Parameter(
            "E_L",
            "",
            0.05,
            "paper, hypothesis H4: E_L grows as f^0.18 from 2 to 16 kHz in series A, f^0.08 in B",
            positive=True,
        ),
        Parameter(
            "G_LT",
            "",
            0.08,
            "paper, hypothesis H4: G_LT grows as f^0.25 from 2 to 16 kHz in series A, f^0.24 in B",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("air_load", "thickness_wedge", "clamp_compliance"),
    action="sweep to higher frequencies, or at low pressure",
    reference="paper, section IV.B",
)
