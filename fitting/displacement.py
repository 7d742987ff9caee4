"""From phasors to displacement: the complex vibration of the whole reed in every hologram.

The phasors of a block are ``A c_k F(u_k)`` (see `fitting.phasors`): its light A is unknown and the
same in all holograms, c_k a phase of the hologram, ``u_k = Σ_j a_kj Φ_j`` the complex phase
amplitude there, made of few functions Φ. Light and amplitudes are found in turns by least squares;
the phase of a hologram is that of its amplitudes, for ``F(u e^{iθ}) = F(u) e^{iθ}``.

The problem is not convex: beyond |u| = 1.84 phasors fall and turn over. It is solved from the calm
holograms outwards, in which all is linear. Each hologram starts from a solved neighbour in
frequency: near resonances one shape grows by some factor and turns by some angle between them, at
a line of the air all shapes grow together; both are searched on grids finer than a fringe.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.bessel import BesselTable
from fitting.errors import FitError
from fitting.phasors import Phasors
from fitting.shapes import ShapeBasis

Array = NDArray[np.floating[Any]]
Float = NDArray[np.float32]
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
# So much of a sweep is enough not to begin it again otherwise.
_MOST_SOLVED = 0.9
_LEAST_SIGNAL = 1.5
# Prior standard deviation of a hologram's gain, in nepers: laser and modulators drift.
_GAIN = 0.05
_GAIN_HELD = 0.5 * _GAIN**-2
# Prior standard deviation of amplitudes, rad: only against what the data do not tell at all.
_FINAL_RAD = 10.0
# Of all blocks, every third serves the search, every ninth the grids.
_SEARCH_STRIDE, _GRID_STRIDE = 3, 9
# Grid of one shape's amplitude: step in radius, angles, and how far beyond the neighbour's.
_RADIUS_STEP_RAD, _ANGLES, _BEYOND, _ROOM_RAD = 0.35, 12, 2.0, 5.0
_SCALES = np.geomspace(0.3, 3.2, 36)
# Modes this near to a hologram, besides the liveliest of its neighbour, may be resonating.
_NEAR_CENTS = 350.0
_STARTS, _DESCENT = 5, 6
_CALM_TURNS, _FINAL_TURNS = 5, 6
# Resonances are no sharper than this; modes may be livelier than expected by this factor; and what
# shapes that are not the finite elements' may add, a share.
_SHARPEST, _ROOM, _OTHER_SHAPES = 0.1, 5.0, 0.05
# Misfits, as reduced χ², that holograms may have to be handed on, the better ones first; and how
# far: at last beyond some that cannot be solved.
_THRESHOLDS = ((2.5, 1), (4.0, 1), (8.0, 1), (20.0, 1), (20.0, 3))
# Or the share of the light that may be left.
_ENOUGH = 0.03
# The light is found anew when so many more holograms have been solved.
_MORE_SOLVED = 1.15
# Beyond this a hologram has not reached the floor of its noise.
_FLOOR = 30.0


@dataclass(frozen=True)
class Displacements:
    """Complex phase amplitudes of every hologram, and what is known of them.

    Attributes
    ----------
    amplitude_rad : (k, j) complex128
        Coordinates of u in a `ShapeBasis`; the phase common to one hologram is arbitrary.
    information : (k, 2j, 2j) float
        Inverse covariance of their real, then imaginary parts, from noise and misfit.
    misfit : (k,) float
        Mean square of what is left of the phasors, in units of the noise: 1 is noise alone.
    light : (n,) complex64
        Of each block, in units of the noise.
    reached : (k,) bool
        Whether the fit of a hologram has come near to its noise.
    """

    amplitude_rad: Amplitudes
    information: Array
    misfit: Array
    light: Complex
    reached: NDArray[np.bool_]


@dataclass(frozen=True)
class _Problem:
    """Phasors (n, k), functions (n, j) and their products in pairs (n, j(j+1)/2)."""

    value: Complex
    functions: Float
    pairs: Float
    bessel: BesselTable

    @classmethod
    def of(cls, value: Complex, functions: Float, bessel: BesselTable) -> "_Problem":
        one, other = np.triu_indices(functions.shape[1])
        return cls(value, functions, functions[:, one] * functions[:, other], bessel)

    def every(self, stride: int) -> "_Problem":
        """Return the same problem for some of the blocks."""
        # Whole arrays of their own: products with strided ones take several times as long.
        return _Problem(
            np.ascontiguousarray(self.value[::stride]),
            np.ascontiguousarray(self.functions[::stride]),
            np.ascontiguousarray(self.pairs[::stride]),
            self.bessel,
        )

    def phasors(self, a: Amplitudes) -> Complex:
        """F(u) of amplitudes (s, j) at all blocks, (s, n)."""
        u = a.astype(np.complex64) @ self.functions.T
        over, _ = self.bessel.over_argument(np.abs(u))
        moved: Complex = u * over
        return moved


@dataclass
class _Normal:
    """Normal equations of some holograms, by real and imaginary parts of amplitudes and log gain.

    Misfits (s,), gradients (s, 2j + 1), matrices (s, 2j + 1, 2j + 1).
    """

    misfit: Array
    gradient: Array
    matrix: Array

    def take_over(self, better: NDArray[np.bool_], other: "_Normal") -> None:
        """Replace those of the holograms that are better."""
        self.misfit[better] = other.misfit[better]
        self.gradient[better] = other.gradient[better]
        self.matrix[better] = other.matrix[better]


def _normal(problem: _Problem, light: Complex, steps: Steps, a: Amplitudes, gain: Array) -> _Normal:
    """Linearise the phasors of holograms (s,) around amplitudes (s, j) and log gains (s,)."""
    u = a.astype(np.complex64) @ problem.functions.T
    phi = np.abs(u)
    over, slope = problem.bessel.over_argument(phi)
    lit = np.exp(gain).astype(np.float32)[:, None] * light
    moved = u * over
    residual = problem.value[:, steps].T - lit * moved
    # dF = ½(J₁′ + J₁/φ) du + ½(J₁′ − J₁/φ) e^{2iθ} du*, by the real and imaginary parts of du.
    turn = np.divide(u, phi, out=np.zeros_like(u), where=phi > 0)
    mean, half = 0.5 * (slope + over), 0.5 * (slope - over) * turn * turn
    real, imaginary = mean + half, mean - half
    power = lit.real**2 + lit.imag**2
    size = problem.functions.shape[1]
    matrix = np.empty((len(a), 2 * size + 1, 2 * size + 1))
    cross = (real.conj() * imaginary * 1j).real
    for (row, column), weight in (
        ((0, 0), real.real**2 + real.imag**2),
        ((0, 1), cross),
        ((1, 1), imaginary.real**2 + imaginary.imag**2),
    ):
        block = _square((power * weight) @ problem.pairs, size)
        matrix[:, row * size :, column * size :][:, :size, :size] = block
        matrix[:, column * size :, row * size :][:, :size, :size] = block
    beside = ((real.conj() * moved).real, (imaginary.conj() * moved).imag)
    coupling = np.concatenate([(power * part) @ problem.functions for part in beside], axis=1)
    matrix[:, -1, :-1] = matrix[:, :-1, -1] = coupling
    matrix[:, -1, -1] = np.sum(power * (moved.real**2 + moved.imag**2), axis=1)
    pulled = lit.conj() * residual
    parts = ((real.conj() * pulled).real, (imaginary.conj() * pulled).imag)
    louder = np.sum((moved.conj() * pulled).real, axis=1)
    gradient = np.concatenate(
        [*(part @ problem.functions for part in parts), louder[:, None]], axis=1
    )
    misfit = np.einsum("sn,sn->s", residual.conj(), residual).real.astype(float)
    return _Normal(misfit, gradient.astype(float), matrix)


def _square(packed: Array, size: int) -> Array:
    """Symmetric matrices (s, j, j) from their upper triangles (s, j(j+1)/2)."""
    whole = np.empty((len(packed), size, size))
    one, other = np.triu_indices(size)
    whole[:, one, other] = whole[:, other, one] = packed
    return whole


def _descend(
    problem: _Problem,
    light: Complex,
    steps: Steps,
    start: tuple[Amplitudes, Array],
    count: int,
    prior: Array,
) -> tuple[Amplitudes, Array, _Normal]:
    """Levenberg and Marquardt on all holograms side by side, each with its own damping.

    From amplitudes (s, j) and log gains (s,) to better ones. The prior is the precision of
    amplitudes around 0, (j, j) or (s, j, j).
    """
    a, gain = start
    size = a.shape[1]
    held = np.zeros((len(a), 2 * size + 1, 2 * size + 1))
    # Half of it: the misfit, of noise of variance 1, is half of χ².
    held[:, :size, :size] = held[:, size:-1, size:-1] = 0.5 * prior
    held[:, -1, -1] = _GAIN_HELD

    def belief(x: Array) -> Array:
        beliefs: Array = np.einsum("si,sij,sj->s", x, held, x, optimize=True)
        return beliefs

    def normal_at(x: Array) -> _Normal:
        return _normal(problem, light, steps, x[:, :size] + 1j * x[:, size:-1], x[:, -1])

    x = np.concatenate([a.real, a.imag, gain[:, None]], axis=1)
    normal = normal_at(x)
    total = normal.misfit + belief(x)
    damping = np.full(len(a), 1e-3)
    diagonal = np.arange(2 * size)
    for _ in range(count):
        damped = normal.matrix + held
        mean = np.trace(normal.matrix[:, :-1, :-1], axis1=1, axis2=2) / (2 * size)
        damped[:, diagonal, diagonal] += (damping * mean + 1e-3)[:, None]
        pull = normal.gradient - np.einsum("sij,sj->si", held, x)
        tried_x = x + np.linalg.solve(damped, pull[..., None])[..., 0]
        tried = normal_at(tried_x)
        tried_total = tried.misfit + belief(tried_x)
        better = tried_total < total
        x[better], total[better] = tried_x[better], tried_total[better]
        normal.take_over(better, tried)
        damping = np.where(better, 0.2 * damping, np.minimum(6 * damping, 1e6))
    return x[:, :size] + 1j * x[:, size:-1], x[:, -1], normal


def _light(problem: _Problem, steps: Steps, a: Amplitudes, gain: Array, weight: Array) -> Complex:
    """Light (n,) of every block by least squares over holograms (s,) of given weights."""
    root = np.sqrt(weight).astype(np.float32)[:, None]
    moved = problem.phasors(a) * np.exp(gain).astype(np.float32)[:, None] * root
    seen = problem.value[:, steps].T * root
    power = np.sum(moved.real**2 + moved.imag**2, axis=0)
    light: Complex = np.sum(moved.conj() * seen, axis=0) / np.maximum(power, np.float32(1e-9))
    return light


def _size(a: Amplitudes) -> Array:
    """Root of the mean square (s,) of displacements over the reed, at least a tenth of a rad."""
    size: Array = np.maximum(np.sqrt(np.sum(np.abs(a) ** 2, axis=1)), 0.1)
    return size


class _Search:
    """Amplitudes, misfits and light of a sweep while its holograms are solved one after another."""

    def __init__(self, phasors: Phasors, basis: ShapeBasis) -> None:
        whole = _Problem.of(phasors.value, basis.functions, BesselTable())
        self.whole, self._most, self._few = (
            whole, whole.every(_SEARCH_STRIDE), whole.every(_GRID_STRIDE)
        )  # fmt: skip
        self._basis = basis
        self._magnitude = np.abs(phasors.value)
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
        # Of the light, in units of the noise: where displacements grow by many radians within a
        # block phasors are no longer those of one place, and leave more than noise.
        self._enough = _ENOUGH * np.mean(np.abs(phasors.value) ** 2, axis=0)

    @property
    def _most_light(self) -> Complex:
        return self.light[::_SEARCH_STRIDE]

    def starts(self) -> Iterator[tuple[Steps, Iterator[tuple[int, int]]]]:
        """Calm holograms to begin with, each set with guesses: a hologram, and the mode it shows.

        First those at the low end of the sweep, where a reed moves much like its first mode at
        rest; then all of them, of which the lowest and the clearest may resemble any of their
        neighbours.
        """
        signal = np.sqrt(np.maximum(np.mean(self._magnitude**2, axis=0) - 1, 0))
        clear = signal > _LEAST_SIGNAL
        low = np.flatnonzero(clear & (self._shown < _STILL_LINEAR))
        if low.size:
            together = low[: int(np.argmax(np.diff([*low, np.inf]) > 1)) + 1]
            nearest = np.argsort(np.abs(self._mode_cents - self._cents[low[0]]))
            yield together, ((int(low[0]), int(mode)) for mode in nearest[:1])
        calm = np.flatnonzero(clear & (self._shown < _CALM))
        if calm.size:
            firsts = (calm[0], calm[np.argmax(signal[calm])])
            yield (
                calm,
                (
                    (int(first), int(mode))
                    for first in firsts
                    for mode in np.argsort(np.abs(self._mode_cents - self._cents[first]))[:4]
                ),
            )

    def begin(self, calm: Steps, guesses: Iterable[tuple[int, int]]) -> None:
        """Solve the calm holograms from the best of some guesses."""
        self.amplitude[:], self.gain[:], self.misfit[:] = 0, 0, np.inf
        self._solved[:] = False
        # F(u) is half of u there.
        relative = self._magnitude[:, calm] / self._brightest[:, None]
        prior = self._prior(calm, 2 * np.sqrt(np.mean(relative**2, axis=0)))
        best = np.inf
        for first, mode in guesses:
            shape = self._basis.functions @ self._basis.shapes[mode]
            turn = np.exp(1j * np.angle(self.whole.value[:, first])) * np.sign(shape)
            start = (self._brightest * turn).astype(np.complex64)
            light, a, normal = self._calm(calm, start, prior)
            if normal.misfit.sum() < best:
                best = float(normal.misfit.sum())
                self.light, self.amplitude[calm] = light, a
                self.misfit[calm] = normal.misfit / len(self._most.value)

    @property
    def solved_share(self) -> float:
        """Share of the holograms that are solved."""
        return float(np.mean(self._solved))

    def _calm(
        self, calm: Steps, light: Complex, prior: Array
    ) -> tuple[Complex, Amplitudes, _Normal]:
        """Light and amplitudes of the calm holograms, in turns."""
        brightest, gain = np.abs(light), np.zeros(len(calm))
        a: Amplitudes = np.zeros((len(calm), self.amplitude.shape[1]), complex)
        for turn in range(_CALM_TURNS):
            a, _, normal = _descend(
                self._most, light[::_SEARCH_STRIDE], calm, (a, gain), 1 if turn else 2, prior
            )
            light = _light(self.whole, calm, a, gain, np.ones(len(calm)))
            # Where the reed is liveliest some hologram of the sweep has shown the first lobe.
            liveliness = np.sum(np.abs(self.whole.phasors(a)) ** 2, axis=0)
            lively = liveliness > np.percentile(liveliness, _LIVELIEST)
            scale = float(np.median(brightest[lively] / np.abs(light[lively])))
            light, a = light * np.float32(scale), a / scale
        return light, a, normal

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
        tried: dict[tuple[int, int], int] = {}
        for threshold, reach in _THRESHOLDS:
            good = np.maximum(self._enough, threshold)
            self._solved |= self.misfit < good
            self._relight()
            lit = int(self._solved.sum())
            while frontier := [pair for pair in self._frontier(reach) if tried.get(pair, -1) < lit]:
                for step, source in frontier:
                    if self._solved[step]:
                        continue
                    tried[step, source] = lit
                    self._solve(step, source)
                    self._solved[step] = self.misfit[step] < good[step]
                    if self._solved.sum() > _MORE_SOLVED * lit + 2:
                        self._relight()
                        lit = int(self._solved.sum())

    def _frontier(self, reach: int) -> list[tuple[int, int]]:
        """Unsolved holograms, each with a solved one not farther off than that."""
        last = len(self._solved) - 1
        return [
            (step, int(source))
            for source in np.flatnonzero(self._solved)
            for step in range(int(source) - reach, int(source) + reach + 1)
            if 0 <= step <= last and not self._solved[step]
        ]

    def _relight(self) -> None:
        """Find the light anew from what is solved, and what is solved from the light."""
        solved = np.flatnonzero(self._solved)
        if not solved.size:
            return
        for _ in range(2):
            weight = 1 / np.maximum(self.misfit[solved], 1)
            start = self.amplitude[solved], self.gain[solved]
            self.light = _light(self.whole, solved, *start, weight)
            self.amplitude[solved], self.gain[solved], normal = _descend(
                self._most, self._most_light, solved, start, 2, self._prior(solved, _size(start[0]))
            )
            self.misfit[solved] = normal.misfit / len(self._most.value)
            # What all gains have in common is light.
            common = float(np.mean(self.gain[solved]))
            self.gain[solved] -= common
            self.light = self.light * np.float32(np.exp(common))

    def _solve(self, step: int, source: int) -> None:
        """Try to find the amplitudes of one hologram from those of a neighbour."""
        starts = [self.amplitude[source], *self._starts(step, self.amplitude[source])]
        a: Amplitudes = np.array(starts)
        gain: Array = np.zeros(len(starts))
        for problem, stride in ((self._few, _GRID_STRIDE), (self._most, _SEARCH_STRIDE)):
            steps, light = np.full(len(a), step), self.light[::stride]
            prior = self._prior(steps, _size(a))
            a, gain, normal = _descend(problem, light, steps, (a, gain), _DESCENT, prior)
            best = np.argsort(normal.misfit)[:2]
            a, gain = a[best], gain[best]
            found = normal.misfit[best[0]] / len(problem.value)
        if found < self.misfit[step]:
            self.amplitude[step], self.gain[step], self.misfit[step] = a[0], gain[0], found

    def _starts(self, step: int, neighbour: Amplitudes) -> list[Amplitudes]:
        """Likeliest changes of a neighbour's amplitudes: of one shape, or of all by a factor."""
        likely = list(zip(*self._on_grid(step, neighbour[None], _SCALES), strict=True))
        near = np.abs(self._mode_cents - self._cents[step]) < _NEAR_CENTS
        shapes = self._basis.shapes
        liveliness = np.abs(shapes @ neighbour.conj()) / np.linalg.norm(shapes, axis=1)
        near[np.argmax(liveliness)] = True
        for shape in shapes[near]:
            now = complex(shape @ neighbour / (shape @ shape))
            rest = neighbour - now * shape
            radius = np.arange(0.2, _BEYOND * abs(now) + _ROOM_RAD, _RADIUS_STEP_RAD)
            angles = np.exp(2j * np.pi * np.arange(_ANGLES) / _ANGLES)
            grid = (radius[:, None] * angles).ravel()
            likely += zip(*self._on_grid(step, np.stack([rest, shape]), grid), strict=True)
        likely.sort(key=lambda start: start[0])
        return [start for _, start in likely[: _STARTS - 1]]

    def _on_grid(
        self, step: int, parts: Amplitudes, grid: Array
    ) -> tuple[list[float], list[Amplitudes]]:
        """Best three of ``[fixed +] factor · part`` over factors (g,), and their misfits."""
        u = parts.astype(np.complex64) @ self._few.functions.T
        whole = grid.astype(np.complex64)[:, None] * u[-1] + (u[0] if len(parts) > 1 else 0)
        over, _ = self._few.bessel.over_argument(np.abs(whole))
        expected = self.light[::_GRID_STRIDE] * (whole * over)
        overlap = expected.conj() @ self._few.value[:, step]
        # The phase of the hologram is free.
        misfit = np.sum(expected.real**2 + expected.imag**2, axis=1) - 2 * np.abs(overlap)
        best = np.argsort(misfit)[:3]
        fixed = parts[0] if len(parts) > 1 else 0
        found = [(fixed + grid[g] * parts[-1]) * np.exp(1j * np.angle(overlap[g])) for g in best]
        return [float(misfit[g]) for g in best], found


def _solved(phasors: Phasors, basis: ShapeBasis) -> _Search:
    """Solve the sweep from one start after another, until most of it is solved."""
    best: _Search | None = None
    search = _Search(phasors, basis)
    for calm, guesses in search.starts():
        search.begin(calm, guesses)
        search.spread()
        if best is None or search.solved_share > best.solved_share:
            best = search
        if best.solved_share > _MOST_SOLVED:
            break
        search = _Search(phasors, basis)
    if best is None:
        raise FitError(
            "every hologram shows fringes from the clamp to the tip, or none shows any light; "
            "begin the sweep with less volts"
        )
    return best


def fit_displacements(phasors: Phasors, basis: ShapeBasis) -> Displacements:
    """Find the vibration of the whole reed in every hologram of a sweep.

    Parameters
    ----------
    phasors : Phasors
    basis : ShapeBasis
        At the points of the phasors.

    Raises
    ------
    FitError
        If no hologram is calm enough to begin with.
    """
    search = _solved(phasors, basis)
    steps = np.arange(len(phasors.drive_hz))
    a, gain, light = search.amplitude, search.gain, search.light
    size = a.shape[1]
    weak = _FINAL_RAD**-2 * np.eye(size)
    for _ in range(_FINAL_TURNS):
        a, gain, normal = _descend(search.whole, light, steps, (a, gain - np.mean(gain)), 2, weak)
        misfit = normal.misfit / len(phasors.value)
        light = _light(search.whole, steps, a, gain, 1 / np.maximum(misfit, 1))
    # The gain of a hologram is nobody's concern any more; it takes information with it.
    coupling, known = normal.matrix[:, :-1, -1:], normal.matrix[:, -1, -1] + _GAIN_HELD
    told = normal.matrix[:, :-1, :-1] - coupling @ coupling.swapaxes(1, 2) / known[:, None, None]
    louder = normal.gradient[:, -1] - gain * _GAIN_HELD
    pull = normal.gradient[:, :-1] - coupling[..., 0] * (louder / known)[:, None]
    # What the prior holds back is given free: only the data may speak.
    x = np.concatenate([a.real, a.imag], axis=1)
    x = x + np.linalg.solve(told + np.kron(np.eye(2), weak), pull[..., None])[..., 0]
    # Noise of variance 1 has half of it in either part.
    information = 2 * told / np.maximum(misfit, 1)[:, None, None]
    return Displacements(
        amplitude_rad=x[:, :size] + 1j * x[:, size:],
        information=information,
        misfit=misfit,
        light=light,
        reached=misfit < _FLOOR,
    )
