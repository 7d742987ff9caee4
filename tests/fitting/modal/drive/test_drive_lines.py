"""Lines of the drive next to a mode, which may be the mode."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.acoustics.poles import DriveLines
from fitting.modal import fit, search
from fitting.modal.drive import lines as drive_lines
from fitting.modal.drive.lines import (
    TakenMode,
    _may_be_a_mode,
    away_from,
    expecting,
    explained_by_lines,
    taken_modes,
    with_lines,
)
from fitting.modal.drive.prior import quiet_ripple
from fitting.modal.first_state import staged
from fitting.modal.model import Model
from fitting.modal.rounds import with_ripple
from tests.fitting.modal.test_fit import DRIVE_HZ, MODE_HZ, cents, planted

HZ = 1500 * 2 ** (np.arange(120) * 25 / 1200)
LINE_HZ, QUALITY = 3000.0, 30.0


def line(hz, height_db):
    """A line of the drive, in phase with the direct path at its pole."""
    return [np.log(hz), np.log(QUALITY), 0.0, (10 ** (height_db / 20) - 1) / QUALITY]


def optimum(found_hz, expected_hz):
    count = len(found_hz)
    model = SimpleNamespace(active=np.arange(count), reference_hz=np.array(expected_hz))
    logs = np.concatenate([np.log(found_hz), np.log(0.03) * np.ones(count)])
    return SimpleNamespace(model=model, logs=logs)


def taken(found_hz, expected_hz, *lines):
    given = DriveLines(np.array(lines), np.eye(4 * len(lines)))
    return taken_modes(optimum(found_hz, expected_hz), given)


def test_a_high_line_next_to_a_mode_may_be_the_mode():
    (mode,) = taken([1700.0, 3020.0], [1700.0, 3020.0], line(LINE_HZ, 20.0))
    assert (mode.mode, mode.log_hz, mode.log_loss) == (1, np.log(LINE_HZ), -np.log(QUALITY))


def test_a_low_line_next_to_a_mode_is_one_of_the_drive():
    assert taken([1700.0, 3020.0], [1700.0, 3020.0], line(LINE_HZ, 12.0)) == []


def test_a_line_between_modes_is_one_of_the_drive():
    assert taken([1700.0, 5500.0], [1700.0, 5500.0], line(LINE_HZ, 20.0)) == []


def test_a_line_of_any_height_may_be_a_mode_that_has_gone_from_there():
    """Next to a line that has taken all of its resonance, a mode may be found anywhere."""
    (mode,) = taken([1700.0, 2600.0], [1700.0, 2980.0], line(LINE_HZ, 8.0))
    assert mode.mode == 1
    assert taken([1700.0, 2985.0], [1700.0, 2980.0], line(LINE_HZ, 8.0)) == []


def test_each_mode_is_looked_for_in_its_highest_line():
    (mode,) = taken([2600.0], [3000.0], line(2950.0, 8.0), line(3050.0, 12.0))
    assert mode.log_hz == pytest.approx(np.log(3050.0))


@pytest.mark.parametrize("better", [True, False])
def test_the_likelier_explanation_is_taken_at_one_scatter(monkeypatch, better):
    sweep, seen, held = planted(), [], []
    # Two starts, two with the mode held, released, and the first again.
    evidence = [0.0, 0.0, 0.0, 0.0, 20.0 if better else -20.0, 0.0]
    shift = [0.02, 0.02, 0.05, 0.05, 0.05, 0.02]
    there = TakenMode(1, float(np.log(sweep.hz[1])) + 0.01, float(np.log(0.02)))

    def counted(model, given, state, scatter):
        number = len(seen)
        found = with_ripple(model, given, state, scatter)
        seen.append(scatter)
        own = 2 * model.powers.shape[1]
        held.append((given.prior.centre[1, own], given.prior.precision[1, own]))
        return replace(found, log_evidence=evidence[number], logs=found.logs + shift[number])

    once = iter([[there], []])
    monkeypatch.setattr(search, "with_ripple", counted)
    # Calls are counted in this process.
    monkeypatch.setattr(search, "map_processes", map)
    monkeypatch.setattr(search, "taken_modes", lambda *_: next(once))
    found = sweep.fit()
    assert len(seen) == 6
    assert seen[2] is seen[3] is seen[4] is seen[5]
    assert held[2] == held[3] == (there.log_hz, pytest.approx(1e6))
    assert held[4][1] == held[0][1] < 1e4
    # Frequencies are within a few cents of those planted, but for the shift.
    moved = np.log(found.hz / sweep.hz[:5])
    assert moved == pytest.approx(0.05 if better else 0.02, abs=2e-3)


@pytest.mark.parametrize("better", [True, False])
def test_the_next_line_is_judged_by_the_prior_of_the_likelier_explanation(monkeypatch, better):
    sweep, seen = planted(), []
    # The first comparison leaves both explanations probable.
    other = 1.0 if better else -1.0
    evidence = [0.0, 0.0, 0.0, 0.0, other, 0.0, -90.0, -90.0, -90.0, 0.0]

    def counted(model, given, state, scatter):
        found = replace(with_ripple(model, given, state, scatter), log_evidence=evidence[len(seen)])
        seen.append(given)
        return found

    modes = iter([[TakenMode(m, float(np.log(sweep.hz[m])), -3.5)] for m in (1, 2)])
    monkeypatch.setattr(search, "with_ripple", counted)
    # Calls are counted in this process.
    monkeypatch.setattr(search, "map_processes", map)
    monkeypatch.setattr(search, "taken_modes", lambda *_: next(modes, []))
    sweep.fit()
    assert len(seen) == 10
    assert seen[9].noise is (seen[4] if better else seen[5]).noise


def chamber(pole_hz, strength=0.35, quality=20.0):
    """Gain of a path through a cavity in parallel to the direct one."""
    ratio = DRIVE_HZ / pole_hz
    return np.abs(1 + strength / (1 - ratio**2 + 1j * ratio / quality))


def in_a_notch(seed):
    """A sweep with a mode where both paths cancel."""
    pole_hz = MODE_HZ[2] / np.sqrt(1.35)
    return planted(seed, noise=0.02, drive_dof=list(enumerate(chamber(pole_hz)))), pole_hz


def test_a_mode_in_the_notch_of_a_chamber_is_where_it_is(monkeypatch):
    """The finer structure alone is too smooth there: drive and mode share the notch."""
    notch = np.abs(np.log(DRIVE_HZ / MODE_HZ[2])) < 0.05
    expected, wrong = [], {True: [], False: []}

    def seen(at, given, bare):
        found = explained_by_lines(at, given, bare)
        expected.extend(found[:1])
        return found

    for seed in (6, 7, 8):
        sweep, pole_hz = in_a_notch(seed)
        for lines in (True, False):
            monkeypatch.setattr(search, "explained_by_lines", seen if lines else lambda *_: [])
            found = sweep.fit()
            off = np.log(np.abs(found.drive / sweep.drive))[notch]
            wrong[lines].append(np.std(off))
            if lines:
                assert (np.abs(cents(found.hz, sweep.hz[:5])) < 3 * found.error_cents).all()
        there = np.abs(np.log(DRIVE_HZ / pole_hz)) < 0.2
        left = (expected[-1].model.log_volts - np.log(sweep.volts * chamber(pole_hz)))[there]
        assert np.abs(left - left.mean()).max() < 0.15
    assert np.mean(wrong[True]) < np.mean(wrong[False])


@dataclass(frozen=True)
class Bare:
    """A model of which nothing is used but that it has a ripple."""

    ripple: object = None


def fitted_once(evidence=0.0, mode_hz=2000.0):
    """What a fit returns that has one mode."""
    return SimpleNamespace(
        end=SimpleNamespace(state=None, scatter=None),
        logs=np.log([mode_hz, 0.03]),
        model=SimpleNamespace(ripple=None),
        magnitude_covariance=None,
        log_evidence=evidence,
    )


def lines_of(*strengths, pole_hz=4700.0):
    """Lines of these strengths, each with a standard error of 0.01."""
    numbers = np.array([[np.log(pole_hz), np.log(20.0), each, 0.0] for each in strengths])
    return DriveLines(numbers.reshape(-1, 4), 1e-4 * np.eye(4 * len(strengths)))


@pytest.fixture
def in_turns(monkeypatch):
    """Lines, and fits that expect them, one after the other.

    Returns what is expected in each fit, and what is returned in the end.
    """

    def of(lines, fits):
        left, fits, expected = list(lines), list(fits), []
        monkeypatch.setattr(drive_lines, "_lines", lambda *_: left.pop(0))
        monkeypatch.setattr(drive_lines, "smooth_ripple", lambda _: None)
        monkeypatch.setattr(drive_lines, "expecting", lambda _, lines: lines)

        def fit(lines, *_):
            expected.append(lines.parameters[:, 2].tolist())
            return fits.pop(0)

        monkeypatch.setattr(drive_lines, "with_ripple", fit)
        return expected, with_lines(fitted_once(), None, Bare())

    return of


@pytest.mark.parametrize(("strengths", "count"), [
    ([0.30, 0.301], 1), ([0.30, 0.32, 0.34, 0.341], 3), (np.linspace(0.1, 0.5, 20), 5),
])  # fmt: skip
def test_lines_are_found_again_until_they_stay_where_they_are(in_turns, strengths, count):
    fits = [fitted_once() for _ in range(5)]
    expected, _ = in_turns([lines_of(each) for each in strengths], fits)
    assert expected == [[each] for each in strengths[:count]]


def test_the_last_turn_is_returned_if_lines_come_to_rest_or_else_the_likeliest(in_turns):
    fits = [fitted_once(evidence) for evidence in (1.0, 3.0, 2.0, 1.0, 0.0)]
    _, found = in_turns([lines_of(each) for each in (0.30, 0.32, 0.34, 0.341)], fits)
    assert found is fits[2]
    _, found = in_turns([lines_of(each) for each in (0.30, 0.32, 0.34, 0.36, 0.38)], fits)
    assert found is fits[1]


def test_another_line_is_expected_once_it_shows(in_turns):
    lines = [lines_of(0.3), lines_of(0.3, 0.1), lines_of(0.3, 0.1)]
    expected, _ = in_turns(lines, [fitted_once(), fitted_once()])
    assert expected == [[0.3], [0.3, 0.1]]


def test_a_fit_that_has_expected_what_may_be_a_mode_is_not_returned(in_turns):
    """The mode is found where the line is, which is too high for a chamber."""
    there = fitted_once(mode_hz=4700.0)
    expected, found = in_turns([lines_of(0.6), lines_of(0.6)], [there])
    assert expected == [[0.6]]
    assert found is None
    # Neither is the fit of the last turn.
    strengths = np.linspace(0.6, 1.0, 5)
    away = [fitted_once(0.0) for _ in range(4)]
    last = fitted_once(9.0, mode_hz=4700.0)
    _, found = in_turns([lines_of(each) for each in strengths], [*away, last])
    assert found is away[0]
    # A lower line, elsewhere, stays.
    both = DriveLines(
        np.concatenate([lines_of(0.6).parameters, lines_of(0.1, pole_hz=9000.0).parameters]),
        1e-4 * np.eye(8),
    )
    fits = [fitted_once(9.0, mode_hz=4700.0), fitted_once(1.0), fitted_once(1.0)]
    expected, found = in_turns([both, both, lines_of(0.1, pole_hz=9000.0)], fits)
    assert expected == [[0.6, 0.1], [0.1]]
    assert found is fits[1]


@pytest.mark.parametrize(("mode_hz", "searches"), [
    (4700.0, [[[0.3, 0.01]], [[0.3]]]), (2000.0, [[[0.3, 0.01]]]),
])  # fmt: skip
def test_a_low_line_next_to_a_mode_is_expected_once_and_left_out_once(
    monkeypatch, mode_hz, searches
):
    """The second line is some 2 dB high, at 4700 Hz."""
    apart, low = lines_of(0.3, pole_hz=9000.0), lines_of(0.01)
    lines = DriveLines(np.concatenate([apart.parameters, low.parameters]), 1e-4 * np.eye(8))
    asked = []

    def fit(lines, *_):
        asked.append(lines.parameters[:, 2].tolist())
        return fitted_once(mode_hz=mode_hz)

    monkeypatch.setattr(drive_lines, "_lines", lambda *_: lines)
    monkeypatch.setattr(drive_lines, "smooth_ripple", lambda _: None)
    monkeypatch.setattr(drive_lines, "expecting", lambda _, lines: lines)
    monkeypatch.setattr(drive_lines, "with_ripple", fit)
    found = explained_by_lines(fitted_once(mode_hz=mode_hz), None, Bare())
    assert [[each] for each in asked] == searches
    assert len(found) == len(searches)


def test_without_lines_there_is_nothing_to_explain_by(monkeypatch):
    monkeypatch.setattr(drive_lines, "_lines", lambda *_: lines_of())
    monkeypatch.setattr(drive_lines, "smooth_ripple", lambda _: None)
    assert explained_by_lines(fitted_once(), None, Bare()) == []


@pytest.mark.parametrize(("mode_hz", "strength", "may_be"), [
    (4310.0, 0.6, True), (4310.0, 0.05, False), (4700.0, 0.6, False),
])  # fmt: skip
def test_a_high_line_next_to_a_mode_is_not_expected_of_the_drive(mode_hz, strength, may_be):
    line = np.array([np.log(4300.0), np.log(20.0), strength, 0.0])
    assert _may_be_a_mode(line, np.log([2000.0, mode_hz]), 0.03) is may_be


def test_a_search_for_a_mode_begins_from_distant_lines_and_then_has_none(monkeypatch):
    sweep, begun, searched = planted(), [], []
    first_hz = sweep.hz[0]
    # One line is next to a mode, the other lies between the second and the third.
    distant_hz = np.sqrt(sweep.hz[1] * sweep.hz[2])
    numbers = [[np.log(hz), np.log(20.0), 0.3, 0.1] for hz in (first_hz, distant_hz)]
    lines = DriveLines(np.array(numbers), 1e-4 * np.eye(8))

    def seen_staged(model, *others):
        begun.append(model.log_volts)
        return staged(model, *others)

    def seen_search(model, given, state, scatter):
        searched.append(model.log_volts)
        return with_ripple(model, given, state, scatter)

    once = iter([[TakenMode(0, float(np.log(first_hz)), -3.5)], []])
    for module in (fit, search):
        monkeypatch.setattr(module, "staged", seen_staged)
    monkeypatch.setattr(search, "with_ripple", seen_search)
    monkeypatch.setattr(search, "explained_by_lines", lambda *_: [])
    monkeypatch.setattr(search, "drive_lines", lambda *_: lines)
    monkeypatch.setattr(search, "map_processes", map)
    monkeypatch.setattr(search, "taken_modes", lambda *_: next(once))
    sweep.fit()
    expected = np.diff(log_of_line(distant_hz, DRIVE_HZ))
    assert np.diff(begun[1] - begun[0]) == pytest.approx(expected, abs=1e-12)
    assert len(searched) == 6
    assert np.ptp(np.array(searched) - begun[0], axis=1) == pytest.approx(0, abs=1e-12)


def test_lines_next_to_a_mode_are_left_out_and_the_others_are_expected():
    lines = DriveLines(
        np.array(
            [[np.log(3000.0), np.log(30.0), 0.5, 0.0], [np.log(4300.0), np.log(20.0), 0.3, 0.1]]
        ),
        np.diag([1e-3, 0.1, 0.02, 0.03, 2e-3, 0.2, 0.04, 0.05]) ** 2,
    )
    # 50 cents from the first line, and 150 from the second.
    modes = np.log([2000.0, 3000.0 * 2 ** (50 / 1200), 4300.0 * 2 ** (150 / 1200)])
    distant = away_from(lines, modes)
    assert distant.parameters.tolist() == lines.parameters[1:].tolist()
    assert distant.covariance.tolist() == lines.covariance[4:, 4:].tolist()
    ripple = quiet_ripple(HZ)
    modes_5, functions = np.ones(5), np.eye(5)
    model = Model(
        HZ, np.zeros(len(HZ)), 4.0, ripple, np.ones((len(HZ), 1)), functions, 3e3 * modes_5,
        0 * modes_5, np.arange(5), None, np.zeros((2, 5, 5)), np.zeros((len(HZ), 5, 5)),
        np.zeros((3, 5)),
    )  # fmt: skip
    assert expecting(model, away_from(lines, lines.parameters[:, 0])) is model
    expected = expecting(model, distant)
    assert expected.log_volts == pytest.approx(log_of_line(4300.0), abs=1e-12)
    # Twice the errors, of which the frequency has one.
    moved = (log_of_line(4300.43) - log_of_line(4299.57)) / 2e-4
    still = np.diag([0, 1, 1, 1]) * distant.covariance
    others = expecting(model, DriveLines(distant.parameters, still))
    own = np.diag(expected.ripple.coarse - others.ripple.coarse)
    assert own == pytest.approx((2 * 2e-3 * moved) ** 2, rel=1e-4, abs=1e-9)
    assert expected.line_weight < 0


def log_of_line(hz, at_hz=HZ):
    ratio = at_hz / hz
    return np.log(np.abs(1 + (0.3 + 0.1j) / (1 - ratio**2 + 1j * ratio / 20)))
