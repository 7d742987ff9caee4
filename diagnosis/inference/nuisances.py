"""Nuisance parameters: what differs between benches and reeds although the model is right."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from holography.arrays import Array
from physics.alterations import BED_SHEAR_SPREAD, Layer, RandomLayer, YieldingClamp
from physics.effects.changes import changed
from physics.parameters.disorder import BY_NAME
from physics.parameters.drive import Drive
from physics.parameters.tree import (
    BenchParameters,
    more,
    with_alteration,
    with_cane,
    with_part,
)
from physics.reed.cane.viscoelastic import (
    Series,
    ViscoelasticCane,
    Zener,
    h4_matrix,
    require_physical,
)
from physics.sized_effect import SizedEffect


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
    family : str
        Nuisances of one family have standard deviations that are all larger, or smaller, than
        usual by one factor; empty if the standard deviation is known.
    """

    name: str
    unit: str
    spread: float
    change: Callable[[BenchParameters, float], BenchParameters]
    source: str
    family: str = ""


def uncertain_sizes(known: SizedEffect) -> tuple[Nuisance, ...]:
    """Return a nuisance for each size of a known effect that has a standard error.

    They change nothing by themselves: `InferenceProblem.parameters` applies the effect with all
    its sizes.
    """
    return tuple(
        Nuisance(
            f"{known.effect.id} {size.name}",
            size.unit,
            known.errors[size.name],
            lambda parameters, _value: parameters,
            "standard error in the bench file",
        )
        for size in known.uncertain
    )


def _cane(name: str, spread: float, source: str, family: str) -> Nuisance:
    return Nuisance(
        name,
        "",
        spread,
        lambda parameters, value: with_cane(parameters, **{name: value}),
        source,
        family,
    )


def _constant(name: str) -> Nuisance:
    """Return the logarithm of the factor on a constant of the cane that is not fitted."""
    kind = BY_NAME[name]
    family = "density" if name == "density" else "constants of cane"
    return _cane(name, kind.ordinary.deviation, kind.ordinary.source, family)


def _disorder(name: str, family: str) -> Nuisance:
    """Return a kind of disorder whose ordinary amounts are positive or negative."""
    kind = BY_NAME[name]
    return Nuisance(
        name,
        kind.ordinary.unit,
        kind.ordinary.root_mean_square,
        lambda parameters, value: kind.change(parameters, value, 0) if value else parameters,
        kind.ordinary.source,
        family,
    )


def _layer(along: int, across: int, spread_m: float) -> Nuisance:
    kind = Layer(along, across)
    return Nuisance(
        f"layer {along}{across}",
        "m",
        spread_m,
        lambda parameters, value: with_alteration(parameters, kind, value),
        BY_NAME["thickness_map"].ordinary.source,
        "thickness",
    )


def layers(*, odd: bool, fine: bool = False) -> list[Nuisance]:
    """Return the Legendre products of a random map of thickness that have most of its variance.

    The correlation of the map is a product of one along and one across the vamp, and so are the
    variances of its coefficients. The thickness everywhere is that of the drawing as well.

    Parameters
    ----------
    odd : bool
        Whether products are odd across the reed. Those move no mode to first order: all they do is
        mix shapes.
    fine : bool
        Whether the finer products are wanted, which have most of the variance of the others.
    """
    kind = BY_NAME["thickness_map"].ordinary
    along = _variances(0.5 * _VAMP_M / RandomLayer.correlation_x_m)
    across = _variances(_HALF_WIDTH_M / RandomLayer.correlation_y_m)
    powers = np.multiply.outer(*(v / (2 * np.arange(len(v)) + 1) for v in (along, across)))
    found = []
    wanted = powers < _LEAST_POWER if fine else powers >= _LEAST_POWER
    for a, b in np.argwhere(wanted & (powers >= _LEAST_FINE)).tolist():
        spread_m = kind.root_mean_square * math.sqrt(along[a] * across[b])
        if a == b == 0:
            spread_m = math.hypot(spread_m, _OFFSET_M)
        if a == 0 and b == 1:
            spread_m = math.hypot(spread_m, BY_NAME["thickness_slope"].ordinary.root_mean_square)
        if b % 2 == odd:
            found.append(_layer(a, b, spread_m))
    return found


def _variances(half: float) -> Array:
    """Return the variance of each Legendre coefficient of a random function of variance 1.

    Its correlation is exp(−Δ²) over an interval of Δ half lengths.
    """
    at, weight = np.polynomial.legendre.leggauss(_POINTS)
    weighted = np.polynomial.legendre.legvander(at, _DEGREE) * weight[:, None]
    correlation = np.exp(-((half * (at[:, None] - at)) ** 2))
    products = np.einsum("ka,kl,la->a", weighted, correlation, weighted)
    variances: Array = (np.arange(_DEGREE + 1) + 0.5) ** 2 * products
    return variances


def _resonance(field: str, spread: float, source: str) -> Nuisance:
    """Return the logarithm of the factor on a property of the first listed resonance."""
    name = f"resonance {_WORDS[field]}"
    change = changed("drive.acoustic_resonance", scale={field: name})
    return Nuisance(
        name,
        "",
        spread,
        lambda parameters, value: change(parameters, {name: value}),
        source,
        "known resonance",
    )


def of_further_resonances(drive: Drive) -> tuple[Nuisance, ...]:
    """Return the nuisances of all acoustic resonances that a bench lists, but for the first."""
    return tuple(
        _further(number, field, spread, source)
        for number in range(len(drive.further_resonances))
        for field, (spread, source) in _RESONANCE.items()
    )


def _further(number: int, field: str, spread: float, source: str) -> Nuisance:
    def change(parameters: BenchParameters, value: float) -> BenchParameters:
        lines = list(parameters.drive.further_resonances)
        grown = getattr(lines[number], field) * math.exp(value)
        lines[number] = replace(lines[number], **{field: grown})
        return with_part(parameters, "drive", further_resonances=tuple(lines))

    name = f"resonance {number + 2} {_WORDS[field]}"
    return Nuisance(name, "", spread, change, source, "known resonance")


def _bypass(name: str, field: str) -> Nuisance:
    return Nuisance(
        name,
        "",
        0.04,
        lambda parameters, value: more(parameters, "drive", **{field: value}),
        "sound that goes around: some per cent",
        "bypass",
    )


def _component(number: int) -> Nuisance:
    """Return a component of hypothesis H4, in which the moduli are linear."""
    E1, E2, E3, G1, G2, G3 = h4_matrix(Series.A)[:, number].tolist()

    def change(parameters: BenchParameters, value: float) -> BenchParameters:
        old = parameters.reed.cane
        young = _more(old.young_L, value, (E1, E2, E3))
        cane = ViscoelasticCane(young, _more(old.shear_LT, value, (G1, G2, G3)))
        require_physical(cane)
        return with_part(parameters, "reed", cane=cane)

    return Nuisance(f"component e{number}", "", 1.0, change, _H4, "strength of cane")


def _more(zener: Zener, value: float, amounts: tuple[float, float, float]) -> Zener:
    return Zener(
        *(
            old + value * amount
            for old, amount in zip(
                (zener.spring_mpa, zener.arm_spring_mpa, zener.arm_dashpot_mpa_s),
                amounts,
                strict=True,
            )
        )
    )


def _clamped(parameters: BenchParameters, value: float) -> BenchParameters:
    grown_m_pa = USUAL_COMPLIANCE_M_PA * math.expm1(value)
    return with_alteration(parameters, YieldingClamp(), grown_m_pa)


def _off_centre(axis: int) -> Nuisance:
    """Return how far the local oscillator is out of the middle of the sensor, along one axis."""

    def change(parameters: BenchParameters, value_m: float) -> BenchParameters:
        shift_m = list(parameters.optics.illumination.local_oscillator_shift_m)
        shift_m[axis] += value_m
        return with_part(
            parameters, "optics.illumination", local_oscillator_shift_m=(shift_m[0], shift_m[1])
        )

    name = f"local oscillator, {('down', 'right')[axis]}"
    return Nuisance(name, "m", 1e-3, change, _BY_EYE, "place of the local oscillator")


def _widened(parameters: BenchParameters, value: float) -> BenchParameters:
    waist_m = parameters.optics.illumination.local_oscillator_waist_m * math.exp(value)
    return with_part(parameters, "optics.illumination", local_oscillator_waist_m=waist_m)


# Vamp of a clarinet reed (paper, Fig. 2), and Gauss points and degree of its Legendre products.
_VAMP_M, _HALF_WIDTH_M, _POINTS, _DEGREE = 35e-3, 6.4e-3, 60, 9
# Least fraction of a map's variance that a product has: of those that are nuisances of a reed (94 %
# of the variance together), and of the fine ones (99 % with them). Chosen: ten to twenty modes do
# not determine more than 23 products.
_LEAST_POWER, _LEAST_FINE = 0.007, 0.001
# Standard deviation of the thickness everywhere: the drawing is right within 10 µm (paper, section
# III.A), equally distributed.
_OFFSET_M = 10e-6 / math.sqrt(3)
# Compliance of the clamp of an ordinary bench: half of 0.5 mm of hard plastic (decision 0050).
USUAL_COMPLIANCE_M_PA: Final = 1e-13
_BY_EYE = (
    "beams are put on the middle of the sensor by eye, within a millimetre of 10 to 30 that they "
    "are wide: chosen, no literature says how they are centred"
)
_H4 = "population of reeds of one brand (paper, Table 5, hypothesis H4)"
_OTHER_BRAND = "chosen: means of brands differ by less than their reeds do"
_GROWTH = "moduli may grow otherwise than by H4 (decision 0049)"
_LISTED = (
    "a bench file lists the frequency only; cavities have qualities of 3 to 100, and amplify by "
    "3 to 12 dB"
)
_RESONANCE: Final = {
    "strength": (0.9, _LISTED),
    "quality": (0.9, _LISTED),
    "frequency_hz": (0.004, "speed of sound within 2 degrees"),
}
_WORDS: Final = {"strength": "strength", "quality": "quality", "frequency_hz": "frequency"}
NUISANCES: Final[tuple[Nuisance, ...]] = (
    *map(_component, (1, 2, 3)),
    _cane("E_L", 0.06, _OTHER_BRAND, "strength of cane"),
    _cane("G_LT", 0.06, _OTHER_BRAND, "strength of cane"),
    *map(_constant, ("E_T", "E_R", "G_LR", "G_TR", "nu_LT", "density")),
    _cane("growth_E_L", 0.05, _GROWTH, "growth of moduli"),
    _cane("growth_G_LT", 0.08, _GROWTH, "growth of moduli"),
    Nuisance(
        "loss",
        "",
        0.25,
        lambda parameters, value: with_part(
            parameters, "reed", loss_factor=parameters.reed.loss_factor * math.exp(value)
        ),
        "loss factors of cane, 0.02 to 0.05",
        "loss",
    ),
    Nuisance(
        "loss growth",
        "",
        0.05,
        lambda parameters, value: more(parameters, "reed", loss_growth=value),
        "decision 0004",
        "loss",
    ),
    _disorder("shear_loss", "loss"),
    Nuisance(
        "clamp",
        "",
        0.7,
        _clamped,
        "hard plastic of 0.1 to 0.5 mm under the strips (decision 0050): within a factor of 4",
    ),
    Nuisance(
        "bed shear",
        "",
        BED_SHEAR_SPREAD,
        lambda parameters, value: more(parameters, "reed", bed_shear_log=value),
        "from dry contacts to thin layers that cannot spread (decision 0096)",
    ),
    _disorder("clamp_shift", "place of the clamp"),
    Nuisance(
        "air",
        "",
        0.29,
        lambda parameters, value: with_part(
            parameters, "reed", air_share=parameters.reed.air_share * (1 + value)
        ),
        "between a free plate and a wide wall, which doubles it, equally distributed "
        "(decision 0026)",
    ),
    *(_resonance(field, *prior) for field, prior in _RESONANCE.items()),
    *(_off_centre(axis) for axis in (0, 1)),
    Nuisance(
        "width of the local oscillator",
        "",
        0.5,
        _widened,
        "that of the lens that happened to be there: chosen",
    ),
    _bypass("bypass, real", "bypass_real"),
    _bypass("bypass, imaginary", "bypass_imaginary"),
    *layers(odd=False),
)
