"""Shapes of modes by what each has of the others, and light that no vibration has shifted."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.inference.nuisances import layers
from diagnosis.observables.carrier import Leaks, carrier_group, leaks_in
from diagnosis.observables.shapes import elastic_reed, shapes_group
from diagnosis.readings.carrier import CarrierReading, unshifted_light
from fitting.fringes.start_frequencies import middling_shapes
from physics.alterations import TipMass
from physics.mechanics import ReedMode, ReedSolver
from physics.parameters.disorder import BY_NAME
from physics.parameters.tree import BenchParameters, with_alteration, with_part
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import ReedGeometry

# A reed of three shapes at four places: two symmetric ones, one antisymmetric.
PLAN = np.array([[1e-3, 1e-3], [1e-3, 4e-3], [10e-3, 0.0], [20e-3, 2e-3]])
BENDS = np.array([[2.0, -1.0], [2.0, -3.0], [1.0, 2.0], [0.2, 1.0]])
TWISTS = np.array([[1.0], [5.0], [0.0], [0.5]])
HALVES = {
    Symmetry.SYMMETRIC: SimpleNamespace(
        size=2, mass=np.eye(2), surface_z=BENDS, measures={Symmetry.SYMMETRIC: None}
    ),
    Symmetry.ANTISYMMETRIC: SimpleNamespace(
        size=1, mass=np.eye(1), surface_z=TWISTS, measures={Symmetry.ANTISYMMETRIC: None}
    ),
}
NAMES, HZ = ("F1", "F2", "T1"), (2e3, 5e3, 3e3)
ALTERED = with_alteration(BenchParameters(), TipMass(), 1e-6)
# In coordinates: what the altered reed's first bending mode has of the others.
OF_OTHERS = 0.1, -0.05


def modes(reed):
    shapes = dict(zip(NAMES, np.eye(3), strict=True))
    if reed.alterations:
        shapes["F1"] = np.array([1.0, *OF_OTHERS])
    return {n: ReedMode(n, hz, 0.03, 0.2, shapes[n]) for n, hz in zip(NAMES, HZ, strict=True)}


MODEL = SimpleNamespace(plan_m=PLAN, loose=HALVES, starts=(0, 2))
WORKSHOP = SimpleNamespace(modes=modes, mass_kg=np.eye(3), reed=MODEL)
NO_LEAKS = Leaks({"up": 0.0}, 0.0)


def sweep(mixing, error=1e-3, twist_sign=1.0):
    """Reading of a sweep whose basis has its shapes largest where they are."""
    return SimpleNamespace(
        names=NAMES,
        shape_names=NAMES,
        # The twisting mode is largest on the right, where it is negative, or in this basis not.
        shape_peak_m=np.array([[1e-3, 1e-3], [1e-3, 4e-3], [1e-3, -4e-3]]),
        shape_peak=np.array([1.0, -1.0, -twist_sign]),
        mixing=np.array(mixing),
        mixing_error=np.full((3, 3), error),
        mixing_spread=1.0 - np.eye(3),
    )


def predicted(block, parameters):
    return dict(
        zip(
            [(p.mode, p.quantity) for p in block.coordinates],
            block.predict(parameters),
            strict=True,
        )
    )


@pytest.mark.parametrize("twist_sign", [1.0, -1.0])
def test_shares_are_in_units_of_largest_deflections_with_the_signs_of_the_basis(twist_sign) -> None:
    block = shapes_group(
        [sweep(np.zeros((3, 3)), twist_sign=twist_sign)], WORKSHOP, NO_LEAKS, BenchParameters()
    )
    assert block is not None
    np.testing.assert_array_equal(block.predict(BenchParameters()), 0.0)
    found = predicted(block, ALTERED)
    # Largest deflections: F1 2, F2 -3 where it counts as negative, T1 5.
    assert found["F1", "share of F2"] == pytest.approx(OF_OTHERS[0] * 3 / 2)
    assert found["F1", "share of T1"] == pytest.approx(twist_sign * OF_OTHERS[1] * 5 / 2)


def test_fractions_are_reported_once_and_hardly_where_fits_disagree() -> None:
    small, large = np.zeros((3, 3)), np.zeros((3, 3))
    large[1, 0] = 0.01
    block = shapes_group(
        [sweep(small), sweep(large), sweep(small)], WORKSHOP, NO_LEAKS, BenchParameters()
    )
    assert block is not None
    assert len(block.values) == 3
    assert shapes_group([sweep(small, error=0.1)], WORKSHOP, NO_LEAKS, BenchParameters()) is None


def test_what_leaks_in_makes_shapes_uncertain() -> None:
    plain = shapes_group([sweep(np.zeros((3, 3)))], WORKSHOP, NO_LEAKS, BenchParameters())
    spoilt = shapes_group(
        [sweep(np.zeros((3, 3)))], WORKSHOP, Leaks({"up": 0.2}, 0.0), BenchParameters()
    )
    assert plain is not None
    assert spoilt is not None
    # Wherever uneven thickness leaves a share open, light that leaks in still counts.
    more = np.diag(spoilt.covariance) - np.diag(plain.covariance)
    assert (np.sqrt(more) > 0.05 * 0.2).all()


# --- Carrier -----------------------------------------------------------------------------------


# A quarter of complex noise whose mean square is 1 is less than this: exp(-x²) = 3/4.
QUARTER = np.sqrt(np.log(4 / 3))


def carriers(leak=0.0):
    """Two sweeps, a loud one and a quiet one, of a reed that moves a little by its clamp."""
    return [
        CarrierReading(
            name, float(np.hypot(leak, np.hypot(6e-4 * volts, QUARTER * 8e-4))), 8e-4, volts
        )
        for name, volts in (("up", 8.0), ("quiet", 2.0))
    ]


def test_a_carrier_is_measured_where_the_reed_hardly_moves() -> None:
    leak = with_part(BenchParameters(), "optics.interference", leak=0.015)
    block = carrier_group(carriers(0.015))
    assert np.sum(block.whitened_residual(leak) ** 2) == pytest.approx(0.0, abs=1e-9)
    assert np.sum(block.whitened_residual(BenchParameters()) ** 2) > 100
    assert np.sum(
        carrier_group(carriers()).whitened_residual(BenchParameters()) ** 2
    ) == pytest.approx(0.0, abs=1e-9)


def test_leaks_count_by_what_moves_in_a_sweep() -> None:
    sweeps = [SimpleNamespace(name=name, amplitude_rad=np.full(9, rad), taken_off=0.0)
              for name, rad in (("up", 0.4), ("quiet", 0.1))]  # fmt: skip
    none, some = leaks_in(carriers(), sweeps, 0.0), leaks_in(carriers(0.02), sweeps, 0.05)
    assert max(none.carrier.values()) == pytest.approx(0.0, abs=1e-12)
    assert some.carrier["quiet"] > 4 * some.carrier["up"] > 0
    assert some.mixing == 0.05
    for one in sweeps:
        one.taken_off = 0.02
    assert leaks_in(carriers(0.02), sweeps, 0.05).carrier["up"] < 0.5 * some.carrier["up"]


def test_without_light_at_rest_nothing_is_known_to_leak_in() -> None:
    assert leaks_in([], [], 0.0) == Leaks({}, 0.0)


# A small image: reed, clamp from 10 mm on, and speckle that nothing moves.
X_M, Y_M = np.linspace(0, 10e-3, 60), np.linspace(-5e-3, 5e-3, 31)
AWAY = (10e-3 - X_M) / 10e-3


class Held:
    """A run of a reed that leaks so much of its light at rest into every hologram."""

    x_m, y_m, sideband_order = X_M, Y_M, 1

    def __init__(self, leak, seed, volts=4.0):
        rng = np.random.default_rng(seed)
        speckle = np.random.default_rng(0).standard_normal((2, len(Y_M), len(X_M)))
        self.light = speckle[0] + 1j * speckle[1]
        self.phases = np.exp(2j * np.pi * rng.random(40))
        moved = 0.6 * rng.random(40)[:, None, None] * AWAY**2 * (1 + 0.3 * Y_M[:, None] / 5e-3)
        turned = np.exp(2j * np.pi * rng.random(40))[:, None, None]
        self.fields = self.light * (leak * self.phases[:, None, None] + turned * moved)
        self.steps = [
            SimpleNamespace(position=k, order=1, noise_level=1e-9, volts=volts, verdict="ok")
            for k in range(40)
        ]
        halves = SimpleNamespace(field=self.light, noise=1e-9)
        self.reconstruction = SimpleNamespace(quadratures=lambda _frames: halves)
        clamp, outline = SimpleNamespace(x_m=(10e-3, 20e-3)), ReedGeometry().outline
        self.reed = SimpleNamespace(clamp=clamp, outline=outline)

    def reed_file(self):
        return SimpleNamespace(geometry=lambda: self.reed)

    def field(self, position):
        return self.fields[position]

    def frames(self, position):
        return position


def part(name, run, clamping=0):
    return SimpleNamespace(name=name, run=run, clamping=clamping, good_steps=run.steps)


def test_what_leaks_in_is_measured_hologram_by_hologram_though_the_reed_moves() -> None:
    quiet, still = Held(0.02, 1, volts=2.0), Held(0.0, 2)
    carriers = [CarrierReading("quiet", 0.02, 1e-5, 2.0), CarrierReading("loud", 0.02, 1e-5, 8.0)]
    found = unshifted_light([part("quiet", quiet)], [part("rest", still)], carriers)["quiet"]
    np.testing.assert_allclose(found.light, quiet.light, rtol=1e-6)
    shares = np.array([found.fraction[k] for k in range(40)])
    assert np.abs(shares) == pytest.approx(np.hypot(0.02, 0.0), rel=0.01)
    assert np.abs(np.angle(shares / quiet.phases)).max() < 0.05


def test_little_light_and_light_of_another_clamping_stay() -> None:
    quiet, still = Held(0.02, 1, volts=2.0), Held(0.0, 2)
    little, much = (
        [CarrierReading("quiet", share, 1e-5, 2.0), CarrierReading("loud", share, 1e-5, 8.0)]
        for share in (2e-3, 0.02)
    )
    assert unshifted_light([part("quiet", quiet)], [part("rest", still)], much) != {}
    assert unshifted_light([part("quiet", quiet)], [part("rest", still)], little) == {}
    assert unshifted_light([part("quiet", quiet, 1)], [part("rest", still)], much) == {}
    assert unshifted_light([part("quiet", quiet)], [part("rest", still)], []) == {}


@pytest.mark.parametrize("per_volt", [6e-4, 2e-2])
def test_a_reed_that_moves_as_much_as_it_likes_leaks_no_carrier(per_volt: float) -> None:
    """A loudspeaker may be thirty times as sensitive as another: it is the volts that tell."""
    for volts in ([0.3], [0.3, 0.33], [0.1, 0.3, 1.2]):
        carriers = [
            CarrierReading(f"{v}", float(np.hypot(per_volt * v, 5e-5)), 1e-4, v) for v in volts
        ]
        group = carrier_group(carriers)
        assert np.abs(group.whitened_residual(BenchParameters())).max() < 1
        quiet, still = Held(0.02, 1, volts=volts[0]), Held(0.0, 2)
        runs = [part(f"{volts[0]}", quiet)], [part("rest", still)]
        assert unshifted_light(*runs, carriers) == {}


def test_layers_have_nearly_all_of_the_variance_of_a_map_of_thickness():
    """A product of Legendre polynomials a and b has the mean square 1 / (2a + 1) / (2b + 1)."""
    variance = BY_NAME["thickness_map"].ordinary.root_mean_square ** 2
    shares = {}
    for fine in (False, True):
        found = [each for odd in (False, True) for each in layers(odd=odd, fine=fine)]
        # Thickness everywhere, and a slope across, are no matter of the map alone.
        own = [each for each in found if each.name not in ("layer 00", "layer 01")]
        degrees = [(int(each.name[-2]), int(each.name[-1])) for each in own]
        powers = [
            each.spread**2 / (2 * a + 1) / (2 * b + 1)
            for each, (a, b) in zip(own, degrees, strict=True)
        ]
        shares[fine] = sum(powers) / variance
        assert len(set(degrees)) == len(own)
    # Without the two of lowest degree, 26 % of the variance.
    assert shares[False] == pytest.approx(0.68, abs=0.02)
    assert shares[True] == pytest.approx(0.055, abs=0.01)


def test_shapes_of_a_series_are_compared_with_those_that_its_fits_use(reed):
    """Fits take the mean cane of their series, in which shapes mix by some per cent otherwise."""
    solver, points = ReedSolver(reed), np.array([[2e-3, 4e-3, 6e-3], [1e-3, -2e-3, 3e-3]])
    for series in Series:
        cane = viscoelastic_cane(Components(), series)
        basis = middling_shapes(reed, cane, *points)
        nominal = with_part(BenchParameters(), "reed", cane=cane)
        found = solver.modes(replace(elastic_reed(nominal), air_share=0.0))
        for name in ("F1", "T1", "F2", "T2", "F3", "X2"):
            hz = basis.hz[basis.names.index(name)]
            assert found[name].hz == pytest.approx(hz, rel=1e-3)
