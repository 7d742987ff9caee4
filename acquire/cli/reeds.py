"""The verbs `acquire modes` and `acquire population`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.app import (
    AsJson,
    Debug,
    ModelOption,
)
from acquire.cli.console import messages, results, show_json, show_message

if TYPE_CHECKING:
    pass


def _constant(name: str, kind: str, meaning: str) -> Any:
    """Option of an elastic constant, `--e-l` or `--E-L`; without it the reed's own counts."""
    dashed = name.replace("_", "-")
    return typer.Option(f"--{dashed.lower()}", f"--{dashed}", metavar=kind, help=meaning)


def modes(
    reed: Annotated[
        str, typer.Argument(help="Reed file, or the name of a shipped reed.")
    ] = "clarinet",
    E_L: Annotated[
        str | None, _constant("E_L", "MODULUS", "Young modulus along the grain, such as '13 GPa'.")
    ] = None,
    E_T: Annotated[
        str | None, _constant("E_T", "MODULUS", "Young modulus across the grain.")
    ] = None,
    E_R: Annotated[
        str | None, _constant("E_R", "MODULUS", "Young modulus through the thickness.")
    ] = None,
    G_LT: Annotated[
        str | None,
        _constant("G_LT", "MODULUS", "Shear modulus that resists torsion, such as '1.1 GPa'."),
    ] = None,
    G_LR: Annotated[
        str | None,
        _constant("G_LR", "MODULUS", "Shear modulus through the thickness, along the grain."),
    ] = None,
    G_TR: Annotated[
        str | None,
        _constant("G_TR", "MODULUS", "Shear modulus through the thickness, across the grain."),
    ] = None,
    nu_LT: Annotated[
        float | None,
        _constant(
            "nu_LT",
            "RATIO",
            "Poisson ratio: contraction across the grain under stress along it, such as 0.22.",
        ),
    ] = None,
    nu_LR: Annotated[
        float | None,
        _constant(
            "nu_LR",
            "RATIO",
            "Poisson ratio: contraction through the thickness under stress along the grain.",
        ),
    ] = None,
    nu_TR: Annotated[
        float | None,
        _constant(
            "nu_TR",
            "RATIO",
            "Poisson ratio: contraction through the thickness under stress across the grain.",
        ),
    ] = None,
    density: Annotated[
        str | None,
        typer.Option(metavar="DENSITY", help="Density of the cane, such as '520 kg/m^3'."),
    ] = None,
    thickness_offset: Annotated[
        str | None,
        typer.Option(metavar="LENGTH", help="Added to the thickness of the vamp, such as '10 um'."),
    ] = None,
    temperature: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPERATURE", help="Temperature of viscoelastic cane, such as '25 degC'."
        ),
    ] = None,
    dryness: Annotated[
        float | None,
        typer.Option(help="Dryness of viscoelastic cane, from 0 (series A) to 1 (series B)."),
    ] = None,
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
    from acquire.cli.display import share_progress
    from fitting.reed_modes import (
        BASIS,
        changed,
        doubts_marked,
        mesh_level,
        modes_by_basis,
        modes_of,
        modes_to_json,
    )
    from protocols.errors import ProtocolError
    from protocols.reed import ReedFile
    from reports.mode_pictures import (
        modes_table,
        require_png,
        write_mode_sheet,
    )

    level = None if mesh == BASIS else mesh_level(mesh)
    if pictures:
        if level is None:
            raise ProtocolError("--pictures: a basis has no shapes to draw; use --mesh fine")
        require_png(pictures)
    cane = {"E_L": E_L, "E_T": E_T, "E_R": E_R, "G_LT": G_LT, "G_LR": G_LR, "G_TR": G_TR}
    ratios = {"nu_LT": nu_LT, "nu_LR": nu_LR, "nu_TR": nu_TR}
    changes: dict[str, str | float | None] = {
        **{f"cane.{name}": value for name, value in {**cane, **ratios, "density": density}.items()},
        "geometry.thickness_offset": thickness_offset,
        "conditions.temperature": temperature,
        "conditions.dryness": dryness,
    }
    original = ReedFile.from_file(reed)
    described = changed(original, changes)
    if level is None:
        with share_progress(messages(), "building") as show:
            found = modes_by_basis(described, original, show_message, show)
    else:
        show_message("computing the reed's modes by finite elements")
        found = modes_of(described, level)
        if pictures:
            write_mode_sheet(described, level, found, pictures)
    if as_json:
        show_json(modes_to_json(described, found))
        return
    console = results()
    console.print(modes_table(described, found if level else doubts_marked(found)))
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
    from fitting.cane.fit_runs import method_name, model_name
    from fitting.errors import FitInputError
    from fitting.populations.table import fit_table, metamodel_of
    from protocols.reed import DEFAULT_REED, ReedFile
    from reports.own_output import require_writable
    from reports.population_tables import (
        components_output,
        opened_table,
        remarks,
        resonances_output,
        summary_table,
        write_resonances,
    )

    forward, way, table, files = model_name(model), method_name(method or "joint"), source, {}
    reed, measured = ReedFile.from_file(kind or DEFAULT_REED), None
    if method and not source.is_dir():
        raise FitInputError("--method: a table already holds resonances; leave it out")
    if source.is_dir() and kind:
        raise FitInputError("--kind: run files say which reed they measured; leave it out")
    outputs = []
    if source.is_dir():
        table = files["resonances"] = source / "resonances.csv"
        outputs.append(resonances_output(table))
    out = files["components"] = out or table.with_name(f"{table.stem}-components.csv")
    components = components_output(out)
    require_writable([*outputs, components], [source])
    if source.is_dir():
        measured = write_resonances(source, table, show_message, way)
        reed = measured.kind
    words = messages()
    with opened_table(components) as file, words.status("fitting") as status:
        summary = fit_table(
            table,
            metamodel_of(forward, reed, show_message),
            file,
            lambda reeds: status.update(f"{reeds} reeds fitted"),
        )
    answer = {**summary.to_json(), "files": {name: str(path) for name, path in files.items()}}
    if measured:
        answer["lines"] = measured.to_json()
    if as_json:
        show_json(answer)
        return
    console = results()
    console.print(summary_table(summary))
    for remark in remarks(summary, measured):
        console.print(remark)
    for name, path in files.items():
        console.print(f"{name:13} {path}", markup=False, soft_wrap=True)
