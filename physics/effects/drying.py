"""A moist reed that dries during the campaign."""

from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="drying",
    title="reed dries",
    stage=Stage.ENVIRONMENT,
    position=1,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.25,
            "a moistened reed loses most of its water in an hour",
            positive=True,
        ),
        Parameter(
            "log_time",
            "",
            0.5,
            "diffusion through half a millimetre of cane takes a quarter of an hour to an hour",
        ),
    ),
    change=changed("environment", add={"drying": "fraction"}, scale={"drying_s": "log_time"}),
    reference="paper, series A and B; Obataya and Norimoto, Mokuzai Gakkaishi 41, 289 (1995)",
)
