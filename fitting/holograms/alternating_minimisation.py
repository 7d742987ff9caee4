"""Light and amplitudes of solved holograms settle together."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.levenberg_marquardt import (
    GAIN_HELD,
    block_light,
    descend,
)
from fitting.holograms.object_field import (
    LightStep,
    light_factor,
    light_step,
    linearise,
    log_light_factor,
)
from fitting.holograms.problem import Problem

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complex64]
Amplitudes = NDArray[np.complexfloating[Any, Any]]

# Prior standard deviation of amplitudes, rad: only against what the data do not tell at all.
FINAL_RAD = 10.0
# Log of the light changes by no more at once.
_LARGEST_STEP = 0.3
# Inverse of the misfit above which a hologram is not explained.
_LEAST_WEIGHT = 0.5


@dataclass(frozen=True)
class Solution:
    """Amplitudes (k, j), log gains (k,) and light (n,)."""

    amplitude: Amplitudes
    gain: Array
    light: Complex


def settle(
    problem: Problem, exact: Problem, smooth: Array, at: Solution
) -> tuple[Solution, LightStep]:
    """One turn: amplitudes, light block by block, then its smooth part with amplitudes together.

    Parameters
    ----------
    problem, exact : Problem
        Of the holograms that are solved; the same in single and in double precision.
    smooth : (n, c) float
        See `fitting.holograms.object_field.smooth_functions`.
    at : Solution
        Where they are.
    """
    steps = np.arange(len(at.gain))
    size = at.amplitude.shape[1]
    weak = FINAL_RAD**-2 * np.eye(size)
    a, gain, misfit = descend(
        problem, at.light, steps, (at.amplitude, at.gain - np.mean(at.gain)), 2, weak
    )
    weight = 1 / np.maximum(misfit / problem.seen, 1)
    light = block_light(problem, steps, a, gain, weight, at.light)
    held = 0.5 * np.diag([FINAL_RAD**-2] * 2 * size + [2 * GAIN_HELD])
    linear = linearise(exact, smooth, light, a, gain, weight)
    x = np.concatenate([a.real, a.imag, gain[:, None]], axis=1)
    step = light_step(linear, held, x, weight)
    # A step that is no small one, because some holograms are in a wrong fringe, is cut short.
    largest = float(np.abs(log_light_factor(smooth, step.move)).max())
    share = min(1.0, _LARGEST_STEP / max(largest, 1e-12))
    # Holograms that are not explained would be thrown anywhere: they follow in the next turn.
    follow = weight > _LEAST_WEIGHT
    y = np.where(follow[:, None], x + share * step.holograms, x)
    factor = light_factor(smooth, share * step.move)
    return Solution(y[:, :size] + 1j * y[:, size:-1], y[:, -1], light * factor), step
