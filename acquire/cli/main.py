"""The command line: the `acquire` command with all of its verbs.

Results go to standard output, progress and messages to standard error. Exit status: 2 for bad
input, 1 for a failed run or outputs that could not be confirmed off, 130 for an interrupt.
"""

import os
import signal
from collections.abc import Callable
from typing import Final

import typer

from acquire.cli import bench, blind, diagnose, fit, paper, plan, reeds, run, run_files
from acquire.cli.app import guarded_verb

_HELP: Final = {"help_option_names": ["-h", "--help"]}
_VERBS: Final[dict[str, Callable[..., None]]] = {
    "plan": plan.plan,
    "run": run.run,
    "pause": run_files.pause_run,
    "continue": run_files.continue_run,
    "list": run_files.list_runs,
    "show": run_files.show_run,
    "pack": run_files.pack_runs,
    "fit": fit.fit,
    "report": fit.report,
    "acoustics": fit.acoustics,
    "population": reeds.population,
    "modes": reeds.modes,
    "diagnose": diagnose.diagnose,
    "effects": diagnose.effects,
    "paper": paper.paper,
}
_BENCH_VERBS: Final[dict[str, Callable[..., None]]] = {
    "list": bench.list_found,
    "check": bench.check,
    "off": bench.off,
}
_BLIND_VERBS: Final[dict[str, Callable[..., None]]] = {"make": blind.make, "score": blind.score}


def command_line() -> typer.Typer:
    """Return the command line with all of its verbs."""
    whole = _group(
        "acquire",
        "Measure how musical reeds vibrate by sideband digital holography, and fit their cane.",
        _VERBS,
    )
    whole.add_typer(
        _group(
            "bench", "Set up a bench: find the instruments, check them, switch them off.",
            _BENCH_VERBS,
        )
    )  # fmt: skip
    whole.add_typer(
        _group("blind", "Check diagnoses on campaigns whose cause is sealed.", _BLIND_VERBS)
    )
    return whole


def _group(name: str, meaning: str, verbs: dict[str, Callable[..., None]]) -> typer.Typer:
    group = typer.Typer(
        name=name,
        help=meaning,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings=_HELP,
    )
    for verb, function in verbs.items():
        group.command(verb)(guarded_verb(function))
    return group


app = command_line()


def main() -> None:
    """Entry point of the `acquire` command."""
    # The runner has two threads. More threads within one matrix product would only wait for each
    # other. numpy's libraries read these variables when a verb first imports them.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    # `acquire pause` may send its signal just after the run has ended; it must not end the process.
    for name in ("SIGUSR1", "SIGUSR2"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    app()
