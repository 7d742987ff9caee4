"""Run several modules one after the other, each in a process of its own."""

import subprocess
import sys
from collections.abc import Sequence


def run_all(modules: Sequence[str]) -> int:
    """Run modules as programs; return the largest exit status.

    Each has a process of its own, so that memory left by one does not slow the next.
    """
    worst = 0
    for module in modules:
        print(f"== {module}", flush=True)
        worst = max(worst, subprocess.run([sys.executable, "-m", module], check=False).returncode)
    return worst
