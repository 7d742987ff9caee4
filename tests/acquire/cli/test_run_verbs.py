"""Runs that are paused, gone on with and looked at, through the command line."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from acquire.runner.control import controllable
from runs.reader import Run

ROOT = Path(__file__).parents[3]


@pytest.fixture
def begin(folder, protocol_file, bench_file):
    """Return a function that begins a sweep in a process of its own, at the camera's pace."""
    processes = []

    def make(*more):
        protocol, bench = protocol_file(), bench_file(pace="realtime")
        command = [sys.executable, "-m", "acquire", "run", protocol, "--bench", bench, *more]
        process = subprocess.Popen(
            [str(word) for word in command],
            cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        processes.append(process)
        return process

    yield make
    for process in processes:
        process.kill()
        process.communicate()


def wait_for_steps(path, count):
    """Wait until a run in work has written `count` steps."""
    documents = path.with_suffix(".documents.jsonl")
    for _ in range(600):
        if documents.exists() and documents.read_text().count('["event"') >= count:
            return
        time.sleep(0.05)
    raise AssertionError("the run does not get on")


@pytest.mark.slow
def test_a_run_is_paused_and_goes_on(cli, begin, folder):
    process, path = begin("--out", "x.h5", "--no-fit", "--json"), folder / "x.h5"
    wait_for_steps(path, 2)
    said = cli("pause", path, "--json")
    assert said.json == {"run": str(path), "order": "pause", "process": process.pid}
    time.sleep(1.0)
    before = path.with_suffix(".documents.jsonl").read_text().count('["event"')
    time.sleep(1.0)
    assert path.with_suffix(".documents.jsonl").read_text().count('["event"') == before < 9
    assert cli("continue", path).status == 0
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert json.loads(out)["verdicts"] == {"ok": 9}
    with Run.open(path) as run:
        assert [interruption.kind for interruption in run.interruptions] == ["paused"]
    assert "acquire continue x.h5" in err
    assert not (folder / "x.process").exists()


@pytest.mark.slow
def test_a_run_in_work_is_shown_listed_and_read_by_anybody(cli, begin, folder):
    process, path = begin("--out", "x.h5", "--no-fit"), folder / "x.h5"
    wait_for_steps(path, 3)
    assert cli("pause", path).status == 0
    shown = cli("show", path, "--json").json
    assert (shown["status"], shown["in_work"], shown["process"]) == ("running", True, process.pid)
    assert 3 <= shown["verdicts"]["ok"] < 9
    assert f"being measured by process {process.pid}" in " ".join(cli("show", path).out.split())
    (listed,) = cli("list", folder, "--json").json
    assert (listed["in_work"], listed["process"], listed["steps"]) == (True, process.pid, 9)
    with h5py.File(path, "r", locking=False) as file:
        good = file["entry/steps/verdict"].asstr()[()] == "ok"
        assert good.sum() >= shown["good"]
        assert np.abs(file["entry/data/field"][0]).any()
    with Run.open(path) as run:
        assert all(np.isfinite(run.field(k)).all() for k in np.flatnonzero(run.good))
    refused = cli("pack", path)
    assert (refused.status, refused.out) == (2, "")
    assert f"is being measured by process {process.pid}" in refused.err
    assert cli("continue", path).status == 0
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    shown = cli("show", path, "--json").json
    assert (shown["status"], shown["in_work"], shown["process"]) == ("complete", False, None)


@pytest.mark.slow
def test_a_run_whose_process_is_gone_is_said_to_be_stopped(cli, begin, folder):
    process, path = begin("--out", "x.h5", "--no-fit"), folder / "x.h5"
    wait_for_steps(path, 1)
    process.kill()
    process.wait()
    shown = cli("show", path, "--json").json
    assert (shown["status"], shown["in_work"], shown["process"]) == ("running", False, None)
    assert "--resume" in cli("show", path).out


def test_frames_of_complete_runs_are_packed(cli, folder, protocol_file, bench_file, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("acquire.runner.run_session.pack", lambda _path, _progress: None)
        for name, keep in (("x.h5", "frames"), ("y.h5", "holograms")):
            made = [protocol_file(keep=keep), "--bench", bench_file(), "--out", name, "--no-fit"]
            assert cli("run", *made).status == 0
    before = Path("x.h5").stat().st_size
    packed = cli("pack", "x.h5", "y.h5", "no.h5", "--json")
    assert packed.status == 2
    assert "no.h5: there is no such file" in packed.err
    first, second = packed.json
    after = Path("x.h5").stat().st_size
    assert first == {
        "run": "x.h5", "packed": True, "reason": "", "before_bytes": before, "after_bytes": after,
        "ratio": after / before,
    }  # fmt: skip
    assert (second["packed"], second["ratio"]) == (False, 1.0)
    assert "holograms" in second["reason"]
    again = cli("pack", "x.h5")
    assert again.status == 0
    assert "packed already" in again.out


@pytest.mark.parametrize("verb", ["pause", "continue"])
def test_only_a_run_in_work_obeys(cli, folder, verb):
    Path("x.process").write_text(f"{os.getpid()}\n")
    said = cli(verb, "x.h5")
    assert (said.status, said.out) == (2, "")
    assert "is not being measured" in said.err


@pytest.mark.slow
def test_a_run_that_was_killed_is_gone_on_with(cli, begin, folder, protocol_file, bench_file):
    process, path = begin("--out", "x.h5", "--no-fit", "--reed", "R9"), folder / "x.h5"
    wait_for_steps(path, 3)
    process.send_signal(signal.SIGKILL)
    process.wait()
    same = protocol_file(), "--bench", bench_file(pace="realtime"), "--resume", path, "--no-fit"
    said = cli("run", *same, "--json")
    assert said.status == 0, said.err
    assert (said.json["run"], said.json["verdicts"]) == (str(path), {"ok": 9})
    shown = cli("show", path, "--json").json
    assert (shown["reed"], shown["status"], shown["verdicts"]) == ("R9", "complete", {"ok": 9})
    (interruption,) = shown["interruptions"]
    assert (interruption["kind"], interruption["reason"]) == ("resumed", "the process had died")
    assert 3 <= interruption["position"] < 9
    again = cli("run", *same)
    assert (again.status, again.out) == (2, "")
    assert "is complete; measure a new run" in again.err


@pytest.mark.parametrize(
    "changed", [{"sweep.last": 32}, {"settle": "50 ms"}, {"reed": "bass-clarinet"}]
)
def test_another_sweep_is_not_put_into_an_unfinished_run(
    cli, begin, folder, protocol_file, bench_file, changed
):
    process, path = begin("--out", "x.h5", "--no-fit"), folder / "x.h5"
    wait_for_steps(path, 1)
    process.send_signal(signal.SIGKILL)
    process.wait()
    other, bench = protocol_file("other.yaml", **changed), bench_file(pace="realtime")
    said = cli("run", other, "--bench", bench, "--resume", path)
    assert (said.status, said.out) == (2, "")
    assert "was begun with another protocol" in said.err
    said = cli("run", protocol_file(), "--bench", bench_file("b.yaml"), "--resume", path)
    assert "was begun with another bench" in said.err


@pytest.mark.parametrize("option", [["--reed", "R8"], ["--seed", "3"], ["--note", "x"]])
def test_what_an_unfinished_run_says_itself_is_not_said_again(
    cli, folder, protocol_file, bench_file, option
):
    said = cli("run", protocol_file(), "--bench", bench_file(), "--resume", "x.h5", *option)
    assert (said.status, said.out) == (2, "")
    assert "the unfinished run has its own already; leave it out" in said.err


def test_a_run_file_shows_what_it_holds(cli, folder, protocol_file, bench_file):
    who = ["--reed", "R07", "--strength", "3.5", "--note", "new [box]", "--out", "x.h5"]
    assert cli("run", protocol_file(), "--bench", bench_file(), *who, "--no-fit").status == 0
    shown = cli("show", "x.h5", "--json").json
    assert (shown["reed"], shown["kind"], shown["strength"]) == ("R07", "clarinet", 3.5)
    assert (shown["verdicts"], shown["bad"], shown["earlier_attempts"]) == ({"ok": 9}, [], [])
    assert set(shown["instruments"]) == {"synthesizers", "generator", "camera"}
    assert 0 < shown["lock_error_hz"]["median"] < 0.2
    shown = cli("show", "x.h5")
    assert shown.status == 0
    for words in ("R07 (clarinet), strength 3.5, series A", "9 ok", "new [box]", "Hz median"):
        assert words in shown.out
    refused = cli("show", "nothing.h5")
    assert (refused.status, refused.out) == (2, "")
    assert "there is no such file" in refused.err


def test_bad_steps_and_earlier_attempts_are_shown(cli, folder, protocol_file, bench_file):
    bench = bench_file(faults={"drop_frame_at": [3]})
    assert cli("run", protocol_file(), "--bench", bench, "--out", "x.h5", "--no-fit").status == 0
    shown = cli("show", "x.h5", "--json").json
    assert (shown["verdicts"], shown["bad"]) == ({"ok": 9}, [])
    (earlier,) = shown["earlier_attempts"]
    assert (earlier["index"], earlier["verdict"]) == (18, "dropped")
    assert "measured again" in cli("show", "x.h5").out


# --- Outputs that cannot be confirmed off ------------------------------------------------------

STUCK = """
from drivers.errors import InstrumentError
from drivers.simulated import SimulatedGenerator

class StuckGenerator(SimulatedGenerator):
    # Its relay sticks, however often it is opened again.
    def read(self):
        frequency_hz, volts, on = super().read()
        return frequency_hz, volts, on or any(state.drive_v for _, state in self.lab.changes)

class AbsentSynthesizers:
    def __init__(self, entry, context):
        raise InstrumentError("synthesizers: do not answer; check the cable")
"""


@pytest.fixture
def stuck(tmp_path, monkeypatch):
    """A package with a generator whose output does not go off."""
    (tmp_path / "stuck_drivers.py").write_text(STUCK)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "stuck_drivers"
    sys.modules.pop("stuck_drivers", None)


def test_an_output_that_is_not_confirmed_off_is_a_failure(
    cli, folder, protocol_file, bench_file, stuck
):
    bench = bench_file(drivers={"generator": f"{stuck}:StuckGenerator"})
    run = ("run", protocol_file(), "--bench", bench, "--no-fit")
    done = cli(*run, "--out", "x.h5", "--json")
    assert done.status == 1
    assert done.json["status"] == "complete"
    assert any("tweeter output" in left for left in done.json["unconfirmed"])
    assert "NOT CONFIRMED" in cli(*run, "--out", "y.h5").err


def test_a_campaign_ends_at_the_first_output_that_is_not_confirmed_off(
    cli, folder, protocol_file, bench_file, campaign_of, stuck
):
    bench = bench_file(drivers={"generator": f"{stuck}:StuckGenerator"})
    campaign = campaign_of(protocol_file(), "first", "second")
    done = cli("run", campaign, "--bench", bench, "--out", "c", "--json")
    assert done.status == 1
    assert list(done.json["parts"]) == ["first"]
    assert done.json["unconfirmed"]
    assert not (folder / "c" / "second.h5").exists()


def test_a_bench_that_cannot_be_opened_says_in_json_what_may_be_on(
    cli, folder, protocol_file, bench_file, stuck
):
    bench = bench_file(drivers={"synthesizers": f"{stuck}:AbsentSynthesizers"})
    done = cli("run", protocol_file(), "--bench", bench, "--out", "x.h5", "--json")
    assert done.status == 1
    assert done.json["status"] == "failed"
    assert "RF" in done.json["unconfirmed"][0]
    assert "may be on" in done.err
    assert not (folder / "x.h5").exists()


def test_a_run_that_policy_ends_is_no_interrupt(cli, folder, protocol_file, bench_file):
    protocol = protocol_file(**{"policy.give_up_after": 3})
    bench = bench_file(faults={"tweeter_unplugged": True})
    done = cli("run", protocol, "--bench", bench, "--out", "x.h5", "--json")
    assert done.status == 1
    assert done.json["status"] == "interrupted"
    assert 3 <= done.json["verdicts"]["no_signal"] <= 6
    assert "tweeter's cable" in done.json["reason"]


# --- Campaigns that are gone on with -----------------------------------------------------------


@pytest.fixture
def campaign_of(folder):
    """Return a function that writes a campaign of a protocol's sweeps."""

    def write(protocol, *parts, **changes):
        lines = [f"name: Small\nprotocol: {protocol}\nparts:"]
        for part in parts:
            lines.append(f"  - name: {part}")
            lines += [f"    {line}" for line in changes.get(part, [])]
        path = folder / "campaign.yaml"
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


@pytest.mark.slow
def test_a_campaign_that_was_killed_is_gone_on_with(
    cli, folder, protocol_file, bench_file, campaign_of
):
    """Parts that are complete stay, the broken one goes on, and the rest follows."""
    parts = {"third": ["new_clamping: true", "do: take the reed out and put it back"]}
    campaign = campaign_of(protocol_file(), "first", "second", "third", "fourth", **parts)
    bench = bench_file(pace="realtime")
    process = subprocess.Popen(
        [sys.executable, "-m", "acquire", "run", str(campaign), "--bench", str(bench),
         "--reed", "R9", "--seed", "3", "--note", "a note", "--out", "c"],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    third = folder / "c" / "third.h5"
    wait_for_steps(third, 3)
    process.kill()
    process.wait()
    first = (folder / "c" / "first.h5").read_bytes()
    again = ("run", campaign, "--bench", bench, "--resume", "c")
    done = cli(*again, "--json")
    assert done.status == 0, done.err
    assert list(done.json["parts"]) == ["third", "fourth"]
    assert (folder / "c" / "first.h5").read_bytes() == first
    runs = [
        Run.open(folder / "c" / f"{name}.h5") for name in ("first", "second", "third", "fourth")
    ]
    assert [run.status for run in runs] == ["complete"] * 4
    assert [run.acquisition.clamping for run in runs] == [0, 0, 1, 1]
    assert {(run.reed, run.seed, run.labels.note) for run in runs} == {("R9", 3, "a note")}
    assert {run.acquisition.campaign for run in runs} == {"c"}
    assert [interruption.kind for interruption in runs[2].interruptions] == ["resumed"]
    # The reed was not clamped a second time: its speckle is the same before and after.
    fields = [run.field(0).ravel() for run in runs]
    same = [abs(np.vdot(fields[2], field)) / np.linalg.norm(fields[2]) / np.linalg.norm(field)
            for field in fields]  # fmt: skip
    assert same[3] > 0.9
    assert max(same[:2]) < 0.5
    for run in runs:
        run.close()
    said = cli(*again)
    assert (said.status, said.out) == (2, "")
    assert "complete" in said.err


@pytest.mark.parametrize("prepared", ["nothing", "an empty folder"])
def test_a_folder_without_a_campaign_is_not_gone_on_with(
    cli, folder, protocol_file, bench_file, campaign_of, prepared
):
    if prepared != "nothing":
        (folder / "c").mkdir()
    said = cli("run", campaign_of(protocol_file(), "up"), "--bench", bench_file(), "--resume", "c")
    assert (said.status, said.out) == (2, "")
    assert "holds no part" in said.err


def test_another_campaign_is_not_put_into_a_folder(
    cli, folder, protocol_file, bench_file, campaign_of
):
    stop = campaign_of(protocol_file(**{"policy.give_up_after": 1}), "up", "down")
    dark = bench_file("dark.yaml", faults={"tweeter_unplugged": True})
    assert cli("run", stop, "--bench", dark, "--out", "c").status == 1
    said = cli("run", stop, "--bench", bench_file(), "--resume", "c")
    assert (said.status, said.out) == (2, "")
    assert "another bench" in said.err


def test_only_one_of_two_programs_goes_on_with_a_campaign(
    cli, folder, protocol_file, bench_file, campaign_of
):
    campaign = campaign_of(protocol_file(**{"policy.give_up_after": 1}), "up", "down")
    dark = bench_file("dark.yaml", faults={"tweeter_unplugged": True})
    assert cli("run", campaign, "--bench", dark, "--out", "c").status == 1
    with controllable(folder / "c"):
        said = cli("run", campaign, "--bench", dark, "--resume", "c")
    assert (said.status, said.out) == (2, "")
    assert "is being measured" in said.err
