"""How large a vibration may be: errors of frequencies and losses from 1 to 100 rad.

A reed is swept on the simulated bench at full size with all noise, with volts for which its largest
displacement is as asked, and with one or several sidebands at every step. The truth is that of the
bench's own reed. A mode may be right, with its stated error, or refused; what is stated wrongly is
counted.

    python -m studies.amplitudes.large [--rad R ...] [--orders 1 0,1,2 ...] [--json]
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from acquire.runner.runner import run
from drivers.registry import open_bench
from drivers.simulated.settings import cane_of
from fitting.cane.fit_runs import fit_runs
from fitting.cane.sweep_fit import SweepFit
from fitting.errors import FitError
from fitting.forward import basis_of
from physics.mechanics import Mechanics, ReedSolver
from physics.reed.cane.viscoelastic import Series, viscoelastic_cane
from protocols.bench import BenchFile
from protocols.plan import Plan, make_plan
from protocols.protocol import Protocol
from studies.amplitudes.comparison import model_of

_REED, _SEED = "large", 1
# Modes below this are claimed to be identified.
_HIGHEST_HZ = 16e3
# A mode that is farther off than both is stated wrongly.
_MOST_PULLS, _MOST_CENTS = 5.0, 8.0
# Points of the vamp at which the largest displacement is looked for, in m.
_VAMP_X_M, _VAMP_Y_M = np.linspace(0.3e-3, 30e-3, 60), np.linspace(-6e-3, 6e-3, 31)


@dataclass(frozen=True)
class Row:
    """One sweep.

    Attributes
    ----------
    rad : float
        Largest displacement of all steps.
    orders : tuple of int
        Recorded sidebands.
    refused : str
        Why nothing was fitted; empty if something was.
    wrong_fringe : int
        Holograms that the fit calls outliers.
    modes : dict
        For each identified mode below 16 kHz: error and stated error in cents, and of the log of
        the loss factor.
    """

    rad: float
    orders: tuple[int, ...]
    refused: str
    wrong_fringe: int
    modes: dict[str, tuple[float, float, float, float]]

    @property
    def wrong(self) -> list[str]:
        """Modes that are stated wrongly."""
        return [
            name
            for name, (off, stated, _, _) in self.modes.items()
            if abs(off) > max(_MOST_PULLS * stated, _MOST_CENTS)
        ]


def measure(rad: float, orders: tuple[int, ...], folder: Path) -> Row:
    """Sweep and fit a reed whose largest displacement is `rad`."""
    plan = _plan(1.0, orders)
    plan = _plan(rad / largest_rad(plan), orders)
    path = folder / f"{rad:g}-{len(orders)}.h5"
    with open_bench(plan.bench, plan.preparation(_REED), _SEED) as bench:
        if run(plan, bench, path).status != "complete":
            raise SystemExit("interrupted")
    try:
        (sweep,) = fit_runs([path]).sweeps
    except FitError as error:
        return Row(rad, orders, str(error), 0, {})
    finally:
        path.unlink()
    off = 0 if sweep.joint is None else int(np.count_nonzero(sweep.joint.modal.off))
    return Row(rad, orders, "", off, _compared(sweep))


def _plan(factor: float, orders: tuple[int, ...]) -> Plan:
    """Series A with volts times a factor, and limits that admit them."""
    protocol = Protocol.from_file("seriesA").replace(
        {
            "drive.from": f"{0.5 * factor:.6g} V",
            "drive.to": f"{16 * factor:.6g} V",
            "sideband.orders": list(orders),
            # The shipped policy stops at eight bad steps in a row, and faint holograms are bad.
            "policy.give_up_after": 184 * len(orders),
        }
    )
    bench = BenchFile.from_file().replace({"limits.volts_max": f"{max(16, 16 * factor):.6g} V"})
    return make_plan(protocol, bench)


def largest_rad(plan: Plan) -> float:
    """Return the largest phase amplitude on the vamp, of all steps of a plan."""
    x_m, y_m = (part.ravel() for part in np.meshgrid(_VAMP_X_M, _VAMP_Y_M))
    drives = [(step.drive_hz, float(step.volts)) for step in plan.steps]
    moved_m = model_of(plan, _REED).displacement_at_m(x_m, y_m, drives)
    return float(4 * np.pi * np.abs(moved_m).max() / float(plan.bench.optics.wavelength_m))


def _compared(sweep: SweepFit) -> dict[str, tuple[float, float, float, float]]:
    cane = viscoelastic_cane(cane_of(sweep.reed), Series(sweep.series))
    modes = ReedSolver(basis_of(sweep.reed_file)).modes(Mechanics(cane=cane))
    return {
        name: (
            1200 * float(np.log2(stated.frequency_hz / modes[name].hz)),
            stated.error_cents,
            float(np.log((stated.loss_factor or np.nan) / modes[name].loss_factor)),
            stated.loss_error or np.nan,
        )
        for name, stated in sweep.resonances.items()
        if name in modes and modes[name].hz < _HIGHEST_HZ
    }


def table_lines(rows: Sequence[Row]) -> list[str]:
    """Return a table for people."""
    lines = [
        f"{'rad':>5} {'orders':9} {'modes':>5} {'T1 cents':>13} {'T1 loss %':>12} {'farthest':>9} "
        f"{'rms pull':>8} {'loss pull':>9} {'off':>4} wrong"
    ]
    for row in rows:
        orders = ",".join(map(str, row.orders))
        if not row.modes:
            lines.append(f"{row.rad:5.0f} {orders:9} {row.refused or 'no mode identified'}")
            continue
        cents, stated, loss, loss_stated = np.array(list(row.modes.values())).T
        first = row.modes.get("T1", (np.nan,) * 4)
        lines.append(
            f"{row.rad:5.0f} {orders:9} {len(cents):5d} {first[0]:+6.2f} ± {first[1]:4.2f} "
            f"{100 * first[2]:+5.1f} ± {100 * first[3]:4.1f} {np.abs(cents).max():9.2f} "
            f"{np.sqrt(np.mean((cents / stated) ** 2)):8.2f} "
            f"{np.sqrt(np.mean((loss / loss_stated) ** 2)):9.2f} {row.wrong_fringe:4d} "
            f"{' '.join(row.wrong) or '-'}"
        )
    return lines


def _orders(text: str) -> tuple[int, ...]:
    return tuple(int(each) for each in text.split(","))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Errors of a fit at large displacements.")
    parser.add_argument("--rad", nargs="+", type=float, default=[1, 3, 10, 30, 60, 100])
    parser.add_argument("--orders", nargs="+", type=_orders, default=[(1,), (0, 1, 2)])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    asked = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for orders in asked.orders:
            for rad in asked.rad:
                rows.append(measure(rad, orders, Path(folder)))
                print(table_lines(rows[-1:])[1], file=sys.stderr, flush=True)
    if asked.json:
        print(json.dumps({"rows": [asdict(row) | {"wrong": row.wrong} for row in rows]}, indent=1))
    else:
        print(*table_lines(rows), sep="\n")


if __name__ == "__main__":
    main()
