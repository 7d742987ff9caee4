"""The basis over materials against the finite elements that it stands for, and itself."""

from dataclasses import astuple, fields, replace

import numpy as np
import pytest
from scipy import linalg
from scipy.optimize import linear_sum_assignment

from physics.errors import ImpossibleReedError
from physics.reed.cane.material import (
    STIFFNESS_TERMS,
    Cane,
    stiffness_terms_pa,
)
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    storage_modulus_pa,
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
from physics.reed.elements.mesh import MeshLevel, build_mesh
from physics.reed.geometry import (
    Clamp,
    ClampSide,
    ReedGeometry,
)
from physics.reed.material_range.basis import (
    HalfMaterialBasis,
    all_modes,
    condensed_stiffness,
    modes,
)
from physics.reed.material_range.cache import material_basis
from physics.reed.material_range.constants import (
    CONSTANTS,
    MODULI,
    SLOPES,
    MaterialBox,
    constants_of,
    possible_canes,
    terms_and_slopes,
    within_box,
)
from physics.reed.material_range.integrals import integrals
from physics.reed.material_range.snapshots import (
    TrainingSettings,
    at_place,
    canes_of_box,
    large_bases,
)
from physics.reed.material_range.training import build_material_basis
from physics.reed.material_range.viscoelastic import settled_modes
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.modes import (
    ModeClass,
    reed_modes,
    viscoelastic_modes,
)

# Too coarse for the truth about reeds: a basis is compared with its own finite elements.
LEVEL = MeshLevel(
    orders=(2, 2, 2),
    edge_breaks_m=(),
    z_breaks=(0.0, 1.0),
    vamp_element_m=5e-3,
    heel_element_m=23e-3,
)
SETTINGS = TrainingSettings(samples=192, aim_cents=2.0)
TINY = MeshLevel(orders=(2, 2, 2), edge_breaks_m=(), z_breaks=(0.0, 1.0), vamp_element_m=14e-3)
FEW = TrainingSettings(snapshots=4, samples=16, highest_hz=8e3)
BOX = MaterialBox()
LIMITS = np.asarray(astuple(BOX))
PROMISED_CENTS = 3.0
# Modes that look the same all over the box: not T4, whose foot may have a nodal line of its own.
STEADY = {*PAPER_MODES, "L1"} - {"T4"}


@pytest.fixture(scope="module")
def basis():
    return build_material_basis(ReedGeometry(), LEVEL, SETTINGS)


def fem_hz(cane, offset_m, geometry=None, level=LEVEL, count=16):
    geometry = geometry or ReedGeometry()
    offset_m += geometry.thickness_offset_m
    mesh = build_mesh(replace(geometry, thickness_offset_m=offset_m), level)
    matrices = assemble(mesh)
    K = stiffness(matrices, stiffness_terms_pa(cane))
    M = mass(matrices, cane.density_kg_m3)
    answer = {}
    for symmetry in Symmetry:
        free = free_dofs(mesh, symmetry)
        answer[symmetry] = np.sort(lowest_modes(K[free][:, free], M[free][:, free], count)[0])
    return answer


def reeds(count, seed, *, corners=False):
    """Canes (n,) and offsets (n,) at random in the box, or at its corners."""
    rng = np.random.default_rng(seed)
    shares = rng.random((count, 10))
    inputs = LIMITS[:, 0] + np.diff(LIMITS)[:, 0] * (np.round(shares) if corners else shares)
    canes = [Cane(*row[:9].tolist(), rng.uniform(420, 620)) for row in inputs]
    return canes, inputs[:, 9]


def density_of(canes):
    return np.array([cane.density_kg_m3 for cane in canes])


def errors_cents(basis, canes, offsets_m, geometry=None, highest_hz=20e3):
    """Deviations (n, m) from finite elements, each mode with its nearest; NaN if too high."""
    found = modes(basis, constants_of(canes), density_of(canes), offsets_m)
    errors = np.full(found.hz.shape, np.nan)
    for k, (cane, offset) in enumerate(zip(canes, offsets_m, strict=True)):
        true_hz = fem_hz(cane, float(offset), geometry)
        for symmetry, half in basis.halves.items():
            at = np.array([basis.names.index(name) for name in half.names])
            cents = 1200 * np.log2(found.hz[k, at][:, None] / true_hz[symmetry])
            rows, columns = linear_sum_assignment(np.minimum(np.abs(cents), 100))
            errors[k, at[rows]] = cents[rows, columns]
    errors[found.hz > highest_hz] = np.nan
    return errors


@pytest.mark.slow
class TestAgainstFiniteElements:
    @pytest.mark.parametrize("corners", [False, True], ids=["inside", "corners"])
    def test_frequencies_are_those_of_the_finite_elements(self, basis, corners):
        """At thicknesses between those of the snapshots, as everything else is."""
        canes, offsets = reeds(8, seed=11, corners=corners)
        errors = errors_cents(basis, canes, offsets)
        assert np.isfinite(errors).sum() > 100
        assert np.nanmax(np.abs(errors)) < PROMISED_CENTS
        # A subspace alone would err to one side.
        assert np.nanmin(errors) < 0 < np.nanmax(errors)

    def test_errors_are_as_small_as_training_says_and_typically_none(self, basis):
        errors = [
            errors_cents(basis, *reeds(count, seed=11, corners=corners))
            for count, corners in ((6, False), (20, True))
        ]
        assert abs(np.mean([np.nanmedian(part) for part in errors])) < 0.3
        stated = max(half.error_cents for half in basis.halves.values())
        assert stated <= SETTINGS.aim_cents
        # The larger model errs too, a little.
        assert max(np.nanmax(np.abs(part)) for part in errors) < stated + 0.3

    def test_every_input_moves_frequencies_as_in_the_finite_elements(self, basis):
        """Tenth of the range to either side: the change by slopes and by finite elements."""
        cane, step = Cane(E_L_pa=12e9, G_LT_pa=0.9e9), 0.05
        centre = np.append(constants_of([cane])[0], 4e-6)
        slopes = modes(basis, centre[None, :9], 520.0, centre[9:]).slopes[0]
        columns = [*range(9), SLOPES.index("thickness_offset_m")]
        for i, column in enumerate(columns):
            change = step * (centre[i] if i < 6 else np.diff(LIMITS[i])[0])
            hz = []
            for sign in (1, -1):
                inputs = centre.copy()
                inputs[i] += sign * change
                hz.append(fem_hz(Cane(*inputs[:9].tolist(), 520.0), inputs[9], count=10))
            size = np.log((1 + step) / (1 - step)) if i < 6 else 2 * change
            for symmetry, half in basis.halves.items():
                at = [basis.names.index(name) for name in half.names]
                middle = modes(basis, centre[None, :9], 520.0, centre[9:]).hz[0, at]
                order = np.argsort(middle)
                moved = 1200 * np.log2(hz[0][symmetry] / hz[1][symmetry])[: len(at)]
                by_slope = 1200 / np.log(2) * size * slopes[at, column][order]
                np.testing.assert_allclose(by_slope, moved, atol=0.5)

    def test_another_reed_does_as_well(self):
        """Thicker, held from below and farther back."""
        geometry = replace(
            ReedGeometry(),
            thickness_offset_m=10e-6,
            clamp=Clamp(x_m=(40e-3, 62e-3), side=ClampSide.FLAT),
        )
        settings = TrainingSettings(highest_hz=11e3, snapshots=12, samples=128)
        basis = build_material_basis(geometry, LEVEL, settings)
        canes, offsets = reeds(3, seed=3)
        errors = errors_cents(basis, canes, offsets, geometry, settings.highest_hz)
        assert np.isfinite(errors).sum() > 20
        assert np.nanmax(np.abs(errors)) < PROMISED_CENTS


class TestSlopes:
    def test_slopes_are_those_of_the_basis(self, basis):
        canes, offsets = reeds(6, seed=21)
        inputs = np.column_stack([constants_of(canes), density_of(canes), offsets])
        centre = modes(basis, inputs[:, :9], inputs[:, 9], inputs[:, 10])
        step = 1e-4
        for slope, name in enumerate(SLOPES):
            logarithmic = name.startswith("ln ")
            change = step * (inputs[:, slope] if logarithmic else LIMITS[min(slope, 9), 1])
            ends = []
            for sign in (1, -1):
                moved = inputs.copy()
                moved[:, slope] += sign * change
                ends.append(modes(basis, moved[:, :9], moved[:, 9], moved[:, 10], slopes=False))
            found = np.log(ends[0].hz / ends[1].hz) / (2 * step if logarithmic else 2 * change)
            scale = 1.0 if name != "thickness_offset_m" else 1 / 20e-6
            np.testing.assert_allclose(centre.slopes[..., slope], found, atol=2e-6 * scale)

    def test_sensitivities_to_the_moduli_add_to_one_half(self, basis):
        canes, offsets = reeds(20, seed=22)
        slopes = modes(basis, constants_of(canes), 520.0, offsets).slopes
        np.testing.assert_allclose(slopes[..., : len(MODULI)].sum(axis=2), 0.5, rtol=1e-9)
        # All but the weak couplings stiffen.
        assert slopes[..., : len(MODULI)].min() > -0.02

    def test_density_is_exact(self, basis):
        canes, offsets = reeds(5, seed=23)
        light, heavy = (modes(basis, constants_of(canes), rho, offsets) for rho in (300.0, 1200.0))
        np.testing.assert_allclose(light.hz, 2 * heavy.hz, rtol=1e-12)
        np.testing.assert_array_equal(light.slopes[..., SLOPES.index("ln density_kg_m3")], -0.5)

    def test_frequencies_without_slopes_are_the_same(self, basis):
        canes, offsets = reeds(5, seed=24)
        alone = modes(basis, constants_of(canes), 520.0, offsets, slopes=False)
        assert alone.slopes is None
        both = modes(basis, constants_of(canes), 520.0, offsets)
        np.testing.assert_array_equal(alone.hz, both.hz)


class TestNames:
    def test_the_reference_gives_the_names(self, basis):
        found = modes(basis, constants_of([Cane()]), 520.0)
        assert set(PAPER_MODES) < set(basis.names)
        rules = reed_modes(ReedGeometry(), Cane(), LEVEL)
        assert basis.names == tuple(mode.name for mode in rules)
        assert basis.classes == tuple(mode.klass for mode in rules)
        assert found.similarity.min() > 0.999
        assert np.all(np.diff(found.hz[0]) > 0)

    def test_clear_names_are_those_of_the_rules(self, basis):
        """Two ways that share nothing but the reference: equal shapes, and what they look like."""
        canes, _ = reeds(8, seed=31)
        found = modes(basis, constants_of(canes), 520.0)
        compared = 0
        for k, cane in enumerate(canes):
            by_rule = {
                mode.name: mode.frequency_hz
                for mode in reed_modes(
                    ReedGeometry(), replace(cane, density_kg_m3=520.0), LEVEL, 22e3
                )
            }
            for m, name in enumerate(basis.names):
                if found.similarity[k, m] > 0.75 and name in STEADY:
                    compared += 1
                    cents = 1200 * np.log2(found.hz[k, m] / by_rule[name])
                    assert abs(cents) < PROMISED_CENTS, (name, cane)
        assert compared > 60

    def test_modes_of_opposite_symmetry_cross(self, basis):
        """T3 follows G_LT and overtakes F3, which does not."""
        G = np.linspace(0.9e9, 2e9, 200)
        constants = constants_of([replace(Cane(), G_LT_pa=float(g)) for g in G])
        found = modes(basis, constants, 520.0)
        T3, F3 = (basis.names.index(name) for name in ("T3", "F3"))
        assert found.hz[0, T3] < found.hz[0, F3]
        assert found.hz[-1, T3] > found.hz[-1, F3]
        assert found.similarity[:, [T3, F3]].min() > 0.8
        steps = 1200 * np.abs(np.diff(np.log2(found.hz[:, [T3, F3]]), axis=0))
        assert steps.max() < 8

    def test_where_modes_of_one_symmetry_exchange_shapes_likeness_falls(self, basis):
        """T4 and F4 never meet; each name goes over to the mode that has taken its shape."""
        G = np.linspace(1.1e9, 2e9, 181)
        constants = constants_of([replace(Cane(), E_L_pa=10.5e9, G_LT_pa=float(g)) for g in G])
        found = modes(basis, constants, 520.0)
        at = [basis.names.index(name) for name in ("T4", "F4")]
        gap = 1200 * np.log2(found.hz[:, at[1]] / found.hz[:, at[0]])
        assert np.abs(gap).min() > 30
        similarity = found.similarity[:, at]
        assert similarity[0].min() > 0.9
        changes = np.flatnonzero(np.diff(np.sign(gap)))
        assert len(changes) == 1
        np.testing.assert_allclose(similarity[changes[0]], 0.5, atol=0.05)
        # Both ways from there names become clearer.
        assert abs(similarity.sum(axis=1).argmin() - changes[0]) <= 1

    def test_clear_names_are_found_beyond_modes_that_have_none(self, basis):
        canes, offsets = reeds(600, seed=33, corners=True)
        constants = constants_of(canes)
        found = modes(basis, constants, 520.0, offsets, slopes=False)
        beyond = 0
        for symmetry, half in basis.halves.items():
            hz, shapes = all_modes(basis, symmetry, constants, 520.0, offsets)
            shares = (half.named_shapes.T @ shapes) ** 2
            at = [basis.names.index(name) for name in half.names]
            likest = np.take_along_axis(hz, shares.argmax(axis=2), axis=1)
            clear = shares.max(axis=2) > 0.6
            np.testing.assert_allclose(found.hz[:, at][clear], likest[clear], rtol=1e-9)
            np.testing.assert_allclose(
                found.similarity[:, at][clear], shares.max(axis=2)[clear], rtol=1e-6
            )
            beyond += np.count_nonzero(clear & (shares.argmax(axis=2) >= len(at)))
        assert beyond > 0

    def test_no_mode_bears_two_names(self, basis):
        canes, offsets = reeds(300, seed=32, corners=True)
        found = modes(basis, constants_of(canes), 520.0, offsets, slopes=False)
        for half in basis.halves.values():
            hz = np.sort(found.hz[:, [basis.names.index(name) for name in half.names]], axis=1)
            assert np.diff(hz, axis=1).min() > 0
        assert found.similarity.min() >= 0
        assert found.similarity.max() <= 1 + 1e-9


class TestManyReeds:
    def test_reeds_do_not_depend_on_their_neighbours(self, basis):
        canes, offsets = reeds(37, seed=41)
        constants, order = constants_of(canes), np.random.default_rng(1).permutation(37)
        together = modes(basis, constants, density_of(canes), offsets)
        mixed = modes(basis, constants[order], density_of(canes)[order], offsets[order], threads=1)
        np.testing.assert_allclose(mixed.hz, together.hz[order], rtol=1e-9)
        np.testing.assert_allclose(mixed.similarity, together.similarity[order], atol=1e-9)
        np.testing.assert_allclose(mixed.slopes, together.slopes[order], atol=1e-8, rtol=1e-8)
        one = modes(basis, constants[5:6], density_of(canes)[5], offsets[5])
        np.testing.assert_allclose(one.hz[0], together.hz[5], rtol=1e-9)

    def test_no_reeds_have_no_modes(self, basis):
        found = modes(basis, constants_of([]), 520.0)
        assert found.hz.shape == (0, len(basis.names))
        assert found.slopes.shape == (0, len(basis.names), len(SLOPES))

    @pytest.mark.parametrize("field", fields(MaterialBox), ids=lambda field: field.name)
    def test_a_reed_outside_the_box_is_flagged(self, field, basis):
        place = [f.name for f in fields(MaterialBox)].index(field.name)
        inputs = np.tile(LIMITS.mean(axis=1), (4, 1))
        inputs[:2, place] = LIMITS[place]
        inputs[2:, place] = LIMITS[place] + 0.01 * np.diff(LIMITS[place]) * (-1, 1)
        found = modes(basis, inputs[:, :9], 520.0, inputs[:, 9], slopes=False)
        np.testing.assert_array_equal(found.within, [True, True, False, False])
        # Extrapolated, not cut off at the end of the box.
        assert np.all(np.isfinite(found.hz))
        assert np.abs(np.log(found.hz[2:] / found.hz[:2])).max() > 1e-6

    def test_an_impossible_reed_has_no_frequencies_and_spoils_no_other(self, basis):
        good = Cane()
        bad = [
            replace(good, E_L_pa=-1e9),
            replace(good, G_TR_pa=0.0),
            replace(good, nu_TR=1.2),
            replace(good, E_R_pa=float("nan")),
            replace(good, G_LR_pa=float("inf")),
            replace(good, E_T_pa=1e300),
            replace(good, G_LT_pa=1e-300),
            replace(good, nu_LR=float("nan")),
            replace(good, nu_LR=float("inf"), nu_LT=0.0),
        ]
        constants = constants_of([good, *bad, *[good] * 6])
        density = [520.0] * 10 + [0.0, float("nan"), float("inf")] + [520.0] * 3
        offset = [0.0] * 13 + [float("nan"), 1e200, 0.0]
        found = modes(basis, constants, density, offset)
        impossible = [False] + [True] * 14 + [False]
        np.testing.assert_array_equal(np.isnan(found.hz).all(axis=1), impossible)
        np.testing.assert_array_equal(np.isnan(found.slopes).any(axis=(1, 2)), impossible)
        np.testing.assert_array_equal(found.within, ~np.array(impossible))
        np.testing.assert_allclose(found.hz[0], found.hz[-1], rtol=1e-9)

    def test_nothing_far_outside_the_box_spoils_a_reed(self, basis):
        canes = [Cane(), replace(Cane(), E_L_pa=1e15, G_TR_pa=1.0), replace(Cane(), E_T_pa=1e10)]
        found = modes(basis, constants_of(canes), 520.0, [0.0, 0.0, 0.5])
        np.testing.assert_array_equal(found.within, [True, False, False])
        alone = modes(basis, constants_of(canes[:1]), 520.0)
        np.testing.assert_allclose(found.hz[0], alone.hz[0], rtol=1e-9)

    def test_inputs_of_another_shape_are_refused(self, basis):
        with pytest.raises(ValueError, match=r"\(9,\).*one row of 9 per reed: E_L_pa"):
            modes(basis, np.ones(9), 520.0)
        with pytest.raises(ValueError, match=r"density_kg_m3 of shape \(3,\)"):
            modes(basis, constants_of([Cane()] * 2), np.full(3, 520.0))
        with pytest.raises(ValueError, match=r"thickness_offset_m of shape \(1,\)"):
            modes(basis, constants_of([Cane()] * 2), 520.0, np.zeros(1))


class TestEveryMode:
    def test_named_modes_are_among_all(self, basis):
        canes, offsets = reeds(4, seed=45)
        constants, density = constants_of(canes), density_of(canes)
        named = modes(basis, constants, density, offsets)
        for symmetry, half in basis.halves.items():
            hz, shapes = all_modes(basis, symmetry, constants, density, offsets)
            assert np.all(np.diff(hz, axis=1) > 0)
            at = [basis.names.index(name) for name in half.names]
            nearest = np.abs(named.hz[:, at, None] / hz[:, None] - 1).min(axis=2)
            np.testing.assert_allclose(nearest, 0, atol=1e-10)
            unit = np.broadcast_to(np.eye(hz.shape[1]), shapes.shape)
            np.testing.assert_allclose(shapes.swapaxes(1, 2) @ shapes, unit, atol=1e-10)

    def test_a_reed_that_cannot_be_is_refused(self, basis):
        constants = constants_of([Cane(), replace(Cane(), nu_TR=1.2)])
        with pytest.raises(ValueError, match="reed 1 of 2 cannot be"):
            all_modes(basis, Symmetry.SYMMETRIC, constants, 520.0)

    def test_coordinates_without_mass_are_at_rest(self):
        factors = np.random.default_rng(46).normal(size=(3, 9, 9))
        stiffness_ = factors @ factors.swapaxes(1, 2) + np.eye(9)
        condensed, following = condensed_stiffness(stiffness_, 4)
        massive = np.diag([1.0] * 4 + [0.0] * 5)
        for K, H, follow in zip(stiffness_, condensed, following, strict=True):
            np.testing.assert_allclose((K @ np.vstack([np.eye(4), follow]))[4:], 0, atol=1e-10)
            inverse = linalg.eigvalsh(massive, K)[:4:-1]
            np.testing.assert_allclose(1 / linalg.eigvalsh(H), inverse, rtol=1e-10)


class TestViscoelasticCane:
    def test_moduli_that_do_not_move_give_the_modes_of_fixed_ones(self, basis):
        still = ViscoelasticCane(Zener(12e3, 0.0, 0.1), Zener(800.0, 0.0, 0.1))
        found = settled_modes(basis, Cane(density_kg_m3=480.0), still, 5e-6)
        fixed = replace(Cane(), E_L_pa=12e9, G_LT_pa=0.8e9)
        expected = modes(basis, constants_of([fixed]), 480.0, 5e-6)
        assert found.names == expected.names
        assert found.slopes is None
        np.testing.assert_allclose(found.hz, expected.hz, rtol=1e-7)
        np.testing.assert_allclose(found.similarity, expected.similarity, atol=1e-5)
        assert found.within.tolist() == [True]

    @pytest.mark.parametrize(
        ("components", "overtaken"),
        [(Components(e1=1.0, e2=-1.0, e3=0.5), False), (Components(e1=4.5, e2=-4.0), True)],
    )
    def test_every_mode_has_the_moduli_of_its_own_frequency(self, basis, components, overtaken):
        cane = viscoelastic_cane(components, Series.A)
        found = settled_modes(basis, Cane(), cane)
        assert found.similarity.min() > 0.6
        T4, F4 = (found.hz[0, basis.names.index(name)] for name in ("T4", "F4"))
        assert (T4 > F4) == overtaken
        for m, hz in enumerate(found.hz[0]):
            E, G = (float(storage_modulus_pa(z, hz)) for z in (cane.young_L, cane.shear_LT))
            own = modes(basis, constants_of([replace(Cane(), E_L_pa=E, G_LT_pa=G)]), 520.0)
            np.testing.assert_allclose(own.hz[0, m], hz, rtol=1e-6)

    @pytest.mark.parametrize("e1", [0.0, 2.0, 3.0])
    def test_modes_are_those_of_the_finite_elements(self, basis, e1):
        """T4 and F4 exchange shapes between: by number no mode is found twice or missed."""
        cane = viscoelastic_cane(Components(e1=e1), Series.A)
        found = settled_modes(basis, Cane(), cane)
        solved = viscoelastic_modes(ReedGeometry(), Cane(), cane, LEVEL, 22e3)
        for symmetry, half in basis.halves.items():
            at = [basis.names.index(name) for name in half.names]
            mine = np.sort(found.hz[0, at])
            true_hz = np.array([m.frequency_hz for m in solved if m.symmetry is symmetry])
            cents = 1200 * np.log2(mine[mine < 20e3][:, None] / true_hz)
            nearest = np.abs(cents).argmin(axis=1)
            assert len(set(nearest.tolist())) == len(nearest)
            assert np.abs(cents[np.arange(len(cents)), nearest]).max() < PROMISED_CENTS

    def test_moduli_beyond_the_box_are_reported(self, basis):
        cane = viscoelastic_cane(Components(e2=4.0), Series.A)
        assert not settled_modes(basis, Cane(), cane).within[0]
        cane = viscoelastic_cane(Components(), Series.A)
        assert not settled_modes(basis, Cane(), cane, 21e-6).within[0]


class TestElasticity:
    def test_terms_are_those_of_the_stiffness_matrix(self):
        canes, _ = reeds(20, seed=51)
        terms, _ = terms_and_slopes(constants_of(canes))
        expected = np.stack([stiffness_terms_pa(cane) for cane in canes])
        assert terms.shape[1] == len(STIFFNESS_TERMS)
        np.testing.assert_allclose(terms, expected, rtol=1e-12)

    def test_slopes_of_terms(self):
        constants = constants_of(reeds(4, seed=52)[0])
        _, slopes = terms_and_slopes(constants)
        for column, name in enumerate(CONSTANTS):
            step = 1e-6 * (constants[:, column] if name in MODULI else np.ones(4))
            ends = []
            for sign in (1, -1):
                moved = constants.copy()
                moved[:, column] += sign * step
                ends.append(terms_and_slopes(moved)[0])
            found = (ends[0] - ends[1]) / 2e-6
            np.testing.assert_allclose(slopes[:, :, column], found, rtol=1e-6, atol=10.0)

    def test_possible_canes_are_those_with_a_stiffness_matrix(self):
        rng = np.random.default_rng(53)
        constants = np.exp(rng.normal(21, 1, (600, 9)))
        constants[:, 6:] = rng.uniform(-1.2, 1.2, (600, 3))
        constants[:50, 2] *= -1

        def possible(row):
            try:
                stiffness_terms_pa(Cane(*row.tolist()))
            except ImpossibleReedError:
                return False
            return True

        expected = [possible(row) for row in constants]
        assert 100 < sum(expected) < 500
        np.testing.assert_array_equal(possible_canes(constants), expected)


class TestTraining:
    def test_integrals_are_projections_of_the_assembled_matrices(self):
        mesh = build_mesh(ReedGeometry(), TINY)
        matrices = assemble(mesh)
        shapes = np.random.default_rng(61).normal(size=(len(mesh.nodes_m), 3, 4))
        flat = shapes.reshape(-1, 4)
        energies, masses = integrals(mesh, shapes)
        for term in range(9):
            expected = flat.T @ (stiffness(matrices, np.eye(9)[term]) @ flat)
            scale = np.abs(expected).max()
            np.testing.assert_allclose(energies[term], expected, atol=1e-11 * scale)
        np.testing.assert_allclose(masses, flat.T @ (mass(matrices, 1.0) @ flat), rtol=1e-10)

    def test_a_large_basis_holds_between_the_thicknesses_of_its_snapshots(self):
        """Rayleigh and Ritz at four thicknesses, and cubic between: no stiffer, no softer.

        Without stretching the coordinates with the thickness, the reed would lock in shear by
        tens of cents.
        """
        settings = replace(FEW, snapshots=8)
        _, bases = large_bases(ReedGeometry(), TINY, settings, lambda _share: None)
        for place in (-0.8, 0.1, 1.0):
            true_hz = fem_hz(Cane(), 20e-6 * place, level=TINY, count=4)
            for symmetry, basis in bases.items():
                terms = stiffness_terms_pa(Cane())
                K = np.tensordot(terms, at_place(basis.pencil.stiffness, place), axes=1)
                M = 520.0 * at_place(basis.pencil.mass, place)
                hz = np.sqrt(linalg.eigvalsh(K, M)[:3]) / (2 * np.pi)
                cents = 1200 * np.log2(hz / true_hz[symmetry][:3])
                assert cents.min() > -0.05
                assert cents.max() < 1

    def test_snapshots_are_modes(self):
        settings = replace(FEW, snapshots=4)
        constants, _ = canes_of_box(settings, 4, edges=False)
        _, bases = large_bases(ReedGeometry(), TINY, settings, lambda _share: None)
        for row, place in zip(constants, np.polynomial.chebyshev.chebpts1(4), strict=True):
            cane = Cane(*row.tolist())
            true_hz = fem_hz(cane, 20e-6 * float(place), level=TINY, count=4)
            for symmetry, basis in bases.items():
                K = np.tensordot(
                    stiffness_terms_pa(cane), at_place(basis.pencil.stiffness, place), axes=1
                )
                M = 520.0 * at_place(basis.pencil.mass, place)
                hz = np.sqrt(linalg.eigvalsh(K, M)[:3]) / (2 * np.pi)
                assert np.abs(1200 * np.log2(hz / true_hz[symmetry][:3])).max() < 3e-3

    def test_training_canes_lie_in_the_box_and_reach_its_ends(self):
        for edges in (False, True):
            constants, places = canes_of_box(SETTINGS, 64, edges=edges)
            assert within_box(BOX, constants, 20e-6 * places).all()
            ends = np.isclose(constants, LIMITS[:9, 0]) | np.isclose(constants, LIMITS[:9, 1])
            assert (ends.mean() > 0.7) == edges

    def test_progress_is_reported_to_the_end(self):
        fractions = []
        build_material_basis(ReedGeometry(), TINY, FEW, fractions.append)
        assert len(fractions) > FEW.snapshots
        assert np.all(np.diff(fractions) >= 0)
        assert (fractions[0], fractions[-1]) == (0, 1)

    def test_meshes_whose_lines_would_change_with_the_thickness_are_refined(self):
        """One element more fits in front of the heel of the thinner reed."""
        level = replace(TINY, vamp_element_m=13.89e-3)
        thin, thick = (
            build_mesh(ReedGeometry(thickness_offset_m=offset), level)
            for offset in BOX.thickness_offset_m
        )
        assert thin.block != thick.block
        shorter = replace(level, vamp_element_m=0.95 * level.vamp_element_m)
        basis = build_material_basis(ReedGeometry(), level, FEW)
        for offset in BOX.thickness_offset_m:
            found = modes(basis, constants_of([Cane()]), 520.0, offset).hz[0]
            true_hz = fem_hz(Cane(), offset, level=shorter, count=4)
            lowest = basis.names.index("F1")
            cents = 1200 * np.log2(found[lowest] / true_hz[Symmetry.SYMMETRIC][0])
            assert abs(cents) < 10

    def test_names_come_from_the_middle_thickness_of_the_box(self):
        box = replace(BOX, thickness_offset_m=(-5e-6, 30e-6))
        basis = build_material_basis(ReedGeometry(), TINY, replace(FEW, box=box))
        found = modes(basis, constants_of([Cane()]), 520.0, 12.5e-6)
        assert found.similarity.min() > 0.999

    @pytest.mark.parametrize(
        ("changed", "named"),
        [
            ({"E_T_pa": (5e8, 4e8)}, "E_T_pa.*5e\\+08 to 4e\\+08"),
            ({"G_LR_pa": (-1e9, 1e9)}, "G_LR_pa"),
            ({"thickness_offset_m": (0.0, 0.0)}, "thickness_offset_m"),
            ({"nu_TR": (0.2, 1.1)}, "Poisson"),
        ],
    )
    def test_a_box_that_is_none_is_refused(self, changed, named):
        settings = replace(FEW, box=replace(BOX, **changed))
        with pytest.raises(ValueError, match=named):
            build_material_basis(ReedGeometry(), TINY, settings)

    def test_a_limit_below_all_modes_is_refused(self):
        with pytest.raises(ValueError, match=r"no antisymmetric mode below 3000 Hz.*raise"):
            build_material_basis(ReedGeometry(), TINY, replace(FEW, highest_hz=3e3))

    def test_an_impossible_thickness_is_refused(self):
        box = replace(BOX, thickness_offset_m=(-90e-6, 0.0))
        with pytest.raises(ImpossibleReedError, match="thick"):
            build_material_basis(ReedGeometry(), TINY, replace(FEW, box=box))


class TestCache:
    @pytest.fixture
    def folder(self, tmp_path, monkeypatch):
        monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "kept"))
        return tmp_path / "kept"

    @pytest.fixture
    def announced(self):
        return []

    def basis(self, announced, geometry=None, settings=FEW):
        return material_basis(geometry, TINY, settings, announced.append)

    def test_a_kept_basis_is_the_one_built(self, folder, announced):
        built, kept = self.basis(announced), self.basis(announced)
        assert len(announced) == 1
        assert len(list(folder.iterdir())) == 1
        assert (kept.geometry, kept.box, kept.names) == (built.geometry, built.box, built.names)
        assert [(type(k), k) for k in kept.classes] == [(ModeClass, k) for k in built.classes]
        for symmetry in Symmetry:
            for field in fields(HalfMaterialBasis):
                np.testing.assert_array_equal(
                    getattr(kept.halves[symmetry], field.name),
                    getattr(built.halves[symmetry], field.name),
                )

    @pytest.mark.usefixtures("folder")
    def test_another_input_is_built_again(self, announced):
        self.basis(announced)
        self.basis(announced, geometry=ReedGeometry(thickness_offset_m=1e-6))
        self.basis(announced, settings=replace(FEW, samples=32))
        assert len(announced) == 3

    @pytest.mark.parametrize("damage", [b"", b"not an archive", None], ids=str)
    def test_a_damaged_entry_is_built_again(self, damage, folder, announced):
        built = self.basis(announced)
        (entry,) = folder.iterdir()
        entry.write_bytes(entry.read_bytes()[:2000] if damage is None else damage)
        again = self.basis(announced)
        assert len(announced) == 2
        assert again.names == built.names
        self.basis(announced)
        assert len(announced) == 2

    def test_a_folder_that_cannot_be_made_costs_only_time(self, tmp_path, monkeypatch, announced):
        (tmp_path / "file").touch()
        monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "file" / "below"))
        assert self.basis(announced).names
        self.basis(announced)
        assert len(announced) == 2
