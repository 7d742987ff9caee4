"""Many reeds fitted together: from a table of resonances, or from a folder of run files."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fitting.acoustics.lines import AcousticLine, SweepPeaks, Verdict, acoustic_lines
from fitting.cane.fit_runs import (
    FIT_SWEEP,
    MethodName,
    ModelName,
    require_model,
)
from fitting.cane.sweep_fit import SweepFit
from fitting.errors import FitError, FitInputError
from fitting.forward import basis_of, finite_element_model
from fitting.paper.constants import adjusted_metamodel
from fitting.populations.flags import Flag, PopulationFit, count_flags
from fitting.populations.population import fit_population
from fitting.populations.resonance_table import Resonances, read_resonances
from physics.reed.cane.viscoelastic import Series
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduction.log_polynomial import finite_element_polynomial
from physics.reed.reduction.metamodel import Metamodel
from protocols.reed import ReedFile
from runs.errors import RunFileError
from runs.reader import Run

COMPONENTS = 4
# The components of such fits do not describe the population.
_UNFIT = Flag.TOO_FEW_RESONANCES | Flag.NOT_CONVERGED


@dataclass
class PopulationSummary:
    """Statistics of a population, updated as its reeds are fitted.

    Attributes
    ----------
    reeds, resonances, passed_over : int
        Reeds, resonances used, and rows of modes that the model does not know.
    fitted : (4,) int array
        Reeds that count for each component.
    """

    reeds: int = 0
    resonances: int = 0
    passed_over: int = 0
    flags: Counter[str] = field(default_factory=Counter)
    fitted: Any = field(default_factory=lambda: np.zeros(COMPONENTS, dtype=int))
    _sums: Any = field(default_factory=lambda: np.zeros((3, COMPONENTS)))
    _squares: float = 0.0

    def add(self, resonances: Resonances, fit: PopulationFit) -> None:
        """Count a piece of the population."""
        self.reeds += len(resonances.reeds)
        self.resonances += int(fit.used.sum())
        self.passed_over += resonances.passed_over
        self.flags.update(count_flags(fit.flags))
        counted = ((fit.flags & int(_UNFIT)) == 0)[:, None] & np.isfinite(fit.components)
        known = np.where(counted, fit.components, 0.0)
        errors = np.where(counted, fit.errors, 0.0)
        self.fitted = self.fitted + counted.sum(axis=0)
        self._sums = self._sums + np.stack([known, known**2, errors**2]).sum(axis=1)
        used = np.isfinite(fit.rms_cents)
        self._squares += float((fit.rms_cents[used] ** 2 * fit.used[used]).sum())

    def to_json(self) -> dict[str, Any]:
        """Return the summary with stable keys (documented in ``docs/reference/json.md``)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = self._sums[0] / self.fitted
            sd = np.sqrt((self._sums[1] - self.fitted * mean**2) / (self.fitted - 1))
            error = np.sqrt(self._sums[2] / self.fitted)
        return {
            "reeds": self.reeds,
            "resonances": self.resonances,
            "passed_over": self.passed_over,
            "rms_cents": (self._squares / self.resonances) ** 0.5 if self.resonances else None,
            "components": {
                f"e{k + 1}": {
                    "reeds": int(self.fitted[k]),
                    "mean": _known(mean[k]),
                    "sd": _known(sd[k]),
                    "rms_error": _known(error[k]),
                }
                for k in range(COMPONENTS)
            },
            "flags": dict(self.flags),
        }


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def metamodel_of(
    model: ModelName, kind: ReedFile, announce: Callable[[str], None] | None = None
) -> Metamodel:
    """Metamodel of a kind of reed: the paper's, or polynomials that follow the finite elements.

    Raises
    ------
    FitInputError
        If the paper's is asked for another reed than its own.
    """
    require_model(model, kind)
    if model == "paper":
        return adjusted_metamodel(PAPER_MODES)
    return finite_element_polynomial(basis_of(kind, announce))


def fit_table(
    table: Path,
    metamodel: Metamodel,
    record: Callable[[tuple[str, ...], PopulationFit], None],
    progress: Callable[[int], None] | None = None,
) -> PopulationSummary:
    """Fit every reed of a table of resonances, some thousands of reeds at a time.

    Parameters
    ----------
    table : Path
        See `fitting.populations.resonance_table`.
    metamodel : Metamodel
    record : callable
        Receives the names of n reeds and their fits, piece by piece.
    progress : callable, optional
        Called with the number of reeds fitted so far.

    Raises
    ------
    FitInputError
        For a table that cannot be read, or an empty one.
    """
    summary = PopulationSummary()
    for resonances in read_resonances(table, metamodel.modes):
        fit = fit_population(resonances.cents, resonances.error_cents, metamodel)
        summary.add(resonances, fit)
        record(resonances.reeds, fit)
        if progress:
            progress(summary.reeds)
    if not summary.reeds:
        raise FitInputError(f"{table}: holds no resonances; it has nothing but its first line")
    return summary


@dataclass(frozen=True)
class Measured:
    """What the runs of a folder have in common.

    Attributes
    ----------
    kind : ReedFile
        Kind of reed.
    sweeps : tuple of (SweepFit, Path)
        Fits that show modes, and the runs that they are of, relative to the folder.
    reeds : int
        How many show modes.
    acoustic_lines : tuple of AcousticLine, optional
        Excitation peaks that stay at the same frequency from reed to reed. None if the method does
        not look for them.
    """

    kind: ReedFile
    sweeps: tuple[tuple[SweepFit, Path], ...]
    reeds: int
    acoustic_lines: tuple[AcousticLine, ...] | None

    def to_json(self) -> list[dict[str, Any]] | None:
        """Return the lines with stable keys (documented in ``docs/reference/json.md``)."""
        if self.acoustic_lines is None:
            return None
        return [line.to_json() for line in self.acoustic_lines]


def measure_resonances(
    folder: Path,
    announce: Callable[[str], None] | None = None,
    method: MethodName = "joint",
) -> Measured:
    """Find the resonances of every complete run of a folder.

    Runs of series other than A and B, runs that show no modes, and files that are no runs or
    damaged are reported and left out; of two runs of one reed and series the later counts.

    Parameters
    ----------
    folder : Path
    announce : callable, optional
        Receives a line of text about each run.
    method : MethodName

    Raises
    ------
    FitInputError
        If no run gives resonances, or the runs are of several kinds of reeds.
    """
    say = announce or (lambda _: None)
    latest = _latest_runs(folder, say)
    kind = _kind_of(folder, latest)
    reed = basis_of(kind, say)
    model = finite_element_model(reed)
    sweeps: list[tuple[SweepFit, Path]] = []
    peaks: list[SweepPeaks] = []
    for number, path in enumerate(latest, 1):
        say(f"run {number} of {len(latest)}: {path}")
        try:
            with Run.open(path) as run:
                sweep = FIT_SWEEP[method](run, reed, model)
        except (FitError, RunFileError) as error:
            say(f"{path}: passed over: {str(error).removeprefix(f'{path}: ')}")
            continue
        if sweep.resonances:
            sweeps.append((sweep, path.relative_to(folder)))
        peaks.append(sweep.drive_peaks)
    if not sweeps:
        raise FitInputError(f"{folder}: no run of series A or B in it shows resonances")
    common = (
        tuple(line for line in acoustic_lines(peaks) if line.verdict is Verdict.BENCH)
        if method == "joint"
        else None
    )
    return Measured(kind, tuple(sweeps), len({each.reed for each in peaks}), common)


def _kind_of(folder: Path, runs: Sequence[Path]) -> ReedFile:
    """Kind of reed of all runs; a population is of one."""
    kinds: dict[str, tuple[ReedFile, Path]] = {}
    for path in runs:
        with Run.open(path) as run:
            kind = run.reed_file()
        kinds.setdefault(kind.sha256, (kind, path))
    if not kinds:
        raise FitInputError(f"{folder}: no run of series A or B in it is complete")
    if len(kinds) > 1:
        named = ", ".join(f"{kind.name} in {path.name}" for kind, path in kinds.values())
        raise FitInputError(
            f"{folder}: holds runs of several kinds of reeds ({named}); give each kind a folder"
        )
    return next(iter(kinds.values()))[0]


def _latest_runs(folder: Path, say: Callable[[str], None]) -> list[Path]:
    """Complete runs by reed and series."""
    latest: dict[tuple[str, str], tuple[str, Path]] = {}
    for path in sorted(folder.rglob("*.h5")):
        try:
            with Run.open(path) as run:
                key, start, status = (run.reed, run.series), run.start_time, run.status
        except RunFileError as error:
            say(str(error))
            continue
        if status != "complete" or key[1] not in set(Series):
            say(f"{path}: {status}, series {key[1]}: passed over")
            continue
        if key in latest:
            say(f"{min(latest[key], (start, path))[1]}: there is a later run of that reed")
        latest[key] = max(latest.get(key, (start, path)), (start, path))
    return [path for _, (_, path) in sorted(latest.items())]
