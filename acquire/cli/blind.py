"""The verbs `acquire blind make` and `acquire blind score`."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.app import (
    AsJson,
    Debug,
)
from acquire.cli.console import messages, results, show_json
from reports.errors import OutputFailedError

if TYPE_CHECKING:
    pass


@contextlib.contextmanager
def _blind_side() -> Iterator[None]:
    """Errors of the other side, which knows none of the house's."""
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
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Gets a folder for each case.")],
    tier: Annotated[
        int,
        typer.Option(
            help="0: nothing wrong; 1: one effect; 2: one easily taken for another; 3: two; "
            "4: one that the catalogue lacks; 6: each effect in turn, beside others that are told."
        ),
    ],
    count: Annotated[int, typer.Option(min=1, help="How many cases.")],
    seed: Annotated[int, typer.Option(min=0, help="Mixed with what the key alone tells.")],
    key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Gets the labels; DIR.key.json if not given."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Cases that are made at once.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Make sealed cases: campaigns of laboratories with something wrong, and hashes of what it is.

    DIR/sealed.json holds the hashes; its own, to be published before any case is answered, is
    printed. A case takes half a minute to one, and 46 MB.
    """
    with _blind_side():
        from acquire.cli.display import share_progress
        from blind.files import make_set

        place = folder.resolve()
        kept = key or place.with_name(f"{place.name}.key.json")
        with share_progress(messages(), "making cases") as told:
            made = make_set(folder, kept, tier, count, seed, jobs, told)
    if as_json:
        show_json({"cases": count, "folder": str(folder), "key": str(kept), "sealed_sha256": made})
        return
    cases = "1 case" if count == 1 else f"{count} cases"
    console = results()
    console.print(f"{cases} in {folder}, whose sealed.json has the SHA-256 {made}", soft_wrap=True)
    console.print(f"The key is {kept}: keep it from whoever answers.", soft_wrap=True)


def score(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR…", help="What `blind make` made; scored as one.")
    ],
    answers: Annotated[
        list[Path],
        typer.Option(
            metavar="DIR",
            help="Folder of NAME.json, what `diagnose --json` printed of each case; "
            "one for each set, in the same order.",
        ),
    ],
    key: Annotated[
        list[Path],
        typer.Option(metavar="FILE", help="Labels, by `blind make`; one for each set."),
    ],
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Reliability plot to draw besides.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score answers to sealed cases; what is not answered counts as wrong."""
    from reports.own_output import (
        Output,
        picture_kind,
        require_writable,
        write_output,
    )

    with _blind_side():
        from blind.classes import CLASSES
        from blind.drawing import draw_reliability
        from blind.files import BlindError, answered_cases
        from blind.report import report as blind_report
        from blind.report import sentences
        from blind.scoring import Classes

        if not len(folders) == len(answers) == len(key):
            raise BlindError(
                f"{len(folders)} sets of cases, {len(answers)} --answers and {len(key)} --key were "
                "given; give one of each for every set, in the same order"
            )
        plot = None
        if picture is not None:
            if picture.suffix.lower() != ".png":
                raise BlindError(f"{picture}: is drawn as PNG; give it a name that ends in .png")
            plot = Output(picture, picture_kind("reliability"), "--picture")
            require_writable([plot])
        sets = zip(folders, answers, key, strict=True)
        cases = [case for made in sets for case in answered_cases(*made)]
        names = [case.name for case in cases]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise BlindError(f"case {twice} is in two sets; give each set once")
        classes = Classes(CLASSES)
        scores = blind_report(cases, classes)
        if as_json:
            show_json(scores)
        else:
            console = results()
            for line in sentences(scores):
                console.print(line, markup=False, soft_wrap=True)
        if plot is not None:
            write_output(plot, draw_reliability(cases, classes, plot.kind.mark))
