"""Alternating minimisation over the object field and the amplitudes of solved holograms."""

from dataclasses import dataclass

import numpy as np

from fitting.holograms.amplitudes import (
    HALF_GAIN_PRECISION,
    block_object_field,
    fit_amplitudes,
)
from fitting.holograms.object_field import (
    FieldStep,
    field_factor,
    field_step,
    linearise,
    log_field_factor,
)
from fitting.holograms.problem import Problem
from holography.arrays import Array, Complex64Array, ComplexArray

# Prior standard deviation of amplitudes, rad: weak, for directions that the data do not determine.
FINAL_RAD = 10.0
# Largest change of the log of the object field in one step.
_LARGEST_STEP = 0.3
# Holograms of a smaller weight (inverse misfit) are not explained.
_LEAST_WEIGHT = 0.5


@dataclass(frozen=True)
class Solution:
    """Amplitudes (k, j), log gains (k,) and object field (n,)."""

    amplitude: ComplexArray
    gain: Array
    object_field: Complex64Array


def alternating_step(
    problem: Problem, exact: Problem, smooth: Array, at: Solution
) -> tuple[Solution, FieldStep]:
    """Minimise once over the amplitudes, the object field of each block, and its smooth factor.

    The smooth factor is fitted together with the amplitudes.

    Parameters
    ----------
    problem, exact : Problem
        The problem of the solved holograms, in single and in double precision.
    smooth : (n, c) float
        See `fitting.holograms.object_field.smooth_functions`.
    at : Solution
        Start.
    """
    steps = np.arange(len(at.gain))
    size = at.amplitude.shape[1]
    weak = FINAL_RAD**-2 * np.eye(size)
    a, gain, misfit = fit_amplitudes(
        problem, at.object_field, steps, (at.amplitude, at.gain - np.mean(at.gain)), 2, weak
    )
    weight = 1 / np.maximum(misfit / problem.seen, 1)
    object_field = block_object_field(problem, steps, a, gain, weight, at.object_field)
    held = 0.5 * np.diag([FINAL_RAD**-2] * 2 * size + [2 * HALF_GAIN_PRECISION])
    linear = linearise(exact, smooth, object_field, a, gain, weight)
    x = np.concatenate([a.real, a.imag, gain[:, None]], axis=1)
    step = field_step(linear, held, x, weight)
    # Holograms in a wrong fringe can make the step too long for the linearisation: it is cut.
    largest = float(np.abs(log_field_factor(smooth, step.move)).max())
    fraction = min(1.0, _LARGEST_STEP / max(largest, 1e-12))
    # Holograms that are not explained do not follow: their equations mean little.
    follow = weight > _LEAST_WEIGHT
    y = np.where(follow[:, None], x + fraction * step.holograms, x)
    factor = field_factor(smooth, fraction * step.move)
    return Solution(y[:, :size] + 1j * y[:, size:-1], y[:, -1], object_field * factor), step
