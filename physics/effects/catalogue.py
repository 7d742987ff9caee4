"""Find every effect: each module of this package that defines ``EFFECT`` is one."""

import pkgutil
from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Final

import physics.effects
from physics.effects.effect import Effect, Stage


def discovered() -> tuple[Effect, ...]:
    """Return all effects in the order of the measuring chain: by stage, position and identifier.

    The order is fixed because sums of evidence depend on it in their last digits.

    Raises
    ------
    ValueError
        If an effect's identifier is not the name of its file.
    """
    effects = []
    for module in pkgutil.iter_modules(physics.effects.__path__, "physics.effects."):
        effect = getattr(import_module(module.name), "EFFECT", None)
        if effect is None:
            continue
        if not isinstance(effect, Effect) or module.name != f"physics.effects.{effect.id}":
            raise ValueError(f"{module.name}: EFFECT has to be an Effect with the file's name")
        effects.append(effect)
    stages = list(Stage)
    return tuple(sorted(effects, key=lambda e: (stages.index(e.stage), e.position, e.id)))


CATALOGUE: Final[tuple[Effect, ...]] = discovered()
BY_ID: Final[Mapping[str, Effect]] = MappingProxyType({effect.id: effect for effect in CATALOGUE})
