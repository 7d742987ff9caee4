"""Print every figure of speed, memory and robustness that is claimed: ``python -m benchmarks``."""

import sys

from studies.run_all import run_all

COMMANDS = (
    "benchmarks.holography",
    "benchmarks.reduced_basis",
    "benchmarks.populations",
    "benchmarks.sweep",
    "benchmarks.kills",
    "benchmarks.faults",
    "benchmarks.soak",
    "benchmarks.fuzz",
    "benchmarks.pace",
    "benchmarks.watching",
)
DESCRIPTION = "Print every figure of speed, memory and robustness that is claimed."

if __name__ == "__main__":
    sys.exit(run_all(COMMANDS, "python -m benchmarks", DESCRIPTION))
