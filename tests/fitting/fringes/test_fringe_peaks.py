"""Which picture is a mode's: windows, lines, neighbours, doubts."""

import numpy as np
import pytest

from fitting.forward import (
    PaperModel,
    cents_of,
    hz_of,
    viscoelastic_cents,
)
from fitting.fringes.fringe_peaks import (
    FringeCurves,
    _Posterior,
    likely_components,
    pick_fringe_peaks,
)
from fitting.paper import constants as paper
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from physics.reed.mode_classification import PAPER_MODES, is_symmetric

MODEL = PaperModel()
STEPS = np.arange(1, 185)
LINE_HZ = 4308.6


def cents_at(values, series=Series.A):
    cane = viscoelastic_cane(Components(*map(float, values)), series)
    return viscoelastic_cents(MODEL, cane, series)


def centres(values=(0, 0, 0, 0), series=Series.A):
    return dict(zip(PAPER_MODES, cents_at(values, series), strict=True))


def prior_sd_cents(name, series=Series.A):
    """Population of H4 and the model's misfit, to first order, without the code under test."""
    m = PAPER_MODES.index(name)
    slopes = [cents_at(d, series)[m] - cents_at(-d, series)[m] for d in 0.5 * np.eye(4)]
    return float(np.sqrt(np.sum(np.square(slopes)) + paper.H4_MISFIT_CENTS**2))


def resonance_curve(cents, centre, peak_rad=5.0, width_cents=26.0):
    return peak_rad / np.sqrt(1 + ((cents - centre) / width_cents) ** 2)


def pick(curves, steps=STEPS, needed=lambda shape, picture: True, lines=(), series=Series.A):
    """Pick from curves of amplitude (functions of cents above F6) by mode name."""
    cents = 25.0 * steps
    names = tuple(curves)
    amplitude = np.stack([curve(cents) for curve in curves.values()], axis=1)
    fringes = FringeCurves(hz_of(cents), steps, amplitude, names)
    return pick_fringe_peaks(fringes, MODEL, series, needed, acoustic_resonances_hz=lines)


def peaks(*places):
    """Curve with the given (cents, rad) peaks."""
    return lambda cents: sum(resonance_curve(cents, *place) for place in places)


def step_of(cents):
    return round(cents / 25)


# --- The ordinary case -------------------------------------------------------------------------


@pytest.mark.parametrize("series", list(Series))
@pytest.mark.parametrize("values", [(0, 0, 0, 0), (1.5, -1, 0.7, 1), (-1.2, 1.4, -1, -0.5)])
def test_every_mode_is_picked_where_its_fringes_are_most(series, values):
    where = centres(values, series)
    found = pick({name: peaks((at, 5.0)) for name, at in where.items()}, series=series)
    assert list(found) == sorted(found, key=lambda name: found[name].frequency_hz)
    for name, at in where.items():
        # Two modes of one symmetry whose peaks lie in neighbouring pictures have to give way.
        alone = all(
            abs(at - other) > 100 or is_symmetric(name) != is_symmetric(mode) or mode == name
            for mode, other in where.items()
        )
        if alone:
            assert found[name].step_index == step_of(at)
            assert found[name].name == name
            assert cents_of(found[name].frequency_hz) == pytest.approx(25 * step_of(at))
            assert found[name].amplitude_rad == pytest.approx(5, rel=0.15)
            assert found[name].method == "picture"


def test_a_mode_that_shows_no_fringes_is_not_found():
    where = centres()
    found = pick({"F1": peaks((where["F1"], 5.0)), "T1": peaks((where["T1"], 0.09))})
    assert list(found) == ["F1"]


def test_names_without_a_place_in_the_model_are_passed_over():
    where = centres()
    found = pick({"T5": peaks((4500, 9.0)), "F1": peaks((where["F1"], 5.0))})
    assert list(found) == ["F1"]


# --- Windows -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["F1", "T1"])
@pytest.mark.parametrize(
    ("sds", "inside"), [(-4.4, False), (-3.5, True), (3.5, True), (4.4, False)]
)
def test_the_window_is_four_deviations_of_the_population(name, sds, inside):
    # F1 is looked for first, and T1 alone too, so that nothing has narrowed its window.
    place = centres()[name] + sds * prior_sd_cents(name)
    assert (name in pick({name: peaks((place, 5.0))})) == inside


def test_a_higher_maximum_outside_the_window_is_ignored():
    at = centres()["F1"]
    found = pick({"F1": peaks((at, 3.0), (at + 6 * prior_sd_cents("F1"), 30.0))})
    assert found["F1"].step_index == step_of(at)


def test_what_was_found_moves_the_window_of_the_next():
    """In the population a high F1 goes with a high F2: a low maximum is no longer F2's."""
    f1, f2 = centres()["F1"] + 180, centres()["F2"] + 110
    decoy = centres()["F2"] - 120
    curve = peaks((f2, 3.0), (decoy, 5.0))
    assert pick({"F2": curve})["F2"].step_index == step_of(decoy)
    assert pick({"F1": peaks((f1, 5.0)), "F2": curve})["F2"].step_index == step_of(f2)


# --- Maxima ------------------------------------------------------------------------------------


def test_a_slope_without_a_maximum_is_not_picked():
    at = centres()["F1"]
    assert pick({"F1": lambda cents: np.exp((cents - at) / 100)}) == {}


def test_the_ends_of_a_sweep_are_not_picked():
    at = centres()["F1"]
    for steps in (np.arange(step_of(at), 185), np.arange(1, step_of(at) + 1)):
        assert pick({"F1": peaks((at, 5.0))}, steps=steps) == {}


def test_the_highest_of_several_maxima_is_picked():
    at = centres()["F1"]
    found = pick({"F1": peaks((at - 150, 3.0), (at, 4.0), (at + 150, 5.0))})
    assert found["F1"].step_index == step_of(at + 150)


def test_a_maximum_that_its_picture_does_not_need_is_passed_over():
    at, asked = centres()["F1"], []

    def needed(shape, picture):
        asked.append((shape, int(STEPS[picture])))
        return STEPS[picture] != step_of(at + 150)

    curves = {"T1": peaks((0, 0.0)), "F1": peaks((at, 4.0), (at + 150, 5.0))}
    assert pick(curves, needed=needed)["F1"].step_index == step_of(at)
    assert asked == [(1, step_of(at + 150)), (1, step_of(at))]
    assert pick(curves, needed=lambda shape, picture: False) == {}


# --- Acoustic lines ----------------------------------------------------------------------------


def test_an_acoustic_line_is_never_picked_however_strong():
    """In series B soft reeds have F2 where the excitation device resonates."""
    line = float(cents_of(LINE_HZ))
    curve = peaks((centres(series=Series.B)["F2"] - 100, 3.0), (line, 300.0))
    without = pick({"F2": curve}, series=Series.B)
    assert without["F2"].step_index == 78
    found = pick({"F2": curve}, series=Series.B, lines=(LINE_HZ,))
    assert found == {} or abs(found["F2"].step_index - 78) > 2


def test_a_mode_near_the_line_is_still_found():
    line = float(cents_of(LINE_HZ))
    curve = peaks((line + 150, 30.0), (line, 50.0))
    found = pick({"F2": curve}, series=Series.B, lines=(LINE_HZ,))
    assert found["F2"].step_index == step_of(line + 150)


@pytest.mark.parametrize(("offset", "blocked"), [(0, True), (50, True), (75, False)])
def test_pictures_within_sixty_cents_of_a_line_are_blocked(offset, blocked):
    at = 25.0 * step_of(centres()["F1"])
    found = pick({"F1": peaks((at, 5.0))}, lines=(float(hz_of(at + offset)),))
    assert (found == {}) == blocked


# --- Neighbours --------------------------------------------------------------------------------


def test_f3_and_t3_may_share_a_picture():
    place = 25.0 * step_of(centres()["T3"] + 40)
    found = pick({"F3": peaks((place, 4.0)), "T3": peaks((place, 6.0))})
    assert found["F3"].step_index == found["T3"].step_index == step_of(place)


@pytest.mark.parametrize(("first", "second"), [("F2", "T2"), ("T1", "X1"), ("F3", "X2")])
def test_modes_of_one_symmetry_never_share_a_picture(first, second):
    assert is_symmetric(first) == is_symmetric(second)
    where = centres()
    place = 0.5 * (where[first] + where[second])
    curves = {name: peaks((place, 6.0), (where[name], 2.0)) for name in (first, second)}
    found = pick(curves)
    # Unless the place lay outside the window of one of them.
    steps = [found[name].step_index for name in (first, second)]
    assert abs(steps[0] - steps[1]) > 2


# --- Errors ------------------------------------------------------------------------------------


def test_the_error_is_that_of_a_uniform_distribution_between_neighbours():
    at = centres()["F1"]
    every = pick({"F1": peaks((at, 5.0))})["F1"]
    assert every.error_cents == pytest.approx(25 / np.sqrt(12), rel=1e-6)
    second = pick({"F1": peaks((at, 5.0))}, steps=STEPS[step_of(at) % 2 :: 2])["F1"]
    assert second.error_cents == pytest.approx(50 / np.sqrt(12), rel=1e-6)


def test_a_missing_neighbour_widens_the_error():
    k = step_of(centres()["F1"])
    curve = {"F1": peaks((25.0 * k, 5.0))}
    one = pick(curve, steps=np.setdiff1d(STEPS, [k + 1]))["F1"]
    both = pick(curve, steps=np.setdiff1d(STEPS, [k - 1, k + 1]))["F1"]
    assert one.error_cents == pytest.approx(37.5 / np.sqrt(12), rel=1e-6)
    assert both.error_cents == pytest.approx(50 / np.sqrt(12), rel=1e-6)


def test_indices_of_the_protocol_are_kept():
    at = centres()["F1"]
    found = pick({"F1": peaks((at, 5.0))}, steps=STEPS[10:])
    assert found["F1"].step_index == step_of(at)


# --- What is believed --------------------------------------------------------------------------


# How far modes follow the four springs, cents per MPa: some 50 cents per standard deviation.
CENTS_PER_MPA = np.random.default_rng(4).standard_normal((11, 4)) * (0.05, 0.03, 0.3, 0.15)


def linear_cents(model, cane, series):
    """Frequencies that follow the components, which the springs do, exactly linearly."""
    E, G = cane.young_L, cane.shear_LT
    springs_mpa = (E.spring_mpa, E.arm_spring_mpa, G.spring_mpa, G.arm_spring_mpa)
    return CENTS_PER_MPA @ np.array(springs_mpa)


def test_belief_in_a_linear_model_is_the_exact_conditional_distribution(monkeypatch):
    """One resonance after the other, against all at once by the formula of the conditional."""
    monkeypatch.setattr("fitting.fringes.fringe_peaks.viscoelastic_cents", linear_cents)

    def linear(values):
        cane = viscoelastic_cane(Components(*map(float, values)), Series.A)
        return linear_cents(MODEL, cane, Series.A)

    learnt = {6: 60.0, 0: -45.0, 4: 20.0, 2: 80.0}
    origin = linear(np.zeros(4))
    slopes = np.stack([linear(unit) - origin for unit in np.eye(4)], axis=1)
    belief = _Posterior(MODEL, Series.A, paper.H4_MISFIT_CENTS)
    for m, offset in learnt.items():
        belief.learn(m, float(origin[m] + offset))

    rows = slopes[list(learnt)]
    variance = rows @ rows.T + paper.H4_MISFIT_CENTS**2 * np.eye(len(learnt))
    gain = rows.T @ np.linalg.inv(variance)
    mean, covariance = gain @ np.array([*learnt.values()]), np.eye(4) - gain @ rows
    for m in range(11):
        expected, sd = belief.predict(m)
        assert expected == pytest.approx(origin[m] + slopes[m] @ mean, abs=1e-6)
        own = slopes[m] @ covariance @ slopes[m] + paper.H4_MISFIT_CENTS**2
        assert sd == pytest.approx(np.sqrt(own), abs=1e-6)


@pytest.mark.parametrize("values", [(0.9, -1.2, 0.6, 0), (-1.5, 1.0, -0.8, 0)])
def test_likely_components_are_near_those_of_the_reed(values):
    found = pick({name: peaks((at, 5.0)) for name, at in centres(values).items()})
    likely = likely_components(found, MODEL, Series.A)
    # What 11 modes with 30 cents of misfit each leave open, half of it towards the mean.
    assert likely.e1 == pytest.approx(values[0], abs=0.4)
    assert likely.e2 == pytest.approx(values[1], abs=0.6)
    assert likely.e3 == pytest.approx(values[2], abs=0.6)
    assert likely.e4 == pytest.approx(0, abs=0.05)


def test_nothing_found_leaves_the_middle_of_the_population():
    assert likely_components({}, MODEL, Series.A) == Components()


def test_belief_starts_from_the_population():
    belief = _Posterior(MODEL, Series.A, paper.H4_MISFIT_CENTS)
    for m, name in enumerate(PAPER_MODES):
        expected, sd = belief.predict(m)
        assert expected == pytest.approx(centres()[name])
        assert sd == pytest.approx(prior_sd_cents(name), rel=1e-6)
        # The paper's 55 reeds spread by 50 to 93 cents, and H4 misses them by 30.
        assert 55 < sd < 110
