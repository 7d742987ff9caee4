"""What all verbs share: common options, and errors as one line with an exit status."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from acquire.cli.console import show_message
from acquire.errors import FAILED, INTERRUPTED
from holography.errors import BenchError
from reports.plain_text import one_line

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the Python traceback of an error.")]
BenchOption = Annotated[
    str, typer.Option("--bench", help="Bench file, or the name of a shipped bench.")
]
RunFiles = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN [RUN_B]", help="One run file, or the run files of series A and B of one reed."
    ),
]
MethodOption = Annotated[
    str,
    typer.Option(
        "--method",
        help="How to find resonances. joint: one fit of all holograms, with loss factors. "
        "picture: the paper's method, by the pictures with most fringes.",
    ),
]
ModelOption = Annotated[
    str,
    typer.Option("--model", help="Model of the reed: fem (finite elements) or paper (Table 9)."),
]


def guarded_verb(function: Callable[..., None]) -> Callable[..., None]:
    """Turn errors into one line and an exit status."""

    @functools.wraps(function)
    def guarded(*args: Any, debug: bool = False, **kwargs: Any) -> None:
        try:
            function(*args, debug=debug, **kwargs)
        except BenchError as error:
            if debug:
                raise
            for line in (str(error), *getattr(error, "__notes__", ())):
                show_message(one_line(f"acquire: {line}"))
            raise typer.Exit(FAILED if error.unconfirmed else error.exit_status) from None
        except OSError as error:
            if debug:
                raise
            for line in (_disk_message(error), *getattr(error, "__notes__", ())):
                show_message(one_line(f"acquire: {line}"))
            raise typer.Exit(FAILED) from None
        except KeyboardInterrupt as stop:
            unconfirmed = getattr(stop, "__notes__", ())
            for line in ("interrupted", *unconfirmed):
                show_message(one_line(f"acquire: {line}"))
            raise typer.Exit(FAILED if unconfirmed else INTERRUPTED) from None

    return guarded


def _disk_message(error: OSError) -> str:
    """Return one line about a file error that no other message explains."""
    where = "" if error.filename is None else f"{error.filename}: "
    reason = error.strerror or str(error) or type(error).__name__
    return one_line(f"{where}the system refused it ({reason}); check the disk, then try again")
