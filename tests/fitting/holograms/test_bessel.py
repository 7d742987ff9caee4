"""Tables of Bessel functions against scipy, near zero, between entries and beyond their end."""

import numpy as np
import pytest
from scipy.special import j1, jv, jvp

from fitting.holograms.bessel import BesselTable, SidebandTable

# What the tables' docstrings promise.
ERROR = 3e-6
ORDERS = (0, 1, 2, 5)


@pytest.fixture(scope="module")
def table():
    return BesselTable()


@pytest.fixture(scope="module")
def phi():
    """Phases over the whole table, as single precision, and many where J₁ is steep."""
    rng = np.random.default_rng(2)
    spread = np.concatenate([rng.uniform(0, 200, 100_000), rng.uniform(0, 3, 20_000)])
    return spread.astype(np.float32)


@pytest.mark.parametrize("order", ORDERS)
def test_value_and_slope_are_as_exact_as_promised(order, phi):
    value, slope = SidebandTable(order)(phi)
    exact = phi.astype(float)
    assert np.abs(value - jv(order, exact)).max() < ERROR
    assert np.abs(slope - jvp(order, exact)).max() < ERROR


@pytest.mark.parametrize("order", ORDERS)
def test_value_and_slope_at_zero_are_exact(order):
    value, slope = SidebandTable(order)(np.zeros(1, np.float32))
    assert (value[0], slope[0]) == (order == 0, 0.5 * (order == 1))


def test_the_ratio_is_as_exact_as_promised(table, phi):
    exact = phi.astype(float)
    assert np.abs(table.over_argument(phi) - j1(exact) / exact).max() < ERROR


def test_the_tensor_is_ratio_and_bend_as_exact_as_promised(table, phi):
    ratio, bend = table.tensor(phi)
    exact = phi.astype(float)
    assert np.array_equal(ratio, table.over_argument(phi))
    assert np.abs(bend + jv(2, exact) / exact**2).max() < ERROR
    assert table.tensor(np.zeros(1, np.float32))[1][0] == -1 / 8


def test_the_ratio_is_a_half_at_zero_and_near_it(table):
    phi = np.concatenate([[0.0], np.geomspace(1e-30, 2e-3, 400)]).astype(np.float32)
    ratio = table.over_argument(phi)
    assert ratio[0] == 0.5
    # J₁(φ)/φ = ½ − φ²/16: the error is relative, because the ratio alone sets a block amplitude.
    assert ratio == pytest.approx(0.5 - phi.astype(float) ** 2 / 16, rel=5e-6)


def test_the_ratio_has_no_step(table):
    """Neighbours differ by less than what the table promises anyway."""
    phi = np.linspace(1e-5, 2e-2, 20_000, dtype=np.float32)
    assert np.abs(np.diff(table.over_argument(phi))).max() < ERROR


def test_value_and_slope_are_continuous_at_the_entries():
    entries = np.arange(1, 39_000, 7) / 200
    table = SidebandTable(1)
    below, above = (table((entries + step).astype(np.float32)) for step in (-2e-5, 2e-5))
    for there, here in zip(below, above, strict=True):
        # 4·10⁻⁵ rad apart, and a phase of 200 rad is kept to 10⁻⁵.
        assert np.abs(there - here).max() < 5e-5


@pytest.mark.parametrize(("largest", "per_rad"), [(200.0, 200), (5.0, 200), (20.0, 50)])
def test_beyond_their_end_tables_are_constant(largest, per_rad):
    beyond = (largest * np.array([1.0, 1.001, 2, 1e4, 1e8])).astype(np.float32)
    value, slope = SidebandTable(1, largest, per_rad)(beyond)
    assert value == pytest.approx(j1(largest), abs=1e-6)
    assert slope == pytest.approx(jvp(1, largest), abs=1e-6)
    ratio, bend = BesselTable(largest, per_rad).tensor(beyond)
    assert ratio == pytest.approx(j1(largest) / largest, rel=1e-4)
    assert bend == pytest.approx(-jv(2, largest) / largest**2, rel=1e-4, abs=1e-9)


def test_a_finer_table_is_more_exact():
    phi = np.random.default_rng(3).uniform(0, 40, 20_000)
    errors = [np.abs(SidebandTable(1, 50.0, n)(phi)[0] - j1(phi)).max() for n in (10, 20, 40)]
    # Linear between entries: four times as exact with twice as many.
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)
    # Between entries the chord is off by an eighth of the curvature, at most 0.58, times step².
    assert errors[0] < 0.58 / 8 / 10**2


@pytest.mark.parametrize("shape", [(), (0,), (7,), (3, 4), (2, 3, 4)])
def test_phases_of_any_shape_are_looked_up_one_by_one(table, shape):
    phi = np.random.default_rng(4).uniform(0, 100, shape).astype(np.float32)
    phi = np.asarray(phi, dtype=np.float32)
    first = SidebandTable(1)
    value, slope = first(phi)
    assert np.shape(value) == np.shape(slope) == np.shape(table.over_argument(phi)) == shape
    assert np.ravel(value) == pytest.approx([float(first(p)[0]) for p in phi.ravel()], abs=1e-9)
