"""Losses of modes: of normal and shear stiffness, of the clamp, and by radiated sound.

A loss factor is the ratio of dissipated to stored energy per radian of a mode, with the moduli of
its own frequency: to first order the imaginary part over the real part of its eigenvalue ω².
"""

from collections.abc import Callable

import numpy as np
from scipy import linalg

from holography.arrays import Array, ComplexArray
from physics.reed.cane.material import terms_and_slopes
from physics.reed.reduced.dynamics import LossFactors, gathered
from physics.reed.reduced.vibrations import Group, Vibrations


def radiated(found: Vibrations) -> Array:
    """Loss factors (m,) by what the air takes away."""
    losses, state = np.zeros(len(found.hz)), found.state
    if state.air is None:
        return losses
    amounts = state.air_fraction * state.air.amounts(np.log(found.hz))
    for start, own in zip(found.reed.starts, state.air.resistance_kg_s, strict=True):
        shapes = found.coordinates[start : start + own.shape[-1]]
        forms = np.einsum("sm,ksm->mk", shapes, np.matmul(own, shapes))
        losses += np.sum(amounts * forms, axis=1)
    return np.asarray(losses / (2 * np.pi * found.hz))


def cane_energies(found: Vibrations) -> Array:
    """Quadratic forms (m, 9) of every mode in the stiffness per unit of each term of the cane."""
    reed, change = found.reed, found.state.change
    parts = list(reed.loose.values())
    sizes = [part.size for part in parts]
    energies = np.zeros((len(found.hz), 9))
    for group, rank in zip(found.groups, found.order, strict=True):
        members = group.coordinates.parts
        terms = gathered([p.stiffness_terms for p in parts], change.stiffness_terms, members, sizes)
        shapes = found.coordinates[np.sort(group.coordinates.everywhere)][:, rank]
        products = np.matmul(terms, shapes)
        energies[rank] = np.einsum("sm,tsm->mt", shapes, products)
    return energies


def spring_energies(found: Vibrations) -> Array:
    """Quadratic forms (m,) of every mode in the springs that hold the strips."""
    energies = np.zeros(len(found.hz))
    for group, rank in zip(found.groups, found.order, strict=True):
        energies[rank] = np.sum(_springs(group) ** 2, axis=0)
    return energies


def _springs(group: Group) -> Array:
    """Amplitudes (k, m) of the unit springs."""
    count = group.coordinates.strip.shape[1]
    return group.vectors[len(group.vectors) - count :]


def loss_factors(found: Vibrations, losses: LossFactors) -> Array:
    """Loss factors (m,) to first order."""
    stiffnesses = terms_and_slopes(found.state.law.constants_at(found.hz))[0]
    stored = cane_energies(found) * stiffnesses
    springs = spring_energies(found)
    lost = (stored @ losses.of_terms).imag + losses.clamp * springs
    # The air adds mass, and the mode has unit mass with it: what is stored is ω².
    return np.asarray(lost / (stored.sum(axis=1) + springs) + radiated(found))


def complex_eigenvalues(found: Vibrations, losses: LossFactors) -> ComplexArray:
    """Eigenvalues ω²(1 + iη) (m,), each of the damped reed with what holds at its own frequency.

    Solved as complex eigenproblems in the condensed coordinates: a check of `loss_factors`, which
    is a thousand times faster.
    """
    answer = np.zeros(len(found.hz), dtype=complex)
    for group, rank in zip(found.groups, found.order, strict=True):
        matrices, amounts_of = _damping(found, group, losses)
        for m, hz in zip(rank.tolist(), group.hz.tolist(), strict=True):
            amounts = group.dynamics.amounts(np.array([hz]))[0][0]
            elastic, omega2 = group.dynamics.elastic, (2 * np.pi * hz) ** 2
            K = np.tensordot(np.where(elastic, amounts, 0.0), group.dynamics.matrices, axes=1)
            M = np.tensordot(np.where(elastic, 0.0, -amounts), group.dynamics.matrices, axes=1)
            K, M = (group.shapes.T @ matrix @ group.shapes for matrix in (K, M))
            lossy = np.tensordot(amounts_of(hz), matrices, axes=1)
            values = linalg.eigvals(K + 1j * lossy, M / omega2)
            answer[m] = values[np.argmin(np.abs(values.real - omega2))]
    return answer


def _damping(
    found: Vibrations, group: Group, losses: LossFactors
) -> tuple[Array, Callable[[float], Array]]:
    """Matrices (k, n, n) of what dissipates, in condensed coordinates, and their amounts (k,)."""
    reed, state, members = found.reed, found.state, group.coordinates.parts
    parts = list(reed.loose.values())
    sizes = [part.size for part in parts]
    terms = [part.stiffness_terms for part in parts]
    stacked = [gathered(terms, state.change.stiffness_terms, members, sizes)]
    if state.air is not None:
        stacked.append(gathered(state.air.resistance_kg_s, {}, members, sizes))
    own = group.coordinates.at_springs(group.coordinates.ordered(np.concatenate(stacked)))
    springs = np.zeros_like(own[:1])
    count = group.coordinates.strip.shape[1]
    at = np.arange(own.shape[-1] - count, own.shape[-1])
    springs[0, at, at] = losses.clamp
    matrices = group.shapes.T @ np.concatenate([own, springs]) @ group.shapes

    def amounts(hz: float) -> Array:
        stiffnesses = terms_and_slopes(state.law.constants_at(np.array([hz])))[0][0]
        each = [stiffnesses * losses.of_terms.imag]
        if state.air is not None:
            each.append(2 * np.pi * hz * state.air_fraction * state.air.amounts(np.log(hz)))
        return np.concatenate([*each, [1.0]])

    return matrices, amounts
