"""An amplifier that does not reach the end of the band."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "drive", roll_off=values["inverse_corner"])


EFFECT = Effect(
    id="amplifier_rolloff",
    title="amplifier rolls off",
    stage=Stage.DRIVE,
    parameters=(
        Parameter(
            "inverse_corner",
            "",
            0.7,
            "10 kHz over its corner; audio amplifiers reach 20 kHz to 100 kHz",
            positive=True,
        ),
    ),
    change=_change,
    moves=frozenset({Tap.RESPONSE}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD, Tap.MODES}),
    neighbours=("frequency_dependent_damping",),
    action="measure the voltage at the tweeter",
    reference="Butterworth, On the theory of filter amplifiers, 1930",
)
