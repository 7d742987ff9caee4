"""Changes of the model's parameters, in which most effects are declared."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from physics.mechanics import Alteration
from physics.twin import Twin, with_alteration

Change = Callable[[Twin, Mapping[str, float]], Twin]
"""``change(twin, values)`` returns the parameters with an effect whose sizes are `values`."""

Names = tuple[tuple[str, str | tuple[str, ...]], ...]


@dataclass(frozen=True)
class FieldChange:
    """Change of the fields of one part of the parameter tree.

    Attributes
    ----------
    part : str
        Name of the part, such as ``optics``, or a dotted path, such as ``reed.shift``.
    added, scaled, put : tuple of (field, name)
        Fields and the names of the sizes that are added to them, whose exponential they are
        multiplied by, and that they are set to.
    """

    part: str
    added: Names = ()
    scaled: Names = ()
    put: Names = ()

    def __call__(self, twin: Twin, values: Mapping[str, float]) -> Twin:
        """Return the changed parameters; `twin` itself if the effect has no strength."""
        strengths = [name for _, names in self.added for name in _as_tuple(names)]
        if not any(values[name] for name in strengths or _as_tuple(self.put[0][1])):
            return twin
        whole: Twin = _with_part(
            twin, self.part.split("."), lambda part: self._changed(part, values)
        )
        return whole

    def _changed(self, part: Any, values: Mapping[str, float]) -> Any:
        fields: dict[str, Any] = {}
        for field, names in self.added:
            before = getattr(part, field)
            fields[field] = (
                before + values[names]
                if isinstance(names, str)
                else tuple(old + values[name] for old, name in zip(before, names, strict=True))
            )
        for field, name in self.scaled:
            fields[field] = getattr(part, field) * float(np.exp(values[str(name)]))
        for field, name in self.put:
            fields[field] = values[str(name)]
        return replace(part, **fields)


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

    def __call__(self, twin: Twin, values: Mapping[str, float]) -> Twin:
        """Return the parameters of the altered reed."""
        return with_alteration(twin, self.kind, values[self.size])


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
    >>> from physics.twin import Twin
    >>> additive("optics", defocus_m="distance")(Twin(), {"distance": 0.05}).optics.defocus_m
    0.05
    """
    return FieldChange(part, added=tuple(fields.items()))


def changed(
    part: str,
    *,
    add: Mapping[str, str] | None = None,
    scale: Mapping[str, str] | None = None,
    put: Mapping[str, str] | None = None,
) -> FieldChange:
    """Return the change that adds to, multiplies or sets the fields of a part.

    Nothing changes if all sizes in `add` are 0 or, without `add`, if the first size in `put` is 0.

    Parameters
    ----------
    part : str
        See `FieldChange`.
    add, scale, put : mapping of str to str, optional
        For each field the name of the size: added, its exponential multiplied, or set.

    Examples
    --------
    >>> from physics.twin import Twin
    >>> warmer = changed("environment", add={"warming_c_h": "rate"}, scale={"loss_per_c": "log"})
    >>> warmer(Twin(), {"rate": 2.0, "log": 0.0}).environment.warming_c_h
    2.0
    """
    each = [tuple((names or {}).items()) for names in (add, scale, put)]
    return FieldChange(part, *each)


def altered(kind: Alteration, size: str) -> AlterationChange:
    """Return the change that alters the reed by a size."""
    return AlterationChange(kind, size)


def _as_tuple(names: str | tuple[str, ...]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names


def _with_part(whole: Any, path: list[str], change: Callable[[Any], Any]) -> Any:
    """Return a tree of dataclasses with the part at a path changed."""
    first, *rest = path
    part = getattr(whole, first)
    return replace(whole, **{first: _with_part(part, rest, change) if rest else change(part)})
