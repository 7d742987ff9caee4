"""Measure reeds of the second laboratory, fit them, and compare what is stated with what is true.

``python -m studies.second_laboratory --reeds 6 --series A --folder reeds`` keeps a run file, a
truth and a fit for each sweep in the folder. What is there already is not made again;
``--fit-only`` fits again what was measured, with the fit of this checkout. The exit status is 1 if
what is stated misses a goal of the project.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import acquire
from studies.second_laboratory.bench import SENSORS, bench_file, protocol, reed_truth
from studies.second_laboratory.parameters import Disorder, draw_bench, draw_reed
from studies.second_laboratory.scoring import (
    HIGHEST_HZ,
    comparisons,
    goal_lines,
    goals,
    scores,
    table_lines,
)


def main(words: Sequence[str] | None = None) -> int:
    """Run the program; return its exit status."""
    asked = _parser().parse_args(words)
    asked.folder.mkdir(parents=True, exist_ok=True)
    found, refused, possible, sweeps = [], {}, dict[str, int](), 0
    for series in asked.series:
        for seed in range(asked.seed, asked.seed + asked.reeds):
            path = asked.folder / f"{series}-{asked.sensor}-{seed}.h5"
            if not asked.fit_only:
                _measure(path, series, asked.sensor, seed, dict(asked.disorder), asked.drive)
            elif not path.exists():
                continue
            truth = json.loads(path.with_suffix(".truth.json").read_text("utf-8"))
            sweeps += 1
            fit = _fit(path, again=asked.fit_only)
            for name, mode in truth["modes"].items():
                possible[name] = possible.get(name, 0) + (mode["hz"] < HIGHEST_HZ)
            if "refused" in fit:
                refused[path.stem] = fit["refused"]
            else:
                found += comparisons(path.stem, series, fit, truth)
            print(f"{path.stem}: {_summary(fit)}", file=sys.stderr, flush=True)
    table = scores(found, possible, sweeps)
    reached = goals(found, table)
    if asked.json:
        rows = [score.to_json() for score in table]
        wanted = [goal.to_json() for goal in reached]
        print(json.dumps({"scores": rows, "goals": wanted, "refused": refused}, indent=1))
    else:
        print(*table_lines(table), *(f"refused: {k}: {v}" for k, v in refused.items()), sep="\n")
        print(*goal_lines(reached), sep="\n")
    return int(not all(goal.reached for goal in reached))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m studies.second_laboratory")
    parser.add_argument("--reeds", type=int, default=6, help="number of reeds (6)")
    parser.add_argument("--series", nargs="+", choices=["A", "B"], default=["A"])
    parser.add_argument("--sensor", choices=list(SENSORS), default="small")
    parser.add_argument("--seed", type=int, default=1, help="of the first reed (1)")
    parser.add_argument("--drive", type=float, default=1.0, help="factor of the paper's volts (1)")
    parser.add_argument(
        "--disorder",
        nargs="*",
        type=_amount,
        default=[],
        metavar="NAME=AMOUNT",
        help="amounts of disorder, 0 is off; all=0 switches off what is not named",
    )
    parser.add_argument("--folder", type=Path, default=Path("measurements/second-laboratory"))
    parser.add_argument("--fit-only", action="store_true", help="fit again, measure nothing")
    parser.add_argument("--json", action="store_true")
    return parser


def _amount(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    return name, float(value)


def _measure(
    path: Path, series: str, sensor: str, seed: int, disorder: Mapping[str, float], drive: float
) -> None:
    """Write the run file of a sweep and the truth of its reed, unless they are there."""
    truth = path.with_suffix(".truth.json")
    ranges = Disorder().scaled(disorder)
    if not truth.exists():
        reed, bench = draw_reed(ranges, series, seed), draw_bench(ranges, seed)
        truth.write_text(json.dumps(reed_truth(reed, bench), indent=1), "utf-8")
    if _complete(path):
        return
    sweep = protocol(series, sensor)
    volts = {"drive.from": f"{0.5 * drive:g} V", "drive.to": f"{16 * drive:g} V"}
    # The shipped policy stops at eight bad steps in a row, and weak holograms are bad steps.
    patience = {"policy.give_up_after": len(sweep.sweep.indices)}
    plan = acquire.plan(
        sweep.replace({**volts, **patience}), bench_file(series, seed, seed, disorder)
    )
    acquire.run(plan, path, reed=f"S{seed}", seed=seed)


def _complete(path: Path) -> bool:
    """Whether a sweep is measured; the files of one that was interrupted are removed."""
    if path.exists():
        with acquire.open_run(path) as run:
            if run.status == "complete":
                return True
    for file in (path, path.with_suffix(".documents.jsonl"), path.with_suffix(".fit.json")):
        file.unlink(missing_ok=True)
    return False


def _fit(path: Path, again: bool) -> dict[str, Any]:
    """Return the JSON of ``acquire fit``, or the reason why there is none."""
    kept = path.with_suffix(".fit.json")
    if again or not kept.exists():
        command = [sys.executable, "-m", "acquire", "fit", str(path), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        answer = done.stdout if done.returncode == 0 else json.dumps({"refused": done.stderr})
        kept.write_text(answer, "utf-8")
    return dict(json.loads(kept.read_text("utf-8")))


def _summary(fit: Mapping[str, Any]) -> str:
    return fit["refused"].strip() if "refused" in fit else f"{len(fit['modes'])} modes"


if __name__ == "__main__":
    sys.exit(main())
