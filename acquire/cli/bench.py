"""The verbs `acquire bench list`, `acquire bench check` and `acquire bench off`.

Results go to standard output, progress and messages to standard error.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Final

import typer

from acquire.cli.app import AsJson, Debug
from acquire.cli.console import (
    results,
    show_json,
    show_message,
)
from acquire.errors import FAILED, INTERRUPTED
from reports.plain_text import plain

if TYPE_CHECKING:
    from rich.table import Table

    from acquire.bench.check import CheckReport
    from acquire.bench.findings import Finding
    from acquire.bench.off import OffReport
    from drivers.discovery import Found, Search

_STYLES: Final = {"pass": "green", "fail": "bold red", "note": "yellow", "skipped": "dim"}
_KINDS: Final = {
    "serial": "serial ports",
    "visa": "VISA resources (USB and network)",
    "camera": "cameras",
    "sound": "sound devices",
}

BenchArgument = Annotated[
    str, typer.Argument(metavar="BENCH", help="Bench file, or a shipped bench's name.")
]


def list_found(
    ask: Annotated[
        bool,
        typer.Option(
            "--ask",
            help="Also ask every serial port what it is: sends an empty line and *IDN?. Do not use "
            "it while another device that obeys its serial port is connected, such as a motor.",
        ),
    ] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """List what is plugged in, what answers, and the line of a bench file for each.

    Changes nothing on any instrument: USB and network instruments are asked *IDN?, cameras are
    not opened, serial ports are asked with --ask only. Instruments that a measurement uses are
    not asked.
    """
    from drivers.discovery import search_all

    show_message("searching serial ports, USB, the local network, cameras and sound devices")
    searches = search_all(ask)
    if as_json:
        show_json(
            {
                "found": [found.to_json() for search in searches for found in search.found],
                "remarks": [
                    {"kind": search.kind, "remark": remark}
                    for search in searches
                    for remark in search.remarks
                ],
            }
        )
        return
    for kind, title in _KINDS.items():
        _show_searches(title, [search for search in searches if search.kind == kind])
    _show("")
    _show("Copy the lines that begin with a role into your bench file; fill in every …")


def _show_searches(title: str, searches: "Sequence[Search]") -> None:
    found = [each for search in searches for each in search.found]
    _show(f"{title}: {len(found) or 'none'}")
    for each in found:
        _show_found(each)
    for search in searches:
        for remark in search.remarks:
            _show(f"  note: {remark}")


def _show_found(found: "Found") -> None:
    _show(f"  {found.address}")
    if found.answer:
        _show(f"      answers {found.answer}")
    if found.remark:
        _show(f"      {found.remark}")
    if found.line:
        _show(f"      {found.line}")


def check(
    bench: BenchArgument,
    hz: Annotated[
        float | None,
        typer.Option(help="Drive of the shot; 2000 Hz, near a clarinet reed's first resonance."),
    ] = None,
    volts: Annotated[
        float | None, typer.Option(help="Peak volts at the loudspeaker in the shot; 0.5 V.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Check a bench: open each instrument, try its limits, take one locked shot, switch off.

    Ends with a table of what passed, what failed and the remedy. The exit status is 0 only if
    nothing failed. The tweeter plays for about a second. No file is written.
    """
    from acquire.bench.check import check_bench
    from acquire.bench.findings import read_bench
    from acquire.bench.shot import shot_plan
    from acquire.runner.orders import Orders, signals_obeyed

    bench_file = read_bench(bench)
    plan, orders = shot_plan(bench_file, hz, volts), Orders()
    with signals_obeyed(orders):
        report = check_bench(bench_file, plan, orders, show_message)
    if as_json:
        show_json(report.to_json())
    else:
        results().print(_table(f"check: {report.bench}", report.findings))
        _show(_closing_words(report))
    if report.interrupted:
        raise typer.Exit(FAILED if report.unconfirmed else INTERRUPTED)
    if not report.passed:
        raise typer.Exit(FAILED)


def off(bench: BenchArgument, as_json: AsJson = False, debug: Debug = False) -> None:
    """Switch off every output of a bench that can be reached, and say which could not.

    A measurement on this computer that uses the bench is stopped first. The exit status is 0 only
    if every output is confirmed off.
    """
    from acquire.bench.findings import read_bench
    from acquire.bench.off import switch_off
    from acquire.runner.orders import Orders, signals_obeyed

    bench_file, orders = read_bench(bench), Orders()
    with signals_obeyed(orders):
        report = switch_off(bench_file, orders, show_message)
    if as_json:
        show_json(report.to_json())
    else:
        results().print(_table(f"outputs: {report.bench}", report.findings))
        _show(_words_on_outputs(report))
    if not report.is_off:
        raise typer.Exit(FAILED)


def _closing_words(report: "CheckReport") -> str:
    if report.unconfirmed:
        return "NOT everything is confirmed off: follow the remedies, then run acquire bench off"
    if report.interrupted:
        return "stopped before the end; everything is off"
    if report.passed:
        return "passed: the bench is ready"
    return "not ready: fix what failed, then check again"


def _words_on_outputs(report: "OffReport") -> str:
    if not report.is_off:
        return "NOT everything is confirmed off: follow the remedies, then run this again"
    if all(finding.result == "note" for finding in report.findings):
        return "nothing to switch off: all instruments are simulated"
    return "everything is off"


def _table(title: str, findings: "Sequence[Finding]") -> "Table":
    """Return a table of findings, the remedy under what was found."""
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), box=SIMPLE, pad_edge=False)
    table.add_column("check", no_wrap=True)
    table.add_column("of", no_wrap=True)
    table.add_column("result", no_wrap=True)
    table.add_column("found, and what to do", overflow="fold")
    for finding in findings:
        text = finding.found + (f"\n→ {finding.remedy}" if finding.remedy else "")
        table.add_row(
            plain(finding.check),
            plain(finding.about),
            Text(finding.result, style=_STYLES[finding.result]),
            plain(text),
        )
    return table


def _show(text: str) -> None:
    results().print(text, soft_wrap=True)
