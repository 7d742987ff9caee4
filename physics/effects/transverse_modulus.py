"""A Young modulus across the grain that is not that of the reference material."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, with_cane


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_cane(twin, E_T=values["E_T"])


EFFECT = Effect(
    id="transverse_modulus",
    title="Young modulus across the grain",
    stage=Stage.MECHANICS,
    parameters=(
        Parameter(
            "E_T",
            "",
            0.3,
            "spread of transverse moduli of cane in the literature that the paper cites",
        ),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("thickness_crown",),
    action="measure a cross-cut strip",
    reference="paper, Table 3: modes T are sensitive to E_T",
)
