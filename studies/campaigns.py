"""Campaigns of benches with nothing wrong, for several benchmarks."""

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from blind.cases import Label, record_case
from diagnosis.campaign import Campaign
from diagnosis.observe import read
from diagnosis.readings.campaign_readings import Readings
from fitting.known_bench import bench_of
from physics.mechanics import ReedSolver
from physics.reed.reduced.stored import reduced_reed
from runs.reader import Run

# Of laboratories with nothing wrong.
SEEDS = 197177817, 587805961, 343088919, 925862771, 1616017002


@contextlib.contextmanager
def campaigns(named: Sequence[Path], count: int = 1) -> Iterator[list[Path]]:
    """Folders as named; of `count` laboratories with nothing wrong if none is."""
    if named:
        yield list(named)
        return
    with tempfile.TemporaryDirectory() as place:
        for seed in SEEDS[:count]:
            record_case(Path(place), str(seed), Label(0, (), True, seed))
        yield [Path(place) / str(seed) for seed in SEEDS[:count]]


def readings_of(folder: Path) -> tuple[Readings, ReedSolver]:
    """Read all run files of a folder, and make what their reed needs."""
    with contextlib.ExitStack() as opened:
        files = sorted(folder.glob("*.h5"))
        campaign = Campaign.of([opened.enter_context(Run.open(file)) for file in files])
        first = campaign.sweeps[0].run
        reed_solver = ReedSolver(reduced_reed(first.reed_file().geometry()))
        return read(campaign, bench_of(first)), reed_solver
