"""Losses of modes: of normal and shear stiffness, of the clamp, and by radiated sound.

A loss factor is the ratio of dissipated to stored energy per radian of a mode, with the moduli of
its own frequency: to first order the imaginary part over the real part of its eigenvalue ω².
"""

import numpy as np

from holography.arrays import Array
from physics.reed.cane.material import terms_and_slopes
from physics.reed.reduced.derivatives import cane_products
from physics.reed.reduced.dynamics import LossFactors
from physics.reed.reduced.vibrations import Vibrations


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


def spring_energies(found: Vibrations) -> Array:
    """Quadratic forms (m,) of every mode in the springs that hold the strips."""
    energies = np.zeros(len(found.hz))
    for group, rank in zip(found.groups, found.order, strict=True):
        held = len(group.vectors) - group.coordinates.strip.shape[1]
        energies[rank] = np.sum(group.vectors[held:] ** 2, axis=0)
    return energies


def loss_factors(found: Vibrations, losses: LossFactors) -> Array:
    """Loss factors (m,) to first order."""
    stored = _stored(found)
    springs = spring_energies(found)
    lost = (stored @ losses.of_terms).imag + losses.clamp * springs
    # The air adds mass, and the mode has unit mass with it: what is stored is ω².
    return np.asarray(lost / (stored.sum(axis=1) + springs) + radiated(found))


def cane_loss_factors(found: Vibrations, losses: LossFactors) -> Array:
    """Loss factors (m,) of the cane alone: of what the cane stores, the fraction that it loses."""
    stored = _stored(found)
    return np.asarray((stored @ losses.of_terms).imag / stored.sum(axis=1))


def _stored(found: Vibrations) -> Array:
    """Quadratic forms (m, 9) of every mode in each term of the stiffness of the cane."""
    stiffnesses = terms_and_slopes(found.state.law.constants_at(found.hz))[0]
    energies = np.einsum("sm,tsm->mt", found.coordinates, cane_products(found), optimize=True)
    return np.asarray(energies * stiffnesses)
