"""From series A to series B: what drying does to each mode, in the paper and in this project.

    python -m studies.closure.drying [--json]

Prints, in cents, by how much the mean frequency of each mode differs between the paper's series
(Table 1), by how much that of the mean reed does if the reed file says that it is dry, and if
`physics.conditions` dries it, with which the simulated bench and the diagnosis dry reeds. Series B
has not all modes of all reeds: a mean of few reeds may differ by what those reeds are like.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fitting.forward import basis_of
from fitting.paper.printed import printed
from physics.conditions import Condition, change_of_cane
from physics.mechanics import ReedMode, ReedSolver
from physics.parameters.environment import Environment
from physics.parameters.tree import BenchParameters, with_cane
from physics.reed.cane.conditions import cane_at_dryness
from physics.reed.cane.viscoelastic import Components
from physics.reed.reduced.elastic import viscoelastic_modes
from protocols.reed import ReedFile

_OCTAVE_CENTS = 1200
# Change of a modulus, in nepers, from which slopes are taken.
_STEP = 0.01
_DRY = Condition(np.array(1.0), np.array(0.0))


@dataclass(frozen=True)
class Drying:
    """Change of one mode's frequency from series A to series B.

    Attributes
    ----------
    printed_cents : float
        Of the paper's means.
    reeds_a, reeds_b : int
        Of which the mode was identified in series A and B.
    reed_file_cents, environment_cents : float
        Of the mean reed.
    """

    printed_cents: float
    reeds_a: int
    reeds_b: int
    reed_file_cents: float
    environment_cents: float


def drying() -> dict[str, Drying]:
    """Return the changes of the modes that both series have, by name."""
    reed = basis_of(ReedFile.from_file())
    wet, dry = (viscoelastic_modes(reed, cane_at_dryness(Components(), d)) for d in (0.0, 1.0))
    by_law = _by_law(ReedSolver(reed))
    found = {}
    for name, series in printed().observed_resonances.items():
        before, after = series.get("A"), series.get("B")
        if before is None or after is None or name not in wet or name not in dry:
            continue
        if before.mean_hz is None or after.mean_hz is None:
            continue
        found[name] = Drying(
            printed_cents=_cents(after.mean_hz, before.mean_hz),
            reeds_a=before.identified,
            reeds_b=after.identified,
            reed_file_cents=_cents(dry[name].frequency_hz, wet[name].frequency_hz),
            environment_cents=by_law[name],
        )
    return found


def _by_law(solver: ReedSolver) -> dict[str, float]:
    """Return what `physics.conditions` does to each mode, in cents, by first order."""
    nominal = BenchParameters()
    modes = solver.modes(nominal.reed)
    slopes = [
        (
            solver.modes(with_cane(nominal, **{modulus: _STEP}).reed),
            solver.modes(with_cane(nominal, **{modulus: -_STEP}).reed),
        )
        for modulus in ("E_L", "G_LT")
    ]
    return {name: _first_order(name, mode.hz, nominal, slopes) for name, mode in modes.items()}


def _first_order(
    name: str,
    hz: float,
    nominal: BenchParameters,
    slopes: list[tuple[Mapping[str, ReedMode], Mapping[str, ReedMode]]],
) -> float:
    change = change_of_cane(nominal.reed.cane, Environment(), _DRY, hz)
    by_E, by_G = (_cents(stiff[name].hz, soft[name].hz) / (2 * _STEP) for stiff, soft in slopes)
    return float(by_E * change.E_L + by_G * change.G_LT)


def _cents(after: float, before: float) -> float:
    return float(_OCTAVE_CENTS * np.log2(after / before))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m studies.closure.drying")
    parser.add_argument("--json", action="store_true")
    found = drying()
    if parser.parse_args().json:
        print(json.dumps({name: vars(row) for name, row in found.items()}, indent=1))
        return
    print("series A to B, cents")
    print("mode   paper   reeds of A, B   reed file   environment")
    for name, row in found.items():
        print(
            f"{name:<4} {row.printed_cents:7.0f} {row.reeds_a:9d} {row.reeds_b:5d}"
            f" {row.reed_file_cents:11.0f} {row.environment_cents:13.0f}"
        )


if __name__ == "__main__":
    main()
