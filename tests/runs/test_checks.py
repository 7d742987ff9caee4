"""What is refused of a run file before it is read, and what is not."""

import os
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from acquire.runner.recorder import reconstruction_of
from runs.errors import RunFileError
from runs.layout import RunLabels
from runs.reader import Run, RunWriter

STEPS = 4


@pytest.fixture
def run_file(tiny_plan, fake_bench, tmp_path):
    """Path of a run file with places for earlier attempts, none of whose steps was measured."""
    plan = tiny_plan(STEPS, **{"policy.bad_step.retries": 1})
    path = tmp_path / "run.h5"
    writer = RunWriter.create(
        path, plan, fake_bench().opened(), RunLabels(), reconstruction_of(plan), "uid"
    )
    writer.finish("failed")
    return path


def refused(path, change):
    """What is said of a file once `change` was done to it."""
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(RunFileError) as caught:
        Run.open(path)
    said = str(caught.value)
    assert said.isprintable()
    assert len(said) < 300 + len(str(path))
    assert caught.value.exit_status == 2
    return said.removeprefix(str(path))


def put(file, name, **made):
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, **made)
    file[name].attrs.update(attributes)


def test_a_file_that_acquire_wrote_is_read(run_file):
    with Run.open(run_file) as run:
        assert len(run) == STEPS


# --- Other files -------------------------------------------------------------------------------


@pytest.fixture
def decoy(run_file):
    """Return a named pipe: who opens it waits for ever."""
    path = run_file.with_name("decoy.h5")
    os.mkfifo(path)
    return str(path)


@pytest.mark.parametrize(
    "name",
    [
        "entry",
        "entry/status",
        "entry/title",
        "entry/steps",
        "entry/steps/volts",
        "entry/data/field",
    ],
)
def test_another_file_is_never_opened_by_a_link(run_file, decoy, name):
    def link(file):
        del file[name]
        file[name] = h5py.ExternalLink(decoy, name)

    assert f"{name} is in another file" in refused(run_file, link)


def test_another_file_is_never_opened_for_data(run_file, decoy):
    def store(file):
        put(file, "entry/steps/volts", shape=(STEPS,), dtype="f8", external=[(decoy, 0, 8 * STEPS)])

    assert "entry/steps/volts keeps its data in another file" in refused(run_file, store)


def test_another_file_is_never_opened_for_a_virtual_dataset(run_file, decoy):
    def map_to(file):
        layout = h5py.VirtualLayout((STEPS,), "f8")
        layout[...] = h5py.VirtualSource(decoy, "x", shape=(STEPS,))
        del file["entry/steps/volts"]
        file.create_virtual_dataset("entry/steps/volts", layout)

    assert "entry/steps/volts keeps its data in another file" in refused(run_file, map_to)


def test_software_of_others_is_never_loaded_to_read(run_file):
    def filter_by(file):
        made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        made.set_chunk((1,))
        made.set_filter(32_015, h5py.h5z.FLAG_OPTIONAL, ())
        space, steps = h5py.h5s.create_simple((STEPS,)), file["entry/steps"]
        del steps["volts"]
        h5py.h5d.create(steps.id, b"volts", h5py.h5t.IEEE_F64LE, space, made)

    assert "unknown filter 32015" in refused(run_file, filter_by)


# --- Links within the file ---------------------------------------------------------------------


@pytest.mark.parametrize("target", ["/entry/steps/carrier_leak", "/entry/steps/volts", "/none"])
def test_a_column_is_no_link_to_another(run_file, target):
    def link(file):
        del file["entry/steps/volts"]
        file["entry/steps/volts"] = h5py.SoftLink(target)

    assert "entry/steps/volts is a link" in refused(run_file, link)


@pytest.mark.parametrize("of", ["entry/steps/carrier_leak", "entry", "/"])
def test_an_object_has_one_name(run_file, of):
    def link(file):
        file["entry/steps/again"] = file[of]

    assert "second name" in refused(run_file, link)


# --- Types and shapes --------------------------------------------------------------------------

TYPES = {
    "text": h5py.string_dtype(),
    "compound": np.dtype([("a", "f8")]),
    "reference": h5py.ref_dtype,
    "lists": h5py.vlen_dtype("f8"),
    "enum": h5py.enum_dtype({"a": 0}),
    "opaque": "V8",
    "complex": "c16",
    "half": "f2",
}


@pytest.mark.parametrize("kind", TYPES)
def test_a_column_of_another_type_is_refused(run_file, kind):
    def retype(file):
        put(file, "entry/steps/volts", shape=(STEPS,), dtype=TYPES[kind])

    assert "(entry/steps/volts is not of the type number)" in refused(run_file, retype)


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("entry/title", {"data": 3}),
        ("entry/steps/verdict", {"data": np.zeros(STEPS)}),
        ("entry/steps/index", {"data": np.zeros(STEPS)}),
        ("entry/data/field", {"shape": (STEPS, 3, 3), "dtype": "f4"}),
    ],
)
def test_what_holds_something_else_is_refused(run_file, name, made):
    assert f"({name} is not of the type" in refused(run_file, lambda file: put(file, name, **made))


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("entry/title", {"data": ["a", "b"]}),
        ("entry/title", {"data": h5py.Empty("S3")}),
        ("entry/steps/volts", {"data": 1.0}),
        ("entry/steps/volts", {"data": np.ones(STEPS - 1)}),
        ("entry/steps/volts", {"data": np.ones(STEPS + 1)}),
        ("entry/steps/frame_id", {"data": np.ones((STEPS, 3), dtype=int)}),
        ("entry/steps/verdict", {"data": np.array(["ok"] * (STEPS - 1), dtype="S16")}),
        ("entry/data/field", {"shape": (STEPS, 5, 5), "dtype": "c8"}),
        ("entry/data/x_m", {"data": np.zeros(3)}),
        # 8 TiB, with no byte behind them.
        ("entry/steps/volts", {"shape": (2**40,), "dtype": "f8"}),
        ("entry/title", {"shape": (2**40,), "dtype": "S8"}),
        ("entry/data/field", {"shape": (STEPS, 2**19, 2**19), "dtype": "c8", "chunks": True}),
    ],
)
def test_shapes_that_do_not_fit_are_refused(run_file, name, made):
    said = refused(run_file, lambda file: put(file, name, **made))
    assert "has the shape" in said or "has no value" in said


@pytest.mark.parametrize("compression", [None, "lzf"])
def test_pictures_that_the_file_cannot_hold_are_refused(run_file, compression):
    """Whatever says how large pictures are says the same: 8 GiB each."""
    side = 2**15

    def enlarge(file):
        for name in ("rows", "columns"):
            file[f"entry/instrument/camera/{name}"][()] = side
        sizes = {"row": 0, "column": 0, "height": side, "width": side}
        for name, value in sizes.items():
            file[f"entry/region/{name}"][()] = value
        for name in ("y_m", "x_m"):
            put(file, f"entry/data/{name}", data=np.linspace(-0.01, 0.01, side))
        file["entry/instrument/laser/distance"][()] = 1e4
        shape, chunk = (STEPS, side, side), (1, 512, 512)
        put(
            file, "entry/data/field", shape=shape, dtype="c8", chunks=chunk, compression=compression
        )
        earlier_attempts = (len(file["entry/earlier_attempts/position"]), side, side)
        made = {"dtype": "c8", "chunks": chunk, "compression": compression}
        put(file, "entry/earlier_attempts/field", shape=earlier_attempts, **made)

    assert "bytes" in refused(run_file, enlarge)


def test_a_group_in_the_place_of_a_column_is_missed(run_file):
    def exchange(file):
        del file["entry/steps/volts"]
        file.create_group("entry/steps/volts")

    assert "is incomplete" in refused(run_file, exchange)


def test_a_named_type_is_refused(run_file):
    def name_type(file):
        file["entry/steps/kind"] = np.dtype("f8")

    assert "neither a group nor a dataset" in refused(run_file, name_type)


def test_a_column_of_a_later_version_does_no_harm(run_file):
    with h5py.File(run_file, "r+") as file:
        file["entry/steps/checksum"] = np.zeros(STEPS, dtype="u4")
        file["entry/notes/of/others"] = "hello"
    Run.open(run_file).close()


@pytest.mark.parametrize(
    "lost", ["entry/earlier_attempts", "entry/interruptions", "entry/provenance/reed"]
)
def test_what_is_written_together_is_there_together(run_file, lost):
    def delete(file):
        del file[lost]

    assert "is incomplete" in refused(run_file, delete)


def test_columns_do_not_share_bytes(run_file):
    """As if one bit of an address was another."""
    with h5py.File(run_file) as file:
        offsets = {name: file[f"entry/steps/{name}"].id.get_offset() for name in ("volts", "index")}
    data = run_file.read_bytes()
    old, new = (offsets[name].to_bytes(8, "little") for name in ("volts", "index"))
    assert data.count(old) == 1
    run_file.write_bytes(data.replace(old, new))
    assert "shares bytes" in refused(run_file, lambda file: None)


def test_hdf5_is_not_left_to_search_a_heap_of_zeros_for_ever(run_file):
    data = bytearray(run_file.read_bytes())
    heap = data.find(b"GCOL")
    size = int.from_bytes(data[heap + 8 : heap + 16], "little")
    # As a lost block of the disk leaves it; the first text is still there.
    first = heap + 16 + 16 + 16
    data[first : heap + size] = bytes(heap + size - first)
    run_file.write_bytes(data)
    with pytest.raises(RunFileError, match=r"heap of texts at byte .* has no end"):
        Run.open(run_file)


# --- Values ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("entry/region/row", -1),
        ("entry/region/column", 2**40),
        ("entry/instrument/camera/pixel_size", np.nan),
        ("entry/instrument/camera/pixel_size", 0.0),
        ("entry/instrument/camera/count_time", -1.0),
        ("entry/instrument/camera/rows", 3),
        ("entry/instrument/camera/saturation_value", -5),
        ("entry/instrument/laser/distance", np.inf),
        ("entry/instrument/synthesizers/sideband_order", -1),
        ("entry/sample/strength", np.inf),
        ("entry/steps/volts", np.nan),
        ("entry/steps/order", 2**40),
        ("entry/steps/drive_hz", 1.0),
        ("entry/earlier_attempts/position", STEPS),
        ("entry/earlier_attempts/position", -2 - STEPS),
        ("entry/interruptions/position", 2**62),
        ("entry/data/y_m", np.nan),
        ("entry/instrument/acoustic_resonances", -1.0),
        ("entry/steps/asked_hz_exact", ""),
        ("entry/steps/drive_hz_exact", "12"),
        ("entry/steps/verdict", "great"),
        ("entry/steps/sentence", b"\xff\xfe"),
        ("entry/status", "done"),
    ],
)
def test_a_value_that_no_run_has_is_refused(run_file, name, value):
    def write(file):
        dataset = file[name]
        dataset[() if dataset.shape == () else 0] = value

    # What a step's checksum covers is refused by that, before it is read.
    assert re.search("(is|are) damaged", refused(run_file, write))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("entry/sample/note", "x" * 1_000_000),
        ("entry/sample/chamber", "round"),
        ("entry/start_time", "yesterday"),
        ("entry/acquisition/kind", "dusk"),
        ("entry/instrument/camera/frame_rate_exact", "-12.4"),
        ("entry/instrument/camera/frame_rate_exact", "1/0"),
        ("entry/provenance/package_versions", "[]"),
        ("entry/provenance/package_versions", '{"a": 1}'),
        ("entry/provenance/package_versions", "[" * 10_000),
    ],
)
def test_a_text_that_no_run_has_is_refused(run_file, name, text):
    assert "is damaged" in refused(run_file, lambda file: put(file, name, data=text))


@pytest.mark.parametrize(
    "note", ["première ligne\n\tand 日本語\u200d\r\n", "\x1b[31mred", "bell \x07", "\x9b2J"]
)
def test_what_a_person_wrote_is_read(run_file, resealed, note):
    with resealed(run_file) as file:
        put(file, "entry/sample/note", data=note)
    with Run.open(run_file) as run:
        assert run.labels.note == note


@pytest.mark.parametrize("version", ["\x1b[2J", 99, [1, 2], h5py.Empty("f"), b"x", "3", -1])
def test_another_version_is_named_in_one_line(run_file, version):
    def write(file):
        file.attrs["format_version"] = version

    assert "has format version" in refused(run_file, write)


@pytest.mark.parametrize("signal", ["\x1b[2J", 3, ["field"], "drive_hz", None])
def test_pictures_of_no_kind_are_refused(run_file, signal):
    def write(file):
        if signal is None:
            del file["entry/data"].attrs["signal"]
        else:
            file["entry/data"].attrs["signal"] = signal

    assert "(entry/data has no valid attribute" in refused(run_file, write)


def test_a_step_that_was_being_written_when_the_program_was_killed_is_no_damage(run_file):
    with h5py.File(run_file, "r+") as file:
        file["entry/steps/read_drive_hz"][1] = 2033.1
        file["entry/steps/read_aom1_hz_exact"][2] = "80000"
    with Run.open(run_file) as run:
        assert [step.verdict.measured for step in run] == [False] * STEPS


def test_the_file_is_closed_when_it_is_refused(run_file):
    refused(run_file, lambda file: file["entry/region/row"].write_direct(np.array(-1)))
    with h5py.File(run_file, "r+"):
        assert Path(run_file).exists()
