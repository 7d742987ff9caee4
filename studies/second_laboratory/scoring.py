"""Compare what fits state with what is true, over many sweeps."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from studies.second_laboratory.cane import DENSITY as DRAWING_DENSITY

# Above this the mesh is not shown to be converged to 5 cents, and names are not settled.
HIGHEST_HZ = 16_000.0


@dataclass(frozen=True)
class Comparison:
    """One number of one sweep: difference to the truth and stated standard error, in one unit."""

    quantity: str
    sweep: str
    difference: float
    error: float


@dataclass(frozen=True)
class Score:
    """One number over all sweeps.

    Attributes
    ----------
    quantity : str
        Such as ``F1``, ``loss F1``, ``e1``.
    unit : str
    stated, of : int
        Sweeps in which it was stated, of those in which it could have been.
    bias, sd, median_error : float
        Of fitted less true; median of the stated standard errors.
    rms_pull : float
        Root mean square of difference over stated error.
    coverage : float
        Share of truths within one stated standard error; 0.68 is right.
    farthest, farthest_in : float, str
        Largest difference, and its sweep.
    """

    quantity: str
    unit: str
    stated: int
    of: int
    bias: float
    sd: float
    median_error: float
    rms_pull: float
    coverage: float
    farthest: float
    farthest_in: str

    def to_json(self) -> dict[str, Any]:
        """Return the fields; what is unknown is null."""
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(self).items()
        }


def comparisons(
    sweep: str, series: str, fit: Mapping[str, Any], truth: Mapping[str, Any]
) -> list[Comparison]:
    """Compare the JSON of one fit with the truth of its reed."""
    found = []
    for name, mode in fit["modes"].items():
        true = truth["modes"].get(name)
        if true is None or true["hz"] > HIGHEST_HZ:
            continue
        cents = 1200 * math.log2(mode["hz"] / true["hz"])
        found.append(Comparison(name, sweep, cents, mode["error_cents"]))
        if mode.get("loss_factor"):
            percent = 100 * math.log(mode["loss_factor"] / true["loss_factor"])
            found.append(Comparison(f"loss {name}", sweep, percent, 100 * mode["loss_error"]))
    for name, stated in (fit["components"] or {}).items():
        true_value = truth["components_over_rho"][name]
        if stated is not None:
            found.append(Comparison(name, sweep, stated["value"] - true_value, stated["error"]))
    losses = fit["losses"].get(series, {})
    for name, key in (("normal", "loss_E"), ("shear", "loss_G")):
        if name in losses and key in truth:
            percent = 100 * math.log(losses[name]["value"] / truth[key])
            error = 100 * losses[name]["error"] / losses[name]["value"]
            found.append(Comparison(f"loss {name}", sweep, percent, error))
    moduli = (fit["moduli"] or {}).get(series, {})
    for name, stated in moduli.items():
        true_value = truth["moduli"][name]
        # Sound knows moduli over density only: a fit that states moduli assumes the drawing's.
        over_rho = true_value * DRAWING_DENSITY / truth["density_kg_m3"]
        error = 100 * stated["error"] / over_rho
        percent = 100 * (stated["value"] / over_rho - 1)
        found.append(Comparison(f"{name.removesuffix('_mpa')}/rho", sweep, percent, error))
    return found


def scores(found: Sequence[Comparison], possible: Mapping[str, int], sweeps: int) -> list[Score]:
    """Summarise comparisons by quantity.

    Parameters
    ----------
    found : sequence of Comparison
    possible : mapping
        For each mode, in how many sweeps it lies in the range that is scored.
    sweeps : int
        Number of sweeps, those included whose fit was refused.
    """
    table = []
    for quantity in _in_order(c.quantity for c in found):
        own = [c for c in found if c.quantity == quantity]
        differences = np.array([c.difference for c in own])
        errors = np.array([c.error for c in own])
        worst = own[int(np.argmax(np.abs(differences)))]
        pulls = differences / errors
        mode = quantity.removeprefix("loss ")
        table.append(
            Score(
                quantity=quantity,
                unit=_unit(quantity),
                stated=len(own),
                of=possible.get(mode, sweeps),
                bias=float(np.mean(differences)),
                sd=float(np.std(differences, ddof=1)) if len(own) > 1 else math.nan,
                median_error=float(np.median(errors)),
                rms_pull=float(np.sqrt(np.mean(pulls**2))),
                coverage=float(np.mean(np.abs(pulls) < 1)),
                farthest=worst.difference,
                farthest_in=worst.sweep,
            )
        )
    return table


def _unit(quantity: str) -> str:
    if quantity.startswith("loss ") or quantity.endswith("/rho"):
        return "%"
    return "sd" if quantity[0] == "e" else "cents"


def _in_order(quantities: Iterable[str]) -> list[str]:
    """Return each quantity once: modes, losses, components, moduli."""
    return sorted(
        set(quantities), key=lambda q: (q.startswith("loss"), q[0] == "e", q.endswith("rho"), q)
    )


def table_lines(table: Sequence[Score]) -> list[str]:
    """Return the scores as lines of text."""
    lines = [
        "quantity   unit   stated     bias       sd  stated error   rms pull  within one   farthest"
    ]
    for s in table:
        lines.append(
            f"{s.quantity:<10} {s.unit:<5} {s.stated:>3}/{s.of:<3} {s.bias:>8.2f} {s.sd:>8.2f}"
            f" {s.median_error:>13.2f} {s.rms_pull:>10.2f} {100 * s.coverage:>11.0f} %"
            f" {s.farthest:>10.2f}  {s.farthest_in}"
        )
    return lines
