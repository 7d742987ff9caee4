"""The command line in this process, small protocols, and two runs of a reed, fitted once."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from acquire.cli.main import app
from protocols.bench import find_bench
from protocols.protocol import find_protocol

REED = "R07"


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
def _each_run_fitted_once(monkeypatch, fit_once):
    monkeypatch.setattr("acquire.analysis.fit_runs", fit_once)


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
def measured(made_once, fit_once):
    """Series A and B from F1 to T2 on a quarter of the sensor, by the command line."""
    part = {"camera.width": 640, "camera.height": 512, "sweep.stride": 2}
    part |= {"sweep.first": 15, "sweep.last": 107}

    def make(path):
        said = {}
        for series, more in (("A", ["--json"]), ("B", ["--no-fit"])):
            protocol = _write_protocol(path.parent / f"{series}.yaml", f"series{series}", part)
            who = ["--reed", REED, "--strength", "3.5", "--note", f"new box {series}"]
            out = ["--out", path.parent / "runs" / f"{REED}-{series}.h5"]
            said[series] = _invoke("run", protocol, *who, "--operator", "Ann", *out, *more)
            assert said[series].status == 0, said[series].err
        path.write_text(json.dumps(asdict(said["A"])))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquire.analysis.fit_runs", fit_once)
        said = made_once("measured.json", make)
    runs = [said.parent / "runs" / f"{REED}-{series}.h5" for series in "AB"]
    return Measured(*runs, Outcome(**json.loads(said.read_text())))
