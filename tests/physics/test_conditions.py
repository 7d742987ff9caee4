"""Temperature and moisture of cane against Arrhenius's law and the two measured states."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physics.reed.cane.conditions import (
    at_temperature,
    cane_at_dryness,
    h4_matrix_at,
    relaxation_time_factor,
)
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    require_physical,
    storage_modulus_pa,
    viscoelastic_cane,
)

CANE = viscoelastic_cane(Components(0.3, -1.1, 0.7, 0.4), Series.A)
COMPONENTS = st.builds(Components, *[st.floats(-1, 1)] * 4)


def relaxation_time_s(zener):
    return zener.arm_dashpot_mpa_s / zener.arm_spring_mpa


def test_the_papers_example_of_a_shift():
    """Ten degrees above 20 °C at 13 kJ/mol: relaxation time less by 16 %."""
    assert 1 - relaxation_time_factor(30.0) == pytest.approx(0.16, abs=0.005)
    # By hand, with the paper's gas constant.
    by_hand = np.exp(13e3 / 8.314 * (1 / 303.15 - 1 / 293.15))
    assert relaxation_time_factor(30.0) == pytest.approx(by_hand, rel=2e-5)


def test_the_relaxation_time_of_both_moduli_is_shifted():
    warm = at_temperature(CANE, 30.0)
    for before, after in ((CANE.young_L, warm.young_L), (CANE.shear_LT, warm.shear_LT)):
        ratio = relaxation_time_s(after) / relaxation_time_s(before)
        assert ratio == pytest.approx(relaxation_time_factor(30.0))
        assert (after.spring_mpa, after.arm_spring_mpa) == (
            before.spring_mpa,
            before.arm_spring_mpa,
        )


def test_temperature_and_frequency_are_exchangeable():
    """Cane at another temperature is what it was at a frequency shifted as much."""
    hz = np.geomspace(500, 40e3, 9)
    factor = relaxation_time_factor(5.0, 40e3)
    cold = at_temperature(CANE, 5.0, 40e3)
    np.testing.assert_allclose(
        storage_modulus_pa(cold.shear_LT, hz), storage_modulus_pa(CANE.shear_LT, factor * hz)
    )
    assert factor > 1
    assert np.all(storage_modulus_pa(cold.young_L, hz) > storage_modulus_pa(CANE.young_L, hz))


@given(st.floats(-40, 80), st.floats(0, 1e5), st.floats(-40, 80))
def test_there_and_back_is_nothing(temperature_c, energy, reference_c):
    there = relaxation_time_factor(temperature_c, energy, reference_c)
    assert there * relaxation_time_factor(reference_c, energy, temperature_c) == pytest.approx(1)
    assert (there <= 1) == (temperature_c >= reference_c or there == 1)


def test_at_the_reference_nothing_changes():
    assert at_temperature(CANE, 20.0) == CANE
    assert at_temperature(CANE, 35.0, reference_c=35.0) == CANE
    assert at_temperature(CANE, 60.0, 0.0) == CANE


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-273.15,), "temperature of -273.15 °C is not above absolute zero"),
        ((-300.0,), "temperature of -300.0 °C is not above absolute zero"),
        ((float("nan"),), "temperature of nan °C"),
        ((float("inf"),), "temperature of inf °C"),
        ((20.0, 13e3, -400.0), "reference of -400.0 °C is not above absolute zero"),
        ((20.0, -1.0), "activation energy of -1.0 J/mol"),
        ((20.0, float("nan")), "activation energy of nan J/mol"),
    ],
)
def test_impossible_temperatures_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        at_temperature(CANE, *arguments)


def parameters(cane: ViscoelasticCane):
    return np.array(
        [
            value
            for zener in (cane.young_L, cane.shear_LT)
            for value in (zener.spring_mpa, zener.arm_spring_mpa, zener.arm_dashpot_mpa_s)
        ]
    )


@given(COMPONENTS)
def test_dryness_runs_from_series_a_to_series_b(components):
    for dryness, series in ((0.0, Series.A), (1.0, Series.B)):
        expected = parameters(viscoelastic_cane(components, series))
        np.testing.assert_allclose(
            parameters(cane_at_dryness(components, dryness)), expected, rtol=1e-12
        )


@given(COMPONENTS, st.floats(0, 1))
def test_half_dry_cane_has_half_dry_components(components, dryness):
    """The interpolation is one of the components on which series A's moduli depend (H4)."""
    e1, e2, e3, e4 = components.e1, components.e2, components.e3, components.e4
    between = Components(
        e1 + dryness * 1.011,
        (1 - dryness) * e2 + dryness * (-2.197 + 0.5 * (e2 + e4)),
        e3 + dryness * 0.8294,
    )
    np.testing.assert_allclose(
        parameters(cane_at_dryness(components, dryness)),
        parameters(viscoelastic_cane(between, Series.A)),
        rtol=1e-9,
    )


@given(COMPONENTS, st.floats(0, 1))
def test_between_two_possible_canes_all_are_possible(components, dryness):
    for series in Series:
        require_physical(viscoelastic_cane(components, series))
    require_physical(cane_at_dryness(components, dryness))


def test_drying_makes_the_mean_reed_stiffer_in_shear_and_softer_along_the_grain():
    """Paper, section on H4: G_LT rises; E_L falls, except around 2300 Hz."""
    wet, dry = (cane_at_dryness(Components(), dryness) for dryness in (0.0, 1.0))
    hz = np.array([4000.0, 16784.0])
    assert np.all(storage_modulus_pa(dry.shear_LT, hz) > storage_modulus_pa(wet.shear_LT, hz))
    assert np.all(storage_modulus_pa(dry.young_L, hz) < storage_modulus_pa(wet.young_L, hz))
    at_2300 = [storage_modulus_pa(cane.young_L, 2300.0) for cane in (wet, dry)]
    assert at_2300[1] == pytest.approx(at_2300[0], rel=0.05)


@pytest.mark.parametrize("dryness", [-0.01, 1.01, float("nan")])
def test_dryness_beyond_the_two_states_is_refused(dryness):
    with pytest.raises(ValueError, match="beyond what was measured"):
        h4_matrix_at(dryness)
    with pytest.raises(ValueError, match="beyond what was measured"):
        cane_at_dryness(Components(), dryness)


def test_zener_parts_keep_their_places():
    cane = cane_at_dryness(Components(), 0.0)
    assert cane.young_L == Zener(10300.0, 7309.0, 0.2822)
