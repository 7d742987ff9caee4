"""Changes of the parameter tree, in which most effects are declared."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from physics.alterations import Alteration
from physics.parameters.tree import BenchParameters, part_at, with_alteration, with_part

Change = Callable[[BenchParameters, Mapping[str, float]], BenchParameters]
"""``change(parameters, values)`` returns the parameters with an effect of sizes `values`."""

Names = tuple[tuple[str, str | tuple[str, ...]], ...]


@dataclass(frozen=True)
class FieldChange:
    """Change of the fields of one part of the parameter tree.

    Attributes
    ----------
    part : str
        Path of the part, such as ``optics.layout``.
    added, grown, scaled, put : tuple of (field, name)
        Fields and the names of the sizes that are added to them, by which they grow in relation to
        themselves, whose exponential they are multiplied by, and that they are set to.
    """

    part: str
    added: Names = ()
    grown: Names = ()
    scaled: Names = ()
    put: Names = ()

    def __call__(self, parameters: BenchParameters, values: Mapping[str, float]) -> BenchParameters:
        """Return the changed parameters; `parameters` itself if the effect has no strength."""
        if not any(values[name] for name in self._strengths):
            return parameters
        part = part_at(parameters, self.part)
        return with_part(parameters, self.part, **self._changed(part, values))

    @property
    def _strengths(self) -> tuple[str, ...]:
        """Sizes without which nothing changes: those that scale other fields do not count."""
        for fields in ((*self.added, *self.grown), self.put[:1], self.scaled):
            if fields:
                return tuple(name for _, names in fields for name in _as_tuple(names))
        return ()

    def _changed(self, part: Any, values: Mapping[str, float]) -> dict[str, Any]:
        fields: dict[str, Any] = {}
        for field, names in self.added:
            before = getattr(part, field)
            fields[field] = (
                before + values[names]
                if isinstance(names, str)
                else tuple(old + values[name] for old, name in zip(before, names, strict=True))
            )
        for field, name in self.grown:
            fields[field] = getattr(part, field) * (1 + values[str(name)])
        for field, name in self.scaled:
            fields[field] = getattr(part, field) * float(np.exp(values[str(name)]))
        for field, name in self.put:
            fields[field] = values[str(name)]
        return fields


@dataclass(frozen=True)
class AlterationChange:
    """Alteration of the reed by an amount.

    Attributes
    ----------
    kind : Alteration
    size : str
        Name of the size that is the amount, in the unit of the alteration.
    """

    kind: Alteration
    size: str

    def __call__(self, parameters: BenchParameters, values: Mapping[str, float]) -> BenchParameters:
        """Return the parameters of the altered reed."""
        return with_alteration(parameters, self.kind, values[self.size])


def additive(part: str, **fields: str | tuple[str, ...]) -> FieldChange:
    """Return the change that adds sizes to the fields of a part.

    Parameters
    ----------
    part : str
        See `FieldChange`.
    **fields : str or tuple of str
        For each field the name of the size; for a field that is a tuple, one name for each entry.

    Examples
    --------
    >>> defocus = additive("optics.layout", defocus_m="distance")
    >>> defocus(BenchParameters(), {"distance": 0.05}).optics.layout.defocus_m
    0.05
    """
    return FieldChange(part, added=tuple(fields.items()))


def changed(
    part: str,
    *,
    add: Mapping[str, str] | None = None,
    grow: Mapping[str, str] | None = None,
    scale: Mapping[str, str] | None = None,
    put: Mapping[str, str] | None = None,
) -> FieldChange:
    """Return the change that adds to, multiplies or sets the fields of a part.

    Nothing changes if all sizes in `add` and `grow` are 0; without these, if the first size in
    `put` is 0.

    Parameters
    ----------
    part : str
        See `FieldChange`.
    add, grow, scale, put : mapping of str to str, optional
        For each field the name of the size: added, grown by in relation to itself, its exponential
        multiplied, or set.

    Examples
    --------
    >>> warmer = changed("environment", add={"warming_c_h": "rate"}, scale={"warm_loss": "log"})
    >>> warmer(BenchParameters(), {"rate": 2.0, "log": 0.0}).environment.warming_c_h
    2.0
    """
    each = [tuple((names or {}).items()) for names in (add, grow, scale, put)]
    return FieldChange(part, *each)


def altered(kind: Alteration, size: str) -> AlterationChange:
    """Return the change that alters the reed by a size."""
    return AlterationChange(kind, size)


def _as_tuple(names: str | tuple[str, ...]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names
