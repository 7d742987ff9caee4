"""From runs to groups of observables that are compared with the model; fewer with less data."""

import pkgutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module

import diagnosis.observables
from diagnosis.campaign import Campaign
from diagnosis.observable_groups import ObservableGroup
from diagnosis.observable_source import GroupSource
from diagnosis.readings.campaign_readings import Readings, read_runs
from physics.mechanics import ReedSolver
from protocols.bench import BenchFile


@cache
def sources() -> tuple[GroupSource, ...]:
    """Return the sources of all groups, by position: ``SOURCES`` of each observable module."""
    package = diagnosis.observables
    found: list[GroupSource] = []
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        found += import_module(module.name).SOURCES
    return tuple(sorted(found, key=lambda source: source.position))


def read(
    campaign: Campaign,
    bench: BenchFile | None = None,
    progress: Callable[[float], None] | None = None,
) -> Readings:
    """Read all runs.

    Parameters
    ----------
    campaign : Campaign
    bench : BenchFile, optional
        What is known of the bench.
    progress : callable, optional
        Called with the fraction that is done.

    Raises
    ------
    RunFileError
        If a run cannot be read.
    """
    readings = read_runs(campaign, bench, progress)
    extra = {source.name: source.read(campaign) for source in sources() if source.read}
    return replace(readings, extra=extra) if extra else readings


def observable_groups(readings: Readings, reed_solver: ReedSolver) -> list[ObservableGroup]:
    """Return the groups of observables that a campaign has data for, in fixed order.

    Parameters
    ----------
    readings : Readings
    reed_solver : ReedSolver
        Solver of this kind of reed.
    """
    built = (source.build(readings, reed_solver) for source in sources())
    return [group for group in built if group is not None]
