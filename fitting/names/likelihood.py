"""How well a reed explains the modes of a sweep: frequencies, shapes, and ratios of strengths."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fitting.names.measured import MeasuredModes
from fitting.names.prediction import Prediction
from holography.arrays import Array
from physics.plausible.reeds import PlausibleReeds

# Scatter of the coordinates of shapes of unit length that are tried: from the functions of a
# `ShapeBasis`, which do not span shapes better, to a shape that is another one (MAC 0.5).
_SHAPE_SCATTER = np.geomspace(3e-3, 0.12, 12)
# Two modes have similar shapes, and may be confused, from this MAC on.
SIMILAR = 0.5


@dataclass(frozen=True)
class Ratio:
    """How much more one of two modes of similar shape is seen than the other.

    The drive pushes both equally, so that the ratio of their participations shows how they share
    the character that is seen.

    Attributes
    ----------
    one, other : int
        Of the measured modes.
    ln_ratio, error : float
        Logarithm of the ratio of the squares of what is visible of both, at equal mass.
    """

    one: int
    other: int
    ln_ratio: float
    error: float


@dataclass(frozen=True)
class NameData:
    """What a reed is fitted to: measured modes (a), and which modes of the reed they are.

    Attributes
    ----------
    measured : MeasuredModes
    mode : (a,) int
        Number of the reed's mode that each measured mode is; -1 if none.
    real : (a,) bool
        Whether it is not spurious.
    scatter : (a,) float
        Scatter of the coordinates of each shape.
    weight : (a,) float
        Weight of each coordinate: their number that is independent, over their number.
    ratios : tuple of Ratio
    """

    measured: MeasuredModes
    mode: NDArray[np.intp]
    real: NDArray[np.bool_]
    scatter: Array
    weight: Array
    ratios: tuple[Ratio, ...] = ()

    @property
    def counts(self) -> NDArray[np.bool_]:
        """Mask (a,) of the modes that the reed is fitted to."""
        return (self.mode >= 0) & self.real


@dataclass(frozen=True)
class ShapeResidual:
    """Difference of a measured shape and that of a reed's mode, scaled to it.

    Attributes
    ----------
    left, precision, expected : (j,) float
        Residual, precision of each coordinate, and expected shape, in directions in which errors
        are independent.
    scale : float
        Of the expected shape; it is fitted, and of no weight.
    """

    left: Array
    precision: Array
    expected: Array
    scale: float

    @property
    def cost(self) -> float:
        """Minus twice the log likelihood, but for a constant."""
        return float(np.sum(self.left**2 * self.precision - np.log(self.precision)))


def shape_residual(
    here: Prediction, measured: MeasuredModes, a: int, m: int, scatter: float
) -> ShapeResidual:
    """Compare the shape of measured mode a with that of the reed's mode m."""
    own = measured.directions[a]
    precision = 1 / (measured.variance[a] + scatter**2)
    expected, seen = own @ here.shape[m], own @ measured.shape[a]
    along = precision * expected
    scale = float(along @ seen) / float(along @ expected)
    return ShapeResidual(seen - scale * expected, precision, expected, scale)


def whitened(here: Prediction, data: NameData) -> tuple[Array, Array]:
    """Return residuals (n,) and their jacobian (n, p), in standard deviations, without the prior.

    Frequencies come first, then shapes, then ratios of strengths.
    """
    measured, counts = data.measured, data.counts
    mode, error = data.mode[counts], measured.error[counts]
    residuals = [(here.ln_hz[mode] - measured.ln_hz[counts]) / error]
    jacobians = [here.by_ln_hz[mode] / error[:, None]]
    for a in np.flatnonzero(counts).tolist():
        m = int(data.mode[a])
        found = shape_residual(here, measured, a, m, float(data.scatter[a]))
        along = found.precision * found.expected
        slope = found.scale * (measured.directions[a] @ here.by_shape[m])
        slope -= np.multiply.outer(found.expected, along @ slope) / float(along @ found.expected)
        root = np.sqrt(data.weight[a] * found.precision)
        residuals.append(-root * found.left)
        jacobians.append(root[:, None] * slope)
    for ratio in data.ratios:
        one, other = int(data.mode[ratio.one]), int(data.mode[ratio.other])
        away = 2 * (here.ln_size[one] - here.ln_size[other]) - ratio.ln_ratio
        residuals.append(np.array([away / ratio.error]))
        jacobians.append(2 * (here.by_ln_size[one] - here.by_ln_size[other])[None] / ratio.error)
    return np.concatenate(residuals), np.concatenate(jacobians)


def similarities_of(here: Prediction, data: NameData) -> Array:
    """Return the MAC (a,) of each measured shape with that of the reed's mode; 0 if it is none."""
    along = np.einsum("aj,aj->a", data.measured.shape, here.shape[np.maximum(data.mode, 0)])
    return np.where(data.mode >= 0, along**2, 0.0)


def log_likelihood(here: Prediction, data: NameData) -> float:
    """Return the log likelihood of a reed, but for a constant of the measured modes."""
    residual, _ = whitened(here, data)
    answer = -0.5 * float(residual @ residual)
    for a in np.flatnonzero(data.counts).tolist():
        precision = 1 / (data.measured.variance[a] + data.scatter[a] ** 2)
        answer += 0.5 * float(data.weight[a] * np.sum(np.log(precision)))
    return answer - float(sum(np.log(ratio.error) for ratio in data.ratios))


def shape_scatter(here: Prediction, data: NameData) -> Array:
    """Return the scatter (a,) of each shape around the reed's that makes it most probable."""
    answer = np.full(len(data.mode), _SHAPE_SCATTER[-1])
    for a in np.flatnonzero(data.mode >= 0).tolist():
        m = int(data.mode[a])
        cost = [
            shape_residual(here, data.measured, a, m, scatter).cost
            for scatter in _SHAPE_SCATTER.tolist()
        ]
        answer[a] = _SHAPE_SCATTER[int(np.argmin(cost))]
    return answer


def shape_weights(here: Prediction, data: NameData) -> Array:
    """Return the weight (a,) of the coordinates of each shape.

    What a model lacks is correlated over the reed. The number of independent residuals is that of
    equal squares with the same sum and the same sum of squares.
    """
    answer = np.ones(len(data.mode))
    for a in np.flatnonzero(data.mode >= 0).tolist():
        found = shape_residual(here, data.measured, a, int(data.mode[a]), float(data.scatter[a]))
        squares = found.left**2 * found.precision
        number = float(np.sum(squares)) ** 2 / max(float(np.sum(squares**2)), 1e-30)
        answer[a] = number / len(squares)
    return answer


def strength_ratios(reeds: PlausibleReeds, here: Prediction, data: NameData) -> tuple[Ratio, ...]:
    """Return the ratios of strengths of close modes of similar shape.

    The force of the drive on one is that on the other, but for the part of its shape that differs:
    there the force may be as large as it is on other modes of that symmetry.
    """
    measured, own, answer = data.measured, own_shifts(reeds, here), []
    found = np.flatnonzero(data.counts)
    force = np.zeros(len(data.mode))
    force[found] = measured.ln_strength[found] - 2 * here.ln_size[data.mode[found]]
    parts = reeds.parts[own[np.maximum(data.mode, 0)]]
    for one, other in combinations(found.tolist(), 2):
        mac = float(measured.shape[one] @ measured.shape[other]) ** 2
        if not are_close(reeds, own[data.mode[one]], own[data.mode[other]]) or mac < SIMILAR:
            continue
        same = found[parts[found] == parts[one]]
        usual = 0.5 * float(np.log(np.mean(np.exp(2 * force[same]))))
        larger = float(np.exp(2 * max(usual - min(force[one], force[other]), 0.0)))
        variance = float(np.sum(measured.strength_error[[one, other]] ** 2)) + (1 - mac) * larger
        ratio = float(measured.ln_strength[one] - measured.ln_strength[other])
        answer.append(Ratio(one, other, ratio, float(np.sqrt(variance))))
    return tuple(answer)


def own_shifts(reeds: PlausibleReeds, here: Prediction) -> NDArray[np.intp]:
    """Return the number (m,) of the shift that moves each mode most."""
    first = reeds.shifts.start
    own = slice(first, first + len(reeds.reference.hz))
    return np.asarray(here.by_ln_hz[:, own].argmax(axis=1))


def are_close(reeds: PlausibleReeds, one: int, other: int) -> bool:
    """Whether two modes of the reference may exchange their characters."""
    return (min(one, other), max(one, other)) in reeds.close
