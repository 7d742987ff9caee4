"""The vibration of a sweep's holograms, found one after another from those that are easy to read.

The problem is not convex: beyond |u| = 1.84 phasors fall and turn over. It is solved from the calm
holograms outwards, in which all is linear. Each hologram starts from a solved neighbour in
frequency: near resonances one shape grows by some factor and turns by some angle between them, at
a line of the air all shapes grow together; both are searched on grids finer than a fringe.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitError
from fitting.holograms.alternating_minimisation import Solution
from fitting.holograms.block_amplitudes import Phasors
from fitting.holograms.levenberg_marquardt import block_light, descend
from fitting.holograms.problem import Problem
from fitting.holograms.shape_basis import ShapeBasis
from fitting.parallel.processes import map_processes
from fitting.parallel.threads import map_threads

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complex64]
Amplitudes = NDArray[np.complexfloating[Any, Any]]
Steps = NDArray[np.intp]

# Largest value of J₁, and holograms whose brightest show it in a block.
_FIRST_LOBE, _BRIGHTEST = 0.5819, 4
# Blocks that move more than so many per cent of all are sure to show it in some hologram.
_LIVELIEST = 75
# A hologram is calm if 95 % of its blocks show less than this: φ below 0.7 rad, all linear.
_CALM = 0.33
# ... and still on the first slope, below 1.2 rad.
_STILL_LINEAR = 0.5
# Of a shape with a largest deflection up to this, phasors have the signs of the shape.
_LINEAR_RAD = 1.0
# Largest deflections that the lowest holograms may have if they are not calm, and how many.
_FRINGES_RAD, _FRINGED = np.geomspace(1.5, 20.0, 8), 6
# If so much of a sweep is explained it is not begun again otherwise; less will do if all holograms
# are solved.
_MOST_EXPLAINED, _ALL_SOLVED = 0.8, 0.7
# Less than that may be explained by chance.
_LEAST_SOLVED = 0.2
_LEAST_SIGNAL = 1.5
# Of all blocks, every third serves the search, every ninth the grids. Fewer let displacements fold.
_SEARCH_STRIDE, _GRID_STRIDE = 3, 9
# Grid of one shape's amplitude: step in radius, angles, and how far beyond the neighbour's.
_RADIUS_STEP_RAD, _ANGLES, _BEYOND, _ROOM_RAD = 0.35, 12, 2.0, 5.0
_SCALES = np.geomspace(0.3, 3.2, 36).astype(np.complex64)
_GRID_TOGETHER = 128
# Modes this near to a hologram, besides the liveliest of its neighbour, may be resonating.
_NEAR_CENTS = 350.0
_STARTS, _QUICK = 5, 5
DESCENT = 6
# From one hologram to the next all grow or shrink by no more.
_STEEPEST = 1.7
# Neighbours are explained alike, unless one is in a wrong fringe: ratio of misfits.
ALIKE = 1.15
_CALM_TURNS = 15
# Resonances are no sharper than this; modes may be livelier than expected by this factor; and what
# shapes that are not the finite elements' may add, a share.
_SHARPEST, _ROOM, _OTHER_SHAPES = 0.1, 5.0, 0.05
# Misfits, as reduced χ², that holograms may have to be handed on, the better ones first; and how
# far: at last beyond some that cannot be solved.
_THRESHOLDS = ((2.5, 1), (4.0, 1), (8.0, 1), (20.0, 1), (20.0, 3))
# Or the share of the light that may be left.
_ENOUGH = 0.03
# A pair of neighbours is tried again in better light, but so often only.
_MOST_LIGHTS = 3
# The light is found anew when so many more holograms have been solved.
_MORE_SOLVED = 1.3


def _size(a: Amplitudes) -> Array:
    """Root of the mean square (s,) of displacements over the reed, at least a tenth of a rad."""
    size: Array = np.maximum(np.sqrt(np.sum(np.abs(a) ** 2, axis=1)), 0.1)
    return size


@dataclass(frozen=True)
class _Guess:
    """A mode that a hologram shows, with a largest deflection."""

    hologram: int
    mode: int
    largest_rad: float = 1.0


class Search:
    """Amplitudes, misfits and light of a sweep while its holograms are solved one after another."""

    def __init__(self, whole: Problem, phasors: Phasors, basis: ShapeBasis) -> None:
        self.whole, self._most, self._few = (
            whole, whole.every(_SEARCH_STRIDE), whole.every(_GRID_STRIDE)
        )  # fmt: skip
        self._basis = basis
        self._value, self._magnitude = phasors.value, np.abs(phasors.value)
        ascending = np.sort(self._magnitude, axis=1)
        self._brightest = ascending[:, -_BRIGHTEST:].mean(axis=1) / _FIRST_LOBE
        self._shown = np.percentile(self._magnitude / self._brightest[:, None], 95, axis=0)
        self._cents, self._mode_cents = 1200 * np.log2(phasors.drive_hz), 1200 * np.log2(basis.hz)
        count = phasors.value.shape[1]
        self.amplitude: Amplitudes = np.zeros((count, basis.functions.shape[1]), complex)
        self.gain: Array = np.zeros(count)
        self.misfit: Array = np.full(count, np.inf)
        self.light: Complex = np.zeros(len(phasors.value), np.complex64)
        self._solved = np.zeros(count, dtype=bool)
        self._enough = enough(phasors)

    @property
    def _most_light(self) -> Complex:
        return self.light[::_SEARCH_STRIDE]

    def starts(self) -> Iterator[tuple[Steps, Sequence[_Guess]]]:
        """Holograms to begin with, each set with guesses.

        First those at the low end of the sweep, where a reed moves much like its first mode at
        rest, if they are calm; then the same, calm or not; at last all calm ones, of which the
        lowest and the clearest may resemble any of their neighbours.
        """
        signal = np.sqrt(np.maximum(np.mean(self._magnitude**2, axis=0) - 1, 0))
        clear = signal > _LEAST_SIGNAL
        low = np.flatnonzero(clear & (self._shown < _STILL_LINEAR))
        if low.size and not clear[: low[0]].any():
            together = low[: int(np.argmax(np.diff([*low, np.inf]) > 1)) + 1]
            yield together, [_Guess(int(low[0]), self._near(low[0])[0])]
        if clear.any():
            first = int(np.argmax(clear))
            few = np.flatnonzero(clear[first : first + _FRINGED]) + first
            mode = self._near(first)[0]
            yield few, [_Guess(first, mode, float(rad)) for rad in _FRINGES_RAD]
        calm = np.flatnonzero(clear & (self._shown < _CALM))
        if calm.size:
            firsts = (calm[0], calm[np.argmax(signal[calm])])
            yield calm, [_Guess(int(k), mode) for k in firsts for mode in self._near(k)[:4]]

    def _near(self, step: int) -> list[int]:
        """Modes, the nearest to a hologram first."""
        return [int(m) for m in np.argsort(np.abs(self._mode_cents - self._cents[step]))]

    def begin(self, few: Steps, guesses: Iterable[_Guess]) -> None:
        """Solve some holograms from the best of some guesses."""
        self.amplitude[:], self.gain[:], self.misfit[:] = 0, 0, np.inf
        self._solved[:] = False
        best = np.inf
        for guess in guesses:
            light, a, left = self._calm(few, guess)
            if left.sum() < best:
                best = float(left.sum())
                self.light, self.amplitude[few] = light, a
                self.misfit[few] = left / self._most.blocks

    @property
    def solution(self) -> Solution:
        """As far as it has come."""
        return Solution(self.amplitude, self.gain, self.light)

    def go_on_with(self, solution: Solution, misfit: Array) -> None:
        """Go on from a better solution, with misfits (k,), to what it does not explain."""
        self.amplitude, self.gain, self.light = (
            solution.amplitude.copy(), solution.gain.copy(), solution.light
        )  # fmt: skip
        self.misfit = misfit.copy()
        self._solved[:] = False
        self.spread()
        self._revise()

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Which holograms (k,) are."""
        return self._solved

    @property
    def explained(self) -> NDArray[np.bool_]:
        """Which holograms (k,) are, down to their noise: they are in the right fringe."""
        return self.misfit < _THRESHOLDS[0][0]

    @property
    def best_explained(self) -> NDArray[np.bool_]:
        """Which holograms (k,) are, as well as most of those that are solved."""
        usual = max(float(np.median(self.misfit[self._solved])), 1.0)
        return self.misfit < _THRESHOLDS[0][0] * usual

    def _calm(self, few: Steps, guess: _Guess) -> tuple[Complex, Amplitudes, Array]:
        """Light and amplitudes of some holograms, in turns, and their misfits."""
        shape = self._basis.shapes[guess.mode]
        u = self._basis.functions @ shape * np.float32(guess.largest_rad)
        over, _ = self.whole.bessel.tensor(np.abs(u))
        turn = np.exp(1j * np.angle(self._value[:, guess.hologram])) * np.sign(u * over)
        light = (self._brightest * turn).astype(np.complex64)
        gain: Array = np.zeros(len(few))
        if guess.largest_rad > _LINEAR_RAD:
            self.light = light
            scales = guess.largest_rad * _SCALES
            a = np.array([self._on_grid(int(k), shape, scales)[1][0] for k in few])
            size = _size(a)
        else:
            a = np.zeros((len(few), self.amplitude.shape[1]), complex)
            # F(u) is half of u there.
            relative = self._magnitude[:, few] / self._brightest[:, None]
            size = 2 * np.sqrt(np.mean(relative**2, axis=0))
        prior = self._prior(few, size)
        for turn_number in range(_CALM_TURNS):
            a, _, left = descend(
                self._most, light[::_SEARCH_STRIDE], few, (a, gain), 1 if turn_number else 2, prior
            )
            light = block_light(self.whole, few, a, gain, np.ones(len(few)))
            # Where the reed is liveliest some hologram of the sweep has shown the first lobe.
            liveliness = np.sum(np.square(self.whole.phasors(a)), axis=(0, 1))
            lively = liveliness > np.percentile(liveliness, _LIVELIEST)
            scale = float(np.median(self._brightest[lively] / np.abs(light[lively])))
            light, a = light * np.float32(scale), a / scale
        return light, a, left

    def _prior(self, steps: Steps, size: Array) -> Array:
        """Precision (s, j, j) of the amplitudes of holograms of given sizes (s,), rms in rad.

        Light that varies smoothly over the reed looks like another shape, the more so the less
        fringes there are. What a mode may contribute is therefore held to what it has under any
        pressure: its compliance, times how near it is to its resonance.
        """
        ratio = 2 ** ((self._cents[steps, None] - self._mode_cents) / 600)
        moving = 2 ** (self._mode_cents / -600) / np.maximum(np.abs(1 - ratio), _SHARPEST)
        moving = _ROOM * moving / moving.max(axis=1, keepdims=True)
        shapes = self._basis.shapes
        spread = np.einsum("sm,mi,mj->sij", moving**2, shapes, shapes, optimize=True)
        spread += _OTHER_SHAPES**2 * np.eye(shapes.shape[1])
        precision: Array = np.linalg.inv(spread) / size[:, None, None] ** 2
        return precision

    def spread(self) -> None:
        """Solve hologram after hologram beside those that are solved."""
        self._go_on()
        if not self._solved.all() and self._solve_calm():
            self._go_on()

    def _go_on(self) -> None:
        """From neighbour to neighbour, the better ones first."""
        # Which lights each pair has been tried in.
        tried: dict[tuple[int, int], list[int]] = {}
        light = 0

        def to_be_tried(pair: tuple[int, int]) -> bool:
            lights = tried.get(pair, [])
            return light not in lights and len(lights) < _MOST_LIGHTS

        for threshold, reach in _THRESHOLDS:
            good = np.maximum(self._enough, threshold)
            self._solved |= self.misfit < good
            self._relight()
            lit, light = int(self._solved.sum()), light + 1
            while frontier := [pair for pair in self._frontier(reach) if to_be_tried(pair)]:
                for step, source in frontier:
                    if self._solved[step]:
                        continue
                    tried.setdefault((step, source), []).append(light)
                    self._solve(step, source)
                    self._solved[step] = self.misfit[step] < good[step]
                    if self._solved.sum() > _MORE_SOLVED * lit + 2:
                        self._relight(1)
                        lit, light = int(self._solved.sum()), light + 1

    def _solve_calm(self) -> bool:
        """Solve calm holograms beyond those that nobody can: with known light they are linear."""
        start = np.zeros((1, self.amplitude.shape[1]), complex)
        calm = np.flatnonzero(~self._solved & (self._shown < _STILL_LINEAR))
        for step in calm:
            self.attempt(int(step), start, ((self._most, _SEARCH_STRIDE, DESCENT),))
        return bool((self.misfit[calm] < _THRESHOLDS[0][0]).any())

    def _revise(self) -> None:
        """Try holograms that are explained worse than a neighbour once more from that side."""
        last = len(self.misfit) - 1
        for step in np.argsort(-self.misfit):
            for source in (step - 1, step + 1):
                if not 0 <= source <= last or not self._solved[source]:
                    continue
                if self.misfit[step] > ALIKE * max(float(self.misfit[source]), 1):
                    self._solve(int(step), int(source))

    def _frontier(self, reach: int) -> list[tuple[int, int]]:
        """Unsolved holograms, each with a solved one not farther off than that."""
        last = len(self._solved) - 1
        return [
            (step, int(source))
            for source in np.flatnonzero(self._solved)
            for step in range(int(source) - reach, int(source) + reach + 1)
            if 0 <= step <= last and not self._solved[step]
        ]

    def _relight(self, turns: int = 2) -> None:
        """Find the light anew from what is solved, and what is solved from the light."""
        solved = np.flatnonzero(self._solved)
        if not solved.size:
            return
        for _ in range(turns):
            weight = 1 / np.maximum(self.misfit[solved], 1)
            start = self.amplitude[solved], self.gain[solved]
            self.light = block_light(self.whole, solved, *start, weight)
            self.amplitude[solved], self.gain[solved], left = descend(
                self._most, self._most_light, solved, start, 2, self._prior(solved, _size(start[0]))
            )
            self.misfit[solved] = left / self._most.blocks
            # What all gains have in common is light.
            common = float(np.mean(self.gain[solved]))
            self.gain[solved] -= common
            self.light = self.light * np.float32(np.exp(common))

    def _solve(self, step: int, source: int) -> None:
        """Try to find the amplitudes of one hologram from those of a neighbour."""
        neighbour = self.amplitude[source]
        scaled = self._on_grid(step, neighbour, _SCALES)[1][0]
        trend = self.trend(step, source)
        quick = np.array([scaled] if trend is None else [trend, scaled])
        self.attempt(step, quick, ((self._most, _SEARCH_STRIDE, _QUICK),), trend)
        if self.misfit[step] < ALIKE * max(float(self.misfit[source]), 1):
            return
        starts = np.array([neighbour, *self._starts(step, neighbour)])
        self.attempt(
            step,
            starts,
            ((self._few, _GRID_STRIDE, DESCENT), (self._most, _SEARCH_STRIDE, DESCENT)),
        )

    def trend(self, step: int, source: int) -> Amplitudes | None:
        """Amplitudes (j,) of a neighbour, if they go on growing or shrinking as they did before."""
        before = 2 * source - step
        if not (0 <= before < len(self._solved) and self._solved[before]):
            return None
        size, former = _size(self.amplitude[[source, before]])
        a = self.amplitude[source] * np.clip(size / former, 1 / _STEEPEST, _STEEPEST)
        light = self.light[::_GRID_STRIDE]
        (turned,) = self._few.turned(light, np.array([step]), a[None])
        return np.asarray(turned)

    def attempt(
        self,
        step: int,
        a: Amplitudes,
        levels: tuple[tuple[Problem, int, int], ...],
        near: Amplitudes | None = None,
    ) -> None:
        """Descend from some starts to one hologram's amplitudes, and keep them if they are better.

        Parameters
        ----------
        step : int
        a : (s, j) complex
            Starts; after every level the two best go on.
        levels : tuple of (problem, stride, turns)
            First with few of the blocks.
        near : (j,) complex, optional
            What is expected.

        Notes
        -----
        Of two that explain the hologram alike the one that is nearer to what is expected is taken,
        if that is told: where phasors fall again beyond 1.84 rad displacements may fold back, and
        be as smooth as noise lets them be.
        """
        gain: Array = np.zeros(len(a))
        for problem, stride, turns in levels:
            steps, light = np.full(len(a), step), self.light[::stride]
            prior = self._prior(steps, _size(a))
            a, gain, left = descend(problem, light, steps, (a, gain), turns, prior)
            best = np.argsort(left)[:2]
            a, gain = a[best], gain[best]
            found = left[best] / problem.blocks
        first = 0
        if near is not None and len(a) > 1 and found[1] < ALIKE * max(found[0], 1):
            first = int(np.argmin(np.linalg.norm(a - near, axis=1)))
        if found[first] < self.misfit[step]:
            self.amplitude[step], self.gain[step], self.misfit[step] = (
                a[first], gain[first], found[first]
            )  # fmt: skip

    def _starts(self, step: int, neighbour: Amplitudes) -> list[Amplitudes]:
        """Likeliest changes of a neighbour's amplitudes: of one shape, or of all by a factor."""
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
        self, step: int, part: Amplitudes, grid: Complex, fixed: Amplitudes | None = None
    ) -> tuple[list[float], list[Amplitudes]]:
        """Best three of ``[fixed +] factor · part`` over factors (g,), and their misfits."""
        few = self._few
        if fixed is None:
            fixed = np.zeros_like(part)
        u, v = few.displacement(np.stack([part, fixed]))
        light = self.light[::_GRID_STRIDE]
        power = light.real**2 + light.imag**2
        pull = light.conj() * self._value[::_GRID_STRIDE, step]
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


def solve(whole: Problem, phasors: Phasors, basis: ShapeBasis) -> Search:
    """Solve the sweep, of one sideband, from one start after another, until most of it is."""

    def begun(start: tuple[Steps, Sequence[_Guess]]) -> Search:
        search = Search(whole, phasors, basis)
        search.begin(*start)
        search.spread()
        return search

    best: Search | None = None
    with closing(map_processes(begun, list(Search(whole, phasors, basis).starts()))) as searches:
        for search in searches:
            if best is None or search.explained.sum() > best.explained.sum():
                best = search
            if best.explained.mean() > (_ALL_SOLVED if best.solved.all() else _MOST_EXPLAINED):
                break
    if best is None or best.solved.mean() < _LEAST_SOLVED:
        solved = int(best.solved.sum()) if best else 0
        raise FitError(
            f"only {solved} of {len(phasors.drive_hz)} holograms can be explained as vibrations of "
            "this reed: none shows any light, or there are too many fringes; begin with less volts"
        )
    return best


def enough(phasors: Phasors) -> Array:
    """Misfits (k,) that holograms may have at least.

    Where displacements grow by many radians within a block phasors are no longer those of one
    place, and leave more than noise: a share of the light.
    """
    share: Array = _ENOUGH * np.mean(np.abs(phasors.value) ** 2, axis=0)
    return share
