"""What a model does not know of a reed: its patterns, and what a fit makes of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import halfnorm

from fitting.cane import fit_runs
from fitting.cane.fit_runs import _parameters
from fitting.cane.model_errors import CANE as NUMBERS
from fitting.cane.model_errors import cane_shift, model_errors
from fitting.cane.over_density import MODULI, components_over_density, moduli_mpa
from fitting.cane.reed_fit import _never_negative, fit_components
from fitting.forward import hz_of, viscoelastic_cents
from fitting.resonance import Resonance
from physics.alterations import RandomLayer, YieldingClamp
from physics.effects.catalogue import BY_ID
from physics.mechanics import HIGHEST_HZ, CaneShift, Mechanics, ReedSolver
from physics.parameters.tree import BenchParameters
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.elements.fem import Symmetry
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.random_surface import random_surface
from physics.reed.reduced.changes import layer
from physics.reed.reduced.derivatives import derivatives
from physics.reed.reduced.vibrations import vibrations
from physics.reed.surface import on_reed, surface_shapes
from physics.sized_effect import SizedEffect
from tests.numbers import cents

CANE = Components(0.5, -0.4, 0.3)


@pytest.fixture(scope="module")
def solver(reed):
    return ReedSolver(reed)


@pytest.fixture(scope="module")
def unknown(solver):
    return model_errors(solver, BenchParameters(), PAPER_MODES)


def pattern(unknown, cause):
    return unknown.cents[unknown.causes.index(cause)]


def swept(model, shift_cents, noise_cents=1.0, series=Series.A, components=CANE):
    """Resonances of a reed of known cane, moved by a shift for each mode."""
    at = viscoelastic_cents(model, viscoelastic_cane(components, series), series)
    return {
        name: Resonance(name, float(hz_of(c + by)), noise_cents, 0, 5.0)
        for name, c, by in zip(model.modes, at, shift_cents, strict=True)
    }


def test_patterns_are_shifts_by_one_standard_deviation(solver, unknown):
    plain = solver.modes(Mechanics())
    yielding = solver.modes(Mechanics(alterations=((YieldingClamp(), 2e-13),)))
    for number, name in enumerate(PAPER_MODES):
        shift = cents(yielding[name].hz, plain[name].hz)
        assert pattern(unknown, "clamp_compliance")[number] == pytest.approx(shift, abs=1e-6)


def test_a_yielding_clamp_lowers_f_and_x_and_spares_t(unknown):
    shift = dict(zip(PAPER_MODES, pattern(unknown, "clamp_compliance"), strict=True))
    assert shift["F1"] < -10
    assert shift["X1"] < -10
    assert abs(shift["T2"]) < 1


def test_a_bed_that_shears_more_moves_what_a_yielding_clamp_moves(solver, unknown):
    shift = dict(zip(PAPER_MODES, pattern(unknown, "bed_shear"), strict=True))
    reeds = [
        Mechanics(alterations=((YieldingClamp(), 2e-13),), bed_shear_log=log) for log in (0.5, -0.5)
    ]
    more, less = (solver.modes(reed) for reed in reeds)
    for name, by in shift.items():
        assert by == pytest.approx(0.5 * cents(more[name].hz, less[name].hz), abs=1e-6)
    assert shift["F1"] < -3
    assert shift["X1"] < -10
    assert abs(shift["T2"]) < 0.5
    # Of either sign, and of the bench, not of one clamping.
    number = unknown.causes.index("bed_shear")
    assert not unknown.positive[number]
    assert not unknown.of_clamping[number]


def test_a_wall_moves_f1_as_much_as_all_air_of_a_free_plate(solver, unknown):
    free, vacuum = solver.modes(Mechanics()), solver.modes(Mechanics(air_share=0.0))
    shift = cents(free["F1"].hz, vacuum["F1"].hz)
    # Of two standard deviations: a wall about doubles the air of F1.
    assert 2 * pattern(unknown, "wall")[0] == pytest.approx(shift, rel=0.15)


def test_f1_compresses_the_air_in_the_mouthpiece(solver, unknown):
    """The energy of the spring, with the shape summed over the window, against that of motion."""
    chamber, mode = BenchParameters().chamber, solver.modes(Mechanics())["F1"]
    x, y = np.meshgrid(np.arange(0.05e-3, 40e-3, 0.1e-3), np.arange(-6e-3, 6e-3, 0.1e-3))
    inside = on_reed(solver.reed.geometry.outline, x, y)
    x, y = x[inside], y[inside]
    open_part = (x < chamber.length_m) & (np.abs(y) < chamber.half_width_m)
    shapes = surface_shapes(solver.reed, x, y, loose=True)[Symmetry.SYMMETRIC]
    coordinates = mode.coordinates[: shapes.shape[1]]
    displaced_m3 = float(np.sum(open_part * (shapes @ coordinates))) * 0.1e-3**2
    volume_m3 = np.pi / 4 * 15e-3**2 * 70e-3
    spring = 1.2 * 343.0**2 / volume_m3
    # Unit mass over half of the reed.
    ratio = spring * displaced_m3**2 / (2 * (2 * np.pi * mode.hz) ** 2)
    shift = dict(zip(PAPER_MODES, pattern(unknown, "mouthpiece"), strict=True))
    assert shift["F1"] == pytest.approx(600 / np.log(2) * ratio, rel=0.02)
    assert shift["F1"] > 30
    assert max(abs(shift[name]) for name in PAPER_MODES if name != "F1") < 1


def test_a_mouthpiece_does_not_change_a_cane(model, unknown):
    """F1 is 50 cents high: E1 would be off by 11 %, and is by 4 %."""
    high = np.where(np.array(PAPER_MODES) == "F1", 50.0, 0.0)
    resonances = {Series.A: swept(model, high)}
    without = replace(
        unknown, cents=np.where(
            (np.array(unknown.causes) == "mouthpiece")[:, None], 0.0, unknown.cents
        ),
    )  # fmt: skip
    off = []
    for errors in (unknown, without):
        found = fit_components(resonances, model, errors).moduli["A"]["E1_mpa"]
        true_mpa = viscoelastic_cane(CANE, Series.A).young_L.spring_mpa
        off.append(abs(found.value / true_mpa - 1))
    assert off[1] > 0.08
    assert off[0] < 0.5 * off[1]


@pytest.mark.slow
def test_maps_have_the_covariance_of_random_surfaces(solver, unknown):
    """Against surfaces of the simulated bench, drawn one by one."""
    found = vibrations(solver.reed, solver.state(Mechanics()), HIGHEST_HZ)
    named = solver.modes(Mechanics())
    rows = [int(np.abs(found.hz - named[name].hz).argmin()) for name in PAPER_MODES]
    lengths_m = RandomLayer.correlation_x_m, RandomLayer.correlation_y_m
    drawn = [layer(solver.reed, random_surface(seed, *lengths_m)) for seed in range(60)]
    shifts = 1200 / np.log(2) * derivatives(found, drawn).ln_hz[rows, -60:]
    rms_m = np.sqrt((3e-6**2 + 3e-6 * 8e-6 + 8e-6**2) / 3)
    maps = unknown.cents[[cause == "thickness_map" for cause in unknown.causes]]
    ratio = np.sqrt(np.sum(maps**2, axis=0)) / (rms_m * np.sqrt(np.mean(shifts**2, axis=1)))
    # Sixty draws know a standard deviation to a tenth.
    np.testing.assert_allclose(ratio, 1.0, atol=0.35)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15)


def test_a_yielding_clamp_is_not_taken_for_soft_cane(model, unknown):
    found = swept(model, pattern(unknown, "clamp_compliance"))
    blind = fit_components({Series.A: found}, model)
    aware = fit_components({Series.A: found}, model, unknown)
    truth = fit_components({Series.A: swept(model, np.zeros(11))}, model).moduli["A"]["E_4kHz_mpa"]
    assert blind.moduli["A"]["E_4kHz_mpa"].value < 0.98 * truth.value
    off = aware.moduli["A"]["E_4kHz_mpa"].value / truth.value - 1
    assert abs(off) < 0.01


def heavy_tip(**errors):
    """0.4 mg on the tip."""
    return SizedEffect(BY_ID["tip_mass"], {"mass": 0.4e-6}, errors)


def test_what_is_known_of_a_bench_is_not_taken_for_another_cane(model, solver, unknown):
    known = heavy_tip()
    with_mass = model_errors(solver, BenchParameters(), PAPER_MODES, [known])
    both = BenchParameters(), known.change(BenchParameters())
    plain, heavy = (solver.modes(parameters.reed) for parameters in both)
    shift = np.array([cents(heavy[name].hz, plain[name].hz) for name in PAPER_MODES])
    assert shift[0] < -20
    np.testing.assert_allclose(with_mass.known_cents, shift, atol=1e-6)
    np.testing.assert_array_equal(unknown.known_cents, 0.0)
    found = {Series.A: swept(model, shift)}
    truth = fit_components({Series.A: swept(model, np.zeros(11))}, model, unknown).moduli["A"]
    blind, aware = (fit_components(found, model, each).moduli["A"] for each in (unknown, with_mass))
    off = [each["E_4kHz_mpa"].value / truth["E_4kHz_mpa"].value - 1 for each in (blind, aware)]
    assert off[0] < -0.01
    assert abs(off[1]) < 0.005


def test_an_uncertain_size_is_one_more_cause(solver, unknown):
    sure, unsure = heavy_tip(), heavy_tip(mass=0.1e-6)
    exact, found = (
        model_errors(solver, BenchParameters(), PAPER_MODES, [each]) for each in (sure, unsure)
    )
    assert set(found.causes) - set(unknown.causes) == {"tip_mass"}
    assert len(found.causes) == len(exact.causes) + 1
    # A quarter of the mass moves modes by about a quarter.
    np.testing.assert_allclose(
        pattern(found, "tip_mass"), exact.known_cents / 4, rtol=0.15, atol=0.5
    )


def young_modulus(values, shift):
    """Young's modulus at 4 kHz over density."""
    moduli = moduli_mpa(values, shift, Series.A, np.array([2e3, 4e3, 8e3]))
    return moduli[MODULI.index("E_4kHz_mpa")]


def with_cane_of_h4(unknown):
    """Return the errors of a model that expects H4's cane of the drawing's density."""
    known = np.array([cause in NUMBERS for cause in unknown.causes])[:, None]
    return replace(
        unknown,
        cents=np.where(known, 0.0, unknown.cents),
        cane=np.where(known, 0.0, unknown.cane),
    )


def test_clamps_that_all_yield_leave_no_bias(model, unknown):
    """A clamp yields or not; to expect as much of the opposite makes all cane look soft.

    With few modes, whose frequencies alone do not show what the clamp does.
    """
    few = ("F1", "T1", "F2", "T2")
    sizes = halfnorm.ppf((np.arange(12) + 0.5) / 12)
    yielding = pattern(unknown, "clamp_compliance")
    both_ways = replace(unknown, positive=np.zeros(len(unknown.causes), dtype=bool))
    truth = young_modulus(np.array([0.5, -0.4, 0.3]), CaneShift())
    bias = []
    for errors in (unknown, both_ways):
        E = [
            fit_components({Series.A: {name: found[name] for name in few}}, model, errors)
            .moduli["A"]["E_4kHz_mpa"]
            .value
            for found in (swept(model, size * yielding) for size in sizes)
        ]
        bias.append(float(np.mean(E)) / truth - 1)
    assert abs(bias[0]) < 0.004
    assert bias[1] < -0.02


def test_normal_values_are_cut_at_zero():
    """Against draws; what is surely positive stays as it is."""
    rng = np.random.default_rng(3)
    mean, root = np.array([0.4, -0.3, 8.0]), np.array([[1.0, 0, 0], [0.7, 0.6, 0], [0.1, 0.2, 0.5]])
    drawn = mean + rng.standard_normal((400_000, 3)) @ root.T
    drawn = drawn[drawn[:, 0] >= 0]
    found, covariance = _never_negative(mean, root @ root.T, np.array([0, 2]))
    assert found == pytest.approx(drawn.mean(axis=0), abs=5e-3)
    assert covariance == pytest.approx(np.cov(drawn.T), abs=8e-3)


def test_dense_cane_is_not_taken_for_soft_cane(model, unknown):
    """Frequencies of a dense reed fall together, and those of cane of H4 cannot.

    The reed is denser by one and a half standard deviations.
    """
    dense_cane = CaneShift(density=1.5 * float(unknown.cane[:, NUMBERS.index("density")].sum()))
    found = {Series.A: swept(model, 1.5 * pattern(unknown, "density"))}
    without = with_cane_of_h4(unknown)
    plain = {Series.A: swept(model, np.zeros(11))}
    values = np.array([0.5, -0.4, 0.3])
    # What the clamp may do is the same in both reeds.
    truth = young_modulus(values, dense_cane) / young_modulus(values, CaneShift())
    off = []
    for errors in (without, unknown):
        dense, other = (
            fit_components(each, model, errors).moduli["A"]["E_4kHz_mpa"].value
            for each in (found, plain)
        )
        off.append(dense / other / truth - 1)
    assert abs(off[0]) > 0.02
    assert abs(off[1]) < 0.01


@pytest.mark.parametrize("sign", [-1, 1])
def test_cane_that_leaves_h4_is_not_taken_for_other_cane(model, unknown, sign):
    """Bending as much stiffer than by H4 as ten in a hundred reeds, and twice that."""
    by_h4 = with_cane_of_h4(unknown)
    plain, values = {Series.A: swept(model, np.zeros(11))}, np.array([0.5, -0.4, 0.3])
    for size in (1.65, 3.3):
        amounts = np.where(np.array(unknown.causes) == "E_L", sign * size, 0.0)
        shift = cane_shift(amounts, unknown.cane)
        found = {Series.A: swept(model, amounts @ unknown.cents)}
        truth = young_modulus(values, shift) / young_modulus(values, CaneShift())
        pulls = []
        for errors in (by_h4, unknown):
            other, E = (
                fit_components(each, model, errors).moduli["A"]["E_4kHz_mpa"]
                for each in (plain, found)
            )
            pulls.append((E.value / other.value / truth - 1) * E.value / E.error)
        assert abs(pulls[1]) < 1.3
        if size > 2:
            assert abs(pulls[0]) > 2.0


@pytest.mark.slow
def test_components_and_moduli_of_reeds_drawn_from_these_errors_are_covered(model, unknown):
    rng, pulls, values = np.random.default_rng(5), [], np.array([0.5, -0.4, 0.3])
    hz = hz_of(viscoelastic_cents(model, viscoelastic_cane(CANE, Series.A), Series.A))
    for _ in range(40):
        drawn = rng.standard_normal(len(unknown.causes))
        drawn = np.where(unknown.positive, np.abs(drawn), drawn)
        own = np.hypot(1.0, unknown.own_cents) * rng.standard_normal(11)
        shift = cane_shift(drawn, unknown.cane)
        found = fit_components(
            {Series.A: swept(model, drawn @ unknown.cents + own)}, model, unknown
        )
        truth = components_over_density(values, shift, {Series.A: hz})
        stated = found.components.values()
        pull = [(e.value - true) / e.error for e, true in zip(stated, truth, strict=True)]
        E = found.moduli["A"]["E_4kHz_mpa"]
        pulls.append([*pull, (E.value - young_modulus(values, shift)) / E.error])
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.25)


def test_patterns_are_those_of_the_cane_that_is_found(reed, model, monkeypatch):
    """First of the cane of the population, then of that which was found with them."""
    seen = []

    def kept(solver, bench, modes, known):
        seen.append((bench.reed.cane, model_errors(solver, bench, modes, known)))
        return seen[-1][1]

    monkeypatch.setattr(fit_runs, "model_errors", kept)
    found = {Series.A: swept(model, np.zeros(11), components=Components(-1.0, 1.0, 1.5))}
    parameters = _parameters(found, model, reed, ())
    (middle, first), (own, second) = seen
    assert middle == BenchParameters().reed.cane
    before = fit_components(found, model, first).components
    values = {name: each.value for name, each in before.items()}
    assert own == viscoelastic_cane(Components(**values), Series.A)
    after = fit_components(found, model, second).components
    assert parameters.components == after
    assert any(after[name].error != each.error for name, each in before.items())


def test_each_clamping_has_a_clamp_of_its_own(model, unknown):
    """Shifted in series B only, which a clamp common to both series could not explain."""
    shift = 1.5 * pattern(unknown, "clamp_shift")
    found = {
        Series.A: swept(model, np.zeros(11), 0.5),
        Series.B: swept(model, shift, 0.5, Series.B),
    }
    common = replace(unknown, of_clamping=np.zeros(len(unknown.causes), dtype=bool))
    own, shared = (fit_components(found, model, errors) for errors in (unknown, common))
    assert own.reduced_chi2 < shared.reduced_chi2
