"""The verb `acquire plan`."""

from typing import Annotated

import typer

from acquire.cli.app import AsJson, BenchOption, Debug
from acquire.cli.console import results, show_json


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
    import acquire
    from acquire.cli.display import plan_summary
    from protocols.campaign import names_campaign
    from reports.run_tables import plan_table
    from reports.tables import terminal_table

    if names_campaign(protocol):
        _plan_campaign(protocol, bench, as_json)
        return
    planned = acquire.plan(protocol, bench)
    if as_json:
        show_json(planned.to_json())
    else:
        console = results()
        console.print(terminal_table(plan_table(planned.plan)))
        for line in plan_summary(planned.plan):
            console.print(line, markup=False, soft_wrap=True)
    if planned.violations:
        raise typer.Exit(2)


def _plan_campaign(name: str, bench: str, as_json: bool) -> None:
    """Show every part of a campaign."""
    import acquire
    from reports.run_tables import campaign_table
    from reports.tables import terminal_table

    planned = acquire.plan_campaign(acquire.load_campaign(name), bench)
    if as_json:
        show_json(planned.to_json())
    else:
        results().print(terminal_table(campaign_table(planned.tasks, planned.plans)))
    for each in planned.plans:
        each.require_possible()
