"""Runs that are paused, gone on with and looked at, through the command line."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from acquire.runfile import Run

ROOT = Path(__file__).parents[2]


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
    """Wait until a run in work has told of so many steps."""
    documents = path.with_suffix(".documents.jsonl")
    for _ in range(600):
        if documents.exists() and documents.read_text().count('["event"') >= count:
            return
        time.sleep(0.05)
    raise AssertionError("the run does not get on")


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
        assert [seam.kind for seam in run.seams] == ["paused"]
    assert "paused, all is off; go on with: acquire continue x.h5" in err
    assert not (folder / "x.process").exists()


@pytest.mark.parametrize("verb", ["pause", "continue"])
def test_only_a_run_in_work_obeys(cli, folder, verb):
    Path("x.process").write_text(f"{os.getpid()}\n")
    said = cli(verb, "x.h5")
    assert (said.status, said.out) == (2, "")
    assert "is not being measured" in said.err


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
    (seam,) = shown["seams"]
    assert (seam["kind"], seam["reason"]) == ("resumed", "the process was gone")
    assert 3 <= seam["position"] < 9
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
    assert (shown["verdicts"], shown["bad"], shown["retakes"]) == ({"ok": 9}, [], [])
    assert set(shown["instruments"]) == {"synthesizers", "generator", "camera"}
    assert 0 < shown["lock_error_hz"]["median"] < 0.2
    told = cli("show", "x.h5")
    assert told.status == 0
    for words in ("R07 (clarinet), strength 3.5, series A", "9 ok", "new [box]", "Hz median"):
        assert words in told.out
    refused = cli("show", "nothing.h5")
    assert (refused.status, refused.out) == (2, "")
    assert "there is no such file" in refused.err


def test_bad_steps_and_retakes_are_shown(cli, folder, protocol_file, bench_file):
    bench = bench_file(faults={"drop_frame_at": [3]})
    assert cli("run", protocol_file(), "--bench", bench, "--out", "x.h5", "--no-fit").status == 0
    shown = cli("show", "x.h5", "--json").json
    assert (shown["verdicts"], shown["bad"]) == ({"ok": 9}, [])
    (retake,) = shown["retakes"]
    assert (retake["index"], retake["verdict"]) == (18, "dropped")
    assert "taken again" in cli("show", "x.h5").out
