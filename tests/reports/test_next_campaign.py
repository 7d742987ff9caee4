"""What to measure next is written as a campaign that runs."""

import errno
import os
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from diagnosis.experiment_design import EXPERIMENTS, Experiment, RankedExperiment
from fitting.errors import FitInputError
from protocols.campaign import CampaignFile, tasks_of
from protocols.errors import ProtocolError
from protocols.protocol import Protocol
from reports.errors import OutputFailedError, OutputRefusedError
from reports.next_campaign import require_repeatable, write_next


def _worth(action: Experiment) -> RankedExperiment:
    return RankedExperiment(action, 3.0, 3.0 / action.minutes)


def _sweeps() -> str:
    return Protocol.from_file("seriesA").text


@pytest.mark.parametrize("action", [a for a in EXPERIMENTS if a.campaign_parts], ids=lambda a: a.id)
def test_every_action_is_a_campaign_of_the_sweeps_that_were_run(
    action: Experiment, tmp_path: Path
) -> None:
    file = tmp_path / "next.yaml"
    assert (
        write_next([_worth(action)], ("crack", "drying"), _sweeps(), "R01", file).experiment
        is action
    )
    tasks = tasks_of(CampaignFile.from_file(file))
    assert [task.part.name for task in tasks] == [part["name"] for part in action.campaign_parts]
    assert {task.protocol.drive for task in tasks} == {Protocol.from_text(_sweeps()).drive}
    assert "crack and drying" in file.read_text()


def test_the_best_that_software_can_run_is_written(tmp_path: Path) -> None:
    by_hand = Experiment("listen", "an ear at the tip", 1.0, (), lambda twin: twin)
    file = tmp_path / "next.yaml"
    rest = next(action for action in EXPERIMENTS if action.id == "long_rest")
    wax = next(action for action in EXPERIMENTS if action.id == "known_mass")
    worths = [_worth(by_hand), _worth(rest), _worth(wax)]
    assert write_next(worths, ("none", "drying"), _sweeps(), "R01", file).experiment is rest
    (task,) = tasks_of(CampaignFile.from_file(file))
    assert task.protocol.calibration is not None
    assert task.protocol.calibration.count == 64


def test_a_campaign_of_a_reed_of_any_name_can_be_read_and_its_command_copied(
    tmp_path: Path,
) -> None:
    rest = next(action for action in EXPERIMENTS if action.id == "long_rest")
    file, reed = tmp_path / "$(touch x).yaml", "R7'\nname: other\n\x1b]0;x\x07; touch x"
    write_next([_worth(rest)], ("none", "drying"), _sweeps(), reed, file)
    assert CampaignFile.from_file(file).name == "Next, long rest"
    (command,) = [line for line in file.read_text("utf-8").splitlines() if "--reed" in line]
    words = shlex.split(command.split("`")[1])
    assert words[:3] == ["acquire", "run", file.name]
    assert words[words.index("--reed") + 1] == "R7'\\nname: other\\n\\x1b]0;x\\x07; touch x"


def test_a_disk_that_is_full_leaves_the_earlier_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rest, wax = (
        next(action for action in EXPERIMENTS if action.id == name)
        for name in ("long_rest", "known_mass")
    )
    file = tmp_path / "next.yaml"
    write_next([_worth(rest)], ("none", "drying"), _sweeps(), "R01", file)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}

    def refuse(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OutputFailedError, match="No space left"):
        write_next([_worth(wax)], ("none", "drying"), _sweeps(), "R01", file)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_protocol_of_a_campaign_that_was_measured_is_marked_once(tmp_path: Path) -> None:
    rest = next(action for action in EXPERIMENTS if action.id == "long_rest")
    file, again = tmp_path / "next.yaml", tmp_path / "again.yaml"
    write_next([_worth(rest)], ("none", "drying"), _sweeps(), "R01", file)
    written = (tmp_path / "next-sweep.yaml").read_text("utf-8")
    write_next([_worth(rest)], ("none", "drying"), written, "R01", again)
    assert (tmp_path / "again-sweep.yaml").read_text("utf-8") == written
    assert Protocol.from_text(written).sha256 == Protocol.from_text(_sweeps()).sha256


def test_nothing_to_tell_apart_is_said(tmp_path: Path) -> None:
    with pytest.raises(FitInputError, match="no two causes"):
        write_next([], ("", ""), _sweeps(), "R01", tmp_path / "next.yaml")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_reported_before_anything_is_diagnosed(tmp_path: Path) -> None:
    run = SimpleNamespace(path=tmp_path / "up.h5", protocol_text=_sweeps())
    file, sweep = tmp_path / "next.yaml", tmp_path / "next-sweep.yaml"
    require_repeatable(run, file)
    # What an earlier diagnosis has written may be written again, other protocols not.
    rest = next(action for action in EXPERIMENTS if action.id == "long_rest")
    for _ in range(2):
        write_next([_worth(rest)], ("none", "drying"), _sweeps(), "R01", file)
        require_repeatable(run, file)
    for mine in ("name: mine\n", _sweeps()):
        sweep.write_text(mine, "utf-8")
        with pytest.raises(OutputRefusedError, match=r"next-sweep\.yaml: is there already"):
            require_repeatable(run, file)
        with pytest.raises(OutputRefusedError, match=r"next-sweep\.yaml: is there already"):
            write_next([_worth(rest)], ("none", "drying"), _sweeps(), "R01", file)
        assert sweep.read_text("utf-8") == mine
    sweep.unlink()
    sweep.mkdir()
    with pytest.raises(OutputRefusedError, match="it is a folder"):
        require_repeatable(run, file)
    sweep.rmdir()
    for text, error, words in (
        ("", FitInputError, "carries no protocol"),
        ("name: half", ProtocolError, r"up\.h5: protocol"),
    ):
        with pytest.raises(error, match=words):
            require_repeatable(SimpleNamespace(path=run.path, protocol_text=text), file)
