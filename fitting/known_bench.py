"""What the bench file in a run says of the bench: effects that it is known to have."""

from collections.abc import Sequence

from fitting.errors import FitInputError
from physics.sized_effect import SizedEffect
from protocols.bench import BenchFile
from protocols.bench_parameters import known_effects, sized_effects
from protocols.errors import ProtocolError
from runs.reader import Run


def bench_of(run: Run) -> BenchFile | None:
    """Bench file that a run carries; None if it carries none that can be read."""
    try:
        return BenchFile.from_text(run.bench_text, "bench of the run")
    except ProtocolError:
        return None


def known_effects_in(runs: Sequence[Run]) -> tuple[SizedEffect, ...]:
    """Return the effects that the bench of some runs is known to have.

    They are those under ``known:`` of the bench files in the runs; none if these cannot be read.

    Raises
    ------
    FitInputError
        If this software does not know one, or the runs do not agree.
    """
    each = [known_effects(bench_of(run)) for run in runs]
    if any(other != each[0] for other in each):
        names = ", ".join(run.path.name for run in runs)
        raise FitInputError(
            f"{names}: the bench files in these runs have not the same effects under known:; fit "
            "the runs one by one"
        )
    try:
        return sized_effects(each[0], f"{runs[0].path}: bench: known")
    except ProtocolError as error:
        raise FitInputError(str(error)) from None
