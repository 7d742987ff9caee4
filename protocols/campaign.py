"""A campaign: what a diagnosis needs, part by part, each a protocol with its own changes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field, ValidationInfo, field_validator

from protocols.errors import ProtocolError
from protocols.protocol import Protocol, is_campaign
from protocols.strict_yaml import (
    Description,
    Section,
    find_description,
    named_beside,
)


class Part(Section):
    """One run of a campaign.

    Attributes
    ----------
    name : str
        Of the part, and of its run file.
    change : dict
        What of the protocol is different, by key path.
    do : str, optional
        What somebody at the bench does before; a bench that can does it by itself.
    clamp_anew : bool
        Whether that is to take the reed out of its clamp and put it back.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,39}$")]
    change: Annotated[dict[str, Any], Field(default_factory=dict)]
    do: str | None = None
    clamp_anew: bool = False


class CampaignFile(Description):
    """Several runs of one reed.

    Attributes
    ----------
    name : str
    protocol : str
        Of the sweeps: a file beside this one, or the name of a shipped protocol.
    parts : tuple of Part
        In the order of time.
    """

    kind: ClassVar[str] = "campaign"
    folder: ClassVar[str] = "."

    name: Annotated[str, Field(min_length=1, max_length=60)]
    protocol: Annotated[str, Field(min_length=1, max_length=255)]
    parts: Annotated[tuple[Part, ...], Field(strict=False, min_length=1)]

    @field_validator("parts")
    @classmethod
    def _each_once(cls, parts: tuple[Part, ...], _info: ValidationInfo) -> tuple[Part, ...]:
        names = [part.name for part in parts]
        twice = [name for k, name in enumerate(names) if name in names[:k]]
        if twice:
            raise ValueError(f"has {twice[0]} twice; give each part a name of its own")
        return parts


@dataclass(frozen=True)
class Task:
    """A part, ready to be planned.

    Attributes
    ----------
    part : Part
    protocol : Protocol
    clamping : int
        How often the reed has been clamped anew by then.
    """

    part: Part
    protocol: Protocol
    clamping: int


def tasks_of(campaign: CampaignFile) -> tuple[Task, ...]:
    """Work out the protocol of every part.

    Raises
    ------
    ProtocolError
        If the protocol, or what a part changes of it, is wrong; names the campaign and its key.
    """
    try:
        base = Protocol.from_file(named_beside(campaign.source, campaign.protocol))
    except ProtocolError as error:
        raise campaign.error("protocol", str(error)) from None
    tasks, clamping = [], 0
    for number, part in enumerate(campaign.parts):
        clamping += part.clamp_anew
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
    """Whether a file, or a shipped one by its name, is a campaign's.

    Raises
    ------
    ProtocolError
        If there is no such file.
    """
    file = find_description(str(name_or_path), Protocol.kind, Protocol.folder)
    try:
        return is_campaign(file.read_text("utf-8"))
    except (OSError, UnicodeDecodeError):
        # Whoever reads it in earnest says what is wrong with it.
        return False
