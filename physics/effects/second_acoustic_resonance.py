"""An acoustic resonance that the bench file does not list."""

import math
from collections.abc import Mapping
from functools import partial

import numpy as np

from physics.effects.effect import Effect, Parameter, Stage
from physics.parameters.drive import AcousticResonance
from physics.parameters.tree import BenchParameters, with_part

# Resonances of Q 30 are resolved if they are at least half their width apart. Between two grid
# frequencies, and between two qualities, the continuous parameters move the resonance.
_RELATIVE_STEP = 0.018
_GRID_HZ = tuple(float(hz) for hz in 2000.0 * (1 + _RELATIVE_STEP) ** np.arange(117))
_GRID_QUALITY, _LOG_QUALITY_SD = (18.0, 42.0), 0.35
# A path of another length, a dome that breaks up or a tube adds pressure of any phase.
_PHASE_STEP_RAD = 0.5 * math.pi
# The third is what a bench file has that names none.
_GRID_PHASE_RAD = tuple(_PHASE_STEP_RAD * turn for turn in (-2, -1, 0, 1))


def with_unlisted(
    field: str, parameters: BenchParameters, values: Mapping[str, float]
) -> BenchParameters:
    """Return a bench with a resonance in a field of its drive; without strength there is none."""
    if not values["strength"]:
        return parameters
    resonance = AcousticResonance(
        frequency_hz=values["hz"] * float(np.exp(values["log_hz"])),
        quality=values["quality"] * float(np.exp(values["log_quality"])),
        strength=values["strength"],
        phase_rad=math.remainder(values["phase"] + values["turn"], 2 * math.pi),
    )
    return with_part(parameters, "drive", **{field: resonance})


EFFECT = Effect(
    id="second_acoustic_resonance",
    title="unlisted acoustic resonance",
    stage=Stage.ACOUSTICS,
    position=2,
    parameters=(
        Parameter(
            "strength",
            "",
            0.2,
            "like the known resonance of the device; at most: ten times the known resonance",
            positive=True,
            most=2.0,
        ),
        Parameter("log_hz", "", _RELATIVE_STEP / math.sqrt(12), "uniform between grid frequencies"),
        Parameter("log_quality", "", _LOG_QUALITY_SD, "small cavities with openings"),
        Parameter(
            "turn", "rad", _PHASE_STEP_RAD / math.sqrt(12), "uniform between phases of the grid"
        ),
        Parameter("hz", "Hz", 0.0, "anywhere in the sweep", grid=_GRID_HZ),
        Parameter("quality", "", 0.0, "small cavities with openings", grid=_GRID_QUALITY),
        Parameter("phase", "rad", 0.0, "paths of any length", grid=_GRID_PHASE_RAD),
    ),
    change=partial(with_unlisted, "second_resonance"),
    reference="paper, section III",
    unique=True,
)
