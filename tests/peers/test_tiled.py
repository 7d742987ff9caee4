"""The documents of a run file, read by Tiled, LiveTable and suitcase as they stand.

Nothing stands between a line of the file and the reader: it is parsed and handed over. Tiled is the
real server with a catalog in memory, asked through its client.
"""

import json
import re

import numpy as np
import pytest

from acquire.runner.runner import run as measure
from runs.documents import documents_path
from runs.reader import Run, RunLabels
from runs.verdict import Verdict

ABSENT = "Tiled, bluesky or suitcase is absent; pip install -e '.[peers]'"
catalog = pytest.importorskip("tiled.catalog", reason=ABSENT)
client = pytest.importorskip("tiled.client", reason=ABSENT)
app = pytest.importorskip("tiled.server.app", reason=ABSENT)
tiled_writer = pytest.importorskip("bluesky_tiled_plugins.writing.tiled_writer", reason=ABSENT)
validator = pytest.importorskip("bluesky_tiled_plugins.writing.validator", reason=ABSENT)
callbacks = pytest.importorskip("bluesky.callbacks", reason=ABSENT)
jsonl = pytest.importorskip("suitcase.jsonl", reason=ABSENT)

# Of Tiled, which calls Starlette's test client.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Using `httpx` with `starlette.testclient` is deprecated"
)

# Columns of `/entry/steps` that are in every event under the same name.
SHARED_COLUMNS = (
    "index",
    "signal_to_noise",
    "noise_level",
    "saturated_share",
    "lock_error_hz",
    "lock_error_se_hz",
    "verdict",
    "sentence",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("runs of µ")


@pytest.fixture(scope="module")
def tiled(folder, tmp_path_factory):
    """Client of an empty Tiled server that may read the folder of the runs."""
    own = tmp_path_factory.mktemp("tiled")
    tree = catalog.in_memory(
        writable_storage=[str(own / "arrays"), f"sqlite:///{own / 'tables.db'}"],
        readable_storage=[str(folder)],
    )
    with client.Context.from_app(app.build_app(tree)) as context:
        yield client.from_context(context)


def documents_of(path):
    with documents_path(path).open(encoding="utf-8") as lines:
        return [tuple(json.loads(line)) for line in lines]


def read_back(tiled, documents, **options):
    write = tiled_writer.TiledWriter(tiled, **options)
    for name, document in documents:
        write(name, document)
    return tiled[documents[0][1]["uid"]]


def require_same(table, records):
    """Compare the table of events with steps of a run file, in the order of the events."""
    for column in SHARED_COLUMNS:
        assert table[column].values.tolist() == [getattr(one, column) for one in records], column
    for column, found in {
        "asked_hz": [float(one.asked_hz) for one in records],
        "drive_hz": [float(one.read_drive_hz) for one in records],
        "difference_hz": [float(one.read_aom1_hz - one.read_aom2_hz) for one in records],
        "volts": [one.read_volts for one in records],
    }.items():
        assert table[column].values.tolist() == found, column


def test_a_run_reads_back(small_plan, open_small_bench, folder, tiled):
    plan, path = small_plan(), folder / "R07.h5"
    labels = RunLabels(strength=3.5, note="dry", operator="Ada Lovelace")
    measure(plan, open_small_bench(plan), path, labels)
    found = read_back(tiled, documents_of(path))
    with Run.open(path) as run:
        start = found.metadata["start"]
        assert start["uid"] == run.uid
        assert (start["reed"], start["series"], start["chamber"]) == ("R07", "A", "asymmetric")
        assert (start["strength"], start["note"], start["operator"]) == (3.5, "dry", "Ada Lovelace")
        assert start["protocol_sha256"] == run.protocol_sha256
        assert start["bench_fingerprint"] == run.bench_fingerprint
        assert found.metadata["stop"]["exit_status"] == "success"
        assert found.metadata["stop"]["num_events"] == {"primary": 5, "steps": 5}
        assert np.all(np.isfinite([step.lock_error_hz for step in run]))
        require_same(found["primary"].read(), run.steps)


@pytest.mark.parametrize("keep", ["holograms", "frames"])
def test_tiled_serves_the_arrays_of_the_run_file(keep, small_plan, open_small_bench, folder, tiled):
    plan, path = small_plan({"keep": keep}), folder / f"{keep}.h5"
    measure(plan, open_small_bench(plan), path)
    found = read_back(tiled, documents_of(path))
    with Run.open(path) as run:
        read, name = (run.field, "field") if keep == "holograms" else (run.frames, "frames")
        kept = np.stack([read(step.position) for step in run])
        indices = [step.index for step in run]
    served = found["steps"][name]
    assert served.dtype == kept.dtype
    np.testing.assert_array_equal(served.read(), kept)
    np.testing.assert_array_equal(served[3], kept[3])
    assert found["steps"].metadata["configuration"]["steps"]["data"]["index"] == indices
    # Type, shape and chunks that the documents announce are those of the file.
    assert validator.validate(found, fix_errors=False, raise_on_error=True)


def test_every_take_of_a_step_is_an_event_and_the_last_one_is_served(
    small_plan, open_small_bench, folder, tiled
):
    plan, path = small_plan(faults={"drop_frame_at": [2]}), folder / "retaken.h5"
    measure(plan, open_small_bench(plan), path)
    found = read_back(tiled, documents_of(path))
    table = found["primary"].read()
    with Run.open(path) as run:
        first, second, *others = run.steps
        [dropped] = run.earlier_attempts
        assert (dropped.verdict, second.verdict) == (Verdict.DROPPED, Verdict.OK)
        require_same(table, [first, dropped, *others, second])
        assert table["attempt"].values.tolist() == [1, 1, 1, 1, 1, 2]
        np.testing.assert_array_equal(found["steps"]["field"][1], run.field(1))
        assert not np.array_equal(run.field(1), run.earlier_field(0))


def test_a_run_that_is_gone_on_with_reads_back_as_one(
    small_plan, open_small_bench, folder, tiled, monkeypatch
):
    plan, path = small_plan(), folder / "resumed.h5"
    bench = open_small_bench(plan)
    grab, grabbed = bench.camera.grab, []

    def give_up_the_third(count, not_before_s):
        grabbed.append(count)
        if len(grabbed) == 3:
            raise KeyboardInterrupt
        return grab(count, not_before_s)

    monkeypatch.setattr(bench.camera, "grab", give_up_the_third)
    measure(plan, bench, path)
    begun = documents_of(path)
    assert begun[-1][1]["exit_status"] == "abort"
    measure(plan, open_small_bench(plan), path, resume=True)
    documents = documents_of(path)
    names = [name for name, _ in documents]
    assert names.count("start") == names.count("stop") == 1
    assert documents[:5] == begun[:5]
    found = read_back(tiled, documents)
    assert found.metadata["stop"]["exit_status"] == "success"
    with Run.open(path) as run:
        assert len(run.interruptions) == 1
        require_same(found["primary"].read(), run.steps)
        np.testing.assert_array_equal(
            found["steps"]["field"].read(), [run.field(step.position) for step in run]
        )


def test_a_killed_run_reads_back_as_far_as_it_came(small_plan, open_small_bench, folder, tiled):
    plan, path, left = small_plan(), folder / "killed.h5", []
    # What SIGKILL leaves: every line is with the operating system before the next step is written.
    measure(plan, open_small_bench(plan), path, progress=lambda _: left.append(documents_of(path)))
    documents = left[2]
    assert [name for name, _ in documents].count("event") == 3
    # Its default is to keep rows back until the stop document, which never comes.
    found = read_back(tiled, documents, batch_size=1)
    assert "stop" not in found.metadata
    with Run.open(path) as run:
        require_same(found["primary"].read(), run.steps[:3])


def test_livetable_shows_every_step(small_plan, open_small_bench, folder, monkeypatch):
    # Without it LiveTable reports what it cannot read, and goes on.
    monkeypatch.setenv("BLUESKY_DEBUG_CALLBACKS", "1")
    plan, path, said = small_plan(), folder / "shown.h5", []
    measure(plan, open_small_bench(plan), path)
    show = callbacks.LiveTable(["index", "drive_hz", "verdict"], out=said.append)
    for name, document in documents_of(path):
        show(name, document)
    rows = [re.split(r"\s*\|\s*", line.strip("| ")) for line in said if " ok " in line]
    assert [row[2:] for row in rows] == [
        [str(step.index), f"{float(step.drive_hz):.3f}", "ok"] for step in plan.steps
    ]


def test_suitcase_writes_the_same_lines(small_plan, open_small_bench, folder, tmp_path):
    plan, path = small_plan(), folder / "packed.h5"
    measure(plan, open_small_bench(plan), path)
    artifacts = jsonl.export(documents_of(path), tmp_path)
    assert artifacts["all"][0].read_text() == documents_path(path).read_text()
