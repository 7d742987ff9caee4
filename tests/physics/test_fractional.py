"""The fractional solid against Zener's, against causality, and against the paper's use of it."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from physics.reed.cane.fractional import (
    LORD_DRY,
    LORD_DRY_AS_TIME,
    FractionalSolid,
    complex_modulus_pa,
    fit_storage,
)
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    Zener,
    storage_modulus_pa,
    viscoelastic_cane,
)

SOLIDS = st.builds(
    FractionalSolid, st.floats(0, 2e4), st.floats(1, 2e4), st.floats(1e-2, 1e3), st.floats(0.2, 1)
)
# The range of the paper's resonances.
HZ = np.geomspace(2e3, 18e3, 50)
# The mean reed, its three different moduli.
H4 = {
    "E A": viscoelastic_cane(Components(), Series.A).young_L,
    "E B": viscoelastic_cane(Components(), Series.B).young_L,
    "G A": viscoelastic_cane(Components(), Series.A).shear_LT,
}


@given(st.builds(Zener, st.floats(1, 2e4), st.floats(1, 2e4), st.floats(1e-3, 1.0)))
def test_of_order_1_it_is_zeners_solid(zener):
    """Paper Eq. 3 for both parts, the twin's own storage modulus for one."""
    hz = np.geomspace(1, 1e6, 13)
    E1, E2, E3 = astuple(zener)
    found = complex_modulus_pa(FractionalSolid(E1, E2, E3, 1.0), hz)
    np.testing.assert_allclose(found.real, storage_modulus_pa(zener, hz), rtol=1e-12)
    eq_3 = 1e6 * (E1 + E2 - E2**2 / (E2 + 2j * np.pi * hz * E3))
    # Equation 3 takes the difference of two large numbers.
    np.testing.assert_allclose(found, eq_3, rtol=1e-9, atol=1e-9 * 1e6 * (E1 + E2))


@given(SOLIDS)
def test_half_way_at_the_relaxation_frequency(solid):
    at = complex_modulus_pa(solid, solid.relaxation_hz)
    half_way = 1e6 * (solid.spring_mpa + solid.arm_spring_mpa / 2)
    assert at.real == pytest.approx(half_way, rel=1e-6)
    # E1/2·tan(πα/4): half the arm's spring for Zener's solid, less for the others.
    peak = 1e6 * solid.arm_spring_mpa / 2 * np.tan(np.pi * solid.order / 4)
    assert at.imag == pytest.approx(peak, rel=1e-6)


@given(SOLIDS)
def test_storage_rises_and_loss_peaks_once(solid):
    hz = solid.relaxation_hz * np.geomspace(1e-6, 1e6, 241)
    modulus = complex_modulus_pa(solid, hz)
    assert np.all(np.diff(modulus.real) > -1e-9 * modulus.real[1:])
    assert np.all(modulus.imag > 0)
    steps = np.sign(np.diff(modulus.imag))
    assert np.all(steps[:120] > 0)
    assert np.all(steps[120:] < 0)


def test_rubbery_and_glassy_ends():
    solid = FractionalSolid(8000.0, 3000.0, 0.3, 0.8)
    assert complex_modulus_pa(solid, 0.0) == pytest.approx(8e9)
    assert complex_modulus_pa(solid, 1e30) == pytest.approx(11e9)


@pytest.mark.parametrize("order", [0.3, 0.546, 1.0])
def test_storage_follows_from_loss_by_kramers_and_kronig(order):
    """``E'(ω) = E'(0) + 2ω²/π · P∫ E''(u) / (u (ω² - u²)) du``, on a logarithmic axis."""
    solid = FractionalSolid(8000.0, 3000.0, 3.0, order)
    hz = 2.5 * solid.relaxation_hz

    def dissipated(x):
        return complex_modulus_pa(solid, hz * np.exp(x)).imag

    def paired(x):
        # Points as far above as below the pole, where what is singular cancels.
        return (dissipated(-x) - np.exp(-2 * x) * dissipated(x)) / (1 - np.exp(-2 * x))

    principal, _ = quad(paired, 1e-6, 80, limit=400)
    storage = 8e9 + 2 / np.pi * principal
    assert storage == pytest.approx(complex_modulus_pa(solid, hz).real, rel=1e-5)


def test_lords_parameters_are_those_printed():
    assert astuple(LORD_DRY) == (8108.0, 2964.0, 0.298, 0.546)
    assert astuple(LORD_DRY_AS_TIME)[:2] == (8108.0, 2964.0)
    assert LORD_DRY_AS_TIME.order == 0.546


def test_only_one_reading_of_lords_parameters_lies_among_the_papers_moduli(tables):
    """The paper finds the moduli of others within three standard deviations of its own."""
    mean, sd = tables["young_modulus_mean_sd"]["H4_B"]["E_4kHz_MPa"]
    printed, as_time = (
        1e-6 * complex_modulus_pa(solid, 4000.0).real for solid in (LORD_DRY, LORD_DRY_AS_TIME)
    )
    assert abs(printed - mean) > 4 * sd
    assert abs(as_time - mean) < 3 * sd
    assert LORD_DRY.relaxation_hz == pytest.approx(3.34e6, rel=0.01)
    assert LORD_DRY_AS_TIME.relaxation_hz == pytest.approx(2964 / 0.298 / (2 * np.pi))


@pytest.mark.parametrize("order", [1.0, 0.7, 0.546])
def test_a_fit_finds_the_solid_again(order):
    truth = FractionalSolid(9000.0, 6000.0, 6000.0 / (2 * np.pi * 5e3) ** order, order)
    storage = complex_modulus_pa(truth, np.geomspace(50, 5e5, 40)).real
    for known in (order, None):
        found = fit_storage(np.geomspace(50, 5e5, 40), storage, order=known)
        np.testing.assert_allclose(astuple(found), astuple(truth), rtol=1e-4)


def test_zeners_solid_does_for_one_decade_and_not_for_six():
    """The paper's statement, with Lord's order: less than a step of the sweep, 25 cents.

    A frequency follows the root of a modulus at most, hence 600 cents an octave of it.
    """

    def shortfall_cents(solid, hz):
        storage = complex_modulus_pa(solid, hz).real
        zener = complex_modulus_pa(fit_storage(hz, storage, order=1.0), hz).real
        return np.abs(600 * np.log2(zener / storage)).max()

    for zener in H4.values():
        like_h4 = fit_storage(HZ, storage_modulus_pa(zener, HZ), order=0.546)
        assert 5 < shortfall_cents(like_h4, HZ) < 25
    assert shortfall_cents(LORD_DRY_AS_TIME, HZ) == pytest.approx(3.6, abs=0.1)
    assert shortfall_cents(LORD_DRY, HZ) == pytest.approx(0.4, abs=0.1)
    assert shortfall_cents(LORD_DRY_AS_TIME, np.geomspace(1, 1e6, 100)) > 35


def test_the_fractional_solid_never_fits_worse():
    rng = np.random.default_rng(2)
    for zener in H4.values():
        storage = storage_modulus_pa(zener, HZ) * (1 + 0.01 * rng.standard_normal(len(HZ)))
        misfit = [
            np.linalg.norm(
                complex_modulus_pa(fit_storage(HZ, storage, order=o), HZ).real / storage - 1
            )
            for o in (1.0, None)
        ]
        assert misfit[1] <= misfit[0] * (1 + 1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"order": 0.0}, "order 0.0"),
        ({"order": 1.1}, "order 1.1"),
        ({"order": float("nan")}, "order nan"),
        ({"spring_mpa": -1.0}, "springs of -1.0 and 2964.0 MPa"),
        ({"arm_spring_mpa": 0.0}, "no material is like that"),
        ({"springpot_mpa_s_order": -0.3}, "no material is like that"),
        ({"spring_mpa": float("inf")}, "no material is like that"),
    ],
)
def test_impossible_solids_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(LORD_DRY, **changes)


@pytest.mark.parametrize(
    ("hz", "storage", "message"),
    [
        ([1e3, 2e3, 3e3], [1e10, 1e10, 1e10], "for 4 parameters"),
        ([1e3, 2e3, 3e3, 4e3], [1e10, 1e10, 1e10], "for 4 parameters"),
        ([0.0, 2e3, 3e3, 4e3], [1e10] * 4, "to be positive"),
        ([1e3, 2e3, 3e3, 4e3], [1e10, 1e10, -1e10, 1e10], "to be positive"),
        ([1e3, 2e3, 3e3, 4e3], [1e10, np.nan, 1e10, 1e10], "to be positive"),
    ],
)
def test_data_that_fix_no_solid_are_refused(hz, storage, message):
    with pytest.raises(ValueError, match=message):
        fit_storage(np.array(hz), np.array(storage))
