"""Orthotropic elasticity from the meaning of the engineering constants."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physics.errors import ImpossibleReedError
from physics.reed.cane.material import (
    STIFFNESS_TERMS,
    Cane,
    constants_of,
    stiffness_matrix_pa,
    stiffness_terms_pa,
    terms_and_slopes,
)
from physics.reed.reduced.reed import CONSTANTS
from tests.physics.canes import ODD_CANE


def strain_under(stress_pa):
    return np.linalg.solve(stiffness_matrix_pa(ODD_CANE), np.array(stress_pa, dtype=float))


def test_pull_along_the_grain():
    """ν_ij is the contraction along j under stress along i."""
    strain = strain_under([1e6, 0, 0, 0, 0, 0])
    stretch = 1e6 / 13e9
    np.testing.assert_allclose(strain, stretch * np.array([1, -0.35, -0.25, 0, 0, 0]), atol=1e-18)


def test_pull_across_the_grain():
    strain = strain_under([0, 1e6, 0, 0, 0, 0])
    stretch = 1e6 / 0.7e9
    # Maxwell: ν_TL / E_T = ν_LT / E_L.
    expected = stretch * np.array([-0.35 * 0.7 / 13, 1, -0.45, 0, 0, 0])
    np.testing.assert_allclose(strain, expected, atol=1e-18)


def test_pull_along_the_radius():
    strain = strain_under([0, 0, 1e6, 0, 0, 0])
    expected = 1e6 / 0.9e9 * np.array([-0.25 * 0.9 / 13, -0.45 * 0.9 / 0.7, 1, 0, 0, 0])
    np.testing.assert_allclose(strain, expected, atol=1e-18)


@pytest.mark.parametrize(("component", "modulus"), [(3, "G_TR_pa"), (4, "G_LR_pa"), (5, "G_LT_pa")])
def test_shear_in_voigt_order_yz_xz_xy(component, modulus):
    stress = np.zeros(6)
    stress[component] = 1e6
    strain = strain_under(stress)
    assert strain[component] == pytest.approx(1e6 / getattr(ODD_CANE, modulus), rel=1e-12)
    assert np.count_nonzero(np.abs(strain) > 1e-18) == 1


def test_isotropic_limit_is_that_of_lame():
    E, nu = 3e9, 0.3
    G = E / (2 * (1 + nu))
    C = stiffness_matrix_pa(Cane(E, E, E, G, G, G, nu, nu, nu))
    lame = E * nu / ((1 + nu) * (1 - 2 * nu))
    expected = np.diag([2 * G] * 3 + [G] * 3)
    expected[:3, :3] += lame
    np.testing.assert_allclose(C, expected, rtol=1e-9, atol=1e-3)


def test_terms_are_the_matrix():
    C = stiffness_matrix_pa(ODD_CANE)
    rebuilt = np.zeros((6, 6))
    for term, value in zip(STIFFNESS_TERMS, stiffness_terms_pa(ODD_CANE), strict=True):
        i, j = (int(digit) - 1 for digit in term)
        rebuilt[i, j] = rebuilt[j, i] = value
    np.testing.assert_allclose(rebuilt, C, atol=1e-3)


@pytest.mark.parametrize("name", ["E_L_pa", "E_T_pa", "E_R_pa", "G_LT_pa", "G_LR_pa", "G_TR_pa"])
@pytest.mark.parametrize("value", [0.0, -1e9])
def test_moduli_that_are_not_positive_are_refused(name, value):
    with pytest.raises(ImpossibleReedError, match="positive"):
        stiffness_terms_pa(replace(Cane(), **{name: value}))


@pytest.mark.parametrize("value", [0.0, -520.0])
def test_density_that_is_not_positive_is_refused(value):
    with pytest.raises(ImpossibleReedError, match="positive"):
        stiffness_terms_pa(replace(Cane(), density_kg_m3=value))


@pytest.mark.parametrize(
    "ratios",
    [
        {"nu_TR": 1.01},
        # |ν_LT| < √(E_L/E_T) = 5.4.
        {"nu_LT": 5.5},
        {"nu_LT": 4.0, "nu_LR": 4.0},
        {"nu_LT": -5.5},
    ],
)
def test_poisson_ratios_that_yield_energy_are_refused(ratios):
    with pytest.raises(ImpossibleReedError, match="Poisson"):
        stiffness_terms_pa(replace(Cane(), **ratios))


def test_stiffnesses_of_many_canes_are_those_of_each_with_their_derivatives():
    rng, step, canes = np.random.default_rng(1), 1e-5, []
    for _ in range(5):
        moduli = np.array(astuple(Cane())[:6]) * rng.uniform(0.7, 1.4, 6)
        canes.append(Cane(*moduli, *rng.uniform(0.1, 0.3, 3)))
    terms, slopes = terms_and_slopes(constants_of(canes))
    np.testing.assert_allclose(terms, [stiffness_terms_pa(cane) for cane in canes], rtol=1e-12)
    for number, name in enumerate(CONSTANTS):
        for cane, own in zip(canes, slopes[..., number], strict=True):
            value = getattr(cane, name)
            ahead, behind = (
                replace(cane, **{name: value * np.exp(h) if number < 6 else value + h})
                for h in (step, -step)
            )
            expected = (stiffness_terms_pa(ahead) - stiffness_terms_pa(behind)) / (2 * step)
            np.testing.assert_allclose(own, expected, atol=1e-7 * np.abs(expected).max())


def refuses(stiffnesses, canes):
    try:
        stiffnesses(canes)
    except ImpossibleReedError:
        return True
    return False


def test_the_same_canes_are_refused_alone_and_among_many():
    rng = np.random.default_rng(2)
    alone, among = [], []
    for _ in range(300):
        cane = Cane(*np.exp(rng.normal(size=6)), *rng.uniform(-1.5, 1.5, 3))
        alone.append(refuses(stiffness_terms_pa, cane))
        among.append(refuses(terms_and_slopes, constants_of([Cane(), cane])))
    assert among == alone
    assert 30 < sum(alone) < 270


@settings(deadline=None)
@given(st.floats(0.5e9, 3e9), st.floats(0.1, 0.99))
def test_admissible_materials_store_energy(E_T_pa, share):
    limit = np.sqrt(14e9 / E_T_pa)
    cane = replace(Cane(), E_T_pa=E_T_pa, nu_LT=share * limit, nu_LR=0.0, nu_TR=0.0)
    C = stiffness_matrix_pa(cane)
    np.testing.assert_allclose(C, C.T, rtol=1e-9)
    assert np.linalg.eigvalsh(C)[0] > 0
