"""The verbs `acquire modes` and `acquire population`."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import typer

from acquire.cli.app import AsJson, Debug, ModelOption
from acquire.cli.console import messages, results, show_json
from acquire.cli.option_group import takes_options
from acquire.errors import UsageError

# Where the options that are not constants of the cane belong in a reed file.
_KEYS: Mapping[str, str] = {
    "thickness_offset": "geometry.thickness_offset",
    "temperature": "conditions.temperature",
    "dryness": "conditions.dryness",
}


def _constant(name: str, kind: str, meaning: str) -> Any:
    """Option of an elastic constant, `--e-l` or `--E-L`; by default, the value of the reed file."""
    dashed = name.replace("_", "-")
    return typer.Option(f"--{dashed.lower()}", f"--{dashed}", metavar=kind, help=meaning)


@dataclass(frozen=True)
class ReedChanges:
    """Options of `acquire modes` that each replace one value of the reed file."""

    E_L: Annotated[
        str | None, _constant("E_L", "MODULUS", "Young modulus along the grain, such as '13 GPa'.")
    ] = None
    E_T: Annotated[str | None, _constant("E_T", "MODULUS", "Young modulus across the grain.")] = (
        None
    )
    E_R: Annotated[
        str | None, _constant("E_R", "MODULUS", "Young modulus through the thickness.")
    ] = None
    G_LT: Annotated[
        str | None,
        _constant("G_LT", "MODULUS", "Shear modulus that resists torsion, such as '1.1 GPa'."),
    ] = None
    G_LR: Annotated[
        str | None,
        _constant("G_LR", "MODULUS", "Shear modulus through the thickness, along the grain."),
    ] = None
    G_TR: Annotated[
        str | None,
        _constant("G_TR", "MODULUS", "Shear modulus through the thickness, across the grain."),
    ] = None
    nu_LT: Annotated[
        float | None,
        _constant(
            "nu_LT",
            "RATIO",
            "Poisson ratio: contraction across the grain under stress along it, such as 0.22.",
        ),
    ] = None
    nu_LR: Annotated[
        float | None,
        _constant(
            "nu_LR",
            "RATIO",
            "Poisson ratio: contraction through the thickness under stress along the grain.",
        ),
    ] = None
    nu_TR: Annotated[
        float | None,
        _constant(
            "nu_TR",
            "RATIO",
            "Poisson ratio: contraction through the thickness under stress across the grain.",
        ),
    ] = None
    density: Annotated[
        str | None,
        typer.Option(metavar="DENSITY", help="Density of the cane, such as '520 kg/m^3'."),
    ] = None
    thickness_offset: Annotated[
        str | None,
        typer.Option(metavar="LENGTH", help="Added to the thickness of the vamp, such as '10 um'."),
    ] = None
    temperature: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPERATURE", help="Temperature of viscoelastic cane, such as '25 degC'."
        ),
    ] = None
    dryness: Annotated[
        float | None,
        typer.Option(help="Dryness of viscoelastic cane, from 0 (series A) to 1 (series B)."),
    ] = None

    def by_key(self) -> dict[str, str | float | None]:
        """Return the values by key path of the reed file."""
        return {
            _KEYS.get(field.name, f"cane.{field.name}"): getattr(self, field.name)
            for field in fields(self)
        }


@takes_options
def modes(
    reed: Annotated[
        str, typer.Argument(help="Reed file, or the name of a shipped reed.")
    ] = "clarinet",
    changes: ReedChanges = ReedChanges(),
    mesh: Annotated[
        str,
        typer.Option(
            help="Mesh: fine, standard or fast (some cents off). basis: answers at once after a "
            "basis has been built, which takes about a minute and is kept."
        ),
    ] = "fine",
    pictures: Annotated[
        Path | None,
        typer.Option(metavar="PATH.png", help="PNG file to write, with a picture of every mode."),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """List every mode of a reed below 20 kHz, computed by finite elements.

    Each option replaces one value of the reed file.
    """
    import acquire
    from acquire.cli.display import stage_progress
    from fitting.reed_modes import BASIS, doubts_marked, mesh_level
    from reports.figures.mode_pictures import modes_table, require_png
    from reports.tables import terminal_table

    if pictures:
        if mesh == BASIS:
            raise UsageError("--pictures: a basis has no shapes to draw; use --mesh fine")
        mesh_level(mesh)
        require_png(pictures)
    words = messages()
    with stage_progress(words) as progress:
        found = acquire.modes(
            reed, changes.by_key(), mesh=mesh, announce=words.print, progress=progress
        )
    if pictures:
        found.write_pictures(pictures)
    if as_json:
        show_json(found.to_json())
        return
    console = results()
    shown = doubts_marked(found.modes) if mesh == BASIS else found.modes
    console.print(terminal_table(modes_table(found.reed, shown)))
    if pictures:
        console.print(f"pictures      {pictures}", markup=False, soft_wrap=True)


def population(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="TABLE.csv|FOLDER",
            help="CSV table of resonances (columns reed, series, mode, hz), or run files.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="CSV table to write, with the parameters of every reed (default: next to SOURCE)."
        ),
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            help="Kind of reed of a table: reed file, or the name of a shipped reed (default: "
            "clarinet). Run files contain it."
        ),
    ] = None,
    model: ModelOption = "fem",
    method: Annotated[
        str | None,
        typer.Option(
            help="How to find resonances in a folder of run files: joint (default) or picture."
        ),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Fit the material parameters of many reeds, each with its error.

    For a folder of run files the resonances are found first, in some seconds for each run. A peak
    that stays at one frequency in all reeds is reported as an acoustic resonance of the air.
    """
    import acquire
    from reports.population_tables import remarks, summary_table
    from reports.tables import terminal_table

    words = messages()
    with words.status("fitting") as status:
        fitted = acquire.population(
            source,
            out,
            kind=kind,
            model=model,
            method=method,
            announce=words.print,
            fitted=lambda reeds: status.update(f"{reeds} reeds fitted"),
        )
    if as_json:
        show_json(fitted.to_json())
        return
    console = results()
    console.print(terminal_table(summary_table(fitted.summary)))
    for remark in remarks(fitted.summary, fitted.measured):
        console.print(remark)
    for name, path in fitted.files.items():
        console.print(f"{name:13} {path}", markup=False, soft_wrap=True)
