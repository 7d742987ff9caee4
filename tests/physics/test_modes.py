"""Named modes straight from finite elements: against other ways of finding the same."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.paper.constants import TABLE_9
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    viscoelastic_cane,
)
from physics.reed.elements.fem import (
    Symmetry,
    assemble,
    free_dofs,
    lowest_modes,
    mass,
    stiffness,
)
from physics.reed.elements.mesh import (
    FAST,
    MeshLevel,
    build_mesh,
    build_whole_mesh,
)
from physics.reed.geometry import (
    Clamp,
    Outline,
    ReedGeometry,
    ThicknessMap,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.modes import (
    at_frequency,
    reed_modes,
    viscoelastic_modes,
)
from physics.reed.reduced.elastic import elastic_modes
from physics.reed.reduction.metamodel import REFERENCE_HZ, Equation1
from protocols.reed import ReedFile
from tests.numbers import cents

# What is tested here holds on any mesh.
LEVEL = MeshLevel(orders=(2, 2, 2), edge_breaks_m=(), z_breaks=(0.0, 1.0))
CLASSES = {"F": "flexural", "T": "transversal", "X": "generic", "L": "lateral", "H": "heel"}


def frequencies(modes):
    return np.array([mode.frequency_hz for mode in modes])


@pytest.fixture(scope="module")
def mesh(geometry):
    return build_mesh(geometry, LEVEL)


@pytest.fixture(scope="module")
def matrices(mesh):
    return assemble(mesh)


@pytest.fixture(scope="module")
def modes(geometry):
    return reed_modes(geometry, Cane(), LEVEL)


def free_matrices(mesh, matrices, cane, symmetry):
    free = free_dofs(mesh, symmetry)
    K = stiffness(matrices, stiffness_terms_pa(cane))[free][:, free]
    return K, mass(matrices, cane.density_kg_m3)[free][:, free], free


# --- Elastic -----------------------------------------------------------------------------------


def test_all_modes_below_the_limit_are_there_and_no_others(modes, mesh, matrices):
    expected = []
    for symmetry in Symmetry:
        K, M, _ = free_matrices(mesh, matrices, Cane(), symmetry)
        found, _ = lowest_modes(K, M, 25)
        expected.append(found[found <= 20e3])
        own = [mode.frequency_hz for mode in modes if mode.symmetry is symmetry]
        np.testing.assert_allclose(own, np.sort(expected[-1]), rtol=1e-9)
    np.testing.assert_allclose(frequencies(modes), np.sort(np.concatenate(expected)), rtol=1e-9)


def test_shapes_have_the_energy_of_their_frequency(modes, mesh, matrices):
    K = stiffness(matrices, stiffness_terms_pa(Cane()))
    M = mass(matrices, 520.0)
    for mode in modes:
        u = mode.shape.ravel()
        assert u @ (M @ u) == pytest.approx(1, rel=1e-9)
        omega = 2 * np.pi * mode.frequency_hz
        assert u @ (K @ u) == pytest.approx(omega**2, rel=1e-7)
        assert not mode.shape[mesh.clamped].any()
        still = 1 if mode.symmetry is Symmetry.SYMMETRIC else 2
        assert not mode.shape[mesh.midplane, still].any()


def test_classes_follow_names(modes):
    assert [mode.name for mode in modes][:4] == ["F1", "T1", "F2", "T2"]
    assert len({mode.name for mode in modes}) == len(modes)
    for mode in modes:
        assert mode.klass == CLASSES[mode.name[0]]
        assert 0.2 < mode.similarity <= 1


def test_sideways_motion_bears_out_no_name_of_the_vamp(geometry):
    level = replace(LEVEL, orders=(3, 4, 2))
    matrices = assemble(build_mesh(geometry, level))
    for mode in reed_modes(geometry, Cane(), level, highest_hz=10e3):
        sideways = mode.shape[:, 1]
        share = 520.0 * sideways @ (matrices.mass @ sideways)
        if mode.klass == "lateral":
            assert share > 0.4
        else:
            assert mode.similarity <= 1 - share


def test_a_lower_limit_gives_the_same_modes_and_names(modes, geometry):
    few = reed_modes(geometry, Cane(), LEVEL, highest_hz=9000)
    assert 4 < len(few) < len(modes)
    for one, other in zip(few, modes, strict=False):
        assert (one.name, one.symmetry) == (other.name, other.symmetry)
        assert one.frequency_hz == pytest.approx(other.frequency_hz, rel=1e-9)
    assert modes[len(few)].frequency_hz > 9000


def test_reed_without_modes_below_the_limit(geometry):
    assert reed_modes(geometry, Cane(), LEVEL, highest_hz=100) == []
    cane = viscoelastic_cane(Components(), Series.A)
    assert viscoelastic_modes(geometry, Cane(), cane, LEVEL, highest_hz=100) == []


def test_jelly_is_refused(geometry):
    jelly = replace(Cane(), density_kg_m3=520e6)
    with pytest.raises(ImpossibleReedError, match="over 100 modes below 22000 Hz"):
        reed_modes(geometry, jelly, LEVEL)


def scaled(geometry, factor):
    """The same reed, every length multiplied."""

    def times(value):
        return tuple(times(v) for v in value) if isinstance(value, tuple) else factor * value

    o = geometry.outline
    outline = Outline(
        *(times(v) for v in (o.tip_radius_m, o.corner_radius_m, o.corner_x_m, o.side_half_width_m)),
        o.side_taper,
        times(o.length_m),
    )
    clamp = Clamp(times(geometry.clamp.x_m), times(geometry.clamp.y_m), geometry.clamp.side)
    return replace(
        geometry,
        outline=outline,
        vamp_x_m=times(geometry.vamp_x_m),
        vamp_y_m=times(geometry.vamp_y_m),
        vamp_z_m=times(geometry.vamp_z_m),
        heel_radius_m=times(geometry.heel_radius_m),
        heel_sagitta_m=times(geometry.heel_sagitta_m),
        clamp=clamp,
    )


def test_twice_the_size_is_an_octave_lower(geometry):
    """To some cents: behind the tip the mesh has a patch of fixed length."""
    small_level = MeshLevel(orders=(3, 3, 2), edge_breaks_m=())
    large_level = replace(
        small_level,
        vamp_element_m=2 * small_level.vamp_element_m,
        heel_element_m=2 * small_level.heel_element_m,
    )
    small = reed_modes(geometry, Cane(), small_level, highest_hz=12e3)
    large = reed_modes(scaled(geometry, 2.0), Cane(), large_level, highest_hz=6e3)
    assert [mode.name for mode in large] == [mode.name for mode in small]
    np.testing.assert_allclose(cents(frequencies(small), frequencies(large)), 1200, atol=5)


def test_four_times_as_stiff_or_light_is_an_octave_higher(modes, geometry):
    reference = Cane()
    moduli = ("E_L_pa", "E_T_pa", "E_R_pa", "G_LT_pa", "G_LR_pa", "G_TR_pa")
    stiff = replace(reference, **{name: 4 * getattr(reference, name) for name in moduli})
    light = replace(reference, density_kg_m3=reference.density_kg_m3 / 4)
    for cane in (stiff, light):
        higher = reed_modes(geometry, cane, LEVEL, highest_hz=40e3)
        assert [mode.name for mode in higher] == [mode.name for mode in modes]
        np.testing.assert_allclose(cents(frequencies(higher), frequencies(modes)), 1200, atol=1e-5)


# --- Names -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("E_L_pa", "G_LT_pa"), [(14e9, 1.1e9), (10e9, 1.5e9), (17e9, 0.7e9)])
def test_names_are_those_of_the_reduced_reed(coarse_reed, geometry, coarse_level, E_L_pa, G_LT_pa):
    """`response.elastic_modes` names the same reed by way of its reduced basis."""
    own = reed_modes(geometry, Cane(E_L_pa=E_L_pa, G_LT_pa=G_LT_pa), coarse_level)
    reduced = elastic_modes(coarse_reed, E_L_pa, G_LT_pa, air_fraction=0.0)
    for mode in own:
        assert cents(mode.frequency_hz, reduced[mode.name].frequency_hz) == pytest.approx(0, abs=3)


@pytest.mark.parametrize(("E_L_pa", "G_LT_pa"), [(14e9, 1.1e9), (7e9, 0.45e9)])
def test_likenesses_are_those_of_the_reduced_reed(
    coarse_reed, geometry, coarse_level, E_L_pa, G_LT_pa
):
    """But that there they are shares of the vamp's motion, here of all. Fine waves have less."""
    reduced = elastic_modes(coarse_reed, E_L_pa, G_LT_pa, air_fraction=0.0)
    compared = []
    for mode in reed_modes(geometry, Cane(E_L_pa=E_L_pa, G_LT_pa=G_LT_pa), coarse_level):
        other = reduced.get(mode.name)
        if other is None or abs(cents(mode.frequency_hz, other.frequency_hz)) > 3:
            continue
        half = coarse_reed.parts[other.symmetry].measures[other.symmetry]
        v = other.coordinates
        outside = 520.0 * v @ (half.lateral_mass + half.heel_mass) @ v
        left = 1.0 if mode.name[0] in "LH" else 1 - outside
        assert mode.similarity == pytest.approx(left * other.similarity, abs=3e-3), mode.name
        compared.append(mode.name)
    assert len(set(PAPER_MODES) & set(compared)) >= 10


def test_modes_are_near_the_papers_table_9(geometry):
    """But for T3, X3 and T4, for which the paper's mesh was too stiff."""
    own = {mode.name: mode.frequency_hz for mode in reed_modes(geometry, Cane(), FAST)}
    table = Equation1(PAPER_MODES, np.array([TABLE_9[name] for name in PAPER_MODES]))
    printed, _, _ = table.evaluate(np.full(11, 14e9), np.full(11, 1.1e9))
    for name, expected_cents in zip(PAPER_MODES, printed, strict=True):
        difference = cents(own[name], REFERENCE_HZ) - expected_cents
        if name in ("T3", "X3", "T4"):
            assert -160 < difference < 0, name
        else:
            assert abs(difference) < 50, name


def test_waves_too_fine_for_the_profiles_take_no_name_from_others():
    """The bass clarinet's T7 is below 20 kHz, and the profiles across reach order 6 only."""
    level = MeshLevel(orders=(3, 4, 2), edge_breaks_m=())
    modes = reed_modes(ReedFile.from_file("bass-clarinet").geometry(), Cane(), level)
    transversal = [mode.name for mode in modes if mode.klass == "transversal"]
    assert transversal == ["T1", "T2", "T3", "T4", "T5", "T6"]
    unnamed = [mode for mode in modes if mode.name.startswith("?")]
    assert [(mode.name, mode.similarity) for mode in unnamed] == [("?1a", 0.0)]
    assert unnamed[0].frequency_hz > modes[-1].frequency_hz * 0.9


def test_faint_resemblance_gives_no_name(geometry):
    level = MeshLevel(orders=(3, 4, 2), edge_breaks_m=(), z_breaks=(0.0, 1.0))
    modes = reed_modes(geometry, Cane(), level, highest_hz=40e3)
    named = [mode for mode in modes if not mode.name.startswith("?")]
    assert len({mode.name for mode in modes}) == len(modes)
    assert 0 < len(modes) - len(named) < 4
    assert min(mode.similarity for mode in named) > 0.1


# --- Viscoelastic ------------------------------------------------------------------------------


def brute_force_hz(mesh, matrices, cane, symmetry, number, start_hz):
    """Eigenfrequency of a number within its symmetry, iterated by solving the whole each time."""
    hz, previous = start_hz, 0.0
    while abs(hz - previous) > 1e-6 * hz:
        constants = at_frequency(Cane(), cane, hz)
        K, M, _ = free_matrices(mesh, matrices, constants, symmetry)
        found, _ = lowest_modes(K, M, number + 3)
        previous, hz = hz, np.sort(found)[number]
    return hz


@pytest.mark.parametrize(
    ("components", "series"),
    [(Components(), Series.A), (Components(1.0, -1.5, 1.5, 0.0), Series.B)],
)
def test_every_mode_has_the_moduli_of_its_own_frequency(
    components, series, geometry, mesh, matrices
):
    cane = viscoelastic_cane(components, series)
    modes = viscoelastic_modes(geometry, Cane(), cane, LEVEL)
    assert np.all(np.diff(frequencies(modes)) > 0)
    for symmetry in Symmetry:
        own = [mode.frequency_hz for mode in modes if mode.symmetry is symmetry]
        expected_hz = [
            brute_force_hz(mesh, matrices, cane, symmetry, number, 1.05 * hz)
            for number, hz in enumerate(own)
        ]
        # What the module promises; one cent was asked for.
        np.testing.assert_allclose(cents(own, expected_hz), 0, atol=0.1)


def test_cane_that_does_not_follow_frequency_is_elastic(modes, geometry):
    fixed = ViscoelasticCane(Zener(14000.0, 0.0, 0.0), Zener(1100.0, 0.0, 0.0))
    found = viscoelastic_modes(geometry, Cane(E_L_pa=1.0), fixed, LEVEL)
    assert [mode.name for mode in found] == [mode.name for mode in modes]
    np.testing.assert_allclose(cents(frequencies(found), frequencies(modes)), 0, atol=1e-5)


def test_shapes_of_viscoelastic_cane_are_mass_normalised(geometry, matrices):
    cane = viscoelastic_cane(Components(), Series.A)
    modes = viscoelastic_modes(geometry, Cane(), cane, LEVEL)
    M = mass(matrices, 520.0)
    for mode in modes[::4]:
        u = mode.shape.ravel()
        assert u @ (M @ u) == pytest.approx(1, rel=1e-6)


# --- Uneven reeds ------------------------------------------------------------------------------

X_M, Y_M = (2e-3, 15e-3, 32e-3), (-5e-3, 0.0, 5e-3)
EVEN_UM = np.array([[3.0, -2.0, 3.0], [-5.0, 1.0, -5.0], [2.0, 4.0, 2.0]])
ODD_UM = np.array([[-4.0, 0.0, 4.0], [3.0, 0.0, -3.0], [1.0, 0.0, -1.0]])
TILT_UM = np.tile([-1.0, 0.0, 1.0], (3, 1))
SYMMETRIC, ANTISYMMETRIC = Symmetry.SYMMETRIC, Symmetry.ANTISYMMETRIC
# F3 and T3 of the even reed have one frequency.
CROSSING = Cane(G_LT_pa=1.445927e9)


def reed_with(deviation_um, y_m=Y_M):
    rows = tuple(tuple(row) for row in (1e-6 * np.asarray(deviation_um)).tolist())
    return ReedGeometry(thickness_map=ThicknessMap(X_M, tuple(y_m), rows))


def as_if_uneven(deviation_um):
    """An even map that says what is known anyway: beyond the last point nothing changes."""
    return reed_with(np.column_stack([deviation_um, deviation_um[:, -1]]), (*Y_M, 7e-3))


def by_name(modes):
    named = {mode.name: mode for mode in modes}
    assert len(named) == len(modes)
    return named


def reflected(mesh, shape):
    """Motion (n, 3) seen in a mirror in the median plane."""
    columns = shape.reshape(*mesh.block, 3)[:, ::-1]
    return (columns * [1, -1, 1]).reshape(shape.shape)


def shifts_hz(geometry, reference, cane=CROSSING):
    found = by_name(reed_modes(geometry, cane, LEVEL, highest_hz=14e3))
    assert set(found) == set(reference)
    return {name: found[name].frequency_hz - mode.frequency_hz for name, mode in reference.items()}


@pytest.fixture(scope="module")
def crossing():
    return by_name(reed_modes(reed_with(0 * EVEN_UM), CROSSING, LEVEL, highest_hz=14e3))


def test_an_even_reed_solved_whole_has_the_modes_of_its_halves():
    halves = reed_modes(reed_with(EVEN_UM), Cane(), LEVEL)
    whole = reed_modes(as_if_uneven(EVEN_UM), Cane(), LEVEL)
    assert len(whole[0].shape) > 1.8 * len(halves[0].shape)
    np.testing.assert_allclose(frequencies(whole), frequencies(halves), rtol=1e-9)
    for one, other in zip(whole, halves, strict=True):
        assert (one.name, one.klass, one.symmetry) == (other.name, other.klass, other.symmetry)
        assert one.similarity == pytest.approx(other.similarity, abs=1e-6)


def test_viscoelastic_cane_of_an_even_reed_solved_whole():
    cane = viscoelastic_cane(Components(1.0, -1.5, 1.5, 0.0), Series.B)
    halves = viscoelastic_modes(reed_with(EVEN_UM), Cane(), cane, LEVEL, highest_hz=12e3)
    whole = viscoelastic_modes(as_if_uneven(EVEN_UM), Cane(), cane, LEVEL, highest_hz=12e3)
    assert [mode.name for mode in whole] == [mode.name for mode in halves]
    np.testing.assert_allclose(cents(frequencies(whole), frequencies(halves)), 0, atol=1e-3)


def test_mirror_images_have_equal_frequencies():
    deviation_um = 3 * EVEN_UM + 8 * ODD_UM
    here, there = reed_with(deviation_um), reed_with(deviation_um[:, ::-1])
    mesh = build_whole_mesh(here, LEVEL)
    for one, other in zip(
        reed_modes(here, Cane(), LEVEL), reed_modes(there, Cane(), LEVEL), strict=True
    ):
        assert (one.name, one.symmetry) == (other.name, other.symmetry)
        assert one.frequency_hz == pytest.approx(other.frequency_hz, rel=1e-9)
        assert one.similarity == pytest.approx(other.similarity, abs=1e-5)
        image = reflected(mesh, other.shape)
        sign = np.sign(np.vdot(image, one.shape))
        np.testing.assert_allclose(sign * image, one.shape, atol=1e-4 * np.abs(image).max())


def test_shapes_of_an_uneven_reed_have_the_energy_of_their_frequency():
    geometry = reed_with(EVEN_UM + 8 * ODD_UM)
    mesh = build_whole_mesh(geometry, LEVEL)
    matrices = assemble(mesh)
    K, M = stiffness(matrices, stiffness_terms_pa(Cane())), mass(matrices, 520.0)
    for mode in reed_modes(geometry, Cane(), LEVEL):
        u = mode.shape.ravel()
        assert u @ (M @ u) == pytest.approx(1, rel=1e-9)
        assert u @ (K @ u) == pytest.approx((2 * np.pi * mode.frequency_hz) ** 2, rel=1e-7)
        assert not mode.shape[mesh.clamped].any()


def test_symmetry_is_that_of_the_larger_part():
    geometry = reed_with(4 * TILT_UM)
    mesh = build_whole_mesh(geometry, LEVEL)
    M = assemble(mesh).mass
    shares = []
    for mode in reed_modes(geometry, CROSSING, LEVEL):
        mirrored = reflected(mesh, mode.shape)
        even, odd = (
            np.sum(part * (M @ part)) for part in (mode.shape + mirrored, mode.shape - mirrored)
        )
        assert mode.symmetry is (SYMMETRIC if even > odd else ANTISYMMETRIC)
        shares.append(min(even, odd) / (even + odd))
    # Some are hardly mixed, others nearly by halves.
    assert min(shares) < 0.01
    assert max(shares) > 0.3


def test_only_the_even_part_of_a_map_changes_frequencies_to_first_order(crossing):
    """But of F3 and T3, which have one frequency (see the next test)."""
    apart = [name for name in crossing if name not in ("F3", "T3")]
    even, twice_even = (shifts_hz(reed_with(k * EVEN_UM), crossing) for k in (0.25, 0.5))
    odd, twice_odd = (shifts_hz(reed_with(k * ODD_UM), crossing) for k in (0.25, 0.5))
    both_um = EVEN_UM + ODD_UM
    both, twice_both = (shifts_hz(reed_with(k * both_um), crossing) for k in (0.25, 0.5))
    for name in apart:
        assert twice_even[name] == pytest.approx(2 * even[name], rel=0.1, abs=0.2)
        assert twice_odd[name] == pytest.approx(4 * odd[name], rel=0.02, abs=1e-4)
        difference, twice = both[name] - even[name], twice_both[name] - twice_even[name]
        assert twice == pytest.approx(4 * difference, rel=0.1, abs=1e-3)
        assert abs(difference) < 0.05
    assert max(abs(even[name]) for name in apart) > 5


def test_two_modes_of_one_frequency_and_unlike_symmetry_mix_to_first_order(crossing):
    """Degenerate perturbation theory: they part by their coupling, and each is half of either."""
    pair = [crossing[name] for name in ("F3", "T3")]
    assert abs(pair[0].frequency_hz - pair[1].frequency_hz) < 0.01
    omega = 2 * np.pi * pair[0].frequency_hz
    half_mesh, little = build_mesh(ReedGeometry(), LEVEL), 0.01
    u, v = (on_both_sides(half_mesh, mode).ravel() for mode in pair)
    matrices = assemble(build_whole_mesh(reed_with(little * TILT_UM), LEVEL))
    K, M = stiffness(matrices, stiffness_terms_pa(CROSSING)), mass(matrices, 520.0)
    coupling = (u @ (K @ v) - omega**2 * (u @ (M @ v))) / little
    found = by_name(reed_modes(reed_with(TILT_UM), CROSSING, LEVEL, highest_hz=14e3))
    gap_hz = abs(found["F3"].frequency_hz - found["T3"].frequency_hz)
    assert gap_hz == pytest.approx(abs(coupling) / (2 * np.pi * omega), rel=0.01)
    assert gap_hz > 0.5
    for name, mode in found.items():
        left = 0.5 if name in ("F3", "T3") else 1.0
        assert mode.similarity == pytest.approx(left * crossing[name].similarity, rel=0.03)


def on_both_sides(half_mesh, mode):
    """Motion of a half reed as one of the whole, mass-normalised over it."""
    sign = 1 if mode.symmetry is SYMMETRIC else -1
    half = mode.shape.reshape(*half_mesh.block, 3)
    return np.concatenate([sign * half[:, :0:-1] * [1, -1, 1], half], axis=1) / np.sqrt(2)


def test_a_reed_may_be_uneven_beyond_recognition(geometry):
    """100 µm more on the right: no two modes share a name, and the first keep theirs."""
    lopsided = reed_with(np.tile([0.0, 50.0, 100.0], (3, 1)))
    modes = reed_modes(lopsided, Cane(), LEVEL, highest_hz=40e3)
    assert len({mode.name for mode in modes}) == len(modes)
    assert [mode.name for mode in modes[:3]] == ["F1", "T1", "F2"]
    for mode in modes:
        assert 0 <= mode.similarity <= 1
        if mode.name.startswith("?"):
            assert mode.name[-1] == mode.symmetry[0]
