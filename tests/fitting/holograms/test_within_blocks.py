"""Tests of what a displacement that changes within a block does to its amplitude."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

from fitting.holograms.bessel import BesselTable
from fitting.holograms.problem import Problem
from fitting.holograms.within_blocks import (
    from_middle,
    mean_bend,
    slope_terms,
    speckle_positions,
    spread_slopes,
)
from tests.numbers import complex_normal

HOLOGRAMS, SIDE = 30, 0.04


def moved(u):
    size = np.maximum(np.abs(u), 1e-12)
    return u * j1(size) / size


@pytest.fixture
def plate():
    """Blocks (n,), functions, and their values at points within each block (p, n, j)."""
    edge = (np.arange(25) + 0.5) * SIDE
    x, y = (part.ravel() for part in np.meshgrid(edge, edge))

    def functions(x, y):
        return np.stack([1 - x, (1 - x) ** 2, y * (1 - x), 1 - 0.5 * y], axis=-1)

    offset = (np.arange(9) - 4) / 9 * SIDE
    within = [functions(x + dx, y + dy) for dx in offset for dy in offset]
    return x, y, functions(x, y), np.array(within)


@pytest.fixture
def problem(plate):
    x, y, functions, _ = plate
    whole = Problem.of(np.zeros((len(x), HOLOGRAMS), complex), functions, BesselTable())
    return replace(whole, slopes=spread_slopes(x, y, (SIDE, SIDE), functions))


@pytest.fixture
def amplitude():
    return 3 * complex_normal(np.random.default_rng(1), HOLOGRAMS, 4)


def test_the_mean_over_a_block_is_the_middle_and_the_bend(plate, problem, amplitude):
    functions, within = plate[2], plate[3]
    middle = moved(amplitude @ functions.T)
    mean = np.mean([moved(amplitude @ f.T) for f in within], axis=0)
    without, left = np.abs(mean - middle), np.abs(mean - middle - mean_bend(problem, amplitude))
    assert np.sqrt(np.mean(left**2)) < 0.25 * np.sqrt(np.mean(without**2))


def test_slope_terms_are_differences_over_the_spread_of_light(problem, plate, amplitude):
    functions, step = plate[2], 1e-4
    for along, found in zip(problem.slopes, slope_terms(problem, amplitude), strict=True):
        ahead, behind = (moved(amplitude @ (functions + s * along).T) for s in (step, -step))
        assert found == pytest.approx((ahead - behind) / (2 * step), abs=2e-4)


def test_positions_are_found_and_taken_off(problem, amplitude):
    rng = np.random.default_rng(2)
    blocks = len(problem.functions)
    positions = 0.4 * complex_normal(rng, blocks, 2)
    field = (300 * complex_normal(rng, blocks)).astype(np.complex64)
    terms = slope_terms(problem, amplitude)
    clean = field * (moved(amplitude @ problem.functions.T) + mean_bend(problem, amplitude))
    value = clean + field * np.einsum("ikn,ni->kn", terms, positions)
    value = value + complex_normal(rng, *value.shape)
    seen = replace(problem, real=value.real, imaginary=value.imag)
    still, weight = np.zeros(HOLOGRAMS), np.ones(HOLOGRAMS)
    found = speckle_positions(seen, amplitude, still, field, weight)
    bright = np.abs(field) > 100
    left = np.sqrt(np.mean(np.abs(found - positions)[bright] ** 2))
    assert left < 0.3 * 0.4
    middle = from_middle(seen, amplitude, still, field, found)
    residual = middle.real + 1j * middle.imaginary - field * moved(amplitude @ problem.functions.T)
    before = value - field * moved(amplitude @ problem.functions.T)
    assert np.mean(np.abs(residual) ** 2) < 1.3
    assert np.mean(np.abs(before) ** 2) > 3


def test_without_slopes_nothing_is_taken_off(problem, amplitude):
    flat = replace(problem, slopes=None)
    assert slope_terms(flat, amplitude) is None
    field, still = np.ones(len(flat.functions), np.complex64), np.zeros(HOLOGRAMS)
    assert speckle_positions(flat, amplitude, still, field, np.ones(HOLOGRAMS)) is None
    assert from_middle(flat, amplitude, still, field, None) is flat
