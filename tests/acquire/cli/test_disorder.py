"""Runs on a bench with disorder: refused if it is wrong, recorded, and not read back."""

import json
import re
from pathlib import Path

import h5py
import pytest

from physics.parameters.disorder import ordinary_amounts
from runs.reader import Run

ROOT = Path(__file__).parents[3]
RECORD = "entry/provenance/simulated_disorder"


def measured(cli, protocol_file, bench_file, name, *more, **twin):
    bench = bench_file(name=f"{name}.yaml", **twin)
    made = [protocol_file(keep="frames"), "--bench", bench, "--out", f"{name}.h5", "--no-fit"]
    done = cli("run", *made, *more)
    assert done.status == 0, done.err
    return Path(f"{name}.h5")


def frames_of(path):
    with h5py.File(path, "r") as file:
        return file["entry/data/frames"][()]


@pytest.mark.parametrize(
    "disorder", [{"lag": "3 um"}, {"laag": 0.1}, {"thickness_map": "1 mm"}, "often", {"seed": -1}]
)
def test_a_wrong_disorder_ends_the_command_with_status_2(
    cli, folder, protocol_file, bench_file, disorder
):
    bench = bench_file(disorder=disorder)
    done = cli("run", protocol_file(), "--bench", bench, "--out", "x.h5", "--no-fit")
    assert done.status == 2
    assert "twin.disorder" in done.err
    assert not (folder / "x.h5").exists()


@pytest.mark.usefixtures("folder")
def test_a_run_keeps_what_was_drawn(cli, protocol_file, bench_file):
    who = ("--reed", "R12")
    path = measured(cli, protocol_file, bench_file, "x", *who, disorder="ordinary")
    with h5py.File(path, "r") as file:
        record = json.loads(file[RECORD].asstr()[()])
    found = {name: amount["value"] for name, amount in record["amounts"].items()}
    assert found == ordinary_amounts(0, "R12")
    again = measured(cli, protocol_file, bench_file, "y", *who, disorder="ordinary")
    assert (frames_of(again) == frames_of(path)).all()
    plain = measured(cli, protocol_file, bench_file, "z", *who)
    with h5py.File(plain, "r") as file:
        assert RECORD not in file
    assert (frames_of(plain) != frames_of(path)).mean() > 0.5
    # Checked with the rest of the header, and no attribute of a run.
    with Run.open(path) as run:
        own = {name: value for name, value in vars(run).items() if isinstance(value, str | dict)}
    assert not any(str(found["lag"]) in str(value) for value in own.values())


def test_no_fit_and_no_diagnosis_reads_how_a_bench_is_simulated():
    """Neither the record nor the section of the bench file; `_twin` is an argument elsewhere."""
    named = re.compile(r"simulated_disorder|\.twin\b|drivers\.simulated|provenance\[")
    readers = {
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for package in ("fitting", "diagnosis", "reports", "reproduction")
        for path in (ROOT / package).rglob("*.py")
        for line in path.read_text("utf-8").splitlines()
        if named.search(line)
    }
    assert readers == set()
    source = (ROOT / "drivers/simulated/lab.py").read_text("utf-8")
    assert named.search(source), "the pattern finds what it is for"
