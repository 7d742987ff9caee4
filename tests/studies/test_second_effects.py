"""Effects of the second laboratory: each changes what its physics says, and nothing at size 0."""

from dataclasses import replace

import numpy as np
import pytest

from studies.second_laboratory.campaigns.climate import Climate
from studies.second_laboratory.campaigns.disorder import LEVELS
from studies.second_laboratory.campaigns.effects import (
    camera,
    cane,
    clocks,
    light,
    mount,
    shape,
    sound,
    unknown_light,
    unknown_sound,
)
from studies.second_laboratory.campaigns.effects.base import Effect
from studies.second_laboratory.campaigns.effects.catalogue import BY_ID, LISTED, UNLISTED
from studies.second_laboratory.parameters import ReedParameters
from tests.studies.second_worlds import (
    GEOMETRY,
    RATE_HZ,
    drive,
    frames,
    hologram,
    modes,
    severe,
    world_of,
)


def everything(*effects, series="A"):
    """Return frames of all scenes, early and late in a campaign, with ordinary disorder."""
    world, settings = world_of(*effects, still=False, series=series)
    drive(settings, 0, 0)
    taken = [frames(world, scene) for scene in ("dark", "flat", "lo_only", "object_only")]
    for time_s in (60.0, 850.0):
        for volts in (0.0, 16.0, 4.0):
            drive(settings, 3400.0 if volts else 0.0, volts)
            taken.append(frames(world, time_s=time_s))
            time_s += 0.4
    return np.array(taken)


@pytest.fixture(scope="module")
def clean():
    return everything()


def test_effects_of_size_0_change_no_bit(clean):
    absent = [severe(cls).absent() for cls in BY_ID.values()]
    assert np.array_equal(everything(*absent), clean)


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_ID)
def test_an_effect_of_size_0_changes_no_bit(clean, name):
    assert np.array_equal(everything(severe(BY_ID[name]).absent()), clean)


# Where the reed itself changes, finite elements take a second, and modes are tested below. More air
# changes nothing in a vacuum.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if cls.reed is not Effect.reed else ())
        for name, cls in BY_ID.items()
        if name != "air_load"
    ],
)
def test_a_severe_effect_changes_frames(clean, name):
    effect = severe(BY_ID[name])
    if name == "lost_frames":
        effect = replace(effect, probability=0.5)
    assert not np.array_equal(everything(effect), clean)


def test_there_are_forty_listed_and_fifteen_others():
    assert (len(LISTED), len(UNLISTED), len(BY_ID)) == (40, 15, 55)
    assert LEVELS["ordinary"] == 1.0
    for cls in BY_ID.values():
        for each in severe(cls).sizes().values():
            assert each["words"]
            assert each["source"]
            assert each["range"][0] < each["range"][1]


# --- Drive --------------------------------------------------------------------------------------


def level_db(*effects, volts=16.0, hz=2500.0, harmonic=1):
    """Return the motion per volt at a harmonic, against 0.1 V and no effect at f itself."""
    found = []
    for these, level in (((), 0.1), (effects, volts)):
        world, settings = world_of(*these)
        drive(settings, hz, level)
        now = world.moment(0.0, np.zeros(4))
        motion = world.motion().coordinates(world.climate(0.0), 1.0, now)
        found.append(np.linalg.norm(motion[harmonic if these else 1]) / level)
    return 20 * np.log10(found[1] / found[0])


def test_compression_lowers_loud_tones_only():
    effect = sound.TweeterCompression(3.0)
    assert level_db(effect) == pytest.approx(-3.0, abs=0.01)
    assert level_db(effect, volts=0.5) == pytest.approx(0.0, abs=0.01)
    assert -60 < level_db(effect, harmonic=3) < -10


def test_rolloff_and_resonances_change_the_response():
    assert level_db(sound.AmplifierRolloff(3.0), hz=20_000.0) == pytest.approx(-3.0, abs=0.01)
    assert abs(level_db(sound.AmplifierRolloff(3.0), hz=1500.0)) < 0.1
    line = sound.SecondAcousticResonance(6.0, 2500.0, 20.0)
    assert level_db(line) == pytest.approx(6.0, abs=0.01)
    assert abs(level_db(line, hz=1500.0)) < 0.5
    known = sound.AcousticResonance(6.0)
    assert 4 < level_db(known, hz=4308.6) < 6.5
    assert abs(level_db(known, hz=12_000.0)) < 1.0


def test_leakage_reaches_the_covered_half():
    def torsion(*effects):
        world, settings = world_of(*effects)
        drive(settings, 1500.0, 1.0)
        now = world.moment(0.0, np.zeros(4))
        moves = world.reed().vamp @ world.motion().coordinates(world.climate(0.0), 1.0, now)[1]
        rows = moves.reshape(15, 40)[:, 5]
        return abs(rows[-1] - rows[0]) / abs(rows[-1] + rows[0])

    assert torsion(sound.ChamberLeakage(0.5)) < 0.7 * torsion()


def test_clocks_turn_holograms():
    def turn(effect, time_s, hz=10_000.0):
        """Return by how much the phase turns from frame to frame, against the lock, in Hz."""
        world, settings = world_of(*effect)
        drive(settings, hz, 16.0)
        now = world.moment(time_s, time_s + (np.arange(4) + 0.5) / 12.4)
        motion = world.motion().coordinates(world.climate(0.0), 1.0, now)
        waves, _ = world.image().light(motion, world.beat(1 / 12.4, now), now)
        steps = np.vdot(waves[0], waves[1])
        return (np.angle(steps * 1j)) / (2 * np.pi) * 12.4

    base = turn((), 500.0)
    assert abs(base) < 0.02
    assert turn((clocks.SynthesizerDetuning(0.3),), 500.0) == pytest.approx(-0.3 + base, abs=0.03)
    drift = clocks.SynthesizerDrift(3.6)
    assert turn((drift,), 300.0) == pytest.approx(-0.3 + base, abs=0.03)
    assert turn((clocks.GeneratorClock(30.0),), 500.0) == pytest.approx(0.3 + base, abs=0.03)
    # The drive itself is off by as much: nothing else is.
    assert clocks.GeneratorClock(30.0).drive_hz(1e4) == pytest.approx(10_000.3)


# --- Reed ---------------------------------------------------------------------------------------


def cents(*effects, air=0.0):
    """Return by how much modes lie above those without an effect, in cents."""
    base, found = modes(air=air), modes(*effects, air=air)
    common = [name for name in base if name in found]
    return {name: 1200 * np.log2(found[name]["hz"] / base[name]["hz"]) for name in common}


def test_density_and_air_lower_all_modes():
    heavy, air = cents(cane.Density(0.1)), cents(mount.AirLoad(1.0), air=1.0)
    assert heavy["F1"] == pytest.approx(-600 * np.log2(1.1), abs=10)
    assert max(heavy.values()) < -50
    assert air["F1"] < air["F3"] < -5


def test_moduli_across_the_grain_raise_torsion():
    found = cents(cane.TransverseModulus(0.3))
    assert found["T2"] > 5 * abs(found["F1"]) > 0
    assert cents(cane.TransverseShear(0.5, 0.5))["F3"] > 5
    grown = cents(cane.ViscoelasticStiffening(0.05, 0.05))
    assert grown["F1"] < -10
    assert grown["F4"] > 10


def test_losses_follow_frequency():
    base, found = modes(), modes(cane.FrequencyDependentDamping(0.5))
    ratio = {name: found[name]["loss_factor"] / base[name]["loss_factor"] for name in ("F1", "T3")}
    assert ratio["F1"] < 0.85
    assert ratio["T3"] > 1.3


def test_thickness_changes_modes_as_plates_do():
    offset, wedge = cents(shape.ThicknessOffset(20.0)), cents(shape.ThicknessWedge(60.0))
    assert offset["T2"] > 10
    assert offset["T2"] > offset["F1"]
    assert wedge["F1"] > 20
    crown, tilt = cents(shape.ThicknessCrown(40.0)), cents(shape.ThicknessTilt(30.0))
    assert crown["F3"] > 5
    assert crown["T1"] < -10
    assert max(abs(each) for each in tilt.values()) < 60
    assert tilt != pytest.approx(cents(), abs=0.5)


def test_a_drop_on_the_tip_lowers_modes_that_move_there():
    found = cents(shape.TipMass(500.0, 0.8, 0.0))
    assert found["F1"] < -10
    assert found["F2"] < -10
    assert abs(found["T1"]) < 0.3 * abs(found["F1"])


def test_soft_clamps_lower_bending():
    both, one = cents(mount.ClampCompliance(2e-3)), cents(mount.ClampAsymmetry(2e-3, 1.0))
    assert both["F1"] < one["F1"] < -3
    other = cents(mount.ClampAsymmetry(2e-3, -1.0))
    # A reed with two equal halves does not know left from right.
    assert other["T1"] == pytest.approx(one["T1"], abs=0.2)


def test_a_crack_lowers_torsion_more_than_bending():
    found = cents(mount.ShortCrack(0.9, 10.0, 2.0, 0.5))
    assert found["T1"] < 3 * found["F1"] < 0
    deep, shallow = (cents(mount.ShortCrack(lost, 10.0, 2.0, 0.5))["T2"] for lost in (0.9, 0.3))
    assert deep < shallow < 0


def test_a_contact_raises_modes():
    found = cents(unknown_sound.ReedContact(0.05, 1.0, 0.0))
    assert found["F1"] > 10


def sides(*effects, time_s=0.0):
    """Return how far the left and the right side move far below F1, without clay, in nm."""
    world, settings = world_of(*effects, series="B")
    drive(settings, 500.0, 1.0)
    now = world.moment(time_s, np.zeros(4))
    moves = world.motion().coordinates(world.climate(0.0), 1.0, now)[1]
    rows = np.abs(world.reed().vamp @ moves).reshape(15, 40)
    return 1e6 * rows[-3, 2], 1e6 * rows[2, 2]


def test_sides_are_left_and_right():
    left, right = sides()
    assert left == pytest.approx(right, rel=1e-3)
    for effect, side in ((shape.ThicknessTilt(30.0), 1), (mount.ClampAsymmetry(2e-2, 1.0), 0)):
        found = sides(effect)
        # The thick side bends less; the side of the soft strip moves more.
        assert found[1 - side] < found[side]
    other = sides(mount.ClampAsymmetry(2e-2, -1.0))
    assert other[0] < other[1]


def test_a_creeping_reed_moves_and_yields():
    creep = unknown_sound.ClampCreep(100.0, 0.6)
    assert sides(creep, time_s=900.0)[0] > 1.005 * sides(creep)[0]
    world, _ = world_of(creep)
    plain = np.ones((4, *GEOMETRY.shape), np.complex64)
    now = world.moment(0.0, np.full(4, 900.0))
    tilted = creep.waves(plain, GEOMETRY, now)[0, 0]
    slope = np.angle(tilted[1:] * np.conj(tilted[:-1])).mean() / (2 * np.pi) / GEOMETRY.pixel_m
    assert slope * 650e-9 == pytest.approx(100e-6, rel=0.01)


def test_harmonics_of_the_generator_move_the_reed():
    found = level_db(unknown_sound.GeneratorHarmonics(0.1, 0.1), hz=2500.0, harmonic=2)
    assert -60 < found < 0
    # F2 lies near twice this frequency, and is then driven at its resonance.
    assert level_db(unknown_sound.GeneratorHarmonics(0.1, 0.1), hz=2615.0, harmonic=2) > found


def resonance_hz(*effects, volts):
    """Return where F1 peaks at a level."""
    world, settings = world_of(*effects)
    hz = 1954 * 2 ** (np.linspace(-60, 160, 45) / 1200)
    answers = []
    for each in hz:
        drive(settings, each, volts)
        now = world.moment(0.0, np.zeros(4))
        motion = world.motion().coordinates(world.climate(0.0), 1.0, now)[1]
        answers.append(np.abs(world.reed().vamp @ motion).max() / volts)
    return hz[int(np.argmax(answers))], max(answers)


def test_hardening_raises_loud_resonances_and_rattle_damps_them():
    hard = mount.HardeningNonlinearity(0.08)
    assert resonance_hz(hard, volts=2.0)[0] > 1.004 * resonance_hz(hard, volts=0.1)[0]
    rattle = unknown_sound.LigatureRattle(0.05, 0.2)
    quiet, loud = (resonance_hz(rattle, volts=volts)[1] for volts in (0.1, 2.0))
    assert loud < 0.7 * quiet


def test_warm_and_drying_reeds_change_with_time():
    reed, air = ReedParameters().cane, Climate(20.0, 0.0)
    warm = cane.TemperatureDrift(4.0).climate(air, 900.0)
    assert warm.temperature_c == pytest.approx(21.0)
    wet = [cane.Drying(2.0, 10.0).climate(air, t).moisture for t in (0.0, 600.0)]
    assert wet == pytest.approx([2.0, 2.0 / np.e])
    drier = replace(reed, moisture=0.0), replace(reed, moisture=2.0)
    young = [each.storage(1e4)[0] for each in drier]
    assert young[0] > 1.02 * young[1]
    assert drier[0].mass() < drier[1].mass()
    film = unknown_sound.WaterFilm(5.0, 2.0, 12.0)
    assert cents(film)["F1"] < -10


def test_the_tweeter_warms_and_the_knob_turns():
    for effect in (unknown_sound.TweeterWarming(0.2, 30.0), unknown_sound.AmplifierKnob(-0.3, 0.5)):
        world, settings = world_of(effect)
        drive(settings, 2500.0, 16.0)
        size = []
        for k in range(1500):
            now = world.moment(0.4 * k, np.zeros(4))
            size.append(world.cast.through("tones", {1: 16 + 0j}, now)[1].real)
        assert size[0] == pytest.approx(16.0, rel=0.01)
        left = 0.8 if effect.id == "tweeter_warming" else np.exp(-0.3)
        assert size[-1] == pytest.approx(16 * left, rel=0.01)


# --- Light --------------------------------------------------------------------------------------


def contrast(*effects, time_s=0.0, hz=2500.0, volts=0.0):
    """Return the amplitude of a hologram."""
    world, settings = world_of(*effects)
    drive(settings, hz, volts)
    return np.sqrt(np.mean(np.abs(hologram(world, time_s)) ** 2))


def test_contrast_falls():
    at_rest = contrast()
    hop = light.LaserModeHop(0.5, 0.5)
    assert contrast(hop) == pytest.approx(at_rest, rel=0.02)
    assert contrast(hop, time_s=800.0) == pytest.approx(0.5 * at_rest, rel=0.1)
    two = unknown_light.TwoLaserModes(0.6, 4.0, 0.0)
    assert contrast(two, time_s=120.0) < 0.6 * contrast(two)
    shaken, now = light.BenchVibration(0.6), world_of()[0].moment(0.0, np.zeros(4))
    assert contrast(shaken) < 0.98 * at_rest
    jitter = np.concatenate([shaken.path(np.zeros(4), now) for _ in range(200)])
    assert jitter.std() == pytest.approx(0.6, rel=0.1)
    still = contrast(light.SpeckleDecorrelation(1.5))
    assert still == pytest.approx(at_rest, rel=1e-6)
    loud = [contrast(*e, hz=2010.0, volts=2.0) for e in ((), (light.SpeckleDecorrelation(1.5),))]
    assert loud[1] < 0.97 * loud[0]


def test_power_drifts_and_corners_darken():
    world, _ = world_of(light.LaserPowerDrift(0.4))
    early, late = (frames(world, "lo_only", t).mean() - 60 for t in (0.0, 900.0))
    assert late / early == pytest.approx(1.1, abs=0.005)
    dark, _ = world_of(light.Vignetting(0.5))
    flat = frames(dark, "flat").mean(0) - 60
    corners = np.mean([flat[:4, :4].mean(), flat[-4:, -4:].mean()])
    assert corners / flat[28:36, 36:44].mean() == pytest.approx(0.53, abs=0.05)
    moved, _ = world_of(light.LoMisalignment(8.0, 0.0))
    columns = frames(moved, "lo_only").mean((0, 1)) - 60
    assert columns[-5:].mean() > 1.1 * columns[:5].mean()
    assert columns.mean() == pytest.approx(1800, rel=0.02)


@pytest.mark.parametrize(
    ("effect", "order"), [(light.CarrierLeak(0.1, 0.0), 0), (light.SidebandCrosstalk(0.1, 0.0), 2)]
)
def test_lines_of_the_reference_select_another_order(effect, order):
    world, settings = world_of(effect)
    drive(settings, 3000.3, 1.0)
    now = world.moment(0.0, (np.arange(4) + 0.5) / 12.4)
    weights = world.beat(1 / 12.4, now).weights(16)
    pure = world_of()[0]
    drive(pure.settings, 3000.3, 1.0)
    plain = pure.beat(1 / 12.4, now).weights(16)
    phases = 2 * np.pi * np.arange(16) / 16
    gains = [np.abs((weights - plain) @ np.exp(1j * n * phases)) for n in range(4)]
    assert np.argmax(np.mean(gains, 1)) == order
    assert gains[order] == pytest.approx(np.full(4, 0.09), abs=0.005)


def test_phase_steps_and_distances_are_wrong():
    odd = light.PhaseStepError(0.2).path(np.zeros(4), None)
    assert odd == pytest.approx([0, 0.2, 0, 0.2])
    geometry = world_of(light.Defocus(50.0))[0].image().geometry
    assert geometry.distance_m == pytest.approx(1.05)
    red = world_of(unknown_light.WrongWavelength(5.0))[0].image().geometry
    assert red.wavelength_m == pytest.approx(655e-9)


def test_spots_ghosts_and_turns_change_the_image():
    base = world_of()[0].image().places
    dirty = world_of(unknown_light.DirtyWindow(0.9, 10.0, 2.0, 5.0))[0].image().places
    assert np.all(dirty.lit <= base.lit)
    assert dirty.lit.min() < 0.5 * base.lit.max()
    askew = world_of(unknown_sound.ReedAskew(3.0))[0].image().places
    slope = np.polyfit(askew.u_m, askew.v_m, 1)[0]
    assert slope == pytest.approx(np.tan(np.radians(3.0)), abs=0.01)
    ghost = contrast(unknown_light.GhostReflection(0.3, 5.0, 2.0, 0.0)) / contrast()
    assert ghost == pytest.approx(np.sqrt(1.09), rel=0.05)


# --- Camera -------------------------------------------------------------------------------------


def test_frames_are_lost_and_counted_on():
    world, _ = world_of()
    now = world.moment(0.0, np.zeros(4))
    now.rng = np.random.default_rng(1)
    lost, twice = camera.LostFrames(0.4, 0.0), camera.LostFrames(0.4, 1.0)
    orders = [lost.sequence([0, 1, 2, 3], now) for _ in range(30)]
    assert all(np.all(np.diff(order) >= 1) for order in orders)
    assert any(order[-1] > 3 for order in orders)
    repeats = [twice.sequence([0, 1, 2, 3], now) for _ in range(30)]
    assert any(np.any(np.diff(order) == 0) for order in repeats)


def test_sensors_are_worse():
    base, settings = world_of()
    del settings
    dark, flat = frames(base, "dark"), frames(base, "flat")
    noisy = world_of(camera.ReadNoise(30.0))[0]
    assert frames(noisy, "dark").std() == pytest.approx(np.hypot(30, 6) / 5, rel=0.05)
    hot = world_of(camera.HotPixels(0.02))[0]
    assert np.mean(frames(hot, "dark").mean(0) > 66) == pytest.approx(0.02, abs=0.01)
    pattern = world_of(camera.FixedPatternNoise(0.1))[0]
    uneven = frames(pattern, "flat").mean(0) / flat.mean(0)
    assert uneven.std() == pytest.approx(0.1, rel=0.1)
    bent = world_of(camera.SensorNonlinearity(0.1))[0]
    ratio = (frames(bent, "flat").mean() - 60) / (flat.mean() - 60)
    assert ratio == pytest.approx(1 - 0.1 * (flat.mean() - 60) / 4000, abs=0.005)
    assert dark.mean() == pytest.approx(60, abs=0.2)


def test_codes_are_missing_and_rows_come_late():
    coded = frames(world_of(unknown_light.MissingCodes(40.0))[0], "flat")
    assert not np.any(coded % 256 >= 216)
    late, settings = world_of(unknown_light.InterlacedRows(20.0))
    plain, others = world_of()
    for each in (settings, others):
        drive(each, 0, 0)
    turned = hologram(late) * np.conj(hologram(plain))
    # A quarter of the frame rate for 20 ms.
    even, odd = (np.angle(np.sum(turned[k::2])) for k in (0, 1))
    assert even == pytest.approx(0, abs=0.05)
    assert odd == pytest.approx(-2 * np.pi * float(RATE_HZ) / 4 * 0.02, abs=0.1)


def test_slips_jump_and_stay():
    world, _ = world_of()
    now = world.moment(0.0, np.zeros(4))
    times_s = np.linspace(0, 600, 601)
    turns = unknown_light.PhaseSlips(6.0, 1.0).turns(np.zeros(601), times_s, now)
    jumps = np.diff(turns)
    assert 20 < np.count_nonzero(jumps) < 120
