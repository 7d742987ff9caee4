"""Tests of slow changes of gains, and of their scatter."""

import numpy as np
import pytest

from fitting.holograms.amplitudes import split_gains
from fitting.holograms.bessel import BesselTable
from fitting.holograms.problem import Problem

HOLOGRAMS, FUNCTIONS = 120, 3


def problem():
    return Problem.of(np.zeros((5, HOLOGRAMS), complex), np.ones((5, FUNCTIONS)), BesselTable())


def known(precision):
    """Normal matrices that determine the gains alone."""
    matrix = np.tile(np.eye(2 * FUNCTIONS + 1), (HOLOGRAMS, 1, 1))
    matrix[:, -1, -1] = 0.5 * precision
    return matrix


def test_gains_are_split_into_what_drifts_and_what_scatters():
    rng = np.random.default_rng(1)
    slow = 0.05 * np.sin(np.arange(HOLOGRAMS) / 25)
    gain = slow + 0.005 * rng.standard_normal(HOLOGRAMS)
    found = split_gains(problem(), gain, known(1e9))
    assert np.sqrt(np.mean((found.slow - slow) ** 2)) < 0.004
    assert found.scatter_nepers == pytest.approx(0.005, rel=0.3)


def test_scatter_alone_is_no_drift():
    gain = 0.02 * np.random.default_rng(2).standard_normal(HOLOGRAMS)
    found = split_gains(problem(), gain, known(1e9))
    assert np.sqrt(np.mean(found.slow**2)) < 0.005
    assert found.scatter_nepers == pytest.approx(0.02, rel=0.25)


def test_gains_without_any_difference_stay_what_they_are():
    found = split_gains(problem(), np.zeros(HOLOGRAMS), known(1e9))
    assert (found.slow == 0).all()
    assert found.scatter_nepers == 0.002


def test_where_no_hologram_shows_its_gain_nothing_is_said():
    found = split_gains(problem(), np.full(HOLOGRAMS, 0.01), known(1.0))
    assert (found.slow == 0).all()
    assert found.scatter_nepers == 0.05
