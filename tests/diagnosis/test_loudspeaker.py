"""What a loudspeaker may do to the drive, by itself."""

import numpy as np
import pytest

from diagnosis.inference.candidate_search import search_alone
from diagnosis.inference.candidates import without_effects
from diagnosis.inference.effect_scan import Start
from diagnosis.inference.nuisances import NUISANCES
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Coordinates, Errors, Observable, observable_group
from diagnosis.observables.drive import (
    _BREAK_UP,
    _QUALITY,
    _WAVES,
    _gain,
    _in_notches,
    _loudspeaker,
)
from physics.effects.catalogue import BY_ID
from physics.parameters.tree import BenchParameters

# 25 cents apart, from 1.4 to 16.5 kHz.
HZ = 1417.2 * 2 ** (np.arange(170) / 48)
APART = np.log(HZ)[:, None] - np.log(HZ)
# Of one hologram.
ERROR = 0.02
LINE = BY_ID["second_acoustic_resonance"]


def covariance():
    """Covariance (n, n) of the log of a response, with its error."""
    waves, left = _loudspeaker(APART)
    most = sum(each.columns @ each.columns.T for each in waves)
    return most + left + ERROR**2 * np.eye(len(HZ))


def dome(rng):
    """Log response (n,) of a dome that breaks up in three resonances within two octaves."""
    s, response = 1j * HZ, np.ones(len(HZ), complex)
    for hz, quality in zip(rng.uniform(4e3, 16e3, 3), rng.uniform(3, 20, 3), strict=True):
        height, width = rng.choice([-1, 1]) * rng.uniform(0.2, 0.6), hz / quality
        response += height * s * width / (s**2 + s * width + hz**2)
    return np.log(np.abs(response))


def line(hz, quality, db):
    """Log response (n,) of one acoustic resonance, of a height at its peak."""
    s, width = 1j * HZ, hz / quality
    return np.log(np.abs(1 + (10 ** (db / 20) - 1) * s * width / (s**2 + s * width + hz**2)))


def test_resonances_that_are_left_out_of_the_columns_are_errors():
    expected = _WAVES[0] ** 2 * np.exp(-0.5 * (APART / _WAVES[1]) ** 2)
    expected += _BREAK_UP**2 / (1 + (_QUALITY * APART) ** 2)
    assert covariance() - ERROR**2 * np.eye(len(HZ)) == pytest.approx(expected, abs=1e-4)
    assert np.linalg.eigvalsh(_loudspeaker(APART)[1]).min() > -1e-9


def test_domes_that_break_up_are_within_the_errors():
    root = np.linalg.cholesky(covariance())
    rng = np.random.default_rng(0)
    squares = [np.sum(np.linalg.solve(root, dome(rng)) ** 2) for _ in range(60)]
    # Nine numbers decide a response; deep notches are not quite as expected.
    assert 4 < np.median(squares) < 18
    assert np.quantile(squares, 0.9) < 60


def test_a_narrow_line_is_more_than_a_loudspeaker_does():
    root = np.linalg.cholesky(covariance())
    narrow, wide = (np.linalg.solve(root, line(5000.0, q, 10.0)) for q in (60.0, 6.0))
    # In standard deviations of its own amplitude.
    assert np.linalg.norm(narrow) > 5
    assert np.linalg.norm(wide) < 5


def log_bayes(response):
    """Log Bayes factor of a resonance that no bench file lists, by the drive (n,) alone."""
    waves, left = _loudspeaker(APART, _in_notches(response, APART))
    errors = Errors(ERROR**2 * np.eye(len(HZ)) + 1.0 + left, waves)
    nominal, places = BenchParameters(), [Coordinates("drive")] * len(HZ)

    def predict(parameters):
        return np.log(_gain(parameters.drive, HZ))

    values = predict(nominal) + response
    group = observable_group("drive", Observable.DRIVE, values, errors, places, ("drive",), predict)
    known = [nuisance for nuisance in NUISANCES if nuisance.family == "known resonance"]
    problem = InferenceProblem([group], nominal, known)
    null = without_effects(problem, [np.zeros(len(known))])
    residuals, same = null.estimate.residuals, null.weighed
    start = Start(null.parameters(problem), residuals, null.model, same, np.zeros(0), same)
    return search_alone(problem, start, null, LINE).log_evidence - null.log_evidence


def test_domes_that_break_up_are_no_evidence_for_another_resonance():
    """Few resonances of a loudspeaker, and an even response elsewhere."""
    rng = np.random.default_rng(1)
    found = [log_bayes(dome(rng) + ERROR * rng.standard_normal(len(HZ))) for _ in range(10)]
    assert np.median(found) < -2
    # One effect of forty is there in one campaign of four: 4 nats make it as likely as none.
    assert max(found) < 4


@pytest.mark.parametrize("hz", [3000.0, 5000.0, 9000.0])
def test_a_line_that_no_loudspeaker_has_is_evidence(hz):
    """At its resonance it adds pressure in phase: the catalogue's phase is 90 degrees there."""
    rng = np.random.default_rng(2)
    noise = ERROR * rng.standard_normal(len(HZ))
    assert log_bayes(line(hz, 42.0, 12.0) + noise) > 8


def test_a_loudspeaker_without_resonances_is_no_evidence():
    rng = np.random.default_rng(2)
    assert log_bayes(ERROR * rng.standard_normal(len(HZ))) < 0


def test_a_notch_is_what_is_below_the_usual_level_nearby():
    notch = line(5000.0, 20.0, 10.0)
    found = _in_notches(-notch, APART)
    at = int(np.argmax(notch))
    # Of the octave around it, the notch itself takes little.
    assert found[at] == pytest.approx(np.exp(notch[at]), rel=0.1)
    assert found.min() == 1.0
    assert np.median(found) < 1.05
    assert _in_notches(notch, APART)[at] == 1.0
