"""Check that a run can be continued: same protocol, bench file and reed file as at its start."""

from dataclasses import dataclass
from pathlib import Path

from protocols.plan import Plan
from runs.errors import RunFileError
from runs.reader import Run


@dataclass(frozen=True)
class Unfinished:
    """A run that can be continued.

    Attributes
    ----------
    path : Path
    reed : str
        Name of the reed.
    seed : int
        Seed of the simulated bench.
    missing : int
        Number of steps that are not measured yet.
    """

    path: Path
    reed: str
    seed: int
    missing: int


def unfinished(path: str | Path, plan: Plan) -> Unfinished:
    """Check that a run is not complete and was begun with a plan, so that it can be continued.

    Parameters
    ----------
    path : str or Path
        Path of the run file.
    plan : Plan

    Returns
    -------
    Unfinished

    Raises
    ------
    RunFileError
        If the run is complete, or was begun with another protocol, bench or reed file: a sweep
        whose halves differ cannot be used.
    """
    # A damaged step counts as pending, so that it is measured again.
    with Run.open(path, damaged_as_pending=True) as run:
        if run.status == "complete":
            raise RunFileError(f"{path}: is complete; measure a new run")
        require_same(run, plan)
        missing = sum(not step.verdict.measured for step in run.steps)
        return Unfinished(run.path, run.reed, run.seed, missing)


def require_same(run: Run, plan: Plan) -> None:
    """Raise an error unless a run was begun with the protocol, bench and reed file of a plan.

    Raises
    ------
    RunFileError
        If one of them differs; names the first.
    """
    hashes = {
        "protocol": (run.protocol_sha256, plan.protocol.sha256),
        "bench": (run.bench_fingerprint, plan.bench.fingerprint),
        "kind of reed": (run.reed_sha256, plan.reed.sha256),
    }
    for what, (run_hash, plan_hash) in hashes.items():
        if run_hash != plan_hash:
            raise RunFileError(
                f"{run.path}: was begun with another {what} ({run_hash[:12]} then, "
                f"{plan_hash[:12]} now); continue with the one in the run file, or measure a new "
                "run"
            )
