"""Diagnose from Python: where measurement and simulation differ, and why."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from acquire.adopting import require_adoptable, write_known
from acquire.measurement import bench_file
from acquire.results.diagnosis import DiagnosisResult, ResonanceDiagnosisResult
from acquire.runner.callbacks import Announce, Progress, ignore
from diagnosis.campaign import Campaign
from diagnosis.campaign_diagnosis import Diagnosis
from diagnosis.campaign_diagnosis import diagnose as judge
from diagnosis.known_bench import known_effects_of
from diagnosis.mean_reed import printed_reeds, tabled_reeds
from diagnosis.observe import read
from diagnosis.resonance_diagnosis import diagnose_resonances as judge_resonances
from fitting.errors import FitError, FitInputError
from fitting.known_bench import bench_of
from physics.effects.catalogue import CATALOGUE
from physics.errors import ImpossibleReedError
from physics.mechanics import ReedSolver
from physics.reed.geometry import is_even
from physics.reed.reduced.stored import reduced_reed
from protocols.bench import BenchFile
from reports.diagnosis_page import page_output, write_page
from reports.next_campaign import next_outputs, require_repeatable, write_next
from reports.own_output import Output, require_writable
from runs.reader import Run


def diagnose(
    *runs: str | Path,
    bench: str | Path | BenchFile | None = None,
    out: str | Path | None = None,
    next_campaign: str | Path | None = None,
    adopt: str | Path | None = None,
    announce: Announce = ignore,
    progress: Progress = ignore,
) -> DiagnosisResult:
    """Find where measurement and simulation differ, and the likeliest cause.

    Parameters
    ----------
    *runs : str or path
        Run files of one reed in one series, or folders of run files.
    bench : str, path or BenchFile, optional
        Bench file whose section ``known:`` lists known effects; by default that of `adopt`, or
        else that in the runs.
    out : str or path, optional
        HTML page to write.
    next_campaign : str or path, optional
        Campaign file to write, which would best separate the likeliest causes.
    adopt : str or path, optional
        Bench file of the runs. The effects that are named are written into its section ``known:``.
    announce, progress : callable, optional

    Returns
    -------
    DiagnosisResult

    Raises
    ------
    FitInputError
        If there are no runs, or they do not belong together.
    FitError
        If no reed of the kind is near what the runs show.
    OutputRefusedError
        If a file would replace one that is not of the same kind.
    UsageError
        If effects cannot be written into the bench file `adopt`.
    """
    bench = adopt if bench is None else bench
    described = None if bench is None else bench_file(bench)
    files = [file for path in runs for file in _run_files(Path(path))]
    if not files:
        raise FitInputError("no data: give run files or folders of run files")
    outputs = _Outputs(
        *(None if each is None else Path(each) for each in (out, next_campaign, adopt))
    )
    bench_files = [Path(bench)] if isinstance(bench, str | Path) else []
    require_writable(outputs.made(), [*files, *bench_files])
    with ExitStack() as opened:
        campaign = Campaign.of([opened.enter_context(Run.open(file)) for file in files])
        first = campaign.sweeps[0].run
        outputs.require_suited(first, described)
        verdict = _verdict(campaign, described, announce, progress)
        result = DiagnosisResult(verdict, tuple(files), first.reed)
        protocol_text = first.protocol_text
    return outputs.written(result, protocol_text)


@dataclass(frozen=True)
class _Outputs:
    """Files that a diagnosis writes; None for what was not asked for."""

    page: Path | None
    following: Path | None
    bench: Path | None

    def made(self) -> list[Output]:
        """Return the files that are made, of which the bench file is none."""
        page = [] if self.page is None else [page_output(self.page)]
        return page if self.following is None else [*page, *next_outputs(self.following)]

    def require_suited(self, first: Run, used: BenchFile | None) -> None:
        """Refuse what cannot be written for these runs."""
        if self.following is not None:
            require_repeatable(first, self.following)
        if self.bench is not None:
            require_adoptable(self.bench, used, bench_of(first))

    def written(self, result: DiagnosisResult, protocol_text: str) -> DiagnosisResult:
        """Write everything, and return the result with what the bench file has got."""
        verdict, runs = result.verdict, [file.name for file in result.runs]
        if self.page is not None:
            write_page(verdict, result.title, self.page, runs)
        if self.following is not None:
            best = verdict.next_experiments
            write_next(best, verdict.compared, protocol_text, result.reed, self.following)
        if self.bench is None:
            return result
        # Last: the file may have got the same effect meanwhile, and nothing else is lost then.
        return replace(result, adopted=write_known(verdict, self.bench, result.reed))


def _verdict(
    campaign: Campaign, bench: BenchFile | None, announce: Announce, progress: Progress
) -> Diagnosis:
    """Fit the sweeps of a campaign, then the causes."""
    first = campaign.sweeps[0].run
    described, known = bench or bench_of(first), known_effects_of(first, bench)
    geometry = first.reed_file().geometry()
    if not is_even(geometry):
        raise FitError(
            f"{first.path}: the thickness map of its reed is not even in y, which a diagnosis "
            "assumes; give either side of the map the mean of both"
        )
    solver = ReedSolver(reduced_reed(geometry, announce=announce), announce)
    readings = read(campaign, described, lambda done: progress("fitting sweeps", done))
    try:
        return judge(
            readings,
            solver,
            readings.nominal,
            known,
            lambda done: progress("fitting causes", done),
        )
    except ImpossibleReedError as error:
        raise FitError(
            f"{first.path}: no reed of its kind is near what its campaign shows ({error}); check "
            "the reed, the series and the bench file"
        ) from error


def diagnose_resonances(
    table: str | Path | None = None, *, announce: Announce = ignore, progress: Progress = ignore
) -> ResonanceDiagnosisResult:
    """Find the likeliest cause of the gap between resonances and the elastic model of a reed.

    Parameters
    ----------
    table : str or path, optional
        CSV table of resonances of clarinet reeds; by default, Table 1 of the paper.
    announce, progress : callable, optional

    Returns
    -------
    ResonanceDiagnosisResult

    Raises
    ------
    FitInputError
        If the table cannot be used, or no clarinet reed has resonances near its values.
    """
    reeds = tabled_reeds(Path(table), announce) if table else printed_reeds()
    solver = ReedSolver(reduced_reed(announce=announce), announce)
    try:
        return ResonanceDiagnosisResult(
            judge_resonances(
                reeds, solver, CATALOGUE, lambda done: progress("fitting causes", done)
            )
        )
    except ImpossibleReedError as error:
        raise FitInputError(
            f"{table or 'Table 1'}: no clarinet reed has resonances near these ({error}); check "
            "frequencies and names of modes"
        ) from error


def _run_files(path: Path) -> list[Path]:
    """Return the run files of a folder, or the file that is named.

    Raises
    ------
    FitInputError
        If a folder has none.
    """
    files = sorted(path.glob("*.h5")) if path.is_dir() else [path]
    if not files:
        raise FitInputError(f"{path}: holds no run files (*.h5)")
    return files
