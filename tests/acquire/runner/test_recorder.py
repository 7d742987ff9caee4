"""What becomes of frames: each fault has its verdict; bad steps are repeated, and both kept."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from acquire.runner.measuring import StepAcquisition, measure
from acquire.runner.recorder import reconstruction_of
from acquire.runner.runner import run
from acquire.runner.summary import RunState
from drivers.errors import InstrumentError
from drivers.roles import Frame
from protocols.plan import Plan
from runs.reader import Run
from runs.verdict import ReadBack, Verdict

RATE_HZ = 12.4
TWICE = {"policy.bad_step.retries": 1}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


def verdicts_of(path):
    with Run.open(path) as measured:
        return [str(step.verdict) for step in measured]


# --- Every fault of frames has its verdict -----------------------------------------------------


def renumbered(*ids):
    """Frames as if others of the same acquisition had come, with time stamps as they should be."""

    def spoil(frames):
        first = frames[0]
        return [
            Frame(first.id + k, first.timestamp_s + k / RATE_HZ, frames[n % 4].image)
            for n, k in enumerate(ids)
        ]

    return spoil


def reordered(*places):
    return lambda frames: [frames[place] for place in places]


def stamped(*jumps_s):
    def spoil(frames):
        return [
            Frame(f.id, f.timestamp_s + jump_s, f.image)
            for f, jump_s in zip(frames, jumps_s, strict=True)
        ]

    return spoil


def pictured(change):
    """Frames whose images were changed: `change` gets all four, (4, ny, nx), and gives others."""

    def spoil(frames):
        images = change(np.stack([frame.image for frame in frames]))
        return [
            Frame(f.id, f.timestamp_s, im.astype(np.uint16))
            for f, im in zip(frames, images, strict=True)
        ]

    return spoil


def ends_in_zeros(images):
    images[2, 20:] = 0
    return images


def ends_as_before(images):
    images[3, 20:] = images[2, 20:]
    return images


def dark(images):
    return np.random.default_rng(0).normal(50, 2, images.shape).round()


def one_dark(images):
    return np.where(np.arange(4)[:, None, None] == 2, dark(images), images)


def blinking(images):
    return images * np.array([1, 0.9, 1, 1])[:, None, None]


def advanced(frames):
    """The last two show what came one period later, and say nothing of it."""
    images = [frame.image for frame in frames]
    return [
        replace(frame, image=image)
        for frame, image in zip(frames, [*images[:2], images[3], images[0]], strict=True)
    ]


FAULTS = {
    "a frame is lost": (renumbered(0, 1, 3, 4), "dropped", "not consecutive"),
    "a frame never comes": (reordered(0, 1, 2), "dropped", "3 frames came instead of 4"),
    "a frame too many": (renumbered(0, 1, 2, 3, 4), "dropped", "5 frames came"),
    "no frame comes": (lambda frames: [], "dropped", "0 frames came"),
    "two are exchanged": (reordered(0, 2, 1, 3), "disordered", "came after frame"),
    "the last comes first": (reordered(3, 0, 1, 2), "disordered", "came after frame"),
    "one comes twice": (renumbered(0, 1, 1, 2), "disordered", "came after frame"),
    "one stamp is wrong": (stamped(0, 0.06, 0, 0), "disordered", "140.6 ms instead"),
    "a frame ends in zeros": (pictured(ends_in_zeros), "partial", "12 of 32 rows of frame"),
    "a frame ends as the one before": (pictured(ends_as_before), "partial", "equal to those of"),
    "a frame is that before": (pictured(lambda im: im[[0, 1, 1, 3]]), "partial", "32 of 32 rows"),
    "a buffer was not empty": (renumbered(-1, 0, 1, 2), "stale", "before the setting had settled"),
    "too much light": (pictured(lambda im: im + 60_000), "saturated", "100 % of the pixels"),
    "no light": (pictured(dark), "no_signal", "shows no motion"),
    "a dead camera": (pictured(lambda im: 0 * im), "no_signal", "shows no motion"),
    "light that turns the other way": (pictured(lambda im: im[::-1]), "lock", "exchanged"),
    "one frame is dark": (pictured(one_dark), "light", "of the light of the others"),
    "light that blinks": (pictured(blinking), "light", "of the light of the others"),
    "an exposure is missing": (advanced, "unsteady", "an exposure is missing"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_of_frames_has_its_verdict_and_is_mended(
    tiny_plan, fake_bench, lit, tmp_path, fault
):
    spoil, verdict, said = FAULTS[fault]
    for retry in (0, 1):
        plan, path = tiny_plan(**{"policy.bad_step.retries": retry}), tmp_path / f"{retry}.h5"
        fake = fake_bench(picture=lit(plan), spoilt={2: spoil})
        summary = run(plan, fake.opened(), path)
        assert summary.status is RunState.COMPLETE
        assert summary.repeated == retry
        with Run.open(path) as measured:
            (bad,) = measured.earlier_attempts if retry else measured.steps[1:2]
            assert (bad.position, str(bad.verdict)) == (1, verdict)
            assert said in bad.sentence
            good = [str(step.verdict) for step in measured]
            assert good == ["ok", "ok" if retry else verdict, "ok"]


@pytest.mark.parametrize(("jump_s", "after"), [(1.0, "ok"), (-0.5, "stale")])
@pytest.mark.parametrize(
    ("within", "stays", "verdicts"),
    [
        (True, True, ["ok", "disordered", "after", "after"]),
        (False, True, ["ok", "disordered", "after", "after"]),
        # Going back is another jump.
        (True, False, ["ok", "disordered", "disordered", "ok"]),
        (False, False, ["ok", "disordered", "disordered", "ok"]),
    ],
)
def test_a_clock_that_jumps_spoils_the_step_in_which_it_does(
    tiny_plan, fake_bench, lit, path, jump_s, after, within, stays, verdicts
):
    """Within a step or before it. Set back, all that follows seems to be from before."""
    plan = tiny_plan(steps=4)
    spoilt = {2: stamped(0 if within else jump_s, 0 if within else jump_s, jump_s, jump_s)}
    if stays:
        spoilt |= dict.fromkeys((3, 4), stamped(*[jump_s] * 4))
    run(plan, fake_bench(picture=lit(plan), spoilt=spoilt).opened(), path)
    assert verdicts_of(path) == [after if verdict == "after" else verdict for verdict in verdicts]
    with Run.open(path) as measured:
        assert "the camera's clock" in measured.steps[1].sentence


@pytest.mark.parametrize(("old", "look_new"), [(0, True), (0, False), (3, False)])
def test_frames_that_were_given_before_are_stale(tiny_plan, fake_bench, lit, path, old, look_new):
    """All of them or the first only, whatever their time stamps say."""
    plan, kept = tiny_plan(), []

    def keep(frames):
        kept.extend(frames)
        return frames

    def repeat(frames):
        late_s = frames[0].timestamp_s - kept[old].timestamp_s if look_new else 0.0
        start_s = kept[old].timestamp_s + late_s
        ids, images = range(kept[old].id, kept[old].id + 4), [frame.image for frame in frames]
        return [Frame(id, start_s + k / RATE_HZ, images[k]) for k, id in enumerate(ids)]

    run(plan, fake_bench(picture=lit(plan), spoilt={1: keep, 2: repeat}).opened(), path)
    assert verdicts_of(path) == ["ok", "stale", "ok"]
    with Run.open(path) as measured:
        assert f"frame {kept[old].id} is not later than frame" in measured.steps[1].sentence


def test_after_the_camera_was_stopped_frames_are_numbered_from_the_start(
    tiny_plan, fake_bench, lit, path
):
    """Their numbers were seen before, and their clock went on."""
    plan = tiny_plan(steps=4, **{"policy.instrument_error": {"retries": 1, "then": "stop"}})
    fake = fake_bench(picture=lit(plan), spoilt={})
    whole = fake.opened()
    grab = whole.camera.grab

    def fail_once(count, not_before_s):
        frames = grab(count, not_before_s)
        if fake.names().count("grab") == 3:
            raise InstrumentError("camera: lost its cable; plug it in")
        return frames

    whole.camera.grab = fail_once
    run(plan, whole, path)
    with Run.open(path) as measured:
        assert measured.good.all()
        assert measured.steps[2].frame_ids[0] <= measured.steps[1].frame_ids[0]


# --- The lock as the light shows it ------------------------------------------------------------


def detuned(plan, error_hz):
    """The same plan with AOM1 at another frequency."""
    steps = tuple(
        replace(step, difference_hz=step.difference_hz + error_hz, aom1_hz=step.aom1_hz + error_hz)
        for step in plan.steps
    )
    return Plan(plan.protocol, plan.reed, plan.bench, steps, ())


# On so few pixels the noise outweighs what leaks of other sidebands: 5 mHz, as a rule.
AROUND_F1 = {"sweep.first": 16, "sweep.last": 26}
# Standard errors of the lock are those of the image: what a path walks by is added to them.
STILL_PATHS = {"path_walk_rad_s": 0.0}


def lock_errors(path):
    with Run.open(path) as measured:
        return np.array([(step.lock_error_hz, step.lock_error_se_hz) for step in measured]).T


def assert_measured(errors_hz, standard_errors_hz, true_hz):
    """Each step within three standard errors, and their mean within three of its own."""
    deviations = (errors_hz - true_hz) / standard_errors_hz
    assert np.abs(deviations).max() < 3
    assert abs(deviations.mean()) < 3 / np.sqrt(len(deviations))
    assert standard_errors_hz.max() < 0.015, "small enough to tell it from a lock"


@pytest.mark.parametrize("error_hz", ["0", "0.1", "-0.1", "-0.4", "1.2"])
def test_a_wrong_difference_of_the_synthesizers_is_measured_from_the_light(
    small_plan, open_small_bench, path, error_hz
):
    plan = small_plan({**AROUND_F1, "policy.bad_step.retries": 0}, light=STILL_PATHS)
    wrong = detuned(plan, Fraction(error_hz))
    run(wrong, open_small_bench(wrong), path)
    assert_measured(*lock_errors(path), float(error_hz))
    assert set(verdicts_of(path)) == {"ok" if error_hz == "0" else "lock"}


@pytest.mark.parametrize("error_ppm", [40_000.0, -40_000.0])
def test_another_rate_of_the_camera_is_measured_from_the_light(
    small_plan, open_small_bench, path, error_ppm
):
    """The light turns by a quarter in a period that is shorter or longer than it should be."""
    changes = {**AROUND_F1, "policy.bad_step.retries": 0}
    plan = small_plan(changes, faults={"frame_rate_error_ppm": error_ppm}, light=STILL_PATHS)
    run(plan, open_small_bench(plan), path)
    ratio = 1 + 1e-6 * error_ppm
    assert_measured(*lock_errors(path), RATE_HZ / 4 * (1 / ratio - 1))
    assert set(verdicts_of(path)) == {"lock"}


@pytest.mark.parametrize("error_hz", ["0.5", "-1.3"])
def test_what_the_light_shows_counts_whatever_the_instruments_say(
    small_plan, open_small_bench, path, error_hz
):
    plan = small_plan({**AROUND_F1, "policy.bad_step.retries": 0}, light=STILL_PATHS)
    bench = open_small_bench(plan)
    played, asked = bench.synthesizers.set_pair, {}

    def detune(aom1_hz, aom2_hz):
        asked["pair"] = aom1_hz, aom2_hz
        played(aom1_hz + Fraction(error_hz), aom2_hz)

    bench.synthesizers.set_pair = detune
    bench.synthesizers.read_pair = lambda: asked["pair"]
    run(plan, bench, path)
    with Run.open(path) as measured:
        for step in measured:
            assert step.read_aom1_hz == step.aom1_hz
            assert step.verdict is Verdict.LOCK
            assert "the light turns by" in step.sentence
            assert f"{step.lock_error_hz:+.3g} Hz off the lock" in step.sentence
    assert_measured(*lock_errors(path), float(error_hz))


def test_a_loudspeaker_that_is_unplugged_shows_no_wrong_lock(small_plan, open_small_bench, path):
    """The carrier's light is there, but turns with no lock at all."""
    changes = {**AROUND_F1, "policy.bad_step.retries": 0}
    plan = small_plan(changes, faults={"tweeter_unplugged": True})
    run(plan, open_small_bench(plan), path)
    assert set(verdicts_of(path)) == {"no_signal"}


def test_measuring_is_a_function_of_the_frames(tiny_plan, lit):
    """`measure` alone, without a bench: a light that turns too fast by a twentieth of a turn."""
    plan = tiny_plan()
    step, picture = plan.steps[0], lit(plan, Fraction(1, 4) + Fraction(1, 20))
    frames = tuple(Frame(k, 1.0 + k / RATE_HZ, picture(k, plan.frame_shape)) for k in range(4))
    read = ReadBack(step.aom1_hz, step.aom2_hz, step.drive_hz, step.volts)
    acquisition = StepAcquisition(0, step, read, read, 0.5, frames, 1)
    found = measure(acquisition, plan, reconstruction_of(plan), 4095)
    assert found.lock_error_hz == pytest.approx(RATE_HZ / 20, abs=0.02)
    assert 0 < found.lock_error_se_hz < 0.02
    assert found.judgement.verdict is Verdict.LOCK
    none = measure(replace(acquisition, frames=()), plan, reconstruction_of(plan), 4095)
    assert none.judgement.verdict is Verdict.DROPPED
    assert np.isnan([none.lock_error_hz, none.unexplained, none.signal_to_noise]).all()
    assert none.lock_error_se_hz == np.inf
    assert not none.field.any()


# --- Taken again -------------------------------------------------------------------------------


@pytest.mark.parametrize("keep", ["holograms", "frames"])
def test_both_takes_of_a_step_are_kept(tiny_plan, fake_bench, lit, path, documents_of, keep):
    plan, reports = tiny_plan(steps=4, keep=keep, **TWICE), []
    bright = lit(plan)
    # The acquisition that is spoilt shows another light, so that it can be recognised.
    spoil = pictured(lambda images: ends_in_zeros(images // 2))
    fake = fake_bench(picture=bright, spoilt={2: spoil})
    summary = run(plan, fake.opened(), path, progress=reports.append)
    assert summary.counts == {Verdict.OK: 4}
    assert summary.repeated == 1
    reported = [
        (report.index, report.attempt, str(report.verdict), report.done) for report in reports
    ]
    assert reported == [
        (12, 1, "ok", 1), (14, 1, "partial", 2), (16, 1, "ok", 3), (18, 1, "ok", 4),
        (14, 2, "ok", 4),
    ]  # fmt: skip
    events = [document["data"] for name, document in documents_of(path) if name == "event"]
    assert [(e["index"], e["attempt"], e["verdict"]) for e in events] == [t[:3] for t in reported]
    grabbed = [entry for entry in fake.log if entry[0] == "set_pair"]
    assert grabbed[4] == grabbed[1]
    with Run.open(path) as measured:
        (first,), second = measured.earlier_attempts, measured.steps[1]
        assert (first.verdict, second.verdict) == (Verdict.PARTIAL, Verdict.OK)
        assert (first.index, second.index) == (14, 14)
        assert "12 of 32 rows" in first.sentence
        assert first.timestamps_s[3] < measured.steps[3].timestamps_s[0] < second.timestamps_s[0]
        assert first.frame_ids[3] < measured.steps[3].frame_ids[0] < second.frame_ids[0]
        for taken, field, images in (
            (
                first,
                measured.earlier_field(0),
                [bright(k, plan.frame_shape) for k in first.frame_ids],
            ),
            (second, measured.field(1), [bright(k, plan.frame_shape) for k in second.frame_ids]),
        ):
            images = np.stack(images)
            if taken is first:
                images = ends_in_zeros(images // 2)
            expected = measured.reconstruction.field(images)
            np.testing.assert_array_equal(field, expected)


@pytest.mark.parametrize(
    ("faults", "verdict"),
    [({"drop_frame_at": [2]}, "dropped"), ({"stale_frame_at": [3]}, "stale")],
)
def test_a_single_fault_of_the_simulated_bench_is_mended(
    small_plan, open_small_bench, path, faults, verdict
):
    plan = small_plan(faults=faults)
    summary = run(plan, open_small_bench(plan), path)
    assert summary.counts == {Verdict.OK: 5}
    with Run.open(path) as measured:
        (first,) = measured.earlier_attempts
        position = next(iter(faults.values()))[0] - 1
        assert (first.position, str(first.verdict)) == (position, verdict)
        latest = measured.steps[position]
        assert latest.changed_s > measured.steps[-1].changed_s > first.changed_s
        assert (measured.earlier_field(0) != measured.field(position)).any()


def test_a_step_that_stays_bad_keeps_all_its_takes(tiny_plan, fake_bench, lit, path):
    plan = tiny_plan(**{"policy.bad_step.retries": 2})
    # The second step is the second acquisition, and alone in both rounds that follow.
    spoilt = {
        2: FAULTS["a frame is lost"][0], 4: FAULTS["no light"][0], 5: FAULTS["too much light"][0]
    }  # fmt: skip
    summary = run(plan, fake_bench(picture=lit(plan), spoilt=spoilt).opened(), path)
    assert summary.counts == {Verdict.OK: 2, Verdict.SATURATED: 1}
    assert (summary.status, summary.repeated) == (RunState.COMPLETE, 2)
    with Run.open(path) as measured:
        assert [str(attempt.verdict) for attempt in measured.earlier_attempts] == [
            "dropped",
            "no_signal",
        ]
    assert verdicts_of(path) == ["ok", "saturated", "ok"]


@pytest.mark.parametrize(("bad", "again"), [(4, 4), (5, 0)])
def test_if_too_many_steps_are_bad_the_trouble_is_not_theirs(
    tiny_plan, fake_bench, lit, path, bad, again
):
    """Of six steps four may be measured again."""
    plan = tiny_plan(steps=6, **TWICE)
    spoilt = dict.fromkeys(range(1, bad + 1), FAULTS["no light"][0])
    fake = fake_bench(picture=lit(plan), spoilt=spoilt)
    summary = run(plan, fake.opened(), path)
    assert (summary.status, summary.repeated) == (RunState.COMPLETE, again)
    assert fake.names().count("grab") == 6 + again
    expected = {"no_signal": bad - again, "ok": 6 - bad + again}
    assert {str(v): n for v, n in summary.counts.items()} == {
        k: n for k, n in expected.items() if n
    }


def test_a_step_that_was_done_without_is_not_bad(tiny_plan, fake_bench, lit, path):
    """An instrument failed at it, as often as policy allows: it is not taken after the last."""
    changes = {**TWICE, "policy.instrument_error": {"retries": 0, "then": "skip"}}
    plan = tiny_plan(**changes)
    fake = fake_bench(picture=lit(plan))

    def fail(name, count):
        if (name, count) == ("grab", 2):
            raise InstrumentError("fake: fails; mend it")

    fake.before = fail
    run(plan, fake.opened(), path)
    assert fake.names().count("grab") == 3
    assert verdicts_of(path) == ["ok", "skipped", "ok"]


def test_an_instrument_that_fails_at_a_second_take_leaves_the_first(
    tiny_plan, fake_bench, lit, path
):
    changes = {**TWICE, "policy.instrument_error": {"retries": 0, "then": "skip"}}
    plan = tiny_plan(**changes)
    fake = fake_bench(picture=lit(plan), spoilt={2: FAULTS["too much light"][0]})

    def fail(name, count):
        if (name, count) == ("grab", 4):
            raise InstrumentError("fake: fails; mend it")

    fake.before = fail
    run(plan, fake.opened(), path)
    assert verdicts_of(path) == ["ok", "saturated", "ok"]
    with Run.open(path) as measured:
        assert measured.earlier_attempts == ()
        assert measured.field(1).any()


# --- A run that is to stop at bad pictures -----------------------------------------------------


def stopping(retry):
    return {"policy.bad_step": {"retries": retry, "then": "stop"}}


def test_a_run_that_is_to_stop_at_bad_step_takes_them_again_at_once(
    tiny_plan, fake_bench, lit, path
):
    plan = tiny_plan(**stopping(1))
    fake = fake_bench(picture=lit(plan), spoilt={2: FAULTS["two are exchanged"][0]})
    summary = run(plan, fake.opened(), path)
    assert (summary.status, summary.counts) == (RunState.COMPLETE, {Verdict.OK: 3})
    pairs = [entry[1] for entry in fake.log if entry[0] == "set_pair"]
    one, two, three = (step.aom1_hz for step in plan.steps)
    assert pairs == [one, two, two, three]
    with Run.open(path) as measured:
        assert [str(attempt.verdict) for attempt in measured.earlier_attempts] == ["disordered"]


@pytest.mark.parametrize("retry", [0, 1])
def test_a_run_that_is_to_stop_at_bad_step_ends_at_that_step(
    tiny_plan, fake_bench, lit, path, retry
):
    plan = tiny_plan(steps=4, **stopping(retry))
    spoilt = dict.fromkeys((2, 3), FAULTS["no light"][0])
    fake = fake_bench(picture=lit(plan), spoilt=spoilt)
    summary = run(plan, fake.opened(), path)
    assert (summary.status, summary.repeated) == (RunState.INTERRUPTED, retry)
    assert fake.names().count("grab") == 2 + retry
    assert (fake.output_on, fake.rf, fake.running) == (False, False, False)
    assert verdicts_of(path) == ["ok", "no_signal", "pending", "pending"]
