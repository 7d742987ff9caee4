"""The parameter tree of a described bench: what its files say, and the effects that it has."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from physics.effects.catalogue import BY_ID
from physics.effects.effect import Parameter
from physics.mechanics import Mechanics
from physics.parameters.chamber import Filling, chamber_of
from physics.parameters.drive import AcousticResonance, Drive
from physics.parameters.optics import Layout, Optics
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.geometry import ReedGeometry
from physics.sized_effect import SizedEffect
from protocols.bench import BenchFile, CameraSensor
from protocols.errors import ProtocolError
from protocols.units import parse_quantity, shown_value

Sizes = Mapping[str, float | str]
"""Values of an effect's parameters by name, numbers or texts with their units."""

# Units that may be written with prefixes, such as "5 um".
_PREFIXED = ("Hz", "m", "rad", "s")
_PLUS_MINUS: Final = re.compile(r"±|\+/?-")


def nominal_parameters(
    layout: Layout,
    sensor: Sensor,
    *,
    geometry: ReedGeometry,
    chamber: str,
    series: str,
    resonances_hz: tuple[float, ...] = (),
) -> BenchParameters:
    """Return the parameters of a bench of which nothing is known but what its files say.

    Parameters
    ----------
    layout : Layout
    sensor : Sensor
    geometry : ReedGeometry
        Of the kind of reed.
    chamber : {'asymmetric', 'symmetric'}
    series : str
        Reeds of series B are dried; the cane is the mean of the population of that series.
    resonances_hz : tuple of float
        Acoustic resonances that the bench file lists.
    """
    kind = Series.B if series == Series.B else Series.A
    return BenchParameters(
        drive=_drive(resonances_hz),
        chamber=chamber_of(geometry, Filling(chamber)),
        reed=Mechanics(cane=viscoelastic_cane(Components(), kind)),
        optics=Optics(layout=layout),
        sensor=sensor,
    )


def _drive(resonances_hz: tuple[float, ...]) -> Drive:
    """Return a drive with the acoustic resonances that a bench file lists, and with no other."""
    if not resonances_hz:
        return Drive(acoustic_resonance=AcousticResonance(strength=0.0))
    first, *others = (AcousticResonance(frequency_hz=hz) for hz in resonances_hz)
    return Drive(acoustic_resonance=first, further_resonances=tuple(others))


def sensor_of_camera(camera: CameraSensor) -> Sensor:
    """Return the sensor of a camera, nominal in what its data sheet does not say.

    Without a data sheet, its digital numbers are taken to cover the full well as those of the
    paper's camera do.
    """
    shape, pixel_m, sheet = (camera.height, camera.width), float(camera.pixel_m), camera.data_sheet
    nominal = Sensor(shape=shape, pixel_m=pixel_m, bits=camera.bits)
    if sheet:
        return replace(nominal, **sheet.model_dump())
    finer = 2.0 ** (camera.bits - Sensor().bits)
    return replace(
        nominal, gain_e_dn=nominal.gain_e_dn / finer, offset_dn=nominal.offset_dn * finer
    )


def known_effects(bench: BenchFile | None) -> Mapping[str, Sizes]:
    """Return the effects that a bench file lists under ``known:``."""
    return (bench.known if bench else None) or {}


def with_effects(
    parameters: BenchParameters, effects: Mapping[str, Sizes], source: str
) -> BenchParameters:
    """Return parameters with effects, each of given sizes.

    Parameters
    ----------
    parameters : BenchParameters
    effects : mapping
        Sizes by the identifier of each effect; a standard error changes nothing here.
    source : str
        File and key that they are from, such as ``lab.yaml: known``.

    Raises
    ------
    ProtocolError
        If there is no such effect or size, or a size has another unit.
    """
    for sized in sized_effects(effects, source):
        parameters = sized.change(parameters)
    return parameters


def sized_effects(effects: Mapping[str, Sizes], source: str) -> tuple[SizedEffect, ...]:
    """Return effects with the sizes that a file gives them, and their standard errors.

    Parameters
    ----------
    effects : mapping
        Sizes by the identifier of each effect, such as ``{"air_load": {"fraction": "0.3 ± 0.1"}}``.
    source : str
        File and key that they are from, such as ``lab.yaml: known``.

    Raises
    ------
    ProtocolError
        If there is no such effect or size, or a size has another unit.
    """
    return tuple(_sized(name, sizes, f"{source}.{name}") for name, sizes in effects.items())


def _sized(name: str, sizes: Sizes, source: str) -> SizedEffect:
    """Return one effect; sizes not given are 0, or in the middle of their grid."""
    effect = BY_ID.get(name)
    if effect is None:
        raise ProtocolError(f"{source} is not a known effect; `acquire effects` lists them")
    values = {p.name: p.grid[len(p.grid) // 2] if p.grid else 0.0 for p in effect.parameters}
    errors: dict[str, float] = {}
    by_name = {parameter.name: parameter for parameter in effect.parameters}
    for size, text in sizes.items():
        if size not in by_name:
            raise ProtocolError(f"{source}.{size} is no size of it; it has {', '.join(by_name)}")
        try:
            values[size], error = _value(by_name[size], text)
        except ValueError as wrong:
            raise ProtocolError(f"{source}.{size}: {wrong}") from None
        if error:
            errors[size] = error
    return SizedEffect(effect, values, errors)


def _value(parameter: Parameter, text: float | str) -> tuple[float, float]:
    """Return the size of a parameter, as it may be, and its standard error."""
    value, error = number_with_error_in(parameter.unit, text)
    if not (math.isfinite(value) and math.isfinite(error)):
        raise ValueError(f"{text!r} is no size")
    if parameter.positive and value < 0:
        raise ValueError(f"{text!r} is negative, which this size cannot be")
    if parameter.grid and not min(parameter.grid) <= value <= max(parameter.grid):
        limits = f"{min(parameter.grid):g} to {max(parameter.grid):g} {parameter.unit}".strip()
        raise ValueError(f"{text!r} is outside its range; choose a value from {limits}")
    if parameter.grid and error:
        raise ValueError(f"{text!r} has a standard error, which this parameter cannot have")
    return value, error


def number_with_error_in(unit: str, text: object) -> tuple[float, float]:
    """Return a number that a file gives with its unit, and its standard error; 0 if it has none.

    Parameters
    ----------
    unit : str
        Empty for a plain number.
    text : object
        A plain number, or a text such as ``5 um`` or ``5 ± 1 um``; ``+-`` is read as ``±``.

    Raises
    ------
    ValueError
        If it has another unit, is no number, or the error is not positive; the message says what
        to write.
    """
    if not isinstance(text, str) or not (signs := _PLUS_MINUS.findall(text)):
        return number_in(unit, text), 0.0
    value, _, spread = text.partition(signs[0])
    written = spread.strip().partition(" ")[2]
    error = number_in(unit, spread.strip())
    if len(signs) > 1 or error <= 0:
        raise ValueError(
            f"{shown_value(text)} is no number with a standard error; write for example "
            f"'{f'5 ± 1 {unit}'.strip()}'"
        )
    return number_in(unit, f"{value.strip()} {written}".strip()), error


def number_in(unit: str, text: object) -> float:
    """Return a number that a file gives with its unit.

    Parameters
    ----------
    unit : str
        Empty for a plain number.
    text : object
        A plain number, or a text such as ``5 um``.

    Raises
    ------
    ValueError
        If it has another unit or is no number; the message says what to write.
    """
    if not unit and isinstance(text, float | int) and not isinstance(text, bool):
        return float(text)
    if unit in _PREFIXED:
        return float(parse_quantity(text, unit))
    remedy = f"write a number and {unit}" if unit else "write a number"
    number, _, written = str(text).partition(" ")
    if written.strip() != unit:
        raise ValueError(f"{shown_value(text)} is not in its unit; {remedy}")
    try:
        return float(number)
    except ValueError:
        raise ValueError(f"{shown_value(text)} is no number; {remedy}") from None
