"""What to measure next, as a campaign file that is ready to run."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import yaml

from diagnosis.experiment_design import RankedExperiment
from fitting.errors import FitInputError
from protocols.campaign import CampaignFile, tasks_of
from protocols.protocol import Protocol
from reports.own_output import (
    Output,
    description_kind,
    require_writable,
    write_output,
)
from reports.plain_text import one_line
from runs.reader import Run

_CAMPAIGN: Final = description_kind("next campaign")
_SWEEP: Final = description_kind("protocol of a next campaign")
_HEAD = """\
# {words}: {minutes:g} min with sweeps of the paper's length, to decide between
# {one} and {other}. Expected change of their log odds: {nats:.1f} nats.
# `acquire run {file} --bench BENCH.yaml --reed {reed}` measures it; without --bench, on the
# simulated bench.
"""


def next_outputs(path: Path) -> tuple[Output, Output]:
    """Campaign file and protocol of its sweeps, as `write_next` writes them."""
    sweep = path.with_name(f"{path.stem}-sweep.yaml")
    return Output(path, _CAMPAIGN, "--next"), Output(sweep, _SWEEP, "--next")


def _marked(protocol_text: str) -> str:
    """Protocol with the mark of its kind, which it has already if such a campaign was measured."""
    return _SWEEP.mark + protocol_text.removeprefix(_SWEEP.mark)


def require_repeatable(run: Run, path: Path) -> None:
    """Refuse what `write_next` could not write, before anything is diagnosed.

    Parameters
    ----------
    run : Run
        A sweep of the campaign.
    path : Path
        Of the campaign file.

    Raises
    ------
    FitInputError
        If the run does not carry the protocol that it was measured by.
    OutputRefusedError
        If the campaign or the protocol must not or cannot be written there.
    ProtocolError
        If the run's protocol cannot be used again.
    """
    protocol = run.protocol_text
    require_writable(next_outputs(path), [run.path])
    if not protocol.strip():
        raise FitInputError(
            f"{run.path}: carries no protocol, of which --next would write another campaign; "
            "diagnose without --next"
        )
    Protocol.from_text(_marked(protocol), f"{run.path}: protocol")


def write_next(
    experiments: Sequence[RankedExperiment],
    between: tuple[str, str],
    protocol_text: str,
    reed: str,
    path: Path,
) -> RankedExperiment:
    """Write the best experiment as a campaign file, and next to it the protocol of its sweeps.

    Parameters
    ----------
    experiments : sequence of RankedExperiment
        Proposed experiments, the best first.
    between : (str, str)
        The two causes that the experiment separates.
    protocol_text : str
        Protocol of the sweeps of the diagnosed campaign.
    reed : str
    path : Path
        Campaign file; the name of the protocol is the same with '-sweep' added. Files of an earlier
        diagnosis are replaced, and no others.

    Returns
    -------
    RankedExperiment
        The experiment in the file.

    Raises
    ------
    FitInputError
        If there is nothing to separate.
    OutputRefusedError, OutputFailedError
        If a file must not or cannot be written.
    ProtocolError
        If the campaign's protocol cannot be used again.
    """
    best = next((each for each in experiments if each.experiment.campaign_parts), None)
    if best is None:
        raise FitInputError("no two causes have to be separated, so there is nothing to measure")
    campaign, sweep = next_outputs(path)
    require_writable([campaign, sweep])
    Protocol.from_text(_marked(protocol_text), str(sweep.path))
    write_output(sweep, _marked(protocol_text))
    write_output(campaign, _campaign_text(best, between, reed, path))
    # Read back, as it will be read when it is run.
    tasks_of(CampaignFile.from_file(path))
    return best


def _campaign_text(best: RankedExperiment, between: tuple[str, str], reed: str, path: Path) -> str:
    """Return the text of a campaign file, with a comment that says what it is for."""
    experiment, (one, other) = best.experiment, between
    head = _HEAD.format(
        words=experiment.description.capitalize(),
        minutes=experiment.minutes,
        one=one,
        other=other,
        nats=best.expected_nats,
        file=shlex.quote(one_line(path.name)),
        reed=shlex.quote(one_line(reed)),
    )
    content = {
        "name": f"Next, {experiment.id.replace('_', ' ')}",
        "protocol": next_outputs(path)[1].path.name,
        "parts": [dict(part) for part in experiment.campaign_parts],
    }
    body = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    return f"{_CAMPAIGN.mark}{head}\n{body}"
