"""The documents of a run file are those of the event model."""

import json

import event_model
import h5py
import numpy as np
import pytest

from acquire.runner.runner import run
from drivers.errors import InstrumentError
from runs.documents import documents_path
from runs.errors import RunFileError
from runs.reader import Run, RunLabels
from runs.verdict import Verdict

BEGINNING = ["start", "descriptor", "descriptor"]
END = ["stream_resource", "stream_datum", "stop"]


def documents_of(path):
    lines = documents_path(path).read_text(encoding="utf-8").splitlines()
    documents = [json.loads(line) for line in lines]
    for name, document in documents:
        event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
    return documents


def test_a_complete_run_is_a_valid_stream(small_plan, open_small_bench, tmp_path):
    plan, path = small_plan(), tmp_path / "R07.h5"
    run(plan, open_small_bench(plan), path, RunLabels(strength=3.5, note="dry", operator="Ada"))
    documents = documents_of(path)
    names = [name for name, _ in documents]
    assert names == [*BEGINNING, *["event"] * 5, *END]
    start, descriptor = documents[0][1], documents[1][1]
    assert start["run_file"] == "R07.h5"
    assert (start["reed"], start["strength"], start["operator"]) == ("R07", 3.5, "Ada")
    assert descriptor["run_start"] == start["uid"]
    assert documents[-1][1]["exit_status"] == "success"
    assert documents[-1][1]["num_events"] == {"primary": 5, "steps": 5}
    with Run.open(path) as measured:
        assert measured.uid == start["uid"]
        for (_, event), step in zip(documents[3:-3], measured, strict=True):
            assert event["data"]["index"] == step.index
            assert event["data"]["drive_hz"] == float(step.drive_hz)
            assert event["data"]["signal_to_noise"] == step.signal_to_noise
            assert event["data"]["verdict"] == step.verdict == Verdict.OK


def test_the_event_model_s_own_router_accepts_the_stream(small_plan, open_small_bench, tmp_path):
    plan, path = small_plan(), tmp_path / "R07.h5"
    run(plan, open_small_bench(plan), path)
    seen = []

    class Reader(event_model.SingleRunDocumentRouter):
        def event(self, doc):
            seen.append(self.get_stream_name(doc))

    reader = Reader()
    for name, document in documents_of(path):
        reader(name, document)
    assert seen == ["primary"] * 5
    assert reader.get_start()["plan_name"] == plan.protocol.name


def test_an_interrupted_run_says_abort(tiny_plan, fake_bench, tmp_path):
    def give_up_the_second(name, count):
        if (name, count) == ("grab", 2):
            raise KeyboardInterrupt

    path = tmp_path / "run.h5"
    run(tiny_plan(), fake_bench(before=give_up_the_second).opened(), path)
    documents = documents_of(path)
    assert [name for name, _ in documents] == [*BEGINNING, "event", *END]
    assert documents[-1][1]["exit_status"] == "abort"


def test_a_run_that_is_gone_on_with_has_one_end(tiny_plan, fake_bench, tmp_path):
    def give_up_the_second(name, count):
        if (name, count) == ("grab", 2):
            raise KeyboardInterrupt

    plan, path = tiny_plan(), tmp_path / "run.h5"
    run(plan, fake_bench(before=give_up_the_second).opened(), path)
    begun = documents_of(path)[:-3]
    run(plan, fake_bench().opened(), path, resume=True)
    documents = documents_of(path)
    assert [name for name, _ in documents] == [*BEGINNING, *["event"] * 3, *END]
    assert documents[: len(begun)] == begun
    assert [event["seq_num"] for _, event in documents[3:-3]] == [1, 2, 3]
    assert documents[-1][1]["num_events"] == {"primary": 3, "steps": 3}


@pytest.mark.parametrize("keep", ["holograms", "frames"])
def test_the_last_documents_point_at_what_the_run_file_keeps(keep, tiny_plan, fake_bench, tmp_path):
    plan, path = tiny_plan(keep=keep), tmp_path / "run of µ.h5"
    run(plan, fake_bench().opened(), path)
    documents = documents_of(path)
    steps, resource, datum = (documents[place][1] for place in (2, -3, -2))
    assert resource["uri"] == f"file://localhost{path}"
    assert datum["descriptor"] == steps["uid"]
    assert datum["stream_resource"] == resource["uid"]
    assert datum["indices"] == {"start": 0, "stop": 3}
    assert datum["seq_nums"] == {"start": 1, "stop": 4}
    key = steps["data_keys"][resource["data_key"]]
    with h5py.File(path) as file:
        kept = file[resource["parameters"]["dataset"]]
        assert kept.name == f"/entry/data/{resource['data_key']}"
        assert kept.shape == (3, *key["shape"])
        assert kept.chunks == tuple(resource["parameters"]["chunk_shape"])
        assert kept.dtype == np.dtype(key["dtype_numpy"])
        assert kept.attrs["units"] == key["units"]
        indices = steps["configuration"]["steps"]["data"]["index"]
        assert indices == file["entry/steps/index"][()].tolist()


def test_a_failed_run_says_why(tiny_plan, fake_bench, tmp_path):
    fake, path = fake_bench(failing={"grab": 3}), tmp_path / "run.h5"
    with pytest.raises(InstrumentError):
        run(tiny_plan(), fake.opened(), path)
    name, stop = documents_of(path)[-1]
    assert (name, stop["exit_status"]) == ("stop", "fail")
    assert "grab fails" in stop["reason"]


def test_documents_are_never_overwritten(tiny_plan, fake_bench, tmp_path):
    fake, path = fake_bench(), tmp_path / "run.h5"
    documents_path(path).write_text("kept")
    with pytest.raises(RunFileError, match=r"run\.documents\.jsonl: exists already"):
        run(tiny_plan(), fake.opened(), path)
    assert documents_path(path).read_text() == "kept"
    assert not path.exists()
    assert fake.log == []
