"""Many reeds fitted together: from a table of resonances, or from a folder of run files."""

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from rich.table import Table

from acquire.errors import RunFileError
from acquire.own_output import Output, replacing, table_kind
from acquire.plain_text import one_line
from acquire.reed_file import ReedFile
from acquire.runfile import Run
from fitting.errors import FitError, FitInputError
from fitting.fit import FIT_SWEEP, MethodName, ModelName, SweepFit, require_model
from fitting.forward import basis_of, finite_element_model
from fitting.lines import Line, common_lines
from fitting.paper import adjusted_metamodel
from fitting.populations import Flag, PopulationFit, count_flags, fit_population
from fitting.resonance_table import (
    COLUMNS,
    ERROR_COLUMN,
    RUN_COLUMN,
    Resonances,
    component_columns,
    read_resonances,
    write_components,
)
from physics.reed.log_polynomial import finite_element_polynomial
from physics.reed.metamodel import Metamodel
from physics.reed.names import PAPER_MODES
from physics.reed.viscoelastic import Series

_COUNT = 4
# With the run of each resonance: a table with these columns is not one that a person typed.
_RESONANCE_COLUMNS = (*COLUMNS, ERROR_COLUMN, RUN_COLUMN)
_RESONANCES = table_kind("resonances", _RESONANCE_COLUMNS)
_COMPONENTS = table_kind("components", component_columns(_COUNT))
# The components of such fits do not describe the population.
_UNFIT = Flag.TOO_FEW_RESONANCES | Flag.NOT_CONVERGED


@dataclass
class PopulationSummary:
    """What is told of a population; grows as its reeds are fitted.

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
    fitted: Any = field(default_factory=lambda: np.zeros(_COUNT, dtype=int))
    _sums: Any = field(default_factory=lambda: np.zeros((3, _COUNT)))
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
        """Return the summary with stable keys (documented in ``docs/json.md``)."""
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
                for k in range(_COUNT)
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


def components_output(path: Path) -> Output:
    """Table of the components of every reed."""
    return Output(path, _COMPONENTS)


def resonances_output(path: Path) -> Output:
    """Table of the resonances of a folder's runs."""
    return Output(path, _RESONANCES, None)


@contextmanager
def opened_table(output: Output) -> Iterator[TextIO]:
    """Open a table for writing; it appears whole or not at all.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        If it must not or cannot be written.
    """
    with replacing(output) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        yield text
        # Hands over what it holds, and leaves the file open.
        text.detach()


def fit_table(
    table: Path,
    metamodel: Metamodel,
    out: TextIO,
    progress: Callable[[int], None] | None = None,
) -> PopulationSummary:
    """Fit every reed of a table of resonances and write its components.

    Parameters
    ----------
    table : Path
        See `fitting.resonance_table`.
    metamodel : Metamodel
    out : text file
        Takes a row for every reed.
    progress : callable, optional
        Told the number of reeds fitted so far.

    Raises
    ------
    FitInputError
        For a table that cannot be read, or an empty one.
    """
    summary = PopulationSummary()

    def pieces() -> Iterator[tuple[tuple[str, ...], PopulationFit]]:
        for resonances in read_resonances(table, metamodel.modes):
            fit = fit_population(resonances.cents, resonances.error_cents, metamodel)
            summary.add(resonances, fit)
            yield resonances.reeds, fit
            if progress:
                progress(summary.reeds)

    write_components(out, pieces(), _COUNT)
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
    reeds : int
        How many show modes.
    lines : tuple of Line, optional
        What stays at the same frequency from reed to reed, and how many reeds show it: the air's.
        None if the method does not look for it.
    """

    kind: ReedFile
    reeds: int
    lines: tuple[Line, ...] | None

    def to_json(self) -> list[dict[str, Any]] | None:
        """Return the lines with stable keys (documented in ``docs/json.md``)."""
        if self.lines is None:
            return None
        return [asdict(line) for line in self.lines]


def write_resonances(
    folder: Path,
    table: Path,
    announce: Callable[[str], None] | None = None,
    method: MethodName = "joint",
) -> Measured:
    """Find the resonances of every complete run of a folder and write them as a table.

    Runs of series other than A and B, runs that show no modes, files that are no runs or damaged
    are told and passed over; of two runs of one reed and series the later counts.

    Raises
    ------
    FitInputError
        If no run gives resonances, or the runs are of several kinds of reeds.
    OutputRefusedError, OutputFailedError
        If the table must not or cannot be written.
    """
    tell = announce or (lambda _: None)
    latest = _latest_runs(folder, tell)
    kind = _kind_of(folder, latest)
    reed = basis_of(kind, tell)
    model = finite_element_model(reed)
    rows: list[tuple[str, ...]] = []
    # Those of both series of a reed are one reed's.
    lines: dict[str, list[Line]] = {}
    for number, path in enumerate(latest, 1):
        tell(f"run {number} of {len(latest)}: {path}")
        try:
            with Run.open(path) as run:
                sweep = FIT_SWEEP[method](run, reed, model)
        except (FitError, RunFileError) as error:
            tell(f"{path}: passed over: {str(error).removeprefix(f'{path}: ')}")
            continue
        rows += _rows(sweep, path.relative_to(folder))
        lines.setdefault(sweep.reed, []).extend(sweep.lines)
    if not rows:
        raise FitInputError(f"{folder}: no run of series A or B in it shows resonances")
    with opened_table(resonances_output(table)) as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(_RESONANCE_COLUMNS)
        out.writerows(rows)
    if method != "joint":
        return Measured(kind, len(lines), None)
    return Measured(kind, len(lines), tuple(common_lines(list(lines.values()))))


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
        told = ", ".join(f"{kind.name} in {path.name}" for kind, path in kinds.values())
        raise FitInputError(
            f"{folder}: holds runs of several kinds of reeds ({told}); give each kind a folder"
        )
    return next(iter(kinds.values()))[0]


def _latest_runs(folder: Path, tell: Callable[[str], None]) -> list[Path]:
    """Complete runs by reed and series."""
    latest: dict[tuple[str, str], tuple[str, Path]] = {}
    for path in sorted(folder.rglob("*.h5")):
        try:
            with Run.open(path) as run:
                key, start, status = (run.reed, run.series), run.start_time, run.status
        except RunFileError as error:
            tell(str(error))
            continue
        if status != "complete" or key[1] not in set(Series):
            tell(f"{path}: {status}, series {key[1]}: passed over")
            continue
        if key in latest:
            tell(f"{min(latest[key], (start, path))[1]}: there is a later run of that reed")
        latest[key] = max(latest.get(key, (start, path)), (start, path))
    return [path for _, (_, path) in sorted(latest.items())]


def _rows(sweep: SweepFit, run: Path) -> list[tuple[str, ...]]:
    # Names of files may hold bytes that are not UTF-8.
    source = one_line(str(run))
    found = sweep.resonances.items()
    cells = ((name, f"{one.frequency_hz:.3f}", f"{one.error_cents:.4g}") for name, one in found)
    return [(sweep.reed, sweep.series, *own, source) for own in cells]


def summary_table(summary: PopulationSummary) -> Table:
    """What the command line shows of a population."""
    told = summary.to_json()
    rms = "" if told["rms_cents"] is None else f", rms {told['rms_cents']:.1f} cents"
    table = Table(title=f"{summary.reeds} reeds, {summary.resonances} resonances{rms}")
    for head in ("component", "reeds", "mean", "SD", "± s.e. (rms)"):
        table.add_column(head, justify="right")
    for name, row in told["components"].items():
        values = (row["mean"], row["sd"], row["rms_error"])
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        table.add_row(name, str(row["reeds"]), *shown)
    return table


def remarks(summary: PopulationSummary, measured: Measured | None = None) -> list[str]:
    """What is to be said beside the table, of a folder's runs too if they were measured."""
    lines = (measured.lines if measured else None) or ()
    of_all = measured.reeds if measured else 0
    said = [
        f"line of the air at {line.hz:.0f} Hz, {line.height_db:+.1f} dB: {line.reeds} of {of_all} "
        "reeds show it, it is none of theirs"
        for line in lines
    ]
    if summary.passed_over:
        said.append(f"{summary.passed_over} resonances of modes that the model does not know")
    flags = summary.flags.items()
    return [*said, *(f"{count} reeds: {flag.lower().replace('_', ' ')}" for flag, count in flags)]
