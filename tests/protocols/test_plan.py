"""The plan: the paper's sweep to the last digit, and every reason why a bench cannot do one."""

import json
import math
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from holography.fresnel import FresnelTransform
from physics.reed.geometry import ReedGeometry
from protocols.bench import BenchFile
from protocols.errors import ProtocolError
from protocols.plan import make_plan, planned_sequence
from protocols.protocol import Protocol
from protocols.reed import ReedFile

SERIES_A = Protocol.from_file("seriesA")
BENCH = BenchFile.from_file()

# Smallest and largest resonance of modes F1 … F4 and of the sweep, as the paper's Table 1 prints
# them: all were read off the sweep, so each is one of its frequencies.
PRINTED_HZ = (1838, 2154, 3091, 3676, 4767, 5669, 5587, 6939, 9262, 10857, 15803, 18524, 19911)


@pytest.fixture(scope="module")
def series_a():
    return make_plan(SERIES_A, BENCH)


def cents(one, other):
    return 1200 * math.log2(one / other)


# --- The paper's sweep -------------------------------------------------------------------------


def test_series_a_can_run(series_a):
    assert series_a.violations == ()
    series_a.require_possible()
    assert [step.index for step in series_a.steps] == list(range(1, 185))


def test_steps_are_measured_upwards_downwards_or_shuffled():
    up, down, shuffled = (
        make_plan(SERIES_A.replace({"sweep.direction": direction}), BENCH)
        for direction in ("up", "down", "shuffled")
    )
    assert up.sequence == tuple(range(184))
    assert down.sequence == tuple(range(183, -1, -1))
    assert shuffled.sequence not in (up.sequence, down.sequence)
    assert sorted(shuffled.sequence) == list(range(184))
    # The same in every run, and for who has only the protocol.
    assert shuffled.sequence == planned_sequence(shuffled.protocol, 184)


def test_asked_frequencies_are_the_grid_of_the_paper(series_a):
    for step in series_a.steps:
        assert step.asked_hz * 10**6 % 1 == 0
        expected_hz = 1396.9 * 2 ** (25 * step.index / 1200)
        assert float(step.asked_hz) == pytest.approx(expected_hz, abs=0.51e-6)


@pytest.mark.parametrize("printed_hz", PRINTED_HZ)
def test_resonances_of_the_paper_are_steps(series_a, printed_hz):
    distance_cents = min(abs(cents(step.asked_hz, printed_hz)) for step in series_a.steps)
    # A hundredth of a step is what the whole hertz of the paper leave open.
    assert round(distance_cents / 25, 2) <= 0.01


@pytest.mark.parametrize(
    ("index", "drive_hz"),
    [(1, "1417.2"), (19, "1837.9"), (73, "4008.5"), (78, "4308.6"), (184, "19911.9")],
)
def test_drives_of_the_paper(series_a, index, drive_hz):
    assert series_a.steps[index - 1].drive_hz == Fraction(drive_hz)


def test_step_78_is_the_acoustic_line_of_the_bench(series_a):
    assert BENCH.acoustic_resonances_hz == (series_a.steps[77].drive_hz,)


def test_every_step_locks_exactly(series_a):
    for step in series_a.steps:
        assert step.lock_residual_hz == 0
        assert step.difference_hz == step.drive_hz + Fraction("12.4") / 4
        assert step.aom1_hz - step.aom2_hz == step.difference_hz
        assert step.aom2_hz == 80_000_000
        assert step.aom1_hz * 10 % 1 == 0
        assert abs(step.drive_hz - step.asked_hz) <= Fraction(1, 20)


def test_snapping_moves_no_step_audibly(series_a):
    assert abs(cents(series_a.steps[0].drive_hz, series_a.steps[0].asked_hz)) < 0.1
    assert max(abs(cents(step.drive_hz, step.asked_hz)) for step in series_a.steps) < 0.1


def test_ramp_of_the_paper(series_a):
    volts = [step.volts for step in series_a.steps]
    assert (volts[0], volts[72], volts[183]) == (0.5, 16.0, 16.0)
    ratios = [after / before for before, after in pairwise(volts[:73])]
    assert ratios == pytest.approx([32 ** (1 / 72)] * 72, rel=1e-5)
    assert set(volts[72:]) == {16.0}


def test_ramp_is_constant_before_it_begins():
    ramp = SERIES_A.replace({"drive.first": 40}).drive
    assert [ramp.volts(k, Fraction(1000)) for k in (1, 40, 73, 100)] == [0.5, 0.5, 16.0, 16.0]
    assert ramp.volts(41, Fraction(1000)) > 0.5


@given(st.integers(-200, 200), st.integers(1, 400), st.integers(1, 10**6))
@settings(deadline=None)
def test_frequencies_at_any_interval(index, interval, millihertz):
    sweep = SERIES_A.sweep.model_copy(
        update={
            "reference_hz": Fraction(millihertz, 1000),
            "interval_cents": Fraction(interval, 10),
        }
    )
    expected_hz = millihertz / 1000 * 2 ** (interval * index / 12000)
    assert float(sweep.frequency_hz(index)) == pytest.approx(expected_hz, rel=1e-12, abs=0.51e-6)


def test_quick_sweep_shows_all_modes_on_enough_pixels():
    plan = make_plan(Protocol.from_file("quick"), BENCH)
    plan.require_possible()
    drives = [float(step.drive_hz) for step in plan.steps]
    # From below the smallest F1 of the paper to the end of its range.
    assert drives[1] < 1812
    assert drives[-1] == 19911.9
    assert len(drives) == 87
    assert plan.frame_shape == (512, 640)
    assert plan.region.width >= 120
    assert {step.index for step in plan.steps} <= {
        step.index for step in make_plan(SERIES_A, BENCH).steps
    }


# --- Costs -------------------------------------------------------------------------------------


def test_duration_counts_settling_to_the_next_frame(series_a):
    # 40 ms of settling is one frame period of 80.6 ms, and four frames follow.
    assert series_a.duration_s == pytest.approx(184 * 5 / 12.4)
    longer = make_plan(SERIES_A.replace(settle="0.1 s"), BENCH)
    assert longer.duration_s == pytest.approx(184 * 6 / 12.4)
    at_once = make_plan(SERIES_A.replace(settle="0 s"), BENCH)
    assert at_once.duration_s == pytest.approx(184 * 4 / 12.4)
    one_period = make_plan(
        SERIES_A.replace({"settle": "0.1 s", "camera.frame_rate": "10 Hz"}), BENCH
    )
    assert one_period.duration_s == pytest.approx(184 * 5 / 10)


def test_file_sizes(series_a):
    region = series_a.region
    assert series_a.file_size_bytes == 184 * region.height * region.width * 8
    frames = make_plan(SERIES_A.replace(keep="frames"), BENCH)
    assert frames.file_size_bytes == 184 * 4 * 1024 * 1280 * 2
    assert frames.largest_size_bytes == (184 + 22 + 8) * 4 * 1024 * 1280 * 2
    assert series_a.packed_size_bytes is None
    assert 0.5 < frames.packed_size_bytes / frames.file_size_bytes < 0.75


@pytest.mark.parametrize(
    ("last", "retry", "spare"),
    # A tenth of the sweep and four, but no more than can be asked for.
    [(184, 1, 22), (184, 0, 0), (184, 5, 22), (2, 1, 2), (2, 5, 4), (1, 1, 1), (60, 1, 10)],
)
def test_spare_attempts_are_a_tenth_of_the_sweep_and_four(last, retry, spare):
    changes = {"sweep.last": last, "policy.bad_step.retries": retry}
    plan = make_plan(SERIES_A.replace(changes), BENCH)
    assert plan.max_retries == spare
    # And for those after which a run gives up.
    assert plan.spare_attempts == (spare + min(8, last) if retry else 0)
    patient = make_plan(SERIES_A.replace({**changes, "policy.give_up_after": 50}), BENCH)
    assert patient.spare_attempts == (spare + min(50, last) if retry else 0)


def test_region_covers_the_reed_and_no_twin(series_a):
    rows, columns = series_a.frame_shape
    pitch_y, pitch_x = FresnelTransform((rows, columns), 6.7e-6, 650e-9, 1.0).object_pitch_m
    region = series_a.region
    top, bottom = (
        (region.row - rows // 2) * pitch_y,
        (region.row + region.height - rows // 2) * pitch_y,
    )
    left = (region.column - columns // 2) * pitch_x
    right = left + region.width * pitch_x
    assert 0.0145 < top <= 0.0151
    assert 0.0289 <= bottom < 0.0295
    assert (left, right) == (pytest.approx(-0.019, abs=2e-4), pytest.approx(0.019, abs=2e-4))


# --- JSON --------------------------------------------------------------------------------------


def test_json_keys_and_exact_strings(series_a):
    content = json.loads(json.dumps(series_a.to_json(), allow_nan=False))
    assert set(content) == {
        "protocol", "reed", "bench", "steps", "duration_s", "file_size_bytes",
        "largest_size_bytes", "packed_size_bytes",
        "violations",
        "known",
    }  # fmt: skip
    first = content["steps"][0]
    assert list(first) == [
        "index", "order", "asked_hz", "drive_hz", "aom1_hz", "aom2_hz", "difference_hz",
        "lock_residual_hz", "volts", "frames", "carrier_leak",
    ]  # fmt: skip
    assert first["drive_hz"] == "1417.2"
    assert first["aom1_hz"] == "80001420.3"
    assert first["lock_residual_hz"] == "0"
    for step, planned in zip(content["steps"], series_a.steps, strict=True):
        for key in ("asked_hz", "drive_hz", "aom1_hz", "aom2_hz", "difference_hz"):
            assert Fraction(Decimal(step[key])) == getattr(planned, key)


def test_json_of_a_binary_synthesizer_is_exact_too():
    bench = BENCH.replace({"instruments.synthesizers.step": "0.23283064365386962890625 Hz"})
    plan = make_plan(SERIES_A, bench)
    plan.require_possible()
    assert max(abs(step.lock_residual_hz) for step in plan.steps) <= Fraction(1, 2 * 10**6)
    for step, planned in zip(plan.to_json()["steps"], plan.steps, strict=True):
        assert Fraction(step["lock_residual_hz"]) == planned.lock_residual_hz != 0
        assert Fraction(step["aom1_hz"]) * 2**32 / 10**9 % 1 == 0


def test_carrier_leak_vanishes_off_the_frame_grid(series_a):
    # Where f is a multiple of f_CCD the carrier leaks; between two multiples it does not.
    def leak(reference, **changes):
        protocol = SERIES_A.replace({"sweep.reference": reference, "sweep.first": 0, **changes})
        return make_plan(protocol, BENCH).steps[0].carrier_leak

    assert leak("2033.6 Hz") > 10 * leak("2036.7 Hz")
    assert leak("2033.6 Hz", **{"camera.exposure": "20 ms"}) > leak("2033.6 Hz")
    assert all(0 <= step.carrier_leak < 0.01 for step in series_a.steps)


# --- What the bench cannot do ------------------------------------------------------------------

IMPOSSIBLE = {
    "17 V": ({"drive.to": "17 V"}, "drive.to", "17 V is above the 16 V"),
    "17 V at the start": ({"drive.from": "17 V"}, "drive.from", "write at most '16 V'"),
    "30 kHz at the end": ({"sweep.last": 213}, "sweep.last", "write 184"),
    "30 kHz all along": ({"sweep.reference": "30 kHz"}, "sweep.reference", "30436.4 Hz, above"),
    "too low a start": ({"sweep.first": -300}, "sweep.first", "write -294"),
    "too low all along": ({"sweep.reference": "1 Hz"}, "sweep.reference", "below the 20 Hz"),
    "frame rate": ({"camera.frame_rate": "12.8 Hz"}, "camera.frame_rate", "at most '12.5 Hz'"),
    "exposure": ({"camera.exposure": "90 ms"}, "camera.exposure", "longer than the frame period"),
    "width": ({"camera.width": 1281}, "camera.width", "write at most 1280"),
    "height": ({"camera.height": 1025}, "camera.height", "write at most 1024"),
    "lock": (
        {"camera.frame_rate": "12.5 Hz", "sideband.order": 0},
        "camera.frame_rate",
        "turns the phase by 0.0503 rad, more than the 0.01 rad",
    ),
}


def test_a_step_of_the_generator_that_no_lock_fits_names_the_bench_file():
    bench = BENCH.replace({"instruments.generator.step": "10001 uHz"})
    (violation,) = make_plan(SERIES_A, bench).violations
    assert violation.key == "camera.frame_rate"
    assert f"bench file {bench.source}; make the generator's step" in violation.message


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_impossible_plan_is_refused_in_one_line(case):
    changes, key, expected = IMPOSSIBLE[case]
    plan = make_plan(SERIES_A.replace(changes), BENCH)
    assert [violation.key for violation in plan.violations] == [key]
    with pytest.raises(ProtocolError) as refused:
        plan.require_possible()
    message = str(refused.value)
    assert message.startswith(f"seriesA (changed): {key}: ")
    assert expected in message
    assert message.isprintable()
    assert json.dumps(plan.to_json(), allow_nan=False)


def test_the_worst_lock_counts_whatever_its_sign():
    # A generator of 0.06 Hz steps misses the lock by -0.025 Hz, -0.005 Hz or +0.015 Hz.
    bench = BENCH.replace({"instruments.generator.step": "0.06 Hz"})
    changes = {"camera.frame_rate": "12.5 Hz", "tolerance.lock_phase": "0.04 rad"}
    plan = make_plan(SERIES_A.replace(changes), bench)
    assert max(step.lock_residual_hz for step in plan.steps) == Fraction("0.015")
    assert [violation.key for violation in plan.violations] == ["camera.frame_rate"]
    assert "misses by -0.025 Hz" in plan.violations[0].message


def test_low_volts_and_narrow_windows_belong_to_the_bench():
    bench = BENCH.replace(
        {"limits.volts_min": "0.6 V", "instruments.synthesizers.window": "10 kHz"}
    )
    keys = [violation.key for violation in make_plan(SERIES_A, bench).violations]
    assert keys == ["drive.from", "sideband.order"]


def test_all_violations_are_collected_and_counted():
    protocol = SERIES_A.replace({"drive.to": "17 V", "sweep.last": 190, "camera.exposure": "1 s"})
    plan = make_plan(protocol, BENCH)
    assert {violation.key for violation in plan.violations} == {
        "drive.to", "sweep.last", "camera.exposure"
    }  # fmt: skip
    with pytest.raises(ProtocolError, match=r"\(and 2 more\)$"):
        plan.require_possible()


def test_violation_names_file_and_line():
    text = SERIES_A.text.replace("last: 184", "last: 213")
    line = text.splitlines().index("  last: 213") + 1
    with pytest.raises(ProtocolError, match=rf"^mine\.yaml:{line}: sweep\.last: "):
        make_plan(Protocol.from_text(text, "mine.yaml"), BENCH).require_possible()


def test_a_wider_tolerance_admits_an_imperfect_lock():
    changes = {"camera.frame_rate": "12.5 Hz", "sideband.order": 0}
    wide = SERIES_A.replace({**changes, "tolerance.lock_phase": "0.06 rad"})
    assert make_plan(wide, BENCH).violations == ()


def test_limits_themselves_are_allowed(series_a):
    edge = BENCH.replace({"limits.drive_max": "19911.9 Hz", "limits.drive_min": "1417.2 Hz"})
    assert make_plan(SERIES_A, edge).violations == ()
    assert max(step.volts for step in series_a.steps) == float(BENCH.limits.volts_max_v)


def test_what_is_kept_of_the_image_follows_the_reed(series_a):
    bass = make_plan(SERIES_A.replace(reed="bass-clarinet"), BENCH)
    assert bass.reed.name == "bass clarinet"
    # Twice 8.2 mm of half width and a vamp of 42 mm, and some air.
    assert bass.layout.reed_size_m == (pytest.approx(17e-3), pytest.approx(45e-3))
    assert series_a.layout.reed_size_m == (0.014, 0.038)
    own = make_plan(SERIES_A, BENCH.replace({"optics.reed_size": {"y": "15 mm", "x": "30 mm"}}))
    assert own.layout.reed_size_m == (0.015, 0.03)
    assert own.region.width < series_a.region.width < bass.region.width


@pytest.mark.parametrize(("reed", "y_mm"), [("clarinet", 37), ("bass-clarinet", 36)])
def test_a_reed_out_of_view_is_a_violation(reed, y_mm):
    """The view is 97 mm wide: 43.7 mm either side of the axis are of use."""
    violation = []
    for centre_mm in (y_mm - 1, y_mm):
        bench = BENCH.replace({"optics.reed_centre.y": f"{centre_mm} mm"})
        plan = make_plan(SERIES_A.replace(reed=reed), bench)
        violation.append([(v.key, v.message) for v in plan.violations])
    assert violation[0] == []
    (key, message) = violation[1][0]
    assert key == "reed"
    assert f"the image of the {plan.reed.name} reed reaches 0.04" in message
    assert "move optics.reed_centre or raise optics.distance in bench file simulated" in message


@pytest.mark.parametrize(
    ("where", "change", "key"),
    [
        ("bench", {"optics.reed_centre.y": "1 m"}, "reed"),
        ("bench", {"optics.reed_size": {"y": "14 m", "x": "38 mm"}}, "reed"),
        ("protocol", {"camera.width": 10**9}, "camera.width"),
    ],
)
def test_a_reed_far_out_of_view_is_a_violation_with_nothing_to_keep(where, change, key):
    protocol, bench = Protocol.from_file("quick"), BenchFile.from_file()
    if where == "bench":
        bench = bench.replace(change)
    else:
        protocol = protocol.replace(change)
    plan = make_plan(protocol, bench)
    assert key in [violation.key for violation in plan.violations]
    assert plan.to_json()["file_size_bytes"] == 0


@pytest.mark.parametrize(
    ("changes", "step"),
    [({"sweep.interval": "0.0001 cents"}, "1 uHz"), ({}, "1 kHz")],
)
def test_steps_at_the_same_drive_frequency_are_a_violation(changes, step):
    bench = BenchFile.from_file().replace({"instruments.generator.step": step})
    plan = make_plan(Protocol.from_file("quick").replace(changes), bench)
    (found,) = [v for v in plan.violations if v.key == "sweep.interval"]
    assert "both driven at" in found.message


def test_a_preparation_is_that_of_the_protocol_and_its_reed():
    preparation = make_plan(SERIES_A.replace(reed="alto-saxophone"), BENCH).preparation("R1")
    alto = ReedFile.from_file("alto-saxophone")
    assert (preparation.reed, preparation.series) == ("R1", "A")
    assert preparation.geometry == alto.geometry() != ReedGeometry()
    # What is drawn again for each reed is not its kind's.
    assert (preparation.constants.E_L_pa, preparation.constants.G_LT_pa) == (14e9, 1.1e9)
    assert preparation.constants.E_T_pa == alto.cane().E_T_pa


@pytest.mark.parametrize(
    ("volts_are", "stated", "peak_v"),
    [("peak", "16 V", 16.0), ("peak_to_peak", "32 V", 16.0), ("rms", "10 V", 14.142)],
)
def test_limits_are_compared_with_peak_volts_however_they_are_stated(volts_are, stated, peak_v):
    limits = {"limits.volts_are": volts_are, "limits.volts_max": stated}
    bench = BENCH.replace(limits)
    allowed = SERIES_A.replace({"drive.to": f"{peak_v} V"})
    assert make_plan(allowed, bench).violations == ()
    beyond = SERIES_A.replace({"drive.to": f"{peak_v + 0.001} V"})
    (violation,) = make_plan(beyond, bench).violations
    assert violation.key == "drive.to"
    assert f"above the {peak_v:g} V (peak) of limits.volts_max" in violation.message
    assert violation.message.endswith(f"write at most '{peak_v:g} V'")


# --- Several sidebands -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def three_sidebands():
    content = yaml.safe_load(SERIES_A.text) | {"sideband": {"orders": [0, 1, 2]}}
    return make_plan(Protocol.from_text(yaml.safe_dump(content)), BENCH)


def test_every_sideband_is_selected_at_every_frequency(three_sidebands):
    steps = three_sidebands.steps
    assert [(step.index, step.order) for step in steps] == [
        (index, order) for index in range(1, 185) for order in (0, 1, 2)
    ]
    rate_hz = three_sidebands.protocol.camera.frame_rate_hz
    for step in steps:
        target_hz = step.order * step.drive_hz + rate_hz / 4
        assert step.difference_hz - step.lock_residual_hz == target_hz


def test_all_sidebands_show_the_same_vibration(series_a, three_sidebands):
    for k, one in enumerate(series_a.steps):
        several = three_sidebands.steps[3 * k : 3 * k + 3]
        assert {(step.drive_hz, step.volts) for step in several} == {(one.drive_hz, one.volts)}
        assert several[1] == one


def test_several_sidebands_take_as_much_longer(series_a, three_sidebands):
    assert three_sidebands.duration_s == pytest.approx(3 * series_a.duration_s)
    assert three_sidebands.file_size_bytes == 3 * series_a.file_size_bytes


def test_a_sideband_beyond_the_synthesizers_names_the_key():
    content = yaml.safe_load(SERIES_A.text) | {"sideband": {"orders": [1, 2]}}
    bench = BENCH.replace({"instruments.synthesizers.window": "25 kHz"})
    (violation,) = make_plan(Protocol.from_text(yaml.safe_dump(content)), bench).violations
    assert violation.key == "sideband.orders"
