"""Steps downhill: amplitudes of holograms from known light, light of blocks from amplitudes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.problem import (
    Normal,
    Problem,
    misfits,
    normal,
)
from fitting.holograms.sidebands import brightness, phasors

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complex64]
Amplitudes = NDArray[np.complexfloating[Any, Any]]
Steps = NDArray[np.intp]

# Prior standard deviation of a hologram's gain, in nepers: laser and modulators drift.
GAIN = 0.05
# Half of its precision: the misfit, of noise of variance 1, is half of χ².
GAIN_HELD = 0.5 * GAIN**-2


def descend(
    problem: Problem,
    light: Complex,
    steps: Steps,
    start: tuple[Amplitudes, Array],
    count: int,
    prior: Array,
) -> tuple[Amplitudes, Array, Array]:
    """Levenberg and Marquardt on all holograms side by side, each with its own damping.

    From amplitudes (s, j) and log gains (s,) to better ones, in so many turns, at least one; and
    their misfits (s,). The prior is the precision of amplitudes around 0, (j, j) or (s, j, j).
    """
    a, gain = start
    size = a.shape[1]
    held = np.zeros((len(a), 2 * size + 1, 2 * size + 1))
    # Half of it: the misfit, of noise of variance 1, is half of χ².
    held[:, :size, :size] = held[:, size:-1, size:-1] = 0.5 * prior
    held[:, -1, -1] = GAIN_HELD

    def belief(x: Array) -> Array:
        beliefs: Array = np.sum(x * (held @ x[..., None])[..., 0], axis=1)
        return beliefs

    def at(x: Array) -> Normal:
        return normal(problem, light, steps, x[:, :size] + 1j * x[:, size:-1], x[:, -1])

    def misfit_at(x: Array) -> Array:
        return misfits(problem, light, steps, x[:, :size] + 1j * x[:, size:-1], x[:, -1])

    x = np.concatenate([a.real, a.imag, gain[:, None]], axis=1)
    now = at(x)
    misfit = now.misfit.copy()
    total = misfit + belief(x)
    damping = np.full(len(a), 1e-3)
    diagonal = np.arange(2 * size)
    for turns_left in reversed(range(count)):
        damped = now.matrix + held
        mean = np.trace(now.matrix[:, :-1, :-1], axis1=1, axis2=2) / (2 * size)
        damped[:, diagonal, diagonal] += (damping * mean + 1e-3)[:, None]
        pull = now.gradient - (held @ x[..., None])[..., 0]
        tried_x = x + np.linalg.solve(damped, pull[..., None])[..., 0]
        # Nobody goes on from the last: slopes take most of the time.
        tried = at(tried_x) if turns_left else None
        tried_misfit = tried.misfit if tried else misfit_at(tried_x)
        tried_total = tried_misfit + belief(tried_x)
        better = tried_total < total
        x[better], total[better] = tried_x[better], tried_total[better]
        misfit[better] = tried_misfit[better]
        if tried:
            now.take_over(better, tried)
        damping = np.where(better, 0.2 * damping, np.minimum(6 * damping, 1e6))
    return x[:, :size] + 1j * x[:, size:-1], x[:, -1], misfit


def block_light(
    problem: Problem,
    steps: Steps,
    a: Amplitudes,
    gain: Array,
    weight: Array,
    before: Complex | None = None,
) -> Complex:
    """Light (n,) of every block by least squares over holograms (s,) of given weights.

    Other sidebands, if there are any, need light from before.
    """
    u, v = problem.phasors(a)
    factor = np.exp(gain).astype(np.float32)[:, None]
    weighed = (weight[:, None] * factor).astype(np.float32)
    real, imaginary = problem.real[steps], problem.imaginary[steps]
    power = np.sum(weighed * factor * (u * u + v * v), axis=0)
    light = np.sum(weighed * (u * real + v * imaginary), axis=0) + 1j * np.sum(
        weighed * (u * imaginary - v * real), axis=0
    )
    if before is not None:
        for side in problem.others:
            shown = phasors(side, problem.displacement(a))
            shown = brightness(side, shown, before, steps).astype(np.complex64)[:, None] * shown
            trust = (weight * side.present[steps]).astype(np.float32)[:, None]
            seen = side.real[steps] + 1j * side.imaginary[steps]
            power += np.sum(trust * (shown.real**2 + shown.imag**2), axis=0)
            light += np.sum(trust * shown.conj() * seen, axis=0)
    found: Complex = (light / np.maximum(power, np.float32(1e-9))).astype(np.complex64)
    return found
