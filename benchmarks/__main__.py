"""Print every figure that the project claims: ``python -m benchmarks``."""

import subprocess
import sys

# Each in a process of its own: what one leaves in memory does not slow the next.
MODULES = (
    "benchmarks.holography",
    "benchmarks.convergence",
    "benchmarks.reduced_basis",
    "benchmarks.populations",
    "benchmarks.sweep",
    "benchmarks.kills",
    "benchmarks.faults",
    "benchmarks.soak",
    "benchmarks.fuzz",
    "benchmarks.independence",
    "benchmarks.pace",
    "benchmarks.watching",
    "benchmarks.recovery",
    "benchmarks.identification",
    "benchmarks.reach",
    "benchmarks.leaks",
    "benchmarks.inverse_crime",
    "benchmarks.sealed_sets",
)


def main() -> int:
    """Run all benchmarks; the exit status is that of the worst."""
    worst = 0
    for module in MODULES:
        print(f"== {module}", flush=True)
        worst = max(worst, subprocess.run([sys.executable, "-m", module], check=False).returncode)
    return worst


if __name__ == "__main__":
    sys.exit(main())
