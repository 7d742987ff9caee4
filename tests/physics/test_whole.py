"""A whole reed in reduced coordinates: against halves, against the elements, and on the bench."""

from dataclasses import fields, replace
from fractions import Fraction

import numpy as np
import pytest

from holography.demodulation import four_phase
from physics.air import distortion_factor, pressure_shape
from physics.bench import (
    BenchModel,
    BenchState,
    Segment,
)
from physics.errors import ImpossibleReedError
from physics.motion import PlainMotion
from physics.optics import reed_axes_m
from physics.parameters.chamber import Chamber, PressureDistortion
from physics.parameters.tree import with_part
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.elements.fem import (
    Symmetry,
    assemble,
    factor,
    mass,
    stiffness,
)
from physics.reed.elements.mesh import MeshLevel, build_whole_mesh
from physics.reed.geometry import (
    Outline,
    ReedGeometry,
    ThicknessMap,
    half_width_m,
)
from physics.reed.modes import reed_modes, viscoelastic_modes
from physics.reed.reduced import snapshots, stored
from physics.reed.reduced.build import build_reduced_reed
from physics.reed.reduced.elastic import reduced_modes
from physics.reed.reduced.reed import BasisSettings, ReedBox
from physics.reed.reduced.response import forced_response
from physics.reed.surface import surface_shapes
from tests.numbers import cents

# Whole reeds are built.
pytestmark = pytest.mark.slow

COARSE = MeshLevel(
    orders=(2, 2, 2),
    vamp_element_m=9e-3,
    heel_element_m=15e-3,
    edge_breaks_m=(),
    z_breaks=(0.0, 1.0),
)
CANE = viscoelastic_cane(Components(), Series.A)
LOSS = 0.03
EVEN, ODD = Symmetry.SYMMETRIC, Symmetry.ANTISYMMETRIC
# None of them is a snapshot of the basis.
MODULI_PA = [(12e9, 1.3e9), (8e9, 1.8e9), (20e9, 0.5e9)]
DRIVE_HZ = Fraction(35000, 10)


def uneven(asymmetry, even_m=10e-6):
    """Reed whose left side (y > 0) is thicker than its right by a share, at the sides."""
    x, y = np.linspace(0, 35e-3, 12), np.linspace(-6.5e-3, 6.5e-3, 14)
    drawn = np.interp(x, [0, 35e-3], [0.08e-3, 3e-3])[:, None]
    deviation = even_m * np.cos(80 * x)[:, None] + 0.5 * asymmetry * drawn * y / 6.5e-3
    rows = tuple(map(tuple, deviation.tolist()))
    return ReedGeometry(thickness_map=ThicknessMap(tuple(x.tolist()), tuple(y.tolist()), rows))


def askew(_hz, x_m, y_m):
    """A complex pressure without any symmetry."""
    return np.exp(-x_m / 15e-3) * (1 + 0.5 * np.sin(300 * y_m)) * (1 + 0.7j * y_m / 6e-3)


def straight(_hz, x_m, _y_m):
    """A pressure that is the same on either side."""
    return np.exp(-x_m / 15e-3).astype(complex)


def elastic(hz):
    return Cane(
        E_L_pa=float(storage_modulus_pa(CANE.young_L, hz)),
        G_LT_pa=float(storage_modulus_pa(CANE.shear_LT, hz)),
    )


def deflection(reed, hz, pressure, x_m, y_m, cane=CANE):
    """Complex deflection of the bark side at points, of whatever parts a reed has."""
    response = forced_response(reed, cane, LOSS, np.array([hz]), pressure)
    shapes = surface_shapes(reed, x_m, y_m)
    return sum(shapes[part] @ response[part][0] for part in response)


# More coordinates than usual: what is left of differences is not that of either basis.
@pytest.fixture(scope="module")
def even_whole():
    monkeypatch = pytest.MonkeyPatch()
    with monkeypatch.context() as patch:
        patch.setattr(snapshots, "build_least_mesh", build_whole_mesh)
        settings = BasisSettings(ReedBox(), modes=30, size=170, snapshots=0)
        return build_reduced_reed(ReedGeometry(), COARSE, settings)


@pytest.fixture(scope="module")
def even_halves():
    return build_reduced_reed(
        ReedGeometry(), COARSE, BasisSettings(ReedBox(), modes=16, size=84, snapshots=0)
    )


@pytest.fixture(scope="module")
def skew_whole():
    return build_reduced_reed(uneven(0.03), COARSE, BasisSettings())


# --- Against the halves of an even reed --------------------------------------------------------


@pytest.mark.parametrize(("E_L_pa", "G_LT_pa"), MODULI_PA)
def test_an_even_reed_has_the_frequencies_of_its_halves(E_L_pa, G_LT_pa, even_whole, even_halves):
    cane = Cane(E_L_pa=E_L_pa, G_LT_pa=G_LT_pa)
    terms = stiffness_terms_pa(cane)
    halves_hz = np.sort(
        np.concatenate(
            [reduced_modes(half, terms, 520.0)[0][:12] for half in even_halves.parts.values()]
        )
    )
    below = np.count_nonzero(halves_hz < 20e3)
    assert below >= 14
    whole_hz = reduced_modes(even_whole.parts[None], terms, 520.0)[0]
    np.testing.assert_allclose(cents(whole_hz[:below], halves_hz[:below]), 0, atol=0.1)


@pytest.mark.parametrize("hz", [605.0, 3.5e3, 9.7e3, 14e3])
def test_an_even_reed_moves_as_its_halves_do(hz, even_whole, even_halves):
    whole_answer, halves_answer = (
        forced_response(reed, CANE, LOSS, np.array([hz]), askew)
        for reed in (even_whole, even_halves)
    )
    even, odd = (
        even_halves.parts[symmetry].surface_z @ halves_answer[symmetry][0]
        for symmetry in (EVEN, ODD)
    )
    moved = even_whole.parts[None].surface_z @ whole_answer[None][0]
    places = {tuple(place): number for number, place in enumerate(even_whole.plan_m.tolist())}
    for side, expected in ((1, even + odd), (-1, even - odd)):
        nodes = [places[x, side * y] for x, y in even_halves.plan_m.tolist()]
        error = np.linalg.norm(moved[nodes] - expected) / np.linalg.norm(expected)
        assert error < 1e-3


def test_an_even_reed_looks_to_the_camera_as_its_halves_do(even_whole, even_halves):
    rng = np.random.default_rng(5)
    x, y = rng.uniform(2e-3, 37e-3, 500), rng.uniform(-5.5e-3, 5.5e-3, 500)
    one, other = (deflection(reed, 3.4e3, askew, x, y) for reed in (even_whole, even_halves))
    # Both are interpolated between the nodes of so coarse a mesh, but not equally at the axis.
    assert np.linalg.norm(one - other) < 0.01 * np.linalg.norm(other)


# --- Against the finite elements ---------------------------------------------------------------


@pytest.mark.parametrize(("E_L_pa", "G_LT_pa"), MODULI_PA)
def test_an_uneven_reed_has_the_frequencies_of_its_elements(E_L_pa, G_LT_pa, skew_whole):
    cane = Cane(E_L_pa=E_L_pa, G_LT_pa=G_LT_pa)
    full_hz = [mode.frequency_hz for mode in reed_modes(skew_whole.geometry, cane, COARSE)]
    assert len(full_hz) >= 14
    hz = reduced_modes(skew_whole.parts[None], stiffness_terms_pa(cane), 520.0)[0][: len(full_hz)]
    errors = cents(hz, full_hz)
    assert errors.min() > -1e-3, "never below: Rayleigh's quotient"
    assert errors.max() < 0.2


# Far below resonance it is the static shapes that tell.
@pytest.mark.parametrize(("hz", "share"), [(20.0, 1e-4), (605.0, 1e-4), (14e3, 5e-3)])
def test_an_uneven_reed_moves_as_its_elements_do(hz, share, skew_whole, consistent_load):
    mesh = build_whole_mesh(skew_whole.geometry, COARSE)
    matrices = assemble(mesh)
    free = np.flatnonzero(~np.repeat(mesh.clamped, 3))
    load = np.zeros(3 * len(mesh.nodes_m), dtype=complex)
    load[2::3] = consistent_load(mesh, lambda x, y: askew(hz, x, y))
    K = stiffness(matrices, stiffness_terms_pa(elastic(hz)))
    dynamic = (1 + 1j * LOSS) * K - (2 * np.pi * hz) ** 2 * mass(matrices, 520.0)
    full = np.zeros_like(load)
    full[free] = factor(dynamic[free][:, free].tocsc())(load[free])
    expected = full[2::3].reshape(mesh.block)[:, :, -1].ravel()
    found = (
        skew_whole.parts[None].surface_z
        @ forced_response(skew_whole, CANE, LOSS, np.array([hz]), askew, 0.0)[None][0]
    )
    assert np.linalg.norm(found - expected) < share * np.linalg.norm(expected)


def test_a_force_at_one_point_moves_another_as_much_as_the_reverse(skew_whole):
    points = skew_whole.load_points_m
    one, other = (
        np.argmin(np.hypot(*(points - place).T)) for place in ([2e-3, 4e-3], [15e-3, -2e-3])
    )

    def moved(pushed, watched):
        def pressure(_hz, x_m, y_m):
            return ((x_m == points[pushed, 0]) & (y_m == points[pushed, 1])).astype(complex)

        answer = forced_response(skew_whole, CANE, LOSS, np.array([5.2e3]), pressure)
        return skew_whole.parts[None].load_z[watched] @ answer[None][0]

    assert moved(one, other) == pytest.approx(moved(other, one), rel=1e-9)
    assert abs(moved(one, other)) > 0


# --- What an uneven reed does that an even one cannot ------------------------------------------


def test_a_straight_pressure_twists_an_uneven_reed_only(even_whole, skew_whole):
    """At its own T1, and a mirrored reed is twisted the other way."""
    mirrored = build_reduced_reed(uneven(-0.03), COARSE, BasisSettings())
    x, y = np.array([2e-3, 2e-3]), np.array([4e-3, -4e-3])
    twists = {}
    for name, reed in (("even", even_whole), ("skew", skew_whole), ("mirrored", mirrored)):
        modes = viscoelastic_modes(reed.geometry, Cane(), CANE, COARSE, highest_hz=6e3)
        (t1,) = (mode for mode in modes if mode.name == "T1")
        left, right = deflection(reed, t1.frequency_hz, straight, x, y)
        twists[name] = (left - right) / (left + right)
    assert abs(twists["even"]) < 1e-3
    assert abs(twists["skew"]) > 0.1
    assert twists["mirrored"] == pytest.approx(-twists["skew"], rel=1e-2)


def test_parts_tell_halves_from_a_whole(even_whole, even_halves):
    assert list(even_whole.parts) == [None]
    assert list(even_halves.parts) == list(Symmetry)


def test_every_point_inside_the_contour_has_a_shape(skew_whole):
    x = np.linspace(1e-6, 37e-3, 60)
    for side in (1, -1):
        y = side * half_width_m(Outline(), x) * (1 - 1e-9)
        (shapes,) = surface_shapes(skew_whole, x, y).values()
        assert shapes.shape == (60, skew_whole.parts[None].mass.shape[0])
        assert np.isfinite(shapes).all()


def test_a_reed_with_many_modes_has_as_many_coordinates_as_it_needs():
    cane = Cane(density_kg_m3=1500.0)
    reed = build_reduced_reed(uneven(0.03), COARSE, BasisSettings(ReedBox(cane)))
    constants = replace(cane, E_L_pa=12e9, G_LT_pa=1.3e9)
    full_hz = [mode.frequency_hz for mode in reed_modes(reed.geometry, constants, COARSE)]
    assert len(full_hz) > 24
    hz = reduced_modes(reed.parts[None], stiffness_terms_pa(constants), 1500.0)[0][: len(full_hz)]
    assert np.abs(cents(hz, full_hz)).max() < 0.2


def test_cane_with_modes_without_number_is_refused(monkeypatch):
    monkeypatch.setattr(snapshots, "_MOST_MODES", 7)
    cork = BasisSettings(
        ReedBox(
            Cane(E_T_pa=5e6, E_R_pa=5e6, G_LR_pa=1e7, G_TR_pa=1e7),
            E_L_pa=(1e8, 2e8),
            G_LT_pa=(1e7, 2e7),
        )
    )
    with pytest.raises(ImpossibleReedError, match=r"over 14 modes below 20000 Hz.*check moduli"):
        build_reduced_reed(uneven(0.03), COARSE, cork)


def test_a_whole_reed_is_kept(skew_whole, tmp_path, monkeypatch):
    monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path))
    built = []

    def build(*inputs):
        built.append(inputs[:3])
        return skew_whole

    monkeypatch.setattr(stored, "build_reduced_reed", build)
    said = []
    for _ in range(2):
        kept = stored.reduced_reed(skew_whole.geometry, COARSE, announce=said.append)
        assert (kept.geometry, kept.box) == (skew_whole.geometry, skew_whole.box)
        assert list(kept.loose) == [None]
        for one, other in (
            (kept, skew_whole),
            (kept.edge, skew_whole.edge),
            (kept.loose[None], skew_whole.loose[None]),
            *((kept.loose[None].measures[s], skew_whole.loose[None].measures[s]) for s in Symmetry),
        ):
            for field in fields(one):
                if isinstance(getattr(one, field.name), np.ndarray):
                    np.testing.assert_array_equal(
                        getattr(one, field.name), getattr(other, field.name)
                    )
    assert built == [(skew_whole.geometry, COARSE, BasisSettings())]
    assert len(said) == 1


# --- On the bench ------------------------------------------------------------------------------


def test_the_bench_moves_a_whole_reed(quiet_settings, even_whole, even_halves, skew_whole):
    bench, halves_bench, skew_bench = (
        BenchModel(quiet_settings, PlainMotion(reed), np.random.default_rng(1))
        for reed in (even_whole, even_halves, skew_whole)
    )
    moved, expected, skew = (
        one.displacement_m(DRIVE_HZ, 2.0) for one in (bench, halves_bench, skew_bench)
    )
    assert np.linalg.norm(moved - expected) < 0.01 * np.linalg.norm(expected)
    assert np.linalg.norm(skew - expected) > 0.1 * np.linalg.norm(expected)


def test_factors_of_the_moduli_hold_at_every_frequency():
    hz, cane = np.geomspace(10, 1e5, 9), viscoelastic_cane(Components(0.5, -1.0, 0.3), Series.B)
    for zener in (cane.young_L, cane.shear_LT):
        np.testing.assert_allclose(
            storage_modulus_pa(zener.scaled(1.1), hz),
            1.1 * storage_modulus_pa(zener, hz),
            rtol=1e-12,
        )


CHAMBER = Chamber()


def distorted(distortion, hz, count=24):
    """Values (n, n) of the factor at Gauss's points of the window, and their weights."""
    points, weights = np.polynomial.legendre.leggauss(count)
    x, y = np.meshgrid(
        0.5 * (1 + points) * CHAMBER.length_m, points * CHAMBER.half_width_m, indexing="ij"
    )
    return distortion_factor(distortion, CHAMBER, hz, x, y), 0.25 * np.outer(weights, weights)


def test_a_distortion_has_the_rms_that_was_asked_for():
    points, weights = np.polynomial.legendre.leggauss(8)
    total = 0.0
    for point, weight in zip(points, weights, strict=True):
        hz = 1e3 * 20 ** (0.5 * (1 + point))
        factor_, area = distorted(PressureDistortion(0.2, 7), hz)
        assert np.sum(area * (factor_ - 1)) == pytest.approx(0, abs=1e-12), "no mere gain"
        total += 0.5 * weight * np.sum(area * np.abs(factor_ - 1) ** 2)
    assert np.sqrt(total) == pytest.approx(0.2, rel=1e-9)


def test_a_distortion_follows_from_its_seed_and_goes_on_as_at_the_edges():
    one, again, other = (distorted(PressureDistortion(0.2, seed), 5e3)[0] for seed in (7, 7, 8))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 0.1
    x, y = np.array([33e-3, 60e-3]), np.array([5.3e-3, 6.5e-3])
    inside, outside = distortion_factor(PressureDistortion(0.2, 7), CHAMBER, 20e3, x, y)
    assert outside == pytest.approx(inside)
    high = distortion_factor(PressureDistortion(0.2, 7), CHAMBER, 40e3, x, y)
    assert high == pytest.approx([inside, outside])


def test_the_bench_pushes_with_the_distorted_pressure(quiet_settings, skew_whole):
    settings = with_part(quiet_settings, "chamber", distortion=PressureDistortion(0.3, 2))

    def pressure(hz, x, y):
        return pressure_shape(settings.chamber, hz, x, y).astype(complex)

    def distorted_pressure(hz, x, y):
        return pressure(hz, x, y) * distortion_factor(
            settings.chamber.distortion, settings.chamber, hz, x, y
        )

    nominal, bench = (
        BenchModel(one, PlainMotion(skew_whole), np.random.default_rng(1))
        for one in (quiet_settings, settings)
    )
    y, x = np.meshgrid(
        *reed_axes_m(settings.optics.layout, bench.region, bench.transform), indexing="ij"
    )
    plain = nominal.displacement_m(DRIVE_HZ, 1.0)
    # Where it moves much: ratios are then no noise of complex64.
    seen = np.abs(plain) > 0.3 * np.abs(plain).max()
    moved = bench.displacement_m(DRIVE_HZ, 1.0)[seen] / plain[seen]
    one, other = (
        deflection(skew_whole, float(DRIVE_HZ), p, x[seen], y[seen])
        for p in (distorted_pressure, pressure)
    )
    np.testing.assert_allclose(moved, one / other, rtol=1e-4)
    assert np.abs(moved - 1).max() > 0.05


def exposed(bench, object_gain):
    """Hologram of the reed at rest under light of a gain, around the reed."""
    state = BenchState(Fraction(25, 8), Fraction(0), 0.0)
    rng = np.random.default_rng(2)
    frames = [
        bench.frame([Segment(0.08 * m, 0.08 * (m + 1), state)], rng, object_gain) for m in range(4)
    ]
    return bench.region.crop(bench.transform.to_object(four_phase(np.stack(frames)))), frames


def test_light_of_the_object_has_the_gain_that_is_asked_for(quiet_bench):
    field, frames = exposed(quiet_bench, 1.0)
    gain = 0.7 * np.exp(1.1j)
    other, dimmer = exposed(quiet_bench, gain)
    inside = np.abs(field) > np.median(np.abs(field))
    measured = np.vdot(field[inside], other[inside]) / np.vdot(field[inside], field[inside])
    assert measured == pytest.approx(gain, rel=1e-3)
    # The light that does not beat goes with the square of the amplitude.
    brighter, nominal = (np.mean(images, dtype=float) for images in (frames, dimmer))
    lo = np.mean(exposed(quiet_bench, 0.0)[1], dtype=float)
    assert (nominal - lo) / (brighter - lo) == pytest.approx(0.49, rel=0.02)


def test_frames_are_the_same_with_and_without_mention_of_a_gain(quiet_bench):
    state = BenchState(Fraction(25, 8), DRIVE_HZ, 1.0)
    segments = [Segment(0.0, 0.08, state)]
    plain = quiet_bench.frame(segments, np.random.default_rng(2))
    np.testing.assert_array_equal(
        plain, quiet_bench.frame(segments, np.random.default_rng(2), 1.0 + 0.0j)
    )
