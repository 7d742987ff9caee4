"""Small worlds of the second laboratory for tests."""

from dataclasses import fields, replace
from fractions import Fraction

import numpy as np

from studies.second_laboratory.campaigns.case import Case, Setup, setup_of
from studies.second_laboratory.campaigns.drawing import CampaignBench, Clamping, Day
from studies.second_laboratory.campaigns.truth import modes_of
from studies.second_laboratory.campaigns.world import World
from studies.second_laboratory.laboratory import Settings
from studies.second_laboratory.light import Geometry
from studies.second_laboratory.parameters import Clamp, ReedParameters
from studies.second_laboratory.shape import Fineness

# Few elements: what is tested here does not depend on their number.
COARSE = Fineness(6.0, 2.1, 0.5, 6.0, 2, 2, (0.0, 1.0), 2, 2)
CENTRE_HZ, RATE_HZ = Fraction(80_000_000), Fraction("12.4")
PERIOD_S = float(1 / RATE_HZ)
GEOMETRY = Geometry((64, 80), 6.7e-6, 650e-9, 1.0)
REED = ReedParameters(clamp=Clamp(bed_n_per_mm3=8000.0))


def case_of(*effects, series="A", amount=1.0):
    kinds = {0: "clean", 1: "single"}
    return Case(kinds.get(len(effects), "pair"), effects, amount, series, 7, 0)


def world_of(*effects, still=True, bench=None, series="A", repeat=0, air=0.0):
    """Return a world and its settings; `still` is a bench without disorder.

    Without air, which takes half of the time, unless it is asked for.
    """
    case = case_of(*effects, series=series)
    setup = setup_of(case, repeat)
    setup = replace(setup, day=replace(setup.day, air=air))
    if still:
        setup = Setup(case, repeat, bench or CampaignBench(), REED, Day(air=air))
    settings = Settings(CENTRE_HZ, CENTRE_HZ, rf=True)
    world = World(setup, GEOMETRY, (0.0, 0.0), settings, COARSE)
    if still:
        world.clamping = Clamping()
    return world, settings


def drive(settings, hz, volts):
    """Play a sine, and lock the synthesizers to its first sideband."""
    settings.drive_hz, settings.volts = Fraction(round(10 * hz), 10), volts
    settings.sounding = volts > 0
    order = int(volts > 0)
    settings.aom1_hz = CENTRE_HZ + order * settings.drive_hz + RATE_HZ / 4


def frames(world, scene="holograms", time_s=0.0, exposure_s=PERIOD_S):
    """Return four frames of a scene as numbers."""
    world.arrange(scene)
    starts = [time_s + k * PERIOD_S for k in range(4)]
    return np.array(world.expose(starts, exposure_s), float)


def hologram(world, time_s=0.0):
    """Return the demodulated frames of the vibrating reed."""
    i = frames(world, time_s=time_s)
    return i[0] - i[2] + 1j * (i[1] - i[3])


def modes(*effects, time_s=0.0, **more):
    """Return frequency and loss factor of modes by name."""
    world, _ = world_of(*effects, **more)
    return modes_of(world.motion(), world.climate(time_s), world.cast)


def severe(cls, seed=3):
    """Return an effect at the severe end of its sizes."""
    effect = cls.draw(np.random.default_rng(seed))
    sizes = {
        each.name: each.metadata["range"][1]
        for each in fields(effect)
        if each.metadata["law"] != "even"
    }
    return replace(effect, **sizes)
