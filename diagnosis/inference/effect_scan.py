"""Evidence of one effect: its strength on a scale of logarithms, everything else in between.

The model is computed at a few strengths and interpolated; what second parameters of an effect
change is linear at each strength. Nuisances are marginalised exactly (`linear_model`), so that the
integral over the strength is a sum along one line for each direction and location. No search can
end in a wrong optimum, and an effect that is too small to be seen has the evidence of none.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp

from diagnosis.inference.linear_model import LinearModel, Weighed, weigh
from diagnosis.inference.problem import InferenceProblem, LocatedEffect
from holography.arrays import Array
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters

# Strengths, as shares of the largest, at which the model is computed. Chosen: a cubic through them
# is within some per cent of what effects do, less than their own form is uncertain by.
_NODES = (0.02, 0.06, 0.15, 0.3, 0.6, 1.0)
# Smallest strength that counts, as a share of the largest, and the number of strengths summed over.
# Chosen: two decades; steps of 4 % of strength, less than a standard error at 20 of them.
_LEAST, _STEPS = 0.01, 120
# An effect with a location is first computed everywhere at one strength, then at the best places.
_PROBE, _PLACES = 3, 4
# Step of second parameters, in their standard deviations.
_SECOND = 0.3
# Effects have not quite the form that the catalogue gives them: a share of what they do (0018).
FORM = 0.12
# Iterations of the scales, which begin at those without the effect.
_TURNS = 10


@dataclass(frozen=True)
class Start:
    """A model to which effects are added.

    Attributes
    ----------
    parameters : BenchParameters
    residuals : (n,) float
        Whitened.
    model : LinearModel
        Around these parameters.
    weighed : Weighed
        The same with the likeliest scales.
    """

    parameters: BenchParameters
    residuals: Array
    model: LinearModel
    weighed: Weighed

    @classmethod
    def at(cls, problem: InferenceProblem, z: Array) -> "Start":
        """Return the model with nuisances z (p,) and without effects."""
        parameters = problem.parameters(z)
        residuals = problem.residuals(parameters)
        model = problem.linear_model(residuals, problem.jacobian(z), z)
        return cls(parameters, residuals, model, weigh(model))


@dataclass(frozen=True)
class Scan:
    """An effect, scanned.

    Attributes
    ----------
    located : LocatedEffect
        At its best location.
    sizes : (s,) float
        Likeliest sizes there, in units of their scales.
    gain : float
        Log evidence over that of the start, all strengths, directions and locations together.
    signature : (n, s) float
        What one scale of each size changes, whitened, by the smallest strength that was computed.
    columns : (n, c) float
        What second parameters change at these sizes, in units of the noise.
    shift : (n,) float
        What the sizes change, in units of the noise.
    """

    located: LocatedEffect
    sizes: Array
    gain: float
    signature: Array
    columns: Array
    shift: Array


def scan_effect(problem: InferenceProblem, start: Start, effect: Effect) -> Scan | None:
    """Scan an effect over all strengths, directions and locations; None if it changes nothing.

    Locations without a possible reed are left out.
    """
    places = list(locations_of(effect))
    lines = [_Line(problem, start, place, d) for place in places for d in _directions(effect)]
    if len(places) > 1:
        lines = _best_lines(lines)
    swept = [found for line in lines if (found := line.swept()) is not None]
    if not swept:
        return None
    best = max(swept, key=lambda one: one.most)
    # Where nothing was swept, the effect has the evidence of none.
    every = len(_directions(effect)) * len(places)
    means = np.array([0.0] * (every - len(swept)) + [one.mean for one in swept])
    return best.scan(float(logsumexp(means)) - math.log(every))


class _Line:
    """One effect at one location along one direction of its strengths."""

    def __init__(
        self,
        problem: InferenceProblem,
        start: Start,
        located: LocatedEffect,
        direction: Array,
    ) -> None:
        self.problem, self.start = problem, start
        self.located, self.direction = located, direction
        strengths = [size for size in located.sizes if size.most]
        self.seconds = [k for k, size in enumerate(located.sizes) if not size.most]
        self.largest = np.array(
            [size.most / size.scale if size.most else 0.0 for size in located.sizes]
        )
        self._whole = np.zeros(len(located.sizes))
        self._whole[[k for k, s in enumerate(located.sizes) if s.most]] = direction
        assert len(strengths) == len(direction)
        self._kept: dict[float, Array] = {}

    def sizes_at(self, share: float) -> Array:
        """Return the sizes (s,) at a share of the largest strength."""
        return share * self.largest * self._whole

    def shift(self, share: float) -> Array:
        """Return what the effect changes (n,), whitened, at a share of the largest strength.

        Raises
        ------
        ImpossibleReedError
            If no such reed is possible.
        """
        if share not in self._kept:
            self._kept[share] = self._residuals(self.sizes_at(share)) - self.start.residuals
        return self._kept[share]

    def _residuals(self, sizes: Array) -> Array:
        return self.problem.residuals(self.located.change(self.start.parameters, sizes))

    def columns(self, share: float) -> Array:
        """Return what second parameters change (n, c), whitened, at such a share."""
        here, found = self.start.residuals + self.shift(share), []
        for k in self.seconds:
            sizes = self.sizes_at(share)
            sizes[k] = _SECOND
            found.append((self._residuals(sizes) - here) / _SECOND)
        return np.stack(found, axis=1) if found else np.zeros((len(here), 0))

    def probe(self) -> float:
        """Return the gain at one strength, with what is linear in it, or -inf."""
        try:
            shift = self.problem.to_noise(self.shift(_NODES[_PROBE]))
        except ImpossibleReedError:
            return -np.inf
        P = self.start.weighed.precision
        pull, known = shift @ P @ self.start.model.left, shift @ P @ shift
        return float(0.5 * max(-pull, 0.0) ** 2 / max(known, 1e-12))

    def swept(self) -> "_Swept | None":
        """Sum over all strengths; None if the effect changes nothing or no reed is possible."""
        nodes, shifts, tables = [0.0], [np.zeros(len(self.start.residuals))], []
        with contextlib.suppress(ImpossibleReedError):
            for share in _NODES:
                shift, table = self.shift(share), self.columns(share)
                nodes.append(share)
                shifts.append(shift)
                tables.append(self.problem.to_noise(table))
        if len(nodes) < 3 or not np.any(np.abs(shifts[-1]) > 1e-6):
            return None
        whole = self.problem.to_noise(np.stack(shifts, axis=1))
        shares = np.geomspace(_LEAST, 1.0, _STEPS)
        shares = shares[shares <= nodes[-1]]
        moved = CubicSpline(np.array(nodes), whole, axis=1)(shares)
        gains = self._gains(shares, moved, np.array(nodes[1:]), tables)
        return _Swept(self, shares, moved, gains, np.array(nodes[1:]), tables)

    def _gains(self, shares: Array, moved: Array, nodes: Array, tables: Sequence[Array]) -> Array:
        """Return the gain (k,) at each strength, with the scales as they are without the effect."""
        P, left = self.start.weighed.precision, self.start.model.left
        pulled = P @ left
        gains = -(moved.T @ pulled) - 0.5 * np.einsum("nk,nk->k", moved, P @ moved)
        if tables[0].shape[1]:
            nearest = np.argmin(np.abs(np.log(shares)[:, None] - np.log(nodes)), axis=1)
            for k, node in enumerate(nearest.tolist()):
                C = tables[node] * (shares[k] / nodes[node])
                PC = P @ C
                known = np.eye(C.shape[1]) + C.T @ PC
                pull = PC.T @ (left + moved[:, k])
                gains[k] += 0.5 * float(pull @ np.linalg.solve(known, pull))
                gains[k] -= 0.5 * float(np.linalg.slogdet(known)[1])
        found: Array = gains
        return found


@dataclass(frozen=True)
class _Swept:
    line: _Line
    shares: Array
    moved: Array
    gains: Array
    nodes: Array
    tables: Sequence[Array]

    @property
    def most(self) -> float:
        return float(self.gains.max())

    @property
    def mean(self) -> float:
        """Log of the mean over all strengths; impossible ones count as of no evidence."""
        return float(logsumexp(self.gains)) - math.log(_STEPS)

    def scan(self, together: float) -> Scan:
        """Return the scan of an effect of which this line is the best.

        Scales are fitted anew at the best strength; what that adds there it adds everywhere.
        """
        line, k = self.line, int(np.argmax(self.gains))
        node = int(np.argmin(np.abs(np.log(self.shares[k] / self.nodes))))
        columns = self.tables[node] * (self.shares[k] / self.nodes[node])
        shift, start = self.moved[:, k], line.start
        model = start.model.moved(shift).with_columns(columns)
        # What nuisances absorb of an effect, they absorb in any form.
        seen = start.model.not_absorbed(shift, start.weighed)
        after = weigh(model, start.weighed.scales, (FORM * seen) ** 2, _TURNS)
        more = after.log_evidence - start.weighed.log_evidence - float(self.gains[k])
        sizes = line.sizes_at(float(self.shares[k]))
        seconds = len(start.model.family)
        for number, which in enumerate(line.seconds):
            sizes[which] = float(after.nuisances[seconds + number])
        first = float(self.nodes[0])
        whole = line.sizes_at(first)
        at = np.flatnonzero(whole)
        signature = np.zeros((len(shift), len(whole)))
        signature[:, at] = (line.shift(first) / np.sum(np.abs(whole)))[:, None]
        return Scan(line.located, sizes, together + more, signature, columns, shift)


def _best_lines(lines: Sequence[_Line]) -> list[_Line]:
    """Return the lines with most evidence at one strength; the others count as they did there."""
    ranked = sorted(lines, key=lambda line: -line.probe())
    return ranked[:_PLACES]


def _directions(effect: Effect) -> list[Array]:
    """Return the directions in which the strengths of an effect are scanned."""
    strengths = [size for size in effect.sizes if size.most]
    signs = [(0.0, 1.0) if size.positive else (-1.0, 0.0, 1.0) for size in strengths]
    return [np.array(each) for each in product(*signs) if any(each)]


def locations_of(effect: Effect) -> Iterator[LocatedEffect]:
    """Yield an effect at all its possible locations."""
    names = [parameter.name for parameter in effect.gridded]
    for at in product(*(parameter.grid for parameter in effect.gridded)):
        yield LocatedEffect(effect, dict(zip(names, at, strict=True)))
