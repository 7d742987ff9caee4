"""A tweeter whose gain falls as its coil moves farther."""

from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="tweeter_compression",
    title="tweeter compresses at high level",
    stage=Stage.DRIVE,
    position=0,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.3,
            "a dome tweeter near its rated power loses 1 to 3 dB; at most: 10 dB, "
            "far beyond the rated power",
            positive=True,
            most=0.7,
        ),
        Parameter(
            "log_corner",
            "",
            0.4,
            "the coil moves most where stiffness controls the dome, up to some kHz",
        ),
    ),
    change=changed(
        "drive", add={"compression": "fraction"}, scale={"compression_hz": "log_corner"}
    ),
    reference="paper, section II.B: amplitudes ramped to 16 V",
)
