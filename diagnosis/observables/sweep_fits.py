"""Joint fits of the sweeps of a campaign: modes, drive and light, and their residuals."""

from typing import Final

import numpy as np

from diagnosis.observable_groups import Coordinates, Observable, ObservableGroup, observable_group
from diagnosis.observable_source import GroupSource
from diagnosis.readings.campaign_readings import Readings
from holography.arrays import Array
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters

# By how many sweeps fits fail though nothing is wrong.
_REFUSED = 0.3


def understood_sweeps_group(understood: int, refused: int) -> ObservableGroup:
    """How many sweeps are no vibrations of this reed: no parameters expects any."""

    def predict(_twin: BenchParameters) -> Array:
        return np.zeros(1)

    places = [Coordinates(f"sweeps not understood, of {understood + refused}")]
    errors = np.array([_REFUSED])
    return observable_group(
        "sweeps", Observable.RESPONSE, [float(refused)], errors, places, (), predict
    )


def _understood(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    understood, refused = len(readings.sweeps), len(readings.refused)
    return understood_sweeps_group(understood, refused) if understood or refused else None


SOURCES: Final = (GroupSource(9, _understood),)
