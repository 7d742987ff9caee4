"""What has to be the same for a run to be gone on with by another process."""

from dataclasses import dataclass
from pathlib import Path

from protocols.plan import Plan
from runs.errors import RunFileError
from runs.reader import Run


@dataclass(frozen=True)
class Unfinished:
    """A run that may be gone on with.

    Attributes
    ----------
    path : Path
    reed : str
    seed : int
    missing : int
        Steps that are still to be taken.
    """

    path: Path
    reed: str
    seed: int
    missing: int


def unfinished(path: str | Path, plan: Plan) -> Unfinished:
    """Check that a plan is that of a run which is not complete.

    Parameters
    ----------
    path : str or Path
        Of the run file.
    plan : Plan

    Raises
    ------
    RunFileError
        If the run is complete, or another protocol, bench or kind of reed was measured in it: half
        a sweep of each would be no sweep.
    """
    # A step that the disk has damaged is measured again.
    with Run.open(path, damaged_as_pending=True) as run:
        if run.status == "complete":
            raise RunFileError(f"{path}: is complete; measure a new run")
        require_same(run, plan)
        missing = sum(not step.verdict.measured for step in run.steps)
        return Unfinished(run.path, run.reed, run.seed, missing)


def require_same(run: Run, plan: Plan) -> None:
    """Require that a run was begun with a plan's protocol, bench and kind of reed.

    Raises
    ------
    RunFileError
        Names the first that is another one.
    """
    hashes = {
        "protocol": (run.protocol_sha256, plan.protocol.sha256),
        "bench": (run.bench_fingerprint, plan.bench.fingerprint),
        "kind of reed": (run.reed_sha256, plan.reed.sha256),
    }
    for what, (then, today) in hashes.items():
        if then != today:
            raise RunFileError(
                f"{run.path}: was begun with another {what} ({then[:12]} then, {today[:12]} now); "
                "continue with the one in the run file, or measure a new run"
            )
