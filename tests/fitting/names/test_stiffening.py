"""A loss factor and a stiffening that trade against a resonance of known width."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.names.reed_posterior import reed_posterior
from fitting.names.stiffening import Stiffening, averaged, growth, shares, stiffening_of
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.mode_classification import names_of
from physics.reed.reduced.vibrations import vibrations
from tests.fitting.names.conftest import planting

MEASURED = ("F1", "T1", "F2", "T2", "X1", "T3", "F3", "X2", "X3")
ENDS_HZ = (1417.2, 19_911.9)
E3 = 2


@pytest.fixture(scope="module")
def viscous(reeds, visible, planted):
    """Posterior of a reed whose moduli grow little: its e3 is 1.5."""
    sweep = planted(MEASURED, e1=0.0, e2=0.0, e3=1.5)
    found = reed_posterior(reeds, visible, sweep.measured, ENDS_HZ)
    return max(found, key=lambda each: each.log_evidence)


def half_width(loss, exponent):
    """Distance in ln f at which the response of a mode has fallen to 1/√2."""
    log = np.linspace(-0.05, 0.05, 200_001)
    response = np.abs(1 / (1 + 1j * loss - np.exp((2 - exponent) * log)))
    inside = log[response > response.max() / np.sqrt(2)]
    return 0.5 * (inside[-1] - inside[0])


def test_a_loss_that_was_fitted_with_another_stiffening_is_put_right():
    """Both have the same width."""
    own = Stiffening(0.1, 0.02)
    right = 0.02 * own.loss_ratio(0.3)
    assert half_width(0.02, 0.3) == pytest.approx(half_width(right, 0.1), rel=2e-3)
    assert own.loss_error == pytest.approx(0.02 / 1.9)


def test_shares_and_growth_say_how_modes_follow_all_moduli(reeds, viscous):
    """Modes move as 1/(2 - γ) with moduli that are larger by one part: by brute force."""
    nearby, step = viscous.nearby, 1e-4
    found = nearby.found
    law, top_hz = found.state.law, found.hz[20] * 1.01
    apart = [
        vibrations(
            reeds.reed,
            replace(
                found.state,
                law=replace(law, constants=replace(law.constants, density_kg_m3=density)),
            ),
            top_hz,
        ).hz
        for density in law.constants.density_kg_m3 * np.exp([step, -step])
    ]
    count = min(len(each) for each in apart) - 1
    slope = np.log(apart[0][:count] / apart[1][:count]) / (2 * step)
    parts = shares(found)[:count]
    exponent = np.sum(parts * growth(reeds, nearby.start, found.hz[:count]), axis=1)
    assert exponent == pytest.approx(2 + 1 / slope, abs=2e-3)
    assert np.ptp(exponent) > 0.05
    # The other moduli have what is left.
    assert np.all((parts > 0) & (parts.sum(axis=1, keepdims=True) < 1))


def test_growth_is_that_of_storage_moduli(reeds):
    values = np.zeros(len(reeds.names))
    values[E3] = 1.0
    hz = np.array([2000.0, 8000.0])
    cane = viscoelastic_cane(Components(e3=1.0), Series.A)
    for column, zener in enumerate((cane.young_L, cane.shear_LT)):
        ratio = storage_modulus_pa(zener, 1.02 * hz) / storage_modulus_pa(zener, hz / 1.02)
        expected = np.log(ratio) / (2 * np.log(1.02))
        assert growth(reeds, values, hz)[:, column] == pytest.approx(expected, rel=2e-3)


def test_stiffening_is_that_of_the_reed_and_not_of_mean_cane(reeds, viscous):
    found = stiffening_of(reeds, viscous)
    mean = replace(viscous, mean=np.where(np.arange(len(reeds.names)) == E3, 0.0, viscous.mean))
    names = dict(zip(MEASURED, zip(found, stiffening_of(reeds, mean), strict=True), strict=True))
    truth = np.zeros(len(reeds.names))
    truth[E3] = 1.5
    near = reeds.near(truth).found
    for number, name in enumerate(("F1", "T1", "F2", "T2", "X1")):
        own, _ = names[name]
        true = float(shares(near)[number] @ growth(reeds, truth, near.hz[[number]])[0])
        assert abs(own.exponent - true) < 4 * own.error + 0.01, name
        assert own.error < 0.05
    assert names["T2"][1].exponent - names["T2"][0].exponent > 0.08


@pytest.mark.parametrize(
    ("names", "sign", "least"),
    [
        (("growth_E_L", "growth_G_LT"), -2.0, 4.0),
        pytest.param(("growth_E_L", "growth_G_LT"), 2.0, 4.0, marks=pytest.mark.slow),
        # Levels of moduli say little of how they grow.
        (("E_L", "G_LT"), 2.0, 0.0),
    ],
)
def test_cane_that_does_not_follow_the_law_of_the_paper_has_its_own_growth(
    reeds, visible, names, sign, least
):
    """Two standard deviations more or less: moduli hardly grow, or twice as fast."""
    free = reeds.with_free_moduli()
    other = {"e1": 0.0, "e2": 0.0, "e3": 0.0, "E_L": 0.0, "G_LT": 0.0}
    other |= dict.fromkeys(names, sign)
    sweep = planting(free, visible)(MEASURED, **other)
    found = max(
        reed_posterior(reeds, visible, sweep.measured, ENDS_HZ), key=lambda each: each.log_evidence
    )
    truth = np.zeros(len(free.names))
    for name, value in other.items():
        truth[free.names.index(name)] = value
    nearby, pulls, held = free.near(truth), [], []
    near = nearby.found
    names = [each.name for each in names_of(nearby.descriptors(np.eye(len(near.hz))))]
    own = stiffening_of(free, found.free_moduli), stiffening_of(reeds, found)
    for name, freely, by_law in zip(MEASURED, *own, strict=True):
        number = names.index(name)
        true = float(shares(near)[number] @ growth(free, truth, near.hz[[number]])[0])
        pulls.append((freely.exponent - true) / freely.error)
        held.append((by_law.exponent - true) / by_law.error)
    assert np.sqrt(np.mean(np.square(pulls))) < 2
    assert np.sqrt(np.mean(np.square(held))) > least


def test_the_error_is_that_of_the_components(reeds, viscous):
    own = replace(viscous, covariance=np.zeros_like(viscous.covariance))
    assert [each.error for each in stiffening_of(reeds, own)] == pytest.approx(
        [0.0] * len(MEASURED), abs=1e-12
    )
    covariance, deviation = own.covariance.copy(), 0.1
    covariance[E3, E3] = deviation**2
    up, down = (
        stiffening_of(reeds, replace(own, mean=viscous.mean + sign * deviation * unit))
        for unit in [np.eye(len(reeds.names))[E3]]
        for sign in (1, -1)
    )
    found = stiffening_of(reeds, replace(own, covariance=covariance))
    for each, one, other in zip(found, up, down, strict=True):
        # Shapes move as well, a little.
        assert each.error == pytest.approx(abs(one.exponent - other.exponent) / 2, rel=0.02)


def test_a_mode_that_is_not_the_reeds_has_none(reeds, viscous):
    mode = np.where(np.arange(len(MEASURED)) == 3, -1, viscous.mode)
    found = stiffening_of(reeds, replace(viscous, mode=mode))
    assert [each is None for each in found] == [number == 3 for number in range(len(MEASURED))]


def test_the_average_covers_what_reeds_disagree_about():
    one, other = Stiffening(0.1, 0.01), Stiffening(0.3, 0.01)
    both = averaged(np.array([0.75, 0.25]), (one, other))
    assert both.exponent == pytest.approx(0.15)
    assert both.error == pytest.approx(np.sqrt(0.01**2 + 0.75 * 0.05**2 + 0.25 * 0.15**2))
    assert averaged(np.array([0.75, 0.25]), (None, other)) == pytest.approx(other)
    assert averaged(np.array([1.0, 0.0]), (None, other)) is None
