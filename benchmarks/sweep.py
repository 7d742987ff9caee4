"""Time and memory of `acquire run` at full size: sweep, fit and pictures in one process.

    python -m benchmarks.sweep [--protocol NAME] [--json]

The run is a process of its own, as a technician starts it; its peak memory is what the operating
system says of it.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TARGET_S, TARGET_MIB = 60.0, 2048.0


def benchmark(protocol: str) -> dict[str, Any]:
    """Run one sweep; the result is what ``--json`` prints."""
    load_before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "acquire", "run", protocol, "--reed", "R01", "--json"]
        command += ["--out", str(Path(folder, "run.h5"))]
        start_s = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        taken_s = time.perf_counter() - start_s
    # KiB on Linux; of the largest child so far, which is the only one.
    peak_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    answer = json.loads(done.stdout)
    return {
        "protocol": protocol,
        "seconds": taken_s,
        "peak_mib": peak_mib,
        "verdicts": answer["verdicts"],
        "modes": list(answer["fit"]["modes"]),
        "load_before": load_before,
        "time_met": taken_s <= TARGET_S,
        "memory_met": peak_mib <= TARGET_MIB,
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    print(
        f"{report['protocol']}: sweep, fit and pictures in {report['seconds']:.1f} s "
        f"(target {TARGET_S:g} s: {'met' if report['time_met'] else 'missed'}), peak memory "
        f"{report['peak_mib']:.0f} MiB (target {TARGET_MIB:g} MiB: "
        f"{'met' if report['memory_met'] else 'missed'}), load before {report['load_before']:.1f}"
    )
    print(f"verdicts {report['verdicts']}, modes {' '.join(report['modes'])}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Time and memory of a full sweep.")
    parser.add_argument("--protocol", default="seriesA")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = benchmark(arguments.protocol)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
