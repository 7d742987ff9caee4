"""Disorder of the simulated bench: what a bench file says, and what it does to frames."""

import json
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import yaml

from drivers.errors import BenchSetupError
from drivers.roles import Arrangement
from drivers.simulated.disorder import as_section, realised
from drivers.simulated.settings import bench_parameters, read_simulation
from holography.demodulation import four_phase
from physics.bench import BenchModel
from physics.parameters.disorder import BY_NAME, CATALOGUE, ordinary_amounts, with_disorder
from physics.parameters.quantity import leaves
from physics.parameters.tree import BenchParameters
from protocols.preparation import Preparation

RATE_HZ = Fraction(62, 5)
PERIOD_S = 1 / RATE_HZ
CENTRE_HZ = Fraction(80_000_000)
DRIVE_HZ = Fraction(20001, 10)
# Kinds whose parameters are not zero on the nominal bench.
NEVER_ZERO = {"path_walk", "read_noise"}
# Where the others show.
SCENES = {"lamp": Arrangement.FLAT, "reference_leak": Arrangement.LO_ONLY}


@pytest.fixture
def running(small_plan, open_small_bench):
    """Return a maker of benches whose camera runs and whose light and loudspeaker are on."""

    def make(disorder, seed=1, reed="R07", **twin):
        plan = small_plan(disorder=disorder, **twin)
        bench = open_small_bench(plan, seed=seed, reed=reed)
        bench.camera.configure(RATE_HZ, PERIOD_S, (128, 160))
        bench.synthesizers.rf_on()
        bench.synthesizers.set_pair(CENTRE_HZ + DRIVE_HZ + RATE_HZ / 4, CENTRE_HZ)
        bench.generator.set_sine(DRIVE_HZ, 4.0)
        bench.camera.start()
        return bench

    return make


def frames_of(bench, count=2, scene=Arrangement.HOLOGRAMS):
    bench.surroundings.arrange(scene)
    grabs = [bench.camera.grab(4, bench.camera.now_s()) for _ in range(count)]
    return np.array([[frame.image for frame in grab] for grab in grabs])


def text_of(kind, amount):
    """An amount as a bench file says it."""
    unit = kind.ordinary.unit
    return f"{amount:.6e} {unit}" if unit else amount


# --- Catalogue -----------------------------------------------------------------------------------


def test_every_kind_has_a_range_within_its_limits_and_a_source():
    assert len(BY_NAME) == len(CATALOGUE)
    for kind in CATALOGUE:
        ordinary, (low, high) = kind.ordinary, kind.limits
        assert low <= ordinary.low < ordinary.high <= high, kind.name
        assert ordinary.source, kind.name
        assert kind.meaning, kind.name


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.name)
def test_a_kind_changes_one_parameter_of_the_tree_to_its_amount(kind):
    nominal = BenchParameters()
    amount = kind.ordinary.high
    changed = with_disorder(nominal, {kind.name: amount}, 0, "R07")
    before, after = (
        {leaf.path: leaf.value for leaf in leaves(tree)} for tree in (nominal, changed)
    )
    different = [after[path] for path in after if after[path] != before[path]]
    different += [own for _, own in changed.reed.alterations]
    assert different == [amount]
    if kind.name not in NEVER_ZERO:
        assert with_disorder(nominal, {kind.name: 0.0}, 0, "R07") == nominal


def test_ordinary_amounts_fill_their_ranges_and_follow_from_seed_and_reed():
    drawn = [ordinary_amounts(seed, "R07") for seed in range(200)]
    for kind in CATALOGUE:
        low, high = kind.ordinary.low, kind.ordinary.high
        places = (np.array([amounts[kind.name] for amounts in drawn]) - low) / (high - low)
        assert 0 <= places.min() < 0.05 < 0.95 < places.max() <= 1, kind.name
        assert np.mean(places) == pytest.approx(0.5, abs=0.1), kind.name
    one, other = ordinary_amounts(3, "R07"), ordinary_amounts(3, "R08")
    assert one == drawn[3]
    assert {name for name in one if one[name] != other[name]} == {
        kind.name for kind in CATALOGUE if kind.of_reed
    }


def test_every_reed_has_a_thickness_map_of_its_own():
    def seed_of(seed, reed):
        ((kind, _),) = with_disorder(
            BenchParameters(), {"thickness_map": 5e-6}, seed, reed
        ).reed.alterations
        return kind.seed

    assert seed_of(0, "R07") == seed_of(0, "R07")
    assert len({seed_of(0, "R07"), seed_of(0, "R08"), seed_of(1, "R07")}) == 3


# --- Bench file ----------------------------------------------------------------------------------


def test_a_section_names_amounts_or_has_them_drawn():
    assert realised({}, "R07", "x").amounts == {}
    named = realised({"thickness_map": "5 um", "lag": 0}, "R07", "x")
    assert named.amounts == {"thickness_map": pytest.approx(5e-6), "lag": 0.0}
    drawn = realised(as_section("ordinary"), "R07", "x")
    assert drawn.amounts == ordinary_amounts(0, "R07")
    both = realised({"ordinary": True, "seed": 4, "lag": 0.002}, "R07", "x")
    assert both.amounts == ordinary_amounts(4, "R07") | {"lag": 0.002}


def test_disorder_reaches_physics_and_takes_the_place_of_what_light_says(small_bench_file):
    bench_file = small_bench_file(
        disorder={"gain_scatter": 0.004, "E_T": -0.1, "frame_jitter": "5 us"},
        light={"gain_scatter": 0.1, "path_jitter_rad": 0.2},
    )
    simulation = read_simulation(bench_file.twin, "mine")
    parameters = bench_parameters(simulation, bench_file, Preparation("R07", "A", "symmetric"))
    assert parameters.optics.interference.gain_scatter == 0.004
    assert parameters.optics.interference.jitter_rad == 0.2
    assert parameters.reed.shift.E_T == -0.1
    assert parameters.clocks.frame_jitter_s == pytest.approx(5e-6)


@pytest.mark.parametrize(
    ("section", "key"),
    [
        ({"lagg": 1}, "lagg"),
        ({"lag": "3 um"}, "lag"),
        ({"lag": 2}, "lag"),
        ({"lag": float("nan")}, "lag"),
        ({"lag": True}, "lag"),
        ({"lag": [0.1]}, "lag"),
        ({"thickness_map": 5}, "thickness_map"),
        ({"thickness_map": "5 kg"}, "thickness_map"),
        ({"thickness_map": "1 mm"}, "thickness_map"),
        ({"path_walk": "0.2 rad"}, "path_walk"),
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"ordinary": 1}, "ordinary"),
        ("often", ""),
        (5, ""),
    ],
)
def test_a_wrong_section_is_refused_in_one_line_with_its_key(section, key, running):
    with pytest.raises(BenchSetupError) as caught:
        running(section)
    path = ".".join(word for word in ("twin.disorder", key) if word)
    assert f"{path}: " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_reed_that_is_not_its_own_mirror_image_is_refused(running):
    rows = [[1.0, -1.0], [1.0, -1.0]]
    uneven = {"x_mm": [0.0, 35.0], "y_mm": [-6.5, 6.5], "deviation_um": rows}
    with pytest.raises(BenchSetupError, match=r"twin\.shape .* twin\.disorder"):
        running({"clamp_shift": "0.1 mm"}, shape={"thickness_map": uneven})


# --- Frames --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.name)
def test_a_kind_changes_frames_and_the_same_seed_gives_the_same_ones(kind, running):
    scene = SCENES.get(kind.name, Arrangement.HOLOGRAMS)
    section = {kind.name: text_of(kind, kind.ordinary.high)}
    light = {"object_e_s": 8e3}
    nominal, one, same = (
        frames_of(running(each, light=light), scene=scene) for each in ({}, section, section)
    )
    np.testing.assert_array_equal(one, same)
    # A time of 20 µs turns the phase by 0.4 mrad: that shows in few pixels.
    assert np.any(one != nominal, axis=(0, 1)).mean() > (
        1e-3 if kind.name == "frame_jitter" else 0.05
    )
    if kind.name not in NEVER_ZERO:
        zero = frames_of(running({kind.name: text_of(kind, 0.0)}, light=light), scene=scene)
        np.testing.assert_array_equal(zero, nominal)


def test_an_ordinary_bench_is_the_same_for_one_seed(running):
    one, same = (frames_of(running("ordinary")) for _ in range(2))
    other_bench = frames_of(running({"ordinary": True, "seed": 1}))
    other_noise = frames_of(running("ordinary", seed=2))
    np.testing.assert_array_equal(one, same)
    for other in (other_bench, other_noise):
        assert (one != other).mean() > 0.5


@pytest.fixture
def seen(monkeypatch):
    """Beginning and gain of the object light of every frame, which are not rendered."""
    frames = []

    def note(_self, segments, _rng, object_gain, _scene):
        frames.append((segments[0].start_s, object_gain))
        return np.zeros((128, 160), dtype=np.uint16)

    monkeypatch.setattr(BenchModel, "frame", note)
    return frames


STILL = {"path_walk": "0 rad/s^0.5"}


def test_the_path_walks_by_its_step_from_acquisition_to_acquisition(running, seen):
    frames_of(running({**STILL, "path_step": "0.4 rad"}), count=400)
    phases = np.unwrap(np.angle([gain for _, gain in seen]))[::4]
    steps = np.diff(phases)
    assert np.std(steps) == pytest.approx(0.4, rel=0.15)
    # A walk: after nine steps the variance is ninefold.
    assert np.std(phases[9::9] - phases[:-9:9]) == pytest.approx(1.2, rel=0.4)
    assert abs(np.corrcoef(steps[1:], steps[:-1])[0, 1]) < 0.2
    within = np.angle([gain for _, gain in seen]).reshape(-1, 4)
    assert np.abs(np.diff(within, axis=1)).max() < 1e-12


def test_the_path_walks_by_a_tenth_of_a_radian_within_four_frames(running, seen):
    frames_of(running({"path_walk": "0.2 rad/s^0.5"}), count=400)
    phases = np.angle([gain for _, gain in seen]).reshape(-1, 4)
    turned = np.angle(np.exp(1j * (phases[:, 3] - phases[:, 0])))
    expected = 0.2 * np.sqrt(3 * float(PERIOD_S))
    assert expected == pytest.approx(0.1, rel=0.03)
    assert np.std(turned) == pytest.approx(expected, rel=0.15)


def test_frames_begin_early_and_late_by_their_jitter(running, seen):
    frames_of(running({**STILL, "frame_jitter": "20 us"}), count=200)
    starts_s = np.array([start_s for start_s, _ in seen])
    late_s = starts_s - np.round(starts_s / float(PERIOD_S)) * float(PERIOD_S)
    late_s -= late_s.mean()
    assert np.std(late_s) == pytest.approx(20e-6, rel=0.15)
    assert abs(np.corrcoef(late_s[1:], late_s[:-1])[0, 1]) < 0.2


def test_the_first_frame_of_an_acquisition_has_the_lag_of_the_one_that_nobody_read(running):
    """Otherwise it would be darker than the others by a tenth."""
    bench = running({"lag": 0.1})
    bench.clock.wait(1.0)
    offset_dn = bench.camera.lab.sensor.offset_dn
    light = frames_of(bench, scene=Arrangement.LO_ONLY).mean(axis=(2, 3)) - offset_dn
    assert light == pytest.approx(np.full(light.shape, light.mean()), rel=2e-3)


def test_speckle_loses_its_correlation_with_the_number_of_acquisitions(running):
    """After n acquisitions (1 - renewal²)^(n/2) of the light is what it was."""
    light = {"local_oscillator_e_s": 40e3, "object_e_s": 8e3}
    bench = running({**STILL, "speckle_renewal": 0.2}, light=light)
    bench.generator.output_off()
    bench.synthesizers.set_pair(CENTRE_HZ + RATE_HZ / 4, CENTRE_HZ)
    transform, region = lab_model(bench).transform, lab_model(bench).region
    images = [
        region.crop(transform.to_object(four_phase(grab))) for grab in frames_of(bench, count=9)
    ]
    found = [
        abs(np.vdot(images[0], each)) / np.linalg.norm(images[0]) / np.linalg.norm(each)
        for each in images
    ]
    # Speckle of some hundred points, and some noise.
    assert found[4] == pytest.approx(0.96**2, abs=0.05)
    assert found[8] == pytest.approx(0.96**4, abs=0.08)


def lab_model(bench):
    return bench.camera.lab._model  # noqa: SLF001  # nothing else holds the transform


# --- Record --------------------------------------------------------------------------------------


def test_an_open_bench_says_what_was_drawn(running):
    record = json.loads(running({"ordinary": True, "seed": 5}, reed="R12").simulated_disorder)
    assert (record["seed"], record["reed"]) == (5, "R12")
    found = {name: amount["value"] for name, amount in record["amounts"].items()}
    assert found == ordinary_amounts(5, "R12")
    assert record["amounts"]["thickness_map"]["unit"] == "m"
    assert running({}).simulated_disorder == ""


def test_parameters_without_disorder_are_those_without_the_key(small_bench_file):
    preparation = Preparation("R07", "A", "symmetric")
    plain, empty = (
        bench_parameters(read_simulation(bench.twin, "mine"), bench, preparation)
        for bench in (small_bench_file(), small_bench_file(disorder={}))
    )
    assert plain == empty


# --- Documentation -------------------------------------------------------------------------------

HOW_TO = Path(__file__).parents[2] / "docs/how-to/practise-on-a-simulated-bench.md"
SECTIONS = re.findall(
    r"^ *```yaml\n(.*?)^ *```$", HOW_TO.read_text("utf-8"), re.DOTALL | re.MULTILINE
)


@pytest.mark.parametrize("text", SECTIONS)
def test_every_bench_of_the_how_to_can_be_played(text, small_bench_file):
    twin = yaml.safe_load(text)["twin"]
    bench_file = small_bench_file(**twin)
    preparation = Preparation("R07", "A", "asymmetric")
    played = bench_parameters(read_simulation(bench_file.twin, "mine"), bench_file, preparation)
    nominal = bench_parameters(read_simulation({}, "mine"), bench_file, preparation)
    assert played != nominal


def test_the_how_to_shows_benches():
    assert len(SECTIONS) >= 5
