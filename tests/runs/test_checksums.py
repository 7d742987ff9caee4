"""Checksums of steps: what the disk damages is noticed, and what is judged again is not."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from acquire.runner.recorder import reconstruction_of
from acquire.runner.runner import run
from acquire.runner.summary import RunState
from drivers.roles import Frame
from runs.errors import RunFileError
from runs.integrity.checksums import (
    in_header,
    pixel_checksum,
    row_checksums,
    whole_rows,
)
from runs.layout import Interruption
from runs.reader import (
    MeasuredStep,
    Run,
    RunLabels,
    RunWriter,
)
from runs.verdict import (
    Judgement,
    ReadBack,
    Verdict,
)

# Columns that may change without a step being damaged.
FREE_TO_CHANGE = {"verdict", "sentence"}


def taken(plan, position, verdict=Verdict.OK, attempt=1):
    """A step whose every number follows from its position and its attempt."""
    rng = np.random.default_rng([position, attempt])
    step, number = plan.steps[position], 10 * position + attempt
    images = rng.integers(0, 4096, (4, *plan.frame_shape), dtype=np.uint16)
    frames = [Frame(4 * number + k, number + 0.1 * k, image) for k, image in enumerate(images)]
    read = ReadBack(step.aom1_hz, step.aom2_hz, step.drive_hz, step.volts)
    field = reconstruction_of(plan).field(images)
    return MeasuredStep(
        read, float(number), frames, field, 10.0, 2.0, 0.01, 900.0, -1e-3, 1e-4, 1e-3,
        Judgement(verdict, f"attempt {attempt}"),
    )  # fmt: skip


@pytest.fixture
def measured(tiny_plan, fake_bench, tmp_path):
    """Write a run of three good steps, the second at its second attempt; return plan and path."""

    def make(keep="holograms", status="complete"):
        plan = tiny_plan(steps=3, keep=keep, **{"policy.bad_step.retries": 1})
        writer = RunWriter.create(
            tmp_path / f"{keep}.h5", plan, fake_bench().opened(), RunLabels(),
            reconstruction_of(plan), "uid",
        )  # fmt: skip
        for position in range(3):
            writer.write(position, taken(plan, position, Verdict.LOCK if position == 1 else "ok"))
        writer.set_aside(1)
        writer.write(1, taken(plan, 1, attempt=2))
        writer.finish(status)
        return plan, writer.path

    return make


def flip(path, name, place=0):
    """Flip one bit in an entry of a dataset, where it is in the file."""
    with h5py.File(path, "r") as file:
        dataset = file["entry"][name]
        if dataset.chunks:
            at = dataset.id.get_chunk_info(place).byte_offset
        else:
            rows = len(dataset) if dataset.shape else 1
            at = dataset.id.get_offset() + place * dataset.nbytes // rows
    with path.open("r+b") as file:
        file.seek(at)
        byte = file.read(1)[0]
        file.seek(at)
        file.write(bytes([byte ^ 1]))


def columns_of(path, group="entry/steps"):
    with h5py.File(path, "r") as file:
        return sorted(file[group])


def test_checksums_can_be_worked_out_as_the_documentation_shows(measured):
    _, path = measured()
    text = (Path(__file__).parents[2] / "docs/reference/run-file.md").read_text("utf-8")
    text = text.partition("## Checksums")[2].partition("\n## ")[0]
    named = {}
    for block in text.split("```python\n")[1:]:
        exec(block.partition("```")[0], named)
    with h5py.File(path, "r") as file:
        steps = file["entry/steps"]
        for k in range(3):
            assert named["row_checksum"](file, k) == steps["row_checksum"][k]
            assert named["pixel_checksum"](file, k) == steps["pixel_checksum"][k]
        assert named["header_checksum"](file) == file["entry/header_checksum"][()]


def test_a_flipped_byte_in_labels_geometry_or_provenance_is_noticed(measured):
    _, path = measured()
    with h5py.File(path, "r") as file:
        names = []
        file.visititems(lambda name, node: names.append(name) if hasattr(node, "dtype") else None)
        numbers = [n for n in names if in_header(n) and file[n].dtype.kind in "iuf"]
    assert len(numbers) > 15
    for name in [*numbers, "entry/header_checksum"]:
        copy = shutil.copy(path, path.with_name("copy.h5"))
        flip(copy, name.removeprefix("entry/"))
        with pytest.raises(RunFileError, match="is damaged"):
            Run.open(copy)
    data = path.read_bytes()
    protocol = b"sweep:"
    assert protocol in data
    path.write_bytes(data.replace(protocol, b"swees:"))
    with pytest.raises(RunFileError, match=r"labels, geometry or provenance .*checksum"):
        Run.open(path)


def test_what_others_add_does_no_harm(measured):
    _, path = measured()
    with h5py.File(path, "r+") as file:
        file["entry/notes/of/a/reader"] = "hello"
    Run.open(path).close()


@pytest.mark.parametrize("keep", ["holograms", "frames"])
def test_a_flipped_byte_in_pixels_is_noticed_whenever_they_are_read(measured, keep):
    _, path = measured(keep)
    name = "field" if keep == "holograms" else "frames"
    flip(path, f"data/{name}", 2)
    flip(path, f"earlier_attempts/{name}", 0)
    with Run.open(path) as run:
        assert run.good.all()
        run.field(0)
        for read in (run.field, run.frames) if keep == "frames" else (run.field,):
            with pytest.raises(RunFileError, match=r"step 16 is damaged .*checksum.*another copy"):
                read(2)
        with pytest.raises(RunFileError, match="an earlier attempt of step 14 is damaged"):
            run.earlier_field(0)


def test_a_flipped_byte_in_any_number_of_a_step_is_noticed_when_a_run_is_opened(measured):
    _, path = measured()
    for name in set(columns_of(path)) - FREE_TO_CHANGE:
        copy = shutil.copy(path, path.with_name("copy.h5"))
        flip(copy, f"steps/{name}", 1)
        with pytest.raises(
            RunFileError, match=r"numbers of .*(row 1).*damaged.*measure again"
        ) as e:
            Run.open(copy)
        assert (e.value.exit_status, str(e.value).isprintable()) == (2, True)
    with Run.open(copy, damaged_as_pending=True) as run:
        assert [step.verdict for step in run] == ["ok", "pending", "ok"]


def test_a_flipped_byte_in_any_number_of_an_earlier_take_is_noticed(measured):
    _, path = measured()
    for name in set(columns_of(path, "entry/earlier_attempts")) - {
        *FREE_TO_CHANGE,
        "field",
        "position",
    }:
        copy = shutil.copy(path, path.with_name("copy.h5"))
        flip(copy, f"earlier_attempts/{name}", 0)
        with pytest.raises(RunFileError, match="an earlier attempt of step 14 are damaged"):
            Run.open(copy)


def test_a_step_may_be_judged_again(measured):
    _, path = measured()
    with h5py.File(path, "r+") as file:
        file["entry/steps/verdict"][0] = "stale"
        file["entry/steps/sentence"][0] = "seen at the end of the sweep"
    with Run.open(path) as run:
        assert (run.steps[0].verdict, run.steps[0].sentence[:4]) == (Verdict.STALE, "seen")
        run.field(0)


def test_whatever_column_is_added_counts():
    columns = {"index": np.arange(3), "name": np.array([b"a", b"b", b"c"], dtype="S8")}
    before = row_checksums(columns)
    after = row_checksums(columns | {"dew_point_k": np.array([1.0, np.nan, 3.0])})
    assert (before != after).all()
    judged = columns | {"verdict": np.array([b"ok"] * 3), "sentence": np.array([b""] * 3)}
    assert (row_checksums(judged | {"row_checksum": before}) == before).all()
    spoilt = before ^ np.array([0, 1, 0], dtype=np.uint64)
    assert whole_rows(columns | {"row_checksum": spoilt}).tolist() == [True, False, True]
    assert row_checksums({"index": np.arange(0)}).shape == (0,)


def test_a_checksum_is_that_of_the_bytes_however_they_lie_in_memory():
    pixels = np.arange(12, dtype=np.complex64).reshape(3, 4)
    assert pixel_checksum(pixels[::-1][::-1]) == pixel_checksum(pixels)
    assert pixel_checksum(np.asfortranarray(pixels)) == pixel_checksum(pixels)
    assert pixel_checksum(pixels.T) != pixel_checksum(pixels)


# --- Damaged runs that are not complete are mended by going on with them ---------------------


@pytest.mark.parametrize("damage", ["data/field", "steps/noise_level", "steps/verdict"])
def test_a_damaged_step_is_taken_again_when_its_run_is_gone_on_with(measured, damage):
    plan, path = measured(status="interrupted")
    flip(path, damage, 2)
    if damage != "data/field":
        with pytest.raises(RunFileError, match=r"step 16 .*damaged.*--resume"):
            Run.open(path)
    writer = RunWriter.resume(path, plan)
    assert writer.damaged == (2,)
    writer.reopen(Interruption(2, "resumed", "", "", ""))
    with Run.open(path) as run:
        assert [step.verdict for step in run] == ["ok", "ok", "pending"]
        assert "damaged" in run.steps[2].sentence
        assert np.isnan(run.steps[2].noise_level)
    writer.write(2, taken(plan, 2, attempt=3))
    writer.finish("complete")
    with Run.open(path) as run:
        assert run.good.all()
        for position, attempt in ((0, 1), (1, 2), (2, 3)):
            expected = taken(plan, position, attempt=attempt).field
            np.testing.assert_array_equal(run.field(position), expected)


def test_a_damaged_earlier_take_is_given_up_when_its_run_is_gone_on_with(measured):
    plan, path = measured(status="interrupted")
    flip(path, "earlier_attempts/noise_level", 0)
    writer = RunWriter.resume(path, plan)
    assert (writer.spare, writer.damaged) == (plan.spare_attempts, ())
    writer.finish("complete")
    with Run.open(path) as run:
        assert run.good.all()
        assert run.earlier_attempts == ()


def test_a_take_that_was_torn_while_it_was_set_aside_stays_where_it_was(measured):
    """As a power cut leaves it: the place claims an attempt that never came there."""
    plan, path = measured(status="interrupted")
    with h5py.File(path, "r+") as file:
        file["entry/steps/verdict"][2] = "stale"
        file["entry/earlier_attempts/position"][1] = -2 - 2
    with Run.open(path, damaged_as_pending=True) as run:
        assert (run.steps[2].verdict, len(run.earlier_attempts)) == (Verdict.STALE, 1)
    writer = RunWriter.resume(path, plan)
    assert writer.spare == plan.spare_attempts - 1
    writer.finish("complete")
    with Run.open(path) as run:
        assert (run.steps[2].verdict, len(run.earlier_attempts)) == (Verdict.STALE, 1)
        np.testing.assert_array_equal(run.field(2), taken(plan, 2).field)


@pytest.mark.parametrize("name", ["index", "order", "aom1_hz_exact"])
def test_a_plan_that_was_damaged_is_not_gone_on_with(measured, name):
    plan, path = measured(status="interrupted")
    flip(path, f"steps/{name}", 1)
    content = path.read_bytes()
    with pytest.raises(RunFileError, match=rf"column {name} .*; measure again"):
        RunWriter.resume(path, plan)
    assert path.read_bytes() == content


def test_a_run_with_a_torn_step_is_gone_on_with_and_says_so(
    tiny_plan, fake_bench, lit, tmp_path, documents_of
):
    plan, path = tiny_plan(), tmp_path / "run.h5"
    bench = replace(fake_bench(picture=lit(plan)).opened(), fingerprint=plan.bench.fingerprint)
    run(plan, bench, path)
    with h5py.File(path, "r+") as file:
        file["entry/status"][()] = "running"
    flip(path, "data/field", 1)
    bench = replace(fake_bench(picture=lit(plan)).opened(), fingerprint=plan.bench.fingerprint)
    assert run(plan, bench, path, resume=True).status is RunState.COMPLETE
    with Run.open(path) as mended:
        assert mended.good.all()
        mended.field(1)
        (interruption,) = mended.interruptions
        assert "damaged" in interruption.reason
        assert "step 14" in interruption.reason
    attempts = [d["data"] for name, d in documents_of(path) if name == "event"]
    assert [(attempt["index"], attempt["attempt"]) for attempt in attempts] == [
        (12, 1),
        (14, 1),
        (16, 1),
        (14, 2),
    ]
