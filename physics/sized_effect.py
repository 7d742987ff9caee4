"""An effect that a bench is known to have, with sizes that are exact or have standard errors."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from physics.effects.effect import Effect, Parameter
from physics.parameters.tree import BenchParameters


@dataclass(frozen=True)
class SizedEffect:
    """An effect of known sizes.

    Attributes
    ----------
    effect : Effect
    values : mapping of str to float
        Value of every parameter of the effect, in its unit.
    errors : mapping of str to float
        Standard errors of those sizes that are not exact.
    """

    effect: Effect
    values: Mapping[str, float]
    errors: Mapping[str, float] = field(default_factory=dict)

    @property
    def uncertain(self) -> tuple[Parameter, ...]:
        """Sizes that have a standard error, in the order of the effect's parameters."""
        return tuple(size for size in self.effect.sizes if size.name in self.errors)

    def change(
        self, parameters: BenchParameters, deviations: tuple[float, ...] = ()
    ) -> BenchParameters:
        """Return parameters with this effect.

        Parameters
        ----------
        parameters : BenchParameters
        deviations : tuple of float, optional
            How far each uncertain size is from its value, in units of its standard error; by
            default 0. A size that cannot be negative is 0 where it would be.
        """
        values = dict(self.values)
        if deviations:
            for size, deviation in zip(self.uncertain, deviations, strict=True):
                value = values[size.name] + self.errors[size.name] * deviation
                values[size.name] = max(value, 0.0) if size.positive else value
        return self.effect.change(parameters, values)
