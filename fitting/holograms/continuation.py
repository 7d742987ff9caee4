"""Solve the holograms of a sweep by continuation in frequency.

The problem is not convex: beyond |u| = 1.84 the block amplitudes decrease again. It is solved from
the holograms of small amplitude outwards, where it is linear. Each hologram starts from a solved
neighbour in frequency. Between the two, one mode shape changes by a complex factor near its
resonance, or all shapes change by one factor at an acoustic resonance. Both are searched on grids
that are finer than a fringe.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.alternating_minimisation import Solution
from fitting.holograms.amplitudes import block_object_field, fit_amplitudes
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.problem import Problem
from fitting.holograms.shape_basis import ShapeBasis
from fitting.parallel.threads import map_threads
from holography.arrays import Array, Complex64Array, ComplexArray, IndexArray

# Largest value of J₁, and holograms whose brightest show it in a block.
_FIRST_LOBE, _BRIGHTEST = 0.5819, 4
# Blocks above this percentile of vibration surely reach that value in some hologram.
_LARGEST_PERCENTILE = 75
# A hologram has small amplitudes if 95 % of its blocks show less than this: φ below 0.7 rad.
_SMALL_AMPLITUDE = 0.33
# ... and still on the first slope, below 1.2 rad.
_STILL_LINEAR = 0.5
# Of a shape with a largest deflection up to this, block amplitudes have the signs of the shape.
_LINEAR_RAD = 1.0
# Trial values of the largest deflection of the lowest holograms, and how many of those are used.
_FRINGES_RAD, _FRINGED = np.geomspace(1.5, 20.0, 8), 6
# Less than that may be explained by chance.
_LEAST_SOLVED = 0.2
_LEAST_SIGNAL = 1.5
# Every third block is used in the continuation, every ninth on the grids. With fewer, displacements
# fold into wrong fringes.
CONTINUATION_STRIDE, _GRID_STRIDE = 3, 9
# Grid of one shape's amplitude: step in radius, angles, and how far beyond the neighbour's.
_RADIUS_STEP_RAD, _ANGLES, _BEYOND, _ROOM_RAD = 0.35, 12, 2.0, 5.0
_SCALES = np.geomspace(0.3, 3.2, 36).astype(np.complex64)
_GRID_TOGETHER = 128
# Modes this near to a hologram, and the strongest of its neighbour, may be resonant.
_NEAR_CENTS = 350.0
_STARTS, _QUICK = 5, 5
ITERATIONS = 6
# Largest factor of all amplitudes from one hologram to the next.
_STEEPEST = 1.7
# Two holograms or solutions with misfits within this ratio are explained equally well; a larger
# ratio means that one is in a wrong fringe.
SAME_FRINGE_RATIO = 1.15
_START_TURNS = 15
# Prior of amplitudes: half width of a resonance, factor by which a mode may exceed its expected
# response, and fraction for shapes that differ from the finite elements.
_SHARPEST, _ROOM, _OTHER_SHAPES = 0.1, 5.0, 0.05
# Largest reduced χ² of a hologram from which its neighbours start, the better ones first, and over
# how many steps: finally also across holograms that cannot be solved.
_THRESHOLDS = ((2.5, 1), (4.0, 1), (8.0, 1), (20.0, 1), (20.0, 3))
# ... or this fraction of the hologram's power as residual.
_ENOUGH = 0.03
# How often a pair of neighbours is tried again after the object field has improved.
_MOST_FIELDS = 3
# The object field is fitted again when the number of solved holograms has grown by this factor.
_MORE_SOLVED = 1.3


def _size(a: ComplexArray) -> Array:
    """Return the rms displacement (s,) over the reed, at least 0.1 rad."""
    size: Array = np.maximum(np.sqrt(np.sum(np.abs(a) ** 2, axis=1)), 0.1)
    return size


def _whole_size(a: ComplexArray, weight: Array) -> float:
    """Return the size of all amplitudes (s, j) by weights (s,); never 0."""
    return float(np.sqrt(np.sum(weight * np.sum(np.abs(a) ** 2, axis=1))) + 1e-12)


@dataclass(frozen=True)
class _Guess:
    """Assumption that a hologram shows one mode with a given largest deflection."""

    hologram: int
    mode: int
    largest_rad: float = 1.0


class Continuation:
    """Amplitudes, misfits and object field of a sweep whose holograms are solved in turn."""

    def __init__(
        self, whole: Problem, block_amplitudes: BlockAmplitudes, basis: ShapeBasis
    ) -> None:
        self.whole, self._most, self._few = (
            whole, whole.every(CONTINUATION_STRIDE), whole.every(_GRID_STRIDE)
        )  # fmt: skip
        self._basis = basis
        self._value, self._magnitude = block_amplitudes.value, np.abs(block_amplitudes.value)
        ascending = np.sort(self._magnitude, axis=1)
        self._brightest = ascending[:, -_BRIGHTEST:].mean(axis=1) / _FIRST_LOBE
        self._shown = np.percentile(self._magnitude / self._brightest[:, None], 95, axis=0)
        self._cents, self._mode_cents = (
            1200 * np.log2(block_amplitudes.drive_hz),
            1200 * np.log2(basis.hz),
        )
        count = block_amplitudes.value.shape[1]
        self.amplitude: ComplexArray = np.zeros((count, basis.functions.shape[1]), complex)
        self.gain: Array = np.zeros(count)
        self.misfit: Array = np.full(count, np.inf)
        self.object_field: Complex64Array = np.zeros(len(block_amplitudes.value), np.complex64)
        self._solved = np.zeros(count, dtype=bool)
        self._enough = enough(block_amplitudes)

    @property
    def _most_object_field(self) -> Complex64Array:
        return self.object_field[::CONTINUATION_STRIDE]

    def starts(self) -> Iterator[tuple[IndexArray, Sequence[_Guess]]]:
        """Yield sets of holograms to begin with, each with guesses.

        First the holograms at the low end of the sweep, if their amplitudes are small: there the
        reed moves nearly like its first mode. Then the same holograms with any amplitude. Then all
        holograms of small amplitude; the lowest and the brightest of them may resemble any of the
        nearest modes.
        """
        signal = np.sqrt(np.maximum(np.mean(self._magnitude**2, axis=0) - 1, 0))
        clear = signal > _LEAST_SIGNAL
        low = np.flatnonzero(clear & (self._shown < _STILL_LINEAR))
        if low.size and not clear[: low[0]].any():
            common_mode_shift = low[: int(np.argmax(np.diff([*low, np.inf]) > 1)) + 1]
            yield common_mode_shift, [_Guess(int(low[0]), self._near(low[0])[0])]
        if clear.any():
            first = int(np.argmax(clear))
            few = np.flatnonzero(clear[first : first + _FRINGED]) + first
            mode = self._near(first)[0]
            yield few, [_Guess(first, mode, float(rad)) for rad in _FRINGES_RAD]
        small = np.flatnonzero(clear & (self._shown < _SMALL_AMPLITUDE))
        if small.size:
            firsts = (small[0], small[np.argmax(signal[small])])
            yield small, [_Guess(int(k), mode) for k in firsts for mode in self._near(k)[:4]]

    def _near(self, step: int) -> list[int]:
        """Return the modes in order of their distance in frequency from a hologram."""
        return [int(m) for m in np.argsort(np.abs(self._mode_cents - self._cents[step]))]

    def begin(self, few: IndexArray, guesses: Iterable[_Guess]) -> None:
        """Solve some holograms from the best of several guesses."""
        self.amplitude[:], self.gain[:], self.misfit[:] = 0, 0, np.inf
        self._solved[:] = False
        best = np.inf
        for guess in guesses:
            object_field, a, left = self._small_amplitude_start(few, guess)
            if left.sum() < best:
                best = float(left.sum())
                self.object_field, self.amplitude[few] = object_field, a
                self.misfit[few] = left / self._most.blocks

    @property
    def solution(self) -> Solution:
        """The solution reached so far."""
        return Solution(self.amplitude, self.gain, self.object_field)

    def continue_from(self, solution: Solution, misfit: Array) -> None:
        """Continue from a better solution, with misfits (k,), to holograms that it misses."""
        self.amplitude, self.gain, self.object_field = (
            solution.amplitude.copy(), solution.gain.copy(), solution.object_field
        )  # fmt: skip
        self.misfit = misfit.copy()
        self._solved[:] = False
        self.solve_outwards()
        self._revise()

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Mask (k,) of the solved holograms."""
        return self._solved

    @property
    def explained(self) -> NDArray[np.bool_]:
        """Mask (k,) of the holograms explained down to their noise, in the right fringe."""
        return self.misfit < _THRESHOLDS[0][0]

    @property
    def best_explained(self) -> NDArray[np.bool_]:
        """Mask (k,) of the holograms explained as well as most of the solved ones."""
        usual = max(float(np.median(self.misfit[self._solved])), 1.0)
        return self.misfit < _THRESHOLDS[0][0] * usual

    def _small_amplitude_start(
        self, few: IndexArray, guess: _Guess
    ) -> tuple[Complex64Array, ComplexArray, Array]:
        """Fit object field and amplitudes of some holograms in turns; return them and misfits."""
        shape = self._basis.shapes[guess.mode]
        u = self._basis.functions @ shape * np.float32(guess.largest_rad)
        over, _ = self.whole.bessel.tensor(np.abs(u))
        turn = np.exp(1j * np.angle(self._value[:, guess.hologram])) * np.sign(u * over)
        object_field = (self._brightest * turn).astype(np.complex64)
        gain: Array = np.zeros(len(few))
        if guess.largest_rad > _LINEAR_RAD:
            self.object_field = object_field
            scales = guess.largest_rad * _SCALES
            a = np.array([self._on_grid(int(k), shape, scales)[1][0] for k in few])
            size = _size(a)
        else:
            a = np.zeros((len(few), self.amplitude.shape[1]), complex)
            # F(u) is half of u there.
            relative = self._magnitude[:, few] / self._brightest[:, None]
            size = 2 * np.sqrt(np.mean(relative**2, axis=0))
        prior = self._prior(few, size)
        for turn_number in range(_START_TURNS):
            a, _, left = fit_amplitudes(
                self._most,
                object_field[::CONTINUATION_STRIDE],
                few,
                (a, gain),
                1 if turn_number else 2,
                prior,
            )
            object_field = block_object_field(self.whole, few, a, gain, np.ones(len(few)))
            # Where the reed moves most, some hologram of the sweep has reached the largest J₁.
            power = np.sum(np.square(self.whole.bessel_vectors(a)), axis=(0, 1))
            moving = power > np.percentile(power, _LARGEST_PERCENTILE)
            scale = float(np.median(self._brightest[moving] / np.abs(object_field[moving])))
            object_field, a = object_field * np.float32(scale), a / scale
        return object_field, a, left

    def _prior(self, steps: IndexArray, size: Array) -> Array:
        """Return the prior precision (s, j, j) of amplitudes, for rms displacements (s,) in rad.

        An object field that varies smoothly over the reed resembles another mode shape, the more
        so the fewer fringes there are. The prior therefore limits each mode to its response under
        any pressure: its compliance times its resonance curve.
        """
        ratio = 2 ** ((self._cents[steps, None] - self._mode_cents) / 600)
        moving = 2 ** (self._mode_cents / -600) / np.maximum(np.abs(1 - ratio), _SHARPEST)
        moving = _ROOM * moving / moving.max(axis=1, keepdims=True)
        shapes = self._basis.shapes
        solve_outwards = np.einsum("sm,mi,mj->sij", moving**2, shapes, shapes, optimize=True)
        solve_outwards += _OTHER_SHAPES**2 * np.eye(shapes.shape[1])
        precision: Array = np.linalg.inv(solve_outwards) / size[:, None, None] ** 2
        return precision

    def solve_outwards(self) -> None:
        """Solve the holograms next to solved ones until none is left that can be solved."""
        self._solve_outwards()
        if not self._solved.all() and self._solve_small_amplitudes():
            self._solve_outwards()

    def _solve_outwards(self) -> None:
        """Solve from neighbour to neighbour, the better explained ones first."""
        # Versions of the object field in which each pair has been tried.
        tried: dict[tuple[int, int], list[int]] = {}
        object_field = 0

        def to_be_tried(pair: tuple[int, int]) -> bool:
            lights = tried.get(pair, [])
            return object_field not in lights and len(lights) < _MOST_FIELDS

        for threshold, reach in _THRESHOLDS:
            good = np.maximum(self._enough, threshold)
            self._solved |= self.misfit < good
            self.update_object_field()
            lit, object_field = int(self._solved.sum()), object_field + 1
            while frontier := [pair for pair in self._frontier(reach) if to_be_tried(pair)]:
                for step, source in frontier:
                    if self._solved[step]:
                        continue
                    tried.setdefault((step, source), []).append(object_field)
                    self._solve(step, source)
                    self._solved[step] = self.misfit[step] < good[step]
                    if self._solved.sum() > _MORE_SOLVED * lit + 2:
                        self.update_object_field(1)
                        lit, object_field = int(self._solved.sum()), object_field + 1

    def _solve_small_amplitudes(self) -> bool:
        """Solve holograms of small amplitude from 0: with a known object field they are linear."""
        start = np.zeros((1, self.amplitude.shape[1]), complex)
        small = np.flatnonzero(~self._solved & (self._shown < _STILL_LINEAR))
        for step in small:
            self.attempt(int(step), start, ((self._most, CONTINUATION_STRIDE, ITERATIONS),))
        return bool((self.misfit[small] < _THRESHOLDS[0][0]).any())

    def _revise(self) -> None:
        """Solve holograms again from a neighbour that is explained better."""
        last = len(self.misfit) - 1
        for step in np.argsort(-self.misfit):
            for source in (step - 1, step + 1):
                if not 0 <= source <= last or not self._solved[source]:
                    continue
                if self.misfit[step] > SAME_FRINGE_RATIO * max(float(self.misfit[source]), 1):
                    self._solve(int(step), int(source))

    def _frontier(self, reach: int) -> list[tuple[int, int]]:
        """Return pairs of an unsolved hologram and a solved one at most `reach` steps away."""
        last = len(self._solved) - 1
        return [
            (step, int(source))
            for source in np.flatnonzero(self._solved)
            for step in range(int(source) - reach, int(source) + reach + 1)
            if 0 <= step <= last and not self._solved[step]
        ]

    def update_object_field(self, turns: int = 2) -> None:
        """Fit the object field to the solved holograms, then these to the object field."""
        solved = np.flatnonzero(self._solved)
        if not solved.size:
            return
        for _ in range(turns):
            weight = 1 / np.maximum(self.misfit[solved], 1)
            start = self.amplitude[solved], self.gain[solved]
            self.object_field = block_object_field(self.whole, solved, *start, weight)
            self.amplitude[solved], self.gain[solved], left = fit_amplitudes(
                self._most,
                self._most_object_field,
                solved,
                start,
                2,
                self._prior(solved, _size(start[0])),
            )
            self.misfit[solved] = left / self._most.blocks
            # The mean gain belongs to the object field. So does what the prior, which is one of
            # shapes, takes from the size of displacements: it would take more in every turn.
            common = float(np.mean(self.gain[solved]))
            self.gain[solved] -= common
            kept = _whole_size(self.amplitude[solved], weight) / _whole_size(start[0], weight)
            self.amplitude[solved] /= kept
            self.object_field = self.object_field * np.float32(np.exp(common) * kept)

    def _solve(self, step: int, source: int) -> None:
        """Try to solve one hologram from the amplitudes of a neighbour."""
        neighbour = self.amplitude[source]
        scaled = self._on_grid(step, neighbour, _SCALES)[1][0]
        trend = self.trend(step, source)
        quick = np.array([scaled] if trend is None else [trend, scaled])
        self.attempt(step, quick, ((self._most, CONTINUATION_STRIDE, _QUICK),), trend)
        if self.misfit[step] < SAME_FRINGE_RATIO * max(float(self.misfit[source]), 1):
            return
        starts = np.array([neighbour, *self._starts(step, neighbour)])
        self.attempt(
            step,
            starts,
            ((self._few, _GRID_STRIDE, ITERATIONS), (self._most, CONTINUATION_STRIDE, ITERATIONS)),
        )

    def trend(self, step: int, source: int) -> ComplexArray | None:
        """Extrapolate amplitudes (j,) to a hologram from its neighbour and the one before that."""
        before = 2 * source - step
        if not (0 <= before < len(self._solved) and self._solved[before]):
            return None
        size, former = _size(self.amplitude[[source, before]])
        # Near a resonance the reciprocal of a displacement is a linear function of frequency.
        a = self.amplitude[source] / np.clip(2 - size / former, 1 / _STEEPEST, _STEEPEST)
        object_field = self.object_field[::_GRID_STRIDE]
        (turned,) = self._few.turned(object_field, np.array([step]), a[None])
        return np.asarray(turned)

    def attempt(
        self,
        step: int,
        a: ComplexArray,
        levels: tuple[tuple[Problem, int, int], ...],
        near: ComplexArray | None = None,
    ) -> None:
        """Fit one hologram's amplitudes from several starts, and keep the best if it is better.

        Parameters
        ----------
        step : int
        a : (s, j) complex
            Starts; after every level the two best go on.
        levels : tuple of (problem, stride, turns)
            First with few of the blocks.
        near : (j,) complex, optional
            Expected amplitudes.

        Notes
        -----
        Beyond 1.84 rad the block amplitudes decrease again, so that a folded displacement may
        explain the hologram equally well. Of two such solutions the one nearer to `near` is taken.
        """
        gain: Array = np.zeros(len(a))
        for problem, stride, turns in levels:
            steps, object_field = np.full(len(a), step), self.object_field[::stride]
            prior = self._prior(steps, _size(a))
            a, gain, left = fit_amplitudes(problem, object_field, steps, (a, gain), turns, prior)
            found = left / problem.blocks
            whole = found + self.oddness(step, a, problem.blocks)
            best = np.argsort(whole)[:2]
            a, gain, found, whole = a[best], gain[best], found[best], whole[best]
        first = 0
        if near is not None and len(a) > 1 and whole[1] < SAME_FRINGE_RATIO * max(whole[0], 1):
            first = int(np.argmin(np.linalg.norm(a - near, axis=1)))
        before = self.oddness(step, self.amplitude[step][None], problem.blocks)[0]
        if whole[first] < self.misfit[step] + before:
            self.amplitude[step], self.gain[step], self.misfit[step] = (
                a[first], gain[first], found[first]
            )  # fmt: skip

    def oddness(self, step: int, a: ComplexArray, blocks: int) -> Array:
        """Return what the prior of a hologram costs amplitudes (s, j), whatever their size.

        The sum of a few shapes without fringes may look like a mode with fringes, and explain a
        dim hologram as well. What moves at this frequency tells them apart.
        """
        prior = self._prior(np.full(len(a), step), _size(a))
        odd: Array = 0.5 * np.einsum("si,sij,sj->s", a.conj(), prior, a, optimize=True).real
        return odd / blocks

    def _starts(self, step: int, neighbour: ComplexArray) -> list[ComplexArray]:
        """Return the likeliest changes of a neighbour's amplitudes: of one shape, or of all."""
        likely = list(zip(*self._on_grid(step, neighbour, _SCALES), strict=True))
        near = np.abs(self._mode_cents - self._cents[step]) < _NEAR_CENTS
        shapes = self._basis.shapes
        liveliness = np.abs(shapes @ neighbour.conj()) / np.linalg.norm(shapes, axis=1)
        near[np.argmax(liveliness)] = True
        for shape in shapes[near]:
            now = complex(shape @ neighbour / (shape @ shape))
            rest = neighbour - now * shape
            radius = np.arange(0.2, _BEYOND * abs(now) + _ROOM_RAD, _RADIUS_STEP_RAD)
            angles = np.exp(2j * np.pi * np.arange(_ANGLES) / _ANGLES)
            grid = (radius[:, None] * angles).ravel().astype(np.complex64)
            likely += zip(*self._on_grid(step, shape, grid, rest), strict=True)
        likely.sort(key=lambda start: start[0])
        return [start for _, start in likely[: _STARTS - 1]]

    def _on_grid(
        self, step: int, part: ComplexArray, grid: Complex64Array, fixed: ComplexArray | None = None
    ) -> tuple[list[float], list[ComplexArray]]:
        """Return the three best ``[fixed +] factor · part`` over factors (g,), and misfits."""
        few = self._few
        if fixed is None:
            fixed = np.zeros_like(part)
        u, v = few.displacement(np.stack([part, fixed]))
        object_field = self.object_field[::_GRID_STRIDE]
        power = object_field.real**2 + object_field.imag**2
        pull = object_field.conj() * self._value[::_GRID_STRIDE, step]
        misfit, overlap = np.empty(len(grid)), np.empty(len(grid), complex)

        def fill(some: slice) -> None:
            real, imaginary = grid.real[some, None], grid.imag[some, None]
            p = real * u[0] - imaginary * v[0] + u[1]
            q = real * v[0] + imaginary * u[0] + v[1]
            square = p * p + q * q
            over = few.bessel.over_argument(np.sqrt(square))
            along = (over * p) @ pull - 1j * ((over * q) @ pull)
            # The phase of the hologram is free.
            misfit[some] = (over * over * square) @ power - 2 * np.abs(along)
            overlap[some] = along

        map_threads(fill, len(grid), _GRID_TOGETHER)
        best = np.argsort(misfit)[:3]
        found = [(fixed + grid[g] * part) * np.exp(1j * np.angle(overlap[g])) for g in best]
        return [float(misfit[g]) for g in best], found


Start = tuple[IndexArray, Sequence[_Guess]]
"""Holograms to begin with, and guesses of what they show; the best of these is taken."""


def starts_of(
    whole: Problem, block_amplitudes: BlockAmplitudes, basis: ShapeBasis
) -> Iterator[Start]:
    """Yield starts of a continuation, the likelier ones first.

    What a few holograms show does not always decide between guesses. After the sets of guesses,
    each guess is therefore a start of its own.
    """
    sets = list(Continuation(whole, block_amplitudes, basis).starts())
    yield from sets
    for few, guesses in sets:
        for guess in guesses if len(guesses) > 1 else ():
            yield few, [guess]


def continued(
    whole: Problem, block_amplitudes: BlockAmplitudes, basis: ShapeBasis, start: Start
) -> Continuation | None:
    """Solve the first sideband of a sweep from a start; None if hardly a hologram is solved."""
    continuation = Continuation(whole, block_amplitudes, basis)
    continuation.begin(*start)
    continuation.solve_outwards()
    return continuation if continuation.solved.mean() >= _LEAST_SOLVED else None


def enough(block_amplitudes: BlockAmplitudes) -> Array:
    """Return the misfit (k,) that is always accepted: a fraction of each hologram's power.

    Where the displacement changes by many radians within a block, a block amplitude is no longer
    that of one point, and the residual is larger than the noise.
    """
    accepted: Array = _ENOUGH * np.mean(np.abs(block_amplitudes.value) ** 2, axis=0)
    return accepted
