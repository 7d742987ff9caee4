"""The whole tree, and small changes of it."""

from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, cast

from physics.alterations import Alteration
from physics.mechanics import Mechanics
from physics.parameters.chamber import Chamber
from physics.parameters.clocks import Clocks
from physics.parameters.drive import Drive
from physics.parameters.environment import Environment
from physics.parameters.optics import Optics
from physics.parameters.sensor import Sensor

T = TypeVar("T")


@dataclass(frozen=True)
class BenchParameters:
    """All parameters of a bench with a reed; the defaults are those of the paper's bench.

    Attributes
    ----------
    drive : Drive
    clocks : Clocks
    chamber : Chamber
    reed : Mechanics
    optics : Optics
    sensor : Sensor
    environment : Environment
    """

    drive: Drive = field(default_factory=Drive)
    clocks: Clocks = Clocks()
    chamber: Chamber = Chamber()
    reed: Mechanics = field(default_factory=Mechanics)
    optics: Optics = Optics()
    sensor: Sensor = field(default_factory=Sensor)
    environment: Environment = Environment()


def with_part(tree: T, path: str, **changes: Any) -> T:
    """Return a tree with other values of some fields of a part.

    Parameters
    ----------
    tree : dataclass
    path : str
        Path of the part, such as ``optics.illumination``.
    **changes
        New values, by the names of fields of the part.

    Examples
    --------
    >>> warm = with_part(BenchParameters(), "environment", warming_c_h=2.0)
    >>> warm.environment.warming_c_h
    2.0
    """
    first, _, rest = path.partition(".")
    part = getattr(tree, first)
    changed = with_part(part, rest, **changes) if rest else replace(part, **changes)
    # A part is a field of a frozen dataclass, whatever the tree is.
    whole: T = replace(cast(Any, tree), **{first: changed})
    return whole


def near_to(parameters: BenchParameters, known: BenchParameters) -> BenchParameters:
    """Return the same parameters, with modes that are sought from those of a known reed."""
    return replace(parameters, reed=replace(parameters.reed, near=replace(known.reed, near=None)))


def part_at(tree: Any, path: str) -> Any:
    """Return the part of a tree at a path, such as ``optics.illumination``."""
    for name in path.split("."):
        tree = getattr(tree, name)
    return tree


def more(parameters: BenchParameters, path: str, **amounts: float) -> BenchParameters:
    """Return a copy of the parameters with amounts added to some fields of a part.

    Parameters
    ----------
    parameters : BenchParameters
    path : str
        See `with_part`.
    **amounts : float
        Amounts to add, by the names of fields of that part.
    """
    if not any(amounts.values()):
        return parameters
    part = part_at(parameters, path)
    changes = {name: getattr(part, name) + by for name, by in amounts.items()}
    return with_part(parameters, path, **changes)


def with_cane(parameters: BenchParameters, **amounts: float) -> BenchParameters:
    """Return a copy of the parameters with amounts added to fields of the reed's `CaneShift`."""
    return more(parameters, "reed.shift", **amounts)


def with_alteration(
    parameters: BenchParameters, kind: Alteration, amount: float
) -> BenchParameters:
    """Return a copy of the parameters with one more alteration of the reed."""
    if not amount:
        return parameters
    altered = (*parameters.reed.alterations, (kind, amount))
    return with_part(parameters, "reed", alterations=altered)
