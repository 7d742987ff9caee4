"""Light at the carrier frequency in the hologram of every sideband."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="carrier_leak",
    title="carrier leaks into the hologram",
    stage=Stage.OPTICS,
    position=4,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.03,
            "spurs of synthesizers are 40 to 60 dB below the carrier; unshifted "
            "light adds to them; at most: a shutter left open; from a third on, "
            "pictures show it at once",
            positive=True,
            most=0.3,
        ),
    ),
    change=additive("optics.interference", leak="fraction"),
    reference="data sheets of direct digital synthesizers",
)
