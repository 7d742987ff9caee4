"""Drying and warming: one law for reed files, for the bench and for the diagnosis."""

import numpy as np
import pytest

from physics.conditions import Condition, change_of_cane, condition_at, hardened
from physics.parameters.environment import Environment
from physics.reed.cane.conditions import at_temperature, cane_at_dryness, dried
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)

HZ = np.geomspace(1e3, 2e4, 12)
MEAN_A, MEAN_B = (viscoelastic_cane(Components(), series) for series in Series)


def logs(after, before):
    """Natural logarithms of the ratios of both storage moduli at `HZ`."""
    return tuple(
        np.log(
            storage_modulus_pa(getattr(after, m), HZ) / storage_modulus_pa(getattr(before, m), HZ)
        )
        for m in ("young_L", "shear_LT")
    )


def test_a_mean_reed_that_is_dried_is_that_of_series_b() -> None:
    assert dried(MEAN_A, 1.0) == MEAN_B
    assert dried(MEAN_A, 0.0) == MEAN_A
    change = change_of_cane(MEAN_A, Environment(), Condition(np.array(1.0), np.array(0.0)), HZ)
    E, G = logs(MEAN_B, MEAN_A)
    assert pytest.approx(E, rel=1e-12) == change.E_L
    assert pytest.approx(G, rel=1e-12) == change.G_LT
    # E_L falls, and the more the higher the frequency; G_LT rises at all (paper, section IV.B).
    assert np.interp(4e3, HZ, change.E_L) == pytest.approx(-0.107, abs=2e-3)
    assert np.interp(16e3, HZ, change.E_L) == pytest.approx(-0.254, abs=2e-3)
    assert change.G_LT.min() > 0.09


@pytest.mark.parametrize("dryness", [0.0, 0.3, 1.0])
def test_reed_files_and_the_bench_dry_a_reed_alike(dryness) -> None:
    # Reeds differ in how they answer by (e4 - e2)/2; this one answers as the mean does.
    components = Components(e1=0.4, e2=-0.7, e3=0.2, e4=-0.7)
    ambient = viscoelastic_cane(components, Series.A)
    E, G = logs(cane_at_dryness(components, dryness), ambient)
    condition = Condition(np.array(dryness), np.array(0.0))
    change = change_of_cane(ambient, Environment(), condition, HZ)
    assert pytest.approx(E, abs=1e-12) == change.E_L
    assert pytest.approx(G, abs=1e-12) == change.G_LT
    assert float(change.loss) == pytest.approx(-0.15 * dryness)


@pytest.mark.parametrize("warmer_c", [-5.0, 0.0, 10.0])
def test_reed_files_and_the_bench_warm_a_reed_alike(warmer_c) -> None:
    E, G = logs(at_temperature(MEAN_A, 20.0 + warmer_c), MEAN_A)
    condition = Condition(np.array(0.0), np.array(warmer_c))
    change = change_of_cane(MEAN_A, Environment(), condition, HZ)
    assert pytest.approx(E, abs=1e-12) == change.E_L
    assert pytest.approx(G, abs=1e-12) == change.G_LT
    assert float(change.loss) == pytest.approx(0.01 * warmer_c)


def test_what_the_laws_leave_open_is_the_same_at_all_frequencies() -> None:
    open_laws = Environment(warm_E_L=-1e-3, warm_G_LT=2e-3, dry_E_L=0.05, dry_G_LT=-0.02)
    condition = Condition(np.array(0.5), np.array(3.0))
    plain, more = (change_of_cane(MEAN_A, law, condition, HZ) for law in (Environment(), open_laws))
    assert pytest.approx(np.full(12, 0.025 - 0.003)) == more.E_L - plain.E_L
    assert pytest.approx(np.full(12, -0.01 + 0.006)) == more.G_LT - plain.G_LT


def test_wood_changes_equally_at_all_frequencies() -> None:
    """Stiffer as it dries, by 1.7 % for each per cent of water, softer as it warms."""
    law = Environment(dry_as_wood=1.0, warm_as_wood=1.0)
    dry = change_of_cane(MEAN_A, law, Condition(np.array(1.0), np.array(0.0)), HZ)
    assert pytest.approx(np.full(12, 0.08)) == dry.E_L
    by_h4 = change_of_cane(MEAN_A, Environment(), Condition(np.array(1.0), np.array(0.0)), HZ)
    assert pytest.approx(by_h4.G_LT) == dry.G_LT
    warm = change_of_cane(MEAN_A, law, Condition(np.array(0.0), np.array(5.0)), HZ)
    assert pytest.approx(np.full(12, -5 * 2.3e-3)) == warm.E_L
    assert pytest.approx(warm.E_L) == warm.G_LT
    # Halfway, the mean of both laws.
    half = change_of_cane(
        MEAN_A, Environment(dry_as_wood=0.5), Condition(np.array(1.0), np.array(0.0)), HZ
    )
    assert pytest.approx(0.5 * (by_h4.E_L + 0.08)) == half.E_L


def test_other_moduli_change_by_what_is_stated_and_otherwise_not() -> None:
    condition = Condition(np.array(0.5), np.array(3.0))
    law = Environment(dry_others=0.1, warm_others=-2e-3)
    assert change_of_cane(MEAN_A, Environment(), condition, HZ).others == 0
    assert change_of_cane(MEAN_A, law, condition, HZ).others == pytest.approx(0.05 - 0.006)


def test_a_condition_approaches_its_end_and_warmth_grows() -> None:
    environment = Environment(drying=0.4, drying_s=1800.0, warming_c_h=2.0, begun_h=0.5)
    condition = condition_at(environment, np.array([0.0, 1800.0, 1e6]))
    gone = 1 - np.exp(-np.array([1.0, 2.0, np.inf]))
    assert condition.dryness == pytest.approx(0.4 * gone, abs=1e-9)
    assert condition.warmer_c[:2] == pytest.approx([1.0, 2.0])
    assert condition_at(Environment(), 5e3).is_initial
    assert not condition.is_initial


def test_hardening_goes_by_the_square_of_the_amplitude() -> None:
    environment = Environment(hardening=0.01)
    assert hardened(environment, 20.0) == pytest.approx(4 * hardened(environment, 10.0))
    assert hardened(environment, 10.0) == pytest.approx(0.007)
