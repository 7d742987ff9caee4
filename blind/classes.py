"""What campaigns as these cannot tell: fixed before any sealed case is answered.

By what effects move on five simulated campaigns with nothing wrong, other than the sealed ones
(`python -m studies.reach`, table in ``docs/explanation/detectability.md``).
"""

from typing import Final

# Effects whose signatures have a cosine of 0.8 or more count as one.
CLASSES: Final[tuple[tuple[str, ...], ...]] = (
    ("drying", "temperature_drift"),
    ("phase_step_error", "synthesizer_detuning", "synthesizer_drift"),
    ("thickness_offset", "thickness_wedge"),
)
# Effects that stand out by five deviations at no size, or at none that is drawn.
UNDETECTABLE: Final[tuple[str, ...]] = (
    "amplifier_rolloff",
    "crack",
    "defocus",
    "density",
    "viscoelastic_stiffening",
    "thickness_tilt",
    "transverse_shear",
)
