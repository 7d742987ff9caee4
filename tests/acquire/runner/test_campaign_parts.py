"""Shutters, lamp and clamp that a bench operates by itself, before a run and when it goes on."""

from types import SimpleNamespace

import numpy as np
import pytest

import acquire
from acquire.runner.campaign_parts import BenchPreparation, PartState, PlannedPart
from acquire.runner.orders import Orders
from protocols.campaign import CampaignPart, Task
from runs.reader import Run

DARK = {"keep": "frames", "calibration": {"kind": "dark", "count": 1}}


class Surroundings:
    def __init__(self, orders=None):
        self.log, self._orders = [], orders

    def arrange(self, arrangement):
        self.log.append(str(arrangement))
        if self._orders is not None:
            self._orders.interrupt()
            self.log.append("waits on")
            self._orders.interrupt()
            self.log.append("not reached")

    def clamp_again(self):
        self.log.append("clamp")


class Motor(Surroundings):
    stays_clamped = True


def part_of(plan, tmp_path, new_clamping=True):
    part = CampaignPart(name="again", new_clamping=new_clamping)
    return PlannedPart(Task(part, plan.protocol, 1), plan, tmp_path / "again.h5")


def prepared(surroundings, part, state, orders=None):
    """Prepare a part; return what the bench has done."""
    bench = SimpleNamespace(surroundings=surroundings)
    BenchPreparation(bench, pytest.fail, orders or Orders()).prepare(part, state)
    return surroundings.log


@pytest.mark.parametrize("state", PartState)
def test_a_bench_that_forgets_clampings_repeats_them(tiny_plan, tmp_path, state):
    part = part_of(tiny_plan(), tmp_path)
    assert prepared(Surroundings(), part, state) == ["clamp", "holograms"]


@pytest.mark.parametrize("state", PartState)
def test_a_reed_that_stays_clamped_is_clamped_again_once_only(tiny_plan, tmp_path, state):
    part = part_of(tiny_plan(), tmp_path)
    expected = ["clamp", "holograms"] if state is PartState.NEW else ["holograms"]
    assert prepared(Motor(), part, state) == expected


def test_shutters_that_never_move_are_given_up_at_the_second_order(tiny_plan, tmp_path):
    orders = Orders()
    surroundings = Surroundings(orders)
    part = part_of(tiny_plan(), tmp_path, new_clamping=False)
    with pytest.raises(KeyboardInterrupt):
        prepared(surroundings, part, PartState.NEW, orders)
    assert surroundings.log == ["holograms", "waits on"]
    assert orders.stopped


def test_a_dark_run_without_a_campaign_is_dark(small_plan, tmp_path):
    """A simulated bench closes its shutters by itself, as in a campaign."""
    dark = acquire.run(small_plan(DARK), tmp_path / "dark.h5")
    lit = acquire.run(
        small_plan({**DARK, "calibration": {"kind": "order0", "count": 1}}), tmp_path / "lit.h5"
    )
    means = []
    for measured in (dark, lit):
        with Run.open(measured.path) as run:
            means.append(float(np.mean(run.frames(0))))
    assert means[0] == pytest.approx(50, abs=1)
    assert means[1] > 500
