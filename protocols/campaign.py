"""Campaign files: several runs of one reed, each with its own changes to a common protocol."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator

from protocols.errors import ProtocolError
from protocols.protocol import Protocol, is_campaign
from protocols.yaml_files.strict_yaml import (
    Description,
    Section,
    find_description,
    named_beside,
)


class CampaignPart(Section):
    """One run of a campaign."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,39}$")]
    """Name of the part and of its run file."""
    change: Annotated[dict[str, Any], Field(default_factory=dict)]
    """Changes to the protocol: new values by key path, such as `sweep.direction: down`."""
    do: str | None = None
    """Instruction for the person at the bench before this part. A simulated bench follows it by
    itself."""
    new_clamping: bool = False
    """Whether the reed is taken out of its clamp and put back before this part."""


class CampaignFile(Description):
    """Several runs of one reed."""

    kind: ClassVar[str] = "campaign"
    folder: ClassVar[str] = "."

    name: Annotated[str, Field(min_length=1, max_length=60)]
    """Title in tables and reports."""
    protocol: Annotated[str, Field(min_length=1, max_length=255)]
    """Common protocol: a file next to the campaign file, or the name of a shipped protocol."""
    parts: Annotated[tuple[CampaignPart, ...], Field(strict=False, min_length=1)]
    """Runs in the order of measurement."""

    @field_validator("parts")
    @classmethod
    def _each_once(cls, parts: tuple[CampaignPart, ...]) -> tuple[CampaignPart, ...]:
        names = [part.name for part in parts]
        twice = [name for k, name in enumerate(names) if name in names[:k]]
        if twice:
            raise ValueError(f"has {twice[0]} twice; give each part a name of its own")
        return parts


@dataclass(frozen=True)
class Task:
    """A part of a campaign with its complete protocol.

    Attributes
    ----------
    part : CampaignPart
    protocol : Protocol
        Common protocol with the changes of the part.
    clamping : int
        Number of new clampings up to this part, itself included.
    """

    part: CampaignPart
    protocol: Protocol
    clamping: int


def tasks_of(campaign: CampaignFile) -> tuple[Task, ...]:
    """Return all parts of a campaign, each with its complete protocol.

    Raises
    ------
    ProtocolError
        If the protocol or a change to it is wrong. The message names the campaign file and the key.
    """
    try:
        base = Protocol.from_file(named_beside(campaign.source, campaign.protocol))
    except ProtocolError as error:
        raise campaign.error("protocol", str(error)) from None
    tasks, clamping = [], 0
    for number, part in enumerate(campaign.parts):
        clamping += part.new_clamping
        name = f"{campaign.name}: {part.name}"[:80]
        for key in part.change:
            whole = next((other for other in part.change if key.startswith(f"{other}.")), None)
            if whole is not None:
                message = f"{key} is given twice, also as part of {whole!r}; give it there"
                raise campaign.error(("parts", number, "change"), message)
        try:
            protocol = base.replace({"name": name, **part.change})
        except ProtocolError as error:
            raise campaign.error(("parts", number, "change"), str(error)) from None
        tasks.append(Task(part, protocol, clamping))
    return tuple(tasks)


def names_campaign(name_or_path: str | Path) -> bool:
    """Return whether a file, or a shipped file of that name, describes a campaign.

    Raises
    ------
    ProtocolError
        If there is no such file.
    """
    file = find_description(str(name_or_path), Protocol.kind, Protocol.folder)
    try:
        return is_campaign(file.read_text("utf-8"))
    except (OSError, UnicodeDecodeError):
        # `Description.from_file` reports what is wrong with it.
        return False
