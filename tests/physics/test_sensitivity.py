"""Sensitivities of frequencies: exact derivatives, one constant at a time, and their sum rule."""

from dataclasses import replace

import numpy as np
import pytest

from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import assemble
from physics.reed.elements.mesh import MeshLevel, build_mesh
from physics.reed.modes import reed_modes
from physics.reed.reduction.sensitivity import (
    CLASSES,
    CONSTANTS,
    MODULI,
    TABLE_3_MODES,
    class_means,
    field_of,
    one_at_a_time,
    rayleigh_sensitivities,
    stiffness_slopes_pa,
)

LEVEL = MeshLevel(orders=(3, 2, 2), edge_breaks_m=(), z_breaks=(0.0, 1.0))
# Different from each other, so that none can stand for another.
CANE = Cane(13e9, 0.5e9, 0.4e9, 1.2e9, 1.0e9, 0.9e9, 0.2, 0.25, 0.3, 500.0)
NAMES = ("F1", "F2", "T1", "T2", "X1", "L1")


@pytest.fixture(scope="module")
def exact(geometry):
    modes = reed_modes(geometry, CANE, LEVEL, 9e3)
    return rayleigh_sensitivities(assemble(build_mesh(geometry, LEVEL)), modes, CANE)


def test_stiffness_slopes_are_those_of_finite_differences():
    slopes = stiffness_slopes_pa(CANE)
    step = 1e-6
    for constant, row in zip(CONSTANTS, slopes, strict=True):
        name, value = field_of(constant), getattr(CANE, field_of(constant))
        high, low = (
            stiffness_terms_pa(replace(CANE, **{name: value * factor}))
            for factor in (1 + step, 1 - step)
        )
        np.testing.assert_allclose(row, (high - low) / (2 * step), rtol=1e-6, atol=1.0)


def test_stiffness_is_homogeneous_in_the_moduli():
    """Euler: the slopes along all moduli together are the stiffnesses themselves."""
    total = stiffness_slopes_pa(CANE)[: len(MODULI)].sum(axis=0)
    np.testing.assert_allclose(total, stiffness_terms_pa(CANE), rtol=1e-12)


def test_moduli_share_one_half(exact):
    assert set(NAMES) <= set(exact)
    for slopes in exact.values():
        assert slopes[: len(MODULI)].sum() == pytest.approx(0.5, abs=1e-6)
        assert np.all(slopes[: len(MODULI)] > 0)


def test_small_variations_give_the_exact_derivatives(geometry, exact):
    heard = []
    found = one_at_a_time(geometry, CANE, LEVEL, share=1e-3, names=NAMES, done=heard.append)
    assert sorted(heard) == sorted(CONSTANTS)
    for name in NAMES:
        np.testing.assert_allclose(found[name], exact[name], atol=2e-6)


def test_classes_follow_what_the_paper_says_of_them(exact):
    column = {constant: CONSTANTS.index(constant) for constant in CONSTANTS}
    assert exact["F1"].argmax() == column["E_L"]
    assert exact["T1"].argmax() == column["G_LT"]
    # Stretching the width stiffens it: transversal modes fall with nu_LT, flexural ones rise.
    assert exact["T2"][column["nu_LT"]] < 0 < exact["F1"][column["nu_LT"]]


def test_means_of_classes_count_modes():
    by_mode = {name: np.full(9, float(n)) for n, name in enumerate(TABLE_3_MODES)}
    means = class_means(by_mode)
    assert len(TABLE_3_MODES) == 16
    assert [means[letter][0] for letter in ("F", "T", "X", "L", "all")] == [
        1.5,
        5.5,
        10.5,
        14.5,
        7.5,
    ]
    assert list(means) == [*CLASSES, "all"]


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1])
def test_impossible_shares_are_refused(geometry, share):
    with pytest.raises(ValueError, match="give a share within 0 and 1"):
        one_at_a_time(geometry, CANE, LEVEL, share=share)


def test_a_mode_that_is_not_there_is_named(geometry):
    with pytest.raises(ValueError, match="no F9 below 20500 Hz"):
        one_at_a_time(geometry, CANE, LEVEL, names=("F1", "F9"))
