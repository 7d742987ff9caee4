"""Descriptions: frozen models that come from one YAML file, read strictly.

Everything wrong with a file is a `ProtocolError` of one line: file, line number, key path, value,
remedy. `protocols.protocol.Protocol` and `protocols.bench.BenchFile` are descriptions.
"""

import difflib
import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, ClassVar, Final, Self

import yaml
from pydantic import BaseModel, ConfigDict, PrivateAttr, ValidationError
from pydantic_core import ErrorDetails

from protocols.errors import ProtocolError
from protocols.units import invisible_character, shown_value
from protocols.yaml_files.key_paths import KIND_KEY, KeyPath, keys_of, kinds, resolved

# A description is two screens long, and 50 kB with a map of 5000 measured thicknesses. These stop a
# file that is something else before it costs time; PyYAML reads some 40 kB in a second.
_MAX_BYTES: Final = 64 * 1024
_MAX_DEPTH: Final = 12
_MAX_VALUE_CHARACTERS: Final = 1000
# Chosen: with the name of a file, a message then fits five lines of a terminal (400 characters).
_MAX_KEY_CHARACTERS: Final = 40
_MAX_PATH_CHARACTERS: Final = 100
_MAX_MESSAGE_CHARACTERS: Final = 260

_PLAIN_TAGS: Final = frozenset(
    f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "map", "seq")
)
# YAML 1.1 reads 010 as 8, 1:30 as 90, 0x10 as 16 and 1_0 as 10, which no user expects.
_DECIMAL: Final = re.compile(
    r"[+-]?(?:0|[1-9][0-9]*|(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?)", re.I
)
_NOT_FINITE: Final = {
    ".nan": math.nan, ".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf,
}  # fmt: skip


# --- Strict YAML -------------------------------------------------------------------------------


class _StrictLoader(yaml.SafeLoader):
    """Safe YAML without features that descriptions do not need; records the line of each key.

    Refused with file, line and key path: anchors and aliases (a short file can expand to
    gigabytes), a key given twice (YAML would silently take the last), keys that are not words,
    keys without a value, values that are not plain (dates, tags), numbers that YAML 1.1 reads in an
    unexpected way, invisible characters, and depths or lengths that no description has.
    """

    def __init__(self, text: str, source: str) -> None:
        super().__init__(text)
        self.source = source
        self.lines: dict[KeyPath, int] = {}
        self._path: list[str | int] = []

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose one node; `index` is the key node, the place in a list, or None for a key."""
        place = index.value if isinstance(index, yaml.Node) else index
        if place is not None:
            self._path.append(place if isinstance(place, int) else str(place))
        event = self.peek_event()  # type: ignore[no-untyped-call]  # untyped in the stubs
        mark = index.start_mark if isinstance(index, yaml.Node) else event.start_mark
        self.lines.setdefault(tuple(self._path), mark.line + 1)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise self._refusal("has a YAML anchor or alias; write the value out where it is used")
        if getattr(event, "tag", None) is not None:
            raise self._refusal(f"has the YAML tag {event.tag!r}; leave the tag out")
        if len(self._path) > _MAX_DEPTH:
            raise self._refusal(f"is nested deeper than {_MAX_DEPTH} levels; flatten it")
        node = super().compose_node(parent, index)
        self._check_plain(node)
        if place is not None:
            self._path.pop()
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping; every key is a word and stands once."""
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        seen: dict[str, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if key.tag != "tag:yaml.org,2002:str":
                raise self._refusal("has a key that is not a word; put it in quotes", line)
            if key.value in seen:
                raise self._refusal(
                    f"is given twice, first in line {seen[key.value]}; keep one", line, key.value
                )
            seen[key.value] = line
        return node

    def _check_plain(self, node: yaml.Node | None) -> None:
        if node is None:
            return
        if node.tag not in _PLAIN_TAGS:
            raise self._refusal(f"has the YAML type {node.tag!r}; put the value in quotes")
        if isinstance(node, yaml.ScalarNode):
            self._check_scalar(node)

    def _check_scalar(self, node: yaml.ScalarNode) -> None:
        value, kind = node.value, node.tag.rpartition(":")[2]
        if len(value) > _MAX_VALUE_CHARACTERS:
            raise self._refusal(f"is longer than {_MAX_VALUE_CHARACTERS} characters; shorten it")
        invisible = invisible_character(value)
        if invisible:
            raise self._refusal(f"holds the character {invisible}; write one line without it")
        if kind == "null" and not value:
            raise self._refusal("an empty value should be written out, or its key left out")
        if kind in ("int", "float"):
            self._check_number(value)

    def _check_number(self, value: str) -> None:
        plain = _DECIMAL.fullmatch(value)
        number = float(value if plain else _NOT_FINITE.get(value.lower(), 0.0))
        if not math.isfinite(number):
            raise self._refusal(f"{number} is not a finite number; write one that is")
        if not plain:
            raise self._refusal(
                f"{shown_value(value)} is not a decimal number; write it as 1996.9 is, or in "
                "quotes if it is a word"
            )

    def _refusal(self, message: str, line: int | None = None, *key: str) -> ProtocolError:
        path = (*self._path, *key)
        return _error(self.source, path, line or self.lines.get(path), message)


def _load_strictly(text: str, source: str) -> tuple[dict[str, Any], dict[KeyPath, int]]:
    """Read YAML; return its plain values and the line of each key path."""
    try:
        loader = _StrictLoader(text, source)
        content = loader.get_single_data()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else None
        problem = error.problem or error.context or "unreadable"
        message = f"is not YAML ({problem}); mend the brackets, quotes or indentation there"
        raise _error(source, (), line, message) from None
    except yaml.reader.ReaderError as error:
        message = f"is not text ({error.reason} at character {error.position}); save it as UTF-8"
        raise _error(source, (), None, message) from None
    if content is None:
        raise _error(source, (), None, "is empty; start from a copy of a shipped file")
    if not isinstance(content, dict):
        message = f"{shown_value(content)} is not a mapping; write lines such as 'name: my sweep'"
        raise _error(source, (), 1, message)
    return content, loader.lines


def _read_text(file: Traversable, source: str) -> str:
    """Read a file of at most `_MAX_BYTES` as UTF-8 text."""
    if file.is_dir():
        raise _error(source, (), None, "is a folder; name a file in it")
    try:
        with file.open("rb") as stream:
            data = stream.read(_MAX_BYTES + 1)
    except OSError as error:
        reason = error.strerror or "unreadable"
        raise _error(source, (), None, f"cannot be read: {reason}; check name and rights") from None
    if len(data) > _MAX_BYTES:
        message = f"is larger than {_MAX_BYTES // 1024} KiB, so it is not a description; check it"
        raise _error(source, (), None, message)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        message = f"is not text (byte {error.start} is not UTF-8); name a YAML file"
        raise _error(source, (), None, message) from None


# --- Errors of one line ------------------------------------------------------------------------


def key_path(path: KeyPath) -> str:
    """Write a path of keys as in messages: ``drive.to``, ``acoustic_resonances[0]``."""
    keys = (
        f"[{p}]" if isinstance(p, int) else f".{_shortened(p, _MAX_KEY_CHARACTERS)}" for p in path
    )
    return _shortened("".join(keys).lstrip("."), _MAX_PATH_CHARACTERS)


def _shortened(text: str, characters: int) -> str:
    """Shorten a text in its middle: the problem comes first and the remedy last."""
    if len(text) <= characters:
        return text
    half = characters // 2
    return f"{text[:half]}…{text[-half + 1 :]}"


def _error(source: str, path: KeyPath, line: int | None, message: str) -> ProtocolError:
    where = source or "(no name)"
    where = where if line is None else f"{where}:{line}"
    message = _shortened(message, _MAX_MESSAGE_CHARACTERS)
    parts = (where, key_path(path), message) if path else (where, message)
    # A file may hold anything; line ends and escape sequences must not reach a terminal.
    return ProtocolError("".join(c if c.isprintable() else repr(c)[1:-1] for c in ": ".join(parts)))


def _explanation(
    error: ErrorDetails, model: type[BaseModel], content: Mapping[str, Any]
) -> tuple[KeyPath, str]:
    """Say at which key path pydantic found something wrong, what it is, and what to do."""
    path, models = resolved(model, error["loc"])
    value = shown_value(_value_at(content, path))
    match error["type"]:
        case "value_error":
            return path, str(error["ctx"]["error"])
        case "extra_forbidden":
            _, models = resolved(model, error["loc"][:-1])
            known = keys_of(models) or ["none"]
            near = difflib.get_close_matches(str(path[-1]), known, n=1, cutoff=0.5)
            remedy = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
            return path, f"unknown key; {remedy}"
        case "missing":
            return path, "is missing; add it, see the shipped files for how it is written"
        case "model_type" | "model_attributes_type":
            return path, f"{value} is no mapping; give {', '.join(keys_of(models))}"
        case "union_tag_not_found":
            return (*path, KIND_KEY), f"is missing; write one of {kinds(models)}"
        case "union_tag_invalid":
            named = shown_value(_value_at(content, (*path, KIND_KEY)))
            return (*path, KIND_KEY), f"{named} is unknown; write one of {kinds(models)}"
        case _:
            complaint = error["msg"].removeprefix("Input ").removeprefix("String ")
            return path, f"{value} {complaint}"


def _value_at(content: Any, path: KeyPath) -> Any:
    for step in path:
        # Of a value that may be one of several types, a path goes on with the type.
        try:
            content = content[step]
        except (LookupError, TypeError):
            break
    return content


# --- Models that come from a file --------------------------------------------------------------


class Section(BaseModel):
    """A frozen part of a description; unknown keys and values of another type are refused.

    The text below a field describes its key in the reference of all keys.
    """

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", use_attribute_docstrings=True
    )


@dataclass(frozen=True)
class _Origin:
    """Source of a description; never compared, so equal settings are equal descriptions."""

    source: str = field(default="(made in Python)", compare=False)
    text: str | None = field(default=None, compare=False)
    lines: Mapping[KeyPath, int] = field(default_factory=dict, compare=False)

    def line_of(self, path: KeyPath) -> int | None:
        """Line of a key, or of the section that it is missing from."""
        return self.lines.get(path) or self.lines.get(path[:-1] or path)


class Description(Section):
    """A whole file: its settings, its text and its name for error messages.

    Attributes have units in their names (`sweep.reference_hz`); keys of the file have units in
    their values (``reference: 1396.9 Hz``). Error messages and `replace` use the keys.
    """

    kind: ClassVar[str] = "description"
    folder: ClassVar[str] = "."

    _origin: _Origin = PrivateAttr(default_factory=_Origin)

    @classmethod
    def from_file(cls, name_or_path: str | Path) -> Self:
        """Read a file, or a shipped file by its bare name.

        Parameters
        ----------
        name_or_path : str or Path
            See `find_protocol` and `find_bench` for how a name is resolved.

        Raises
        ------
        ProtocolError
            If there is no such file or anything in it is wrong.
        """
        source = str(name_or_path)
        file = find_description(source, cls.kind, cls.folder)
        return cls.from_text(_read_text(file, source), source)

    @classmethod
    def from_text(cls, text: str, source: str = "(text)") -> Self:
        """Read the text of a file; `source` names it in error messages.

        Raises
        ------
        ProtocolError
            If anything in it is wrong.
        """
        if len(text) > _MAX_BYTES:
            message = f"is longer than {_MAX_BYTES} characters, so it is not a {cls.kind}; check it"
            raise _error(source, (), None, message)
        content, lines = _load_strictly(text, source)
        return cls._from_content(content, _Origin(source, text, lines))

    @classmethod
    def _from_content(cls, content: Mapping[str, Any], origin: _Origin) -> Self:
        try:
            return cls.model_validate(content, context=origin)
        except ValidationError as invalid:
            errors = invalid.errors()
            # A misspelt key is also a missing one: name the misspelling.
            error = min(errors, key=lambda e: e["type"] != "extra_forbidden")
            others = len(errors) - 1
            path, message = _explanation(error, cls, content)
            message += f" (and {others} more)" if others else ""
            raise _error(origin.source, path, origin.line_of(path), message) from None

    def model_post_init(self, context: Any, /) -> None:
        """Keep where the description came from, which `_from_content` passes as the context."""
        if isinstance(context, _Origin):
            self._origin = context

    def replace(self, changes: Mapping[str, Any] | None = None, /, **more: Any) -> Self:
        """Return a copy with some settings changed, checked like a file.

        Parameters
        ----------
        changes : mapping, optional
            New values by key path as in the file and in error messages. A quantity is written as
            in the file; a mapping replaces a whole section; None leaves out an optional key.
        **more
            The same as keywords, as in `dict.update`.

        Raises
        ------
        ProtocolError
            If a key path is unknown or a value is wrong.

        Examples
        --------
        >>> from protocols.protocol import Protocol
        >>> series_a = Protocol.from_file("seriesA")
        >>> short = series_a.replace({"sweep.last": 30, "drive.to": "8 V"}, keep="frames")
        >>> short.sweep.last, short.drive.to_v, short.keep
        (30, Fraction(8, 1), 'frames')
        """
        origin = _Origin(f"{self.source} (changed)")
        content = self.content()
        for key, value in {**(changes or {}), **more}.items():
            *sections, last = key.split(".")
            section: Any = content
            for name in sections:
                section = section.setdefault(name, {}) if isinstance(section, dict) else None
            if not isinstance(section, dict):
                message = f"has no key {last!r} below it; change a key that the file could hold"
                raise _error(origin.source, tuple(sections), None, message)
            section[last] = value
        return self._from_content(content, origin)

    def content(self) -> dict[str, Any]:
        """Return the settings as plain values, keyed and written as in a file, defaults included.

        Two descriptions that mean the same have the same content.
        """
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)

    @property
    def source(self) -> str:
        """Name for error messages: the file, and whether it was changed since."""
        return self._origin.source

    @property
    def text(self) -> str:
        """YAML of this description: the original text, or the plain content."""
        if self._origin.text is not None:
            return self._origin.text
        written: str = yaml.safe_dump(self.content(), sort_keys=False, allow_unicode=True)
        return written

    @property
    def sha256(self) -> str:
        """Hash of the content: comments, order and spelling (``500 mV``) do not change it."""
        canonical = json.dumps(self.content(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()

    def error(self, key: str | KeyPath, message: str) -> ProtocolError:
        """Return the error that says `message` of a key path of this file, dotted or in parts."""
        path = tuple(key.split(".")) if isinstance(key, str) else key
        return _error(self.source, path, self._origin.line_of(path), message)


# --- Shipped files and names -------------------------------------------------------------------


def named_beside(source: str, name: str) -> str | Path:
    """Return the file of a name in the folder of the file `source`; without one, the name."""
    neighbour = Path(source).parent / name
    try:
        return neighbour if neighbour.is_file() else name
    except OSError:
        # No file can have that name; `find_description` reports it.
        return name


def find_description(name: str, kind: str, folder: str) -> Traversable:
    """Find a file by its path, or a shipped file in `folder`; `kind` names it in errors."""
    path = Path(name)
    try:
        exists, is_folder = path.exists(), path.is_dir()
    except OSError as error:
        reason = error.strerror or "unreadable"
        raise _error(name, (), None, f"cannot be read: {reason}; check name and rights") from None
    if exists and not is_folder:
        return path
    shipped = shipped_files(folder)
    bare = name.removeprefix("protocols/").removeprefix(f"{folder}/").removesuffix(".yaml")
    if bare in shipped:
        return shipped[bare]
    if is_folder:
        return path
    spelt = {name.lower(): name for name in shipped}
    near = [spelt[match] for match in difflib.get_close_matches(bare.lower(), spelt, n=1)]
    remedy = f"did you mean {near[0]}? " if near else ""
    message = f"there is no such file, nor a shipped {kind} of that name"
    raise _error(name, (), None, f"{message}; {remedy}shipped are {', '.join(sorted(shipped))}")


def shipped_files(folder: str) -> dict[str, Traversable]:
    """YAML files that come with the software in one folder of `protocols`, by name."""
    root = resources.files("protocols")
    place = root if folder == "." else root / folder
    return {
        file.name.removesuffix(".yaml"): file
        for file in place.iterdir()
        if file.name.endswith(".yaml")
    }
