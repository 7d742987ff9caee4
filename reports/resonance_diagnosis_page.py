"""What the command line shows of a diagnosis of resonances, and its JSON."""

import math
from collections.abc import Mapping
from typing import Any

from rich.table import Table

from diagnosis.likeness import DETECTABLE, Reach
from diagnosis.published import (
    PublishedDiagnosis,
    Size,
    Trial,
)
from physics.effects.form import Effect

_NOT_PROOF = "closing a gap does not prove its cause"
# Sizes are told from so many nats of log odds on.
_LEAST_TOLD = 1.0


def gap_of_modes(diagnosis: PublishedDiagnosis) -> Table:
    """Gap of every mode beside its floor, per series."""
    table = Table(title="Resonances less the elastic reed (E_L and G_LT fitted in each series)")
    table.add_column("mode")
    for reed in diagnosis.reeds:
        table.add_column(f"{reed.series}: gap (cents)", justify="right")
        table.add_column(f"{reed.series}: floor", justify="right")
    names = list(dict.fromkeys(name for reed in diagnosis.reeds for name in reed.modes))
    for name in names:
        row = [name]
        for reed in diagnosis.reeds:
            if name not in reed.modes:
                row += ["", ""]
                continue
            at = reed.modes.index(name)
            gap = float(diagnosis.residual_cents[reed.series][at])
            floor = float(diagnosis.floor_cents[reed.series][at])
            row += [f"{gap:+.0f}" if abs(gap) > floor else "not resolvable", f"{floor:.0f}"]
        table.add_row(*row)
    return table


def trials_table(diagnosis: PublishedDiagnosis) -> Table:
    """What effects close of the gap, alone and together."""
    table = Table(title="What effects close of it")
    table.add_column("effects", no_wrap=True)
    for reed in diagnosis.reeds:
        table.add_column(f"rms {reed.series},\ncents", justify="right")
    table.add_column("κ, mode\nleft out", justify="right")
    if len(diagnosis.reeds) > 1:
        table.add_column("κ, other\nseries", justify="right")
    table.add_column("log odds,\nnats", justify="right")
    before = diagnosis.elastic.rms_cents
    for trial in (*diagnosis.alone, *diagnosis.together):
        row = ["\n+ ".join(trial.effects)]
        row += [f"{before[s]:.0f} → {after:.0f}" for s, after in trial.rms_cents.items()]
        interval = f"[{_share(trial.kappa_low)}, {_share(trial.kappa_high)}]"
        row.append(f"{_share(trial.kappa)}\n{interval}")
        if len(diagnosis.reeds) > 1:
            row.append("\n".join(f"{s} {_share(k)}" for s, k in trial.kappa_other.items()))
        odds = f"{trial.log_bayes:+.1f}"
        row.append(odds if trial.certified else f"{odds} *")
        table.add_row(*row)
    return table


def words(diagnosis: PublishedDiagnosis, effects: Mapping[str, Effect]) -> list[str]:
    """What it comes to, a line each."""
    rms = ", ".join(f"{s} {v:.0f} cents" for s, v in diagnosis.elastic.rms_cents.items())
    lines = [f"elastic reed: rms {rms}"]
    for trial in (*diagnosis.alone, *diagnosis.together):
        if _is_told(trial):
            together = len(trial.effects) > 1
            sizes = "; ".join(_size(size, owned=together) for size in trial.sizes)
            lines.append(f"{' + '.join(trial.effects)}: {sizes}")
    lines += _hardly_told(diagnosis, effects)
    if not all(trial.certified for trial in (*diagnosis.alone, *diagnosis.together)):
        lines.append("* the fit has not converged: no effect is to be named by it")
    unseen = [entry.effect for entry in diagnosis.reach if out_of_reach(entry, effects)]
    if unseen:
        lines.append(
            f"out of reach of such data, at three spreads of their priors: {', '.join(unseen)}"
        )
    return [*lines, _NOT_PROOF]


def _is_told(trial: Trial) -> bool:
    return trial.certified and trial.log_bayes > _LEAST_TOLD


def _hardly_told(diagnosis: PublishedDiagnosis, effects: Mapping[str, Effect]) -> list[str]:
    """What each likely effect is alike to, the most alike first, and what would tell it."""
    reach, lines = {entry.effect: entry for entry in diagnosis.reach}, []
    for trial in diagnosis.alone:
        name = trial.effects[0]
        alike = sorted(reach[name].alike.items(), key=lambda item: -item[1])
        if alike and _is_told(trial):
            others = ", ".join(f"{other} ({value:.2f})" for other, value in alike)
            action = effects[name].action
            lines.append(
                f"{name} is hardly told by such data from {others}: cosines of what both move; "
                f"what would tell it: {action}"
            )
    return lines


def out_of_reach(reach: Reach, effects: Mapping[str, Effect]) -> bool:
    """Whether no parameter of an effect would stand out at three spreads of its prior."""
    spreads = {p.name: p.spread for p in effects[reach.effect].parameters}
    return all(least > 3 * spreads[name] for name, least in reach.detectable.items())


def to_json(diagnosis: PublishedDiagnosis) -> dict[str, Any]:
    """Return the diagnosis with stable keys; what is not a number becomes null."""
    return {
        "series": {
            reed.series.value: {
                "reeds": reed.reeds,
                "modes": {
                    name: {
                        "cents": _number(cents),
                        "gap_cents": _number(gap),
                        "floor_cents": _number(floor),
                        "resolvable": bool(abs(gap) > floor),
                    }
                    for name, cents, gap, floor in zip(
                        reed.modes,
                        reed.cents,
                        diagnosis.residual_cents[reed.series],
                        diagnosis.floor_cents[reed.series],
                        strict=True,
                    )
                },
            }
            for reed in diagnosis.reeds
        },
        "elastic": _trial(diagnosis.elastic),
        "alone": [_trial(trial) for trial in diagnosis.alone],
        "together": [_trial(trial) for trial in diagnosis.together],
        "reach": {
            entry.effect: {
                "absorbed": _number(entry.absorbed),
                "detectable": {name: _number(v) for name, v in entry.detectable.items()},
                "deviations": DETECTABLE,
                "alike": {name: _number(v) for name, v in entry.alike.items()},
            }
            for entry in diagnosis.reach
        },
        "classes": [list(group) for group in diagnosis.classes if len(group) > 1],
    }


def _trial(trial: Trial) -> dict[str, Any]:
    return {
        "effects": list(trial.effects),
        "sizes": [
            {
                "effect": size.effect,
                "name": size.name,
                "unit": size.unit,
                "value": _number(size.value),
                "error": _number(size.error),
                "z": _number(size.z),
            }
            for size in trial.sizes
        ],
        "rms_cents": {s: _number(v) for s, v in trial.rms_cents.items()},
        "kappa": _number(trial.kappa),
        "kappa_interval": [_number(trial.kappa_low), _number(trial.kappa_high)],
        "kappa_from_other_series": {s: _number(v) for s, v in trial.kappa_other.items()},
        "log_bayes": _number(trial.log_bayes),
        "converged": trial.certified,
        "moduli_pa": {
            s: {"E_L": _number(E), "G_LT": _number(G)} for s, (E, G) in trial.moduli_pa.items()
        },
    }


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _size(size: Size, *, owned: bool) -> str:
    """A size; of which effect, if there are several."""
    name = f"{size.effect}'s {size.name}" if owned else size.name
    unit = f" {size.unit}" if size.unit else ""
    spreads = f"{size.z:+.1f} spreads of its prior"
    return f"{name} {size.value:.3g} ± {size.error:.1g}{unit} ({spreads})"


def _share(value: float) -> str:
    # Nothing is not less than nothing.
    return f"{round(value, 2) + 0.0:.0%}" if math.isfinite(value) else "–"
