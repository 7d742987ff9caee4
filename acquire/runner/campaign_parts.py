"""The parts of a campaign: which are measured, and how the bench is prepared for each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from acquire.runner.orders import Orders
from acquire.runner.resuming import require_same
from acquire.runner.run_session import Sample, arrange_light
from drivers.roles import Bench
from protocols.bench import BenchFile
from protocols.campaign import (
    CampaignFile,
    Task,
    tasks_of,
)
from protocols.plan import Plan, make_plan
from runs.errors import RunFileError
from runs.reader import Run


class PartState(StrEnum):
    """Whether a part is measured."""

    NEW = "new"
    BEGUN = "begun"
    COMPLETE = "complete"


@dataclass(frozen=True)
class PlannedPart:
    """A part of a campaign with its plan and its run file.

    Attributes
    ----------
    task : Task
    plan : Plan
    path : Path
        Its run file.
    """

    task: Task
    plan: Plan
    path: Path

    @property
    def state(self) -> PartState:
        """Whether the part is measured.

        Raises
        ------
        RunFileError
            If its run file cannot be read.
        """
        if not self.path.exists():
            return PartState.NEW
        with Run.open(self.path) as run:
            return PartState.COMPLETE if run.status == "complete" else PartState.BEGUN


def planned_parts(
    campaign: CampaignFile, folder: Path, bench: BenchFile
) -> tuple[PlannedPart, ...]:
    """Plan every part of a campaign.

    Raises
    ------
    ProtocolError
        If a part is wrong, or the bench cannot carry it out.
    """
    parts = tuple(
        PlannedPart(task, make_plan(task.protocol, bench), folder / f"{task.part.name}.h5")
        for task in tasks_of(campaign)
    )
    for part in parts:
        part.plan.require_possible()
    return parts


def begun_campaign(parts: Sequence[PlannedPart], folder: Path) -> Sample:
    """Read what a campaign was started with, and check that it can be continued.

    Raises
    ------
    RunFileError
        If the folder holds no part, all parts are complete, or a part was started with another
        protocol, bench or kind of reed.
    """
    found: Sample | None = None
    missing = False
    for part in parts:
        if not part.path.exists():
            missing = True
            continue
        with Run.open(part.path) as run:
            require_same(run, part.plan)
            missing |= run.status != "complete"
            labels = replace(run.labels, campaign=run.acquisition.campaign)
            found = found or Sample(run.reed, labels, run.seed)
    if found is None:
        raise RunFileError(
            f"{folder}: holds no part of this campaign; begin it again without --resume"
        )
    if not missing:
        raise RunFileError(f"{folder}: all its parts are complete; measure a new campaign")
    return found


class BenchPreparation:
    """Brings shutters, lamp and clamp into the state that each part needs.

    Parameters
    ----------
    bench : Bench
        Open bench. A person has to do what it has no `surroundings` for.
    wait_for : callable
        Called with what a person must do; returns when it is done.
    orders : Orders
    """

    def __init__(
        self,
        bench: Bench,
        wait_for: Callable[[str], None],
        orders: Orders,
    ) -> None:
        self._bench, self._wait_for, self._orders = bench, wait_for, orders
        self._last_done = ""
        self._went_on = False

    def prepare(self, part: PlannedPart, state: PartState) -> None:
        """Prepare the bench for a part that is to be measured; remember one that is complete.

        The reed is clamped again once only, however often its part is started. A simulated reed
        forgets its clampings when its process ends, and repeats them.

        Raises
        ------
        KeyboardInterrupt
            If the campaign is stopped while it waits for a person, or for the second time while
            shutters or clamp move.
        """
        clamps = part.task.part.new_clamping
        surroundings = self._bench.surroundings
        if surroundings is not None:
            # A driver that makes no statement may have lost the clampings of an earlier process.
            stays = bool(getattr(surroundings, "stays_clamped", False))
            if clamps and (state is PartState.NEW or not stays):
                with self._orders.given_up_at(2):
                    surroundings.clamp_again()
            arrange_light(part.plan, self._bench, self._orders)
            return
        if state is PartState.COMPLETE:
            self._last_done = self._last_done if clamps else part.task.part.do or self._last_done
            self._went_on = True
            return
        self._ask(part, state)

    def _ask(self, part: PlannedPart, state: PartState) -> None:
        todo, clamped = part.task.part.do or "", part.task.part.new_clamping
        if state is PartState.BEGUN and clamped:
            # The reed was clamped before the part was started.
            todo = ""
        if not todo and (self._went_on or state is PartState.BEGUN):
            # The bench may have been changed since.
            todo = f"check that the bench is as part {part.task.part.name} needs it"
            todo += f" ({self._last_done})" if self._last_done else ""
        if todo:
            with self._orders.given_up_at(1):
                self._wait_for(todo)
        if not clamped:
            self._last_done = part.task.part.do or self._last_done
        self._went_on = False
