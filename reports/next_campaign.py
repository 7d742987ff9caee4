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
# {words}: {minutes:g} min with sweeps of the paper's length, to tell {one} from {other}.
# Expected to tell by {nats:.1f} nats of log odds. `acquire run {file} --reed {reed}` runs it.
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
    worths: Sequence[RankedExperiment],
    between: tuple[str, str],
    protocol_text: str,
    reed: str,
    path: Path,
) -> RankedExperiment:
    """Write the best action that software can run, and next to it the protocol of its sweeps.

    Parameters
    ----------
    worths : sequence of RankedExperiment
        The best first.
    between : (str, str)
        What they are to tell apart.
    protocol_text : str
        Of the sweeps of the campaign.
    reed : str
    path : Path
        Of the campaign file; the protocol's has '-sweep' added to its name. Older files of an
        earlier diagnosis there are replaced, and nothing else.

    Returns
    -------
    worth : RankedExperiment
        What the file does.

    Raises
    ------
    FitInputError
        If nothing is to be told apart.
    OutputRefusedError, OutputFailedError
        If a file must not or cannot be written.
    ProtocolError
        If the campaign's protocol cannot be used again.
    """
    best = next((worth for worth in worths if worth.experiment.campaign_parts), None)
    if best is None:
        raise FitInputError("no two causes have to be separated, so there is nothing to measure")
    campaign, sweep = next_outputs(path)
    require_writable([campaign, sweep])
    Protocol.from_text(_marked(protocol_text), str(sweep.path))
    action = best.experiment
    content = {
        "name": f"Next, {action.id.replace('_', ' ')}",
        "protocol": sweep.path.name,
        "parts": [dict(part) for part in action.campaign_parts],
    }
    head = _HEAD.format(
        words=action.description.capitalize(),
        minutes=action.minutes,
        one=between[0],
        other=between[1],
        nats=best.expected_nats,
        file=shlex.quote(one_line(path.name)),
        reed=shlex.quote(one_line(reed)),
    )
    write_output(sweep, _marked(protocol_text))
    body = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    write_output(campaign, f"{_CAMPAIGN.mark}{head}\n{body}")
    # As it will be read when it is run.
    tasks_of(CampaignFile.from_file(path))
    return best
