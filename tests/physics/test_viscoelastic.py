"""Zener's solid and hypothesis H4 against the paper's identities and tables."""

from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physics.errors import ImpossibleReedError
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    h4_matrix,
    require_physical,
    storage_modulus,
    storage_modulus_pa,
    viscoelastic_cane,
)

SOLIDS = st.builds(Zener, st.floats(1, 2e4), st.floats(1, 2e4), st.floats(1e-3, 1.0))
COMPONENTS = st.builds(Components, *[st.floats(-4, 4)] * 4)


@settings(deadline=None)
@given(SOLIDS)
def test_rubbery_half_way_and_glassy_moduli(zener):
    relaxation_hz = zener.arm_spring_mpa / zener.arm_dashpot_mpa_s / (2 * np.pi)
    rubbery, half_way, glassy = (
        storage_modulus_pa(zener, relaxation_hz * np.array([0, 1, 1e9])) / 1e6
    )
    assert rubbery == pytest.approx(zener.spring_mpa)
    assert half_way == pytest.approx(zener.spring_mpa + zener.arm_spring_mpa / 2)
    assert glassy == pytest.approx(zener.spring_mpa + zener.arm_spring_mpa)


@settings(deadline=None)
@given(SOLIDS)
def test_storage_is_the_real_part_of_the_complex_modulus(zener):
    """A spring parallel to a Maxwell arm: stiffnesses add, in the arm compliances."""
    omega = np.geomspace(1, 1e6, 7)
    dashpot = 1j * omega * zener.arm_dashpot_mpa_s
    arm = 1 / (1 / zener.arm_spring_mpa + 1 / dashpot)
    np.testing.assert_allclose(
        storage_modulus_pa(zener, omega / (2 * np.pi)), 1e6 * (zener.spring_mpa + arm).real
    )


@settings(deadline=None)
@given(SOLIDS)
def test_storage_rises_with_frequency(zener):
    storage = storage_modulus_pa(zener, np.geomspace(1, 1e6, 50))
    # Far from relaxation a rise is lost in rounding.
    assert np.all(np.diff(storage) > -1e-9 * storage[1:])
    assert storage[-1] > storage[0]


def test_steepest_at_the_relaxation_frequency():
    """The paper's fourth property of Eq. 4: ``dE'/dω = E3/2`` at ω = 1/τ1."""
    zener = Zener(10300.0, 7309.0, 0.2822)
    hz = zener.arm_spring_mpa / zener.arm_dashpot_mpa_s / (2 * np.pi)
    above, below = storage_modulus_pa(zener, np.array([hz + 0.1, hz - 0.1])) / 1e6
    assert (above - below) / (2 * np.pi * 0.2) == pytest.approx(0.2822 / 2, rel=1e-6)


def test_storage_is_smooth_through_an_arm_without_a_spring():
    """A fit may walk through E2 = 0: no pole, no kink."""
    arms = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])
    storage = np.array([storage_modulus_pa(Zener(9e3, arm, 0.02), 2e3) for arm in arms])
    np.testing.assert_allclose(storage, 1e6 * (9e3 + arms), atol=0.1)


@settings(deadline=None)
@given(COMPONENTS, st.sampled_from(Series))
def test_identities_of_h4(components, series):
    """The paper's Eqs after the definition of H4, with ě of either series."""
    e1, e2, e3, e4 = astuple(components)
    if series is Series.B:
        e1, e2, e3 = 1.011 + e1, -2.197 + (e2 + e4) / 2, 0.8294 + e3
    cane = viscoelastic_cane(components, series)
    rubbery, arm, dashpot = astuple(cane.young_L)
    assert rubbery + arm == pytest.approx(10300 + 7309 + 3 * 640.5 * e2, abs=1e-8)
    assert 2 * rubbery - arm == pytest.approx(2 * 10300 - 7309 + 3 * 640.5 * e3, abs=1e-8)
    assert dashpot == 0.2822
    rubbery, arm, dashpot = astuple(cane.shear_LT)
    assert rubbery + arm == pytest.approx(115.7 * (12 + 3 * e1 - 2 * e3), abs=1e-8)
    # Printed with -ě3, which neither its own G1 and G2 nor Table 7's mean G2 of series B allow.
    assert 2 * rubbery - arm == pytest.approx(2 * 115.7 * (3 + e3), abs=1e-8)
    assert dashpot == 0.02038


@settings(deadline=None)
@given(COMPONENTS)
def test_drying_is_nothing_to_the_ambient_reed(components):
    e1, e2, e3, _ = astuple(components)
    ambient = viscoelastic_cane(components, Series.A)
    assert ambient == viscoelastic_cane(Components(e1, e2, e3, 0.0), Series.A)


@pytest.fixture(scope="module")
def population():
    """Springs and relaxation frequencies of 100 000 reeds per series, and moduli at 4 kHz."""
    draws = np.random.default_rng(11).standard_normal((4, 100_000))
    answer = {}
    for series in Series:
        # The model is linear in its components: arrays pass through it as numbers do.
        cane = viscoelastic_cane(Components(*draws), series)
        for letter, zener in (("E", cane.young_L), ("G", cane.shear_LT)):
            spring, arm, dashpot = astuple(zener)
            answer[series, letter] = {
                f"{letter}1_MPa": spring,
                f"{letter}2_MPa": arm,
                "fr_Hz": arm / (2 * np.pi * dashpot),
                f"{letter}_4kHz_MPa": storage_modulus_pa(zener, 4e3) / 1e6,
            }
    return answer


@pytest.mark.parametrize("series", Series)
@pytest.mark.parametrize(
    ("letter", "table"), [("E", "young_modulus_mean_sd"), ("G", "shear_modulus_mean_sd")]
)
def test_population_has_the_means_and_deviations_of_tables_6_and_7(
    series, letter, table, population, tables
):
    published = tables[table][f"H4_{series}"]
    for quantity in (f"{letter}1_MPa", f"{letter}2_MPa", "fr_Hz"):
        values, (mean, deviation) = population[series, letter][quantity], published[quantity]
        assert np.mean(values) == pytest.approx(mean, rel=0.01), quantity
        assert np.std(values) == pytest.approx(deviation, rel=0.01), quantity


@pytest.mark.parametrize("series", Series)
def test_population_has_the_moduli_at_4_khz_of_tables_6_and_7(series, population, tables):
    """Less exactly: storage is not linear in the components.

    A deviation over 55 reeds is uncertain by 10 %, and a normal population has reeds with G2 near
    zero, of low G′, which lower its mean by more than 1 % and which the paper's sample lacks.
    """
    mean, deviation = tables["young_modulus_mean_sd"][f"H4_{series}"]["E_4kHz_MPa"]
    values = population[series, "E"]["E_4kHz_MPa"]
    assert np.mean(values) == pytest.approx(mean, rel=0.01)
    assert np.std(values) == pytest.approx(deviation, rel=0.05)
    mean, _ = tables["shear_modulus_mean_sd"][f"H4_{series}"]["G_4kHz_MPa"]
    values = population[series, "G"]["G_4kHz_MPa"]
    assert np.mean(values) < mean
    assert np.mean(values) == pytest.approx(mean, rel=0.02)


def test_one_reed_in_sixty_cannot_be(population):
    """G2 < 0 where e1 − e3 < −3, a normal deviate of variance 2: 1.69 %."""
    assert np.mean(population[Series.A, "G"]["G2_MPa"] < 0) == pytest.approx(0.0169, abs=0.0015)


def test_possible_reeds_pass_and_impossible_ones_name_their_spring():
    require_physical(viscoelastic_cane(Components(), Series.A))
    with pytest.raises(ImpossibleReedError, match="G2 = -"):
        require_physical(viscoelastic_cane(Components(e1=-2.0, e3=2.0), Series.A))
    with pytest.raises(ImpossibleReedError, match="E1 = 0 MPa"):
        require_physical(ViscoelasticCane(Zener(0.0, 1.0, 1.0), Zener(1.0, 1.0, 1.0)))


# --- Many at once ------------------------------------------------------------------------------


def test_many_storage_moduli_are_those_of_each():
    rng = np.random.default_rng(3)
    E1, E2, E3 = rng.uniform(5e3, 1e4, 5), rng.uniform(-2e3, 8e3, 5), rng.uniform(0.1, 0.4, 5)
    hz = np.array([[500.0], [4000.0], [20e3]])
    many = storage_modulus(E1, E2, E3, hz)
    assert many.value_mpa.shape == (3, 5)
    for n in range(5):
        one = storage_modulus_pa(Zener(E1[n], E2[n], E3[n]), hz[:, 0])
        np.testing.assert_allclose(1e6 * many.value_mpa[:, n], one, rtol=1e-12)


@pytest.mark.parametrize("arm_spring", [4000.0, -300.0, 0.0])
def test_slopes_of_the_storage_modulus_are_those_of_finite_differences(arm_spring):
    at = np.array([10e3, arm_spring, 0.25, np.log(3000.0)])

    def value(p):
        return storage_modulus(p[0], p[1], p[2], np.exp(p[3])).value_mpa

    slopes = storage_modulus(*map(np.array, at[:3]), np.exp(at[3]))
    for k, slope in (
        (1, slopes.by_arm_spring),
        (2, slopes.by_arm_dashpot_per_s),
        (3, slopes.by_ln_frequency_mpa),
    ):
        step = np.eye(4)[k] * 1e-4 * max(1.0, abs(at[k]))
        difference = (value(at + step) - value(at - step)) / (2 * step[k])
        assert slope == pytest.approx(difference, rel=1e-5, abs=1e-4)


def test_an_arm_of_nothing_carries_nothing():
    nothing = storage_modulus(np.array(9e3), np.array(0.0), np.array(0.0), np.array(1e3))
    assert nothing.value_mpa == 9e3
    assert nothing.by_ln_frequency_mpa == 0


@pytest.mark.parametrize("series", Series)
def test_the_matrix_of_h4_is_h4(series):
    e = np.array([0.3, -1.2, 0.7, 1.9])
    cane = viscoelastic_cane(Components(*e), series)
    E, G = cane.young_L, cane.shear_LT
    parameters = h4_matrix(series) @ [1, *e]
    expected = [E.spring_mpa, E.arm_spring_mpa, E.arm_dashpot_mpa_s]
    expected += [G.spring_mpa, G.arm_spring_mpa, G.arm_dashpot_mpa_s]
    np.testing.assert_allclose(parameters, expected, rtol=1e-12)
