"""Names of modes: from shapes drawn by hand, and for reeds of the whole population."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physics.errors import ImpossibleReedError
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    require_physical,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.elements.fem import Symmetry
from physics.reed.mode_classification import (
    PAPER_MODES,
    ModeDescriptor,
    assign_names,
    is_symmetric,
    name_of,
    names_of,
    similarities,
    vamp_profiles,
    width_profiles,
)
from physics.reed.reduced.elastic import elastic_modes, viscoelastic_mode
from physics.reed.surface import surface_shapes

EVEN_MODES = {"F1", "F2", "F3", "F4", "T2", "T4", "X2"}


def possible_canes(seed):
    """Reeds of the population N(0, 1), in both series, less those that cannot be."""
    rng = np.random.default_rng(seed)
    while True:
        components = Components(*rng.standard_normal(4))
        for series in Series:
            cane = viscoelastic_cane(components, series)
            try:
                require_physical(cane)
            except ImpossibleReedError:
                continue
            yield cane


def moduli_pa(cane, hz):
    return float(storage_modulus_pa(cane.young_L, hz)), float(storage_modulus_pa(cane.shear_LT, hz))


@pytest.mark.parametrize(
    ("width_order", "nodal_lines", "name"),
    [
        (0, 0, "F1"),
        (0, 3, "F4"),
        (1, 0, "T1"),
        (4, 0, "T4"),
        (1, 1, "X1"),
        (2, 1, "X2"),
        (1, 2, "X3"),
    ],
)
def test_names_are_the_papers(width_order, nodal_lines, name):
    assert name_of(width_order, nodal_lines) == name


def test_every_pattern_has_a_name_of_its_own():
    names = [name_of(order, lines) for order in range(7) for lines in range(7)]
    assert len(set(names)) == len(names)


def test_a_name_gives_the_symmetry():
    assert {name for name in PAPER_MODES if is_symmetric(name)} == EVEN_MODES
    for order in range(5):
        for lines in range(4):
            name = name_of(order, lines)
            if "(" not in name:
                assert is_symmetric(name) == (order % 2 == 0)
    with pytest.raises(ValueError, match="H1"):
        is_symmetric("H1")


@pytest.mark.parametrize("width_order", range(5))
@pytest.mark.parametrize("nodal_lines", range(4))
def test_a_shape_drawn_by_hand_bears_its_name(width_order, nodal_lines):
    """Legendre across, Legendre along, dying away towards the clamp."""
    x = np.linspace(-1, 1, 40)
    along = np.polynomial.legendre.Legendre.basis(nodal_lines)(x) * (1 - (x + 1) / 2) ** 0.5
    eta = np.broadcast_to(np.linspace(0, 1, 25), (40, 25))
    across = np.polynomial.legendre.Legendre.basis(width_order)(eta)
    profiles = width_profiles((along[:, None] * across)[..., None], eta)
    square = np.sum(profiles[:, width_order % 2 :: 2] ** 2, axis=(0, 1))
    (found,) = similarities(profiles, square, symmetric=width_order % 2 == 0)
    assert found[name_of(width_order, nodal_lines)] > 0.98
    assert sum(found.values()) == pytest.approx(1)
    (half_of_it,) = similarities(profiles, 2 * square, symmetric=width_order % 2 == 0)
    assert sum(half_of_it.values()) == pytest.approx(0.5)


def test_nodal_lines_are_counted_without_the_foot_where_signs_mean_nothing():
    """A flexural profile with one node, noise before it and a faint tail that changes sign."""
    profiles = np.zeros((8, 7, 2))
    profiles[:, 0, 0] = [0.01, 1, 0.5, 0, -0.4, -0.015, 0.01, -0.01]
    profiles[:, 0, 1] = [-0.5, 1, 0.5, 0, -0.4, -0.3, 0.03, -0.03]
    square = np.sum(profiles**2, axis=(0, 1))
    first, second = similarities(profiles, square, symmetric=True)
    assert first["F2"] == pytest.approx(1)
    assert second["F5"] == pytest.approx(1)


@pytest.mark.parametrize("grading", [0.7, 1.0, 1.6])
def test_squares_are_integrals_over_the_vamp_however_the_mesh_is_graded(grading):
    """Of 1 and of a torsion, on a trapezoid: its area and a moment of inertia."""
    x_m = 40e-3 * np.linspace(0, 1, 800) ** grading
    eta = np.linspace(0, 1, 60) ** grading
    width_m = 5e-3 - 0.05 * x_m[:, None]
    plan_m = np.stack(np.broadcast_arrays(x_m[:, None], width_m * eta), axis=-1)
    y_m = plan_m[..., 1]
    profiles, points = vamp_profiles(plan_m, np.stack([np.ones_like(y_m), y_m], axis=-1), 35e-3)
    # The rounded tip is left out.
    vamp_m = np.linspace(0.5e-3, 35e-3, 2001)
    width_m = 5e-3 - 0.05 * vamp_m
    expected = np.trapezoid(width_m, vamp_m), np.trapezoid(width_m**3 / 3, vamp_m)
    np.testing.assert_allclose(np.sum(points**2, axis=0), expected, rtol=0.01)
    own = profiles[:, [0, 1], [0, 1]]
    np.testing.assert_allclose(np.sum(own**2, axis=0), expected, rtol=0.01)


def test_profiles_are_orthonormal_within_a_parity():
    eta = np.linspace(0, 1, 400)[None]
    table = np.polynomial.legendre.legvander(eta, 6) * np.sqrt(2 * np.arange(7) + 1)
    gram = width_profiles(table, eta)[0]
    same_parity = np.add.outer(range(7), range(7)) % 2 == 0
    np.testing.assert_allclose(gram[same_parity], np.eye(7)[same_parity], atol=1e-3)


CANDIDATES = st.lists(
    st.dictionaries(st.sampled_from(PAPER_MODES[:5]), st.floats(0.01, 1), min_size=1, max_size=4),
    min_size=1,
    max_size=4,
)


@settings(deadline=None)
@given(CANDIDATES)
def test_no_name_is_given_twice(candidates):
    names = [name for name, _ in assign_names(candidates)]
    assert len(names) == len(candidates)
    assert len(set(names)) == len(names)


@settings(deadline=None)
@given(CANDIDATES)
def test_likeness_given_is_the_candidates_own(candidates):
    for candidate, (name, similarity) in zip(candidates, assign_names(candidates), strict=True):
        assert similarity == candidate.get(name, 0.0)


@settings(deadline=None)
@given(CANDIDATES)
def test_the_assignment_has_the_greatest_total_likeness(candidates):
    """Against all assignments, one by one."""
    names = sorted({name for candidate in candidates for name in candidate})
    names += ["nothing"] * len(candidates)
    best = max(
        sum(c.get(name, 0.0) for c, name in zip(candidates, choice, strict=True))
        for choice in permutations(names, len(candidates))
    )
    assert sum(similarity for _, similarity in assign_names(candidates)) == pytest.approx(best)


def test_of_two_claims_to_one_name_the_better_wins():
    assert assign_names([{"F4": 0.6}, {"F4": 0.9}])[1] == ("F4", 0.9)
    # T4 and F4 exchange shapes: each takes what the other likes less.
    crossing = [{"F4": 0.50, "T4": 0.45}, {"F4": 0.55, "T4": 0.10}]
    assert [name for name, _ in assign_names(crossing)] == ["T4", "F4"]


def test_no_mode_has_a_name_without_a_claim_to_it():
    named = assign_names([{"F2": 0.03, "X2": 0.96}, {"F1": 0.09}, {"F1": 0.64, "T2": 0.2}])
    assert [name for name, _ in named] == ["X2", "?1", "F1"]


EVEN, ODD = Symmetry.SYMMETRIC, Symmetry.ANTISYMMETRIC


def descriptor(symmetry, motions, *, share=1.0, sideways=0.0, behind=0.0, square=1.0):
    """ModeDescriptor of motions given as {width order: (nodal lines, amplitude)} each."""
    profiles = np.zeros((24, 7, len(motions)))
    x = np.linspace(0, 1, 24)
    for m, motion in enumerate(motions):
        for order, (lines, amplitude) in motion.items():
            along = np.cos(np.pi * (lines * x + 0.25 * (lines == 0) * x))
            profiles[:, order, m] = amplitude * along / np.linalg.norm(along)
    count = len(motions)
    numbers = (np.broadcast_to(value, count) for value in (share, sideways, behind))
    return ModeDescriptor(symmetry, *numbers, profiles, np.broadcast_to(square, count))


def named(*descriptors):
    return [naming.name for naming in names_of(descriptors)]


def test_motions_bear_the_names_that_they_are_most_like():
    found = names_of([descriptor(EVEN, [{0: (1, 1.0)}, {2: (0, 0.8), 0: (2, 0.6)}])])
    assert [naming.name for naming in found] == ["F2", "T2"]
    assert [naming.symmetry for naming in found] == [EVEN, EVEN]
    assert [naming.similarity for naming in found] == pytest.approx([1.0, 0.64])
    assert [naming.outside for naming in found] == [0.0, 0.0]


def test_one_clear_likeness_is_worth_more_than_two_faint_ones():
    """0.55 + 0.2 is less than 0.3 + 0.5, but of their squares it is more."""
    motions = [
        {4: (0, np.sqrt(0.55)), 0: (3, np.sqrt(0.3))},
        {4: (0, np.sqrt(0.5)), 0: (3, np.sqrt(0.2))},
    ]
    assert named(descriptor(EVEN, motions)) == ["T4", "F4"]


def test_faint_claims_give_no_name():
    """Of two T2, one is for 9 % an F1, which no other mode is."""
    faint = {2: (0, np.sqrt(0.91)), 0: (0, 0.3)}
    assert named(descriptor(EVEN, [{2: (0, 1.0)}, faint])) == ["T2", "?1s"]
    less_faint = {2: (0, np.sqrt(0.85)), 0: (0, np.sqrt(0.15))}
    assert named(descriptor(EVEN, [{2: (0, 1.0)}, less_faint])) == ["T2", "F1"]


def test_waves_that_profiles_do_not_resolve_bear_out_no_name():
    """What little the profiles see of a T7 looks like an X(5,1)."""
    fine, coarse = {5: (1, np.sqrt(0.05))}, {5: (1, np.sqrt(0.6)), 3: (2, np.sqrt(0.4))}
    assert named(descriptor(ODD, [fine, coarse])) == ["?1a", "X(5,1)"]
    assert named(descriptor(ODD, [fine])) == ["?1a"]
    assert named(descriptor(ODD, [fine], square=0.05)) == ["X(5,1)"]


@pytest.mark.parametrize(
    ("symmetry", "sideways", "behind", "expected"),
    [
        (ODD, 0.4, 0.2, ("L1", 0.4)),
        (EVEN, 0.6, 0.1, ("L1s", 0.6)),
        (EVEN, 0.1, 0.7, ("H1", 0.7)),
        (ODD, 0.2, 0.5, ("H1a", 0.5)),
        (ODD, 0.3, 0.19, ("T1", 1.0)),
    ],
)
def test_what_moves_elsewhere_than_the_vamp_is_lateral_or_the_heels(
    symmetry, sideways, behind, expected
):
    order = 1 if symmetry is ODD else 0
    (found,) = names_of(
        [descriptor(symmetry, [{order: (0, 1.0)}], sideways=sideways, behind=behind)]
    )
    assert (found.name, found.similarity) == (expected[0], pytest.approx(expected[1]))
    assert found.outside == pytest.approx(sideways + behind)


def test_each_kind_is_counted_by_itself_from_the_lowest():
    sideways, behind = [0.9, 0.0, 0.8, 0.0, 0.0], [0.0, 0.9, 0.0, 0.7, 0.0]
    assert named(descriptor(ODD, [{1: (0, 1.0)}] * 5, sideways=sideways, behind=behind)) == [
        "L1",
        "H1a",
        "L2",
        "H2a",
        "T1",
    ]
    equal = [{1: (0, amplitude)} for amplitude in (0.8, 1.0, 0.9)]
    assert named(descriptor(ODD, equal)) == ["?1a", "T1", "?2a"]


def test_a_motion_of_both_symmetries_has_that_of_its_larger_part():
    """An uneven reed: each of two motions is half F3, half T3, and each bears another name."""
    even = descriptor(EVEN, [{0: (2, 1.0)}] * 2, share=[0.45, 0.52])
    odd = descriptor(ODD, [{3: (0, 1.0)}] * 2, share=[0.55, 0.48])
    found = names_of([even, odd])
    assert [(naming.name, naming.symmetry) for naming in found] == [("T3", ODD), ("F3", EVEN)]
    assert [naming.similarity for naming in found] == pytest.approx([0.55, 0.52])


def test_no_motions_have_no_names():
    assert names_of([descriptor(EVEN, [])]) == []


def test_the_papers_modes_are_present_in_every_reed_of_the_population(standard_reed):
    """120 canes, each with the moduli that it has at 2, 7 and 14 kHz."""
    canes = possible_canes(seed=8)
    for _ in range(120):
        cane = next(canes)
        for hz in (2e3, 7e3, 14e3):
            modes = elastic_modes(standard_reed, *moduli_pa(cane, hz))
            assert set(PAPER_MODES) <= set(modes)
            frequencies = {modes[name].frequency_hz for name in PAPER_MODES}
            assert len(frequencies) == len(PAPER_MODES)
            even = {n for n in PAPER_MODES if modes[n].symmetry is Symmetry.SYMMETRIC}
            assert even == EVEN_MODES


def test_names_say_what_the_tip_does(standard_reed):
    """F moves the whole tip one way; T1 its corners apart; T2 its corners against its middle."""
    modes = elastic_modes(standard_reed, 13e9, 1.0e9)
    y = np.linspace(0.1e-3, 6.3e-3, 40)
    shapes = surface_shapes(standard_reed, np.full_like(y, 3.2e-3), y)
    sections = {name: shapes[mode.symmetry] @ mode.coordinates for name, mode in modes.items()}
    crossings = {
        name: np.count_nonzero(np.diff(np.sign(w[np.abs(w) > 0.05 * np.abs(w).max()])))
        for name, w in sections.items()
    }
    # Of the half reed; the axis itself is one more for odd modes.
    assert [crossings[name] for name in ("F1", "T1", "T2", "T3", "T4")] == [0, 0, 1, 1, 2]


def test_a_viscoelastic_mode_is_taken_with_the_moduli_at_its_own_frequency(standard_reed):
    canes = possible_canes(seed=9)
    for name, start_hz in (("F1", 1996), ("T3", 9571), ("F4", 16784)):
        cane = next(canes)
        mode = viscoelastic_mode(standard_reed, cane, name, start_hz)
        assert mode.name == name
        moduli = moduli_pa(cane, mode.frequency_hz)
        again = elastic_modes(standard_reed, *moduli, air_hz=mode.frequency_hz)[name]
        assert abs(1200 * np.log2(again.frequency_hz / mode.frequency_hz)) < 0.01
        # Eq. 4 is monotone and sensitivities are below 1/2: any start leads to the same mode.
        elsewhere = viscoelastic_mode(standard_reed, cane, name, 6000.0)
        assert elsewhere.frequency_hz == pytest.approx(mode.frequency_hz, rel=1e-5)


def test_a_mode_that_is_not_there_is_an_error(standard_reed):
    with pytest.raises(ImpossibleReedError, match="no mode F99"):
        viscoelastic_mode(standard_reed, next(possible_canes(seed=10)), "F99", 5e3)
