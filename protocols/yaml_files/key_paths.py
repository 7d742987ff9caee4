"""Key paths of a file, and the models that they lead to."""

from collections.abc import Iterator, Sequence
from typing import Any, Final, get_args

from pydantic import BaseModel

KeyPath = tuple[str | int, ...]

# Key that names the kind of a section of which there are several kinds, such as a sweep law.
KIND_KEY: Final = "law"


def resolved(model: type[BaseModel], location: KeyPath) -> tuple[KeyPath, list[type[BaseModel]]]:
    """Return the key path in the file for a location of pydantic, and the models at that path.

    In a section of which there are several kinds, such as sweep laws, pydantic adds the name of the
    kind to the location. It is not part of the key path.
    """
    path: list[str | int] = []
    models, kind_follows = [model], False
    for step in location:
        if kind_follows:
            models = [each for each in models if step in _kind_names(each)]
            kind_follows = False
            continue
        path.append(step)
        # An item of a list has the section of the list.
        if isinstance(step, str):
            fields = [
                info
                for each in models
                for name, info in each.model_fields.items()
                if step == (info.alias or name)
            ]
            kind_follows = any(info.discriminator for info in fields)
            models = [below for info in fields for below in _models_in(info.annotation)]
    return tuple(path), models


def _kind_names(model: type[BaseModel]) -> tuple[Any, ...]:
    return get_args(model.model_fields[KIND_KEY].annotation)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Models in the type of a key: a model itself, or one in an option, a tuple or a list."""
    kinds: list[Any] = [annotation]
    while kinds:
        kind = kinds.pop(0)
        kinds += get_args(kind)
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield kind


def keys_of(models: Sequence[type[BaseModel]]) -> list[str]:
    """Keys of some models as they are written in the file, each once."""
    keys = (info.alias or name for each in models for name, info in each.model_fields.items())
    return list(dict.fromkeys(keys))


def kinds(models: Sequence[type[BaseModel]]) -> str:
    """Return the names of the kinds of a section, for a message."""
    return ", ".join(str(name) for each in models for name in _kind_names(each))
