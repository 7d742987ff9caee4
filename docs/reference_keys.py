"""Tables of every key of every YAML file, generated from the models that read these files.

`tables` yields one table for each kind of file (protocol, bench, reed, campaign), and one for the
options of each driver of this package. The reference pages are rendered from them.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo

from drivers.registry import find_driver, known_drivers
from drivers.simulated.settings import Simulation
from protocols.bench import BenchFile
from protocols.campaign import CampaignFile
from protocols.protocol import Protocol
from protocols.reed import ReedFile
from protocols.units import format_quantity
from protocols.yaml_files.key_paths import KIND_KEY
from protocols.yaml_files.strict_yaml import Description

_FILES: tuple[type[Description], ...] = (Protocol, BenchFile, ReedFile, CampaignFile)
# Sections that a description leaves to a driver, and the model that checks them.
_CHECKED_BY_DRIVER: dict[tuple[type[BaseModel], str], type[BaseModel]] = {
    (BenchFile, "twin"): Simulation,
}
_WORDS = {str: "text", int: "whole number", float: "number", bool: "true or false"}
_QUANTITIES = {
    "Hz": "frequency",
    "V": "voltage",
    "ohm": "resistance",
    "m": "length",
    "s": "time",
    "cents": "interval",
    "rad": "angle",
    "Pa": "modulus",
    "kg/m^3": "density",
    "degC": "temperature",
}


@dataclass(frozen=True)
class Key:
    """One key of a file.

    Attributes
    ----------
    path : str
        Key path, such as ``sweep.interval`` or ``parts[].name``.
    kind : str
        Type of the value in words, such as ``frequency`` or ``list of whole number``.
    unit : str
        Unit of a quantity; any unit of the same dimension may be written. Empty for others.
    default : str
        Value that holds without this key; ``required`` if there is none, ``none`` if its absence
        means something of its own.
    allowed : str
        Allowed values or range; empty if all values of the type are allowed.
    description : str
    when : str
        Condition under which the key exists, such as ``law: geometric``; empty for always.
    """

    path: str
    kind: str
    unit: str
    default: str
    allowed: str
    description: str
    when: str = ""


@dataclass(frozen=True)
class Table:
    """All keys of one kind of file, or of the options of one driver.

    Attributes
    ----------
    name : str
        ``protocol``, ``bench``, ``reed``, ``campaign``, or the name of a driver.
    title : str
    description : str
    keys : tuple of Key
        In the order of the model.
    """

    name: str
    title: str
    description: str
    keys: tuple[Key, ...]


def tables() -> Iterator[Table]:
    """Yield the tables of all files, then those of the options of all drivers."""
    for model in _FILES:
        title = f"Keys of a {model.kind} file"
        yield Table(model.kind, title, _summary(model), tuple(_keys(model)))
    for role in ("synthesizers", "generator", "camera"):
        for name in sorted(known_drivers(role)):
            options = getattr(find_driver(role, name), "OPTIONS", None)
            if options is not None:
                path = f"instruments.{role}.options"
                title = f"Options of the driver {name}"
                yield Table(name, title, _summary(options), tuple(_keys(options, f"{path}.")))


def _keys(model: type[BaseModel], prefix: str = "", when: str = "") -> Iterator[Key]:
    for name, info in model.model_fields.items():
        key = info.alias or name
        path, parts = f"{prefix}{key}", _Parts(info)
        section = _CHECKED_BY_DRIVER.get((model, name))
        sections = (section,) if section else parts.sections
        if key == KIND_KEY and when:
            continue
        yield Key(
            path=path,
            kind=f"{'list of ' * parts.lists}{'section' if sections else parts.kind}",
            unit=parts.unit,
            default=_default(info, bool(sections), parts.unit),
            allowed=parts.allowed,
            description=" ".join((info.description or "").split()),
            when=when,
        )
        below = f"{path}{'[]' * parts.lists}."
        if len(sections) > 1:
            yield _kind_key(below, sections)
        for each in sections:
            condition = f"{KIND_KEY}: {_kind_name(each)}" if len(sections) > 1 else when
            yield from _keys(each, below, condition)


class _Parts:
    """What the annotation of a field says."""

    def __init__(self, info: FieldInfo) -> None:
        self.lists, self.unit = 0, ""
        self.sections: tuple[type[BaseModel], ...] = ()
        self._words: list[str] = []
        self._choices: list[str] = []
        self._limits: list[str] = []
        for each in info.metadata:
            self._read_metadata(each)
        self._read(info.annotation)

    @property
    def kind(self) -> str:
        """Type in words."""
        words = [_QUANTITIES[self.unit]] if self.unit else self._words
        return " or ".join(dict.fromkeys(words))

    @property
    def allowed(self) -> str:
        """Choices and limits."""
        return ", ".join(dict.fromkeys(self._choices + self._limits))

    def _read(self, annotation: Any) -> None:
        origin, arguments = get_origin(annotation), get_args(annotation)
        if origin is Annotated:
            for each in arguments[1:]:
                self._read_metadata(each)
            self._read(arguments[0])
        elif origin in (Union, UnionType):
            for each in arguments:
                self._read(each)
        elif origin is Literal:
            self._words.append("text" if isinstance(arguments[0], str) else "whole number")
            self._choices += [f"`{choice}`" for choice in arguments]
        elif origin in (tuple, list):
            self.lists += 1
            self._read(arguments[0])
        elif origin is dict or annotation is dict:
            self._words.append("mapping")
        elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
            self.sections += (annotation,)
        elif annotation not in (NoneType, Fraction):
            self._words.append(_WORDS[annotation])

    def _read_metadata(self, metadata: Any) -> None:
        if isinstance(metadata, BeforeValidator):
            self.unit = getattr(metadata.func, "keywords", {}).get("unit", self.unit)
        if isinstance(metadata, FieldInfo):
            for each in metadata.metadata:
                self._read_metadata(each)
        for name, words in (
            ("gt", "above {}"), ("ge", "at least {}"), ("lt", "below {}"), ("le", "at most {}"),
            ("min_length", "at least {} long"), ("max_length", "at most {} long"),
            ("pattern", "pattern `{}`"),
        ):  # fmt: skip
            limit = getattr(metadata, name, None)
            if limit is not None:
                self._limits.append(words.format(limit))


def _default(info: FieldInfo, is_section: bool, unit: str) -> str:
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    if isinstance(value, BaseModel) and any(
        below.is_required() for below in type(value).model_fields.values()
    ):
        return json.dumps(value.model_dump(mode="json", by_alias=True))
    if is_section:
        return "optional"
    if value is None:
        return "none"
    if isinstance(value, Fraction):
        return format_quantity(value, unit)
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:g}"
    return json.dumps(value, default=str)


def _kind_name(model: type[BaseModel]) -> str:
    return str(get_args(model.model_fields[KIND_KEY].annotation)[0])


def _kind_key(prefix: str, sections: tuple[type[BaseModel], ...]) -> Key:
    """Return the key that chooses one of several sections."""
    described = [
        f"`{_kind_name(each)}`: {each.model_fields[KIND_KEY].description}" for each in sections
    ]
    names = ", ".join(f"`{_kind_name(each)}`" for each in sections)
    return Key(f"{prefix}{KIND_KEY}", "text", "", "required", names, " ".join(described))


def _summary(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").partition("\n\n")[0].strip()
