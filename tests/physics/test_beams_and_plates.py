"""The finite elements against beams and plates whose frequencies are known.

Each half box is solved in both symmetries about y = 0: the symmetric half holds bending in z and
stretching, the antisymmetric half bending in y and torsion.
"""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import (
    Symmetry,
    assemble,
    free_dofs,
    lowest_modes,
    mass,
    stiffness,
)

DENSITY = 520.0
SHEAR_COEFFICIENT = 5 / 6


def isotropic(E_pa, nu):
    G = E_pa / (2 * (1 + nu))
    return Cane(E_pa, E_pa, E_pa, G, G, G, nu, nu, nu, DENSITY)


def frequencies_hz(mesh, cane, symmetry, count, free=None):
    matrices = assemble(mesh)
    free = free_dofs(mesh, symmetry) if free is None else free
    K = stiffness(matrices, stiffness_terms_pa(cane))[free][:, free]
    M = mass(matrices, cane.density_kg_m3)[free][:, free]
    return np.sort(lowest_modes(K, M, count)[0])


def timoshenko_hz(length_m, depth_m, E_pa, G_pa, count, *, held_at_both_ends=False):
    """Frequencies of a Timoshenko beam of rectangular section, per unit width.

    The state (w, ψ, M, V) obeys a linear system along x; a mode is a frequency at which the ends'
    conditions leave a state other than zero.
    """
    area, inertia = depth_m, depth_m**3 / 12
    # Scaled so that all entries of the system are of order 1.
    force = E_pa * inertia / length_m**2
    size = np.array([length_m, 1.0, force * length_m, force])
    end = slice(0, 2) if held_at_both_ends else slice(2, 4)

    def closing(hz):
        omega2 = (2 * np.pi * hz) ** 2
        system = np.zeros((4, 4))
        system[0, 1] = 1
        system[0, 3] = 1 / (SHEAR_COEFFICIENT * G_pa * area)
        system[1, 2] = 1 / (E_pa * inertia)
        system[2, 1], system[2, 3] = -DENSITY * inertia * omega2, -1
        system[3, 0] = -DENSITY * area * omega2
        along = expm(length_m * system / size[:, None] * size)
        return np.linalg.det(along[end, 2:])

    euler_hz = 0.1615 * depth_m / length_m**2 * np.sqrt(E_pa / DENSITY)
    grid = euler_hz * np.geomspace(0.3, 200, 1500)
    values = [closing(hz) for hz in grid]
    crossings = np.flatnonzero(np.diff(np.sign(values)))[:count]
    return np.array([brentq(closing, grid[k], grid[k + 1]) for k in crossings])


def torsion_constant(width_m, depth_m):
    """Saint-Venant's series for a rectangle, width ≥ depth."""
    n = np.arange(1, 40, 2)
    series = np.sum(np.tanh(n * np.pi * width_m / (2 * depth_m)) / n**5)
    return width_m * depth_m**3 / 3 * (1 - 192 * depth_m / (np.pi**5 * width_m) * series)


def test_timoshenko_beams_have_eulers_limit():
    """The reference itself: clamped-free 1.8751, 4.6941; clamped-clamped 4.7300, 7.8532."""
    unit = np.sqrt(1e10 / DENSITY / 12) * 1e-4 / (2 * np.pi)
    slender = timoshenko_hz(1.0, 1e-4, 1e10, 1e12, 2)
    np.testing.assert_allclose(slender / unit, [1.87510**2, 4.69409**2], rtol=1e-4)
    slender = timoshenko_hz(1.0, 1e-4, 1e10, 1e12, 2, held_at_both_ends=True)
    np.testing.assert_allclose(slender / unit, [4.73004**2, 7.85320**2], rtol=1e-4)


@pytest.fixture(scope="module")
def cantilever(box_mesh):
    """100 mm long, 8 mm wide, 5 mm thick; half of it."""
    return box_mesh((0.1, 4e-3, 5e-3), (6, 1, 1), (4, 3, 3), lambda x, _y, _z: x == 0)


def test_isotropic_cantilever_bends_up_and_down(cantilever):
    E = 10e9
    expected = timoshenko_hz(0.1, 5e-3, E, E / 2, 3)
    stretching = 0.25 / 0.1 * np.sqrt(E / DENSITY)
    found = frequencies_hz(cantilever, isotropic(E, 0.0), Symmetry.SYMMETRIC, 4)
    np.testing.assert_allclose(found, [*expected, stretching], rtol=1e-3)


def test_isotropic_cantilever_bends_sideways_and_twists(cantilever):
    E = 10e9
    bending = timoshenko_hz(0.1, 8e-3, E, E / 2, 3)
    polar = 8e-3 * 5e-3 * (8e-3**2 + 5e-3**2) / 12
    twisting = 0.25 / 0.1 * np.sqrt(E / 2 / DENSITY * torsion_constant(8e-3, 5e-3) / polar)
    found = frequencies_hz(cantilever, isotropic(E, 0.0), Symmetry.ANTISYMMETRIC, 4)
    np.testing.assert_allclose(found[[0, 1, 3]], bending, rtol=1e-3)
    # The clamp hinders the section from warping, which Saint-Venant does not know of.
    assert found[2] == pytest.approx(twisting, rel=0.01)
    assert found[2] > twisting


def test_poissons_ratio_only_matters_at_the_clamp_of_a_slender_beam(cantilever):
    expected = timoshenko_hz(0.1, 5e-3, 10e9, 10e9 / 2.6, 3)
    found = frequencies_hz(cantilever, isotropic(10e9, 0.3), Symmetry.SYMMETRIC, 3)
    np.testing.assert_allclose(found, expected, rtol=0.01)
    assert np.all(found > expected)


def test_grain_along_x_stiffens_bending_along_x(box_mesh):
    """Cane's own constants: E_L for bending, G_LR and G_LT for the shear that goes with it."""
    mesh = box_mesh((60e-3, 3e-3, 3e-3), (6, 1, 1), (4, 3, 3), lambda x, _y, _z: x == 0)
    cane = Cane(G_LR_pa=0.6e9, density_kg_m3=DENSITY)
    up_and_down = timoshenko_hz(60e-3, 3e-3, cane.E_L_pa, cane.G_LR_pa, 3)
    found = frequencies_hz(mesh, cane, Symmetry.SYMMETRIC, 3)
    np.testing.assert_allclose(found, up_and_down, rtol=3e-3)
    sideways = timoshenko_hz(60e-3, 6e-3, cane.E_L_pa, cane.G_LT_pa, 2)
    found = frequencies_hz(mesh, cane, Symmetry.ANTISYMMETRIC, 8)
    for expected in sideways:
        assert np.abs(found / expected - 1).min() < 3e-3


def test_bending_across_the_grain_is_that_of_the_tangential_modulus(box_mesh):
    """A bar along y held at both ends; its halves are odd and even modes."""
    mesh = box_mesh((2e-3, 30e-3, 2e-3), (1, 6, 1), (3, 4, 3), lambda _x, y, _z: y == 30e-3)
    cane = Cane(E_T_pa=0.5e9, E_R_pa=2e9, G_TR_pa=0.3e9, nu_LT=0, nu_LR=0, nu_TR=0)
    expected = timoshenko_hz(60e-3, 2e-3, cane.E_T_pa, cane.G_TR_pa, 3, held_at_both_ends=True)
    symmetric = frequencies_hz(mesh, cane, Symmetry.SYMMETRIC, 8)
    antisymmetric = frequencies_hz(mesh, cane, Symmetry.ANTISYMMETRIC, 8)
    for found, hz in ((symmetric, expected[0]), (antisymmetric, expected[1])):
        assert np.abs(found / hz - 1).min() < 2e-3
    assert np.abs(symmetric / expected[2] - 1).min() < 2e-3
    assert min(symmetric[0], antisymmetric[0]) > 0.99 * expected[0]


SIDE_M, PLATE_M = 40e-3, 0.2e-3


def plate_hz(coefficient, E_pa, nu):
    """From ``ω a² √(ρh/D)``."""
    rigidity = E_pa * PLATE_M**3 / (12 * (1 - nu**2))
    return coefficient / (2 * np.pi * SIDE_M**2) * np.sqrt(rigidity / (DENSITY * PLATE_M))


def test_clamped_square_plate_has_leissas_frequencies(box_mesh):
    """35.992, 73.413 (twice), 108.27, 131.64: Leissa, *Vibration of Plates* (1969), table 4.21.

    The coefficients hold for every Poisson ratio; without one, the clamp has no boundary layer as
    thin as the plate, which a theory of plates does not know of.
    """
    mesh = box_mesh(
        (SIDE_M, SIDE_M / 2, PLATE_M),
        (6, 3, 1),
        (5, 5, 2),
        lambda x, y, _z: (x == 0) | (x == SIDE_M) | (y == SIDE_M / 2),
    )
    cane = isotropic(5e9, 0.0)
    for symmetry, coefficients in (
        (Symmetry.SYMMETRIC, [35.992, 73.413, 131.64]),
        (Symmetry.ANTISYMMETRIC, [73.413, 108.27]),
    ):
        expected = plate_hz(np.array(coefficients), 5e9, 0.0)
        found = frequencies_hz(mesh, cane, symmetry, len(coefficients))
        np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_cantilevered_square_plate_has_leissas_frequencies(box_mesh):
    """3.492, 8.525, 21.43, 27.33, 31.11: Leissa, J. Sound Vib. 31 (1973) 257, upper bounds."""
    mesh = box_mesh((SIDE_M, SIDE_M / 2, PLATE_M), (5, 3, 1), (5, 5, 2), lambda x, _y, _z: x == 0)
    cane = isotropic(5e9, 0.3)
    for symmetry, coefficients in (
        (Symmetry.SYMMETRIC, [3.492, 21.43, 27.33]),
        (Symmetry.ANTISYMMETRIC, [8.525, 31.11]),
    ):
        bound = plate_hz(np.array(coefficients), 5e9, 0.3)
        found = frequencies_hz(mesh, cane, symmetry, len(coefficients))
        np.testing.assert_allclose(found, bound, rtol=8e-3)
        assert np.all(found < bound)


def test_simply_supported_orthotropic_plate_is_naviers(box_mesh):
    """Closed form, with all four bending stiffnesses of a plate whose grain lies along x."""
    length, width = 40e-3, 20e-3
    mesh = box_mesh((length, width / 2, PLATE_M), (4, 2, 1), (5, 5, 2))
    cane = Cane(density_kg_m3=DENSITY)
    x, y, _ = mesh.nodes_m.T
    across, along = np.isclose(x % length, 0), np.isclose(y, width / 2)
    minor = 1 - cane.nu_LT**2 * cane.E_T_pa / cane.E_L_pa
    D11, D22 = (E * PLATE_M**3 / (12 * minor) for E in (cane.E_L_pa, cane.E_T_pa))
    D12, D66 = cane.nu_LT * D22, cane.G_LT_pa * PLATE_M**3 / 12

    def navier_hz(m, n):
        a, b = m / length, n / width
        omega2 = D11 * a**4 + 2 * (D12 + 2 * D66) * (a * b) ** 2 + D22 * b**4
        return 0.5 * np.pi * np.sqrt(omega2 / (DENSITY * PLATE_M))

    for symmetry, orders in (
        (Symmetry.SYMMETRIC, [(1, 1), (2, 1), (1, 3)]),
        (Symmetry.ANTISYMMETRIC, [(1, 2), (2, 2)]),
    ):
        held = np.ones((len(x), 3), dtype=bool)
        held.ravel()[free_dofs(mesh, symmetry)] = False
        # Deflection and the tangential motion vanish on a simply supported edge.
        held[across, 1] = held[along, 0] = held[across | along, 2] = True
        found = frequencies_hz(mesh, cane, symmetry, 6, np.flatnonzero(~held.ravel()))
        for m, n in orders:
            assert np.abs(found / navier_hz(m, n) - 1).min() < 1e-3, (m, n)
        assert found[0] == pytest.approx(navier_hz(*orders[0]), rel=1e-3)
