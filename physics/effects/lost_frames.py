"""Camera frames that are lost or delivered twice."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="lost_frames",
    title="camera frames are lost or repeated",
    stage=Stage.TIMING,
    position=0,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.03,
            "fraction of the acquisitions, on a bus shared with other devices; at "
            "most: more is no working camera",
            positive=True,
            most=0.5,
        ),
    ),
    change=additive("clocks", lost_fraction="fraction"),
    reference="frame numbers of every acquisition",
)
