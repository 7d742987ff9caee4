"""Evidence of one effect: its strength on a scale of logarithms, everything else in between.

The model is computed at a few strengths and interpolated; what second parameters of an effect
change is linear at each strength. Nuisances are marginalised exactly (`linear_model`), so that the
integral over the strength is a sum along one line for each direction and location. No search can
end in a wrong optimum, and an effect that is too small to be seen has the evidence of none.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from diagnosis.inference.estimation import MapEstimate
from diagnosis.inference.gross_errors import with_gross_errors
from diagnosis.inference.linear_model import GROSS, LinearModel, Weighed, weigh
from diagnosis.inference.problem import InferenceProblem, LocatedEffect
from holography.arrays import Array
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters

# Strengths, as shares of the largest, at which the model is computed. Chosen: a cubic through them
# is within some per cent of what effects do, less than their own form is uncertain by.
_NODES = (0.02, 0.06, 0.15, 0.3, 0.6, 1.0)
# Smallest strength that counts, as a share of the largest, and the number of strengths summed over.
# Chosen: two decades, in steps of 4 %; and share of a step by which a peak is sought.
LEAST, _STEPS, _PEAK = 0.01, 120, 0.02
# Log of the density of strengths, in their logs.
LOG_DENSITY = -math.log(-math.log(LEAST))
# An effect with a location is first computed everywhere at some strengths, then at the best places.
# Chosen: the peak of a strong resonance has another form than that of a weak one, and the wrong
# form fits best in a wrong place.
_PROBES, _PLACES = (_NODES[0], _NODES[2], _NODES[3]), 4
# Step of second parameters, in their standard deviations.
_SECOND = 0.3
# Iterations of the scales, which begin at those without the effect.
_TURNS = 10
# What an effect changes by less, in standard errors of any number, it does not change. Chosen: all
# of a campaign's several hundred numbers together then move by less than a fiftieth of what shows.
_NOTHING = 1e-3
# An effect that moves all numbers together by fewer standard deviations is none: nobody could tell.
# Chosen: two, as for a 95 % interval.
SHOWS = 2.0


@dataclass(frozen=True)
class Start:
    """A model to which an effect is added, or in which one is changed.

    Attributes
    ----------
    parameters : BenchParameters
        Without the effect.
    residuals : (n,) float
        Whitened, with the effect of the sizes below.
    model : LinearModel
        The same around its nuisances.
    weighed : Weighed
        With the likeliest scales.
    sizes : (s,) float
        Sizes of the effect; all 0 where it is added.
    bare : Weighed
        The same without the form of this effect: what shows does so in whatever form.
    """

    parameters: BenchParameters
    residuals: Array
    model: LinearModel
    weighed: Weighed
    sizes: Array
    bare: Weighed

    @classmethod
    def without(cls, problem: InferenceProblem, found: MapEstimate) -> "Start":
        """Return the model without effects, as it was fitted."""
        model = problem.linear_model(found.residuals, found.jacobian, found.z)
        parameters = problem.parameters(found.z)
        model, weighed = with_gross_errors(problem, model, weigh(model))
        return cls(parameters, found.residuals, model, weighed, np.zeros(0), weighed)


@dataclass(frozen=True)
class Elsewhere:
    """Directions and locations of an effect other than the best, all equally likely beforehand.

    Attributes
    ----------
    log_evidence : float
        Of strengths that would show, in all of these together.
    count : int
        Number of directions and locations, with the best.
    """

    log_evidence: float = -np.inf
    count: int = 1

    def with_best(self, log_evidence: float) -> float:
        """Return the log evidence of all, where the best has this one by itself."""
        return float(np.logaddexp(log_evidence - math.log(self.count), self.log_evidence))


@dataclass(frozen=True)
class Scan:
    """An effect, scanned.

    Attributes
    ----------
    located : LocatedEffect
        At its best location.
    sizes : (s,) float
        Likeliest sizes there, in units of their scales.
    log_evidence : float
        Of strengths that would show, in all directions and at all locations together; up to the
        constant of the start's.
    log_hidden : float
        Of all other strengths.
    columns : (n, s) float
        What one scale of each size changes there, whitened.
    shift : (n,) float
        What the sizes change over the start, whitened.
    elsewhere : Elsewhere
        The other directions and locations.
    model : LinearModel
        At these sizes.
    weighed : Weighed
        The same with the likeliest scales.
    """

    located: LocatedEffect
    sizes: Array
    log_evidence: float
    log_hidden: float
    columns: Array
    shift: Array
    elsewhere: Elsewhere
    model: LinearModel
    weighed: Weighed


def scan_effect(problem: InferenceProblem, start: Start, effect: Effect) -> Scan | None:
    """Scan an effect over all strengths, directions and locations; None if it changes nothing.

    Locations without a possible reed have no evidence.
    """
    start = replace(start, sizes=np.zeros(len(effect.sizes)))
    places, ways = list(locations_of(effect)), _directions(effect)
    lines = [_Line(problem, start, place, way) for place in places for way in ways]
    others: list[_Line] = []
    if len(places) > 1:
        lines = sorted(
            (line for line in lines if line.possible), key=lambda line: -line.roughly.most
        )
        lines, others = lines[: _PLACES * len(ways)], lines[_PLACES * len(ways) :]
    tried = [line.swept() for line in lines]
    swept = [found for found in tried if found is not None]
    if not swept:
        return None
    best = max(swept, key=lambda one: (np.isfinite(one.sums.shown), one.sums.most))
    # Where an effect changes nothing, it has the evidence of none.
    sums = [one.sums for one in swept if one is not best]
    sums += [line.roughly for line in others]
    every = len(sums) + 1 + sum(found is None for found in tried)
    hidden = [best.sums.hidden, *(each.hidden for each in sums)]
    hidden += [0.0] * (every - len(hidden))
    log_hidden = float(logsumexp(hidden)) - math.log(every) + start.weighed.log_evidence
    return best.scan(sums, every, log_hidden)


def scan_again(
    problem: InferenceProblem,
    start: Start,
    located: LocatedEffect,
    elsewhere: Elsewhere,
    log_hidden: float,
) -> Scan | None:
    """Scan an effect along the direction of the sizes that a start has.

    Parameters
    ----------
    elsewhere : Elsewhere
        Other directions and locations: as the first scan found them.
    log_hidden : float
        See `Scan`: it is that of the first scan.
    """
    strengths = start.sizes[[k for k, size in enumerate(located.sizes) if size.most]]
    swept = _Line(problem, start, located, strengths / np.abs(strengths).max()).swept()
    if swept is None:
        return None
    found = swept.scan((), 1, log_hidden)
    together = elsewhere.with_best(found.log_evidence)
    return replace(found, elsewhere=elsewhere, log_evidence=together)


class _Line:
    """One effect at one location along one direction of its strengths."""

    def __init__(
        self, problem: InferenceProblem, start: Start, located: LocatedEffect, direction: Array
    ) -> None:
        self.problem, self.start, self.located = problem, start, located
        sizes = located.sizes
        self.strong = [k for k, size in enumerate(sizes) if size.most]
        self.seconds = [k for k, size in enumerate(sizes) if not size.most]
        self.largest = np.zeros(len(sizes))
        self.largest[self.strong] = 2.0 * direction
        self._kept: dict[float, Array] = {}

    @property
    def begun(self) -> float:
        """Share of the largest strength that the start has."""
        along = self.largest[self.strong]
        return float(self.start.sizes[self.strong] @ along / (along @ along))

    def sizes_at(self, share: float) -> Array:
        """Return the sizes (s,) at a share of the largest strength."""
        sizes = self.start.sizes.copy()
        sizes[self.strong] = share * self.largest[self.strong]
        return sizes

    def shift(self, share: float) -> Array:
        """Return what such a share changes (n,) over the start, in units of the noise.

        Raises
        ------
        ImpossibleReedError
            If no such reed is possible.
        """
        if share == self.begun:
            return np.zeros(len(self.start.residuals))
        if share not in self._kept:
            moved = self._residuals(self.sizes_at(share)) - self.start.residuals
            self._kept[share] = self.problem.to_noise(moved)
        return self._kept[share]

    def _residuals(self, sizes: Array) -> Array:
        known = self.start.parameters
        return self.problem.residuals(self.located.change(known, sizes), known)

    def seconds_at(self, share: float) -> Array:
        """Return what second parameters change (n, c), in units of the noise, at such a share."""
        if not self.seconds:
            return np.zeros((len(self.start.residuals), 0))
        here, found = self._residuals(self.sizes_at(share)), []
        for k in self.seconds:
            sizes = self.sizes_at(share)
            sizes[k] += _SECOND
            found.append((self._residuals(sizes) - here) / _SECOND)
        return self.problem.to_noise(np.stack(found, axis=1))

    @property
    def possible(self) -> bool:
        """Whether there is a reed with a moderate strength of the effect."""
        with contextlib.suppress(ImpossibleReedError):
            for share in _PROBES:
                self.shift(share)
            return True
        return False

    @cached_property
    def roughly(self) -> "_Sums":
        """Sums over all strengths, between which and beyond which all is straight."""
        P, bare = self.start.weighed.precision, self.start.bare.precision
        shifts = np.stack([self.shift(share) for share in _PROBES], axis=1)
        shares = np.geomspace(LEAST, 1.0, _STEPS)
        parts = np.array([np.interp(shares, (0.0, *_PROBES), row) for row in np.eye(4)[1:]])
        parts *= np.maximum(shares / _PROBES[-1], 1.0)
        known, seen = (np.sum(parts * ((shifts.T @ P @ shifts) @ parts), axis=0) for P in (P, bare))
        gains = -(shifts.T @ (P @ self.start.model.left)) @ parts - 0.5 * known
        return _Sums(float(gains.max()), *_shown_and_hidden(gains, np.sqrt(seen), shares))

    def swept(self) -> "_Swept | None":
        """Try all strengths; None if the effect changes nothing or no reed is possible."""
        begun = self.begun
        nodes, shifts, tables = [], [], []
        with contextlib.suppress(ImpossibleReedError):
            for share in sorted({0.0, begun, *_NODES}):
                shift = self.shift(share)
                tables.append(self.seconds_at(share) if share else None)
                shifts.append(shift)
                nodes.append(share)
        if len(nodes) < 3 or np.ptp(shifts, axis=0).max() < _NOTHING:
            return None
        at, known = np.array(nodes), [table for table in tables if table is not None]
        moved = CubicSpline(at, np.stack(shifts, axis=1), axis=1)
        return _Swept(self, moved, at[at > 0], known).integrated()


@dataclass(frozen=True)
class _Sums:
    """Gain of log evidence over the start with its scales, along one line.

    Attributes
    ----------
    most : float
        At the likeliest strength.
    shown, hidden : float
        Log of the gain at strengths that would show, and at all others, each summed over the prior
        of strengths; impossible ones have no evidence.
    """

    most: float = -np.inf
    shown: float = -np.inf
    hidden: float = -np.inf


@dataclass(frozen=True)
class _Swept:
    """A line, computed at some strengths and interpolated.

    Attributes
    ----------
    line : _Line
    moved : CubicSpline
        Gives shifts (n, ...) at shares of the largest strength.
    nodes : (m,) float
        Shares at which the model was computed.
    tables : sequence of (n, c) float
        What second parameters change at the nodes.
    best : float
        Likeliest share.
    sums : _Sums
    """

    line: _Line
    moved: CubicSpline
    nodes: Array
    tables: Sequence[Array]
    best: float = 0.0
    sums: _Sums = _Sums()

    def seconds(self, share: float) -> Array:
        """Return what second parameters change (n, c): in proportion to the strength."""
        node = int(np.argmin(np.abs(np.log(share / self.nodes))))
        columns: Array = self.tables[node] * (share / self.nodes[node])
        return columns

    def integrated(self) -> "_Swept":
        """Return the same with the likeliest strength and the sums over all."""
        shares = np.geomspace(LEAST, 1.0, _STEPS)
        shares = shares[shares <= self.nodes[-1]]
        gains, step = self.gains(shares), math.log(shares[1] / shares[0])
        place = int(np.argmax(gains))
        ends = np.log(shares[[max(place - 1, 0), min(place + 1, len(shares) - 1)]])
        found = minimize_scalar(
            lambda log: -self.gains(np.exp([log]))[0],
            bounds=tuple(ends.tolist()),
            method="bounded",
            options={"xatol": _PEAK * step},
        )
        best, most = float(np.exp(found.x)), -float(found.fun)
        # A peak narrower than the steps is a Gaussian in between.
        lower, upper = self.gains(best * np.exp([-_PEAK * step, _PEAK * step]))
        bend = max((2 * most - lower - upper) / (_PEAK * step) ** 2, 1e-12)
        shown, hidden = _shown_and_hidden(gains, self.deviations(shares), shares)
        if 0 < place < len(shares) - 1 and bend * step**2 > 1:
            shown = most + 0.5 * math.log(2 * math.pi / bend) + LOG_DENSITY
        return replace(self, best=best, sums=_Sums(most, shown, hidden))

    def deviations(self, shares: Array) -> Array:
        """Return by how many standard deviations such shares (k,) move all numbers together."""
        P, moved = self.line.start.bare.precision, self.moved(shares) - self.moved([0.0])
        squares = np.einsum("nk,nk->k", moved, P @ moved)
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))

    def gains(self, shares: Array) -> Array:
        """Return the gain (k,) of log evidence at such shares."""
        start, moved = self.line.start, self.moved(shares)
        P, left, begun = start.weighed.precision, start.model.left, start.sizes[self.line.seconds]
        gains = -(moved.T @ (P @ left)) - 0.5 * np.einsum("nk,nk->k", moved, P @ moved)
        for k, share in enumerate(shares.tolist() if self.line.seconds else ()):
            C = self.seconds(share)
            own, pull = C.T @ P @ C, C.T @ (P @ (left + moved[:, k]))
            # From second parameters of 0, around which their prior is.
            gains[k] += float(begun @ pull - 0.5 * begun @ own @ begun)
            known, pull = np.eye(len(own)) + own, pull - own @ begun
            gains[k] += 0.5 * float(pull @ np.linalg.solve(known, pull))
            gains[k] -= 0.5 * float(np.linalg.slogdet(known)[1])
        return np.asarray(gains)

    def _weighed(self, model: LinearModel) -> tuple[LinearModel, Weighed, int]:
        """Weigh a model with the numbers that are wrong at the start, or those that now are.

        Return it with the position of its first second parameter.
        """
        start, problem = self.line.start, self.line.problem
        after, position = weigh(model, start.weighed.scales, _TURNS), len(start.model.family)
        before = int(np.sum(start.model.family != GROSS))
        if before == position:
            return *with_gross_errors(problem, model, after), position
        right = model.without_gross_errors()
        own, other = with_gross_errors(problem, right, weigh(right, after.scales, _TURNS))
        if other.log_evidence > after.log_evidence:
            return own, other, before
        return model, after, position

    def scan(self, others: Sequence[_Sums], count: int, log_hidden: float) -> Scan:
        """Return the scan of an effect of which this line is the best.

        Scales are fitted again at the best strength. The gain there is taken to be that at all
        strengths, and in proportion on lines that gain less.

        Parameters
        ----------
        others : sequence of _Sums
            Of other lines, each as likely as this one.
        count : int
            Number of lines, with this one.
        log_hidden : float
            See `Scan`.
        """
        line, start, share = self.line, self.line.start, self.best
        shift, seconds = self.moved(share), self.seconds(share)
        # What nuisances absorb of an effect, they absorb in any form.
        seen = start.model.not_absorbed(shift - self.moved(0.0), start.model.usual)
        begun = start.sizes[line.seconds]
        moved = start.model.moved(shift - seconds @ begun).with_columns(seconds)
        model, after, q = self._weighed(line.problem.with_form(moved, seen))
        sizes = line.sizes_at(share)
        sizes[line.seconds] = own = after.nuisances[q : q + len(line.seconds)]
        columns = np.zeros((len(shift), len(sizes)))
        columns[:, line.seconds] = seconds
        by_share = self.moved(share, 1)
        # Strengths that move together share what moves.
        along = line.largest[line.strong]
        columns[:, line.strong] = by_share[:, None] * along / float(along @ along)
        before, most = start.weighed.log_evidence, self.sums.most
        more = after.log_evidence - before - most
        shares = [np.clip(each.most / most, 0.0, 1.0) if most > 0 else 0.0 for each in others]
        shown = [each.shown + more * s for each, s in zip(others, shares, strict=True)]
        log_shown = float(logsumexp(shown)) if shown else -np.inf
        elsewhere = Elsewhere(before + log_shown - math.log(count), count)
        return Scan(
            located=line.located,
            sizes=sizes,
            log_evidence=elsewhere.with_best(before + more + self.sums.shown),
            log_hidden=log_hidden,
            columns=line.problem.from_noise(columns),
            shift=line.problem.from_noise(shift + seconds @ (own - begun)),
            elsewhere=elsewhere,
            model=model,
            weighed=after,
        )


def _shown_and_hidden(gains: Array, deviations: Array, shares: Array) -> tuple[float, float]:
    """Return the logs of the mean gain of strengths that would show, and of all others.

    Parameters
    ----------
    gains, deviations, shares : (k,) float
        Log gain, and standard deviations by which all numbers move together, at shares of the
        largest strength that are evenly spaced in their logs.
    """
    shows, step = deviations >= SHOWS, math.log(shares[1] / shares[0])
    shown = _log_integral(np.where(shows, gains, -np.inf), step)
    hidden = _log_integral(np.where(shows, -np.inf, gains), step)
    return shown + LOG_DENSITY, hidden + LOG_DENSITY


def _log_integral(logs: Array, step: float) -> float:
    """Return the log of an integral of which logarithms are known, straight between equal steps.

    What is next to a value of -inf, where there is nothing, counts to the middle of the step.
    """
    nothing = ~np.isfinite(logs)
    ends = nothing[1:] != nothing[:-1]
    falls = np.abs(np.diff(np.where(nothing, 0.0, logs)))
    mean = np.where(falls > 1e-9, -np.expm1(-falls) / np.maximum(falls, 1e-9), 1.0)
    mean = np.where(ends, 0.5, mean)
    return float(logsumexp(np.maximum(logs[1:], logs[:-1]) + np.log(mean * step)))


def _directions(effect: Effect) -> list[Array]:
    """Return the directions in which the strengths of an effect are scanned.

    Between two that are neighbours a strength of five standard errors loses two thirds of a nat.
    """
    strengths = [size for size in effect.sizes if size.most]
    shares = [(0.0, 0.5, 1.0) if one.positive else (-1.0, -0.5, 0.0, 0.5, 1.0) for one in strengths]
    return [np.array(each) for each in product(*shares) if max(map(abs, each), default=0.0) == 1]


def locations_of(effect: Effect) -> Iterator[LocatedEffect]:
    """Yield an effect at all its possible locations."""
    names = [parameter.name for parameter in effect.gridded]
    for at in product(*(parameter.grid for parameter in effect.gridded)):
        yield LocatedEffect(effect, dict(zip(names, at, strict=True)))
