"""Scenes, hands and slow drifts of the second laboratory's campaigns."""

from dataclasses import replace

import numpy as np
import pytest

from studies.second_laboratory.campaigns.climate import Climate, Wander
from studies.second_laboratory.campaigns.disorder import CampaignDisorder, disorder_at
from studies.second_laboratory.campaigns.drawing import (
    CampaignBench,
    HandParameters,
    LampParameters,
    SensorParameters,
)
from studies.second_laboratory.campaigns.effects.base import Cast, Moment
from studies.second_laboratory.campaigns.image import Beat
from studies.second_laboratory.campaigns.truth import modes_of
from studies.second_laboratory.light import exposure_weights, vibration_samples
from studies.second_laboratory.parameters import Disorder
from tests.studies.second_worlds import PERIOD_S, drive, frames, hologram, modes, world_of

QUIET = SensorParameters(read_noise_e=5.0)


def test_dark_frames_show_offset_noise_and_hot_pixels():
    sensor = replace(QUIET, dark_current_e_s=100.0, hot_share=0.02, offset_dn=63.0)
    world, _ = world_of(bench=CampaignBench(sensor=sensor))
    dark = frames(world, "dark")
    # 100 e/s for 80 ms are 8 e of 5 e/dn, and of their logarithm's spread 5 % more.
    assert np.median(dark) == pytest.approx(63 + 8 / 5, abs=0.5)
    hot = dark.mean(0) > 63 + 5 * 1.5
    assert np.mean(hot) == pytest.approx(0.02, abs=0.01)
    # Pixels are hot in all frames, and more so in longer exposures.
    short = frames(world, "dark", 5.0, PERIOD_S / 4)
    assert np.mean(short[:, hot]) - 63 < 0.35 * (np.mean(dark[:, hot]) - 63)
    cold = dark[:, ~hot]
    assert np.std(cold[0] - cold[1]) == pytest.approx(np.sqrt(2 * (33 / 25 + 1 / 12)), rel=0.1)


def test_flat_frames_follow_exposure_flicker_and_slope():
    lamp = LampParameters(rate_e_s=150_000.0, slope=(0.0, 0.05), flicker=0.01)
    world, _ = world_of(bench=CampaignBench(lamp=lamp, sensor=QUIET))
    long = np.array([frames(world, "flat", t, 0.08) for t in range(40)])
    short = frames(world, "flat", 50.0, 0.02) - 60
    assert np.mean(long - 60) == pytest.approx(4 * np.mean(short), rel=0.01)
    level = long.mean((2, 3)).ravel()
    assert np.std(level) / np.mean(level) == pytest.approx(0.01, rel=0.3)
    columns = long.mean((0, 1, 2)) - 60
    assert columns[-8:].mean() / columns[:8].mean() == pytest.approx(1.09, abs=0.02)


def test_beams_add_up():
    world, settings = world_of()
    drive(settings, 0, 0)
    bench = CampaignBench()
    alone, objects, both = (
        frames(world, scene).mean() - 60 for scene in ("lo_only", "object_only", "holograms")
    )
    level_dn = bench.beams.reference_e / bench.sensor.electrons_per_dn
    assert alone == pytest.approx(level_dn, rel=0.01)
    # The object's light is as uneven as speckle.
    assert objects == pytest.approx(level_dn * bench.beams.object_share, rel=0.2)
    assert both == pytest.approx(alone + objects, rel=0.02)
    settings.rf = False
    assert frames(world, "lo_only", 5.0).mean() == pytest.approx(60, abs=0.1)


def test_hands_need_minutes():
    world, _ = world_of()
    waits = [world.arrange(scene) for scene in ("dark", "flat", "flat")]
    assert waits[1] > waits[0] > waits[2] > 1
    assert 100 < world.clamp_again(10.0) < 400


def test_a_new_clamping_is_near_the_old_one_with_another_speckle():
    bench = CampaignBench(hands=HandParameters(front_mm=0.1, bed=0.1, lateral_mm=0.1, place_mm=0.1))
    world, settings = world_of(bench=bench)
    drive(settings, 0, 0)
    before, again = [], []
    for kept in (before, again):
        kept += [hologram(world), hologram(world, time_s=2.0)]
        kept.append(modes_of(world.motion(), world.climate(0.0), world.cast))
        world.clamp_again(5.0)

    def similar(a, b):
        return abs(np.vdot(a, b)) / np.linalg.norm(a) / np.linalg.norm(b)

    # The reed itself stays as it is between acquisitions.
    assert similar(before[0], before[1]) > 0.9
    assert similar(before[0], again[0]) < 0.1
    cents = [1200 * np.log2(again[2][name]["hz"] / before[2][name]["hz"]) for name in ("F1", "T1")]
    assert 0.01 < np.abs(cents).max() < 40


def test_repeats_share_the_camera_but_not_the_day():
    first, second = (world_of(still=False, repeat=repeat)[0] for repeat in (0, 1))
    assert first.clamping != second.clamping
    assert first.climate(0.0) != second.climate(0.0)
    assert first.reed_parameters().thickness == second.reed_parameters().thickness
    flat = [np.mean([frames(w, "flat", t) for t in range(20)], (0, 1)) for w in (first, second)]
    rough = [each / np.mean(each) - 1 for each in flat]
    assert np.corrcoef(rough[0].ravel(), rough[1].ravel())[0, 1] > 0.7


def test_what_wanders_forgets_slowly():
    rng = np.random.default_rng(5)
    walks = [Wander(rng, 2.0, 600.0) for _ in range(300)]
    at = np.array([[walk(t) for t in (100.0, 160.0, 3000.0)] for walk in walks])
    assert at.std() == pytest.approx(2.0, rel=0.1)
    near, far = (np.corrcoef(at[:, 0], at[:, k])[0, 1] for k in (1, 2))
    assert near == pytest.approx(np.exp(-0.1), abs=0.05)
    assert abs(far) < 0.2


def test_frequencies_follow_temperature_without_new_elements():
    world, _ = world_of(still=False)
    motion, cast = world.motion(), Cast((), (1,))
    cold, warm = (modes_of(motion, Climate(c, 0.0), cast) for c in (20.0, 22.0))
    per_kelvin = world.reed_parameters().cane.per_kelvin
    # The bed does not soften, and the air is thinner: a part of the root of the moduli.
    shift = warm["F1"]["hz"] / cold["F1"]["hz"] - 1
    assert 1.1 * per_kelvin < shift < 0.6 * per_kelvin


def test_fast_light_is_that_of_all_phases():
    world, settings = world_of()
    drive(settings, 2400.0, 2.0)
    now = world.moment(0.0, PERIOD_S * (np.arange(4) + 0.5))
    motion = world.motion().coordinates(world.climate(0.0), 1.0, now)
    image = world.image()
    hz, lines = float(settings.drive_hz), [(0, 1 + 0j)]
    beat_hz = float(settings.aom1_hz - settings.aom2_hz)
    none = np.zeros(4)
    beat = Beat(hz, beat_hz, now.middles_s, PERIOD_S, none, none, lines)
    waves, own = image.light(motion, beat, now)
    # Each phase of the vibration as a reed at rest, whose light beats at no frequency.
    still = Beat(0.0, 0.0, np.zeros(1), PERIOD_S, none[:1], none[:1], lines)
    samples = 4 * vibration_samples(8.0)
    turns = np.exp(2j * np.pi * np.arange(samples) / samples)
    held = [{0: np.real(motion[1] * turn) + 0j} for turn in turns]
    slow = np.array([image.light(each, still, now)[0][0] for each in held])
    starts = now.middles_s - PERIOD_S / 2
    direct = np.tensordot(exposure_weights(hz, beat_hz, starts, PERIOD_S, samples), slow, 1)
    assert np.linalg.norm(waves - direct) < 2e-3 * np.linalg.norm(direct)
    mean = np.mean(np.abs(slow) ** 2, 0)
    assert own.mean() == pytest.approx(mean.mean(), rel=0.02)
    assert np.corrcoef(own.ravel(), mean.ravel())[0, 1] > 0.8


def test_levels_scale_what_a_laboratory_decides():
    plain, half = disorder_at(1.0), disorder_at(0.25)
    assert plain == (Disorder(), CampaignDisorder())
    for name, factor in (("density", 1.0), ("temperature", 0.25), ("uniformity", 0.5)):
        ratio = getattr(half[0], name).high / getattr(plain[0], name).high
        assert ratio == pytest.approx(factor)
    assert half[1].power_wander.high == pytest.approx(0.25 * plain[1].power_wander.high)


def test_moments_know_what_is_played():
    world, settings = world_of()
    drive(settings, 2000.0, 3.0)
    now = world.moment(1.0, np.zeros(4))
    assert isinstance(now, Moment)
    assert (now.drive_hz, now.volts, now.clay) == (2000.0, 3.0, True)
    settings.sounding = False
    assert world.moment(1.0, np.zeros(4)).volts == 0


def test_modes_have_names_and_losses():
    found = modes()
    assert {"F1", "T1", "F2", "T2", "X1"} <= found.keys()
    assert 0.015 < found["F1"]["loss_factor"] < 0.03
