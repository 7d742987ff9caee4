"""Options of a driver in a bench file, read as strictly as the rest of the file."""

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from drivers.errors import BenchSetupError

M = TypeVar("M", bound=BaseModel)

# Chosen: no key and no value of an option is as long, and a message with both stays short.
_MAX_CHARACTERS = 80


class Options(BaseModel):
    """Options of a driver: frozen; unknown keys and values of another type are refused."""

    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


def read_options(model: type[M], content: Mapping[str, Any], bench: str, section: str) -> M:
    """Check a section of a bench file that its driver checks.

    Parameters
    ----------
    model : type of `Options`
    content : mapping
        The section.
    bench : str
        Name of the bench, for the message.
    section : str
        Key path of the section, such as ``instruments.camera.options``.

    Raises
    ------
    BenchSetupError
        With the key path of the first thing that is wrong.
    """
    try:
        return model.model_validate(content)
    except ValidationError as invalid:
        errors = invalid.errors()
        # A misspelt key is also a missing one: name the misspelling.
        first = min(errors, key=lambda error: error["type"] != "extra_forbidden")
        key = ".".join(_shown(str(part)) for part in (section, *first["loc"]))
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        if first["type"] == "extra_forbidden":
            known = ", ".join(model.model_fields) or "none"
            message = f"unknown key; known are {known}"
        elif first["type"] == "missing":
            message = "is missing; add it"
        else:
            complaint = first["msg"].removeprefix("Input ").removeprefix("Value error, ")
            message = f"{complaint}, but is {_shown(repr(first['input']))}; correct it"
        raise BenchSetupError(f"bench {bench!r}: {key}: {message}{more}") from None


def _shown(text: str) -> str:
    """Text with its middle left out if it is long, so that a message stays one line."""
    half = _MAX_CHARACTERS // 2
    return text if len(text) <= _MAX_CHARACTERS else f"{text[:half]}…{text[-half:]}"
