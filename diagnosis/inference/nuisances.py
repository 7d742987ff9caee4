"""Nuisance parameters: what differs between benches and reeds although the model is right."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from physics.mechanics import Layer
from physics.twin import (
    FitBias,
    Twin,
    more,
    with_alteration,
    with_cane,
    with_reed,
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
        ``change(twin, value)``: the twin with it.
    source : str
    of_fits : bool
        Whether it is a fit bias.
    """

    name: str
    unit: str
    spread: float
    change: Callable[[Twin, float], Twin]
    source: str
    of_fits: bool = False


def _cane(name: str, spread: float, source: str) -> Nuisance:
    return Nuisance(name, "", spread, lambda twin, value: with_cane(twin, **{name: value}), source)


def _layer(along: int, across: int) -> Nuisance:
    kind = Layer(along, across)
    spread = _PROFILE_M / (1 + along) ** 0.5
    return Nuisance(
        f"layer {along}{across}",
        "m",
        spread,
        lambda twin, value: with_alteration(twin, kind, value),
        "profiles of reeds of one brand, by micrometer: some micrometres",
    )


def _drive(name: str, spread: float, source: str) -> Nuisance:
    return Nuisance(
        name, "", spread, lambda twin, value: more(twin, "drive", **{name: value}), source
    )


def _bypass(part: int) -> Nuisance:
    def change(twin: Twin, value: float) -> Twin:
        bypass = list(twin.drive.bypass)
        bypass[part] += value
        drive = replace(twin.drive, bypass=(bypass[0], bypass[1]))
        return replace(twin, drive=drive)

    name = ("bypass, real", "bypass, imaginary")[part]
    return Nuisance(name, "", 0.04, change, "sound that goes around: some per cent")


_PROFILE_M: Final = 5e-6
_POPULATION = "population of reeds of one brand (paper, Table 5)"
# Of the exponents with which moduli grow from 2 to 16 kHz, over canes with components from N(0, 1).
_VISCOELASTIC = "population of reeds of one brand (paper, Table 5, hypothesis H4)"
_HANDBOOK = "spread of small clear specimens of one wood"
NUISANCES: Final[tuple[Nuisance, ...]] = (
    _cane("E_L", 0.12, _POPULATION),
    _cane("G_LT", 0.12, _POPULATION),
    _cane("E_T", 0.1, _HANDBOOK),
    _cane("E_R", 0.1, _HANDBOOK),
    _cane("G_LR", 0.12, _HANDBOOK),
    _cane("G_TR", 0.12, _HANDBOOK),
    _cane("density", 0.03, _HANDBOOK),
    _cane("growth_E_L", 0.04, _VISCOELASTIC),
    _cane("growth_G_LT", 0.09, _VISCOELASTIC),
    Nuisance(
        "loss",
        "",
        0.2,
        lambda twin, value: with_reed(twin, loss_factor=twin.reed.loss_factor * 2.718281828**value),
        "loss factors of cane, 0.02 to 0.05",
    ),
    Nuisance(
        "loss growth",
        "",
        0.05,
        lambda twin, value: with_reed(twin, loss_growth=twin.reed.loss_growth + value),
        "decision 0004",
    ),
    Nuisance(
        "mesh",
        "",
        0.3,
        lambda twin, value: with_reed(twin, coarse_share=twin.reed.coarse_share + value),
        "decision 0009: what finer elements change",
    ),
    _drive("resonance_excess", 0.07, "the same device, taken apart and put together"),
    _drive("resonance_quality", 0.07, "the same device, taken apart and put together"),
    _drive("resonance_shift", 0.004, "speed of sound within 2 degrees"),
    _bypass(0),
    _bypass(1),
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


def _exchange(mode: str, share: tuple[float, float]) -> Callable[[Twin, float], Twin]:
    def change(twin: Twin, value: float) -> Twin:
        more = (mode, share[0] * value, share[1] * value)
        return replace(twin, fit_bias=FitBias((*twin.fit_bias.exchanged, more)))

    return change
