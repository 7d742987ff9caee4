"""What a fit of a population recovers of the components of its reeds.

Reeds are drawn from N(0, 1) (hypothesis H4; those outside physics in either series, 2 % of them,
are drawn again), their modes have the moduli of their own frequencies, and the sweep sees each at
the nearest picture of its 25-cent grid. `benchmarks.populations` measures time and memory.

    python -m studies.populations [--kind REED] [--basis-reeds N] [--json]

* Recovery of e1…e4 on 1000 reeds whose modes are those of the metamodel: of the paper's Eq. 1, and
  of polynomials that follow the finite elements.
* How far the polynomials are from the reduced basis, and the recovery on reeds whose modes are
  those of the basis: by name, crossings included.
"""

import argparse
import json
import sys
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.cane.reed_fit import COMPONENTS
from fitting.forward import (
    basis_of,
    cents_of,
    hz_of,
)
from fitting.paper.constants import adjusted_metamodel
from fitting.populations.flags import count_flags
from fitting.populations.population import fit_population
from physics.errors import ImpossibleReedError
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    h4_matrix,
    storage_modulus,
    viscoelastic_cane,
)
from physics.reed.geometry import ReedGeometry
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import viscoelastic_mode
from physics.reed.reduced.reed import ReducedReed
from physics.reed.reduction.log_polynomial import LogPolynomial, finite_element_polynomial
from physics.reed.reduction.metamodel import Metamodel
from protocols.reed import DEFAULT_REED, ReedFile

Array = NDArray[np.floating[Any]]

RMS_SD, COVERAGE = 0.12, (0.62, 0.74)
# What no unbiased estimate can beat at 25 cents, from the research on identifiability.
CRAMER_RAO_SD = (0.05, 0.07, 0.08, 0.11)
PICTURE_CENTS, PICTURES = 25.0, 184
ERROR_CENTS = PICTURE_CENTS / np.sqrt(12)
RECOVERED_REEDS = 1000
# Each pass gains a factor of about 5.
PASSES = 20


# --- Reeds -------------------------------------------------------------------------------------


def draw_canes(rng: np.random.Generator, count: int) -> Array:
    """Components (count, 4); draws with a spring that is not positive are drawn again."""
    kept: list[Array] = []
    while sum(map(len, kept)) < count:
        drawn = rng.standard_normal((count, 4))
        springs = np.stack([_zener(drawn, series)[:, [0, 1, 3, 4]] for series in Series])
        kept.append(drawn[(springs > 0).all(axis=(0, 2))])
    return np.concatenate(kept)[:count]


def _zener(components: Array, series: Series) -> Array:
    """E1, E2, E3, G1, G2, G3, (n, 6)."""
    return np.column_stack([np.ones(len(components)), components]) @ h4_matrix(series).T


def population_cents(components: Array, metamodel: Metamodel) -> Array:
    """Cents (n, 2, m) of a population, each mode with the moduli of its own frequency."""
    cents = np.full((len(components), len(Series), len(metamodel.modes)), 2400.0)
    for column, series in enumerate(Series):
        E1, E2, E3, G1, G2, G3 = _zener(components, series).T[..., None]
        for _ in range(PASSES):
            hz = hz_of(cents[:, column])
            E, G = storage_modulus(E1, E2, E3, hz), storage_modulus(G1, G2, G3, hz)
            cents[:, column] = metamodel.evaluate(1e6 * E.value_mpa, 1e6 * G.value_mpa)[0]
    return cents


def pictures(cents: Array) -> Array:
    """Resonances where the sweep sees them; NaN for those beyond its ends."""
    k = np.round(cents / PICTURE_CENTS)
    return np.where((k >= 1) & (k <= PICTURES), PICTURE_CENTS * k, np.nan)


def metamodels_of(kind: ReedFile, polynomial: LogPolynomial) -> dict[str, Metamodel]:
    """Return polynomials of the finite elements, and Eq. 1 if the reed is the paper's."""
    followed: dict[str, Metamodel] = {"finite elements": polynomial}
    if kind.geometry() == ReedGeometry():
        return {"paper": adjusted_metamodel(PAPER_MODES), **followed}
    return followed


def reduced_reed(kind: ReedFile) -> ReducedReed:
    """Return the reduced model of a reed and show progress."""
    return basis_of(kind, lambda what: print(what, file=sys.stderr))


# --- Recovery ----------------------------------------------------------------------------------


def recovery(canes: Array, observed: Array, metamodel: Metamodel) -> dict[str, Any]:
    """How far fits lie from the truth, in standard deviations of the population."""
    fit = fit_population(observed, ERROR_CENTS, metamodel)
    missed = fit.components - canes
    rms, covered = np.sqrt(np.mean(missed**2, axis=0)), np.mean(np.abs(missed) < fit.errors, axis=0)
    return {
        "reeds": len(canes),
        "resonances": int(fit.used.sum()),
        "rms_sd": _by_component(rms),
        "robust_sd": _by_component(1.4826 * np.median(np.abs(missed), axis=0)),
        "median_error": _by_component(np.median(fit.errors, axis=0)),
        "coverage": _by_component(covered),
        "mean_reduced_chi2": float(np.mean(fit.reduced_chi2)),
        "flags": count_flags(fit.flags),
        "rms_met": bool((rms <= RMS_SD).all()),
        "coverage_met": bool(((covered >= COVERAGE[0]) & (covered <= COVERAGE[1])).all()),
    }


def _by_component(values: Array) -> dict[str, float]:
    return dict(zip(COMPONENTS, map(float, values), strict=True))


# --- The basis itself --------------------------------------------------------------------------


def basis_cents(reed: ReducedReed, canes: Array, starts: Array) -> Array:
    """Cents (n, 2, m) by name from the reduced basis, NaN where a name does not settle."""
    cents = np.full(starts.shape, np.nan)
    for n, column, m in np.ndindex(*starts.shape):
        series = list(Series)[column]
        cane = viscoelastic_cane(Components(*map(float, canes[n])), series)
        start_hz = float(hz_of(starts[n, column, m]))
        try:
            mode = viscoelastic_mode(reed, cane, PAPER_MODES[m], start_hz)
        except ImpossibleReedError:
            continue
        cents[n, column, m] = cents_of(mode.frequency_hz)
    return cents


def against_basis(reed: ReducedReed, polynomial: LogPolynomial, reeds: int) -> dict[str, Any]:
    """Accuracy of the polynomials, and recovery of reeds of the basis."""
    canes = draw_canes(np.random.default_rng(4), reeds)
    predicted = population_cents(canes, polynomial)
    true = basis_cents(reed, canes, predicted)
    deviation = np.abs(predicted - true)
    by_mode = {
        name: {
            "median_cents": float(np.nanmedian(deviation[..., m])),
            "p95_cents": float(np.nanpercentile(deviation[..., m], 95)),
            "largest_cents": float(np.nanmax(deviation[..., m])),
            "without_settled_name": int(np.isnan(deviation[..., m]).sum()),
        }
        for m, name in enumerate(PAPER_MODES)
    }
    seen = pictures(true)
    left_out = fit_population(seen, ERROR_CENTS, polynomial).left_out
    for name, share in zip(polynomial.modes, left_out.mean(axis=(0, 1)), strict=True):
        by_mode[name]["left_out"] = float(share)
    return {
        "modes": by_mode,
        "followed": recovery(canes, seen, polynomial),
        "straight_through": recovery(canes, seen, replace(polynomial, cells=None)),
    }


# --- All of it ---------------------------------------------------------------------------------


def study(kind: ReedFile, basis_reeds: int) -> dict[str, Any]:
    """Measure everything; the result is what ``--json`` prints."""
    reed = reduced_reed(kind)
    polynomial = finite_element_polynomial(reed)
    metamodels = metamodels_of(kind, polynomial)
    canes = draw_canes(np.random.default_rng(5), RECOVERED_REEDS)
    return {
        "reed": kind.name,
        "recovery": {
            name: recovery(canes, pictures(population_cents(canes, metamodel)), metamodel)
            for name, metamodel in metamodels.items()
        },
        "against_basis": against_basis(reed, polynomial, basis_reeds) if basis_reeds else None,
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a study for people."""
    print(report["reed"])
    for name, row in report["recovery"].items():
        print(f"\n{name}")
        _print_recovery(row)
        _print_claims(row)
    if report["against_basis"]:
        _print_basis(report["against_basis"])


def verdict(met: bool) -> str:
    """Return the word for a claim that is met or missed."""
    return "met" if met else "missed"


def _print_recovery(row: dict[str, Any]) -> None:
    print(f"recovery on {row['reeds']} reeds, {row['resonances']} resonances")
    print(f"{'':4}{'rms SD':>8}{'robust':>8}{'error':>8}{'bound':>8}{'coverage':>10}")
    for name, bound in zip(COMPONENTS, CRAMER_RAO_SD, strict=True):
        print(
            f"{name:4}{row['rms_sd'][name]:8.3f}{row['robust_sd'][name]:8.3f}"
            f"{row['median_error'][name]:8.3f}{bound:8.2f}{row['coverage'][name]:10.1%}"
        )
    print(f"mean reduced chi2 {row['mean_reduced_chi2']:.2f}, flags {row['flags'] or 'none'}")


def _print_claims(row: dict[str, Any]) -> None:
    for claim, met in (
        (f"rms error up to {RMS_SD} SD", row["rms_met"]),
        (f"coverage {COVERAGE[0]:.0%} to {COVERAGE[1]:.0%}", row["coverage_met"]),
    ):
        print(f"{claim}, each component: {verdict(met)}")


def _print_basis(row: dict[str, Any]) -> None:
    print("\npolynomials less reduced basis, cents")
    print(f"{'mode':5}{'median':>8}{'95 %':>8}{'largest':>9}{'unsettled':>11}{'left out':>10}")
    for name, mode in row["modes"].items():
        print(
            f"{name:5}{mode['median_cents']:8.2f}{mode['p95_cents']:8.1f}"
            f"{mode['largest_cents']:9.1f}{mode['without_settled_name']:11d}"
            f"{mode['left_out']:10.1%}"
        )
    print("\nreeds of the basis; modes that the polynomials do not follow are left out of fits")
    _print_recovery(row["followed"])
    _print_claims(row["followed"])
    print("\nthe same if none were left out")
    _print_recovery(row["straight_through"])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Recovery of the components of populations.")
    parser.add_argument("--basis-reeds", type=int, default=1000, help="0 leaves them out")
    parser.add_argument("--kind", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = study(ReedFile.from_file(arguments.kind), arguments.basis_reeds)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
