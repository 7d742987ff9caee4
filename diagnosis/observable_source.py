"""How a module of `diagnosis.observables` declares its groups of observables."""

from collections.abc import Callable
from dataclasses import dataclass

from diagnosis.campaign import Campaign
from diagnosis.observable_groups import ObservableGroup
from diagnosis.readings.campaign_readings import Readings
from physics.mechanics import ReedSolver


@dataclass(frozen=True)
class GroupSource:
    """Source of one group of observables.

    Attributes
    ----------
    position : int
        Place among all groups. Sums over groups depend on their order in the last digits.
    build : callable
        ``build(readings, reed_solver)`` returns the group; None if the campaign has no such data.
    name : str
        Key of what `read` returns, in `Readings.extra`.
    read : callable, optional
        ``read(campaign)`` reads from the open runs what no other module reads.
    """

    position: int
    build: Callable[[Readings, ReedSolver], ObservableGroup | None]
    name: str = ""
    read: Callable[[Campaign], object] | None = None
