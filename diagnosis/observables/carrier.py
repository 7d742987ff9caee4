"""Carrier light in the holograms, seen near the clamp where the reed hardly moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from diagnosis.observable_groups import (
    DISORDER,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    ObservableGroup,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.carrier import CarrierReading, carrier_floor
from diagnosis.readings.sweeps import SweepReading
from holography.arrays import Array
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters

# Shares by which what a reed shows next to its clamp differs from what is expected: in all sweeps,
# and in each. Chosen: clamps yield, and speckle is seen where it happens to be bright.
_REEDS, _SWEEPS = 1.0, 0.3
# Fraction of the carrier that may stay where it has been subtracted. Chosen: a third.
_LEFT = 0.3


@dataclass(frozen=True)
class Leaks:
    """What is in sweeps that fits do not expect: a carrier, the next sideband.

    Attributes
    ----------
    carrier : dict of float
        Over what moves in each sweep, by its name.
    mixing : float
        Of the next sideband, in units of the own.
    """

    carrier: dict[str, float]
    mixing: float


def leaks_in(
    carriers: Sequence[CarrierReading], sweeps: Sequence[SweepReading], mixing: float
) -> Leaks:
    """What leaks into each sweep.

    Parameters
    ----------
    carriers : sequence of CarrierReading
    sweeps : sequence of SweepReading
    mixing : float
        See `diagnosis.observables.light.mixing_in`.
    """
    share = dict(
        zip(
            [c.name for c in carriers],
            [c.share for c in carriers] - carrier_floor(carriers),
            strict=True,
        )
    )
    carrier = {
        sweep.name: max(share.get(sweep.name, 0.0), 0.0)
        * (_LEFT if sweep.taken_off else 1.0)
        / float(np.median(sweep.amplitude_rad))
        for sweep in sweeps
    }
    return Leaks(carrier, mixing)


def carrier_group(carriers: Sequence[CarrierReading]) -> ObservableGroup:
    """Compare the carrier in the sideband of each sweep."""
    floor = carrier_floor(carriers)
    noise = np.array([c.error for c in carriers]) * 0.3

    def predict(parameters: BenchParameters) -> Array:
        amplitude: Array = np.hypot(parameters.optics.interference.leak, floor)
        return amplitude

    moving = GroupNuisances(
        "motion near the clamp", _REEDS * floor[:, None], DISORDER, "chosen: of each reed its own"
    )
    errors = Errors(np.hypot(noise, _SWEEPS * floor), (moving,))
    places = [Coordinates("carrier near the clamp", level=c.name) for c in carriers]
    values = [c.share for c in carriers]
    return observable_group(
        "carrier", Observable.MAPS, values, errors, places, ("optics",), predict
    )


def _carrier(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return carrier_group(readings.carriers) if readings.carriers else None


SOURCES: Final = (GroupSource(8, _carrier),)
