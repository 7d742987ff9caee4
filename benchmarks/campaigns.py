"""Campaigns in folders, read once for several benchmarks."""

import contextlib
from pathlib import Path

from acquire.runfile import Run
from diagnosis.campaign import Campaign
from diagnosis.known_bench import bench_of
from diagnosis.observing import Readings, read
from physics.mechanics import Workshop
from physics.reed.cache import anatomy


def readings_of(folder: Path) -> tuple[Readings, Workshop]:
    """Read all run files of a folder, and make what their reed needs."""
    with contextlib.ExitStack() as opened:
        files = sorted(folder.glob("*.h5"))
        campaign = Campaign.of([opened.enter_context(Run.open(file)) for file in files])
        first = campaign.sweeps[0].run
        workshop = Workshop(anatomy(first.reed_file().geometry()))
        return read(campaign, bench_of(first)), workshop
