"""Tests of what a displacement that changes within a block does to its amplitude."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import j1

from fitting.holograms.alternating_minimisation import Solution, cost
from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.changing_field import FieldChange
from fitting.holograms.displacement import _unlikelihood, explained_amplitudes
from fitting.holograms.object_field import CommonModeError
from fitting.holograms.problem import Problem
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements, _change_of, displacements_of
from fitting.holograms.within_blocks import (
    from_middle,
    mean_bend,
    slope_terms,
    speckle_positions,
    spread_slopes,
    within_blocks,
)
from tests.numbers import complex_normal

HOLOGRAMS, SIDE = 30, 0.04
# Standard deviation of light that fills a block evenly, in its sides.
EVEN = np.full((2, 25 * 25), 12**-0.5)


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
    return replace(whole, slopes=spread_slopes(x, y, (SIDE, SIDE), EVEN, functions))


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
    inside = within_blocks(seen, amplitude)
    found = speckle_positions(seen, inside, amplitude, still, field, weight)
    bright = np.abs(field) > 100
    left = np.sqrt(np.mean(np.abs(found - positions)[bright] ** 2))
    assert left < 0.3 * 0.4
    middle = from_middle(seen, inside, still, field, found)
    residual = middle.real + 1j * middle.imaginary - field * moved(amplitude @ problem.functions.T)
    before = value - field * moved(amplitude @ problem.functions.T)
    assert np.mean(np.abs(residual) ** 2) < 1.3
    assert np.mean(np.abs(before) ** 2) > 3


def test_light_off_the_middle_of_its_block_does_not_look_like_light_that_changes(
    problem, amplitude
):
    rng, walk = np.random.default_rng(3), 2e-4
    blocks = len(problem.functions)
    positions = 0.5 * complex_normal(rng, blocks, 2)
    change = np.cumsum(complex_normal(rng, HOLOGRAMS, blocks), axis=0)
    light = 100 * complex_normal(rng, blocks)
    field = (light * (1 + np.sqrt(walk) * change)).astype(np.complex64)
    terms, moving = slope_terms(problem, amplitude), moved(amplitude @ problem.functions.T)
    shown = moving + mean_bend(problem, amplitude) + np.einsum("ikn,ni->kn", terms, positions)
    value = field * shown + complex_normal(rng, HOLOGRAMS, blocks)
    seen = replace(problem, real=value.real, imaginary=value.imag)
    normal = SimpleNamespace(misfit=seen.seen)
    step = SimpleNamespace(linear=SimpleNamespace(normal=normal))

    def found(positions):
        at = Solution(amplitude, np.zeros(HOLOGRAMS), field, positions=positions)
        change = _change_of(seen, at, step)
        return change.walk + change.scatter

    assert found(positions) == pytest.approx(walk, rel=0.3)
    assert found(None) > 3 * walk


@pytest.fixture
def off_middle(problem, amplitude):
    """Light off the middle of its blocks: what is seen, and displacements that know of it."""
    rng, blocks = np.random.default_rng(4), len(problem.functions)
    positions = 0.5 * complex_normal(rng, blocks, 2)
    field = (1000 * complex_normal(rng, blocks)).astype(np.complex64)
    terms, moving = slope_terms(problem, amplitude), moved(amplitude @ problem.functions.T)
    shown = moving + mean_bend(problem, amplitude) + np.einsum("ikn,ni->kn", terms, positions)
    value = field * shown + complex_normal(rng, HOLOGRAMS, blocks)
    seen = replace(problem, real=value.real, imaginary=value.imag)
    values = 2 * amplitude.shape[1]
    normal = SimpleNamespace(
        misfit=seen.seen, matrix=np.tile(np.eye(values + 1), (HOLOGRAMS, 1, 1))
    )
    common = CommonModeError(
        np.zeros((HOLOGRAMS, values, 0)), np.zeros((HOLOGRAMS, 0, 0)), np.zeros((HOLOGRAMS, 0))
    )
    linear = SimpleNamespace(normal=normal, smooth=np.zeros((blocks, 0)))
    step = SimpleNamespace(linear=linear, common_mode=common)

    def displacements(positions):
        at = Solution(amplitude, np.zeros(HOLOGRAMS), field[None].repeat(HOLOGRAMS, axis=0),
                      positions=positions)  # fmt: skip
        steady = FieldChange(1e-8, 1e-8)
        return displacements_of(seen, np.arange(HOLOGRAMS), at, step, steady)

    return seen, field, positions, displacements


def test_light_off_the_middle_of_its_block_is_found_as_light_of_the_whole_block(off_middle):
    _, field, positions, displacements = off_middle

    def off(positions):
        found = displacements(positions).object_field
        return np.sqrt(np.mean(np.abs(found - field) ** 2)) / 1000

    # Noise of 1, light of 1000, and F of 0.3 in 30 holograms: 6e-4.
    assert off(positions) < 2e-3
    assert off(None) > 3 * off(positions)


def test_displacements_are_likelier_with_the_places_of_their_light(off_middle):
    seen, _, positions, displacements = off_middle
    known = displacements(positions)
    unlike = [_unlikelihood(seen, each) for each in (known, replace(known, positions=None))]
    assert unlike[0] < unlike[1] - 1000


def test_without_slopes_nothing_is_taken_off(problem, amplitude):
    flat = replace(problem, slopes=None)
    assert slope_terms(flat, amplitude) is None
    assert within_blocks(flat, amplitude) is None
    field, still = np.ones(len(flat.functions), np.complex64), np.zeros(HOLOGRAMS)
    assert speckle_positions(flat, None, amplitude, still, field, np.ones(HOLOGRAMS)) is None
    assert from_middle(flat, None, still, field, None) is flat


def test_light_may_spread_farther_along_one_axis(plate):
    x, y, functions, _ = plate
    even = spread_slopes(x, y, (SIDE, SIDE), EVEN, functions)
    along = spread_slopes(x, y, (SIDE, SIDE), np.array([[3.0], [2.0]]) * EVEN, functions)
    assert along[0] == pytest.approx(3 * even[0])
    assert along[1] == pytest.approx(2 * even[1])
    assert np.abs(even[1]).max() > 0.01


def test_explained_amplitudes_are_those_of_even_light_in_each_block(plate, amplitude):
    x, y, functions, within = plate
    steps = np.arange(HOLOGRAMS)
    size = functions.shape[1]
    blocks = BlockAmplitudes(
        np.zeros((len(x), HOLOGRAMS), np.complex64), x, y, (SIDE, SIDE), EVEN, 1.0,
        np.ones(len(x)), steps, steps, 1000.0 + steps, np.ones(HOLOGRAMS),
    )  # fmt: skip
    names = tuple(f"F{i + 1}" for i in range(size))
    basis = ShapeBasis(
        functions.astype(np.float32), np.eye(size), names, 1e3 * np.arange(1, size + 1),
        np.zeros(size), np.zeros((2, size, size)), np.array([1e3, 2e4]), np.zeros((2, size, size)),
        np.ones(size), {},
    )  # fmt: skip
    rng = np.random.default_rng(9)
    light, gain = complex_normal(rng, len(x)), 0.1 * rng.standard_normal(HOLOGRAMS)
    found = Displacements(
        amplitude_rad=amplitude,
        information=np.zeros((HOLOGRAMS, 2 * size, 2 * size)),
        common_mode=CommonModeError(
            np.zeros((HOLOGRAMS, 2 * size, 0)),
            np.zeros((HOLOGRAMS, 0, 0)),
            np.zeros((HOLOGRAMS, 0)),
        ),
        recording_rank=steps,
        misfit=np.ones(HOLOGRAMS),
        gain=gain,
        gain_nepers=0.1,
        object_field=light.astype(np.complex64),
        field_variance=None,
        change=None,
        reached=np.ones(HOLOGRAMS, bool),
    )
    lit = np.exp(gain)[:, None] * light
    expected = lit * np.mean([moved(amplitude @ f.T) for f in within], axis=0)
    without = lit * moved(amplitude @ functions.T)
    off = explained_amplitudes(blocks, basis, found) - expected
    assert np.linalg.norm(off) < 0.25 * np.linalg.norm(without - expected)


def test_fringes_too_narrow_for_blocks_do_not_explain_a_calm_hologram(problem, plate):
    """They would explain any residual by their variance, which makes it less likely."""
    rng = np.random.default_rng(10)
    calm = 0.5 * complex_normal(rng, HOLOGRAMS, 4)
    light = 30 * complex_normal(rng, len(plate[0]))
    seen = light * moved(calm @ plate[2].T) + complex_normal(rng, HOLOGRAMS, len(light))
    seen = replace(Problem.of(seen.T, plate[2], BesselTable()), slopes=problem.slopes)
    gain, field = np.zeros(HOLOGRAMS), light.astype(np.complex64)
    costs = [cost(seen, Solution(a, gain, field)) for a in (calm, 300 * calm)]
    assert (costs[0] < costs[1]).all()


def test_the_cost_of_a_hologram_is_minus_the_log_of_its_density(problem, plate, amplitude):
    """A complex normal density of the variance that narrow fringes and the field add to noise."""
    rng = np.random.default_rng(11)
    light = 5 * complex_normal(rng, len(plate[0]))
    value = complex_normal(rng, len(plate[0]), HOLOGRAMS)
    variance = rng.uniform(0, 3, (HOLOGRAMS, len(light))).astype(np.float32)
    # Without slopes, only the field adds to the noise.
    own = replace(Problem.of(value, plate[2], BesselTable()), slopes=None)
    gain = np.zeros(HOLOGRAMS)
    found = cost(own, Solution(amplitude, gain, light.astype(np.complex64), variance))
    fringe = moved(amplitude @ plate[2].T)
    whole = 1 + np.abs(fringe) ** 2 * variance
    expected = np.sum(np.log(whole) + np.abs(value.T - light * fringe) ** 2 / whole, axis=1)
    assert found == pytest.approx(expected, rel=1e-3)
