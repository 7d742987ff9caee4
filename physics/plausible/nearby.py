"""Reeds near one: their modes as mixtures of its modes, with derivatives."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components
from scipy.special import ndtr

from holography.arrays import Array
from physics.reed.mode_classification import ModeDescriptor
from physics.reed.reduced.elastic import all_descriptors
from physics.reed.reduced.vibrations import Vibrations

# Mass of the air as a multiple of that around a free plate: a reed in a wide wall has about twice
# that, and a mouthpiece is between the two (decision 0026: F1 is 42 and 81 cents lower).
_AIR = (1.0, 2.0)
# Two modes that are closer than this fraction of a squared frequency are pushed apart in
# derivatives of shapes (not in shapes): chosen, 2 cents, below the scatter of any model.
_CLOSE = 2e-3
# Two modes couple if they would be pushed apart by more than twice this part of a frequency where
# they cross. Chosen: 20 cents, a fifth of the repulsion of X1 and L1, the strongest of the paper's
# reed.
_WEAK = 10 * float(np.log(2)) / 1200


@dataclass(frozen=True)
class NearbyReeds:
    """Reeds near one, as mixtures of its modes.

    Attributes
    ----------
    found : Vibrations
        The m modes of that one, without whatever is not cane.
    start : (p,) float
        Its parameters; 0 for whatever is not cane.
    air : int
        Which parameter is that of the air.
    turned : (r, m) float
        These modes as sums of the characters of the reference.
    stiffness : (p, m, m) float
        Derivative of the stiffness, over twice ω² (of each pair, the product of both ω): on the
        diagonal, of the logarithm of the frequency.
    mass : (p, m, m) float
        Derivative of the mass.
    """

    found: Vibrations
    start: Array
    air: int
    turned: Array
    stiffness: Array
    mass: Array

    def modes(self, parameters: Array) -> tuple[Array, Array]:
        """Return the modes of reeds, all modes that are close taken together.

        Each has the number of the mode of `found` of which it has most; modes that couple have
        theirs in order of frequency. Modes that hardly couple cross: in order of frequency, a small
        change of a reed would give one of them the number of the other, and its shape.

        Parameters
        ----------
        parameters : (..., p) float

        Returns
        -------
        hz : (..., m) float
        mixing : (..., m, m) float
            Each mode in a column, as a sum of those of `found`, of unit mass.
        """
        K, M = self._matrices(parameters)
        inverse = np.linalg.inv(np.linalg.cholesky(M))
        squares, vectors = np.linalg.eigh(inverse @ K @ np.swapaxes(inverse, -1, -2))
        mixing = np.swapaxes(inverse, -1, -2) @ vectors
        number = _numbers(K, M, squares, mixing)
        squares = np.take_along_axis(squares, number, axis=-1)
        mixing = np.take_along_axis(mixing, number[..., None, :], axis=-1)
        return np.sqrt(np.maximum(squares, 1.0)) / (2 * np.pi), mixing

    def numbers_in(self, other: "NearbyReeds", parameters: Array) -> NDArray[np.intp]:
        """Return the number (m,) near another reed of each mode of one with parameters (p,).

        It is -1 if a mode is none of those.
        """
        own, theirs = (each.turned @ each.modes(parameters)[1] for each in (self, other))
        return _same(own.T @ theirs)

    def _amounts(self, parameters: Array) -> Array:
        """Return what stiffness and mass are multiplied by (..., p): air is never negative."""
        amounts = parameters - self.start
        low, high = _AIR
        amounts[..., self.air] = low + (high - low) * ndtr(parameters[..., self.air])
        return amounts

    def _matrices(self, parameters: Array) -> tuple[Array, Array]:
        """Return stiffness and mass (..., m, m) of reeds."""
        omega, step = 2 * np.pi * self.found.hz, self._amounts(parameters)
        logs = np.tensordot(step, self.stiffness, axes=1)
        own = np.arange(len(omega))
        K = 2 * np.multiply.outer(omega, omega) * logs
        # Of a change of all moduli this is exact.
        K[..., own, own] = omega**2 * np.exp(2 * logs[..., own, own])
        return K, np.eye(len(omega)) + np.tensordot(step, self.mass, axes=1)

    def slopes(self, parameters: Array) -> tuple[Array, Array]:
        """Return derivatives of the modes of one reed (see `modes`).

        Parameters
        ----------
        parameters : (p,) float

        Returns
        -------
        ln_hz : (m, p) float
        mixing : (m, m, p) float
            Of the shapes; their mass stays one to first order of the change of mass.
        """
        omega, own = 2 * np.pi * self.found.hz, np.arange(len(self.found.hz))
        hz, mixing = self.modes(parameters)
        squares = (2 * np.pi * hz) ** 2
        moved = 2 * np.multiply.outer(omega, omega) * self.stiffness
        moved[:, own, own] *= np.exp(
            2 * np.tensordot(self._amounts(parameters), self.stiffness[:, own, own], axes=1)
        )
        within = mixing.T @ moved @ mixing - squares * (mixing.T @ self.mass @ mixing)
        value = parameters[self.air]
        within[self.air] *= (_AIR[1] - _AIR[0]) * np.exp(-0.5 * value**2) / np.sqrt(2 * np.pi)
        gap = squares - squares[:, None]
        close = _CLOSE**2 * np.multiply.outer(squares, squares)
        ln_hz = within[:, own, own] / (2 * squares)
        turned = mixing @ (within * gap / (gap**2 + close))
        return ln_hz.T, np.moveaxis(turned, 0, -1)

    def descriptors(self, mixing: Array, besides: Array | None = None) -> list[ModeDescriptor]:
        """Return what the modes of one reed are named by.

        Parameters
        ----------
        mixing : (m, m) float
            As from `modes`.
        besides : (s, m) float, optional
            What each mode has besides these modes, in the coordinates of the reed.
        """
        found, density = self.found, self.found.state.law.constants.density_kg_m3
        shapes = found.coordinates @ mixing
        if besides is not None:
            shapes = shapes + besides
        # Of the cane's mass: that of the air belongs to no part of the reed.
        mass = density * np.einsum("sm,sm->m", shapes, found.reed.mass @ shapes)
        cane = replace(found.reed.cane, density_kg_m3=density)
        reed = replace(found.reed, box=replace(found.reed.box, cane=cane))
        return all_descriptors(reed, shapes / np.sqrt(mass))


def _numbers(K: Array, M: Array, squares: Array, mixing: Array) -> NDArray[np.intp]:
    """Return which mode (..., m) in order of frequency has each number, see `NearbyReeds.modes`."""
    answer = _same(mixing)
    own = np.sqrt(np.diagonal(K, axis1=-2, axis2=-1))
    both = own[..., None] * own[..., None, :]
    # At their mean frequency, mass couples two modes, too.
    coupled = np.abs(K - both * M) > 2 * _WEAK * both
    for index in np.ndindex(answer.shape[:-1]):
        count, group = connected_components(coupled[index], directed=False)
        for each in range(count):
            among = np.flatnonzero(group == each)
            order = np.argsort(squares[index][answer[index][among]])
            answer[index][among] = answer[index][among][order]
    return answer


def _same(overlap: Array) -> NDArray[np.intp]:
    """Return which column (..., m) is each row, for overlaps (..., m, n) of modes; -1 if none."""
    answer = np.full(overlap.shape[:-1], -1)
    for index in np.ndindex(overlap.shape[:-2]):
        rows, columns = linear_sum_assignment(-(overlap[index] ** 2))
        answer[index][rows] = columns
    return answer
