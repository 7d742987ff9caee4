"""The twin's description of a bench and of the reed on it: what it takes for true.

Every field's default is what the nominal twin assumes. An effect replaces a few of them.
"""

from dataclasses import dataclass, replace
from typing import Any

from physics.mechanics import Alteration, Mechanics


@dataclass(frozen=True)
class Twin:
    """A bench as the twin sees it.

    Attributes
    ----------
    reed : Mechanics
    """

    reed: Mechanics = Mechanics()


def with_reed(twin: Twin, **changes: Any) -> Twin:
    """Twin with other fields of its reed."""
    return replace(twin, reed=replace(twin.reed, **changes))


def with_cane(twin: Twin, **more: float) -> Twin:
    """Twin whose cane's shifts are that much greater."""
    shift = twin.reed.shift
    changed = {name: getattr(shift, name) + value for name, value in more.items()}
    return with_reed(twin, shift=replace(shift, **changed))


def with_alteration(twin: Twin, kind: Alteration, amount: float) -> Twin:
    """Twin whose reed has been altered besides."""
    if not amount:
        return twin
    return with_reed(twin, alterations=(*twin.reed.alterations, (kind, amount)))
