"""Benches with reeds that the fit does not know."""

import pytest

from drivers.simulated.settings import bench_parameters, read_simulation
from physics.parameters.disorder import CATALOGUE
from protocols.plan import make_plan
from protocols.protocol import Protocol
from studies.wrong_reeds import wrong_bench


def test_a_bench_has_all_disorder_that_its_reed_and_light_do_not_have():
    section = wrong_bench("wrong-07", 7).twin["disorder"]
    left_out = {kind.name for kind in CATALOGUE} - set(section)
    assert {"gain_scatter", "path_step", "thickness_map", "density"} <= left_out
    assert {"shear_loss", "lag", "speckle_renewal", "frame_jitter"} <= set(section)


def test_a_bench_plays_the_disorder_that_it_has():
    bench = wrong_bench("wrong-07", 7)
    preparation = make_plan(Protocol.from_file("quick"), bench).preparation("wrong-07")
    played = bench_parameters(read_simulation(bench.twin, bench.name), bench, preparation)
    section = bench.twin["disorder"]
    assert played.sensor.lag == pytest.approx(section["lag"])
    assert played.reed.shear_loss_log == pytest.approx(section["shear_loss"])
    assert played.chamber.rail_leak == pytest.approx(section["rail_leak"])


def test_other_seeds_make_other_benches():
    one, other = (wrong_bench("wrong-07", seed).twin["disorder"] for seed in (7, 8))
    assert one["lag"] != other["lag"]
