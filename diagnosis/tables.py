"""What the command line shows of a diagnosis."""

from rich.table import Table

from diagnosis.gap import Diagnosis


def gap_table(diagnosis: Diagnosis) -> Table:
    """Gap of every mode in units of its floor, worst first."""
    table = Table(title="Gap between run and nominal twin")
    for head in ("series", "mode", "gap (cents)", "floor (cents)", "gap / floor"):
        table.add_column(head, justify="right")
    for cell in diagnosis.cells:
        ratio = abs(cell.gap_cents) / cell.floor_cents
        told = f"{ratio:.1f}" if ratio > 1 else "not resolvable"
        table.add_row(
            cell.series, cell.mode, f"{cell.gap_cents:+.1f}", f"{cell.floor_cents:.1f}", told
        )
    return table


def closing_words(diagnosis: Diagnosis) -> list[str]:
    """Where the gap stands as a whole and what each effect takes off it, a line each."""
    rms, floor = diagnosis.rms_cents, diagnosis.floor_cents
    if diagnosis.resolvable:
        lines = [f"gap {rms:.1f} cents rms, floor {floor:.1f}"]
    else:
        lines = [f"gap {rms:.1f} cents rms: below its floor of {floor:.1f}, not resolvable"]
    for trial in diagnosis.trials:
        closed = "" if trial.kappa != trial.kappa else f", closes {trial.kappa:.0%} of the gap"
        lines.append(
            f"{trial.effect} ({trial.stage}) × {trial.share:.2f}: "
            f"{trial.rms_before_cents:.1f} → {trial.rms_after_cents:.1f} cents{closed}"
        )
    return [*lines, "closing a gap does not prove its cause"]
