"""The verbs `acquire blind make` and `acquire blind score`."""

import contextlib
import functools
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.app import AsJson, Debug
from acquire.cli.console import messages, results, show_json
from reports.errors import OutputFailedError
from reports.own_output import Output, picture_kind, require_writable, write_output

if TYPE_CHECKING:
    from blind.scoring import Case


@contextlib.contextmanager
def _blind_errors() -> Iterator[None]:
    """Turn errors of `blind`, which imports no other package, into errors of the program."""
    from fitting.errors import FitInputError

    try:
        from blind.files import BlindDiskError, BlindError
    except ImportError as error:
        raise FitInputError(
            f"blind cases need {error.name}, which is not installed; install reedbench[blind]"
        ) from None
    try:
        yield
    except BlindDiskError as error:
        raise OutputFailedError(str(error)) from None
    except BlindError as error:
        raise FitInputError(str(error)) from None


def make(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder to write; each case gets a folder in it.")
    ],
    tier: Annotated[
        int,
        typer.Option(
            help="0: no effect; 1: one effect; 2: one that resembles another; 3: two effects; "
            "4: one that the catalogue does not have; 6: each effect in turn, with known ones."
        ),
    ],
    count: Annotated[int, typer.Option(min=1, help="Number of cases.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed, combined with a secret in the key file.")],
    key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File for the true causes (default: DIR.key.json)."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Number of cases to make in parallel.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Make sealed test cases: campaigns with a hidden cause, and a hash of each cause.

    DIR/sealed.json holds the hashes. Its own SHA-256 is printed: publish it before you answer a
    case. A case takes 30 to 60 s and 46 MB.
    """
    with _blind_errors():
        from acquire.cli.display import stage_progress
        from blind.files import make_set

        place = folder.resolve()
        kept = key or place.with_name(f"{place.name}.key.json")
        with stage_progress(messages()) as show:
            stage = functools.partial(show, "making cases")
            made = make_set(folder, kept, tier, count, seed, jobs, stage)
    if as_json:
        show_json({"cases": count, "folder": str(folder), "key": str(kept), "sealed_sha256": made})
        return
    cases = "1 case" if count == 1 else f"{count} cases"
    console = results()
    console.print(f"wrote {cases} to {folder}; SHA-256 of sealed.json: {made}", soft_wrap=True)
    console.print(f"The key is {kept}. Do not show it to the person who answers.", soft_wrap=True)


def score(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR…", help="Folders that `blind make` wrote; scored together."),
    ],
    answers: Annotated[
        list[Path],
        typer.Option(
            metavar="DIR",
            help="Folder with NAME.json, the output of `diagnose --json` for each case; "
            "one folder for each DIR, in the same order.",
        ),
    ],
    key: Annotated[
        list[Path],
        typer.Option(metavar="FILE", help="Key file of `blind make`; one for each DIR."),
    ],
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Reliability diagram to write.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score answers to sealed test cases. A case without an answer counts as wrong."""
    with _blind_errors():
        from blind.classes import CLASSES
        from blind.drawing import draw_reliability
        from blind.report import report as blind_report
        from blind.report import sentences
        from blind.scoring import Classes

        plot = _reliability_output(picture)
        cases, classes = _scored_cases(folders, answers, key), Classes(CLASSES)
        scores = blind_report(cases, classes)
        if as_json:
            show_json(scores)
        else:
            console = results()
            for line in sentences(scores):
                console.print(line, markup=False, soft_wrap=True)
        if plot is not None:
            write_output(plot, draw_reliability(cases, classes, plot.kind.mark))


def _scored_cases(
    folders: Sequence[Path], answers: Sequence[Path], keys: Sequence[Path]
) -> "list[Case]":
    """Read the cases of all sets with their answers; no case may be in two sets."""
    from blind.files import BlindError, answered_cases

    if not len(folders) == len(answers) == len(keys):
        raise BlindError(
            f"{len(folders)} sets of cases, {len(answers)} --answers and {len(keys)} --key were "
            "given; give one of each for every set, in the same order"
        )
    sets = zip(folders, answers, keys, strict=True)
    cases = [case for made in sets for case in answered_cases(*made)]
    twice = [name for name, count in Counter(case.name for case in cases).items() if count > 1]
    if twice:
        raise BlindError(f"case {twice[0]} is in two sets; give each set once")
    return cases


def _reliability_output(picture: Path | None) -> "Output | None":
    """Return the reliability diagram as an output that may be written."""
    from blind.files import BlindError

    if picture is None:
        return None
    if picture.suffix.lower() != ".png":
        raise BlindError(f"{picture}: is drawn as PNG; give it a name that ends in .png")
    plot = Output(picture, picture_kind("reliability"), "--picture")
    require_writable([plot])
    return plot
