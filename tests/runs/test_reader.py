"""Run files: what is written is read, by us and by plain h5py, whatever killed the writer."""

import contextlib
import io
import random
import re
import shutil
import time
from dataclasses import replace
from fractions import Fraction
from itertools import groupby

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.roles import Frame
from holography.fresnel import FresnelTransform
from holography.reconstruction import Reconstruction
from physics.optics import reed_axes_m
from physics.parameters.optics import Layout
from protocols.reed import ReedFile
from runs.disk import DiskFile
from runs.errors import DiskError, RunFileError
from runs.layout import (
    INTERRUPTIONS_MAX,
    TO_BE_MEASURED_AGAIN,
    Interruption,
    exact_text,
)
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


def measured(plan, position, verdict=Verdict.OK, attempt=1):
    """A step whose every number follows from its position, its pictures also from the attempt."""
    rng = np.random.default_rng([position, attempt])
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
        brightness_dn=1000.0 + position,
        lock_error_hz=-1e-3 * position,
        lock_error_se_hz=1e-4 * position,
        unexplained=1e-3 * position,
        judgement=Judgement(verdict, f"step {position} – said"),
    )


def test_what_is_written_is_read(plan, create):
    writer = create()
    writer.write(0, measured(plan, 0))
    writer.write(2, measured(plan, 2, Verdict.LOCK))
    writer.mark(3, Verdict.INTERRUPTED, "the generator fell off the table")
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
            assert record.lock_error_hz == -1e-3 * position
            assert record.lock_error_se_hz == 1e-4 * position
            assert record.sentence == f"step {position} – said"
        pending = run.steps[1]
        assert pending.read_drive_hz is None
        assert np.isnan(pending.signal_to_noise)
        assert pending.drive_hz == plan.steps[1].drive_hz


def test_a_run_says_which_kind_of_reed_was_measured(tiny_plan, create, resealed):
    writer = create(plan=tiny_plan(steps=4, reed="bass-clarinet"))
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.reed_file() == ReedFile.from_file("bass-clarinet")
        assert run.reed_text == ReedFile.from_file("bass-clarinet").text
    with resealed(writer.path) as file:
        text = file["entry/provenance/reed"].asstr()[()].replace("butt: 7.1 mm", "butt: 7.1")
        del file["entry/provenance/reed"]
        file["entry/provenance/reed"] = text
    with Run.open(writer.path) as run, pytest.raises(RunFileError) as refused:
        run.reed_file()
    assert "half_width_at_butt: 7.1 has no unit" in str(refused.value)
    assert "does not understand that reed" in str(refused.value)
    # A file that says nothing was written when there was one kind only.
    with resealed(writer.path) as file:
        del file["entry/provenance/reed"]
        del file["entry/provenance/reed_sha256"]
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
        assert run.acoustic_resonances_hz == (4308.6,)
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
    writer.mark(0, Verdict.INTERRUPTED, "é" * 300)
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
        assert field.id.get_storage_size() == field.nbytes, "places for the steps to come"
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
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("runs.contents._write_data", full)
    with pytest.raises(DiskError, match="No space left on device") as refused:
        create()
    assert refused.value.exit_status == 1
    assert list(tmp_path.iterdir()) == []


def test_a_step_that_holds_no_data_is_not_read(plan, create):
    writer = create()
    writer.write(0, measured(plan, 0))
    writer.mark(1, Verdict.INTERRUPTED, "given up")
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
        "text": "HDF5 file .*; name a run file",
        "empty": "HDF5 file .*; name a run file",
        "other": "not a run file",
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


def _damaged(content, rng):
    """The same bytes but for some."""
    damaged = bytearray(content)
    for _ in range(rng.choice([20, 200, 2000])):
        damaged[rng.randrange(len(damaged))] = rng.randrange(256)
    return bytes(damaged)


def test_what_a_disk_has_damaged_is_read_or_refused_in_one_line(plan, create, tmp_path):
    writer = create()
    for position in range(4):
        writer.write(position, measured(plan, position))
    writer.finish("complete")
    content, said = writer.path.read_bytes(), []
    for seed in range(100):
        path = tmp_path / f"{seed}.h5"
        path.write_bytes(_damaged(content, random.Random(seed)))
        try:
            with Run.open(path) as run:
                run.reed_file()
                for step in run.steps:
                    run.field(step.position)
        except RunFileError as error:
            said.append(str(error))
    assert all("\n" not in line and len(line) < 400 for line in said)
    for words in ("is damaged", "is incomplete", "as an HDF5 file"):
        assert any(words in line for line in said), words


# --- Takes -------------------------------------------------------------------------------------


@pytest.fixture
def retaking(tiny_plan):
    """Plan some steps that may be taken twice."""

    def make(steps=4, **changes):
        return tiny_plan(steps, **{"policy.bad_step.retries": 1, **changes})

    return make


@pytest.mark.parametrize("keep", ["holograms", "frames"])
def test_of_a_step_that_was_taken_again_both_takes_are_kept(retaking, create, keep):
    plan = retaking(keep=keep)
    first = replace(measured(plan, 1, Verdict.DROPPED, attempt=1), changed_s=11.0)
    second = replace(measured(plan, 1, Verdict.OK, attempt=2), changed_s=22.0)
    writer = create(plan=plan)
    writer.write(0, measured(plan, 0))
    writer.write(1, first)
    assert writer.spare == plan.spare_attempts == 8
    writer.set_aside(1)
    assert writer.spare == 7
    with Run.open(writer.path) as run:
        # Nothing of the first attempt is where the second one is to come.
        assert run.steps[1].verdict is Verdict.PENDING
        assert [attempt.verdict for attempt in run.earlier_attempts] == [Verdict.DROPPED]
    writer.write(1, second)
    writer.finish("complete")
    with Run.open(writer.path) as run:
        (earlier,), latest = run.earlier_attempts, run.steps[1]
        assert (earlier.position, latest.position) == (1, 1)
        assert (earlier.verdict, latest.verdict) == (Verdict.DROPPED, Verdict.OK)
        assert (earlier.changed_s, latest.changed_s) == (11.0, 22.0)
        np.testing.assert_array_equal(run.earlier_field(0), first.field)
        np.testing.assert_array_equal(run.field(1), second.field)
        np.testing.assert_array_equal(run.field(0), measured(plan, 0).field)
        # All but what was said of it is the same.
        same = {"verdict": Verdict.OK, "changed_s": 22.0}
        assert replace(earlier, **same) == latest
        with pytest.raises(IndexError):
            run.earlier_field(1)
    with pytest.raises(RunFileError, match="is closed; open it again"):
        run.earlier_field(0)


def test_takes_before_the_last_are_in_the_order_in_which_they_were_taken_again(retaking, create):
    plan = retaking(**{"policy.bad_step.retries": 2})
    writer = create(plan=plan)
    for position in (2, 0):
        writer.write(position, measured(plan, position, Verdict.LOCK))
    for position, verdict in ((2, Verdict.STALE), (0, Verdict.OK), (2, Verdict.OK)):
        writer.set_aside(position)
        writer.write(position, measured(plan, position, verdict))
    writer.finish("complete")
    with Run.open(writer.path) as run:
        earlier_attempts = [(attempt.position, attempt.verdict) for attempt in run.earlier_attempts]
        assert earlier_attempts == [(2, Verdict.LOCK), (0, Verdict.LOCK), (2, Verdict.STALE)]


def test_without_a_spare_place_nothing_is_set_aside(retaking, create):
    plan = retaking(**{"policy.bad_step.retries": 5})
    writer = create(plan=plan)
    for _ in range(plan.spare_attempts):
        writer.write(0, measured(plan, 0, Verdict.DROPPED))
        writer.set_aside(0)
    writer.write(0, measured(plan, 0, Verdict.DROPPED, attempt=7))
    assert writer.spare == 0
    with pytest.raises(RunFileError, match="no space to measure step 1 again"):
        writer.set_aside(0)
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.steps[0].verdict is Verdict.DROPPED
        expected = measured(plan, 0, attempt=7).field
        np.testing.assert_array_equal(run.field(0), expected)


@pytest.mark.parametrize("keep", ["holograms", "frames"])
def test_a_shorter_take_has_nothing_of_the_longer_one_before(retaking, create, keep):
    plan = retaking(keep=keep)
    writer = create(plan=plan)
    writer.write(1, measured(plan, 1, Verdict.STALE))
    writer.set_aside(1)
    short = measured(plan, 1, Verdict.DROPPED, attempt=2)
    short = replace(short, frames=short.frames[:2], field=0 * short.field)
    writer.write(1, short)
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.steps[1].frame_ids == (10, 11, -1, -1)
        np.testing.assert_equal(run.steps[1].timestamps_s, (1.0, 1.1, np.nan, np.nan))
        assert run.earlier_attempts[0].frame_ids == (10, 11, 12, 13)
        if keep == "frames":
            np.testing.assert_array_equal(run.frames(1)[1], short.frames[1].image)
            assert not run.frames(1)[2:].any()


def test_more_frames_than_planned_are_not_kept(retaking, create):
    plan = retaking()
    writer, step = create(plan=plan), measured(plan, 0, Verdict.DROPPED)
    writer.write(0, replace(step, frames=[*step.frames, step.frames[0]]))
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.steps[0].frame_ids == (0, 1, 2, 3)


def test_a_step_that_was_done_without_says_why(create):
    writer = create()
    writer.mark(2, Verdict.SKIPPED, "the generator fell off the table")
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.steps[2].verdict is Verdict.SKIPPED
        assert run.steps[2].sentence == "the generator fell off the table"
        with pytest.raises(RunFileError, match="step 16 is skipped and holds no data"):
            run.field(2)


# --- Interruptions, and going on
# -----------------------------------------------------------------------


def test_interruptions_are_kept_in_order(create):
    one = Interruption(
        2, "paused", "2026-01-01T10:00:00+00:00", "2026-01-01T10:05:00+00:00", "tea – or so"
    )
    two = Interruption(
        3, "recovered", "2026-01-01T11:00:00+00:00", "2026-01-01T11:00:01+00:00", "é" * 300
    )
    writer = create()
    writer.add_interruption(one)
    writer.add_interruption(two)
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.interruptions == (one, replace(two, reason="é" * 120))


def test_interruptions_beyond_the_last_place_are_lost_and_nothing_else(plan, create):
    writer = create()
    for number in range(INTERRUPTIONS_MAX + 3):
        writer.add_interruption(Interruption(number, "paused", "", "", ""))
    writer.write(0, measured(plan, 0))
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert [interruption.position for interruption in run.interruptions] == list(
            range(INTERRUPTIONS_MAX)
        )
        assert run.good[0]


def test_a_file_is_gone_on_with_where_it_stopped(retaking, create):
    plan = retaking()
    writer = create(plan=plan)
    writer.write(0, measured(plan, 0))
    writer.write(1, measured(plan, 1, Verdict.LOCK))
    writer.finish("interrupted")
    interruption = Interruption(
        2, "resumed", "2026-01-01T10:00:00+00:00", "2026-01-02T10:00:00+00:00", "was ended"
    )
    writer = RunWriter.resume(writer.path, plan)
    with Run.open(writer.path) as run:
        assert run.status == "interrupted", "until it really goes on"
    writer.reopen(interruption)
    with Run.open(writer.path) as run:
        assert (run.status, run.end_time, run.interruptions) == ("running", "", (interruption,))
    writer.set_aside(1)
    for position in (1, 2, 3):
        writer.write(position, measured(plan, position))
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.status == "complete"
        assert run.good.all()
        assert [attempt.verdict for attempt in run.earlier_attempts] == [Verdict.LOCK]
        for position in range(4):
            np.testing.assert_array_equal(run.field(position), measured(plan, position).field)


def test_a_file_that_is_being_read_is_gone_on_with(plan, create):
    writer = create()
    writer.write(0, measured(plan, 0))
    writer.finish("interrupted")
    with Run.open(writer.path) as run:
        writer = RunWriter.resume(writer.path, plan)
        writer.write(1, measured(plan, 1))
        assert [step.verdict for step in run][:2] == [Verdict.OK, Verdict.PENDING]
        np.testing.assert_array_equal(run.field(0), measured(plan, 0).field)
        with Run.open(writer.path) as again:
            assert again.good.tolist() == [True, True, False, False]
    writer.finish("complete")


# --- Other files -------------------------------------------------------------------------------


def test_a_file_of_today_says_its_version(create):
    writer = create()
    writer.finish("complete")
    with Run.open(writer.path) as run:
        assert run.format_version == 5


@pytest.mark.parametrize("lost", ["version", "checksums"])
def test_a_file_without_checksums_is_of_an_older_format(create, lost):
    writer = create()
    writer.finish("complete")
    with h5py.File(writer.path, "r+") as file:
        if lost == "version":
            file.attrs["format_version"] = 4
        else:
            del file["entry/steps/row_checksum"], file["entry/steps/pixel_checksum"]
    missing = r"(format version|pixel_checksum is missing).*measure again"
    with pytest.raises(RunFileError, match=missing) as refused:
        Run.open(writer.path)
    assert refused.value.exit_status == 2
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("lost", ["signal_to_noise", "row_checksum", "order"])
def test_no_column_may_be_missing(create, lost):
    writer = create()
    writer.finish("complete")
    with h5py.File(writer.path, "r+") as file:
        del file["entry/steps"][lost]
    with pytest.raises(RunFileError, match="is incomplete"):
        Run.open(writer.path)


# --- Killed at any moment ----------------------------------------------------------------------


class Logged(DiskFile):
    """A file that remembers what was written where, as if the program were killed after each."""

    def __init__(self, path):
        super().__init__(path, 0)
        self.changes = []

    def write(self, data):
        self.changes.append((self.tell(), bytes(data)))
        return super().write(data)

    def truncate(self, size=None):
        self.changes.append((self.tell() if size is None else size, None))
        return super().truncate(size)

    def states(self, content):
        """What the file holds after each change, from what it held before all."""
        content = bytearray(content)
        for place, data in self.changes:
            if data is None:
                del content[place:]
                content.extend(bytes(place - len(content)))
            else:
                content.extend(bytes(max(place - len(content), 0)))
                content[place : place + len(data)] = data
            yield bytes(content)


ATTEMPTS = [(0, Verdict.DROPPED), (1, Verdict.OK), (2, Verdict.STALE)]


@pytest.fixture
def states(retaking, create):
    """Plan and attempts of a run with two bad steps, and its file wherever it is killed."""
    plan, attempts = retaking(steps=len(ATTEMPTS)), {}
    for position, verdict in ATTEMPTS:
        for number, said in ((1, verdict), (2, Verdict.OK)):
            step = measured(plan, position, said, number)
            # The time tells which attempt it is.
            attempts[position, number] = replace(step, changed_s=10.0 * position + number)
    writer = create(plan=plan)
    writer.close()
    before, log = writer.path.read_bytes(), Logged(writer.path)
    writer = RunWriter(writer.path, log, plan.protocol.keep)
    for position, _ in ATTEMPTS:
        writer.write(position, attempts[position, 1])
    for position, verdict in ATTEMPTS:
        if verdict is not Verdict.OK:
            writer.set_aside(position)
            writer.write(position, attempts[position, 2])
    writer.finish("complete")
    log.close()
    assert len(log.changes) > 100
    return plan, attempts, list(log.states(before))


@pytest.mark.slow
def test_whatever_is_written_last_every_take_in_the_file_is_whole(states):
    _, attempts, contents = states
    firsts, seen = dict(ATTEMPTS), set()
    for content in contents:
        with h5py.File(io.BytesIO(content), "r") as file:
            run = Run("killed.h5", file)
            for step in run.steps:
                if step.verdict.measured:
                    number = round(step.changed_s - 10 * step.position)
                    whole = attempts[step.position, number]
                    np.testing.assert_array_equal(run.field(step.position), whole.field)
                    assert step.verdict is whole.judgement.verdict
                    assert step.sentence == whole.judgement.sentence
                    assert step.noise_level == whole.noise_level
                    assert step.frame_ids == tuple(frame.id for frame in whole.frames)
            for number, attempt in enumerate(run.earlier_attempts):
                whole = attempts[attempt.position, 1]
                np.testing.assert_array_equal(run.earlier_field(number), whole.field)
                assert attempt.verdict is whole.judgement.verdict
                assert attempt.changed_s == whole.changed_s
                assert attempt.sentence == whole.judgement.sentence
            seen.add(tuple(step.verdict for step in run.steps))
    # Each bad step was seen bad, to be measured again, and good.
    for position in (0, 2):
        assert {verdicts[position] for verdicts in seen} == {
            firsts[position], Verdict.PENDING, Verdict.OK
        }  # fmt: skip


def test_whatever_is_written_last_no_take_is_lost_or_seen_twice(states):
    """As a reader sees a running run: attempts come one by one, steps without a verdict empty."""
    _, _, contents = states
    seen = dict.fromkeys(range(len(ATTEMPTS)), 0)
    for content in (*contents[::4], contents[-1]):
        with h5py.File(io.BytesIO(content), "r") as file:
            run = Run("in work.h5", file)
            for step in run.steps:
                earlier_attempts = [
                    attempt for attempt in run.earlier_attempts if attempt.position == step.position
                ]
                count = len(earlier_attempts) + step.verdict.measured
                assert count - seen[step.position] in (0, 1)
                seen[step.position] = count
                if not step.verdict.measured:
                    assert np.isnan([step.noise_level, step.changed_s, *step.timestamps_s]).all()
                    assert (step.read_drive_hz, set(step.frame_ids)) == (None, {-1})
                    assert step.sentence in ("", TO_BE_MEASURED_AGAIN)
    assert seen == {0: 2, 1: 1, 2: 2}


def _bad(verdict):
    return verdict.measured and verdict is not Verdict.OK


def said_of(content):
    with h5py.File(io.BytesIO(content), "r") as file:
        names = ("steps/verdict", "earlier_attempts/position")
        return [file["entry"][name][()].tolist() for name in names]


@pytest.mark.slow
def test_whatever_is_written_last_the_run_is_gone_on_with_and_no_take_is_lost(states, tmp_path):
    """A step that was being set aside is so once, and none is written twice."""
    plan, attempts, contents = states
    # The first and the last of those that say the same of all steps and attempts.
    groups = [list(group) for _, group in groupby(contents, key=said_of)]
    for number, content in enumerate(state for group in groups for state in (group[0], group[-1])):
        path = tmp_path / f"killed{number}.h5"
        path.write_bytes(content)
        with Run.open(path) as run:
            bad = {step.position for step in run.steps if _bad(step.verdict)}
            bad |= {attempt.position for attempt in run.earlier_attempts}
        writer = RunWriter.resume(path, plan)
        with Run.open(path) as run:
            todo = [step.position for step in run.steps if not step.verdict.measured]
            again = [step.position for step in run.steps if _bad(step.verdict)]
        for position in again:
            writer.set_aside(position)
        for position in (*todo, *again):
            writer.write(position, attempts[position, 2])
        writer.finish("complete")
        with Run.open(path) as run:
            assert run.good.all()
            assert bad <= {attempt.position for attempt in run.earlier_attempts}
            assert len({attempt.position for attempt in run.earlier_attempts}) == len(
                run.earlier_attempts
            )
            for place, attempt in enumerate(run.earlier_attempts):
                assert attempt.changed_s == attempts[attempt.position, 1].changed_s
                whole = attempts[attempt.position, 1].field
                np.testing.assert_array_equal(run.earlier_field(place), whole)


# Forks writers, kills each after a random time, and says so at the end of the pipe.
NURSERY = """
import os, random, signal, time
import numpy as np
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from acquire.runner.quality import Judgement, ReadBack, Verdict
from acquire.runner.recorder import reconstruction_of
from runs.reader import MeasuredStep, RunLabels, RunWriter
from drivers.context import WallClock
from drivers.registry import Bench
from drivers.roles import Frame, Preparation

class Fake:
    identity, saturation_dn = "fake", 4095

protocol = Protocol.from_file("quick").replace({"sweep.stride": 4})
plan = make_plan(protocol, BenchFile.from_file())
bench = Bench("b", "f", Preparation("R", "A", "asymmetric"), 0, Fake(), Fake(), Fake(), WallClock())

def write(path):
    writer = RunWriter.create(path, plan, bench, RunLabels(), reconstruction_of(plan), "u")
    os.write(said_go, b"go")
    region = plan.region
    for position, step in enumerate(plan.steps):
        field = np.full((region.height, region.width), position + 1j * position, np.complex64)
        image = np.full(plan.frame_shape, position, np.uint16)
        frames = [Frame(position, float(position), image) for _ in range(4)]
        read = ReadBack(step.aom1_hz, step.aom2_hz, step.drive_hz, float(position))
        # Every third step is taken twice.
        for verdict in (Verdict.LOCK, Verdict.OK) if position % 3 == 0 else (Verdict.OK,):
            if verdict is Verdict.OK and position % 3 == 0 and writer.spare:
                writer.set_aside(position)
            judgement = Judgement(verdict, f"step {position}")
            writer.write(position, MeasuredStep(read, 1.0 * position, frames, field,
                         *[1.0 * position] * 7, judgement))
    writer.finish("complete")

def begin(number):
    global said_go
    heard, said_go = os.pipe()
    child = os.fork()
    if child == 0:
        write(f"{folder}/killed{number}.h5")
        os._exit(0)
    os.read(heard, 2)
    return child

# The first is left alone, to see how long a whole run attempts.
random.seed(seed)
child = begin("none")
start_s = time.monotonic()
os.waitpid(child, 0)
whole_s = time.monotonic() - start_s
for number in range(kills):
    child = begin(number)
    time.sleep(random.uniform(0.0, whole_s))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
said.send(len(plan.steps))
"""


# Writes a run as fast as it can, every step twice, until it is asked to stop.
WRITER = """
import numpy as np
from acquire.runner.quality import Judgement, ReadBack, Verdict
from acquire.runner.recorder import reconstruction_of
from runs.reader import MeasuredStep, RunLabels, RunWriter
from drivers.context import WallClock
from drivers.registry import Bench
from drivers.roles import Frame, Preparation

class Fake:
    identity, saturation_dn = "fake", 4095

bench = Bench("b", "f", Preparation("R", "A", "asymmetric"), 0, Fake(), Fake(), Fake(), WallClock())
region = plan.region
shape = region.height, region.width
number = 0
while not stop.exists():
    number += 1
    path.unlink(missing_ok=True)
    writer = RunWriter.create(path, plan, bench, RunLabels(), reconstruction_of(plan), "u")
    said.send(number)
    for attempt, verdict in enumerate((Verdict.LOCK, Verdict.OK)):
        for position, step in enumerate(plan.steps):
            value = number + 0.25 * attempt + 1j * position
            image = np.full(plan.frame_shape, position, np.uint16)
            frames = [Frame(position, float(number), image) for _ in range(4)]
            read = ReadBack(step.aom1_hz, step.aom2_hz, step.drive_hz, float(attempt))
            judgement = Judgement(verdict, f"attempt {attempt}")
            if attempt and writer.spare:
                writer.set_aside(position)
            elif attempt:
                break
            writer.write(position, MeasuredStep(read, 1.0 * number, frames,
                         np.full(shape, value, np.complex64), *[1.0 * attempt] * 7, judgement))
    writer.finish("complete")
"""


def test_a_run_in_work_is_read_as_if_nothing_was_written(processes, retaking, tmp_path):
    """Whatever is seen as measured is one whole attempt; nothing is called damaged."""
    plan, path, stop = retaking(steps=12), tmp_path / "run.h5", tmp_path / "stop"
    child, heard = processes(WRITER, plan=plan, path=path, stop=stop)
    heard.recv()
    openings, seen, refusals = 0, set(), []
    begun_s, limit_s = time.monotonic(), 60.0
    while openings < 60 and time.monotonic() - begun_s < limit_s:
        if openings > 3 and len(seen) > 2:
            # Enough; only on a machine that is busy with other programs it attempts longer.
            limit_s = 3.0
        try:
            run = Run.open(path)
        except RunFileError as error:
            # One run was ended, and the next is not there yet.
            refusals.append(str(error))
            continue
        with run:
            openings += 1
            for step in run.steps:
                if not step.verdict.measured:
                    continue
                attempt = 1 if step.verdict is Verdict.OK else 0
                assert (step.noise_level, step.read_volts) == (attempt, attempt)
                assert step.sentence == f"attempt {attempt}"
                try:
                    field = run.field(step.position)
                except RunFileError as error:
                    refusals.append(str(error))
                    continue
                assert (field == field[0, 0]).all()
                assert field[0, 0] == step.changed_s + 0.25 * attempt + 1j * step.position
            for number, earlier in enumerate(run.earlier_attempts):
                assert (earlier.verdict, earlier.sentence) == (Verdict.LOCK, "attempt 0")
                assert run.earlier_field(number)[0, 0].imag == earlier.position
            seen.add((int(run.good.sum()), len(run.earlier_attempts)))
    stop.touch()
    with contextlib.suppress(EOFError):
        while True:
            heard.recv()
    child.join()
    assert child.exitcode == 0
    other = [line for line in refusals if not re.search("no such file|measured again", line)]
    assert not other
    assert openings > 3
    assert len(seen) > 2, seen


@pytest.mark.slow
def test_after_sigkill_every_finished_step_is_whole(processes, tmp_path):
    kills, seed = 20, random.randrange(10**6)
    _, heard = processes(NURSERY, folder=str(tmp_path), kills=kills, seed=seed)
    steps, finished_steps = heard.recv(), []
    for number in range(kills):
        with h5py.File(tmp_path / f"killed{number}.h5", "r") as file:
            columns = file["entry/steps"]
            verdicts = columns["verdict"].asstr()[()]
            finished = np.flatnonzero(verdicts != "pending")
            assert finished.tolist() == list(range(len(finished)))
            finished_steps.append(len(finished))
            sentences, exact = (columns[n].asstr()[()] for n in ("sentence", "read_drive_hz_exact"))
            for position in finished:
                field = file["entry/data/field"][position]
                assert (field == position + 1j * position).all(), f"seed {seed}"
                assert sentences[position] == f"step {position}"
                assert float(Fraction(exact[position])) == columns["drive_hz"][position]
            for name in ("read_volts", "changed_s", "signal_to_noise", "saturated_share"):
                np.testing.assert_array_equal(columns[name][finished], finished)
            assert (columns["frame_id"][finished] == finished[:, None]).all()
        with Run.open(tmp_path / f"killed{number}.h5") as run:
            assert run.good.sum() >= len(finished) - 1
            assert run.status in ("running", "complete")
            for place, attempt in enumerate(run.earlier_attempts):
                assert (attempt.verdict, attempt.read_volts) == (Verdict.LOCK, attempt.position)
                field = attempt.position * np.complex64(1 + 1j)
                assert (run.earlier_field(place) == field).all(), f"seed {seed}"
    # The kills fell into the run, not before or after it.
    assert len({count for count in finished_steps if 0 < count < steps}) > 5, finished_steps


def test_a_complete_run_may_be_opened_by_h5py_at_the_same_time(plan, create):
    writer = create()
    for position in range(len(plan.steps)):
        writer.write(position, measured(plan, position))
    writer.finish("complete")
    with Run.open(writer.path) as run, h5py.File(writer.path, "r") as file:
        assert file["entry/status"].asstr()[()] == run.status == "complete"
    with h5py.File(writer.path, "r", locking=False), Run.open(writer.path) as run:
        assert run.status == "complete"
