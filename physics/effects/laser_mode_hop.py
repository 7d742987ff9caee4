"""A laser that hops to another mode: fringe contrast drops at once, brightness does not."""

import numpy as np

from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage

# Half a minute to eight hours. Chosen: for bench files that do not say when; a diagnosis tries the
# times of its own campaign.
_AFTER_H = tuple(float(h) for h in np.geomspace(0.5 / 60, 8.0, 32))

EFFECT = Effect(
    id="laser_mode_hop",
    title="laser hops to another mode",
    stage=Stage.OPTICS,
    position=1,
    parameters=(
        Parameter(
            "contrast_loss",
            "",
            0.2,
            "from a little to most of the contrast; at most: more leaves no fringes",
            positive=True,
            most=0.9,
        ),
        Parameter(
            "after",
            "h",
            0.0,
            "at any time, from a sweep of a minute to a day's work",
            grid=_AFTER_H,
            moment=True,
        ),
    ),
    change=changed("optics.interference", put={"hop": "contrast_loss", "hop_after_h": "after"}),
    reference="multimode diode lasers",
    unique=True,
)
