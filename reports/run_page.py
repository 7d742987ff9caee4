"""The HTML page of one or more runs, and its pictures as files next to it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from fitting.cane.sweep_fit import ReedFit, SweepFit
from reports.figures.drawing import contact_sheet, png_of, response_plot
from reports.figures.joint_drawing import mode_sheet
from reports.fit_tables import parameters_table, remarks, resonances_table
from reports.own_output import (
    Output,
    page_kind,
    picture_kind,
    require_writable,
    write_output,
)
from reports.pages import Picture, render
from reports.tables import Table
from runs.reader import Run

_PAGE: Final = page_kind("report")
_PICTURES: Final = {name: picture_kind(name) for name in ("contact sheet", "response", "modes")}


def page_of(run: Path) -> Path:
    """Page of a run's report, if none is named: next to the run file."""
    return run.with_suffix(".html") if run.name else Path("report.html")


def require_report(runs: Sequence[Path], page: Path, *, measured: bool = True) -> None:
    """Refuse a report that cannot be written, before anything is measured or fitted.

    Parameters
    ----------
    runs : sequence of Path
    page : Path
    measured : bool
        Whether the runs are there already. If not, the folder of the page need not be there.

    Raises
    ------
    OutputRefusedError
        If the page or a picture must not or cannot be written.
    RunFileError
        If a run cannot be read.
    """
    series = [_series_of(run) for run in runs] if measured else ["" for _ in runs]
    # A set, because a run that is named twice is refused by the fit, which says why.
    pictures = {
        _picture_output(page, stem, name) for stem in _stems(runs, series) for name in _PICTURES
    }
    require_writable([Output(page, _PAGE), *pictures], runs, makes_folder=not measured)


def _series_of(path: Path) -> str:
    with Run.open(path) as run:
        return run.series


def _stems(runs: Sequence[Path], series: Sequence[str]) -> list[str]:
    """What the names of each run's pictures begin with; with the series if names are equal."""
    stems = [run.stem for run in runs]
    if len(set(stems)) == len(stems):
        return stems
    # A file may give its series any name.
    kept = ["".join(c if c.isalnum() else "-" for c in one) for one in series]
    return [f"{stem}-{one}" for stem, one in zip(stems, kept, strict=True)]


def _picture_output(page: Path, stem: str, name: str) -> Output:
    return Output(page.with_name(f"{stem}.{name.replace(' ', '-')}.png"), _PICTURES[name])


def write_report(fit: ReedFit, page: Path) -> dict[str, Path]:
    """Write the page, and next to it the contact sheet, response plot and modes of every run.

    Parameters
    ----------
    fit : ReedFit
    page : Path
        An older report there is replaced, and nothing else.

    Returns
    -------
    dict
        What was written, by name.

    Raises
    ------
    RunFileError
        If a run cannot be read.
    OutputRefusedError, OutputFailedError
        If the page or a picture must not or cannot be written.
    """
    runs = [sweep.path for sweep in fit.sweeps]
    require_report(runs, page)
    files, sections = {"report": page}, []
    stems = _stems(runs, [sweep.series for sweep in fit.sweeps])
    for stem, sweep in zip(stems, fit.sweeps, strict=True):
        with Run.open(sweep.path) as run:
            figures = _figures(sweep, run)
            facts = _facts(run)
        pictures = []
        for name, figure in figures.items():
            output = _picture_output(page, stem, name)
            png = png_of(figure, software=output.kind.mark)
            label = name if len(fit.sweeps) == 1 else f"{name} {sweep.series}"
            files[label] = output.path
            write_output(output, png)
            pictures.append(_picture(name, png))
        sections.append(_section(sweep, fit, facts, pictures))
    series = " and ".join(sweep.series for sweep in fit.sweeps)
    title = f"Reed {fit.sweeps[0].reed}, series {series}"
    text = render("run.html", _PAGE, title, no_fit="", cane=_cane(fit), sweeps=sections)
    write_output(Output(page, _PAGE), text)
    return files


def _figures(sweep: SweepFit, run: Run) -> dict[str, Figure]:
    peaks_hz = _peaks_hz(sweep, run)
    figures = {
        "contact sheet": contact_sheet(run, sweep.measured, peaks_hz),
        "response": response_plot(sweep, peaks_hz),
    }
    if sweep.joint:
        figures["modes"] = mode_sheet(sweep.joint, sweep.measured)
    return figures


def _peaks_hz(sweep: SweepFit, run: Run) -> Sequence[float]:
    """Excitation peaks that a joint fit found, else those that the bench file lists."""
    return (
        [seen.peak.hz for seen in sweep.excitation_peaks]
        if sweep.joint
        else run.acoustic_resonances_hz
    )


def write_bare_report(runs: Sequence[Path], page: Path, reason: str) -> dict[str, Path]:
    """Write a page about runs that cannot be fitted: facts and contact sheets, and why.

    Parameters
    ----------
    runs : sequence of Path
    page : Path
        An older report there is replaced, and nothing else.
    reason : str
        Why there is no fit.

    Returns
    -------
    dict
        What was written, by name.

    Raises
    ------
    RunFileError
        If a run cannot be read.
    OutputRefusedError, OutputFailedError
        If the page must not or cannot be written.
    """
    require_writable([Output(page, _PAGE)], runs)
    reeds, sections = [], []
    for path in runs:
        with Run.open(path) as run:
            reeds.append(run.reed)
            sheet = png_of(contact_sheet(run, {}, run.acoustic_resonances_hz))
            title = f"Reed {run.reed}, series {run.series}"
            sections.append(_Section(title, _facts(run), [_picture("contact sheet", sheet)]))
    text = render("run.html", _PAGE, f"Reed {reeds[0]}", no_fit=reason, cane=None, sweeps=sections)
    write_output(Output(page, _PAGE), text)
    return {"report": page}


@dataclass(frozen=True)
class _Section:
    """What the page shows of one run."""

    title: str
    facts: list[tuple[str, str]]
    pictures: list[Picture]
    table: Table | None = None
    remarks: Sequence[str] = ()


def _section(
    sweep: SweepFit, fit: ReedFit, facts: list[tuple[str, str]], pictures: list[Picture]
) -> _Section:
    residual = fit.parameters.residual_cents.get(sweep.series, {}) if fit.parameters else {}
    table = replace(resonances_table(sweep, residual), title="")
    return _Section(
        f"Series {sweep.series}: resonances", facts, pictures, table, remarks(sweep)
    )  # fmt: skip


@dataclass(frozen=True)
class _Cane:
    """What the page shows of the cane's parameters, or why there are none."""

    table: Table | None
    warnings: Sequence[str]


def _cane(fit: ReedFit) -> _Cane:
    table = parameters_table(fit)
    if fit.parameters is None or table is None:
        return _Cane(None, [f"No parameters: {fit.reason}"])
    unphysical = [
        "The fitted model has a spring with a negative constant: do not use these parameters."
    ]
    return _Cane(replace(table, title=""), [] if fit.parameters.physical else unphysical)


def _facts(run: Run) -> list[tuple[str, str]]:
    """Return what a run is, who took it, and how it went."""
    labels, good = run.labels, int(run.good.sum())
    facts = [
        ("protocol", run.title),
        ("bench", run.bench_name),
        ("start", run.start_time),
        ("strength", "" if labels.strength is None else f"{labels.strength:g}"),
        ("steps", f"{good} of {len(run)} steps good"),
        ("status", run.status),
        ("run file", run.path.name),
        ("operator", labels.operator),
        ("note", labels.note),
    ]
    return [(word, text) for word, text in facts if text]


_SHOWS: Final = {
    "contact sheet": (
        "Image of the vibrating reed at every step of the sweep",
        "Brightness is the amplitude of the light that the vibration shifted. Each image has the "
        "number of its step; modes and excitation peaks have coloured frames. The picture "
        "of a mode states its displacement at resonance in nm. Tip down.",
    ),
    "response": (
        "Amplitude of every mode against drive frequency",
        "Displacement of the reed, and of each mode, where it moves most: from rest to the largest "
        "deflection, half of peak to peak. Points mark the resonances; dotted lines the "
        "displacements at which the image of the first sideband is brightest.",
    ),
    "modes": (
        "Hologram, fitted shape and residual of every mode",
        "For each mode: the hologram nearest to its resonance, the shape that was fitted to all "
        "holograms with its displacement in nm, and the residual of the fit.",
    ),
}


def _picture(name: str, png: bytes) -> Picture:
    alt, caption = _SHOWS[name]
    return Picture(png, alt, caption, wide=True)
