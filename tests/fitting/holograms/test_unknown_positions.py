"""Tests of errors by unknown positions of light, against whole matrices of all unknowns."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

from fitting.holograms.alternating_minimisation import weighed
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements, problem_of
from fitting.holograms.unknown_positions import _variance, covariance_by_positions
from fitting.holograms.within_blocks import slope_terms
from tests.numbers import complex_normal

SIDE, HOLOGRAMS, FUNCTIONS, INDEPENDENT = 0.1, 6, 3, 0.7
# Variance of each part of a position, in units of that of light that fills a block.
PART = 0.08


def moved(u):
    size = np.maximum(np.abs(u), 1e-12)
    return u * j1(size) / size


@pytest.fixture
def plate():
    edge = (np.arange(8) + 0.5) * SIDE
    x, y = (part.ravel() for part in np.meshgrid(edge, edge))
    return x, y, np.stack([1 - x, y * (1 - x), 1 - 0.5 * y**2], axis=-1)


@pytest.fixture
def blocks(plate):
    x, y, _ = plate
    steps = np.arange(HOLOGRAMS)
    even = np.full((2, len(x)), 12**-0.5)
    value = np.zeros((len(x), HOLOGRAMS), np.complex64)
    return BlockAmplitudes(
        value, x, y, (SIDE, SIDE), even, INDEPENDENT, np.ones(len(x)), steps, steps,
        1000.0 + steps, np.ones(HOLOGRAMS),
    )  # fmt: skip


@pytest.fixture
def basis(plate):
    size, names = FUNCTIONS, ("F1", "T1", "F2")
    return ShapeBasis(
        plate[2].astype(np.float32), np.eye(size), names, 1e3 * np.arange(1, size + 1),
        np.zeros(size), np.zeros((2, size, size)), np.array([1e3, 2e4]), np.zeros((2, size, size)),
        np.ones(size), {},
    )  # fmt: skip


@pytest.fixture
def displacements(plate):
    rng, count = np.random.default_rng(1), len(plate[0])
    nothing = np.zeros((HOLOGRAMS, 2 * FUNCTIONS, 0)), np.zeros((HOLOGRAMS, 0, 0))
    return Displacements(
        amplitude_rad=3 * complex_normal(rng, HOLOGRAMS, FUNCTIONS),
        information=np.zeros((HOLOGRAMS, 2 * FUNCTIONS, 2 * FUNCTIONS)),
        common_mode=CommonModeError(*nothing, np.zeros((HOLOGRAMS, 0))),
        recording_rank=np.arange(HOLOGRAMS),
        misfit=np.array([0.8, 1.0, 1.5, 0.9, 1.2, 1.0]),
        gain=0.1 * rng.standard_normal(HOLOGRAMS),
        gain_nepers=0.1,
        object_field=(20 * complex_normal(rng, count)).astype(np.complex64),
        field_variance=None,
        change=None,
        reached=np.ones(HOLOGRAMS, bool),
        positions=np.sqrt(2 * PART) * complex_normal(rng, count, 2),
    )


def whole_information(blocks, basis, displacements):
    """Information on all amplitudes, then on all positions, from differences of the fringes."""
    problem = problem_of(blocks, basis).exact()
    a, functions = displacements.amplitude_rad, basis.functions.astype(float)
    count, step = len(functions), 1e-5
    lit = np.exp(displacements.gain)[:, None] * displacements.object_field
    slopes = lit * slope_terms(problem, a)
    weight = np.asarray(weighed(problem, displacements.solution).weight)
    amplitudes = HOLOGRAMS * 2 * FUNCTIONS
    found = np.zeros((amplitudes + 4 * count,) * 2)
    for k in range(HOLOGRAMS):
        columns = np.zeros((count, len(found)), complex)
        for part, unit in enumerate((1, 1j)):
            for j in range(FUNCTIONS):
                other = a[k] + step * unit * np.eye(FUNCTIONS)[j]
                change = (moved(other @ functions.T) - moved(a[k] @ functions.T)) / step
                columns[:, 2 * FUNCTIONS * k + FUNCTIONS * part + j] = lit[k] * change
            for axis in range(2):
                at = amplitudes + count * (2 * part + axis)
                columns[:, at : at + count] = np.diag(unit * slopes[axis, k])
        trust = 2 * INDEPENDENT * weight[k] / max(displacements.misfit[k], 1)
        found += ((columns.conj() * trust[:, None]).T @ columns).real
    return found, amplitudes


def by_whole_matrices(blocks, basis, displacements, influence):
    information, amplitudes = whole_information(blocks, basis, displacements)
    positions = np.arange(amplitudes, len(information))
    count = len(positions) // 4
    of_blocks = information[amplitudes:, amplitudes:].reshape(4, count, 4, count)
    own = np.einsum("inkn->nik", of_blocks)
    information[positions, positions] += 1 / _variance(displacements.positions, own)
    along = influence.reshape(len(influence), -1)
    known = np.linalg.inv(information[:amplitudes, :amplitudes])
    unknown = np.linalg.inv(information)[:amplitudes, :amplitudes]
    return along @ (unknown - known) @ along.T


@pytest.fixture
def influence():
    rng = np.random.default_rng(2)
    # Of very different sizes, as those of frequencies and losses.
    sizes = np.array([1e-6, 1e-3, 1.0])[:, None, None]
    return sizes * rng.standard_normal((3, HOLOGRAMS, 2 * FUNCTIONS))


def test_what_unknown_positions_add_is_what_whole_matrices_say(
    blocks, basis, displacements, influence
):
    found = covariance_by_positions(blocks, basis, displacements, influence)
    expected = by_whole_matrices(blocks, basis, displacements, influence)
    size = np.sqrt(np.diag(expected))
    relative = expected / np.outer(size, size)
    assert found / np.outer(size, size) == pytest.approx(relative, abs=0.02)


def test_the_variance_of_positions_is_found_from_the_likeliest_ones():
    rng, blocks = np.random.default_rng(3), 2000
    positions = np.sqrt(PART) * rng.standard_normal((blocks, 4))
    root = rng.standard_normal((blocks, 4, 4)) * np.exp(rng.normal(1, 1, (blocks, 1, 1)))
    information = root @ root.swapaxes(1, 2)
    noise = (root @ rng.standard_normal((blocks, 4, 1)))[..., 0]
    seen = (information @ positions[..., None])[..., 0] + noise
    held = information + np.eye(4) / PART
    likeliest = np.linalg.solve(held, seen[..., None])[..., 0]
    found = likeliest[:, :2] + 1j * likeliest[:, 2:]
    assert _variance(found, information) == pytest.approx(PART, rel=0.05)


def test_more_holograms_of_the_same_shape_leave_the_same_error(blocks, basis, displacements):
    """Their noise averages out, and positions stay as unknown as they are."""
    one = displacements.amplitude_rad[:1] * np.exp(1j * np.arange(HOLOGRAMS))[:, None]
    turn = np.exp(1j * np.arange(HOLOGRAMS))
    same = replace(displacements, amplitude_rad=one, misfit=np.ones(HOLOGRAMS))

    def error(count):
        mean = np.zeros((1, HOLOGRAMS, 2 * FUNCTIONS))
        # Mean amplitude of the second function, each hologram turned to the same phase.
        mean[0, :count, 1], mean[0, :count, FUNCTIONS + 1] = turn[:count].real, turn[:count].imag
        return covariance_by_positions(blocks, basis, same, mean / count)[0, 0]

    assert error(HOLOGRAMS) == pytest.approx(error(1), rel=0.02)


def test_without_positions_nothing_is_added(blocks, basis, displacements, influence):
    still = replace(displacements, positions=None)
    assert not covariance_by_positions(blocks, basis, still, influence).any()


def test_a_hologram_without_a_solution_says_nothing(blocks, basis, displacements, influence):
    lost = replace(displacements, misfit=np.array([0.8, np.inf, 1.5, 0.9, 1.2, 1.0]))
    assert np.isfinite(covariance_by_positions(blocks, basis, lost, influence)).all()
    others = [k for k in range(HOLOGRAMS) if k != 1]
    rest = replace(
        displacements,
        amplitude_rad=displacements.amplitude_rad[others],
        gain=displacements.gain[others],
        misfit=displacements.misfit[others],
    )
    fewer = replace(blocks, value=blocks.value[:, others], recording_rank=np.arange(5))
    influence[:, 1] = 0
    found = covariance_by_positions(blocks, basis, lost, influence)
    expected = covariance_by_positions(fewer, basis, rest, influence[:, others])
    assert found == pytest.approx(expected, rel=1e-3)
