"""Tests of the scatter of gains around slow changes."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.holograms.amplitudes import gain_scatter
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


def test_slow_changes_of_gains_are_no_scatter():
    rng = np.random.default_rng(1)
    slow = 0.05 * np.sin(np.arange(HOLOGRAMS) / 25)
    gain = slow + 0.005 * rng.standard_normal(HOLOGRAMS)
    assert gain_scatter(problem(), gain, known(1e9)) == pytest.approx(0.005, rel=0.3)


def test_the_scatter_of_gains_is_found():
    gain = 0.02 * np.random.default_rng(2).standard_normal(HOLOGRAMS)
    assert gain_scatter(problem(), gain, known(1e9)) == pytest.approx(0.02, rel=0.25)


def test_gains_without_any_difference_have_the_least_scatter():
    assert gain_scatter(problem(), np.zeros(HOLOGRAMS), known(1e9)) == 0.002


def test_where_no_hologram_shows_its_gain_the_scatter_is_what_it_was():
    assert gain_scatter(problem(), np.full(HOLOGRAMS, 0.01), known(1.0)) == 0.05


def test_noise_that_blocks_share_is_no_scatter_of_gains():
    """Of blocks half of which are independent, a fit takes half of the noise of a gain for it."""
    shared, precision = replace(problem(), independent_fraction=0.5), 5e3
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        noise = np.sqrt(2 / precision) * rng.standard_normal(HOLOGRAMS)
        free = 0.02 * rng.standard_normal(HOLOGRAMS) + noise
        # As the prior of gains has them.
        gain = free / (1 + shared.half_gain_precision / (0.5 * precision))
        found.append(gain_scatter(shared, gain, known(precision)) ** 2)
    assert np.sqrt(np.mean(found)) == pytest.approx(0.02, rel=0.1)


def test_gains_that_blocks_share_noise_in_are_less_sure():
    gain = 0.01 * np.random.default_rng(4).standard_normal(HOLOGRAMS)
    # Just enough to know more than the prior does, if all blocks are independent.
    just = known(1.5 / 0.05**2)
    assert gain_scatter(problem(), gain, just) < 0.05
    assert gain_scatter(replace(problem(), independent_fraction=0.5), gain, just) == 0.05
