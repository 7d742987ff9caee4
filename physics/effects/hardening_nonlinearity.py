"""A reed whose stiffness grows with its vibration amplitude."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="hardening_nonlinearity",
    title="stiffness grows with amplitude",
    stage=Stage.MECHANICS,
    position=13,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.002,
            "relative stiffening at a phase amplitude of 10 rad, half a "
            "micrometre; at most: a tip that beats against the rails",
            positive=True,
            most=0.05,
        ),
    ),
    change=additive("environment", hardening="fraction"),
    reference="Duffing, Erzwungene Schwingungen, 1918",
)
