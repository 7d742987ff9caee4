"""Cane that warms up or cools down during the campaign."""

from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="temperature_drift",
    title="temperature drifts",
    stage=Stage.ENVIRONMENT,
    position=0,
    parameters=(
        Parameter(
            "rate",
            "degC/h",
            6.0,
            "laboratories, and reeds next to lamps and lasers; at most: a lamp next to the reed",
            most=30.0,
        ),
        Parameter(
            "log_loss",
            "",
            0.5,
            "the loss of wood depends on temperature differently from piece to piece",
        ),
        Parameter("E_L", "1/degC", 1e-3, "decision 0023: Arrhenius law and wood differ by this"),
        Parameter("G_LT", "1/degC", 2e-3, "decision 0023: no measurement of dry cane is known"),
        Parameter(
            "as_wood", "", 0.5, "decision 0098: halfway between Arrhenius and wood is one deviation"
        ),
        Parameter(
            "others",
            "1/degC",
            3e-3,
            "decision 0098: between none and wood of 12 % moisture",
        ),
    ),
    change=changed(
        "environment",
        add={
            "warming_c_h": "rate",
            "warm_E_L": "E_L",
            "warm_G_LT": "G_LT",
            "warm_as_wood": "as_wood",
            "warm_others": "others",
        },
        scale={"warm_loss": "log_loss"},
    ),
    reference="Weidenfeller et al., Mater. Res. 21, e20170795 (2018)",
)
