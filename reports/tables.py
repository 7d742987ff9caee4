"""What the command line shows of a fit."""

from rich.table import Table
from rich.text import Text

from fitting.cane.fit_runs import ReedFit, SweepFit
from fitting.cane.reed_fit import Estimate
from fitting.fringes.picking import Resonance


def modes_table(sweep: SweepFit) -> Table:
    """Resonances of one run."""
    table = Table(title=Text(f"Reed {sweep.reed}, series {sweep.series}: resonances"))
    jointly = sweep.joint is not None
    more = ("loss factor", "liveliest", "MAC") if jointly else ("fringes (rad)",)
    for head in ("mode", "frequency", "± cents", *more, "picture"):
        table.add_column(head, justify="right", no_wrap=True)
    for name, found in sweep.resonances.items():
        table.add_row(
            name,
            f"{found.frequency_hz:.1f} Hz",
            f"{found.error_cents:.1f}",
            *(_joint_cells(found) if jointly else (f"{found.amplitude_rad:.1f}",)),
            str(found.step_index),
        )
    return table


def _joint_cells(found: Resonance) -> tuple[str, str, str]:
    """What only a joint fit knows of a mode."""
    loss = "" if found.loss_factor is None else f"{found.loss_factor:.4f}"
    if found.loss_factor is not None and found.loss_error is not None:
        loss += f" ± {found.loss_factor * found.loss_error:.4f}"
    response = "" if found.response_hz is None else f"{found.response_hz:.0f} Hz"
    return loss, response, "" if found.likeness is None else f"{found.likeness:.2f}"


def not_identified_lines(sweep: SweepFit) -> list[str]:
    """Why modes within the sweep are not identified, a line for each reason; lines of the drive."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in sweep.not_identified.items():
        by_reason.setdefault(reason, []).append(name)
    lines = [f"not identified: {', '.join(names)}: {r}" for r, names in by_reason.items()]
    return lines + [
        f"a line of the drive at {line.hz:.0f} Hz, {line.height_db:+.0f} dB: of the air or the "
        "loudspeaker if other reeds show it too, and no mode"
        for line in sweep.lines
    ]


def parameters_table(fit: ReedFit) -> Table | None:
    """Components and moduli with errors; nothing if the fit has none."""
    if fit.parameters is None:
        return None
    parameters = fit.parameters
    caption = f"rms {parameters.rms_cents:.1f} cents, model: {parameters.model}"
    if parameters.at_limit:
        caption += f"; at the limit of the search, so not known: {', '.join(parameters.at_limit)}"
    table = Table(title=Text(f"Reed {fit.sweeps[0].reed}: the cane"), caption=caption)
    table.add_column("parameter")
    table.add_column("value", justify="right")
    table.add_column("± s.e.", justify="right")
    table.add_column("unit")
    for name, estimate in parameters.components.items():
        table.add_row(name, f"{estimate.value:+.2f}", f"{estimate.error:.2f}", "population SD")
    for series, moduli in parameters.moduli.items():
        for name, estimate in moduli.items():
            table.add_row(*_modulus_row(name, estimate, series))
    return table


def _modulus_row(name: str, estimate: Estimate, series: str) -> tuple[str, str, str, str]:
    quantity = name.removesuffix("_mpa").replace("_4kHz", "' at 4 kHz")
    label = f"{quantity}, series {series}"
    return label, f"{estimate.value:.0f}", f"{estimate.error:.0f}", "MPa"
