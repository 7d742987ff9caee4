"""A laser that hops to another mode: fringe contrast drops at once, brightness does not."""

from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="laser_mode_hop",
    title="laser hops to another mode",
    stage=Stage.OPTICS,
    position=1,
    parameters=(
        Parameter("contrast_loss", "", 0.2, "from a little to most of the contrast", positive=True),
        Parameter(
            "time_fraction",
            "",
            0.0,
            "at any time of the campaign",
            grid=tuple(0.05 * k for k in range(1, 20)),
        ),
    ),
    change=changed("optics", put={"hop": "contrast_loss", "hop_time_fraction": "time_fraction"}),
    reference="multimode diode lasers",
    unique=True,
)
