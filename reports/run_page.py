"""One self-contained HTML page about a run, and its pictures as files beside it."""

import base64
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from fitting.cane.fit_runs import ReedFit, SweepFit
from fitting.fringes.picking import Resonance
from reports.drawing import (
    contact_sheet,
    png_of,
    response_plot,
)
from reports.joint_drawing import mode_sheet
from reports.own_output import (
    Output,
    page_kind,
    picture_kind,
    require_writable,
    write_output,
)
from reports.plain_text import escaped
from reports.tables import not_identified_lines
from runs.reader import Run

_PAGE: Final = page_kind("report")
_PICTURES: Final = {name: picture_kind(name) for name in ("contact sheet", "response", "modes")}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 1400px;
       margin: 2rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.5rem; margin-bottom: 0.2rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; margin: 0.6rem 0; }
th, td { padding: 0.2rem 0.8rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; display: block; margin: 0.6rem 0; }
.facts { color: #555; } .warning { color: #b00020; font-weight: 600; }
.columns { display: flex; gap: 3rem; flex-wrap: wrap; align-items: flex-start; }
"""


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
    files, parts = {"report": page}, [_heading(fit), _parameters(fit)]
    stems = _stems(runs, [sweep.series for sweep in fit.sweeps])
    for stem, sweep in zip(stems, fit.sweeps, strict=True):
        with Run.open(sweep.path) as run:
            lines_hz = _lines_hz(sweep, run)
            figures = {
                "contact sheet": contact_sheet(run, sweep.resonances, lines_hz),
                "response": response_plot(sweep, lines_hz),
            }
            if sweep.joint:
                figures["modes"] = mode_sheet(sweep.joint, sweep.resonances)
            parts.append(_sweep(sweep, run, fit))
        for name, figure in figures.items():
            output = _picture_output(page, stem, name)
            picture = png_of(figure, software=output.kind.mark)
            label = name if len(fit.sweeps) == 1 else f"{name} {sweep.series}"
            files[label] = output.path
            write_output(output, picture)
            parts.append(_embedded(name, picture))
    write_output(Output(page, _PAGE), _document(fit.sweeps[0].reed, parts))
    return files


def _lines_hz(sweep: SweepFit, run: Run) -> Sequence[float]:
    """What a joint fit found of lines outweighs what the bench's description says of them."""
    return [line.hz for line in sweep.lines] if sweep.joint else run.acoustic_lines_hz


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
    parts, reeds = [f'<p class="warning">No fit: {escaped(reason)}</p>'], []
    for path in runs:
        with Run.open(path) as run:
            reeds.append(run.reed)
            title = escaped(f"Reed {run.reed}, series {run.series}")
            sheet = png_of(contact_sheet(run, {}, run.acoustic_lines_hz))
            parts.append(f"<h1>{title}</h1>{_facts(run)}{_embedded('contact sheet', sheet)}")
    write_output(Output(page, _PAGE), _document(reeds[0], parts))
    return {"report": page}


def _document(reed: str, parts: Iterable[str]) -> str:
    title = escaped(f"Reed {reed}")
    return (
        f"{_PAGE.mark}<title>{title}</title>"
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>"
    )


def _heading(fit: ReedFit) -> str:
    series = " and ".join(sweep.series for sweep in fit.sweeps)
    title = f"Reed {fit.sweeps[0].reed}, series {series}"
    return f"<h1>{escaped(title)}</h1>"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escaped(c)}</{tag}>" for c in cells) + "</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"


def _parameters(fit: ReedFit) -> str:
    """Components and moduli side by side, or why there are none."""
    if fit.parameters is None:
        return f'<h2>The cane</h2><p class="warning">No parameters: {escaped(fit.reason)}</p>'
    p = fit.parameters
    components = _table(
        ("component (population SD)", "value", "± s.e."),
        [(name, f"{e.value:+.2f}", f"{e.error:.2f}") for name, e in p.components.items()],
    )
    moduli = [
        _table(
            (f"modulus, series {series} (MPa)", "value", "± s.e."),
            [(_modulus(name), f"{e.value:.0f}", f"{e.error:.0f}") for name, e in estimates.items()],
        )
        for series, estimates in p.moduli.items()
    ]
    doubt = (
        ""
        if p.physical
        else '<p class="warning">A spring came out negative: the fit lies outside physics.</p>'
    )
    # A standard deviation, like the errors that it was added to.
    misfit = f", with {p.misfit_cents:.1f} cents added to every error" if p.misfit_cents else ""
    facts = (
        f'<p class="facts">Residual rms {p.rms_cents:.1f} cents, χ² per degree of freedom '
        f"{p.reduced_chi2:.2f}{misfit}; forward model: {escaped(p.model)}.</p>"
    )
    return (
        f'<h2>The cane</h2><div class="columns">{components}{"".join(moduli)}</div>{facts}{doubt}'
    )


def _modulus(name: str) -> str:
    return name.removesuffix("_mpa").replace("_4kHz", "′ at 4 kHz")


def _sweep(sweep: SweepFit, run: Run, fit: ReedFit) -> str:
    """Facts about one run and the table of its modes."""
    residual = fit.parameters.residual_cents.get(sweep.series, {}) if fit.parameters else {}
    jointly = sweep.joint is not None
    rows = [
        (
            name,
            f"{found.frequency_hz:.1f}",
            f"{found.error_cents:.1f}",
            *(_joint_cells(found) if jointly else ()),
            str(found.step_index),
            f"{found.amplitude_rad:.2f}",
            f"{residual[name]:+.1f}" if name in residual else "not fitted",
        )
        for name, found in sweep.resonances.items()
    ]
    more = ("loss factor", "peak response at (Hz)", "participation", "MAC") if jointly else ()
    head = (
        *("mode", "frequency (Hz)", "± cents", *more),
        *("picture", "phase amplitude (rad)", "residual (cents)"),
    )
    title = escaped(f"Series {sweep.series}: resonances")
    missing = "<br>".join(map(escaped, not_identified_lines(sweep)))
    return f'<h2>{title}</h2>{_facts(run)}{_table(head, rows)}<p class="facts">{missing}</p>'


def _joint_cells(found: Resonance) -> tuple[str, ...]:
    """What only a joint fit knows of a mode."""
    loss = "" if found.loss_factor is None else f"{found.loss_factor:.4f}"
    if found.loss_factor is not None and found.loss_error is not None:
        loss += f" ± {found.loss_factor * found.loss_error:.4f}"
    return (
        loss,
        "" if found.response_hz is None else f"{found.response_hz:.1f}",
        "" if found.participation is None else f"{found.participation:.3f}",
        "" if found.likeness is None else f"{found.likeness:.2f}",
    )


def _facts(run: Run) -> str:
    """What a run is, who took it, and how it went."""
    labels, good = run.labels, int(run.good.sum())
    strength = "" if labels.strength is None else f", strength {labels.strength:g}"
    facts = [
        f"{run.title} on the {run.bench_name}, {run.start_time}{strength}",
        f"{good} of {len(run)} steps good, status {run.status}",
        f"run file {run.path.name}",
    ]
    said_by_person = {"operator": labels.operator, "note": labels.note}
    facts += [f"{word}: {text}" for word, text in said_by_person.items() if text]
    said = "<br>".join(map(escaped, facts))
    return f'<p class="facts">{said}</p>'


def _embedded(name: str, picture: bytes) -> str:
    data = base64.b64encode(picture).decode()
    return f'<img alt="{escaped(name)}" src="data:image/png;base64,{data}">'
