"""The time that a sweep takes with a camera that runs at its real pace.

The simulated bench renders every frame while it is exposed, so instruments, camera, reconstruction,
judgement and writing share two cores as they would with real light. It is compared with the limit:
1.3 times the time that the frames themselves take.

    python -m benchmarks.pace [--protocol NAME] [--json]
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import acquire
from protocols.bench import BenchFile
from runs.reader import Run
from runs.verdict import Verdict

LIMIT_RATIO = 1.30


def benchmark(protocol: str) -> dict[str, Any]:
    """Measure one sweep; the result is what ``--json`` prints."""
    bench = BenchFile.from_file().replace({"twin": {"pace": "realtime"}})
    plan = acquire.plan(acquire.load(protocol), bench).plan
    exposed_s = sum(s.frames for s in plan.steps) / float(plan.protocol.camera.frame_rate_hz)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.h5")
        summary = acquire.run(plan, path, reed="pace").summary
        with Run.open(path) as run:
            period_s = float(1 / run.frame_rate_hz)
            starts_s = [step.timestamps_s[0] for step in run if step.timestamps_s]
            periods = np.round(np.diff(starts_s) / period_s).astype(int)
            took_s = run.steps[-1].timestamps_s[-1] + period_s - run.steps[0].changed_s
    return {
        "protocol": protocol,
        "steps": len(plan.steps),
        "good": summary.counts.get(Verdict.OK, 0),
        "load": os.getloadavg()[0],
        "frames_s": exposed_s,
        "sweep_s": took_s,
        "command_s": summary.duration_s,
        "ratio": took_s / exposed_s,
        "ratio_with_opening_and_closing": summary.duration_s / exposed_s,
        "periods_per_step": {str(n): int(np.sum(periods == n)) for n in sorted(set(periods))},
        "met": summary.duration_s <= LIMIT_RATIO * exposed_s,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="A sweep at the camera's real pace.")
    parser.add_argument("--protocol", default="seriesA")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    print("a sweep takes over a minute", file=sys.stderr)
    report = benchmark(arguments.protocol)
    if arguments.json:
        print(json.dumps(report, indent=2))
        return
    print(
        f"{report['protocol']}: {report['steps']} steps, {report['good']} good; the frames take "
        f"{report['frames_s']:.1f} s, the sweep {report['sweep_s']:.1f} s ({report['ratio']:.2f}), "
        f"with opening and closing {report['command_s']:.1f} s "
        f"({report['ratio_with_opening_and_closing']:.2f}; up to {LIMIT_RATIO:.2f}: "
        f"{'met' if report['met'] else 'missed'})"
    )
    shown = ", ".join(
        f"{n} steps of {periods}" for periods, n in report["periods_per_step"].items()
    )
    print(f"frame periods from step to step: {shown}; load {report['load']:.1f}")


if __name__ == "__main__":
    main()
