"""Forced vibration: reciprocity, power, limits, and the full finite-element model."""

from dataclasses import replace

import numpy as np
import pytest

from physics.air import pressure_shape
from physics.parameters.chamber import Chamber, Filling
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.elements.fem import (
    Symmetry,
    factor,
    free_dofs,
    mass,
    stiffness,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced import elastic as reed_response
from physics.reed.reduced.elastic import (
    elastic_modes,
    named_modes,
    reduced_modes,
    viscoelastic_mode,
)
from physics.reed.reduced.response import forced_response
from tests.numbers import cents

CANE = viscoelastic_cane(Components(), Series.A)
LOSS = 0.03
EVEN, ODD = Symmetry.SYMMETRIC, Symmetry.ANTISYMMETRIC


def uneven(_hz, x_m, y_m):
    """A complex pressure without any symmetry."""
    return np.exp(-x_m / 15e-3) * (1 + 0.5 * np.sin(300 * y_m)) * (1 + 0.7j * y_m / 6e-3)


def elastic(hz, cane=CANE):
    """Cane with the storage moduli at a frequency."""
    return Cane(
        E_L_pa=float(storage_modulus_pa(cane.young_L, hz)),
        G_LT_pa=float(storage_modulus_pa(cane.shear_LT, hz)),
    )


def test_every_mode_up_to_the_number_named_has_a_name_of_its_own(coarse_reed):
    modes = elastic_modes(coarse_reed, 12e9, 0.9e9)
    assert len(modes) == 2 * named_modes(coarse_reed)
    for symmetry in Symmetry:
        own = [mode for mode in modes.values() if mode.symmetry is symmetry]
        assert len(own) == named_modes(coarse_reed)
        assert len({mode.frequency_hz for mode in own}) == len(own)


def test_motion_that_profiles_do_not_resolve_bears_out_no_name(coarse_reed):
    loose = {}
    for symmetry, part in coarse_reed.loose.items():
        own = part.measures[symmetry]
        coarser = replace(own, vamp_square=2 * own.vamp_square)
        loose[symmetry] = replace(part, measures={symmetry: coarser})
    half_resolved = elastic_modes(replace(coarse_reed, loose=loose), 12e9, 0.9e9)
    modes = elastic_modes(coarse_reed, 12e9, 0.9e9)
    # Those with fine waves are integrated too roughly on so coarse a mesh.
    for name in ("F1", "T1", "F2", "X1"):
        expected = 0.5 * modes[name].similarity
        assert half_resolved[name].similarity == pytest.approx(expected, rel=0.15)


# In a vacuum, with the moduli of either frequency, the name T2 is the other mode's: F2 and T2
# exchange shapes.
EXCHANGING = viscoelastic_cane(Components(-3.06, -0.51, -0.91, 0.8), Series.A)


def test_modes_that_exchange_shapes_settle(coarse_reed):
    found = [
        viscoelastic_mode(coarse_reed, EXCHANGING, "T2", hz, air_fraction=0.0)
        for hz in (2e3, 5.2e3, 9e3)
    ]
    found.append(viscoelastic_mode(coarse_reed, EXCHANGING, "F2", 9e3, air_fraction=0.0))
    half, numbers = coarse_reed.parts[EVEN], []
    for mode in found:
        constants = elastic(mode.frequency_hz, EXCHANGING)
        density = constants.density_kg_m3
        hz, shapes = reduced_modes(half, stiffness_terms_pa(constants), density)
        number = int(np.argmin(np.abs(cents(hz, mode.frequency_hz))))
        assert cents(hz[number], mode.frequency_hz) == pytest.approx(0, abs=0.01)
        overlap = shapes[:, number] @ half.mass @ mode.coordinates * density
        assert abs(overlap) == pytest.approx(1, abs=1e-3)
        numbers.append(number)
    # The second and the third of their symmetry.
    assert numbers == [1, 1, 1, 2]
    assert max(mode.similarity for mode in found) < 0.7


def test_settled_by_number_modes_are_those_settled_by_name(coarse_reed, monkeypatch):
    by_name = [viscoelastic_mode(coarse_reed, CANE, name, 8e3) for name in PAPER_MODES]
    monkeypatch.setattr(reed_response, "_MOST_ITERATIONS", 0)
    for mode in by_name:
        other = viscoelastic_mode(coarse_reed, CANE, mode.name, 8e3)
        assert (other.name, other.symmetry) == (mode.name, mode.symmetry)
        assert cents(other.frequency_hz, mode.frequency_hz) == pytest.approx(0, abs=0.01)
        # Names are found among other shapes, each with moduli of its own.
        assert other.similarity == pytest.approx(mode.similarity, abs=1e-3)


def stored(reed, symmetry, hz):
    """Reduced storage stiffness (r, r) at a frequency."""
    terms = stiffness_terms_pa(elastic(hz))
    return np.tensordot(terms, reed.parts[symmetry].stiffness_terms, axes=1)


def pushed(reed, symmetry, pressure, hz):
    """Reduced force (r,) of the part of a pressure that has a symmetry."""
    x, y = reed.load_points_m.T
    mirrored = pressure(hz, x, -y) if symmetry is EVEN else -pressure(hz, x, -y)
    return 0.5 * (pressure(hz, x, y) + mirrored) @ reed.parts[symmetry].load_z


@pytest.mark.parametrize("hz", [700.0, 5.2e3, 13e3])
def test_a_force_at_one_point_moves_another_as_much_as_the_reverse(hz, coarse_reed):
    """Points on either side of the axis, so that both symmetries take part."""
    points = coarse_reed.load_points_m
    one, other = (
        np.argmin(np.hypot(*(points - place).T)) for place in ([2e-3, 4e-3], [15e-3, 2e-3])
    )

    def push_at(index, side):
        def pressure(_hz, x_m, y_m):
            at = (x_m == points[index, 0]) & (y_m == side * points[index, 1])
            return at.astype(complex)

        return forced_response(coarse_reed, CANE, LOSS, np.array([hz]), pressure)

    def motion_at(index, side, response):
        """Swept volume at a point of the flat side."""
        even, odd = (coarse_reed.parts[s].load_z[index] @ response[s][0] for s in (EVEN, ODD))
        return even + side * odd

    there = motion_at(other, -1, push_at(one, 1))
    back = motion_at(one, 1, push_at(other, -1))
    assert there == pytest.approx(back, rel=1e-9)
    same_side = motion_at(other, 1, push_at(one, 1))
    assert abs(same_side - there) > 1e-3 * abs(there)


@pytest.mark.parametrize("hz", [900.0, 1996.0, 8e3, 16e3])
def test_power_that_enters_is_dissipated(hz, coarse_reed):
    """``½ Re(F·v*) = ½ ω η q*·K q + ½ v*·R v`` with v = iωq: in cane, and as sound."""
    response = forced_response(coarse_reed, CANE, LOSS, np.array([hz]), uneven)
    omega = 2 * np.pi * hz
    air = [resistance for _, resistance in coarse_reed.air.at(hz)]
    for (symmetry, (q,)), R in zip(response.items(), air, strict=True):
        velocity = 1j * omega * q
        entering = 0.5 * np.real(np.conj(velocity) @ pushed(coarse_reed, symmetry, uneven, hz))
        lost = 0.5 * omega * LOSS * np.real(np.conj(q) @ stored(coarse_reed, symmetry, hz) @ q)
        lost += 0.5 * np.real(np.conj(velocity) @ R[: len(q), : len(q)] @ velocity)
        assert entering > 0
        assert entering == pytest.approx(lost, rel=1e-8)


def test_low_frequencies_bend_the_reed_as_a_static_pressure_does(coarse_reed):
    response = forced_response(coarse_reed, CANE, 0.0, np.array([1.0]), uneven)
    for symmetry, (q,) in response.items():
        force = pushed(coarse_reed, symmetry, uneven, 0.0)
        static = np.linalg.solve(stored(coarse_reed, symmetry, 0.0), force)
        np.testing.assert_allclose(q, static, atol=1e-6 * np.abs(static).max())


def test_a_static_push_on_the_flat_side_bends_the_tip_towards_the_bark(coarse_reed):
    response = forced_response(
        coarse_reed, CANE, LOSS, np.array([10.0]), lambda _hz, x, _y: np.ones_like(x)
    )
    half = coarse_reed.parts[EVEN]
    deflection = (half.surface_z @ response[EVEN][0]).real
    tip = np.argmin(np.hypot(*coarse_reed.plan_m.T))
    assert deflection[tip] > 0.9 * np.abs(deflection).max()


@pytest.mark.parametrize("name", ["F1", "T1", "X1"])
def test_at_resonance_the_amplitude_goes_with_the_inverse_of_the_loss(name, coarse_reed):
    mode = viscoelastic_mode(coarse_reed, CANE, name, 3e3, air_fraction=0.0)
    hz = np.array([mode.frequency_hz])
    tip = np.argmin(np.hypot(*(coarse_reed.plan_m - [2e-3, 4e-3]).T))
    amplitude = {}
    for loss in (0.002, 0.004):
        q = forced_response(coarse_reed, CANE, loss, hz, uneven, 0.0)[mode.symmetry][0]
        amplitude[loss] = coarse_reed.parts[mode.symmetry].surface_z[tip] @ q
        # One mode alone: its force over iηω² (its mass is one).
        force = mode.coordinates @ pushed(coarse_reed, mode.symmetry, uneven, hz[0])
        alone = mode.coordinates * force / (1j * loss * (2 * np.pi * hz[0]) ** 2)
        expected = coarse_reed.parts[mode.symmetry].surface_z[tip] @ alone
        assert abs(amplitude[loss] / expected - 1) < 0.05
    assert abs(amplitude[0.002] / amplitude[0.004]) == pytest.approx(2, rel=0.01)


def test_motion_lags_the_push_by_a_quarter_turn_at_resonance(coarse_reed):
    """And by less before, by more after: the sign of the time factor."""
    mode = viscoelastic_mode(coarse_reed, CANE, "F1", 2e3)
    tip = np.argmin(np.hypot(*coarse_reed.plan_m.T))
    phases = []
    for ratio in (0.5, 1.0, 1.3):
        q = forced_response(
            coarse_reed,
            CANE,
            LOSS,
            np.array([ratio * mode.frequency_hz]),
            lambda _hz, x, _y: (x < 10e-3).astype(complex),
        )
        phases.append(np.angle(coarse_reed.parts[EVEN].surface_z[tip] @ q[EVEN][0]))
    assert -0.2 < phases[0] < 0
    assert phases[1] == pytest.approx(-np.pi / 2, abs=0.1)
    assert -np.pi < phases[2] < -2.8


def test_response_is_linear_in_the_pressure(coarse_reed):
    hz = np.array([3.3e3])

    def other(_hz, x_m, y_m):
        return np.cos(100 * x_m) * (y_m > 0)

    def both(hz, x_m, y_m):
        return 2 * uneven(hz, x_m, y_m) - 3j * other(hz, x_m, y_m)

    one, two, sum_of_both = (
        forced_response(coarse_reed, CANE, LOSS, hz, p) for p in (uneven, other, both)
    )
    for symmetry in Symmetry:
        expected = 2 * one[symmetry] - 3j * two[symmetry]
        np.testing.assert_allclose(
            sum_of_both[symmetry], expected, atol=1e-12 * np.abs(expected).max()
        )


def test_symmetric_pressure_never_moves_the_antisymmetric_half(coarse_reed):
    frequencies = np.array([605.0, 3.5e3, 9.6e3])
    chamber = Chamber(Filling.SYMMETRIC)

    def pressure(hz, x_m, y_m):
        return pressure_shape(chamber, hz, x_m, y_m)

    response = forced_response(coarse_reed, CANE, LOSS, frequencies, pressure)
    assert not response[ODD].any()
    assert np.all(np.abs(response[EVEN]).max(axis=1) > 0)


def test_frequencies_are_solved_one_by_one(coarse_reed):
    frequencies = np.array([1e3, 4e3, 9e3])
    together = forced_response(coarse_reed, CANE, LOSS, frequencies, uneven)
    for k, hz in enumerate(frequencies):
        alone = forced_response(coarse_reed, CANE, LOSS, np.array([hz]), uneven)
        for symmetry in Symmetry:
            np.testing.assert_array_equal(together[symmetry][k], alone[symmetry][0])


@pytest.fixture(scope="module")
def full_errors(standard_reed, standard_mesh, standard_matrices, consistent_load):
    """Relative error of the deflection of the bark side, by frequency and symmetry."""
    chamber = Chamber(Filling.ASYMMETRIC)

    def pressure(hz, x_m, y_m):
        return pressure_shape(chamber, hz, x_m, y_m)

    errors = {}
    for hz in (605.0, 14e3):
        # The full model is in a vacuum.
        at = np.array([hz])
        reduced = forced_response(standard_reed, CANE, LOSS, at, pressure, air_fraction=0.0)
        K = stiffness(standard_matrices, stiffness_terms_pa(elastic(hz)))
        M = mass(standard_matrices, Cane().density_kg_m3)
        for symmetry in Symmetry:
            free, sign = free_dofs(standard_mesh, symmetry), 1 if symmetry is EVEN else -1
            load = np.zeros(3 * len(standard_mesh.nodes_m), dtype=complex)
            load[2::3] = consistent_load(
                standard_mesh,
                lambda x, y, hz=hz, sign=sign: (
                    0.5 * (pressure(hz, x, y) + sign * pressure(hz, x, -y))
                ),
            )
            dynamic = ((1 + 1j * LOSS) * K - (2 * np.pi * hz) ** 2 * M)[free][:, free]
            full = np.zeros_like(load)
            full[free] = factor(dynamic.tocsc())(load[free])
            expected = full[2::3].reshape(standard_mesh.block)[:, :, -1].ravel()
            found = standard_reed.parts[symmetry].surface_z @ reduced[symmetry][0]
            errors[hz, symmetry] = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    return errors


@pytest.mark.slow
def test_quasi_static_response_is_that_of_the_full_model(full_errors):
    assert max(full_errors[605.0, symmetry] for symmetry in Symmetry) < 0.01


@pytest.mark.slow
def test_forced_response_is_that_of_the_full_model(full_errors):
    assert max(full_errors.values()) < 0.01
