"""A diagnosis of resonances as tables, sentences and JSON."""

import math
from collections.abc import Mapping
from typing import Any

from diagnosis.effect_notes import notes_of
from diagnosis.inference.similarity import DETECTION_SIGMA, Detectability
from diagnosis.resonance_diagnosis import ResonanceDiagnosis
from diagnosis.resonance_fit import FittedSize, ResonanceFit
from physics.effects.effect import Effect
from reports.tables import Column, Table

_NOT_PROOF = "explaining a difference does not prove its cause"
# Effects with log odds above this, in nats, are described; 1 nat is odds of 2.7 to 1.
_LEAST_NATS = 1.0


def gap_of_modes(diagnosis: ResonanceDiagnosis) -> Table:
    """Return the gap of every mode and its standard error, per series."""
    columns = [Column("mode", "mode")]
    for reed in diagnosis.reeds:
        columns += [
            Column(f"gap_{reed.series}", f"{reed.series}: gap", "cents", _gap),
            Column(f"floor_{reed.series}", "±", "cents", ".0f"),
        ]
    names = list(dict.fromkeys(name for reed in diagnosis.reeds for name in reed.modes))
    rows = []
    for name in names:
        row: list[Any] = [name]
        for reed in diagnosis.reeds:
            if name not in reed.modes:
                row += [None, None]
                continue
            at = reed.modes.index(name)
            floor = float(diagnosis.floor_cents[reed.series][at])
            row += [(float(diagnosis.residual_cents[reed.series][at]), floor), floor]
        rows.append(row)
    title = "Measured resonances less those of an elastic reed"
    note = "The elastic reed has E_L and G_LT fitted in each series. ±: standard error of the gap."
    return Table(tuple(columns), tuple(rows), title, note)


def _gap(value: tuple[float, float]) -> str:
    gap, floor = value
    return f"{gap:+.0f}" if abs(gap) > floor else "within its error"


def trials_table(diagnosis: ResonanceDiagnosis) -> Table:
    """Return how much of the gap effects explain, alone and together."""
    before = diagnosis.elastic.rms_cents
    series = [reed.series for reed in diagnosis.reeds]
    columns = [
        Column("effects", "effects", wraps=False),
        *(Column(f"rms_{s}", f"rms {s}", "cents", str) for s in series),
        Column("explained", "explained,\nmode left out", "", str),
        Column("explained_other", "explained,\nother series", "", str),
        Column("log_bayes", "log odds", "nats", str),
    ]
    rows = []
    for trial in (*diagnosis.single, *diagnosis.together):
        interval = f"[{_fraction(trial.explained_low)}, {_fraction(trial.explained_high)}]"
        odds = f"{trial.log_bayes:+.1f}"
        rows.append(
            (
                "\n+ ".join(trial.effects),
                *(f"{before[s]:.0f} → {trial.rms_cents[s]:.0f}" for s in series),
                f"{_fraction(trial.explained)}\n{interval}",
                "\n".join(f"{s} {_fraction(k)}" for s, k in trial.explained_other_series.items()),
                odds if trial.converged else f"{odds} *",
            )
        )
    table = Table(tuple(columns), tuple(rows), "How much of the gap effects explain")
    if len(series) > 1:
        return table
    return table.select(*(c.key for c in columns if c.key != "explained_other"))


def words(diagnosis: ResonanceDiagnosis, effects: Mapping[str, Effect]) -> list[str]:
    """Return what the tables mean and what follows from them, a line each."""
    rms = ", ".join(f"{s} {v:.0f} cents" for s, v in diagnosis.elastic.rms_cents.items())
    trials = (*diagnosis.single, *diagnosis.together)
    lines = [
        "explained: fraction of the gap that disappears with the effect, in modes left out of the "
        "fit [95 % interval], and in each series with sizes fitted to the other; log odds: against "
        "the elastic reed, 3 nats are odds of 20 to 1",
        f"elastic reed: rms {rms}",
    ]
    for trial in trials:
        if _is_likely(trial):
            together = len(trial.effects) > 1
            sizes = "; ".join(_size(size, owned=together) for size in trial.sizes)
            lines.append(f"{' + '.join(trial.effects)}: {sizes}")
    lines += _confusable(diagnosis, effects)
    if not all(trial.converged for trial in trials):
        lines.append("* this fit has not converged: do not name an effect by it")
    unseen = [entry.effect for entry in diagnosis.detectability if out_of_reach(entry, effects)]
    if unseen:
        lines.append(
            "not detectable with such data, even at three standard deviations of their priors: "
            f"{', '.join(unseen)}"
        )
    return [*lines, _NOT_PROOF]


def _is_likely(trial: ResonanceFit) -> bool:
    return trial.converged and trial.log_bayes > _LEAST_NATS


def _confusable(diagnosis: ResonanceDiagnosis, effects: Mapping[str, Effect]) -> list[str]:
    """Return which effects each likely effect is confusable with, the most similar first."""
    reach, lines = {entry.effect: entry for entry in diagnosis.detectability}, []
    for trial in diagnosis.single:
        name = trial.effects[0]
        alike = sorted(reach[name].confusable.items(), key=lambda item: -item[1])
        if alike and _is_likely(trial):
            others = ", ".join(f"{other} ({value:.2f})" for other, value in alike)
            action = notes_of(effects[name]).check
            lines.append(
                f"{name} is confusable with {others} (cosines of their signatures); "
                f"how to check it: {action}"
            )
    return lines


def out_of_reach(reach: Detectability, effects: Mapping[str, Effect]) -> bool:
    """Whether no parameter would be detectable at three standard deviations of its prior."""
    spreads = {p.name: p.spread for p in effects[reach.effect].parameters}
    return all(least > 3 * spreads[name] for name, least in reach.detectable.items())


def to_json(diagnosis: ResonanceDiagnosis) -> dict[str, Any]:
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
        "single": [_trial(trial) for trial in diagnosis.single],
        "combined": [_trial(trial) for trial in diagnosis.together],
        "detectability": {
            entry.effect: {
                "absorbed": _number(entry.absorbed),
                "detectable": {name: _number(v) for name, v in entry.detectable.items()},
                "deviations": DETECTION_SIGMA,
                "confusable": {name: _number(v) for name, v in entry.confusable.items()},
            }
            for entry in diagnosis.detectability
        },
        "classes": [list(group) for group in diagnosis.classes if len(group) > 1],
    }


def _trial(trial: ResonanceFit) -> dict[str, Any]:
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
        "explained_fraction": _number(trial.explained),
        "explained_fraction_interval": [
            _number(trial.explained_low),
            _number(trial.explained_high),
        ],
        "explained_fraction_from_other_series": {
            s: _number(v) for s, v in trial.explained_other_series.items()
        },
        "log_bayes": _number(trial.log_bayes),
        "converged": trial.converged,
        "moduli_pa": {
            s: {"E_L": _number(E), "G_LT": _number(G)} for s, (E, G) in trial.moduli_pa.items()
        },
    }


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _size(size: FittedSize, *, owned: bool) -> str:
    """Return a size with its error, and of which effect it is if there are several."""
    name = f"{size.effect}'s {size.name}" if owned else size.name
    unit = f" {size.unit}" if size.unit else ""
    spreads = f"{size.z:+.1f} SD of its prior"
    return f"{name} {size.value:.3g} ± {size.error:.1g}{unit} ({spreads})"


def _fraction(value: float) -> str:
    # A small negative fraction is shown as 0, not as -0.
    return f"{round(value, 2) + 0.0:.0%}" if math.isfinite(value) else "–"
