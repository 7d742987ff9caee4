"""Resonances of reeds that differ from the fit's model: joint fit, pictures, a public library.

Reeds of `studies.wrong_reeds` are swept in series A and B with all noise; every run is fitted
jointly and by pictures; and sdypy-EMA is given the same amplitudes, if it is installed. Errors are
those from the eigenfrequencies of the reed that the bench plays. All that the joint fit states with
a standard error, losses and cane too, is scored as in `studies.second_laboratory`, with the same
goals. The last runs have nothing to be identified.

    python -m studies.identification [--folder DIR] [--reeds N] [--jobs N] [--json]

Runs and fits that are in the folder already are not made again: a fit is ``<run>.judged.json``.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pydantic import TypeAdapter

from acquire.runner.runner import run
from drivers.registry import open_bench
from fitting.acoustics.lines import SweepPeaks, Verdict, acoustic_lines
from fitting.cane.fit_runs import fit_runs, fit_sweep, fit_sweep_jointly
from fitting.errors import FitError
from fitting.forward import basis_of, finite_element_model
from fitting.modal.identify import JointFit
from holography.arrays import Array
from physics.reed.cane.viscoelastic import Series
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from protocols.reed import ReedFile
from runs.reader import Run
from studies.modal_peer import LIBRARY, peer_modes, peer_version
from studies.second_laboratory.scoring import (
    Comparison,
    Goal,
    Score,
    comparisons,
    goal_lines,
    goals,
    scores,
    table_lines,
)
from studies.wrong_reeds import WrongRun, make_run

# Modes that are to be identified in every reed, and longest time of a fit.
CLAIMED = ("F1", "T1", "F2", "T2", "T3", "F3", "X2")
FIT_S = 10.0
# A name that the reed's own finite elements hardly know is no truth.
_LEAST_SIMILARITY = 0.5
# Number of points of the reed that the library is given.
_PEER_POINTS = 60
_METHODS = ("joint", "picture", LIBRARY)
# More bad steps in a row than a sweep has.
_NEVER = 10_000


@dataclass(frozen=True)
class Judged:
    """One run: errors in cents by method and mode, what the joint fit states, seconds."""

    run: str
    series: Series
    error_cents: dict[str, dict[str, float]]
    stated_cents: dict[str, float]
    stated: list[Comparison]
    true_names: list[str]
    joint_s: float
    picture_s: float
    drive_peaks: SweepPeaks


def judge(path: Path) -> Judged:
    """Fit one run in every way, and compare it with its truth."""
    truth = json.loads(path.with_suffix(".truth.json").read_text(encoding="utf-8"))
    true_hz = {
        name: mode["hz"]
        for name, mode in truth["modes"].items()
        if mode["similarity"] > _LEAST_SIMILARITY
    }
    start_s = time.perf_counter()
    fit = fit_runs([path])
    middle_s = time.perf_counter()
    with Run.open(path) as opened:
        reed = basis_of(opened.reed_file())
        pictures = fit_sweep(opened, reed, finite_element_model(reed))
    end_s = time.perf_counter()
    sweep = fit.sweeps[0]
    found = {name: mode.frequency_hz for name, mode in sweep.resonances.items()}
    joint = sweep.joint
    by_method = {
        "joint": found,
        "picture": {name: mode.frequency_hz for name, mode in pictures.resonances.items()},
        LIBRARY: _by_library(joint, found) if joint and peer_version() else {},
    }
    return Judged(
        path.stem,
        Series(truth["series"]),
        {
            method: {
                n: 1200 * float(np.log2(hz / true_hz[n])) for n, hz in modes.items() if n in true_hz
            }
            for method, modes in by_method.items()
        },
        {name: mode.error_cents for name, mode in sweep.resonances.items()},
        comparisons(path.stem, truth["series"], fit.to_json(), truth),
        list(true_hz),
        middle_s - start_s,
        end_s - middle_s,
        sweep.drive_peaks,
    )


def _kept_or_judged(path: Path) -> Judged:
    """Read what an earlier call kept of this run, or fit the run and keep it."""
    kept = path.with_suffix(".judged.json")
    fields = TypeAdapter(Judged)
    if kept.exists():
        return fields.validate_json(kept.read_bytes())
    judged = judge(path)
    kept.write_bytes(fields.dump_json(judged, indent=1))
    return judged


def _by_library(joint: JointFit, expected_hz: Mapping[str, float]) -> dict[str, float]:
    """Let the public library find modes in the same amplitudes.

    It is given what it cannot know: amplitudes of holograms have any phase, and the drive is no
    input that was measured; both are divided out as the joint fit found them. Poles are looked for
    near the frequencies that the joint fit found.
    """
    functions = joint.basis.functions
    points = np.linspace(0, len(functions) - 1, _PEER_POINTS).astype(int)
    reached = joint.displacements.reached
    response = (joint.displacements.amplitude_rad / joint.modal.drive[:, None])[reached]
    modes = peer_modes(
        joint.block_amplitudes.drive_hz[reached],
        response @ functions[points].T.astype(float),
        expected_hz,
    )
    return {name: mode.hz for name, mode in modes.items()}


def table(judged: Sequence[Judged], series: Series) -> dict[str, dict[str, Any]]:
    """By mode and method: how often it was found, bias and standard deviation; coverage."""
    of_series = [j for j in judged if j.series is series]
    rows: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(n for j in of_series for n in j.true_names):
        row: dict[str, Any] = {"reeds": sum(name in j.true_names for j in of_series)}
        for method in _METHODS:
            errors = np.array(
                [j.error_cents[method][name] for j in of_series if name in j.error_cents[method]]
            )
            row[method] = {
                "found": len(errors),
                "bias_cents": float(errors.mean()) if len(errors) else None,
                "sd_cents": float(errors.std(ddof=1)) if len(errors) > 1 else None,
                "farthest_cents": float(np.abs(errors).max()) if len(errors) else None,
            }
        normalised = _normalised(of_series, (name,))
        row["coverage"] = float(np.mean(normalised < 1)) if len(normalised) else None
        rows[name] = row
    return rows


def _normalised(judged: Sequence[Judged], names: Sequence[str]) -> Array:
    """Errors of the joint fit over its standard errors."""
    return np.array(
        [
            abs(j.error_cents["joint"][name]) / j.stated_cents[name]
            for j in judged
            for name in names
            if name in j.error_cents["joint"]
        ]
    )


def _scores(judged: Sequence[Judged]) -> list[Score]:
    """Score all that is stated with a standard error."""
    names = Counter(name for each in judged for name in each.true_names)
    return scores([one for each in judged for one in each.stated], names, len(judged))


def summary(judged: Sequence[Judged]) -> dict[str, Any]:
    """All that is claimed, and whether it holds."""
    tables = {str(series): table(judged, series) for series in Series}
    claimed = [tables["A"][name] for name in CLAIMED if name in tables["A"]]
    stated = [one for each in judged for one in each.stated]
    seconds = [j.joint_s for j in judged]
    return {
        "runs": len(judged),
        "reeds": len({each.drive_peaks.reed for each in judged}),
        "library": peer_version(),
        "modes": tables,
        "stated": {
            str(series): [
                score.to_json() for score in _scores([j for j in judged if j.series is series])
            ]
            for series in Series
        },
        "goals": [goal.to_json() for goal in goals(stated, _scores(judged))],
        "acoustic_lines": [
            line.to_json()
            for line in acoustic_lines([each.drive_peaks for each in judged])
            if line.verdict is Verdict.BENCH
        ],
        "fit_s": {
            "median": float(np.median(seconds)),
            "most": max(seconds),
            "longer": sum(s > FIT_S for s in seconds),
        },
        "found_all": all(row["joint"]["found"] == row["reeds"] for row in claimed),
        "time_met": max(seconds) <= FIT_S,
    }


# --- Nothing to be identified ------------------------------------------------------------------


def _still() -> Protocol:
    """Return a protocol with next to no volts: as if the loudspeaker were not connected."""
    drive = {"law": "ramp", "from": "1e-6 V", "to": "3.2e-5 V", "first": 1, "last": 73}
    return Protocol.from_file("seriesA").replace(drive=drive)


def _still_run(path: Path) -> None:
    """Sweep a still reed: the run gives up after some steps without light."""
    _sweep(path, _still(), None)


def _wrong_kind_run(path: Path) -> None:
    """Sweep a bass clarinet's reed where the protocol says a clarinet's."""
    _sweep(path, Protocol.from_file("seriesA"), ReedFile.from_file("bass-clarinet"))


def _noise_run(path: Path) -> None:
    """Sweep a still reed, and call every step good: all there is in the holograms is noise."""
    still = _still()
    patient = still.policy.model_copy(update={"give_up_after": _NEVER})
    _sweep(path, still.replace(policy=patient), None)
    with h5py.File(path, "r+") as file:
        file["entry/steps/verdict"][...] = b"ok"


def _sweep(path: Path, protocol: Protocol, kind: ReedFile | None) -> None:
    bench = BenchFile.from_file()
    plan = make_plan(protocol, bench)
    preparation = plan.preparation("R07")
    if kind:
        preparation = replace(preparation, geometry=kind.geometry(), constants=kind.constants())
    with open_bench(bench, preparation, seed=3) as opened:
        run(plan, opened, path)


NOTHING: Mapping[str, Callable[[Path], None]] = {
    "loudspeaker off": _still_run,
    "noise alone": _noise_run,
    "a reed of another kind": _wrong_kind_run,
}


def judge_nothing(folder: Path) -> dict[str, dict[str, Any]]:
    """What the joint fit says where there is nothing for it."""
    answer = {}
    for case, make in NOTHING.items():
        path = folder / f"{case.replace(' ', '-')}.h5"
        make(path)
        with Run.open(path) as opened:
            reed = basis_of(opened.reed_file())
            try:
                sweep = fit_sweep_jointly(opened, reed, finite_element_model(reed))
                answer[case] = {"identified": list(sweep.resonances), "said": ""}
            except FitError as error:
                answer[case] = {"identified": [], "said": str(error).removeprefix(f"{path}: ")}
    return answer


# --- Printing ----------------------------------------------------------------------------------


def _print_tables(result: dict[str, Any]) -> None:
    for series, rows in result["modes"].items():
        print(f"series {series}, errors in cents: bias ± standard deviation (found), farthest")
        print(f"{'mode':7}{'reeds':>6}" + "".join(f"{m:>32}" for m in _METHODS) + "  68 % cover")
        for name, row in rows.items():
            cells = "".join(f"{_cell(row[method]):>32}" for method in _METHODS)
            covered = "" if row["coverage"] is None else f"{row['coverage']:11.0%}"
            print(f"{name:7}{row['reeds']:6d}{cells}{covered}")
    for series, stated in result["stated"].items():
        print(f"series {series}, all that is stated with a standard error, below 16 kHz")
        print(*table_lines([Score(**_numbers(row)) for row in stated]), sep="\n")


def _numbers(row: Mapping[str, Any]) -> dict[str, Any]:
    """Replace what is unknown by not-a-number."""
    return {key: float("nan") if value is None else value for key, value in row.items()}


def _cell(errors: Mapping[str, Any]) -> str:
    if not errors["found"]:
        return "not found"
    sd = "" if errors["sd_cents"] is None else f" ± {errors['sd_cents']:.2f}"
    return f"{errors['bias_cents']:+.2f}{sd} ({errors['found']}), {errors['farthest_cents']:.1f}"


def _print_claims(result: dict[str, Any]) -> None:
    def met(key: str) -> str:
        return "met" if result[key] else "missed"

    seconds = result["fit_s"]
    print(*goal_lines([Goal(**goal) for goal in result["goals"]]), sep="\n")
    print(f"{', '.join(CLAIMED)} identified in every reed of series A: {met('found_all')}")
    print(
        f"a run is fitted in {seconds['median']:.1f} s, {seconds['most']:.1f} s at most, "
        f"{seconds['longer']} of {result['runs']} longer than {FIT_S:g} s: {met('time_met')}"
    )
    for line in result["acoustic_lines"]:
        print(
            f"acoustic line at {line['hz']:.1f} ± {line['error_hz']:.1f} Hz, "
            f"{line['height_db']:+.1f} dB, in {line['reeds']} of {line['of']} reeds"
        )
    for case, said in result["nothing"].items():
        found = ", ".join(said["identified"]) or "nothing identified"
        print(f"{case}: {found}: {said['said']}")


def benchmark(folder: Path, reeds: int, jobs: int) -> dict[str, Any]:
    """Make the runs that are not there, fit all of them, and judge."""
    wanted = [WrongRun(folder, k, series) for k in range(reeds) for series in Series]
    missing = [w for w in wanted if not w.path.with_suffix(".truth.json").exists()]
    with ProcessPoolExecutor(jobs) as pool:
        for line in pool.map(make_run, missing):
            print(line, file=sys.stderr, flush=True)
    judged = []
    for number, each in enumerate(wanted, 1):
        print(f"\rfitting run {number} of {len(wanted)}", end="", file=sys.stderr, flush=True)
        judged.append(_kept_or_judged(each.path))
    print(file=sys.stderr)
    with tempfile.TemporaryDirectory() as place:
        return {**summary(judged), "nothing": judge_nothing(Path(place))}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Resonances of reeds that the fit does not know.")
    parser.add_argument("--folder", type=Path, help="where runs are, and kept")
    parser.add_argument("--reeds", type=int, default=24, help="how many, each in series A and B")
    parser.add_argument("--jobs", type=int, default=2, help="runs made at a time")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = arguments.folder or Path(place)
        folder.mkdir(parents=True, exist_ok=True)
        result = benchmark(folder, arguments.reeds, arguments.jobs)
    if arguments.json:
        print(json.dumps(result, indent=1))
    else:
        _print_tables(result)
        _print_claims(result)
    nothing = all(not case["identified"] for case in result["nothing"].values())
    reached = result["time_met"] and all(Goal(**goal).reached for goal in result["goals"])
    sys.exit(0 if nothing and reached else 1)


if __name__ == "__main__":
    main()
