"""The verb `acquire paper`."""

from pathlib import Path
from typing import Annotated

import typer

from acquire.cli.app import (
    AsJson,
    Debug,
)
from acquire.cli.console import results, show_json, show_message


def paper(
    out: Annotated[
        Path | None,
        typer.Option(metavar="PAGE.html", help="HTML page to write (default: paper.html)."),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare the numbers that the paper prints with ours, on one self-contained HTML page.

    This takes about a minute. With --json and without --out no page is written.
    """
    from reports.own_output import require_writable
    from reports.tables import terminal_table
    from reproduction.page import (
        counts_table,
        page_output,
        write_page,
    )
    from reproduction.whole import compare_paper

    page = out or (None if as_json else Path("paper.html"))
    if page:
        require_writable([page_output(page)])
    comparison = compare_paper(show_message)
    if page:
        write_page(comparison, page)
    if as_json:
        show_json(comparison.to_json() | {"page": str(page) if page else None})
        return
    console = results()
    console.print(terminal_table(counts_table(comparison)))
    for sentence in comparison.findings:
        console.print(f"- {sentence}", markup=False)
    console.print(f"page          {page}", markup=False, soft_wrap=True)
