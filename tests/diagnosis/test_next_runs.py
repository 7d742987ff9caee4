"""What to measure next is written as a campaign that runs."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from acquire.campaign_file import CampaignFile, tasks_of
from acquire.errors import ProtocolError, RunFileError
from acquire.protocol import Protocol
from diagnosis.actions import ACTIONS, Action, Worth
from diagnosis.next_runs import require_repeatable, write_next
from fitting.errors import FitInputError


def _worth(action: Action) -> Worth:
    return Worth(action, 3.0, 3.0 / action.minutes)


def _sweeps() -> str:
    return Protocol.from_file("seriesA").text


@pytest.mark.parametrize("action", [a for a in ACTIONS if a.parts], ids=lambda a: a.id)
def test_every_action_is_a_campaign_of_the_sweeps_that_were_run(
    action: Action, tmp_path: Path
) -> None:
    file = tmp_path / "next.yaml"
    assert (
        write_next([_worth(action)], ("crack", "drying"), _sweeps(), "R01", file).action is action
    )
    tasks = tasks_of(CampaignFile.from_file(file))
    assert [task.part.name for task in tasks] == [part["name"] for part in action.parts]
    assert {task.protocol.drive for task in tasks} == {Protocol.from_text(_sweeps()).drive}
    assert "tell crack from drying" in file.read_text()


def test_the_best_that_software_can_run_is_written(tmp_path: Path) -> None:
    by_hand = Action("listen", "an ear at the tip", 1.0, (), lambda twin: twin)
    file = tmp_path / "next.yaml"
    rest = next(action for action in ACTIONS if action.id == "long_rest")
    wax = next(action for action in ACTIONS if action.id == "known_mass")
    worths = [_worth(by_hand), _worth(rest), _worth(wax)]
    assert write_next(worths, ("none", "drying"), _sweeps(), "R01", file).action is rest
    (task,) = tasks_of(CampaignFile.from_file(file))
    assert task.protocol.calibration is not None
    assert task.protocol.calibration.count == 64


def test_nothing_to_tell_apart_is_said(tmp_path: Path) -> None:
    with pytest.raises(FitInputError, match="no two causes"):
        write_next([], ("", ""), _sweeps(), "R01", tmp_path / "next.yaml")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_told_before_anything_is_diagnosed(tmp_path: Path) -> None:
    run = SimpleNamespace(path=tmp_path / "up.h5", protocol_text=_sweeps())
    file, sweep = tmp_path / "next.yaml", tmp_path / "next-sweep.yaml"
    require_repeatable(run, file)
    # What an earlier diagnosis has written may be written again, another protocol not.
    sweep.write_text(_sweeps(), "utf-8")
    require_repeatable(run, file)
    sweep.write_text("name: mine\n", "utf-8")
    with pytest.raises(FitInputError, match=r"next-sweep\.yaml: is there already"):
        require_repeatable(run, file)
    assert sweep.read_text("utf-8") == "name: mine\n"
    sweep.unlink()
    sweep.mkdir()
    with pytest.raises(RunFileError, match="it is a folder"):
        require_repeatable(run, file)
    sweep.rmdir()
    for text, error, words in (
        ("", FitInputError, "carries no protocol"),
        ("name: half", ProtocolError, r"up\.h5: protocol"),
    ):
        with pytest.raises(error, match=words):
            require_repeatable(SimpleNamespace(path=run.path, protocol_text=text), file)
