"""Declare the number of a field: its unit, its plausible range, and the source of both."""

import math
from collections.abc import Iterator
from dataclasses import Field, dataclass, field, fields, is_dataclass
from typing import Any

_KEY = "quantity"


@dataclass(frozen=True)
class Quantity:
    """What is known of a number before anything is measured.

    Attributes
    ----------
    unit : str
        Empty for a plain number.
    low, high : float
        Plausible range.
    source : str
        Source of the nominal value and of the range.
    """

    unit: str
    low: float
    high: float
    source: str

    @property
    def deviation(self) -> float:
        """Standard deviation of a number that is equally distributed in the range."""
        return (self.high - self.low) / math.sqrt(12)

    @property
    def root_mean_square(self) -> float:
        """Root of the mean square of a number that is equally distributed in the range."""
        return math.sqrt((self.low**2 + self.low * self.high + self.high**2) / 3)


def quantity(nominal: float, unit: str, low: float, high: float, source: str) -> Any:
    """Return the field of a frozen dataclass that holds a number.

    Parameters
    ----------
    nominal : float
        Default of the field.
    unit, low, high, source
        See `Quantity`.

    Raises
    ------
    ValueError
        If the nominal value lies outside the range, or no source is given.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Chamber:
    ...     length_m: float = quantity(33e-3, "m", 20e-3, 60e-3, "a mouthpiece, by ruler")
    >>> Chamber().length_m
    0.033
    """
    if not (low <= nominal <= high and source):
        raise ValueError(
            f"{nominal} {unit} has to lie in its range, {low} to {high}, and to have a source"
        )
    return field(default=nominal, metadata={_KEY: Quantity(unit, low, high, source)})


def bounded(unit: str, low: float, high: float, source: str) -> Any:
    """Return the field of a frozen dataclass that holds a number without a default.

    Parameters
    ----------
    unit, low, high, source
        See `Quantity`.
    """
    return field(metadata={_KEY: Quantity(unit, low, high, source)})


def quantity_of(declared: "Field[Any]") -> Quantity:
    """Return what a field of a dataclass declares of its number.

    Parameters
    ----------
    declared : dataclasses.Field

    Raises
    ------
    KeyError
        If it declares nothing.
    """
    known: Quantity = declared.metadata[_KEY]
    return known


@dataclass(frozen=True)
class Leaf:
    """One number of a parameter tree.

    Attributes
    ----------
    path : str
        Names of the fields that lead to it, with dots between them.
    value : float
    quantity : Quantity or None
        None if its field does not declare one.
    """

    path: str
    value: float
    quantity: Quantity | None

    @property
    def plausible(self) -> bool:
        """Whether the value lies in its range."""
        known = self.quantity
        return known is None or known.low <= self.value <= known.high


def leaves(tree: Any, path: str = "") -> Iterator[Leaf]:
    """Yield every number of a tree of dataclasses, in the order of the fields.

    Tuples are passed over: they hold coordinates and alterations, which say themselves what they
    are. So are flags and names.
    """
    for each in fields(tree):
        value, own = getattr(tree, each.name), f"{path}.{each.name}" if path else each.name
        if is_dataclass(value):
            yield from leaves(value, own)
        elif isinstance(value, float) and math.isfinite(value):
            yield Leaf(own, value, each.metadata.get(_KEY))
