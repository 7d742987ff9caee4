"""Displacements in nm that the fit states, compared with those that frames are rendered from.

Reeds are swept on the simulated bench at full size with all noise, and their run files are fitted.
The truth is the displacement of the renderer itself: of the whole reed at every step, at the same
points of the vamp, and of each mode as the part of that motion along the mode's shape (they are
orthogonal with respect to mass), at the mode's eigenfrequency. The fit knows neither.

With ``--continuation`` nothing is fitted: displacements without noise are projected on the
functions of the fit, and continued to the contour. Their largest values differ from the truth,
because cane differs from reed to reed.

    python -m studies.amplitudes [--reeds N] [--first K] [--protocol NAME] [--continuation] [--json]
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acquire.runner.runner import run
from drivers.registry import open_bench
from fitting.cane.fit_runs import fit_runs
from holography.arrays import Array
from holography.fringes import first_sideband_maxima_m
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from studies.amplitudes.comparison import (
    Comparison,
    compare_modes,
    compare_peaks,
    model_of,
    summary,
)
from studies.amplitudes.continuation import continuation

# The fringes that the paper quotes (section II.B), and a peak of 1.5 µm: for each, the holograms
# whose largest displacement is this near to it count.
_FRINGES, _PEAK_NM, _NEAR = (1, 5, 10), 1500.0, 0.1
# Modes below this are claimed to be identified.
_HIGHEST_HZ = 16e3


def targets_nm(wavelength_m: float) -> dict[str, float]:
    """Return the displacements of the paper's bright fringes, and 1.5 µm, by name."""
    maxima_nm: Array = 1e9 * first_sideband_maxima_m(max(_FRINGES), wavelength_m)
    fringes = {f"bright fringe {n}": float(maxima_nm[n - 1]) for n in _FRINGES}
    return fringes | {"peak of 1.5 µm": _PEAK_NM}


def benchmark(reeds: int, first: int, protocol: str) -> dict[str, Any]:
    """Compare a number of reeds; the result is what ``--json`` prints."""
    plan = make_plan(Protocol.from_file(protocol), BenchFile.from_file())
    peaks: list[Comparison] = []
    modes: list[Comparison] = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, first + reeds):
            reed, path = f"amplitude-{number:02d}", Path(folder) / f"{number}.h5"
            with open_bench(plan.bench, plan.preparation(reed), number) as bench:
                if run(plan, bench, path).status != "complete":
                    raise SystemExit("interrupted")
            (sweep,) = fit_runs([path]).sweeps
            path.unlink()
            model = model_of(plan, reed)
            peaks += compare_peaks(sweep, plan, model)
            modes += compare_modes(sweep, model)
            print(f"{reed}: largest {sweep.response.largest}", file=sys.stderr, flush=True)
    return report_of(peaks, modes, float(plan.bench.optics.wavelength_m))


def report_of(
    peaks: Sequence[Comparison], modes: Sequence[Comparison], wavelength_m: float
) -> dict[str, Any]:
    """Collect what ``--json`` prints."""
    near = {
        name: [row for row in peaks if abs(row.true_nm / nm - 1) < _NEAR]
        for name, nm in targets_nm(wavelength_m).items()
    }
    below = [row for row in modes if row.hz < _HIGHEST_HZ]
    return {
        "holograms": summary(peaks),
        "targets": {
            name: {"nm": nm} | summary(near[name]) for name, nm in targets_nm(wavelength_m).items()
        },
        "modes_below_16_khz": summary(below),
        "modes_above_16_khz": summary([row for row in modes if row.hz >= _HIGHEST_HZ]),
        "modes": [asdict(row) | {"pull": row.pull} for row in modes],
        "largest_pulls": [
            asdict(row) | {"pull": row.pull}
            for row in sorted(peaks, key=lambda row: -abs(row.pull))[:5]
        ],
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a comparison for people."""
    rows = {"all holograms": report["holograms"]}
    rows |= {f"{name}, {own['nm']:.1f} nm": own for name, own in report["targets"].items()}
    rows |= {
        "modes below 16 kHz": report["modes_below_16_khz"],
        "modes above 16 kHz": report["modes_above_16_khz"],
    }
    print(
        f"{'':28} {'count':>5} {'|off| nm':>9} {'largest':>8} {'stated':>7} {'pull':>5} {'68 %':>5}"
    )
    for name, row in rows.items():
        if not row["count"]:
            print(f"{name:28} {0:5d}")
            continue
        print(
            f"{name:28} {row['count']:5d} {row['median_off_nm']:9.2f} {row['largest_off_nm']:8.2f} "
            f"{row['median_error_nm']:7.2f} {row['rms_pull']:5.2f} {row['coverage_68']:5.0%}"
        )
    for row in report["modes"]:
        print(
            f"{row['reed']} {row['name']:4} {row['hz']:8.1f} Hz  true {row['true_nm']:8.2f} nm  "
            f"stated {row['nm']:8.2f} ± {row['error_nm']:.2f} nm  pull {row['pull']:+.1f}"
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Displacements in nm of simulated sweeps.")
    parser.add_argument("--reeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="number of the first reed")
    parser.add_argument("--protocol", default="seriesA")
    parser.add_argument("--continuation", action="store_true", help="errors of the functions alone")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    compare = continuation if arguments.continuation else benchmark
    report = compare(arguments.reeds, arguments.first, arguments.protocol)
    if arguments.json or arguments.continuation:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
