"""Alternating minimisation over the object field and the amplitudes of solved holograms."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.amplitudes import FINAL_RAD, block_object_field, fit_amplitudes
from fitting.holograms.changing_field import FieldChange, field_estimate, mean_power
from fitting.holograms.object_field import (
    FieldStep,
    field_factor,
    field_step,
    linearise,
    log_field_factor,
)
from fitting.holograms.problem import Problem, misfits
from fitting.holograms.sidebands import sideband_values
from fitting.holograms.within_blocks import (
    WithinBlocks,
    blurring,
    from_middle,
    speckle_positions,
    within_blocks,
)
from holography.arrays import Array, Complex64Array, ComplexArray

# Largest change of the log of the object field in one step.
_LARGEST_STEP = 0.3
# Holograms of a smaller weight (inverse misfit) are not explained.
_LEAST_WEIGHT = 0.5
# Steps end when one lowers half of χ² by less: a displacement that is off by its standard error in
# one of its coordinates costs one half.
_SETTLED = 5.0
# ... or when all displacements move by less than this, in standard errors, but for a common-mode
# error: that one converges slowly, and the modal fit finds it. Chosen: twenty more such steps would
# be one standard error.
_STILL = 0.05
# Rounding of products of columns of norm 1, and how often what it leaves is taken out again.
_ROUNDING, _REFINED = 1e-14, 2
# A hologram with a larger misfit is far from its noise.
FAR = 30.0


@dataclass(frozen=True)
class Solution:
    """Amplitudes and object field of all holograms.

    Attributes
    ----------
    amplitude : (k, j) complex
    gain : (k,) float
        Log gains.
    object_field : (n,) or (k, n) complex64
        One row if the object field is the same in all holograms.
    field_variance : (k, n) float32, optional
        Variance of the object field, if it changes from hologram to hologram.
    positions : (n, 2) complex, optional
        Mean positions of the light within each block, see
        `fitting.holograms.within_blocks.speckle_positions`.
    """

    amplitude: ComplexArray
    gain: Array
    object_field: Complex64Array
    field_variance: NDArray[np.float32] | None = None
    positions: ComplexArray | None = None

    def every(self, stride: int) -> "Solution":
        """Return the same for every `stride`-th block."""
        variance, positions = self.field_variance, self.positions
        return replace(
            self,
            object_field=self.object_field[..., ::stride],
            field_variance=None if variance is None else variance[..., ::stride],
            positions=None if positions is None else positions[::stride],
        )


@dataclass(frozen=True)
class Sweep:
    """Solved holograms, and what else is fitted to them.

    Attributes
    ----------
    problem, exact : Problem
        The same in single and in double precision.
    smooth : (n, c) float
        See `fitting.holograms.object_field.smooth_functions`.
    change : FieldChange, optional
        How much the object field changes from hologram to hologram; it is one for all otherwise.
    common : bool
        Whether the smooth factor of the object field is fitted; if not, it stays as it is.
    """

    problem: Problem
    exact: Problem
    smooth: Array
    change: FieldChange | None
    common: bool = True

    def with_gains(self, gain_nepers: float, change: FieldChange) -> "Sweep":
        """Return the same holograms with another scatter of gains and change of the field."""
        problem, exact = (
            replace(each, gain_nepers=gain_nepers) for each in (self.problem, self.exact)
        )
        return replace(self, problem=problem, exact=exact, change=change)


def alternating_step(sweep: Sweep, at: Solution) -> tuple[Solution, FieldStep]:
    """Minimise once over the amplitudes, the object field of each block, and its smooth factor.

    The smooth factor is fitted together with the amplitudes. What is small, corrections within
    blocks and the variance of the noise, follows one step later.
    """
    half = _half_step(sweep, at)
    now, weight = half.solution, half.weight
    size = now.amplitude.shape[1]
    held = 0.5 * np.diag([FINAL_RAD**-2] * 2 * size + [2 * sweep.problem.half_gain_precision])
    precise = with_weights_of(middle(sweep.exact, now, half.within), half.weighed)
    linear = linearise(precise, sweep.smooth, now.object_field, now.amplitude, now.gain, weight)
    x = np.concatenate([now.amplitude.real, now.amplitude.imag, now.gain[:, None]], axis=1)
    step = field_step(linear, held, x, common=sweep.common)
    # Holograms in a wrong fringe can make the step too long for the linearisation: it is cut.
    largest = float(np.abs(log_field_factor(sweep.smooth, step.move)).max())
    fraction = min(1.0, _LARGEST_STEP / max(largest, 1e-12))
    # Holograms that are not explained do not follow: their equations mean little.
    follow = weight > _LEAST_WEIGHT
    y = np.where(follow[:, None], x + fraction * step.holograms, x)
    factor = field_factor(sweep.smooth, fraction * step.move)
    found = replace(
        now,
        amplitude=y[:, :size] + 1j * y[:, size:-1],
        gain=y[:, -1],
        object_field=now.object_field * factor,
    )
    return found, step


@dataclass(frozen=True)
class _HalfStep:
    """Amplitudes of all holograms for a given object field, then this field for them.

    Attributes
    ----------
    solution : Solution
    misfit, weight : (k,) float
        Squared residuals before the object field is fitted, and the weights that follow from them.
    weighed : Problem
        With the noise that was used.
    within : WithinBlocks, optional
        See `fitting.holograms.within_blocks`; None without slopes.
    """

    solution: Solution
    misfit: Array
    weight: Array
    weighed: Problem
    within: WithinBlocks | None


def _half_step(sweep: Sweep, at: Solution) -> _HalfStep:
    problem, steps = sweep.problem, np.arange(len(at.gain))
    weak = FINAL_RAD**-2 * np.eye(at.amplitude.shape[1])
    within = within_blocks(problem, at.amplitude)
    own = weighed(middle(problem, at, within), at)
    a, gain, misfit = fit_amplitudes(
        own, at.object_field, steps, (at.amplitude, at.gain - np.mean(at.gain)), 2, weak
    )
    weight = 1 / np.maximum(misfit / problem.seen, 1)
    now = with_field(own, replace(at, amplitude=a, gain=gain), weight, sweep.change)
    positions = speckle_positions(
        with_weights_of(problem, own), within, a, gain, now.object_field, weight
    )
    return _HalfStep(replace(now, positions=positions), misfit, weight, own, within)


def with_field(
    problem: Problem, at: Solution, weight: Array, change: FieldChange | None
) -> Solution:
    """Return a solution with the object field that its amplitudes and weights (k,) give."""
    if change is None:
        steps = np.arange(len(at.gain))
        field = block_object_field(problem, steps, at.amplitude, at.gain, weight, at.object_field)
        return replace(at, object_field=field, field_variance=None)
    found = field_estimate(problem, at.amplitude, at.gain, at.object_field, change, weight)
    return replace(at, object_field=found.mean, field_variance=found.variance)


def middle(problem: Problem, at: Solution, within: WithinBlocks | None = None) -> Problem:
    """Return a problem with block amplitudes as if light came from the middle of each block.

    `within` saves time if it is known for the same amplitudes.
    """
    known = within or within_blocks(problem, at.amplitude)
    return from_middle(problem, known, at.gain, at.object_field, at.positions)


def weighed(problem: Problem, at: Solution) -> Problem:
    """Return a problem whose noise has the variance that field and slopes add to it."""
    power = mean_power(at.object_field)
    blurred = {n: power * part for n, part in blurring(problem, at.amplitude).items()}
    field = 0.0 if at.field_variance is None else at.field_variance
    u, v = problem.bessel_vectors(at.amplitude)
    more = np.exp(2 * at.gain)[:, None] * (blurred[1] + (u * u + v * v) * field)
    displacement, others = problem.displacement(at.amplitude), []
    for side in problem.others:
        shown = np.abs(sideband_values(side, displacement)) ** 2
        weight = 1 / (1 + blurred[side.order] + shown * field)
        others.append(replace(side, weight=weight.astype(side.real.dtype)))
    weight = (1 / (1 + more)).astype(problem.functions.dtype)
    return replace(problem, weight=weight, others=tuple(others))


def with_weights_of(problem: Problem, other: Problem) -> Problem:
    """Return a problem whose noise has the variance that it has in another one."""
    dtype = problem.functions.dtype
    others = [
        replace(side, weight=None if seen.weight is None else seen.weight.astype(dtype))
        for side, seen in zip(problem.others, other.others, strict=True)
    ]
    weight = None if other.weight is None else other.weight.astype(dtype)
    return replace(problem, weight=weight, others=tuple(others))


def cost(problem: Problem, at: Solution) -> Array:
    """Return the negative log likelihood (k,) of holograms and their gains, but for a constant."""
    own = weighed(middle(problem, at), at)
    steps = np.arange(len(at.gain))
    left = misfits(own, at.object_field, steps, at.amplitude, at.gain)
    left = left + problem.half_gain_precision * at.gain**2
    if own.weight is not None:
        left = left - np.sum(np.log(own.weight), axis=1)
    for side in own.others:
        if side.weight is not None:
            left = left - side.present * np.sum(np.log(side.weight), axis=1)
    return left


def whole_cost(problem: Problem, at: Solution) -> float:
    """Return the negative log likelihood of all holograms with the prior of their gains."""
    return float(np.sum(cost(problem, at)) + len(at.gain) * np.log(problem.gain_nepers))


def settled(sweep: Sweep, at: Solution, most_turns: int) -> tuple[Solution, FieldStep]:
    """Repeat alternating steps until they lower the misfit, or move displacements, no more.

    If the smooth factor stays as it is, the equations that would find it are needed for the first
    and the last step only.

    Parameters
    ----------
    sweep : Sweep
    at : Solution
        Start.
    most_turns : int
        Largest number of steps; one more with the equations if the factor stays as it is.
    """
    seen, here = sweep.problem.seen, at.amplitude
    at, step = alternating_step(sweep, at)
    before, stale = _whole(step, seen), False
    for _ in range(most_turns - 1):
        if moved_alone(here, at.amplitude, step, seen) < _STILL:
            break
        here = at.amplitude
        if sweep.common:
            at, step = alternating_step(sweep, at)
            now = _whole(step, seen)
        else:
            half = _half_step(sweep, at)
            at, now, stale = half.solution, whole_misfit(half.misfit / seen, seen), True
        if before - now < _SETTLED:
            break
        before = now
    return alternating_step(sweep, at) if stale else (at, step)


def _whole(step: FieldStep, seen: Array) -> float:
    # Where the model itself is off, so is the measure of what is small.
    return whole_misfit(step.linear.normal.misfit / seen, seen)


def moved_alone(before: ComplexArray, now: ComplexArray, step: FieldStep, seen: Array) -> float:
    """Return by how many standard errors displacements have moved, root mean square.

    A common-mode error of all displacements, and the phase of a hologram, do not count.

    Parameters
    ----------
    before, now : (k, j) complex
        Displacements before and after a step.
    step : FieldStep
        Its equations, which give standard errors and common-mode error.
    seen : (k,) float
        Number of values that each hologram shows, see `fitting.holograms.problem.Problem`.
    """
    size, normal = before.shape[1], step.linear.normal
    # Noise of variance 1 has half of it in either part.
    information = 2 * np.einsum("kii->ki", normal.matrix)[:, : 2 * size]
    errors = np.sqrt(information / np.maximum(normal.misfit / seen, 1)[:, None])
    move = np.concatenate([(now - before).real, (now - before).imag], axis=1)
    turned = errors * np.concatenate([-now.imag, now.real], axis=1)
    turned /= np.maximum(np.linalg.norm(turned, axis=1), 1e-12)[:, None]
    moved = errors * move
    moved -= turned * np.sum(turned * moved, axis=1)[:, None]
    common = errors[..., None] * step.common_response
    common -= turned[..., None] * (turned[:, None] @ common)
    return _left(common.reshape(move.size, -1), moved.ravel()) / float(np.sqrt(move.size))


def _left(columns: Array, values: Array) -> float:
    """Return the norm of what is left of values (n,) when combinations of columns are taken out.

    By normal equations of columns of equal norm, some times: each takes out what rounding has left.
    """
    scale = 1 / np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    curvature, axes = np.linalg.eigh(scale[:, None] * (columns.T @ columns) * scale)
    inverse = np.where(curvature > _ROUNDING, 1 / np.maximum(curvature, _ROUNDING), 0)
    for _ in range(_REFINED):
        onto = axes.T @ (scale * (columns.T @ values))
        values = values - columns @ (scale * (axes @ (inverse * onto)))
    return float(np.linalg.norm(values))


def whole_misfit(misfit: Array, seen: Array) -> float:
    """Return the misfit of all holograms in units of what is usual, of which none counts much.

    Holograms without a solution have an infinite misfit.
    """
    usual = max(float(np.median(misfit)), 1.0)
    return float(np.sum(np.minimum(misfit, FAR) * seen)) / usual
