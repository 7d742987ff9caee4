"""A bench that shakes: the phase between the beams is another one in each frame."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "optics", jitter_rad=values["jitter"])


EFFECT = Effect(
    id="bench_vibration",
    title="bench vibrates",
    stage=Stage.ENVIRONMENT,
    parameters=(
        Parameter(
            "jitter", "rad", 0.15, "a tenth of a wavelength of path is 0.6 rad", positive=True
        ),
    ),
    change=_change,
    moves=frozenset({Tap.HOLOGRAM}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.MODES}),
    neighbours=("phase_step_error",),
    action="look at order 0 with all machines off",
    reference="interferometry without an isolated table",
)
