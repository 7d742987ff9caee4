"""What is known of a bench before its diagnosis: its camera, and effects that it surely has."""

import math
from collections.abc import Mapping
from dataclasses import replace

from physics.effects.catalogue import BY_ID
from physics.effects.effect import Effect, Parameter
from physics.sensor import Sensor
from physics.twin import Twin
from protocols.bench import BenchFile
from protocols.errors import ProtocolError
from protocols.units import parse_quantity
from runs.reader import Run

# Units that may be written with prefixes, such as "5 um".
_PREFIXED = ("Hz", "m", "rad")


def bench_of(run: Run) -> BenchFile | None:
    """Bench file that a run carries; None if it carries none that can be read."""
    try:
        return BenchFile.from_text(run.bench_text, "bench of the run")
    except ProtocolError:
        return None


def sensor_of(bench: BenchFile | None, run: Run) -> Sensor:
    """Sensor of a run, nominal in what nothing says of it."""
    transform = run.reconstruction.transform
    sensor = replace(Sensor(), shape=transform.shape, pixel_m=transform.pixel_m)
    sheet = bench.instruments.camera.data_sheet if bench else None
    if sheet is None:
        return sensor
    return replace(sensor, **sheet.model_dump())


def base_twin(bench: BenchFile | None) -> Twin:
    """Return the model with the effects that a bench file lists under ``known:``.

    Raises
    ------
    ProtocolError
        If there is no such effect or size, or a size has another unit.
    """
    twin = Twin()
    for name, sizes in ((bench.known if bench else None) or {}).items():
        effect = BY_ID.get(name)
        if effect is None or bench is None:
            raise ProtocolError(
                f"{bench.source if bench else name}: known.{name} is not a known effect; "
                "`acquire effects` lists them"
            )
        twin = effect.change(twin, _values(bench, effect, sizes))
    return twin


def only_once(bench: BenchFile | None) -> tuple[str, ...]:
    """Return the effects that a bench states and that a model cannot have twice.

    Parameters
    ----------
    bench : BenchFile or None
        Whose effects are all in the catalogue.
    """
    told = (bench.known if bench else None) or {}
    return tuple(name for name in told if BY_ID[name].unique)


def _values(bench: BenchFile, effect: Effect, sizes: Mapping[str, float | str]) -> dict[str, float]:
    """Return all parameters of an effect; those not given are 0, or in the middle of their grid."""
    values = {p.name: p.grid[len(p.grid) // 2] if p.grid else 0.0 for p in effect.parameters}
    by_name = {parameter.name: parameter for parameter in effect.parameters}
    for name, text in sizes.items():
        if name not in by_name:
            raise ProtocolError(
                f"{bench.source}: known.{effect.id}.{name} is no size of it; it has "
                f"{', '.join(by_name)}"
            )
        try:
            values[name] = _value(by_name[name], text)
        except ValueError as error:
            raise ProtocolError(f"{bench.source}: known.{effect.id}.{name}: {error}") from None
    return values


def _value(parameter: Parameter, text: float | str) -> float:
    """Size of a parameter, as it may be."""
    value = _number(parameter, text)
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is no size")
    if parameter.positive and value < 0:
        raise ValueError(f"{text!r} is negative, which this size cannot be")
    if parameter.grid and not min(parameter.grid) <= value <= max(parameter.grid):
        limits = f"{min(parameter.grid):g} to {max(parameter.grid):g} {parameter.unit}".strip()
        raise ValueError(f"{text!r} is outside its range; choose a value from {limits}")
    return value


def _number(parameter: Parameter, text: float | str) -> float:
    if not parameter.unit and isinstance(text, float):
        return text
    if parameter.unit in _PREFIXED:
        return float(parse_quantity(text, parameter.unit))
    number, _, unit = str(text).partition(" ")
    if unit.strip() != parameter.unit:
        remedy = f"write a number and {parameter.unit}" if parameter.unit else "write a number"
        raise ValueError(f"{text!r} is not in its unit; {remedy}")
    return float(number)
