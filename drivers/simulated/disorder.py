"""The section ``twin: disorder:`` of a bench file: what a simulated bench is really like."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.errors import BenchSetupError
from physics.parameters.disorder import BY_NAME, Disorder, ordinary_amounts, with_disorder
from physics.parameters.tree import BenchParameters
from protocols.bench_parameters import number_in
from protocols.units import shown_value

# Keys of the section that are no amounts.
_ORDINARY, _SEED = "ordinary", "seed"


@dataclass(frozen=True)
class RealisedDisorder:
    """Disorder of one bench with one reed.

    Attributes
    ----------
    seed : int
        From which amounts and fields were drawn.
    reed : str
        Name of the reed.
    amounts : mapping of float
        By name; empty if there is no disorder.
    """

    seed: int = 0
    reed: str = ""
    amounts: Mapping[str, float] = field(default_factory=dict)

    def applied(self, parameters: BenchParameters) -> BenchParameters:
        """Return the parameters of a bench with this disorder."""
        return with_disorder(parameters, self.amounts, self.seed, self.reed)

    @property
    def record(self) -> str:
        """JSON for the run file: seed, and each amount with its unit; empty without disorder."""
        if not self.amounts:
            return ""
        amounts = {
            name: {"value": value, "unit": BY_NAME[name].ordinary.unit}
            for name, value in self.amounts.items()
        }
        return json.dumps({"seed": self.seed, "reed": self.reed, "amounts": amounts})


def as_section(content: object) -> object:
    """Return the section as a mapping: the word ``ordinary`` says that all is drawn."""
    return {_ORDINARY: True} if content == _ORDINARY else content


def realised(section: Mapping[str, Any], reed: str, source: str) -> RealisedDisorder:
    """Return the disorder that a section of a bench file asks for.

    Amounts that it names have their values. With ``ordinary: true`` all others are drawn.

    Parameters
    ----------
    section : mapping
    reed : str
        Name of the reed on the bench.
    source : str
        Bench and key path of the section, for messages.

    Raises
    ------
    BenchSetupError
        If a key is unknown, or a value has another unit or is outside its limits.
    """
    seed, ordinary = section.get(_SEED, 0), section.get(_ORDINARY, False)
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise BenchSetupError(
            f"{source}.{_SEED}: {shown_value(seed)} is no whole number from 0; correct it"
        )
    if not isinstance(ordinary, bool):
        raise BenchSetupError(
            f"{source}.{_ORDINARY}: {shown_value(ordinary)} is not true or false; correct it"
        )
    amounts = ordinary_amounts(seed, reed) if ordinary else {}
    for name, text in section.items():
        if name in (_SEED, _ORDINARY):
            continue
        kind = BY_NAME.get(name)
        if kind is None:
            known = ", ".join((_ORDINARY, _SEED, *BY_NAME))
            raise BenchSetupError(f"{source}.{name}: unknown key; known are {known}")
        amounts[name] = _amount(kind, text, f"{source}.{name}")
    return RealisedDisorder(seed, reed, amounts)


def _amount(kind: Disorder, text: object, source: str) -> float:
    unit, (low, high) = kind.ordinary.unit, kind.limits
    try:
        value = number_in(unit, text)
    except ValueError as error:
        raise BenchSetupError(f"{source}: {error}") from None
    if not (math.isfinite(value) and low <= value <= high):
        limits = f"{low:g} to {high:g} {unit}".strip()
        raise BenchSetupError(f"{source}: {shown_value(text)} is outside {limits}; correct it")
    return value
