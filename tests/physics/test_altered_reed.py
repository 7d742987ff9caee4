"""Reeds that are changed: against other geometries, brute force, and what must not matter."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy import linalg
from scipy.optimize import brentq
from scipy.special import eval_legendre

from physics.alterations import Layer, SoftSpot, TipMass, YieldingClamp
from physics.errors import ImpossibleReedError
from physics.mechanics import HIGHEST_HZ, CaneShift, Mechanics, ReedSolver, cane_law
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    viscoelastic_cane,
)
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import half_width_m
from physics.reed.reduced.build import build_reduced_reed
from physics.reed.reduced.changes import (
    added_mass,
    as_matrix,
    combined,
    layer,
    softening,
    yielding_clamp,
)
from physics.reed.reduced.elastic import reduced_modes
from physics.reed.reduced.reed import BasisSettings
from physics.reed.reduced.stored import reduced_reed
from tests.numbers import cents

EVERYTHING = Mechanics(
    shift=CaneShift(E_L=0.05, E_T=-0.1, G_LR=0.1, density=0.03, growth_E_L=0.01),
    alterations=(
        (Layer(0, 0), 8e-6),
        (Layer(1, 1), 5e-6),
        (TipMass(), 3e-7),
        (SoftSpot(15e-3, 2e-3), 5e-5),
        (YieldingClamp(), 2e-13),
        (YieldingClamp(1), 1e-13),
    ),
)
# Moduli that no frequency changes.
ELASTIC = ViscoelasticCane(Zener(14000.0, 0.0, 0.0), Zener(1100.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def reed_solver(geometry, coarse_level):
    return ReedSolver(reduced_reed(geometry, coarse_level))


def frequencies(reed_solver, reed):
    return np.array([mode.hz for mode in reed_solver.modes(reed).values()])


def unit_change(model, kind):
    """What one unit of an alteration adds, as its docstring says."""
    if isinstance(kind, YieldingClamp):
        return yielding_clamp(model, float(kind.side >= 0), float(kind.side <= 0))
    if isinstance(kind, TipMass):
        area_m2 = 2 * model.area_m2[model.bark_m[:, 0] < kind.length_m].sum()
        return added_mass(model, lambda x, _y: (x < kind.length_m) / area_m2)
    if isinstance(kind, SoftSpot):
        return softening(
            model,
            lambda x, y: np.exp(
                -((x - kind.x_m) ** 2 + (y - kind.y_m) ** 2) / (2 * kind.radius_m**2)
            ),
        )
    outline, end_m = model.geometry.outline, model.geometry.vamp_x_m[-1]
    return layer(
        model,
        lambda x, y: (
            eval_legendre(kind.along, 2 * x / end_m - 1)
            * eval_legendre(kind.across, y / half_width_m(outline, x))
        ),
    )


def whole(reed_solver, reed):
    """Stiffness and mass of a reed at a frequency, in all coordinates that it has."""
    model = reed_solver.reed
    change = combined((amount, unit_change(model, kind)) for kind, amount in reed.alterations)
    terms = model.stiffness_terms + as_matrix(model, change.stiffness_terms)
    law = cane_law(model.cane, reed.cane, reed.shift)
    mass = law.constants.density_kg_m3 * (model.mass + as_matrix(model, change.mass))
    mass = mass + as_matrix(model, change.mass_kg)
    moving = np.ones(len(mass), dtype=bool)
    moving[model.strip] = False
    springs = np.zeros_like(mass)
    if change.compliance_m_n is not None:
        springs[np.ix_(~moving, ~moving)] = np.linalg.inv(change.compliance_m_n)
        moving[:] = True
    keep = np.ix_(moving, moving)

    def stiffness(hz):
        return (np.tensordot(stiffness_terms_pa(law.at(hz)), terms, axes=1) + springs)[keep]

    def inertia(hz):
        carried = linalg.block_diag(*[moved for moved, _ in model.air.at(hz)])
        return (mass + reed.air_share * carried)[keep]

    return stiffness, inertia


def by_brute_force(reed_solver, reed, count):
    """Lowest frequencies, each with the moduli that it asks for, by solving for all modes."""
    stiffness, mass = whole(reed_solver, reed)

    def answered(hz, number):
        return np.sqrt(linalg.eigvalsh(stiffness(hz), mass(hz))[number]) / (2 * np.pi)

    return [
        brentq(lambda hz, k=k: answered(hz, k) - hz, 100.0, 2 * HIGHEST_HZ, xtol=1e-6)
        for k in range(count)
    ]


@pytest.mark.slow
def test_modes_of_a_coarse_mesh_are_where_its_stiffness_puts_them(
    geometry, coarse_level, monkeypatch
):
    """By the moduli that each frequency asks for, as the simulated bench plays it."""
    solver = ReedSolver(build_reduced_reed(geometry, coarse_level, BasisSettings()))
    names = list(solver.modes(Mechanics()))[:4]
    cents = np.array([3.0, 1.0, 4.0, 2.0])
    monkeypatch.setattr(solver, "_coarse", lambda: dict(zip(names, cents, strict=True)))
    reed = replace(Mechanics(), coarse_share=1.0)
    stiffness, mass = whole(solver, reed)
    added = solver.stiffness_of_coarse_mesh(reed)
    moving = np.ones(len(added), dtype=bool)
    moving[solver.reed.strip] = False
    added = added[np.ix_(moving, moving)]

    def answered(hz, number):
        squares = linalg.eigvalsh(stiffness(hz) + added, mass(hz))
        return np.sqrt(squares[number]) / (2 * np.pi)

    expected = [
        brentq(lambda hz, k=k: answered(hz, k) - hz, 100.0, 2 * HIGHEST_HZ, xtol=1e-6)
        for k in range(4)
    ]
    found, plain = (frequencies(solver, each)[:4] for each in (reed, Mechanics()))
    # Shifts of 1 to 4 cents are as moduli that grow make them, to a hundredth.
    shifts, wanted = np.log(found / plain), np.log(np.array(expected) / plain)
    np.testing.assert_allclose(shifts, wanted, rtol=0.01)
    assert np.all(wanted > 1.04 * np.log(2) / 1200 * cents)


@pytest.mark.parametrize(
    "reed",
    [
        Mechanics(),
        replace(EVERYTHING, alterations=EVERYTHING.alterations[:3]),
        EVERYTHING,
    ],
    ids=["nominal", "held", "everything"],
)
def test_modes_are_those_of_all_coordinates_with_moduli_of_their_own_frequency(reed_solver, reed):
    found = frequencies(reed_solver, reed)
    assert len(found) > 15
    assert np.all(np.diff(found) >= 0)
    off = np.abs(cents(found, by_brute_force(reed_solver, reed, len(found))))
    assert off[found < 22e3].max() < 0.05
    assert off.max() < 0.3


@pytest.mark.slow
def test_a_layer_is_a_reed_that_was_drawn_thicker(geometry):
    step_m, cane, count = 4e-6, Cane(), 4
    # Strains at the surface need cubic elements: of quadratic ones shifts are 8 % off.
    level = MeshLevel(orders=(3, 3, 2))
    reed_solver = ReedSolver(build_reduced_reed(geometry, level, BasisSettings()))

    def drawn(offset_m):
        thicker = replace(geometry, thickness_offset_m=offset_m)
        reed = build_reduced_reed(thicker, level, BasisSettings())
        terms = stiffness_terms_pa(cane)
        each = [reduced_modes(half, terms, cane.density_kg_m3)[0] for half in reed.parts.values()]
        return np.array([own[:count] for own in each])

    def grown(offset_m):
        alterations = ((Layer(0, 0), offset_m),)
        layers = Mechanics(cane=ELASTIC, alterations=alterations, air_share=0.0)
        modes = list(reed_solver.modes(layers).values())
        first = len(modes[0].coordinates) // 2
        even = [mode.hz for mode in modes if np.any(mode.coordinates[:first])]
        odd = [mode.hz for mode in modes if np.any(mode.coordinates[first:])]
        return np.array([even[:count], odd[:count]])

    expected = cents(drawn(step_m), drawn(-step_m))
    assert np.ptp(expected) > 30
    found = cents(grown(step_m), grown(-step_m))
    np.testing.assert_allclose(found, expected, rtol=0.005, atol=0.04)


def test_a_little_mass_lowers_modes_by_what_it_moves(reed_solver):
    nominal, mass_kg = Mechanics(cane=ELASTIC, air_share=0.0), 1e-10
    model = reed_solver.reed
    zone = model.bark_m[:, 0] < 2e-3
    weight = np.where(zone, model.area_m2, 0.0) / (2 * model.area_m2[zone].sum())
    found = reed_solver.modes(replace(nominal, alterations=((TipMass(2e-3), mass_kg),)))
    for name, mode in reed_solver.modes(nominal).items():
        start, moved = 0, {}
        for symmetry, part in model.loose.items():
            count = part.size
            moved[symmetry] = part.motion @ mode.coordinates[start : start + count]
            start += count
        # Half a reed, whose modes have mass 1, carries half of it: that is what weights add up to.
        energy = sum(np.sum(weight * np.square(part)) for part in moved.values())
        share = 2 * (found[name].hz / mode.hz - 1) / mass_kg
        assert share == pytest.approx(-energy, rel=1e-3, abs=1.0)


def test_stiffer_cane_is_faster_by_the_root(reed_solver):
    log = 0.2
    moduli = ("E_L", "E_T", "E_R", "G_LT", "G_LR", "G_TR")
    vacuum = Mechanics(cane=ELASTIC, air_share=0.0)
    stiffer = replace(vacuum, shift=CaneShift(**dict.fromkeys(moduli, log)))
    denser = replace(vacuum, shift=CaneShift(density=log))
    nominal = reed_solver.modes(vacuum)
    for reed, power in ((stiffer, 0.5), (denser, -0.5)):
        both = [
            (mode.hz, nominal[name].hz) for name, mode in reed_solver.modes(reed).items()
            if name in nominal
        ]  # fmt: skip
        changed, plain = np.transpose(both)
        assert np.abs(cents(changed, plain * np.exp(power * log))).max() < 1e-3


def test_stiffness_grows_with_that_of_the_modulus_by_its_share(reed_solver):
    """Of elastic cane without air nothing grows; a modulus that grows as f^g adds g of its share.

    If all of a mode's stiffness grows as f^g, its frequency rises by 1 / (2 − g) of any log factor
    on the stiffness: the share is that derivative by E_L, times 2.
    """
    elastic = Mechanics(cane=ELASTIC, air_share=0.0)
    growth, step = 0.1, 1e-3
    growing = replace(elastic, shift=CaneShift(growth_E_L=growth))
    stiffer = replace(elastic, shift=CaneShift(E_L=step))
    rest, grown, up = (reed_solver.modes(each) for each in (elastic, growing, stiffer))
    for name in ("F1", "T1", "F2", "T2"):
        assert rest[name].stiffening == pytest.approx(0.0, abs=1e-6)
        share = 2 * np.log(up[name].hz / rest[name].hz) / step
        # The shape follows the moduli, which changes shares a little.
        assert grown[name].stiffening == pytest.approx(growth * share, abs=0.05 * growth)
    assert grown["F1"].stiffening > 0.8 * growth
    assert grown["T1"].stiffening < 0.5 * growth


def test_a_yielding_clamp_lowers_all_modes_the_more_the_more_it_yields(reed_solver):
    each = [
        frequencies(reed_solver, Mechanics(alterations=((YieldingClamp(), yielding),)))[:12]
        for yielding in (0.0, 1e-16, 1e-14, 1e-13, 1e-12)
    ]
    assert np.abs(cents(each[1], each[0])).max() < 1.0
    for stiffer, softer in pairwise(each):
        assert np.all(cents(softer, stiffer) < 1e-3)
    assert cents(each[-1], each[0]).min() < -50


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ((YieldingClamp(1), 3e-13), (YieldingClamp(-1), 3e-13)),
        ((Layer(1, 1), 1e-5), (Layer(1, 1), -1e-5)),
        ((SoftSpot(12e-3, 3e-3), 1e-4), (SoftSpot(12e-3, -3e-3), 1e-4)),
    ],
)
def test_what_is_wrong_on_the_left_does_as_much_on_the_right(reed_solver, left, right):
    found, mirrored = (
        frequencies(reed_solver, Mechanics(alterations=(change,))) for change in (left, right)
    )
    assert np.abs(cents(found, frequencies(reed_solver, Mechanics())[: len(found)])).max() > 1
    assert np.abs(cents(found, mirrored)).max() < 1e-3


def test_air_moves_along_and_takes_sound_away(reed_solver):
    vacuum = reed_solver.modes(Mechanics(loss_factor=0.02, air_share=0.0))
    air = reed_solver.modes(Mechanics(loss_factor=0.02, air_share=1.0))
    half = reed_solver.modes(Mechanics(loss_factor=0.02, air_share=0.5))
    for name in list(vacuum)[:12]:
        assert vacuum[name].loss_factor == pytest.approx(0.02)
        assert air[name].loss_factor >= half[name].loss_factor >= 0.02
        lower = cents(air[name].hz, vacuum[name].hz)
        assert lower < 0
        assert cents(half[name].hz, vacuum[name].hz) == pytest.approx(lower / 2, rel=0.1)


@pytest.mark.parametrize(
    "change",
    [(Layer(0, 0), -2e-3), (SoftSpot(12e-3, 0.0), 1.0)],
    ids=["no cane left", "nothing carries"],
)
def test_what_leaves_no_reed_is_refused(reed_solver, change):
    with pytest.raises(ImpossibleReedError, match=r"no reed|positive definite|leading minor"):
        reed_solver.modes(Mechanics(alterations=(change,)))


def test_changes_combine_and_stay_as_they_are(reed_solver):
    model = reed_solver.reed
    parts = [
        (2.0, layer(model, lambda x, y: 1e-6 * (1 + x + y))),
        (-3.0, added_mass(model, lambda x, _y: 1e-3 * x)),
        (0.5, yielding_clamp(model, 1e-13, 2e-13)),
    ]
    s, c = len(model.mass), len(model.strip)
    for field, shape in (
        ("stiffness_terms", (9, s, s)),
        ("mass", (s, s)),
        ("mass_kg", (s, s)),
        ("compliance_m_n", (c, c)),
    ):

        def matrix(change, field=field, shape=shape):
            own = getattr(change, field)
            if isinstance(own, dict):
                own = as_matrix(model, own)
            return np.zeros(shape) + (0 if own is None else own)

        before = [matrix(part) for _, part in parts]
        total = matrix(combined(parts))
        expected = sum(amount * own for (amount, _), own in zip(parts, before, strict=True))
        np.testing.assert_allclose(total, expected, rtol=1e-12, atol=1e-30)
        for (_, part), own in zip(parts, before, strict=True):
            assert np.array_equal(matrix(part), own)


def test_losses_change_no_frequency(reed_solver):
    cane = viscoelastic_cane(Components(), Series.B)
    vacuum = Mechanics(cane=cane, air_share=0.0)
    plain = reed_solver.modes(vacuum)
    lossy = reed_solver.modes(replace(vacuum, loss_factor=0.05, loss_growth=0.5))
    for name, mode in plain.items():
        assert lossy[name].hz == mode.hz
        assert lossy[name].loss_factor == pytest.approx(0.05 * (mode.hz / 4000) ** 0.5)
