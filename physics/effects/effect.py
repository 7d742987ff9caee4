"""An effect: a physical cause that the nominal model leaves out, as a change of its parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from physics.effects.changes import Change


class Stage(StrEnum):
    """Part of the measuring chain in which an effect acts, from the drive to the computation."""

    DRIVE = "drive"
    TIMING = "timing"
    MECHANICS = "mechanics"
    ACOUSTICS = "acoustics"
    OPTICS = "optics"
    CAMERA = "camera"
    ENVIRONMENT = "environment"
    NUMERICS = "numerics"


@dataclass(frozen=True)
class Parameter:
    """Parameter of an effect: a strength, a second size, or a value from a grid.

    Without strength there is no effect. Second sizes say how an effect acts, such as how fast.

    Attributes
    ----------
    name : str
    unit : str
        Empty for a plain number.
    spread : float
        Usual size; of a second size the standard deviation of its prior. In this unit.
    source : str
        Source of the prior; never the data under test.
    positive : bool
        Whether a size cannot be negative.
    grid : tuple of float
        For a parameter without a size, such as a position or a time: its possible values, equally
        likely. Empty for a size.
    most : float
        Largest strength that a bench can have. Before a campaign, strengths from a hundredth of
        that on are equally likely on a scale of logarithms. 0 for a second size.
    moment : bool
        Whether the grid are times since a campaign began. A campaign has its own: see
        `Effect.at_moments`.
    """

    name: str
    unit: str
    spread: float
    source: str
    positive: bool = False
    grid: tuple[float, ...] = ()
    most: float = 0.0
    moment: bool = False

    @property
    def scale(self) -> float:
        """Unit in which fits count: half of the largest strength, or the spread."""
        return self.most / 2 or self.spread


@dataclass(frozen=True)
class Effect:
    """One effect.

    Attributes
    ----------
    id : str
        Identifier, the name of its file.
    title : str
    stage : Stage
    parameters : tuple of Parameter
    change : callable
        ``change(parameters, values)`` returns the parameters with the effect; with every size 0 it
        returns equal parameters.
    reference : str
    position : int
        Place among the effects of its stage; effects of equal position are sorted by identifier.
    unique : bool
        Whether the model can hold only one effect of this kind.
    after : str
        Identifier of the first of two effects of a kind, without which there is no second one.
        Empty for most.
    """

    id: str
    title: str
    stage: Stage
    parameters: tuple[Parameter, ...]
    change: Change
    reference: str
    position: int = 99
    unique: bool = False
    after: str = ""

    @property
    def sizes(self) -> tuple[Parameter, ...]:
        """Parameters that have a size."""
        return tuple(parameter for parameter in self.parameters if not parameter.grid)

    @property
    def gridded(self) -> tuple[Parameter, ...]:
        """Parameters whose values are from a grid."""
        return tuple(parameter for parameter in self.parameters if parameter.grid)

    def at_moments(self, hours: Sequence[float]) -> "Effect":
        """Return the effect with other times, at which a campaign could show it."""
        if not hours:
            return self
        parameters = tuple(
            replace(each, grid=tuple(hours)) if each.moment else each for each in self.parameters
        )
        return replace(self, parameters=parameters)
