"""Analyse from Python: resonances, cane, modes and populations."""

from collections.abc import Callable, Mapping
from pathlib import Path

from acquire.errors import UsageError
from acquire.results.analysis import (
    AcousticsResult,
    FitResult,
    ModesResult,
    PopulationResult,
)
from acquire.runner.callbacks import Announce, Progress, ignore
from fitting.cane.fit_runs import fit_runs, method_name, model_name
from fitting.populations.acoustic_lines import measure_acoustic_lines
from fitting.populations.table import fit_table, metamodel_of
from fitting.reed_modes import BASIS, changed, mesh_level, modes_by_basis, modes_of
from protocols.reed import DEFAULT_REED, ReedFile
from reports.own_output import require_writable
from reports.population_tables import (
    components_output,
    opened_table,
    resonances_output,
    write_components,
    write_resonances,
)


def fit(
    *runs: str | Path, method: str = "joint", model: str = "fem", announce: Announce = ignore
) -> FitResult:
    """Find the resonances of a reed in its runs, and fit its material parameters.

    Parameters
    ----------
    *runs : str or path
        One run file, or the run files of series A and B of one reed.
    method : {'joint', 'picture'}
        One fit of all holograms, or the method of the paper.
    model : {'fem', 'paper'}
        Model of the reed: finite elements, or Table 9 of the paper.
    announce : callable, optional
        Called with one line before each long computation.

    Returns
    -------
    FitResult

    Raises
    ------
    FitError
        If a run shows no modes.
    FitInputError
        If there is no such method or model, or the runs do not belong together.
    RunFileError
        If a file cannot be read.
    """
    return FitResult(fit_runs(list(runs), model_name(model), announce, method_name(method)))


def acoustics(*runs: str | Path, announce: Announce = ignore) -> AcousticsResult:
    """Find the acoustic resonances of a bench from the runs of several reeds.

    Parameters
    ----------
    *runs : str or path
        Run files of one bench: three reeds or more decide what belongs to the bench.
    announce : callable, optional
        Called with one line about each run.

    Returns
    -------
    AcousticsResult

    Raises
    ------
    UsageError
        If no run is given.
    FitInputError
        If a run is named twice, or the runs are of different benches.
    FitError
        If no run can be fitted.
    RunFileError
        If a file cannot be read.
    """
    if not runs:
        raise UsageError("acoustics: no run is given; give the run files of several reeds")
    return AcousticsResult(measure_acoustic_lines([Path(run) for run in runs], announce))


def modes(
    reed: str | Path | ReedFile = DEFAULT_REED,
    changes: Mapping[str, str | float | None] | None = None,
    *,
    mesh: str = "fine",
    announce: Announce = ignore,
    progress: Progress = ignore,
) -> ModesResult:
    """Compute every mode of a reed below 20 kHz.

    Parameters
    ----------
    reed : str, path or ReedFile
        A reed, its file, or the name of a shipped one.
    changes : mapping, optional
        Key paths of the reed file and their values, such as ``{"cane.E_L": "13 GPa"}``. A value of
        None changes nothing.
    mesh : {'fine', 'standard', 'fast', 'basis'}
        Mesh of the finite elements. ``basis`` answers at once after a reduced basis has been
        built, which takes about a minute and is kept.
    announce, progress : callable, optional

    Returns
    -------
    ModesResult

    Raises
    ------
    ProtocolError
        If the reed or the mesh is wrong, or the reed is impossible.
    """
    original = reed if isinstance(reed, ReedFile) else ReedFile.from_file(reed)
    level = None if mesh == BASIS else mesh_level(mesh)
    described = changed(original, changes or {})
    if level is None:
        found = modes_by_basis(
            described, original, announce, lambda done: progress("building a basis", done)
        )
    else:
        announce("computing the reed's modes by finite elements")
        found = modes_of(described, level)
    return ModesResult(described, tuple(found), mesh)


def population(
    source: str | Path,
    out: str | Path | None = None,
    *,
    kind: str | Path | None = None,
    model: str = "fem",
    method: str | None = None,
    announce: Announce = ignore,
    fitted: Callable[[int], None] = ignore,
) -> PopulationResult:
    """Fit the material parameters of many reeds, each with its error.

    Parameters
    ----------
    source : str or path
        CSV table of resonances (columns reed, series, mode, hz), or a folder of run files.
    out : str or path, optional
        CSV table to write, with the parameters of every reed; by default next to `source`.
    kind : str or path, optional
        Kind of reed of a table: a reed file, or the name of a shipped one. Run files contain it.
    model : {'fem', 'paper'}
    method : {'joint', 'picture'}, optional
        How to find resonances in a folder of run files.
    announce : callable, optional
        Called with one line about each run.
    fitted : callable, optional
        Called with the number of reeds that are fitted.

    Returns
    -------
    PopulationResult

    Raises
    ------
    UsageError
        If an argument does not apply to the source.
    FitInputError
        If the source holds nothing to fit.
    OutputRefusedError
        If a file would replace one that is not of the same kind.
    """
    source, forward, way = Path(source), model_name(model), method_name(method or "joint")
    _require_applicable(source, kind, method)
    table = source / "resonances.csv" if source.is_dir() else source
    target = Path(out) if out else table.with_name(f"{table.stem}-components.csv")
    components = components_output(target)
    outputs = [resonances_output(table)] if source.is_dir() else []
    require_writable([*outputs, components], [source])
    measured = write_resonances(source, table, announce, way) if source.is_dir() else None
    reed = measured.kind if measured else ReedFile.from_file(kind or DEFAULT_REED)
    with opened_table(components) as file:
        summary = fit_table(
            table,
            metamodel_of(forward, reed, announce),
            lambda reeds, fit: write_components(file, reeds, fit),
            fitted,
        )
    return PopulationResult(summary, measured, target, table if measured else None)


def _require_applicable(source: Path, kind: str | Path | None, method: str | None) -> None:
    """Refuse arguments that a folder of run files, or a table, does not take."""
    if method and not source.is_dir():
        raise UsageError("method: a table already holds resonances; leave it out")
    if kind and source.is_dir():
        raise UsageError("kind: run files say which reed they measured; leave it out")
