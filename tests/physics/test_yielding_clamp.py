"""A clamp whose strips rest on elastic beds: against finite elements on springs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from holography.arrays import Array
from physics.alterations import YieldingClamp, unit_change, with_sliding
from physics.mechanics import Mechanics, ReedSolver
from physics.reed.cane.material import stiffness_terms_pa
from physics.reed.cane.viscoelastic import ViscoelasticCane, Zener
from physics.reed.elements.fem import assemble, lowest_modes, mass, stiffness
from physics.reed.elements.mesh import STANDARD, build_least_mesh
from physics.reed.reduced.boundary import STRIP_AXES, bark_side
from physics.reed.reduced.changes import BED_SHEAR, combined, yielding_clamp
from physics.reed.reduced.vibrations import vibrations
from tests.numbers import cents

ELASTIC = ViscoelasticCane(Zener(14000.0, 0.0, 0.0), Zener(1100.0, 0.0, 0.0))
HIGHEST_HZ = 12e3


@pytest.fixture(scope="module")
def springs(standard_reed):
    """Finite elements with nothing held: stiffness, mass, springs of 1 Pa per m, condition."""
    geometry = standard_reed.geometry
    mesh = build_least_mesh(geometry, STANDARD)
    matrices = assemble(mesh)
    cane = replace(standard_reed.cane, E_L_pa=14e9, G_LT_pa=1.1e9)
    bark, (front, back) = bark_side(mesh), geometry.clamp.x_m
    x, y = bark.points_m.T
    inner, outer = geometry.clamp.y_m
    on_strip = (x > front) & (x < back) & (y > inner) & (y < outer)
    area = (bark.area_m2 * on_strip).reshape(len(bark.elements), -1)
    assert area.sum() == pytest.approx((back - front) * (outer - inner))
    gram = np.einsum("eg,ga,gb->eab", area, bark.values, bark.values, optimize=True)
    nodes = np.broadcast_to(bark.elements[:, :, None], gram.shape)
    places = nodes.ravel(), np.swapaxes(nodes, 1, 2).ravel()
    count = len(mesh.nodes_m)
    bed = sparse.csc_array((gram.ravel(), places), shape=(count, count))
    K = stiffness(matrices, stiffness_terms_pa(cane))
    return K, mass(matrices, cane.density_kg_m3), bed, mesh.midplane


def on_springs(springs, away_m_pa, along_m_pa):
    """Frequencies of both symmetries below 12 kHz."""
    K, M, bed, midplane = springs
    K = K + sparse.kron(bed, np.diag([1 / along_m_pa, 1 / along_m_pa, 1 / away_m_pa])).tocsc()
    found = []
    for still in ((1,), (0, 2)):
        held = np.zeros((len(midplane), 3), dtype=bool)
        held[:, still] = midplane[:, None]
        free = np.flatnonzero(~held.ravel())
        hz, _ = lowest_modes(K[free][:, free].tocsc(), M[free][:, free].tocsc(), 8)
        found += hz[hz < HIGHEST_HZ].tolist()
    return np.sort(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("away_m_pa", "times"), [(5e-14, BED_SHEAR), (2.5e-13, BED_SHEAR), (1e-12, 1.2), (1e-12, 4.3)]
)
def test_modes_are_those_of_finite_elements_on_springs(
    standard_reed, springs, away_m_pa, times
) -> None:
    solver = ReedSolver(standard_reed)
    reed = Mechanics(
        cane=ELASTIC,
        air_share=0.0,
        alterations=((YieldingClamp(), away_m_pa),),
        bed_shear_log=float(np.log(times / BED_SHEAR)),
    )
    expected = on_springs(springs, away_m_pa, times * away_m_pa)
    found = np.sort(vibrations(standard_reed, solver.state(reed), HIGHEST_HZ).hz)
    assert len(found) == len(expected) >= 10
    apart = cents(found, expected)
    # The two modes in which the reed moves sideways ask for most of the strips' coordinates.
    assert np.sort(np.abs(apart))[:-2].max() < 3
    assert np.abs(apart).max() < 14


def test_strips_move_in_one_direction_in_each_coordinate(coarse_reed) -> None:
    m2 = coarse_reed.strip_m2
    apart = STRIP_AXES[:, None] != STRIP_AXES
    assert m2.shape == apart.shape
    assert np.abs(m2[apart]).max() == 0


def test_beds_yield_along_the_reed_by_their_shear(coarse_reed) -> None:
    """An even bed in all directions, and the two parts that add up to one of hard plastic."""
    even = yielding_clamp(coarse_reed, 1e-13, 2e-13, along=1.0).compliance_m_n
    away, along = (
        yielding_clamp(coarse_reed, 1e-13, 2e-13, away=a, along=b).compliance_m_n
        for a, b in ((1.0, 0.0), (0.0, 1.0))
    )
    np.testing.assert_allclose(even, away + along, rtol=1e-12)
    whole = yielding_clamp(coarse_reed, 1e-13, 2e-13).compliance_m_n
    np.testing.assert_allclose(whole, away + BED_SHEAR * along, rtol=1e-12)
    own = np.linalg.inv(coarse_reed.strip_m2)
    np.testing.assert_allclose(even[: len(own), : len(own)], 1.5e-13 * own, rtol=1e-9)


def test_all_clamps_of_a_reed_have_one_ratio(coarse_reed) -> None:
    log = 0.4
    clamps = ((YieldingClamp(), 1e-13), (YieldingClamp(1), 5e-14))
    made = combined((a, unit_change(coarse_reed, k)) for k, a in with_sliding(clamps, log))
    times = BED_SHEAR * np.exp(log)
    expected = yielding_clamp(coarse_reed, 1.5e-13, 1e-13, along=times).compliance_m_n
    np.testing.assert_allclose(made.compliance_m_n, expected, rtol=1e-9)


def test_more_shear_lowers_what_bends_and_moves_sideways_and_spares_what_twists(
    coarse_reed,
) -> None:
    solver, soft = ReedSolver(coarse_reed), ((YieldingClamp(), 1e-13),)
    plain, more = (
        solver.modes(Mechanics(alterations=soft, bed_shear_log=log)) for log in (0.0, 0.5)
    )
    shift = {name: cents(more[name].hz, plain[name].hz) for name in ("F1", "F2", "T2", "X1")}
    assert shift["F1"] < -2
    assert shift["F2"] < -2
    assert shift["X1"] < -5
    assert abs(shift["T2"]) < 0.5
    # Without a clamp that yields there is nothing to shear.
    rigid = [solver.modes(Mechanics(bed_shear_log=log))["F1"].hz for log in (0.0, 0.5)]
    assert rigid[0] == rigid[1]


def test_modes_that_a_clamp_mixes_have_names_in_the_order_that_is_known(coarse_reed) -> None:
    """L1 and X1 exchange their shapes over a decade of compliance, and never meet."""
    plain = ReedSolver(coarse_reed)
    clamps = 1e-13 * np.arange(0.5, 8.0, 0.5)
    reeds = [Mechanics(alterations=((YieldingClamp(), float(each)),)) for each in clamps]

    def hz(solver, name) -> Array:
        return np.array([solver.modes(reed)[name].hz for reed in reeds])

    assert np.abs(np.diff(np.log(hz(plain, "L1")))).max() > 0.05
    one, other = plain.in_order(("L1", "X1")), plain.in_order(("X1", "L1"))
    # Hardly mixed: names are those of the shapes.
    assert hz(one, "L1")[0] == hz(plain, "L1")[0] > hz(plain, "X1")[0]
    mixed = slice(np.flatnonzero(hz(one, "L1") < hz(one, "X1"))[0], None)
    assert clamps[mixed][0] < 3e-13
    assert np.abs(np.diff(np.log(hz(one, "L1")[mixed]))).max() < 0.03
    np.testing.assert_array_equal(hz(other, "X1")[mixed], hz(one, "L1")[mixed])
    np.testing.assert_array_equal(hz(other, "L1")[mixed], hz(one, "X1")[mixed])
    for name in ("F1", "T2", "F3"):
        np.testing.assert_array_equal(hz(one, name), hz(plain, name))
