"""The known acoustic resonance of the excitation device, stronger than measured before."""

from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="acoustic_resonance",
    title="known acoustic resonance is stronger",
    stage=Stage.ACOUSTICS,
    position=1,
    parameters=(
        Parameter(
            "excess",
            "",
            1.0,
            "chambers are filled by hand: from no resonance to several times the "
            "usual strength; at most: an empty chamber rings with a quality of "
            "some 100",
            positive=True,
            most=5.0,
        ),
    ),
    change=changed("drive.acoustic_resonance", grow={"strength": "excess"}),
    reference="paper, section III: picture 78 of both series",
)
