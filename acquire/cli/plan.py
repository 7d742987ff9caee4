"""The verb `acquire plan`."""

from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.app import (
    AsJson,
    BenchOption,
    Debug,
    plan_of,
)
from acquire.cli.console import results, show_json

if TYPE_CHECKING:
    pass


def plan(
    protocol: Annotated[
        str, typer.Argument(help="Protocol or campaign: a file, or the name of a shipped one.")
    ],
    bench: BenchOption = "simulated",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Show every step of a protocol, its duration and its file size. No instrument is opened.

    For a campaign, show its parts.
    """
    from acquire.cli.display import plan_summary, plan_table
    from protocols.campaign import names_campaign

    if names_campaign(protocol):
        _plan_campaign(protocol, bench, as_json)
        return
    planned = plan_of(protocol, bench)
    if as_json:
        show_json(planned.to_json())
    else:
        console = results()
        console.print(plan_table(planned))
        for line in plan_summary(planned):
            console.print(line, markup=False, soft_wrap=True)
    if planned.violations:
        raise typer.Exit(2)


def _plan_campaign(name: str, bench: str, as_json: bool) -> None:
    """Show every part of a campaign."""
    from acquire.cli.display import campaign_table
    from acquire.runner import script
    from protocols.campaign import CampaignFile, tasks_of

    tasks = tasks_of(CampaignFile.from_file(name))
    plans = [script.plan(task.protocol, bench) for task in tasks]
    if as_json:
        show_json(
            [
                {"part": task.part.name, "do": task.part.do, "clamping": task.clamping}
                | planned.to_json()
                for task, planned in zip(tasks, plans, strict=True)
            ]
        )
    else:
        results().print(campaign_table(tasks, plans))
    for planned in plans:
        planned.require_possible()
