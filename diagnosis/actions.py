"""What may be done on the bench to tell rivals apart, and how much each would tell per minute."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from diagnosis.block import Block
from diagnosis.estimate import spread_of
from diagnosis.rivals import Comparison, Rival
from physics.mechanics import TipMass
from physics.twin import (
    Twin,
    more,
    with_alteration,
    with_reed,
)

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Action:
    """Something to do and to measure again.

    Attributes
    ----------
    id, words : str
    minutes : float
        Of bench time: 75 s a sweep (`acquire plan campaign`), and hands.
    blocks : tuple of str
        Names of the blocks that it measures again.
    change : callable
        What the action does to a twin.
    sharper : float
        Factor on the standard deviations of its numbers.
    parts : tuple of mapping
        Of a campaign file (see `protocols.campaign`); none if no software runs it.
    """

    id: str
    words: str
    minutes: float
    blocks: tuple[str, ...]
    change: Callable[[Twin], Twin]
    sharper: float = 1.0
    parts: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class Worth:
    """What an action is expected to tell.

    Attributes
    ----------
    action : Action
    nats : float
        Expected log odds between the two best rivals, gained by it.
    nats_per_minute : float
    """

    action: Action
    nats: float
    nats_per_minute: float


def _same(twin: Twin) -> Twin:
    return twin


def _in_vacuum(twin: Twin) -> Twin:
    return with_reed(twin, air_share=0.0)


def _with_wax(twin: Twin) -> Twin:
    return with_alteration(twin, TipMass(), 1e-6)


def _after_an_hour(twin: Twin) -> Twin:
    return more(twin, "environment", begun_h=1.0)


def _without_clay(twin: Twin) -> Twin:
    return replace(twin, drive=replace(twin.drive, open_right=1.0))


_SWEEP: Final = ("modes", "lines of the drive", "forces", "level", "brightness", "noise", "fringes")
_STILL: Final = ("light at rest", "still light", "scatter of phases")
_FRAMES: Final = ("dark frames", "even light", "local oscillator")
_LADDER: Final = ("20 ms", "40 ms", "60 ms", "80 ms")


def _frames(kind: str, count: int, exposures: Sequence[str] = ()) -> dict[str, Any]:
    """What a sweep's protocol is to be changed by for frames of something else."""
    told: dict[str, Any] = {"kind": kind, "count": count}
    if exposures:
        told["exposures"] = list(exposures)
    return {"keep": "frames", "calibration": told}


def _part(name: str, do: str = "", **more: Any) -> dict[str, Any]:
    return {"name": name, **({"do": do} if do else {}), **more}


ACTIONS: Final[tuple[Action, ...]] = (
    Action("repeat", "the same sweeps once more", 10.0, (*_SWEEP, "lock", "frames"), _same,
           parts=(_part("up2"), _part("down2", change={"sweep.direction": "down"}),
                  _part("shuffled2", change={"sweep.direction": "shuffled"}),
                  _part("again2", "take the reed out of its clamp, and put it back as it was",
                        new_clamping=True))),
    Action("low_pressure", "a sweep in a vacuum chamber", 40.0, ("modes",), _in_vacuum,
           parts=(_part("vacuum", "put the mouthpiece into the vacuum chamber, and pump it out"),)),
    Action("known_mass", "a sweep with 1 mg of wax on the tip", 10.0, ("modes",), _with_wax,
           parts=(_part("wax", "stick 1 mg of wax to the middle of the tip"),)),
    Action("wait", "the same sweeps after an hour", 65.0, ("modes",), _after_an_hour,
           parts=(_part("later", "wait an hour, and touch nothing"),
                  _part("later_down", change={"sweep.direction": "down"}))),
    Action("without_clay", "a sweep with both halves of the chamber open", 10.0,
           ("forces", "lines of the drive"), _without_clay,
           parts=(_part("open", "take the clay out of the chamber",
                        change={"chamber": "symmetric"}),)),
    Action("long_rest", "order 0 of the reed at rest, 64 acquisitions", 2.0, _STILL, _same, 0.25,
           parts=(_part("long_rest", "let both beams through", change=_frames("order0", 64)),)),
    Action("more_frames", "dark, flat and local oscillator frames, 64 of each", 3.0, _FRAMES, _same,
           0.5,
           parts=(_part("dark2", "cover the camera", change=_frames("dark", 64)),
                  _part("flat2", "block both beams, and light the camera evenly with a lamp",
                        change=_frames("flat", 16, _LADDER)),
                  _part("lo2", "lamp off; let the local oscillator through, and block the object "
                               "beam", change=_frames("lo_only", 16, _LADDER)))),
    Action("microphone", "the sound at the tip by a microphone, with the reed held", 15.0,
           ("lines of the drive", "level"), _same, 0.3),
)  # fmt: skip


def ranked_actions(
    comparison: Comparison,
    one: Rival,
    other: Rival,
    actions: Sequence[Action] = ACTIONS,
) -> list[Worth]:
    """Rank actions by what they are expected to tell of two rivals, per minute.

    Parameters
    ----------
    comparison : Comparison
    one, other : Rival
    """
    twins = one.twin(comparison), other.twin(comparison)
    by_name = {block.name: block for block in comparison.blocks}
    worths = []
    for action in actions:
        chosen = [by_name[name] for name in action.blocks if name in by_name]
        if not chosen:
            continue
        try:
            nats = sum(_told(comparison, block, one, twins, action) for block in chosen)
        except ValueError:
            continue
        worths.append(Worth(action, nats, nats / action.minutes))
    return sorted(worths, key=lambda worth: -worth.nats_per_minute)


def _told(
    comparison: Comparison, block: Block, rival: Rival, twins: tuple[Twin, Twin], action: Action
) -> float:
    """Half the square of the distance between two predictions, in units of all that is unknown."""
    apart = block.predict(action.change(twins[0])) - block.predict(action.change(twins[1]))
    piece = comparison.slices[block.name]
    J = rival.free
    slope = np.linalg.inv(block.root) @ (rival.deviation[piece][:, None] * J[piece])
    variance = action.sharper**2 * block.covariance + slope @ spread_of(J) @ slope.T
    return 0.5 * float(apart @ np.linalg.solve(variance, apart))
