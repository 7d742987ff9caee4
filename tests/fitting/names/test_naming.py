"""Names of measured modes: probabilities that are right, and no name twice."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitting.names.final_names import final_names
from fitting.names.measured import measured_modes
from fitting.names.naming import (
    SURE,
    ModeNaming,
    exchanged_names,
    name_modes,
    name_probabilities,
    named,
    visible_coordinates,
)
from fitting.names.prediction import predict
from fitting.names.reed_fit import SHIFT_CENTS, Question, refitted, towards
from fitting.names.reed_posterior import _first, reed_posterior
from fitting.names.straight_lines import with_straight_lines
from physics.errors import ImpossibleReedError
from physics.plausible.reeds import PlausibleReeds
from physics.reed.cane.viscoelastic import Series
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.mesh import MeshLevel
from physics.reed.mode_classification import ModeDescriptor, names_of
from physics.reed.reduced.elastic import all_descriptors
from physics.reed.reduced.stored import reduced_reed
from protocols.reed import ReedFile
from tests.fitting.names.conftest import planting

CENT = np.log(2) / 1200
MEASURED = ("F1", "T1", "F2", "T2", "X1", "L1", "T3", "F3", "X2", "X3", "T4")
ENDS_HZ = (1417.2, 19_911.9)
# Numbers of X1 and L1 among all modes of a reed, in order of frequency.
CLOSE_PAIR = (4, 5)
NAMES = [f"{letter}{number}" for letter in "FTXLH" for number in range(1, 5)]


def probabilities_of(reeds, visible, measured, ends_hz=ENDS_HZ):
    """Probability of each name of each measured mode, of the most probable reed."""
    found = reed_posterior(reeds, visible, measured, ends_hz)
    best = max(found, key=lambda each: each.log_evidence)
    return best, name_probabilities(best, [reeds.reed, with_straight_lines(reeds.reed)])


@pytest.mark.parametrize("seed", [0, 1])
def test_modes_of_a_plausible_reed_have_their_names(reeds, visible, planted, seed):
    """Whatever their order: names are not those that modes came with.

    In a clamp that hardly yields, where X1 and L1 are far from their crossing.
    """
    order = list(np.random.default_rng(seed).permutation(MEASURED))
    sweep = planted(order, seed, clamp_compliance=-1.0)
    best, found = probabilities_of(reeds, visible, sweep.measured)
    assert [max(own, key=own.get) for own in found] == order
    assert min(own[name] for own, name in zip(found, order, strict=True)) > SURE
    assert best.spurious.max() < 0.01
    assert best.outside.max() < 1e-6


@pytest.mark.parametrize(
    ("seed", "e1", "e2", "e3"),
    [
        (0, -2.3, 0.6, 1.6),
        pytest.param(5, -0.1, 2.5, 4.0, marks=pytest.mark.slow),
        pytest.param(23, -2.0, -0.7, 2.6, marks=pytest.mark.slow),
    ],
)
def test_modes_of_an_unusual_reed_have_their_names(reeds, visible, planted, seed, e1, e2, e3):
    """Some modes have another order there than in the middle of the population."""
    sweep = planted(MEASURED, seed, e1=e1, e2=e2, e3=e3)
    middle = planted(MEASURED, seed, e1=0.0, e2=0.0, e3=0.0)
    orders = [[name for name in each.names if name in MEASURED] for each in (sweep, middle)]
    assert orders[0] != orders[1]
    best, found = probabilities_of(reeds, visible, sweep.measured)
    likeliest = {
        name: max(own, key=own.get)
        for name, own in zip(MEASURED, found, strict=True)
        if max(own.values(), default=0.0) > SURE
    }
    assert len(likeliest) >= 9
    assert all(name == own for name, own in likeliest.items())
    errors = np.sqrt(np.diag(best.covariance)[:3])
    assert np.abs(best.mean[:3] - [e1, e2, e3]).max() < 4 * errors.max()
    # The reed explains its modes: shifts are those that any model leaves.
    assert best.shift_cents < 2 * SHIFT_CENTS[0]


@pytest.mark.parametrize(
    "off",
    [
        pytest.param(-1e-7, marks=pytest.mark.slow),
        -1e-9,
        pytest.param(0.0, marks=pytest.mark.slow),
        pytest.param(1e-9, marks=pytest.mark.slow),
        1e-7,
    ],
)
def test_a_mode_that_a_search_has_left_out_is_looked_for_again(reeds, visible, planted, off):
    """What rounding decides on the way does not decide whether X2 is found."""
    sweep = planted(MEASURED, 23, e1=-2.0, e2=-0.7, e3=2.6)
    moved = replace(sweep.measured, ln_hz=sweep.measured.ln_hz + off)
    best, found = probabilities_of(reeds, visible, moved)
    assert found[MEASURED.index("X2")]["X2"] > SURE
    assert np.all(best.mode >= 0)
    assert best.shift_cents == pytest.approx(SHIFT_CENTS[0])


def test_a_search_that_leaves_all_possible_reeds_takes_no_name_away(
    reeds, visible, planted, monkeypatch
):
    """Neither one from another clamp, nor one with moduli that leave hypothesis H4."""
    sweep = planted(MEASURED, 0, clamp_compliance=-1.0)

    def nowhere(*_args):
        raise ImpossibleReedError("no such reed")

    begun = []

    def once(*args):
        begun.append(args)
        return towards(*args) if len(begun) == 1 else nowhere()

    def predicted(own, *rest):
        return nowhere() if len(own.names) > len(reeds.names) else predict(own, *rest)

    module = "fitting.names.reed_posterior"
    # Searches from elsewhere are always begun.
    monkeypatch.setattr(f"{module}._USUAL_SHIFTS", 0.0)
    monkeypatch.setattr(f"{module}.towards", once)
    monkeypatch.setattr(f"{module}.predict", predicted)
    best, found = probabilities_of(reeds, visible, sweep.measured)
    assert [max(own, key=own.get) for own in found] == list(MEASURED)
    assert best.free_moduli is None
    naming = name_modes((best,), MEASURED, reeds)
    assert {each.name for each in naming.values()} == set(MEASURED)
    assert all(each.stiffening is None for each in naming.values())


def test_a_mode_is_the_same_after_a_step_to_a_reed_with_another_order(reeds, visible, planted):
    """From the middle of the population to a reed at its edge, T3 and F3 cross."""
    sweep = planted(MEASURED, 5, e1=1.5, e2=0.0, e3=-1.0, clamp_compliance=-1.0)
    question = Question(reeds, visible, tuple(np.log(ENDS_HZ)))
    fit = _first(question, sweep.measured)
    here = predict(reeds, visible, np.zeros(len(reeds.names)))
    order = [each.name for each in names_of(here.nearby.descriptors(np.eye(len(here.ln_hz))))]
    mode = np.array([order.index(name) for name in MEASURED])
    data = replace(fit.data, mode=mode, scatter=np.full(len(mode), 0.1))
    fit = replace(fit, here=here, data=data)
    for _ in range(6):
        fit = refitted(question, fit)
    near = fit.here.nearby
    own = [each.name for each in names_of(near.descriptors(np.eye(len(near.found.hz))))]
    assert [own[m] for m in fit.data.mode] == list(MEASURED)
    assert fit.data.mode.tolist() != mode.tolist()


def test_a_step_towards_an_impossible_reed_ends_at_a_possible_one(reeds, visible):
    question = Question(reeds, visible, (7.2, 9.9))
    middle, best = np.zeros((2, len(reeds.names)))
    best[reeds.names.index("nu_LT")] = 100.0
    possible = towards(question, middle, 1e-2 * best).parameters
    assert possible == pytest.approx(1e-2 * best)
    farthest = float(towards(question, middle, best).parameters.max())
    assert 0.05 < farthest <= 2.0
    beyond = best + 40 * (best > 0)
    with pytest.raises(ImpossibleReedError):
        towards(question, beyond, 2 * beyond)


def test_at_an_avoided_crossing_the_name_is_not_sure(reeds, visible, planted):
    """Half of X1 and half of L1: a clamp that yields lowers L1 until they share both modes."""
    modes = [0, 1, 2, 3, *CLOSE_PAIR, "T3", "F3", "X2", "X3", "T4"]
    sweep = planted(modes, clamp_compliance=1.5)
    _, found = probabilities_of(reeds, visible, sweep.measured)
    for own in found[4:6]:
        assert {"X1", "L1"} <= set(own)
        assert max(own.values()) < SURE
        assert own["X1"] + own["L1"] > 0.9
    assert all(max(own.values()) > SURE for own in found[:4])


@pytest.mark.parametrize(("yields", "lower"), [(0.0, "X1"), (3.0, "L1")])
def test_on_either_side_of_the_crossing_names_are_exchanged(reeds, visible, planted, yields, lower):
    """Both modes show about the same of themselves; all others say how far the clamp yields."""
    modes = [0, 1, 2, 3, *CLOSE_PAIR, "T3", "F3", "X2", "X3", "T4"]
    sweep = planted(modes, clamp_compliance=yields)
    assert sweep.names[4] == lower
    _, found = probabilities_of(reeds, visible, sweep.measured)
    upper = {"X1": "L1", "L1": "X1"}[lower]
    assert found[4].get(lower, 0.0) > 0.9
    assert found[5].get(upper, 0.0) > 0.9


def test_a_mode_beyond_the_sweep_is_not_believed_at_another_frequency(reeds, visible, planted):
    """A sweep that begins 150 cents above F1, and an F1 that is fitted 230 cents too high."""
    sweep = planted(MEASURED)
    measured = sweep.measured
    first_hz = sweep.hz[0] * 2 ** (150 / 1200)
    wrong = measured.ln_hz + np.where(np.arange(len(MEASURED)) == 0, 230 * CENT, 0.0)
    best, found = probabilities_of(
        reeds, visible, replace(measured, ln_hz=wrong), (first_hz, ENDS_HZ[1])
    )
    assert best.spurious[0] > 0.95
    assert found[0].get("F1", 0.0) < 0.05
    assert best.spurious[1:].max() < 0.05
    # The same reed in a sweep that contains F1.
    best, found = probabilities_of(reeds, visible, measured)
    assert best.spurious[0] < 0.01


def test_a_mode_where_the_reed_has_none_is_spurious(reeds, visible, planted):
    sweep = planted(MEASURED)
    measured, k = sweep.measured, MEASURED.index("T3")
    wrong = measured.ln_hz.copy()
    wrong[k] += 300 * CENT
    best, _ = probabilities_of(reeds, visible, replace(measured, ln_hz=wrong))
    assert best.spurious[k] > 0.5
    assert np.delete(best.spurious, k).max() < 0.05
    # Nor does it move the reed.
    right, _ = probabilities_of(reeds, visible, measured)
    own = slice(reeds.shifts.start)
    deviation = np.sqrt(np.diag(right.covariance)[own])
    assert np.all(np.abs(best.mean[own] - right.mean[own]) < deviation)


@pytest.mark.parametrize(
    ("off_cents", "strange", "plausible"),
    [(0.0, 0.0, True), (100.0, 0.0, True), (0.0, 0.5, True), (100.0, 0.5, False)],
)
def test_a_reed_with_other_frequencies_and_shapes_is_of_another_kind(
    reeds, visible, planted, off_cents, strange, plausible
):
    """A fifth of the motion is in no mode of the reed; errors that are as large excuse it."""
    measured = planted(MEASURED).measured
    rng = np.random.default_rng(1)
    count, size = measured.shape.shape
    shape = measured.shape + strange * rng.standard_normal((1, size)) / np.sqrt(size)
    other = replace(
        measured,
        ln_hz=measured.ln_hz + off_cents * CENT * rng.standard_normal(count),
        shape=shape / np.linalg.norm(shape, axis=1, keepdims=True),
    )
    found = reed_posterior(reeds, visible, other, ENDS_HZ)
    assert {each.is_plausible for each in found} == {plausible}
    unsure = replace(other, variance=np.full_like(measured.variance, 0.2 / size))
    assert all(each.is_plausible for each in reed_posterior(reeds, visible, unsure, ENDS_HZ))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["alto-saxophone", "bass-clarinet"])
def test_larger_reeds_are_of_another_kind(reeds, basis, visible, kind):
    """They lie on the clamp of a clarinet's, and light is seen where the clarinet's reed is."""
    geometry = ReedFile.from_file(kind).geometry()
    others = PlausibleReeds.of(reduced_reed(geometry, MeshLevel(orders=(2, 2, 2))), Series.A)
    planted = planting(others, visible_coordinates(others.reed, basis[0], *basis[1]))
    modes = np.flatnonzero((others.reference.hz > ENDS_HZ[0]) & (others.reference.hz < 12e3))
    sweep = planted(modes.tolist())
    found = reed_posterior(reeds, visible, sweep.measured, ENDS_HZ)
    assert not max(found, key=lambda each: each.log_evidence).is_plausible


def test_of_two_fits_of_one_mode_one_is_not_of_the_reed(reeds, visible, planted):
    sweep = planted((*MEASURED, "F3"))
    measured = sweep.measured
    shape = measured.shape.copy()
    shape[-1] = shape[MEASURED.index("F3")]
    best, found = probabilities_of(reeds, visible, replace(measured, shape=shape))
    both = [found[MEASURED.index("F3")], found[-1]]
    assert sum(own.get("F3", 0.0) > 0.5 for own in both) <= 1
    modes = best.mode[best.mode >= 0]
    assert len(set(modes.tolist())) == len(modes)


def motions(fraction):
    """X1 and L1 of half a reed, of which each has a fraction of the other's motion."""
    lateral = np.array([fraction, 1 - fraction])
    nodes = np.sign(np.linspace(-1, 1, 20))
    profiles = np.zeros((20, 7, 2))
    profiles[:, 1] = nodes[:, None] * np.sqrt(1 - lateral) / np.sqrt(20)
    return [
        ModeDescriptor(
            Symmetry.ANTISYMMETRIC, np.ones(2), lateral, np.zeros(2), profiles, 1 - lateral
        )
    ]


@pytest.mark.parametrize(
    ("fraction", "low", "high"), [(0.02, 0.99, 1), (0.35, 0.85, 0.97), (0.49, 0.5, 0.6)]
)
def test_a_name_is_as_probable_as_its_mode_is_pure(fraction, low, high):
    first, second = exchanged_names(motions(fraction))
    assert low < first["X1"] <= high
    assert low < second["L1"] <= high
    assert sum(first.values()) == pytest.approx(1, abs=2e-3)
    assert first.get("L1", 0.0) == pytest.approx(second.get("X1", 0.0), abs=1e-9)


def test_a_name_that_no_motion_has_counts_too():
    """Three fifths of T5 and two fifths of X6, which is (3,1)."""
    profiles = np.zeros((20, 7, 1))
    profiles[:, 5, 0] = np.sqrt(0.6 / 20)
    profiles[:, 3, 0] = np.sign(np.linspace(-1, 1, 20)) * np.sqrt(0.4 / 20)
    one, none = np.ones(1), np.zeros(1)
    motion = ModeDescriptor(Symmetry.ANTISYMMETRIC, one, none, none, profiles, one)
    (found,) = exchanged_names([motion])
    odds = 0.4**2 / 0.6**2
    assert found == pytest.approx({"T5": 1 / (1 + odds), "X6": odds / (1 + odds)})


@pytest.mark.parametrize("fraction", [0.6, 0.4])
def test_of_two_motions_that_one_name_describes_best_neither_has_it_for_sure(fraction):
    """F4 with a tenth of X5, which is (2,2), and above it a fraction of F4, and T4."""
    x = np.linspace(-1, 1, 20)
    profiles = np.zeros((20, 7, 2))
    bending = np.sign((x + 0.5) * x * (x - 0.5))
    profiles[:, 0] = np.outer(bending, np.sqrt([0.9 / 20, fraction / 20]))
    profiles[:, 2, 0] = np.sign(x**2 - 0.25) * np.sqrt(0.1 / 20)
    profiles[:, 4, 1] = np.sqrt((1 - fraction) / 20)
    ones, none = np.ones(2), np.zeros(2)
    motion = ModeDescriptor(Symmetry.SYMMETRIC, ones, none, none, profiles, ones)
    first, second = exchanged_names([motion])
    # Of a motion that another name describes best, F4 is none: the first has no T4 to give for it.
    odds = (fraction / 0.9) ** 2 if fraction > 0.5 else 0.0
    assert first["F4"] == pytest.approx(1 / (1 + odds + (0.1 / 0.9) ** 2))
    assert second["T4"] == pytest.approx(1 / (1 + odds))


def test_the_shape_that_is_measured_has_the_name(reeds, visible, planted):
    """A reed with its own thickness everywhere has shapes that no plausible reed has."""
    modes = (*MEASURED, "T5", "X6")
    sweep = planted(modes)
    measured, (one, other) = sweep.measured, (modes.index("T5"), modes.index("X6"))
    pure = {}
    for turn in (-0.6, 0.6):
        shape = measured.shape.copy()
        shape[one] += np.tan(turn) * measured.shape[other]
        shape[other] -= np.tan(turn) * measured.shape[one]
        shape /= np.linalg.norm(shape, axis=1, keepdims=True)
        _, found = probabilities_of(reeds, visible, replace(measured, shape=shape))
        pure[turn] = found[one].get("T5", 0.0)
        assert all(max(own.values()) > SURE for own in found[: len(MEASURED)])
    assert max(pure.values()) > SURE
    assert min(pure.values()) < 0.5


def test_both_ways_to_draw_lines_across_agree_below_15_khz(reeds):
    """Where they do not, a name is not sure."""
    found = reeds.near(np.zeros(len(reeds.names))).found
    curved = names_of(all_descriptors(reeds.reed, found.coordinates))
    straight = names_of(all_descriptors(with_straight_lines(reeds.reed), found.coordinates))
    low = found.hz < 15e3
    names = [[naming.name for naming, own in zip(each, low, strict=True) if own]
             for each in (curved, straight)]  # fmt: skip
    assert names[0] == names[1]
    assert {"F1", "T1", "F2", "T2", "X1", "T3", "F3", "X2", "X3", "T4"} <= set(names[0])
    differ = [abs(a.similarity - b.similarity) for a, b in zip(curved, straight, strict=True)]
    assert max(np.array(differ)[low]) < 0.15


@given(
    st.dictionaries(
        st.sampled_from(NAMES),
        st.dictionaries(st.sampled_from(NAMES), st.floats(0, 1), max_size=6),
        min_size=1,
        max_size=12,
    )
)
def test_no_name_is_given_twice(probabilities):
    found = named(probabilities)
    assert set(found) == set(probabilities)
    names = [naming.name for naming in found.values()]
    assert len(set(names)) == len(names)
    for label, naming in found.items():
        assert naming.probability == probabilities[label].get(naming.name, 0.0)
        assert all(p >= 0.01 for _, p in naming.candidates)


@given(st.data())
def test_final_names_are_all_different(data):
    """Also those of modes that are not identified, whose names another mode may have now."""
    labels = data.draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=10, unique=True))
    measured = data.draw(st.lists(st.sampled_from(labels), unique=True))
    given_names = data.draw(
        st.lists(
            st.sampled_from(NAMES), min_size=len(measured), max_size=len(measured), unique=True
        )
    )
    naming = {
        label: ModeNaming(name, data.draw(st.floats(0, 1)), (), 0.0, 0.0)
        for label, name in zip(measured, given_names, strict=True)
    }
    doubtful = {label for label in labels if label not in measured}
    found = final_names(labels, naming, doubtful)
    plain = [name.removesuffix("?") for name in found]
    assert len(set(plain)) == len(plain) == len(labels)
    for label, name in zip(labels, found, strict=True):
        if label in measured:
            sure = naming[label].probability >= SURE
            assert name == naming[label].name + ("" if sure else "?")


def test_an_exchange_of_two_labels_is_put_right():
    naming = {
        "X1": ModeNaming("L1", 0.99, (), 0.0, 0.0),
        "L1": ModeNaming("X1", 0.7, (), 0.0, 0.0),
        "T3": ModeNaming("F3", 0.99, (), 0.0, 0.0),
    }
    labels = ("F1", "X1", "L1", "T3", "F3")
    assert final_names(labels, naming, {"F1", "F3"}) == ("F1", "L1", "X1?", "F3", "T3")


def test_sizes_of_shapes_are_of_no_weight():
    """What is measured is a direction; errors of the size are projected out."""
    amplitude = np.array([[3.0, 4.0]])
    modal = SimpleNamespace(
        names=("F1",),
        hz=np.array([2000.0]),
        covariance=np.diag([1e-6, 1e-4]),
        shapes=amplitude / 5,
        participation=np.array([2.0j]),
        participation_error=np.array([0.1]),
        resonant=SimpleNamespace(
            amplitude_rad=amplitude,
            covariance=(np.outer(amplitude[0], amplitude[0]) + 0.25 * np.eye(2))[None],
        ),
    )
    found = measured_modes(modal, np.array([0]))
    assert found.shape[0] == pytest.approx([0.6, 0.8])
    assert found.variance[0] == pytest.approx([0.0, 0.01], abs=1e-12)
    assert found.error[0] == pytest.approx(1e-3)
    assert np.exp(found.ln_strength[0]) == pytest.approx(2 * 2000.0**2)
    assert found.strength_error[0] == pytest.approx(0.05)
