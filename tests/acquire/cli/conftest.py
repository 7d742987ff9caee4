"""The command line in this process, small protocols, and two runs of a reed, fitted once."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from acquire.cli.main import app
from fitting.cane.fit_runs import fit_runs
from protocols.bench import find_bench
from protocols.protocol import find_protocol

REED = "R07"


@cache
def _fitted(paths, model, method):
    return fit_runs(paths, model, method=method)


def _fit_once(runs, model="fem", announce=None, method="joint"):
    """Fit the same runs once for a session, however many verbs ask for it."""
    return _fitted(tuple(Path(run).resolve() for run in runs), model, method)


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    status: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


def _invoke(*arguments):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return Outcome(done.exit_code, done.stdout, done.stderr)


@pytest.fixture(autouse=True)
def _bench_of_the_user(monkeypatch):
    monkeypatch.setattr("acquire.analysis.fit_runs", _fit_once)


@pytest.fixture(scope="session")
def cli():
    """Return a function that carries out a command; whatever it does not catch is raised."""
    return _invoke


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder that commands are given in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def bench_file(tmp_path):
    """Return a function that writes a bench with a coarse reed and settings of the simulation."""

    def write(name="bench.yaml", drivers=None, **twin):
        content = yaml.safe_load(find_bench().read_text(encoding="utf-8"))
        content["twin"] = {"mesh": "coarse", **twin}
        for role, driver in (drivers or {}).items():
            content["instruments"][role]["driver"] = driver
        path = tmp_path / name
        path.write_text(yaml.safe_dump(content))
        return path

    return write


def _write_protocol(path, name, changes):
    content = yaml.safe_load(find_protocol(name).read_text(encoding="utf-8"))
    for key, value in changes.items():
        *sections, last = key.split(".")
        section = content
        for part in sections:
            section = section.setdefault(part, {})
        section[last] = value
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture
def protocol_file(tmp_path):
    """Return a function that writes a protocol of nine steps on a tiny sensor, with changes."""

    def write(name="small.yaml", **changes):
        tiny = {"camera.width": 160, "camera.height": 128, "sweep.stride": 2}
        tiny |= {"sweep.first": 14, "sweep.last": 30}
        return _write_protocol(tmp_path / name, "quick", {**tiny, **changes})

    return write


@dataclass(frozen=True)
class Measured:
    """Two runs of one reed, and what `acquire run` said of the first."""

    a: Path
    b: Path
    said: Outcome


@pytest.fixture(scope="session")
def measured(tmp_path_factory):
    """Series A and B from F1 to T2 on a quarter of the sensor, by the command line."""
    folder = tmp_path_factory.mktemp("bench")
    part = {"camera.width": 640, "camera.height": 512, "sweep.stride": 2}
    part |= {"sweep.first": 15, "sweep.last": 107}
    said = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquire.analysis.fit_runs", _fit_once)
        for series, more in (("A", ["--json"]), ("B", ["--no-fit"])):
            protocol = _write_protocol(folder / f"{series}.yaml", f"series{series}", part)
            who = ["--reed", REED, "--strength", "3.5", "--note", f"new box {series}"]
            out = ["--out", folder / "runs" / f"{REED}-{series}.h5"]
            said[series] = _invoke("run", protocol, *who, "--operator", "Ann", *out, *more)
            assert said[series].status == 0, said[series].err
    return Measured(*(folder / "runs" / f"{REED}-{s}.h5" for s in "AB"), said["A"])
