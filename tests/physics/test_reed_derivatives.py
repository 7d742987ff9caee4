"""Analytic derivatives of a reduced reed: against central differences, and sum rules."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from physics.air import pressure_shape
from physics.parameters.chamber import Chamber, Filling
from physics.reed.cane.material import STIFFNESS_TERMS, Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.radiation import air_load
from physics.reed.reduced.changes import (
    added_mass,
    as_matrix,
    combined,
    layer,
    moved_clamp,
    softening,
    yielding_clamp,
)
from physics.reed.reduced.derivatives import (
    PARAMETERS,
    derivatives,
    local_shifts,
    predicted_hz,
)
from physics.reed.reduced.dynamics import CaneLaw, LossFactors, State
from physics.reed.reduced.losses import loss_factors
from physics.reed.reduced.reed import MODULI
from physics.reed.reduced.response import pressure_force, pressure_forces
from physics.reed.reduced.shape_derivatives import (
    loss_derivatives,
    modal_force_derivatives,
    modal_forces,
    shape_derivatives,
)
from physics.reed.reduced.vibrations import vibrations
from tests.numbers import cents

HIGHEST_HZ = 22e3
CANE = Cane(E_T_pa=430e6, G_LR_pa=1300e6, nu_LT=0.25)
LAW = CaneLaw(
    CANE,
    viscoelastic_cane(Components(0.3, -0.2, 0.1), Series.A),
    log_E_L=0.03,
    growth_E_L=0.02,
    growth_G_LT=-0.01,
)
LOSSES = LossFactors(0.03, 0.05, 0.1)


@pytest.fixture(scope="module")
def air(coarse_reed):
    return air_load(coarse_reed)


@pytest.fixture(scope="module")
def directions(coarse_reed):
    """Unit changes, each with the step of a central difference."""
    reed = coarse_reed
    return {
        "offset": (layer(reed, lambda x, _y: np.ones_like(x)), 2e-8),
        "tilt": (layer(reed, lambda _x, y: y / 6e-3), 2e-8),
        "wedge": (layer(reed, lambda x, _y: x / 35e-3), 2e-8),
        "mass": (added_mass(reed, lambda x, _y: (x < 2e-3) / 20e-6), 1e-9),
        "crack": (softening(reed, lambda x, y: np.exp(-((x - 0.012) ** 2 + y**2) / 2e-6)), 2e-7),
        "edge": (moved_clamp(reed, 1.0), 1e-6),
        "turned": (moved_clamp(reed, 0.0, 1.0), 1e-6),
        "clamp": (yielding_clamp(reed, 1.0, 1.0), 2e-16),
        "left": (yielding_clamp(reed, 1.0, 0.0), 2e-16),
    }


def states(reed, air, directions):
    """A clamped reed in vacuum, and one with everything that does not keep it even."""
    everything = [
        (6e-6, directions["offset"][0]),
        (5e-6, directions["tilt"][0]),
        (2e-13, directions["clamp"][0]),
        (1e-13, directions["left"][0]),
        (3e-7, directions["mass"][0]),
    ]
    return {
        "held": State(LAW),
        "everything": State(LAW, combined(everything), air, 0.8),
    }


def stepped(state, name, directions, amount):
    """The state with one parameter changed."""
    if name in directions:
        change = combined([(1.0, state.change), (amount, directions[name][0])])
        return replace(state, change=change)
    law, cane = state.law, state.law.constants
    if name == "air_fraction":
        return replace(state, air_fraction=state.air_fraction + amount)
    if name.startswith("growth"):
        return replace(state, law=replace(law, **{name: getattr(law, name) + amount}))
    if name == "ln E_L_pa":
        return replace(state, law=replace(law, log_E_L=law.log_E_L + amount))
    if name == "ln G_LT_pa":
        return replace(state, law=replace(law, log_G_LT=law.log_G_LT + amount))
    field = name.removeprefix("ln ")
    value = getattr(cane, field)
    moved = value * np.exp(amount) if name.startswith("ln") else value + amount
    return replace(state, law=replace(law, constants=replace(cane, **{field: moved})))


def differences(reed, state, name, directions, look):
    """Central difference of what a look at the vibrations gives."""
    step = directions[name][1] if name in directions else 1e-5
    start = vibrations(reed, state, HIGHEST_HZ)
    found = []
    for amount in (step, -step):
        other = vibrations(reed, stepped(state, name, directions, amount), HIGHEST_HZ)
        signs = np.sign(np.sum(other.coordinates * start.coordinates, axis=0))
        found.append(look(replace(other, coordinates=other.coordinates * signs)))
    return (found[0] - found[1]) / (2 * step)


@pytest.fixture(scope="module", params=["held", pytest.param("everything", marks=pytest.mark.slow)])
def case(request, coarse_reed, air, directions):
    state = states(coarse_reed, air, directions)[request.param]
    found = vibrations(coarse_reed, state, HIGHEST_HZ)
    names = list(directions)
    slopes = shape_derivatives(found, [directions[name][0] for name in names])
    return state, found, (*PARAMETERS, *names), slopes


def one_sided(state, name):
    """Parameters at the end of their range: nothing yields less than a rigid clamp."""
    return state.change.compliance_m_n is None and name in ("clamp", "left")


PARAMETERS_OF_STATE = [n for n in PARAMETERS if n != "air_fraction"]


def test_frequencies_follow_every_parameter(case, coarse_reed, directions):
    state, _, names, slopes = case
    for number, name in enumerate(names):
        if one_sided(state, name):
            continue
        expected = differences(coarse_reed, state, name, directions, lambda v: np.log(v.hz))
        own = slopes.frequencies.ln_hz[:, number]
        scale = np.abs(expected).max()
        # An odd change of an even reed, and air where there is none, move nothing.
        assert np.abs(own - expected).max() <= 1e-3 * scale + 1e-7, name


def test_a_rigid_clamp_is_the_limit_of_one_that_yields(coarse_reed, directions):
    """Of a rigid clamp there is no central difference, but of one that hardly yields there is."""
    unit = directions["clamp"][0]
    rigid, yielding = (
        derivatives(vibrations(coarse_reed, state, HIGHEST_HZ), [unit]).ln_hz[:, -1]
        for state in (State(LAW), State(LAW, combined([(1e-18, unit)])))
    )
    assert rigid.max() < 0
    np.testing.assert_allclose(rigid, yielding, rtol=0.01, atol=5e-3 * np.abs(rigid).max())


def test_shapes_follow_every_parameter(case, coarse_reed, directions):
    state, found, names, slopes = case
    for number, name in enumerate(names):
        if one_sided(state, name):
            continue
        expected = differences(coarse_reed, state, name, directions, lambda v: v.coordinates)
        # The lower half of the modes: those above are of a rougher span.
        half = np.s_[: len(found.hz) // 2]
        scale = np.abs(expected).max(axis=0)[half]
        off = np.abs(slopes.shapes[..., number] - expected).max(axis=0)[half]
        assert np.all(off <= 0.02 * scale + 5e-3 * scale.max() + 1e-9), name


def test_losses_follow_every_parameter(case, coarse_reed, directions):
    state, found, names, slopes = case
    own = loss_derivatives(found, LOSSES, slopes)
    for number, name in enumerate(names):
        if one_sided(state, name):
            continue
        expected = differences(
            coarse_reed, state, name, directions, lambda v: loss_factors(v, LOSSES)
        )
        off = np.abs(own[:, number] - expected)[: len(found.hz) // 2]
        # Losses are some hundredths.
        assert off.max() <= 0.02 * np.abs(expected).max() + 1e-4, name


def pressure(hz, x, y):
    return pressure_shape(Chamber(Filling.ASYMMETRIC), hz, x, y).astype(complex)


def test_forces_on_modes_follow_every_parameter(case, coarse_reed, directions):
    state, found, names, slopes = case
    force = pressure_force(coarse_reed, pressure)
    own = modal_force_derivatives(found, force, slopes)
    for number, name in enumerate(names):
        if one_sided(state, name):
            continue
        expected = differences(
            coarse_reed, state, name, directions, lambda v: modal_forces(v, force)
        )
        off = np.abs(own[:, number] - expected)[: len(found.hz) // 2]
        size = np.abs(modal_forces(found, force)).max()
        assert off.max() <= 0.02 * np.abs(expected).max() + 1e-5 * size, name


def test_moduli_raise_elastic_modes_by_half_their_logarithm_together(coarse_reed):
    found = vibrations(coarse_reed, State(CaneLaw(CANE)), HIGHEST_HZ)
    slopes = derivatives(found).ln_hz
    moduli = [PARAMETERS.index(f"ln {name}") for name in MODULI]
    np.testing.assert_allclose(slopes[:, moduli].sum(axis=1), 0.5, rtol=1e-9)
    np.testing.assert_allclose(slopes[:, PARAMETERS.index("ln density_kg_m3")], -0.5, rtol=1e-9)


def complex_eigenvalue(reed, state, hz):
    """Eigenvalue ω²(1 + iη) next to a frequency, in all coordinates, with what holds there."""
    law, change, omega = state.law, state.change, 2 * np.pi * hz
    own = [LOSSES.shear if term[0] in "456" else LOSSES.normal for term in STIFFNESS_TERMS]
    terms = reed.stiffness_terms + as_matrix(reed, change.stiffness_terms)
    K = np.tensordot(stiffness_terms_pa(law.at(hz)) * (1 + 1j * np.array(own)), terms, axes=1)
    M = law.constants.density_kg_m3 * (reed.mass + as_matrix(reed, change.mass))
    M = M + as_matrix(reed, change.mass_kg)
    if state.air is not None:
        carried, resisting = (
            linalg.block_diag(*own) for own in zip(*state.air.at(hz), strict=True)
        )
        M = M + state.air_fraction * carried
        K = K + 1j * omega * state.air_fraction * resisting
    moving = np.ones(len(M), dtype=bool)
    if change.compliance_m_n is None:
        moving[reed.strip] = False
    else:
        springs = np.linalg.inv(change.compliance_m_n)
        K[np.ix_(reed.strip, reed.strip)] += (1 + 1j * LOSSES.clamp) * springs
    cut = np.ix_(moving, moving)
    values = np.linalg.eigvals(np.linalg.solve(M[cut], K[cut]))
    return values[np.argmin(np.abs(values.real - omega**2))]


def test_losses_are_those_of_the_complex_eigenproblem(case, coarse_reed):
    state, found, _, _ = case
    own = loss_factors(found, LOSSES)
    values = np.array([complex_eigenvalue(coarse_reed, state, float(hz)) for hz in found.hz])
    # To first order in losses of some percent, and modes that are close share theirs.
    np.testing.assert_allclose(own, values.imag / values.real, rtol=0.02)
    assert own.max() - own.min() > 0.005
    together = loss_factors(found, LossFactors(0.04, 0.04, 0.04))
    alone = loss_factors(found, LossFactors(0.0, 0.0, 0.0))
    np.testing.assert_allclose(together - alone, 0.04, rtol=1e-9)


# --- Modes that are nearly degenerate ----------------------------------------------------------


def closest(reed, base, logs, among):
    """Where ln G_LT brings two neighbours of a list of modes closest: law, cents, their names."""
    best = (np.inf, 0.0)
    for log in logs.tolist():
        hz = among(vibrations(reed, State(replace(base, log_G_LT=log)), HIGHEST_HZ))
        best = min(best, (float(cents(hz[1:], hz[:-1]).min()), log))
    return replace(base, log_G_LT=best[1]), best[0]


def test_a_pair_is_followed_through_its_avoided_crossing(coarse_reed):
    """T4 and F4: across, single derivatives go straight on."""

    def even_and_high(found):
        hz = found.hz[found.order[0]]
        return hz[(hz > 11e3) & (hz < 17.5e3)]

    base = CaneLaw(Cane(E_L_pa=10.5e9, G_LT_pa=1.6e9))
    law, gap = closest(coarse_reed, base, np.linspace(-0.3, 0.3, 41), even_and_high)
    assert gap < 150
    half = 0.1
    start, end = (
        vibrations(
            coarse_reed, State(replace(law, log_G_LT=law.log_G_LT + side * half)), HIGHEST_HZ
        )
        for side in (-1, 1)
    )
    slopes = derivatives(start)
    step = np.zeros(len(PARAMETERS))
    step[PARAMETERS.index("ln G_LT_pa")] = 2 * half
    even = start.order[0]
    ranks = even[np.argsort(start.hz[even])]
    looked_at = (start.hz[ranks[:-1]] > 11e3) & (start.hz[ranks[1:]] < 17.5e3)
    first = int(np.argmin(np.where(looked_at, np.diff(start.hz[ranks]), np.inf)))
    pair = ranks[first : first + 2]
    others = np.sort(end.hz[end.order[0]])[first : first + 2]
    alone = start.hz[pair] * np.exp(slopes.ln_hz[pair] @ step)
    within = np.ix_(pair, pair)
    matrix = np.diag(np.log(start.hz[pair])) + slopes.couplings[within] @ step
    together = np.exp(np.linalg.eigvalsh(matrix))
    assert np.abs(cents(np.sort(alone), others)).max() > 4
    assert np.abs(cents(together, others)).max() < 0.5 * np.abs(cents(np.sort(alone), others)).max()
    everything = np.abs(cents(predicted_hz(start, slopes, step)[pair], others))
    assert everything.max() < 0.5 * np.abs(cents(np.sort(alone), others)).max()


def test_an_odd_change_pushes_modes_of_unlike_symmetry_apart(coarse_reed, directions):
    """T3 and F3 cross; a tilt couples them, though the derivative of neither knows of it."""
    tilt, amount_m = directions["tilt"][0], 4e-6

    def middle(found):
        return found.hz[(found.hz > 7e3) & (found.hz < 13e3)]

    base = CaneLaw(Cane(E_L_pa=14e9))
    law, gap = closest(coarse_reed, base, np.linspace(-0.6, 0.6, 121), middle)
    law, gap = closest(coarse_reed, law, law.log_G_LT + np.linspace(-5e-3, 5e-3, 41), middle)
    law, gap = closest(coarse_reed, law, law.log_G_LT + np.linspace(-2e-4, 2e-4, 21), middle)
    assert gap < 0.03
    start = vibrations(coarse_reed, State(law), HIGHEST_HZ)
    end = vibrations(coarse_reed, State(law, combined([(amount_m, tilt)])), HIGHEST_HZ)
    slopes = derivatives(start, [tilt])
    np.testing.assert_allclose(slopes.ln_hz[:, -1], 0, atol=1e-9)
    step = np.zeros(len(PARAMETERS) + 1)
    step[-1] = amount_m
    lower = int(np.argmin(np.where(start.hz[:-1] > 7e3, np.diff(start.hz), np.inf)))
    together = predicted_hz(start, slopes, step)
    apart = cents(end.hz[lower + 1], end.hz[lower])
    assert apart > 5 * gap
    assert cents(together[lower + 1], together[lower]) == pytest.approx(apart, rel=0.2)


# --- Pressure ----------------------------------------------------------------------------------


@pytest.mark.parametrize("filling", list(Filling))
def test_forces_by_polynomials_are_those_projected(filling, coarse_reed):
    def shape(hz, x, y):
        return pressure_shape(Chamber(filling), hz, x, y) * np.exp(-2j * hz * x / 343.0)

    force = pressure_force(coarse_reed, shape)
    for hz in (0.0, 37.0, 605.3, 4308.6, 19876.5, 24.9e3, 30e3):
        expected = pressure_forces(coarse_reed, hz, shape)
        size = max(np.linalg.norm(own) for own in expected.values())
        for key, own in force.at(hz).items():
            assert np.linalg.norm(own - expected[key]) <= 2e-5 * size
    assert force.highest_hz == 25e3


def test_a_sharp_pressure_is_projected_at_every_frequency(coarse_reed):
    def shape(hz, x, _y):
        return np.exp(-x / 0.01) / (1 - (hz / 4308.6) ** 2 + 1j * hz / 4308.6 / 2500)

    force = pressure_force(coarse_reed, shape)
    for hz in (4300.0, 4308.6, 4310.0):
        for key, own in force.at(hz).items():
            np.testing.assert_array_equal(own, pressure_forces(coarse_reed, hz, shape)[key])


def test_derivatives_of_a_sharp_pressure_are_those_of_its_resonance(coarse_reed):
    def shape(hz, x, _y):
        return np.exp(-x / 0.01) * gain(hz)

    def gain(hz):
        return 1 / (1 - (hz / 4308.6) ** 2 + 1j * hz / 4308.6 / 2500)

    force, hz = pressure_force(coarse_reed, shape), 4308.0
    ratio = hz / 4308.6
    expected = (2 * ratio**2 - 1j * ratio / 2500) * gain(hz)
    for key, own in force.by_ln_hz(hz).items():
        np.testing.assert_allclose(own, expected * force.at(hz)[key], rtol=1e-3)


def test_local_shifts_add_up_to_those_of_a_layer(coarse_reed):
    found = vibrations(coarse_reed, State(CaneLaw(coarse_reed.cane)), 20e3)

    def thickness(x, y):
        return 1 + 30 * x + 50 * np.abs(y)

    on_vamp = coarse_reed.bark_m[:, 0] < coarse_reed.geometry.vamp_x_m[-1]
    weights = coarse_reed.area_m2 * on_vamp * thickness(*coarse_reed.bark_m.T)
    whole = derivatives(found, [layer(coarse_reed, thickness)]).ln_hz[:, -1]
    np.testing.assert_allclose(weights @ local_shifts(found), whole, rtol=1e-9)
