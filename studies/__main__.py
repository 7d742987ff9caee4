"""Print every figure of accuracy that the project claims: ``python -m studies``."""

import sys

from studies.run_all import run_all

COMMANDS = (
    "studies.convergence",
    "studies.reduced_basis",
    "studies.populations",
    "studies.closure.drying",
    "studies.independence",
    "studies.recovery",
    "studies.identification",
    "studies.second_laboratory --reeds 24 --seed 501 --series A B",
    "studies.amplitudes",
    "studies.amplitudes.large",
    "studies.reach",
    "studies.sealed.leaks",
    "studies.closure",
    "studies.inverse_crime",
    "studies.sealed_sets",
)
DESCRIPTION = "Print every figure of accuracy that the project claims."

if __name__ == "__main__":
    sys.exit(run_all(COMMANDS, "python -m studies", DESCRIPTION))
