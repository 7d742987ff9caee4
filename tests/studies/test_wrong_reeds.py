"""Benches with reeds that the fit does not know."""

import numpy as np
import pytest

from drivers.simulated.settings import bench_parameters, read_simulation
from physics.parameters.disorder import CATALOGUE
from physics.reed.cane.viscoelastic import Series
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from studies.wrong_reeds import truth_of, wrong_bench


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


def test_the_truth_has_the_loss_of_shear_that_the_bench_plays():
    """A mode of torsion is mostly shear, F1 hardly; frequencies are those without loss."""

    def truth(shear_loss):
        twin = {"mesh": "coarse", "disorder": {"shear_loss": shear_loss}}
        return truth_of(BenchFile.from_file().replace({"twin": twin}), "R07", Series.A)["modes"]

    equal, more = truth(0.0), truth(0.5)
    ratio = {name: more[name]["loss_factor"] / equal[name]["loss_factor"] for name in ("F1", "T1")}
    assert 1 < ratio["F1"] < 1.2 < ratio["T1"] < np.exp(0.5)
    assert more["T1"]["hz"] == equal["T1"]["hz"]
