"""Print every figure of accuracy that the project claims: ``python -m studies``."""

import sys

from studies.run_all import run_all

MODULES = (
    "studies.convergence",
    "studies.reduced_basis",
    "studies.populations",
    "studies.independence",
    "studies.recovery",
    "studies.identification",
    "studies.amplitudes",
    "studies.amplitudes.large",
    "studies.reach",
    "studies.sealed.leaks",
    "studies.closure",
    "studies.inverse_crime",
    "studies.sealed_sets",
)

if __name__ == "__main__":
    sys.exit(run_all(MODULES))
