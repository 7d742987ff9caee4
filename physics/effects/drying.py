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
            "a moistened reed loses most of its water in an hour; at most: from wet to dry",
            positive=True,
            most=1.0,
        ),
        Parameter(
            "log_time",
            "",
            0.5,
            "diffusion through half a millimetre of cane takes a quarter of an hour to an hour",
        ),
        Parameter("E_L", "", 0.1, "decision 0023: half of what the paper and wood differ by"),
        Parameter("G_LT", "", 0.05, "decision 0023: the paper and wood nearly agree"),
        Parameter(
            "as_wood", "", 0.5, "decision 0098: halfway between series B and wood is one deviation"
        ),
        Parameter("others", "", 0.1, "decision 0098: those of wood change, by H4 none do"),
        Parameter("loss", "", 0.2, "decision 0023: wood loses less when dry, cane may lose more"),
    ),
    change=changed(
        "environment",
        add={
            "drying": "fraction",
            "dry_E_L": "E_L",
            "dry_G_LT": "G_LT",
            "dry_as_wood": "as_wood",
            "dry_others": "others",
            "dry_loss": "loss",
        },
        scale={"drying_s": "log_time"},
    ),
    reference="paper, series A and B; Obataya and Norimoto, Mokuzai Gakkaishi 41, 289 (1995)",
)
