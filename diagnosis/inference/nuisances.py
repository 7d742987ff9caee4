"""Nuisance parameters: what differs between benches and reeds although the model is right."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from physics.effects.changes import changed
from physics.mechanics import Layer
from physics.parameters.tree import (
    BenchParameters,
    FitBias,
    more,
    with_alteration,
    with_cane,
    with_part,
)


@dataclass(frozen=True)
class Nuisance:
    """One nuisance parameter; 0 is the nominal model.

    Attributes
    ----------
    name, unit : str
    spread : float
        Standard deviation of its prior.
    change : callable
        ``change(parameters, value)``: the parameters with it.
    source : str
    of_fits : bool
        Whether it is a fit bias.
    family : str
        Nuisances of one family have standard deviations that are all larger, or smaller, than
        usual by one factor; empty if the standard deviation is known.
    """

    name: str
    unit: str
    spread: float
    change: Callable[[BenchParameters, float], BenchParameters]
    source: str
    of_fits: bool = False
    family: str = ""


# Standard deviation of the log of a factor on a family. Chosen: benches and reeds have between a
# quarter and four times the usual disorder in 19 of 20 cases.
FAMILY_FREEDOM: Final = 0.7


def _cane(name: str, spread: float, source: str, family: str) -> Nuisance:
    return Nuisance(
        name,
        "",
        spread,
        lambda parameters, value: with_cane(parameters, **{name: value}),
        source,
        family=family,
    )


def _layer(along: int, across: int) -> Nuisance:
    kind = Layer(along, across)
    spread = _PROFILE_M / (1 + along) ** 0.5
    return Nuisance(
        f"layer {along}{across}",
        "m",
        spread,
        lambda parameters, value: with_alteration(parameters, kind, value),
        "profiles of reeds of one brand, by micrometer: some micrometres",
        family="thickness",
    )


def _resonance(name: str, field: str, spread: float, source: str) -> Nuisance:
    """Return the logarithm of the factor on a property of the known acoustic resonance."""
    change = changed("drive.acoustic_resonance", scale={field: name})
    return Nuisance(
        name,
        "",
        spread,
        lambda parameters, value: change(parameters, {name: value}),
        source,
        family="known resonance",
    )


def _bypass(name: str, field: str) -> Nuisance:
    return Nuisance(
        name,
        "",
        0.04,
        lambda parameters, value: more(parameters, "drive", **{field: value}),
        "sound that goes around: some per cent",
        family="bypass",
    )


_PROFILE_M: Final = 5e-6
_POPULATION = "population of reeds of one brand (paper, Table 5)"
# Of the exponents with which moduli grow from 2 to 16 kHz, over canes with components from N(0, 1).
_VISCOELASTIC = "population of reeds of one brand (paper, Table 5, hypothesis H4)"
_TAKEN_APART = "the same device, taken apart and put together"
_HANDBOOK = "spread of small clear specimens of one wood"
NUISANCES: Final[tuple[Nuisance, ...]] = (
    _cane("E_L", 0.12, _POPULATION, "strength of cane"),
    _cane("G_LT", 0.12, _POPULATION, "strength of cane"),
    _cane("E_T", 0.1, _HANDBOOK, "constants of cane"),
    _cane("E_R", 0.1, _HANDBOOK, "constants of cane"),
    _cane("G_LR", 0.12, _HANDBOOK, "constants of cane"),
    _cane("G_TR", 0.12, _HANDBOOK, "constants of cane"),
    _cane("density", 0.03, _HANDBOOK, "density"),
    _cane("growth_E_L", 0.04, _VISCOELASTIC, "growth of moduli"),
    _cane("growth_G_LT", 0.09, _VISCOELASTIC, "growth of moduli"),
    Nuisance(
        "loss",
        "",
        0.2,
        lambda parameters, value: with_part(
            parameters, "reed", loss_factor=parameters.reed.loss_factor * math.exp(value)
        ),
        "loss factors of cane, 0.02 to 0.05",
        family="loss",
    ),
    Nuisance(
        "loss growth",
        "",
        0.05,
        lambda parameters, value: more(parameters, "reed", loss_growth=value),
        "decision 0004",
        family="loss",
    ),
    Nuisance(
        "mesh",
        "",
        0.3,
        lambda parameters, value: more(parameters, "reed", coarse_share=value),
        "decision 0009: what finer elements change",
    ),
    _resonance("resonance strength", "strength", 0.07, _TAKEN_APART),
    _resonance("resonance quality", "quality", 0.07, _TAKEN_APART),
    _resonance("resonance frequency", "frequency_hz", 0.004, "speed of sound within 2 degrees"),
    _bypass("bypass, real", "bypass_real"),
    _bypass("bypass, imaginary", "bypass_imaginary"),
    *(_layer(along, across) for along in range(4) for across in range(4) if along + across < 5),
)

# Fit bias of a mode: cents, and logarithm of the loss.
_EXCHANGED_CENTS, _EXCHANGED_LOSS = 12.0, 0.12
_METHOD = "fits of simulated sweeps: a few of a hundred modes are 10 to 40 cents off"


def of_fits(modes: Sequence[str]) -> tuple[Nuisance, ...]:
    """Return the fit biases of modes: frequency and loss that a fit has mistaken for the drive."""
    of_each = (
        ("cents", "cents", _EXCHANGED_CENTS, (1.0, 0.0)),
        ("loss", "", _EXCHANGED_LOSS, (0.0, 1.0)),
    )
    return tuple(
        Nuisance(f"{mode}, {what}", unit, spread, _exchange(mode, share), _METHOD, of_fits=True)
        for mode in modes
        for what, unit, spread, share in of_each
    )


def _exchange(
    mode: str, share: tuple[float, float]
) -> Callable[[BenchParameters, float], BenchParameters]:
    def change(parameters: BenchParameters, value: float) -> BenchParameters:
        more = (mode, share[0] * value, share[1] * value)
        return replace(parameters, fit_bias=FitBias((*parameters.fit_bias.exchanged, more)))

    return change
