"""The form of an effect: what the nominal twin leaves out, and how it shows if it is there."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from physics.twin import Twin


class Stage(StrEnum):
    """Where in the chain from the drive to the number an effect acts."""

    DRIVE = "drive"
    TIMING = "timing"
    MECHANICS = "mechanics"
    ACOUSTICS = "acoustics"
    OPTICS = "optics"
    CAMERA = "camera"
    ENVIRONMENT = "environment"
    NUMERICS = "numerics"


class Tap(StrEnum):
    """Where measurement and twin can be compared, from logs to material."""

    LOG = "T0"
    DRIVE = "T1"
    SENSOR = "T2"
    HOLOGRAM = "T3"
    FIELD = "T4"
    MAPS = "T5"
    RESPONSE = "T6"
    MODES = "T7"
    MATERIAL = "T8"


@dataclass(frozen=True)
class Parameter:
    """Size of an effect; 0 is none of it, exactly.

    Attributes
    ----------
    name : str
    unit : str
        Empty for a plain number.
    spread : float
        Standard deviation of the prior, in this unit.
    source : str
        Where the spread is from; never the data under test.
    positive : bool
        Whether only values from 0 up are possible.
    places : tuple of float
        Values that are alike likely, of what has no size, such as a place or a time; the others
        have sizes.
    """

    name: str
    unit: str
    spread: float
    source: str
    positive: bool = False
    places: tuple[float, ...] = ()


@dataclass(frozen=True)
class Effect:
    """One effect that the nominal twin leaves out.

    Attributes
    ----------
    id : str
        Its file's name.
    title : str
    stage : Stage
    parameters : tuple of Parameter
    change : callable
        ``change(twin, values)``: the twin with the effect; with every value 0, the same twin.
    moves, keeps : frozenset of Tap
        Taps that it must move where it is large, and those that it must leave alone.
    neighbours : tuple of str
        Effects that it may be taken for.
    action : str
        What on the bench tells it from them.
    reference : str
    single : bool
        Whether a twin has room for only one of it.
    """

    id: str
    title: str
    stage: Stage
    parameters: tuple[Parameter, ...]
    change: Callable[[Twin, Mapping[str, float]], Twin]
    moves: frozenset[Tap]
    keeps: frozenset[Tap]
    neighbours: tuple[str, ...]
    action: str
    reference: str
    single: bool = False

    @property
    def sizes(self) -> tuple[Parameter, ...]:
        """Parameters that have a size."""
        return tuple(parameter for parameter in self.parameters if not parameter.places)

    @property
    def placed(self) -> tuple[Parameter, ...]:
        """Parameters that are places."""
        return tuple(parameter for parameter in self.parameters if parameter.places)
