"""Joint fits of the sweeps of a campaign: modes, drive and light, and their residuals."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from diagnosis.block import (
    Block,
    Observable,
    Place,
    block,
)
from diagnosis.observable_source import GroupSource
from diagnosis.readings.campaign_readings import Readings
from physics.mechanics import ReedSolver
from physics.twin import Twin

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]


# By how many sweeps fits fail though nothing is wrong.
_REFUSED = 0.3


def understood_block(understood: int, refused: int) -> Block:
    """How many sweeps are no vibrations of this reed: no twin expects any."""

    def predict(_twin: Twin) -> Array:
        return np.zeros(1)

    places = [Place(f"sweeps not understood, of {understood + refused}")]
    errors = np.array([_REFUSED])
    return block("sweeps", Observable.RESPONSE, [float(refused)], errors, places, (), predict)


def _understood(readings: Readings, _reed_solver: ReedSolver) -> Block | None:
    understood, refused = len(readings.sweeps), len(readings.refused)
    return understood_block(understood, refused) if understood or refused else None


SOURCES: Final = (GroupSource(9, _understood),)
