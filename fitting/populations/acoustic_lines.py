"""Find the acoustic resonances of a bench from the run files of several reeds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fitting.acoustics.lines import AcousticLine, SweepPeaks, acoustic_lines
from fitting.cane.fit_runs import fit_sweep_jointly
from fitting.errors import FitError, FitInputError
from fitting.forward import ForwardModel, basis_of, finite_element_model
from physics.reed.reduced.reed import ReducedReed
from runs.reader import Run


@dataclass(frozen=True)
class RunPeaks:
    """Excitation peaks of one run.

    Attributes
    ----------
    path : Path
    series : str
    peaks : SweepPeaks
    """

    path: Path
    series: str
    peaks: SweepPeaks

    def to_json(self) -> dict[str, Any]:
        """Return the peaks with stable keys."""
        return {
            "path": str(self.path),
            "reed": self.peaks.reed,
            "series": self.series,
            "low_hz": self.peaks.low_hz,
            "high_hz": self.peaks.high_hz,
            "peaks": [seen.to_json() for seen in self.peaks.peaks],
        }


@dataclass(frozen=True)
class MeasuredLines:
    """Acoustic lines of several runs.

    Attributes
    ----------
    runs : tuple of RunPeaks
    lines : tuple of AcousticLine
        In order of frequency.
    passed_over : dict
        Reasons why runs could not be fitted, by path.
    """

    runs: tuple[RunPeaks, ...]
    lines: tuple[AcousticLine, ...]
    passed_over: dict[Path, str]

    @property
    def reeds(self) -> int:
        """Number of reeds that could be fitted."""
        return len({run.peaks.reed for run in self.runs})

    def to_json(self) -> dict[str, Any]:
        """Return all lines with stable keys (documented in ``docs/reference/json.md``)."""
        return {
            "reeds": self.reeds,
            "lines": [line.to_json() for line in self.lines],
            "runs": [run.to_json() for run in self.runs],
            "passed_over": [
                {"path": str(path), "reason": reason} for path, reason in self.passed_over.items()
            ],
        }


def measure_acoustic_lines(
    paths: Sequence[Path], announce: Callable[[str], None] | None = None
) -> MeasuredLines:
    """Fit runs of several reeds, and group the resonances of their drives into lines.

    Runs that cannot be fitted are reported and left out.

    Parameters
    ----------
    paths : sequence of Path
        Run files of one bench.
    announce : callable, optional
        Receives a line of text about each run.

    Raises
    ------
    FitInputError
        If a run is named twice, or the runs are of different benches.
    FitError
        If no run can be fitted.
    RunFileError
        If a file cannot be read.
    """
    say = announce or (lambda _: None)
    _require_one_bench(paths)
    models: dict[str, tuple[ReducedReed, ForwardModel]] = {}
    found: list[RunPeaks] = []
    passed_over: dict[Path, str] = {}
    for number, path in enumerate(paths, 1):
        say(f"run {number} of {len(paths)}: {path}")
        with Run.open(path) as run:
            kind = run.reed_file()
            if kind.sha256 not in models:
                reed = basis_of(kind, say)
                models[kind.sha256] = reed, finite_element_model(reed)
            try:
                sweep = fit_sweep_jointly(run, *models[kind.sha256])
            except FitError as error:
                passed_over[path] = str(error).removeprefix(f"{path}: ")
                say(f"{path}: passed over: {passed_over[path]}")
                continue
        found.append(RunPeaks(path, sweep.series, sweep.drive_peaks))
    if not found:
        raise FitError(
            f"none of {len(paths)} runs can be fitted; `acquire fit RUN` says why for each"
        )
    lines = acoustic_lines([run.peaks for run in found])
    return MeasuredLines(tuple(found), tuple(lines), passed_over)


def _require_one_bench(paths: Sequence[Path]) -> None:
    """Refuse runs that are named twice, and runs of different benches."""
    benches: dict[str, Path] = {}
    files: set[Path] = set()
    for path in paths:
        if path.resolve() in files:
            raise FitInputError(f"{path}: named twice; name each run once")
        files.add(path.resolve())
        with Run.open(path) as run:
            benches.setdefault(run.bench_name, path)
    if len(benches) > 1:
        (one, first), (other, second) = list(benches.items())[:2]
        raise FitInputError(
            f"{first} was measured on {one!r} and {second} on {other!r}; acoustic lines belong to "
            "one bench: give runs of one bench"
        )
