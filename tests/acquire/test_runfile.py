"""Run files: what is written is read, by us and by plain h5py, whatever killed the writer."""

import random
import shutil
import subprocess
import sys
from fractions import Fraction

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.errors import RunFileError
from acquire.quality import Judgement, ReadBack, Verdict
from acquire.reconstruction import Reconstruction
from acquire.reed_file import ReedFile
from acquire.run_layout import exact_text
from acquire.runfile import MeasuredStep, Run, RunLabels, RunWriter
from drivers.roles import Frame
from holography.fresnel import FresnelTransform
from physics.optics import Layout, reed_axes_m

UID = "00000000-0000-4000-8000-000000000001"
LABELS = RunLabels(strength=3.5, note="wet – 20 °C", operator="Ada")


@pytest.fixture
def plan(tiny_plan):
    return tiny_plan(steps=4)


@pytest.fixture
def create(plan, fake_bench, tmp_path):
    """Create a run file of a plan."""

    def make(name="run.h5", plan=plan, labels=LABELS):
        bench = fake_bench().opened()
        return RunWriter.create(tmp_path / name, plan, bench, labels, geometry(plan), UID)

    return make


def geometry(plan):
    optics = plan.bench.optics
    transform = FresnelTransform(
        plan.frame_shape, 6.7e-6, float(optics.wavelength_m), float(optics.distance_m)
    )
    return Reconstruction(transform, plan.region)


def measured(plan, position, verdict=Verdict.OK):
    """A step whose every number follows from its position."""
    rng = np.random.default_rng(position)
    step = plan.steps[position]
    images = rng.integers(0, 4096, (4, *plan.frame_shape), dtype=np.uint16)
    return MeasuredStep(
        read_back=ReadBack(step.aom1_hz, step.aom2_hz, step.drive_hz, step.volts),
        changed_s=float(position),
        frames=[Frame(10 * position + k, position + 0.1 * k, im) for k, im in enumerate(images)],
        field=geometry(plan).field(images),
        signal_to_noise=10.0 + position,
        noise_level=2.0 + position,
        saturated_share=0.01 * position,
        judgement=Judgement(verdict, f"step {position} – said"),
    )


def test_what_is_written_is_read(plan, create):
    writer = create()
    writer.write(0, measured(plan, 0))
    writer.write(2, measured(plan, 2, Verdict.LOCK))
    writer.mark_interrupted(3, "the generator fell off the table")
    writer.finish("interrupted")
    with Run.open(writer.path) as run:
        assert run.status == "interrupted"
        assert run.good.tolist() == [True, False, False, False]
        verdicts = [step.verdict for step in run]
        assert verdicts == [Verdict.OK, Verdict.PENDING, Verdict.LOCK, Verdict.INTERRUPTED]
        assert run.steps[3].sentence == "the generator fell off the table"
        for position in (0, 2):
            expected, record = measured(plan, position), run.steps[position]
            np.testing.assert_array_equal(run.field(position), expected.field)
            assert run.field(position).dtype == np.complex64
            step = plan.steps[position]
            for name in ("index", "asked_hz", "drive_hz", "aom1_hz", "aom2_hz", "difference_hz"):
                assert getattr(record, name) == getattr(step, name)
            assert record.lock_residual_hz == 0
            assert (record.volts, record.carrier_leak) == (step.volts, step.carrier_leak)
            assert record.read_aom1_hz == step.aom1_hz
            assert record.read_aom2_hz == step.aom2_hz
            assert record.read_drive_hz == step.drive_hz
            assert record.read_volts == step.volts
            assert record.changed_s == position
            assert record.frame_ids == tuple(10 * position + k for k in range(4))
            assert record.timestamps_s == tuple(position + 0.1 * k for k in range(4))
            assert record.signal_to_noise == 10.0 + position
            assert record.noise_level == 2.0 + position
            assert record.saturated_share == 0.01 * position
            assert record.sentence == f"step {position} – said"
        pending = run.steps[1]
        assert pending.read_drive_hz is None
        assert np.isnan(pending.signal_to_noise)
        assert pending.drive_hz == plan.steps[1].drive_hz


def test_a_run_says_which_kind_of_reed_was_measured(tiny_plan, create):
    writer = create(plan=tiny_plan(steps=4, reed="bass-clarinet"))
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.reed_file() == ReedFile.from_file("bass-clarinet")
        assert run.reed_text == ReedFile.from_file("bass-clarinet").text
    with h5py.File(writer.path, "r+") as file:
        text = file["entry/provenance/reed"].asstr()[()].replace("butt: 7.1 mm", "butt: 7.1")
        del file["entry/provenance/reed"]
        file["entry/provenance/reed"] = text
    with Run.open(writer.path) as run, pytest.raises(RunFileError) as refused:
        run.reed_file()
    assert "half_width_at_butt: 7.1 has no unit" in str(refused.value)
    assert "does not understand that reed" in str(refused.value)
    # A file that says nothing was written when there was one kind only.
    with h5py.File(writer.path, "r+") as file:
        del file["entry/provenance/reed"]
    with Run.open(writer.path) as run:
        assert run.reed_file() == ReedFile.from_file("clarinet")


def test_a_run_explains_itself(plan, create):
    writer = create()
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert (run.reed, run.series, run.chamber) == ("R07", "A", "asymmetric")
        assert run.labels == LABELS
        assert (run.uid, run.seed, run.title) == (UID, 1, plan.protocol.name)
        assert run.protocol_text == plan.protocol.text
        assert run.protocol_sha256 == plan.protocol.sha256
        assert run.bench_text == plan.bench.text
        assert (run.bench_name, run.bench_fingerprint) == ("fake bench", "0" * 64)
        assert run.identities == dict.fromkeys(("synthesizers", "generator", "camera"), "fake")
        assert run.package_versions["numpy"] == np.__version__
        assert run.acoustic_lines_hz == (4308.6,)
        assert (run.frame_rate_hz, run.sideband_order) == (Fraction(62, 5), 1)
        assert run.exposure_s == pytest.approx(1 / 12.4)
        assert run.saturation_dn == 4095
        assert run.region == plan.region
        assert run.frame_shape == plan.frame_shape
        assert run.start_time <= run.end_time
        assert run.start_time.endswith("+00:00")
        y_m, x_m = reed_axes_m(Layout(), plan.region, geometry(plan).transform)
        np.testing.assert_array_equal(run.y_m, y_m)
        np.testing.assert_array_equal(run.x_m, x_m)


def test_a_run_without_labels_has_none(create):
    writer = create(labels=RunLabels())
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.labels == RunLabels()


def test_frames_and_holograms_give_the_same_field(tiny_plan, create):
    fields = {}
    for keep in ("holograms", "frames"):
        plan = tiny_plan(keep=keep)
        writer = create(f"{keep}.h5", plan)
        for position in range(3):
            writer.write(position, measured(plan, position))
        writer.finish("complete")
        with Run.open(writer.path) as run:
            assert run.keep == keep
            fields[keep] = [run.field(position) for position in range(3)]
            if keep == "frames":
                images = np.stack([frame.image for frame in measured(plan, 1).frames])
                np.testing.assert_array_equal(run.frames(1), images)
            else:
                with pytest.raises(RunFileError, match="kept holograms, so it has no frames"):
                    run.frames(1)
    np.testing.assert_array_equal(fields["frames"], fields["holograms"])


def test_the_layout_is_nexus(plan, create):
    writer = create()
    writer.write(0, measured(plan, 0))
    writer.finish("complete")
    with h5py.File(writer.path) as file:
        kinds = {
            "entry": "NXentry",
            "entry/instrument": "NXinstrument",
            "entry/instrument/camera": "NXdetector",
            "entry/sample": "NXsample",
            "entry/data": "NXdata",
        }
        assert {path: file[path].attrs["NX_class"] for path in kinds} == kinds
        assert file[file.attrs["default"]].attrs["default"] == "data"
        data = file["entry/data"]
        signal_set = data[data.attrs["signal"]]
        axes = [data[name] for name in data.attrs["axes"]]
        assert tuple(len(axis) for axis in axes) == signal_set.shape
        assert [axis.attrs["units"] for axis in axes] == ["Hz", "m", "m"]
        assert signal_set.chunks == (1, *signal_set.shape[1:]), "one chunk per step"
        texts = file["entry/steps/aom1_hz_exact"].asstr()[()]
        np.testing.assert_allclose(
            [float(Fraction(text)) for text in texts], file["entry/steps/aom1_hz"][()], rtol=0
        )
        assert file["entry/steps/aom1_hz"].attrs["units"] == "Hz"


@given(st.fractions(max_denominator=2**40))
def test_exact_text_reads_back_exactly(value):
    if abs(value) < 10**12:
        assert Fraction(exact_text(value)) == value


def test_a_binary_synthesizer_is_kept_exactly():
    tuning_word_hz = Fraction(10**9, 2**32) * 343_597_383
    assert Fraction(exact_text(tuning_word_hz)) == tuning_word_hz
    with pytest.raises(ValueError, match="no synthesizer has such a step"):
        exact_text(Fraction(1, 3**200))


def test_a_long_reason_is_cut_at_a_character(plan, create):
    writer = create()
    writer.mark_interrupted(0, "é" * 300)
    writer.finish("failed")
    with Run.open(writer.path) as run:
        assert run.steps[0].sentence == "é" * 120


def test_a_step_that_was_written_is_with_the_operating_system(plan, create, tmp_path):
    """A copy of the bytes is what another program would find if this one were killed now."""
    writer = create()
    writer.write(0, measured(plan, 0))
    shutil.copy(writer.path, tmp_path / "copy.h5")
    with h5py.File(tmp_path / "copy.h5") as file:
        assert file["entry/steps/verdict"].asstr()[()].tolist() == ["ok"] + ["pending"] * 3
        field = file["entry/data/field"]
        np.testing.assert_array_equal(field[0], measured(plan, 0).field)
        assert field.id.get_storage_size() == field.nbytes, "room for the steps to come"
    writer.finish("complete")


# --- Refusals ----------------------------------------------------------------------------------


def test_a_file_is_never_overwritten(create):
    writer = create()
    writer.finish("complete")
    content = writer.path.read_bytes()
    with pytest.raises(RunFileError, match="exists already and is never overwritten"):
        create()
    assert writer.path.read_bytes() == content


def test_a_missing_folder_is_named(create):
    with pytest.raises(RunFileError, match="cannot be made"):
        create("no/such/folder.h5")


def test_a_file_that_cannot_be_made_is_not_left_behind(create, plan, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acquire.run_writer._write_data", full)
    with pytest.raises(RunFileError, match="No space left on device"):
        create()
    assert list(tmp_path.iterdir()) == []


def test_a_step_that_holds_no_data_is_not_read(plan, create):
    writer = create()
    writer.write(0, measured(plan, 0))
    writer.mark_interrupted(1, "given up")
    writer.finish("interrupted")
    with Run.open(writer.path) as run:
        with pytest.raises(RunFileError, match="step 14 is interrupted and holds no data"):
            run.field(1)
        with pytest.raises(RunFileError, match="step 16 is pending and holds no data"):
            run.field(2)
    with pytest.raises(RunFileError, match="is closed; open it again"):
        run.field(0)


@pytest.mark.parametrize("kind", ["missing", "folder", "text", "empty", "other", "newer"])
def test_what_is_no_run_file_is_refused_in_one_line(kind, create, tmp_path):
    path = tmp_path / "some.h5"
    if kind == "folder":
        path.mkdir()
    elif kind in ("text", "empty"):
        path.write_text("name: my sweep\n" if kind == "text" else "")
    elif kind == "other":
        with h5py.File(path, "w") as file:
            file["data"] = [1, 2, 3]
    elif kind == "newer":
        create("some.h5").finish("complete")
        with h5py.File(path, "r+") as file:
            file.attrs["format_version"] = 99
    said = {
        "missing": "no such file",
        "folder": "is a folder",
        "text": "no HDF5 file",
        "empty": "no HDF5 file",
        "other": "no run file",
        "newer": "format version 99",
    }
    with pytest.raises(RunFileError, match=said[kind]) as caught:
        Run.open(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


@pytest.mark.parametrize(
    "lost", ["entry/steps/verdict", "entry/data/y_m", "entry/provenance", "entry/sample/name"]
)
def test_a_file_that_lacks_a_part_is_incomplete(create, lost):
    writer = create()
    writer.finish("complete")
    with h5py.File(writer.path, "r+") as file:
        del file[lost]
    with pytest.raises(RunFileError, match="is incomplete") as caught:
        Run.open(writer.path)
    assert "\n" not in str(caught.value)


# --- Killed at any moment ----------------------------------------------------------------------

# Forks writers, kills each after a random time, and says so on standard output.
NURSERY = """
import os, random, signal, sys, time
import numpy as np
from acquire.bench_file import BenchFile
from acquire.plan import make_plan
from acquire.protocol import Protocol
from acquire.quality import Judgement, ReadBack, Verdict
from acquire.reconstruction import Reconstruction
from acquire.runfile import MeasuredStep, RunLabels, RunWriter
from drivers.registry import Bench
from drivers.roles import Frame, Preparation
from holography.fresnel import FresnelTransform

class Fake:
    identity, saturation_dn = "fake", 4095

folder, kills, seed = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
protocol = Protocol.from_file("quick")
plan = make_plan(protocol, BenchFile.from_file())
transform = FresnelTransform(plan.frame_shape, 6.7e-6, 650e-9, 1.0)
geometry = Reconstruction(transform, plan.region)
bench = Bench("b", "f", Preparation("R", "A", "asymmetric"), 0, Fake(), Fake(), Fake(), Fake())

def write(path):
    writer = RunWriter.create(path, plan, bench, RunLabels(), geometry, "u")
    print("go", flush=True)
    region = plan.region
    for position, step in enumerate(plan.steps):
        field = np.full((region.height, region.width), position + 1j * position, np.complex64)
        frames = [Frame(position, float(position), field) for _ in range(4)]
        read = ReadBack(step.aom1_hz, step.aom2_hz, step.drive_hz, float(position))
        judgement = Judgement(Verdict.OK, f"step {position}")
        writer.write(position, MeasuredStep(read, 1.0 * position, frames, field, 1.0 * position,
                     1.0 * position, 1.0 * position, judgement))
    writer.finish("complete")

def begin(number):
    heard, said = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(said, 1)
        write(f"{folder}/killed{number}.h5")
        os._exit(0)
    os.read(heard, 2)
    return child

# The first is left alone, to see how long a whole run takes.
random.seed(seed)
child, start_s = begin("none"), time.monotonic()
os.waitpid(child, 0)
whole_s = time.monotonic() - start_s
for number in range(kills):
    child = begin(number)
    time.sleep(random.uniform(0.0, whole_s))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
"""


def test_after_sigkill_every_finished_step_is_whole(tmp_path):
    kills, seed = 20, random.randrange(10**6)
    subprocess.run(
        [sys.executable, "-c", NURSERY, str(tmp_path), str(kills), str(seed)],
        check=True,
        stdout=subprocess.DEVNULL,
        timeout=60,
    )
    finished_steps = []
    for number in range(kills):
        with h5py.File(tmp_path / f"killed{number}.h5", "r") as file:
            verdicts = file["entry/steps/verdict"].asstr()[()]
            finished = np.flatnonzero(verdicts != "pending")
            assert finished.tolist() == list(range(len(finished)))
            finished_steps.append(len(finished))
            for position in finished:
                field = file["entry/data/field"][position]
                assert (field == position + 1j * position).all(), f"seed {seed}"
                for name in ("read_volts", "changed_s", "signal_to_noise", "saturated_share"):
                    assert file[f"entry/steps/{name}"][position] == position
                assert (file["entry/steps/frame_id"][position] == position).all()
                exact = Fraction(file["entry/steps/read_drive_hz_exact"].asstr()[position])
                assert float(exact) == file["entry/steps/drive_hz"][position]
                assert file["entry/steps/sentence"].asstr()[position] == f"step {position}"
        with Run.open(tmp_path / f"killed{number}.h5") as run:
            assert run.good.sum() == len(finished)
            assert run.status in ("running", "complete")
    # The kills fell into the run, not before or after it.
    assert len({count for count in finished_steps if 0 < count < 87}) > 5, finished_steps
