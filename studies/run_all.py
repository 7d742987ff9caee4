"""Run several modules one after the other, each in a process of its own."""

import argparse
import subprocess
import sys
from collections.abc import Sequence


def run_all(
    commands: Sequence[str], program: str, description: str, words: Sequence[str] | None = None
) -> int:
    """Run modules as programs; return the largest exit status.

    Each has a process of its own, so that memory left by one does not slow the next.

    Parameters
    ----------
    commands : sequence of str
        Module and arguments.
    program, description : str
        How it is called, and what it prints.
    words : sequence of str, optional
        Arguments of the program; by default those of this process.
    """
    by_module = {command.split()[0]: command for command in commands}
    parser = argparse.ArgumentParser(prog=program, description=description)
    parser.add_argument("module", nargs="*", help=f"by default all: {', '.join(by_module)}")
    asked = parser.parse_args(words).module
    if unknown := sorted(set(asked) - set(by_module)):
        parser.error(f"unknown: {', '.join(unknown)}; choose from {', '.join(by_module)}")
    worst = 0
    for module in asked or by_module:
        print(f"== {module}", flush=True)
        run = [sys.executable, "-m", *by_module[module].split()]
        worst = max(worst, subprocess.run(run, check=False).returncode)
    return worst
