"""Whether many runs in one process leave it as it was, and whether rival programs harm each other.

Twenty runs on the simulated bench, on the emulated bench, runs that fail half way, and fits, all in
one process: after a few runs to warm up, memory, open files and threads must not grow. Six
processes that start at once with an empty cache must compute the reed once and measure the same
pixels. Two programs that want the same run file or the same campaign folder at once: one must
measure, the other must end with exit status 2 and one line that says why, and nothing may be
harmed.

    python -m benchmarks.soak [--runs N] [--rounds N] [--json]
"""

import argparse
import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.soaking.contention import RIVALRIES, Files, on_an_empty_cache, rivalry
from benchmarks.soaking.leaks import LIMITS, WARM_UP, series, works


def benchmark(runs: int, rounds: int) -> dict[str, Any]:
    """Soak; the result is what ``--json`` prints."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # First: later this process may have threads, and could not be forked.
        files = Files.write(folder)
        cold = on_an_empty_cache(6, files)
        rivals = [rivalry(each, rounds, files) for each in RIVALRIES]
        all_series = [series(each, work, runs) for each, work in works(folder).items()]
    return {
        "runs": runs,
        "series": [
            {
                "name": one.name,
                **{each: one.values(each) for each in LIMITS},
                "slopes": one.slopes,
                "leaks": one.leaks,
            }
            for one in all_series
        ],
        "limits": LIMITS,
        "empty_cache": {**asdict(cold), "met": cold.met},
        "rivalries": [{**asdict(one), "met": one.met} for one in rivals],
        "met": cold.met
        and all(one.met for one in rivals)
        and not any(one.leaks for one in all_series),
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    for one in report["series"]:
        print(f"{one['name']}, {report['runs']} in one process after {WARM_UP} to warm up:")
        for name, limit in report["limits"].items():
            scale, unit = (1e6, "MB") if name == "memory_bytes" else (1, "")
            shown = " ".join(f"{value / scale:.4g}" for value in one[name])
            per_run, error = (value / scale for value in one["slopes"][name])
            print(
                f"  {name.removesuffix('_bytes'):8} {per_run:+.3f} ± {error:.3f} {unit} per run, "
                f"limit {limit / scale:g} ({_verdict(name not in one['leaks'])}): {shown}"
            )
    cold = report["empty_cache"]
    print(
        f"{cold['processes']} processes on an empty cache: {cold['complete']} complete, "
        f"{cold['identical']} with identical pixels; {cold['built']} computed the reed, "
        f"{cold['waited']} said that they wait; {cold['entries']} file in the cache "
        f"({_verdict(cold['met'])})"
    )
    for one in report["rivalries"]:
        print(
            f"{one['name']}, {one['rounds']} times: one measured and the other ended with status 2 "
            f"in {one['decided']}, said why in one line in {one['explained']}, harmed nothing in "
            f"{one['unharmed']} ({_verdict(one['met'])})"
        )
        for reason in one["reasons"]:
            print(f"    {reason}")


def _verdict(met: bool) -> str:
    return "met" if met else "missed"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="runs of each series")
    parser.add_argument("--rounds", type=int, default=10, help="rounds of each rivalry")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    if arguments.runs < 3 or arguments.rounds < 1:
        parser.error("--runs must be at least 3, --rounds at least 1")
    report = benchmark(arguments.runs, arguments.rounds)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)
    sys.exit(not report["met"])


if __name__ == "__main__":
    main()
