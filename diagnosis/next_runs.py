"""What to measure next, as a campaign file that is ready to run."""

from collections.abc import Sequence
from pathlib import Path

import yaml

from acquire.campaign_file import CampaignFile, tasks_of
from acquire.protocol import Protocol
from acquire.runfile import Run
from diagnosis.actions import Worth
from fitting.comparison.page import require_writable
from fitting.errors import FitInputError

_HEAD = """\
# {words}: {minutes:g} min with sweeps of the paper's length, to tell {one} from {other}.
# Expected to tell by {nats:.1f} nats of log odds. `acquire run {file} --reed {reed}` runs it.
"""


def sweep_beside(path: Path) -> Path:
    """Protocol of the sweeps of a campaign file that `write_next` writes."""
    return path.with_name(f"{path.stem}-sweep.yaml")


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
        If the run does not carry the protocol that it was measured by, or another protocol is
        where that would be written.
    RunFileError
        If the protocol cannot be written there.
    ProtocolError
        If the run's protocol cannot be used again.
    """
    sweep, protocol = sweep_beside(path), run.protocol_text
    require_writable(sweep, "--next")
    if not protocol.strip():
        raise FitInputError(
            f"{run.path}: carries no protocol, of which --next would write another campaign; "
            "diagnose without --next"
        )
    Protocol.from_text(protocol, f"{run.path}: protocol")
    if sweep.exists() and sweep.read_bytes() != protocol.encode():
        raise FitInputError(f"{sweep}: is there already, and another protocol; name another --next")


def write_next(
    worths: Sequence[Worth], between: tuple[str, str], protocol_text: str, reed: str, path: Path
) -> Worth:
    """Write the best action that software can run, and beside it the protocol of its sweeps.

    Parameters
    ----------
    worths : sequence of Worth
        The best first.
    between : (str, str)
        What they are to tell apart.
    protocol_text : str
        Of the sweeps of the campaign.
    reed : str
    path : Path
        Of the campaign file; the protocol's has '-sweep' added to its name.

    Returns
    -------
    worth : Worth
        What the file does.

    Raises
    ------
    FitInputError
        If nothing is to be told apart, or a file cannot be written; one that is there is replaced.
    ProtocolError
        If the campaign's protocol cannot be used again.
    """
    best = next((worth for worth in worths if worth.action.parts), None)
    if best is None:
        raise FitInputError("no two causes are to be told apart, so there is nothing to measure")
    sweep = sweep_beside(path)
    Protocol.from_text(protocol_text, str(sweep))
    action = best.action
    content = {
        "name": f"Next, {action.id.replace('_', ' ')}",
        "protocol": sweep.name,
        "parts": [dict(part) for part in action.parts],
    }
    head = _HEAD.format(
        words=action.words.capitalize(), minutes=action.minutes, one=between[0], other=between[1],
        nats=best.nats, file=path.name, reed=reed,
    )  # fmt: skip
    try:
        sweep.write_text(protocol_text, "utf-8")
        body = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        path.write_text(f"{head}\n{body}", "utf-8")
    except OSError as error:
        raise FitInputError(f"{path}: cannot be written ({error.strerror or error})") from None
    # As it will be read when it is run.
    tasks_of(CampaignFile.from_file(path))
    return best
