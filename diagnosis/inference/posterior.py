"""Posterior of the nuisances of a linear Gaussian model, most of which reach one group only.

A nuisance that changes the numbers of one group alone is marginalised within that group. What is
left is a small system of the nuisances that groups share: the cost grows with the cube of the
largest group, not with that of all nuisances together.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.linalg import lapack

from holography.arrays import Array


@dataclass(frozen=True)
class Block:
    """Numbers whose own nuisances reach no other numbers.

    Attributes
    ----------
    rows : (k,) int
        Which of the numbers they are.
    own : (l,) int
        Which of the nuisances are their own.
    shared : (k, p) float
        Slopes along the nuisances that several blocks share.
    local : (k, l) float
        Slopes along their own.
    """

    rows: NDArray[np.intp]
    own: NDArray[np.intp]
    shared: Array
    local: Array


@dataclass(frozen=True)
class Structure:
    """Slopes (n, q) of a linear model, taken apart.

    Attributes
    ----------
    shared : (p,) int
        Which nuisances several blocks share.
    blocks : tuple of Block
    """

    shared: NDArray[np.intp]
    blocks: tuple[Block, ...]

    @classmethod
    def of(cls, slopes: Array, group: NDArray[np.intp]) -> "Structure":
        """Find which nuisances reach one group only; group (n,) is that of each number."""
        groups = [np.flatnonzero(group == each) for each in np.unique(group)]
        reached = np.array([np.any(slopes[rows], axis=0) for rows in groups])
        local = reached.sum(axis=0) <= 1
        shared, home = np.flatnonzero(~local), np.argmax(reached, axis=0)
        blocks, others = [], []
        for number, rows in enumerate(groups):
            own = np.flatnonzero(local & (home == number))
            if len(own):
                every = slopes[rows]
                blocks.append(Block(rows, own, every[:, shared], every[:, own]))
            else:
                others.append(rows)
        if others:
            rows, none = np.concatenate(others), np.zeros(0, dtype=np.intp)
            every = slopes[rows]
            blocks.append(Block(rows, none, every[:, shared], every[:, none]))
        return cls(shared, tuple(blocks))


@dataclass(frozen=True)
class _Part:
    """One block with its own nuisances marginalised.

    Attributes
    ----------
    block : Block
    half : (l, k) float
        Whitened own slopes: ``half.T @ half`` is the precision that they take away.
    inverse : (l, l) float
        Inverse of the Cholesky factor of the precision of its own nuisances.
    along : (l, p) float
        ``half`` times the shared slopes.
    left : (l,) float
        ``half`` times the numbers.
    """

    block: Block
    half: Array
    inverse: Array
    along: Array
    left: Array


@dataclass(frozen=True)
class Posterior:
    """Posterior of the nuisances.

    Attributes
    ----------
    mean : (q,) float
    log_det : float
        Logarithm of the determinant of their covariance.
    squares : float
        Squares of the numbers, whitened by noise and nuisances.
    variance : (n,) float
        Of the noise.
    root : (p, p) float
        Inverse of the Cholesky factor of the precision of the shared nuisances.
    shared : (p,) int
    parts : tuple of _Part
    """

    mean: Array
    log_det: float
    squares: float
    variance: Array
    root: Array
    shared: NDArray[np.intp]
    parts: tuple[_Part, ...]

    @classmethod
    def of(
        cls, structure: Structure, left: Array, variance: Array, prior_variance: Array
    ) -> "Posterior":
        """Marginalise the nuisances.

        Parameters
        ----------
        structure : Structure
        left : (n,) float
            Model less measurement with all nuisances at 0.
        variance : (n,) float
            Of the noise.
        prior_variance : (q,) float
            Of the nuisances.

        Raises
        ------
        LinAlgError
            If a variance is not positive.
        """
        shared = structure.shared
        precision = np.diag(1 / prior_variance[shared])
        pull, squares, log_det = np.zeros(len(shared)), 0.0, 0.0
        parts = []
        for block in structure.blocks:
            own_left, own_variance = left[block.rows], variance[block.rows]
            part, log = _marginalised(block, own_left, own_variance, prior_variance[block.own])
            weighted = block.shared / own_variance[:, None]
            precision += weighted.T @ block.shared - part.along.T @ part.along
            pull += weighted.T @ own_left - part.along.T @ part.left
            squares += float(own_left @ (own_left / own_variance) - part.left @ part.left)
            log_det += log
            parts.append(part)
        root, log = _inverse_root(precision)
        half = root @ pull
        mean = np.empty(len(prior_variance))
        mean[shared] = -(root.T @ half)
        for part in parts:
            moved = part.left + part.along @ mean[shared]
            mean[part.block.own] = -(part.inverse.T @ moved)
        squares -= float(half @ half)
        return cls(mean, log_det + log, squares, variance, root, shared, tuple(parts))

    def variances(self) -> tuple[Array, Array]:
        """Return what is uncertain of nuisances (q,) and of numbers (n,): their variances."""
        nuisances, numbers = np.empty(len(self.mean)), np.empty(len(self.variance))
        nuisances[self.shared] = _column_squares(self.root)
        for part in self.parts:
            block = part.block
            absorbed = part.inverse.T @ part.along
            nuisances[block.own] = _column_squares(part.inverse)
            nuisances[block.own] += _column_squares(self.root @ absorbed.T)
            left = block.shared - block.local @ absorbed
            numbers[block.rows] = _column_squares(part.half) * self.variance[block.rows] ** 2
            numbers[block.rows] += _column_squares(self.root @ left.T)
        return nuisances, numbers

    def precision(self) -> Array:
        """Return the inverse covariance (n, n) of the numbers, nuisances marginalised."""
        whole = np.zeros((len(self.variance),) * 2)
        across = np.empty((len(self.shared), len(self.variance)))
        for part in self.parts:
            rows = part.block.rows
            own = np.diag(1 / self.variance[rows]) - part.half.T @ part.half
            whole[np.ix_(rows, rows)] = own
            weighted = part.block.shared / self.variance[rows][:, None]
            across[:, rows] = self.root @ (weighted - part.half.T @ part.along).T
        whole -= across.T @ across
        return whole


def _marginalised(
    block: Block, left: Array, variance: Array, prior_variance: Array
) -> tuple[_Part, float]:
    """Marginalise the own nuisances of a block, and return the log determinant they leave."""
    weighted = block.local.T / variance
    precision = weighted @ block.local + np.diag(1 / prior_variance)
    inverse, log_det = _inverse_root(precision)
    half = inverse @ weighted
    return _Part(block, half, inverse, half @ block.shared, half @ left), log_det


def _inverse_root(precision: Array) -> tuple[Array, float]:
    """Return the inverse Cholesky factor (k, k), and the log determinant of the inverse."""
    if not len(precision):
        return precision, 0.0
    lower = linalg.cholesky(precision, lower=True, check_finite=False)
    inverse, _ = lapack.dtrtri(lower, lower=1)
    return np.asarray(inverse), -2 * float(np.sum(np.log(np.diag(lower))))


def _column_squares(matrix: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->j", matrix, matrix))
