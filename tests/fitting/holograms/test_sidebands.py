"""Other sidebands of the same vibrations: their derivatives, and what they show of the light."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import jv

from fitting.holograms.amplitudes import block_object_field, fit_amplitudes
from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import SidebandAmplitudes
from fitting.holograms.displacement import fit_displacements
from fitting.holograms.object_field import linearise, smooth_functions
from fitting.holograms.problem import (
    Problem,
    misfits,
    normal,
)
from fitting.holograms.sidebands import (
    OtherSideband,
    brightness,
    sideband_equations,
    sideband_values,
)
from tests.fitting.holograms.test_displacement import complex_normal, planted, share_of_error

HOLOGRAMS, BLOCKS, FUNCTIONS = 6, 150, 4
LIGHT = 40.0
ORDERS = (0, 1, 2, 5)


def sideband(order, u):
    """F_n(u) to double precision."""
    return jv(order, np.abs(u)) * np.exp(1j * order * np.angle(u))


@dataclass
class Sweep:
    """A few holograms of a few sidebands, with noise; brightness and phase are drawn for each."""

    orders: tuple[int, ...]
    largest_rad: float = 4.0
    noise: float = 1.0

    def __post_init__(self):
        rng = np.random.default_rng(4)
        self.x, self.y = rng.uniform(0, 1, (2, BLOCKS))
        self.functions = rng.uniform(-1, 1, (BLOCKS, FUNCTIONS))
        self.a = complex_normal(rng, HOLOGRAMS, FUNCTIONS)
        self.a *= self.largest_rad / np.abs(self.a @ self.functions.T).max()
        self.object_field = LIGHT * complex_normal(rng, BLOCKS)
        self.weight = rng.uniform(0.5, 1, HOLOGRAMS)
        u = self.a @ self.functions.T

        def seen(order, c):
            return c[:, None] * self.object_field * sideband(
                order, u
            ) + self.noise * complex_normal(rng, HOLOGRAMS, BLOCKS)

        self.c = {
            n: np.exp(0.05 * rng.standard_normal(HOLOGRAMS) + 2j * np.pi * rng.uniform(size=6))
            for n in self.orders
        }
        present = np.arange(HOLOGRAMS) != 2
        self.others = [
            SidebandAmplitudes(n, np.where(present[:, None], seen(n, self.c[n]), 0).T, present)
            for n in self.orders
        ]
        first = seen(1, np.ones(HOLOGRAMS)).T
        self.problem = Problem.of(first, self.functions, BesselTable(), self.others)
        self.smooth = smooth_functions(self.x, self.y)

    def sideband_equations(self, a=None, object_field=None):
        return sideband_equations(
            self.problem.others[0],
            self.functions,
            self.problem.pairs,
            self.object_field if object_field is None else object_field,
            np.arange(HOLOGRAMS),
            self.problem.displacement(self.a if a is None else a),
        )

    def linear(self, object_field=None):
        object_field = self.object_field if object_field is None else object_field
        zero = np.zeros(HOLOGRAMS)
        return linearise(self.problem, self.smooth, object_field, self.a, zero, self.weight)


# --- Block amplitudes -----------------------------------------------------------------------------


@pytest.mark.parametrize("order", ORDERS)
def test_phasors_are_those_of_the_sideband(order):
    sweep = Sweep((order,), 30.0)
    shown = sideband_values(sweep.problem.others[0], sweep.problem.displacement(sweep.a))
    assert np.abs(shown - sideband(order, sweep.a @ sweep.functions.T)).max() < 2e-5


def test_where_nothing_moves_only_the_carrier_is_bright():
    still = np.zeros((2, 3)), np.zeros((2, 3))
    for order, expected in ((0, 1), (1, 0), (2, 0)):
        side = OtherSideband.of(
            SidebandAmplitudes(order, np.zeros((3, 2)), np.ones(2, bool)), float
        )
        assert sideband_values(side, still) == pytest.approx(np.full((2, 3), expected))


@pytest.mark.parametrize("order", ORDERS)
def test_brightness_and_phase_are_found(order):
    sweep = Sweep((order,), noise=0.0)
    side, present = sweep.problem.others[0], np.arange(HOLOGRAMS) != 2
    shown = sideband_values(side, sweep.problem.displacement(sweep.a))
    found = brightness(side, shown, sweep.object_field, np.arange(HOLOGRAMS))
    assert np.abs(found / sweep.c[order] - 1)[present].max() < 1e-4


# --- Derivatives -------------------------------------------------------------------------------


# Sideband 5 of half a radian is all dark: a dark hologram's brightness is held, not found.
@pytest.mark.parametrize(
    ("order", "largest_rad"), [*((n, 9.0) for n in ORDERS), (0, 0.5), (1, 0.5), (2, 0.5)]
)
def test_gradients_are_minus_half_the_slope_of_what_is_left(order, largest_rad):
    """Brightness and phase are fitted again at every place."""
    # Tables are single precision: no smaller step.
    sweep, step = Sweep((order,), largest_rad), 3e-3
    slopes = [
        (
            sweep.sideband_equations(sweep.a + move).misfit
            - sweep.sideband_equations(sweep.a - move).misfit
        )
        / (2 * step)
        for move in step * np.concatenate([np.eye(FUNCTIONS), 1j * np.eye(FUNCTIONS)])
    ]
    expected = -0.5 * np.array(slopes).T
    assert sweep.sideband_equations().gradient == pytest.approx(
        expected, abs=5e-3 * np.abs(expected).max()
    )


@pytest.mark.parametrize("order", ORDERS)
def test_matrices_leave_brightness_and_phase_free(order):
    sweep, step, k = Sweep((order,), noise=0.0), 1e-6, 3
    lit = sweep.c[order][k] * sweep.object_field
    columns = []
    for move in step * np.concatenate([np.eye(FUNCTIONS), 1j * np.eye(FUNCTIONS)]):
        ahead, behind = (
            sideband(order, (sweep.a[k] + s * move) @ sweep.functions.T) for s in (1, -1)
        )
        columns.append(lit * (ahead - behind) / (2 * step))
    own = np.stack(columns, axis=1)
    free = lit * sideband(order, sweep.a[k] @ sweep.functions.T)
    free = np.stack([free, 1j * free], axis=1)
    coupling = (own.conj().T @ free).real
    expected = (own.conj().T @ own).real - coupling @ coupling.T / np.sum(np.abs(free[:, 0]) ** 2)
    found = sweep.sideband_equations().matrix[k]
    assert found == pytest.approx(expected, abs=2e-4 * np.abs(expected).max())


def test_a_sideband_that_was_not_recorded_gives_nothing():
    found = Sweep((0,)).sideband_equations()
    assert found.misfit[2] == 0
    assert not found.gradient[2].any()
    assert not found.matrix[2].any()


def test_equations_of_the_light_are_those_of_the_search():
    sweep = Sweep((0, 2))
    expected = normal(
        sweep.problem, sweep.object_field, np.arange(HOLOGRAMS), sweep.a, np.zeros(HOLOGRAMS)
    )
    found = sweep.linear().normal
    for one, other in ((found.misfit, expected.misfit), (found.gradient, expected.gradient)):
        assert one == pytest.approx(other, rel=1e-9)
    assert found.matrix == pytest.approx(expected.matrix, rel=1e-9)
    assert sweep.problem.seen.tolist() == [450, 450, 150, 450, 450, 450]


@pytest.mark.parametrize("orders", [(), (0, 2)])
def test_misfits_without_slopes_are_those_with_them(orders):
    sweep, gain = Sweep(orders), 0.1 * np.arange(HOLOGRAMS)
    point = sweep.problem, sweep.object_field, np.arange(HOLOGRAMS), 0.9 * sweep.a, gain
    assert misfits(*point) == pytest.approx(normal(*point).misfit, rel=1e-9)


@pytest.mark.parametrize("count", [1, 3])
def test_a_descent_returns_the_misfits_of_its_end(count):
    sweep, steps = Sweep((0, 2)), np.arange(HOLOGRAMS)
    start, prior = (0.9 * sweep.a, np.zeros(HOLOGRAMS)), np.eye(FUNCTIONS)
    a, gain, left = fit_amplitudes(sweep.problem, sweep.object_field, steps, start, count, prior)
    assert left == pytest.approx(
        misfits(sweep.problem, sweep.object_field, steps, a, gain), rel=1e-9
    )
    assert np.all(left < misfits(sweep.problem, sweep.object_field, steps, *start))


def test_a_descent_takes_no_turn_that_makes_it_worse():
    sweep, steps = Sweep((), largest_rad=8.0), np.arange(HOLOGRAMS)
    # A step that takes F for straight goes beyond its largest.
    start = (0.2 * sweep.a, np.zeros(HOLOGRAMS))
    a, gain, left = fit_amplitudes(
        sweep.problem, sweep.object_field, steps, start, 1, np.eye(FUNCTIONS)
    )
    stayed = np.all(a == start[0], axis=1)
    assert 0 < np.count_nonzero(stayed) < HOLOGRAMS
    assert left == pytest.approx(
        misfits(sweep.problem, sweep.object_field, steps, a, gain), rel=1e-9
    )


@pytest.mark.parametrize("orders", [(0,), (2,), (0, 2)])
def test_gradients_of_the_light_follow_all_sidebands(orders):
    sweep, count = Sweep(orders), 66

    def misfit(move):
        factor = np.exp(sweep.smooth @ (move[:count] + 1j * move[count:]))
        return sweep.weight @ sweep.linear(sweep.object_field * factor).normal.misfit

    slopes = [(misfit(1e-4 * unit) - misfit(-1e-4 * unit)) / 2e-4 for unit in np.eye(2 * count)]
    expected = -0.5 * np.array(slopes)
    found = sweep.linear().field_gradient.sum(axis=0)
    assert found == pytest.approx(expected, abs=3e-3 * np.abs(expected).max())


@pytest.mark.parametrize("order", [0, 2])
def test_light_is_coupled_to_displacement_with_brightness_and_phase_free(order):
    """What other sidebands add, from derivatives of their block amplitudes by differences."""
    sweep, step = Sweep((order,), noise=0.0), 1e-6
    with_it = sweep.linear()
    without = linearise(
        replace(sweep.problem, others=()),
        sweep.smooth,
        sweep.object_field,
        sweep.a,
        np.zeros(HOLOGRAMS),
        sweep.weight,
    )
    matrix = np.zeros((132, 132))
    for k in np.flatnonzero(np.arange(HOLOGRAMS) != 2):
        lit = sweep.c[order][k] * sweep.object_field
        at = lit * sideband(order, sweep.a[k] @ sweep.functions.T)
        columns = []
        for move in step * np.concatenate([np.eye(FUNCTIONS), 1j * np.eye(FUNCTIONS)]):
            ahead, behind = (
                sideband(order, (sweep.a[k] + s * move) @ sweep.functions.T) for s in (1, -1)
            )
            columns.append(lit * (ahead - behind) / (2 * step))
        own, of_light = np.stack(columns, axis=1), at[:, None] * sweep.smooth
        of_light = np.concatenate([of_light, 1j * of_light], axis=1)
        # Without the part along what is free: brightness, and phase.
        free = np.stack([at, 1j * at], axis=1)
        power = np.sum(np.abs(at) ** 2)
        own = own - free @ (free.conj().T @ own).real / power
        of_light = of_light - free @ (free.conj().T @ of_light).real / power
        expected = (own.conj().T @ of_light).real
        found = with_it.coupling[k, :-1] - without.coupling[k, :-1]
        assert found == pytest.approx(expected, abs=1e-3 * np.abs(with_it.coupling[k]).max())
        matrix += sweep.weight[k] * (of_light.conj().T @ of_light).real
    # A hologram that is not there couples nothing.
    assert with_it.coupling[2] == pytest.approx(without.coupling[2])
    # The same for magnitude and phase, and nothing between the two.
    changes = np.random.default_rng(5).standard_normal(with_it.coupling.shape[:2])
    products = np.einsum("kxc,kx->kc", with_it.coupling, changes)
    size = np.abs(products).max()
    assert with_it.on_field(changes) == pytest.approx(products, abs=1e-9 * size)
    summed = with_it.field_matrix.sum(axis=0)
    assert with_it.whole_field_matrix == pytest.approx(summed, abs=1e-9 * np.abs(summed).max())
    found = np.kron(np.eye(2), np.sum(with_it.field_matrix - without.field_matrix, axis=0))
    assert found == pytest.approx(matrix, abs=1e-3 * np.abs(matrix).max())


# --- Light and displacement --------------------------------------------------------------------


def test_light_is_found_from_all_sidebands():
    sweep = Sweep((0, 2), noise=0.0)
    steps, zero = np.arange(HOLOGRAMS), np.zeros(HOLOGRAMS)
    wrong = sweep.object_field * np.exp(0.01 * sweep.smooth[:, 1])
    found = block_object_field(sweep.problem, steps, sweep.a, zero, sweep.weight, wrong)
    assert np.abs(found / sweep.object_field - 1).max() < 0.01
    rough = block_object_field(
        replace(sweep.problem, others=()), steps, sweep.a, zero, sweep.weight
    )
    assert rough == pytest.approx(sweep.object_field, rel=1e-4)


@pytest.fixture(scope="module")
def with_orders():
    """Sweep of a plate with its carrier and second sideband, of noise of their own."""
    sweep = planted()
    rng = np.random.default_rng(9)
    u = sweep.true_rad @ sweep.basis.functions.T.astype(float)
    others = []
    for order in (0, 2):
        turn = np.exp(2j * np.pi * rng.uniform(size=(len(u), 1)))
        seen = turn * sweep.object_field * sideband(order, u) + complex_normal(rng, *u.shape)
        others.append(
            SidebandAmplitudes(order, seen.T.astype(np.complex64), np.ones(len(u), dtype=bool))
        )
    return replace(sweep, block_amplitudes=replace(sweep.block_amplitudes, others=tuple(others)))


def test_the_carrier_separates_light_from_displacement(with_orders):
    """The phase of smooth light, which the first sideband leaves open."""
    alone = fit_displacements(replace(with_orders.block_amplitudes, others=()), with_orders.basis)
    found = fit_displacements(with_orders.block_amplitudes, with_orders.basis)
    assert found.reached.all()
    assert found.misfit == pytest.approx(np.ones(84), abs=0.35)
    known = [np.linalg.eigvalsh(each.common_mode.whole)[1] for each in (alone, found)]
    assert known[1] > 10 * known[0]
    errors = [np.median(share_of_error(with_orders, each)) for each in (alone, found)]
    assert errors[1] < 0.7 * errors[0]
