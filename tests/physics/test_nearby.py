"""Modes of a reed that are sought from those of a reed near it: the same as from nothing."""

from dataclasses import replace

import numpy as np
import pytest

from physics.alterations import Layer, MovedClamp, YieldingClamp
from physics.mechanics import CaneShift, Mechanics, ReedSolver
from physics.reed.nearby import NearbyModes, modes_below
from physics.reed.reduced.dynamics import State
from physics.reed.reduced.vibrations import vibrations

HIGHEST_HZ = 24e3
SOFT = (YieldingClamp(), 1e-13)
KNOWN = Mechanics(alterations=(SOFT,))
OTHERS = {
    "itself": KNOWN,
    "cane": replace(KNOWN, shift=CaneShift(E_L=0.06, G_LT=-0.05, E_T=0.1, growth_G_LT=0.1)),
    "density": replace(KNOWN, shift=CaneShift(density=0.1)),
    "layers": replace(KNOWN, alterations=(SOFT, (Layer(1, 0), 3e-6), (Layer(2, 2), -2e-6))),
    "softer clamp": replace(KNOWN, alterations=(SOFT, (YieldingClamp(), 3e-14))),
    "moved clamp": replace(KNOWN, alterations=(SOFT, (MovedClamp(), 1e-4))),
    "less air": replace(KNOWN, air_share=0.7),
}


@pytest.fixture(scope="module")
def solver(coarse_reed) -> ReedSolver:
    return ReedSolver(coarse_reed)


@pytest.fixture(scope="module")
def nearby(solver: ReedSolver) -> NearbyModes:
    return NearbyModes(solver.reed, solver.state(KNOWN), HIGHEST_HZ)


@pytest.mark.parametrize("name", OTHERS)
def test_modes_are_those_that_are_found_from_nothing(solver, nearby, name: str) -> None:
    state: State = solver.state(OTHERS[name])
    found, expected = nearby.modes(state), vibrations(solver.reed, state, HIGHEST_HZ)
    assert found is not None
    # From nothing, frequencies are exact to 2e-4 cents, and shapes to the root of that.
    np.testing.assert_allclose(found.hz, expected.hz, rtol=3e-7)
    signs = np.sign(np.sum(found.coordinates * expected.coordinates, axis=0))
    apart = np.abs(found.coordinates * signs - expected.coordinates).max(axis=0)
    assert np.all(apart < 2e-3 * np.abs(expected.coordinates).max(axis=0))


def test_differences_are_smooth(solver, nearby) -> None:
    """Modes solve the problem so exactly that differences over small steps are derivatives."""

    def log_hz(step: float) -> np.ndarray:
        reed = replace(KNOWN, shift=CaneShift(E_L=step))
        return np.log(nearby.modes(solver.state(reed)).hz)

    half, whole = ((log_hz(s) - log_hz(-s)) / (2 * s) for s in (5e-4, 1e-3))
    np.testing.assert_allclose(half, whole, atol=1e-5)


@pytest.mark.parametrize(
    "alteration", [(Layer(0, 1), 3e-6), (YieldingClamp(side=1), 1e-13)], ids=["tilt", "one side"]
)
def test_a_reed_of_other_parts_is_not_near(solver, nearby, alteration) -> None:
    """What couples parts, or lets the strips move otherwise, is solved for from nothing."""
    reed = replace(KNOWN, alterations=(SOFT, alteration))
    assert nearby.modes(solver.state(reed)) is None
    apart = solver.modes(reed)
    again = ReedSolver(solver.reed).modes(replace(reed, near=KNOWN))
    assert {name: mode.hz for name, mode in again.items()} == {n: m.hz for n, m in apart.items()}


def test_far_reeds_have_all_modes_once_or_are_not_near(solver, nearby) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        E_L, G_LT, E_T, G_LR, density = rng.normal(0, 0.3, 5)
        shift = CaneShift(E_L=E_L, G_LT=G_LT, E_T=E_T, G_LR=G_LR, density=density)
        state = solver.state(replace(KNOWN, shift=shift))
        found = nearby.modes(state)
        if found is not None:
            expected = vibrations(solver.reed, state, HIGHEST_HZ)
            np.testing.assert_allclose(found.hz, expected.hz, rtol=3e-7)


def test_a_reed_that_first_order_throws_far_away_is_not_near(solver, nearby) -> None:
    """Without overflow, which would be a warning."""
    for E_L in (6.0, 30.0, 200.0):
        state = solver.state(replace(KNOWN, shift=CaneShift(E_L=E_L)))
        assert nearby.modes(state) is None


def test_modes_below_a_frequency_are_counted(solver) -> None:
    found = vibrations(solver.reed, solver.state(KNOWN), HIGHEST_HZ)
    for group in found.groups:
        for number, hz in enumerate(group.hz.tolist()):
            assert modes_below(group.dynamics, hz * (1 - 1e-5)) == number
            assert modes_below(group.dynamics, hz * (1 + 1e-5)) == number + 1


def test_a_hint_changes_no_name_and_no_loss(solver) -> None:
    reed = replace(OTHERS["cane"], shear_loss_log=0.4, loss_growth=0.1, coarse_share=0.0)
    apart, near = solver.modes(reed), ReedSolver(solver.reed).modes(replace(reed, near=KNOWN))
    assert list(near) == list(apart)
    for name, mode in apart.items():
        assert near[name].hz == pytest.approx(mode.hz, rel=3e-7)
        assert near[name].loss_factor == pytest.approx(mode.loss_factor, rel=1e-4)
    assert replace(reed, near=KNOWN) == reed
