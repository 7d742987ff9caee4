"""Plausible reeds: their modes are those of the full reduced reed, and so are derivatives."""

import numpy as np
import pytest
from scipy import stats

from physics.alterations import BED_SHEAR_SPREAD, Layer, MovedClamp, unit_change
from physics.mechanics import CaneShift, cane_law
from physics.parameters.disorder import BY_NAME
from physics.plausible.reeds import PlausibleReeds
from physics.plausible.surfaces import ThicknessFunctions
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.mode_classification import names_of
from physics.reed.reduced.changes import BED_SHEAR, combined, layer, yielding_clamp
from physics.reed.reduced.dynamics import State
from physics.reed.reduced.elastic import all_descriptors
from physics.reed.reduced.vibrations import vibrations

CONSTANTS = ("E_T", "E_R", "G_LR", "G_TR", "density", "nu_LT", "nu_LR", "nu_TR")
# Parameters of the air at which it is that of a free plate, and of a reed in a wide wall.
FREE, WALL = -9.0, 9.0


@pytest.fixture(scope="module")
def reeds(reed):
    return PlausibleReeds.of(reed, Series.A)


def drawn(reeds, seed):
    """Draw the parameters of a reed whose modes are not shifted."""
    parameters = np.random.default_rng(seed).standard_normal(len(reeds.names))
    parameters[reeds.shifts] = 0.0
    return parameters


def deviation(name):
    known = BY_NAME[name].ordinary
    return (known.high - known.low) / np.sqrt(12)


def state_of(reeds, parameters, air_fraction=1.0):
    """The same reed as a state of the full reduced reed, with all changes in it."""
    value, reed = dict(zip(reeds.names, parameters.tolist(), strict=True)), reeds.reed
    known = BY_NAME["thickness_map"].ordinary
    rms_m = np.sqrt((known.low**2 + known.low * known.high + known.high**2) / 3)
    functions = ThicknessFunctions.of(reed.geometry, 8e-3, 4e-3)
    amounts = [value[f"thickness {k + 1}"] for k in range(len(functions.pairs))]

    def thickness(x, y):
        return rms_m * np.tensordot(amounts, functions.at(x, y), axes=1)

    changes = [(1.0, layer(reed, thickness))]
    for name, kind in (
        ("thickness_slope", Layer(0, 1)),
        ("clamp_shift", MovedClamp()),
        ("clamp_tilt", MovedClamp(tilted=True)),
    ):
        changes.append((deviation(name) * value[name], unit_change(reed, kind)))
    compliance = stats.halfnorm.ppf(stats.norm.cdf(value["clamp_compliance"]), scale=2e-13)
    along = BED_SHEAR * np.exp(BED_SHEAR_SPREAD * value["bed_shear"])
    changes.append((1.0, yielding_clamp(reed, compliance, compliance, along=along)))
    cane = viscoelastic_cane(Components(value["e1"], value["e2"], value["e3"]), Series.A)
    shift = CaneShift(**{name: deviation(name) * value[name] for name in CONSTANTS})
    return State(cane_law(reed.cane, cane, shift), combined(changes), reed.air, air_fraction)


def cents(hz, other):
    return 1200 * np.log2(hz / other)


@pytest.mark.parametrize("seed", [0, 1])
def test_modes_are_those_of_the_full_reduced_reed(reeds, seed):
    """Changes of thickness and clamp move them by up to 40 cents, and mix close ones.

    Names are compared in a clamp that hardly yields: near a crossing, cents decide them.
    """
    parameters = drawn(reeds, seed)
    parameters[reeds.names.index("air")] = FREE
    hz, _ = reeds.near(parameters).modes(parameters)
    full = vibrations(reeds.reed, state_of(reeds, parameters), 20e3)
    assert cents(hz[: len(full.hz)], full.hz) == pytest.approx(np.zeros(len(full.hz)), abs=3)
    parameters[reeds.clamp] = -1.0
    nearby = reeds.near(parameters)
    full = vibrations(reeds.reed, state_of(reeds, parameters), 20e3)
    descriptors = nearby.descriptors(nearby.modes(parameters)[1])
    names = [naming.name for naming in names_of(descriptors)][: len(full.hz)]
    assert names == [n.name for n in names_of(all_descriptors(reeds.reed, full.coordinates))]


def test_air_lowers_modes_as_that_around_the_full_reed(reeds):
    parameters, found = np.zeros(len(reeds.names)), []
    for air, fraction in ((FREE, 1.0), (WALL, 2.0)):
        parameters[reeds.names.index("air")] = air
        hz, _ = reeds.near(parameters).modes(parameters)
        full = vibrations(reeds.reed, state_of(reeds, parameters, fraction), 20e3)
        assert cents(hz[: len(full.hz)], full.hz) == pytest.approx(np.zeros(len(full.hz)), abs=3)
        found.append(hz)
    # Free air lowers F1 by 42 cents (decision 0026), and twice as much by as much again.
    assert cents(found[1], found[0])[0] == pytest.approx(-42, abs=4)


def test_slopes_are_those_of_differences(reeds):
    parameters, step = drawn(reeds, 2), 1e-4
    nearby = reeds.near(parameters)
    by_ln_hz, by_mixing = nearby.slopes(parameters)
    _, mixing = nearby.modes(parameters)
    for number in range(len(parameters)):
        both = []
        for side in (-1, 1):
            moved = parameters.copy()
            moved[number] += side * step
            hz, turned = nearby.modes(moved)
            both.append((np.log(hz), turned * np.sign(np.sum(turned * mixing, axis=0))))
        (low, before), (high, after) = both
        assert by_ln_hz[:, number] == pytest.approx((high - low) / (2 * step), rel=1e-3, abs=2e-6)
        # The mass of a shape is kept to first order only: what it gains in length does not count.
        found = (after - before) / (2 * step) * np.sign(np.sum(before * mixing, axis=0))
        found -= mixing * np.sum(found * mixing, axis=0) / np.sum(mixing**2, axis=0)
        own = by_mixing[..., number]
        own = own - mixing * np.sum(own * mixing, axis=0) / np.sum(mixing**2, axis=0)
        assert own[:, :12] == pytest.approx(found[:, :12], rel=0.05, abs=2e-3)


@pytest.mark.parametrize("name", ["e1", "clamp_compliance", "bed_shear"])
def test_what_acts_exactly_has_the_derivative_of_reeds_that_are_solved_again(reeds, name):
    """Of cane and clamp: a reed near one, to first order, is the one that is set up there."""
    parameters, step = drawn(reeds, 2), 1e-3
    own, number = reeds.near(parameters), reeds.names.index(name)
    ends = []
    for side in (-1, 1):
        moved = parameters.copy()
        moved[number] += side * step
        ends.append(np.log(reeds.near(moved).modes(moved)[0][:12]))
    slope = (ends[1] - ends[0]) / (2 * step)
    assert np.abs(slope).max() > 1e-3
    assert own.slopes(parameters)[0][:12, number] == pytest.approx(slope, rel=0.02, abs=3e-5)


def test_a_shift_moves_a_mode_that_no_other_is_close_to(reeds):
    parameters = np.zeros(len(reeds.names))
    nearby = reeds.near(parameters)
    before, _ = nearby.modes(parameters)
    parameters[reeds.shifts.start] = 10.0
    after, _ = nearby.modes(parameters)
    moved = cents(after, before)
    assert moved[0] == pytest.approx(10, abs=0.1)
    assert moved[1:] == pytest.approx(np.zeros(len(moved) - 1), abs=0.5)


def crossing(reeds, beyond_cents):
    """Parameters of a reed whose modes F2 and T2, of two parts, are beyond their crossing."""
    parameters = np.zeros(len(reeds.names))
    nearby = reeds.near(parameters)
    hz, mixing = nearby.modes(parameters)
    names = [n.name for n in names_of(nearby.descriptors(mixing))]
    lower, upper = names.index("T1"), names.index("F2")
    assert reeds.parts[lower] != reeds.parts[upper]
    shift = 0.5 * (cents(hz[upper], hz[lower]) + beyond_cents)
    first = reeds.shifts.start
    parameters[first + lower], parameters[first + upper] = shift, -shift
    return nearby, parameters, lower, upper


@pytest.mark.parametrize("beyond_cents", [-5.0, 5.0])
def test_modes_that_hardly_couple_keep_their_numbers_where_they_cross(reeds, beyond_cents):
    nearby, parameters, lower, upper = crossing(reeds, beyond_cents)
    hz, mixing = nearby.modes(parameters)
    assert cents(hz[lower], hz[upper]) == pytest.approx(beyond_cents, abs=2.0)
    assert np.all(np.diag(mixing)[[lower, upper]] ** 2 > 0.9)
    assert np.all(np.diff(np.delete(hz, [lower, upper])) > 0)
    # Each derivative is that of the mode with that number.
    by_ln_hz, _ = nearby.slopes(parameters)
    own = by_ln_hz[[lower, upper], reeds.shifts.start + np.array([lower, upper])]
    assert own == pytest.approx(np.log(2) / 1200 * np.ones(2), rel=0.1)


def test_modes_are_found_again_near_a_reed_that_has_them_in_another_order(reeds):
    """In cane of little viscosity more modes than one pair have another order."""
    other = np.zeros(len(reeds.names))
    other[:3] = -0.5, 1.7, 3.5
    one, two = reeds.near(0.5 * other), reeds.near(other)
    number = one.numbers_in(two, other)
    shapes = [each.turned @ each.modes(other)[1] for each in (one, two)]
    found = np.flatnonzero(number >= 0)
    overlap = np.sum(shapes[0][:, found] * shapes[1][:, number[found]], axis=0) ** 2
    # More than half: no other mode has as much.
    assert np.all(overlap[:12] > 0.5)
    assert not np.array_equal(number[:12], np.arange(12))
    assert len(set(number[found])) == len(found)


def test_characters_of_x1_and_l1_repel_each_other(reeds):
    """Where they would cross, both modes have both characters, 100 cents apart.

    In a clamp that hardly yields.
    """
    parameters = np.zeros(len(reeds.names))
    parameters[reeds.clamp] = -3.0
    nearby = reeds.near(parameters)
    names = [n.name for n in names_of(nearby.descriptors(nearby.modes(parameters)[1]))]
    lower, upper = names.index("X1"), names.index("L1")
    first, apart, outside = reeds.shifts.start, [], []
    for shift in np.arange(0.0, 200.0, 10.0):
        parameters[first + lower], parameters[first + upper] = shift, -shift
        hz, mixing = nearby.modes(parameters)
        apart.append(cents(hz[upper], hz[lower]))
        outside.append(names_of(nearby.descriptors(mixing))[lower].outside)
    closest = int(np.argmin(apart))
    assert 80 < apart[closest] < 140
    assert outside[0] < 0.2 < 0.35 < outside[closest] < 0.65 < 0.8 < outside[-1]


def test_thickness_functions_make_up_a_surface_with_its_correlation(reed):
    functions = ThicknessFunctions.of(reed.geometry, 8e-3, 4e-3)
    x, y = np.array([12e-3, 16e-3, 16e-3]), np.array([0.0, 0.0, 2e-3])
    correlation = functions.at(x, y).T @ functions.at(x, y)
    expected = np.exp(
        -(np.subtract.outer(x, x) ** 2) / 8e-3**2 - np.subtract.outer(y, y) ** 2 / 4e-3**2
    )
    assert correlation == pytest.approx(expected, abs=0.08)
    assert 15 < len(functions.pairs) < 30
