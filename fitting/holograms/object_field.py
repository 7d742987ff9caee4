"""Fit the smooth factor of the object field that is nearly confounded with the vibration.

The block amplitudes are ``A c_k F(u_k)``. At small amplitudes ``F(u) = u/2``: an object field that
is brighter by a smooth factor, with displacements that are smaller by it, gives the same holograms.
Fringes determine the magnitude of that factor but never its phase, because
``F(u e^{iθ}) = F(u) e^{iθ}``. Alternating minimisation over object field and displacements would
therefore converge slowly, to one solution of many. Here one Newton step finds the factor, and the
displacements of all holograms follow it. The remaining uncertainty of the factor is returned as a
common-mode error; the modal fit reduces it, because modes have real shapes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.linearisation import Local, triangle, write_symmetric
from fitting.holograms.problem import (
    Normal,
    Problem,
    fill_normal,
)
from fitting.parallel.threads import map_threads
from holography.arrays import Array, ComplexArray, IndexArray

# Total degree in x and y of the polynomial that is the factor's logarithm: enough to turn the shape
# of F1 into that of any mode below 20 kHz (decision 0047).
_DEGREE = 10
# Prior standard deviation of each coefficient, in nepers or rad: weak, for the directions that the
# data do not determine.
_LOOSE = 1.0
# ... and of a step: along those directions the factor stays where it is.
_STEP = 0.01


@dataclass(frozen=True)
class CommonModeError:
    """Error that all displacements have in common because the object field is uncertain.

    Attributes
    ----------
    response : (k, 2j, q) float
        Derivatives of the amplitudes (real, then imaginary parts) of every hologram with respect
        to the q parameters of the error.
    precision : (k, q, q) float
        What each hologram adds to the inverse covariance of the parameters.
    pull : (k, q) float
        What it adds to the negative gradient of half of χ² by the parameters, where they are 0.
    small : (q, j, j) complex, optional
        See `response_of_small`.
    renewal : (q, q) float, optional
        See `fitting.holograms.changing_field.renewal_of`.
    """

    response: Array
    precision: Array
    pull: Array
    small: ComplexArray | None = None
    renewal: Array | None = None

    @property
    def whole(self) -> Array:
        """Inverse covariance (q, q) of parameters that are the same in all holograms."""
        weak = _LOOSE**-2 * np.eye(self.precision.shape[1])
        whole: Array = weak + self.precision.sum(axis=0)
        return whole

    def counting(self, independent: float) -> "CommonModeError":
        """Return the error if block amplitudes count for a fraction of independent ones."""
        return replace(self, precision=independent * self.precision, pull=independent * self.pull)

    def among(self, holograms: int, some: IndexArray) -> "CommonModeError":
        """Return the error of more holograms, of which some (s,) are those of this one.

        The others have no displacements.
        """

        def spread(each: Array) -> Array:
            whole = np.zeros((holograms, *each.shape[1:]))
            whole[some] = each
            return whole

        return CommonModeError(
            spread(self.response),
            spread(self.precision),
            spread(self.pull),
            self.small,
            self.renewal,
        )

    def responding_at(self, expected: ComplexArray, measured: ComplexArray) -> "CommonModeError":
        """Return the error of amplitudes (k, j) that are expected, where others were measured.

        Responses of measured amplitudes contain their noise. With them, a brighter object field
        would make this noise smaller, and so all residuals of a fit. Of the response of each
        hologram, the part that is like that of small displacements is proportional to the
        amplitudes.
        """
        if self.small is None:
            return self
        own, change = (_real(self.small, each) for each in (measured, expected - measured))
        power = np.maximum(np.sum(own**2, axis=1), np.finfo(float).tiny)
        share = np.clip(np.sum(self.response * own, axis=1) / power, 0, 1)
        return replace(self, response=self.response + share[:, None] * change)


def response_of_small(functions: Array, smooth: Array, object_field: ComplexArray) -> ComplexArray:
    """Return how small displacements follow the factor of the object field.

    Parameters
    ----------
    functions, smooth : (n, j) and (n, c) float
    object_field : (n,) or (k, n) complex

    Returns
    -------
    (q, j, j) complex
        Their product with amplitudes (j,) is the change of these for each coefficient of the
        factor: block amplitudes stay as they are, as far as functions can follow.
    """
    light = np.mean(np.abs(np.atleast_2d(object_field)) ** 2, axis=0)
    weighed = light[:, None] * functions
    onto = np.linalg.solve(functions.T @ weighed, weighed.T)
    magnitude = -((onto[:, None] * smooth.T) @ functions).swapaxes(0, 1)
    small: ComplexArray = np.concatenate([magnitude, 1j * magnitude[1:]])
    return small


def _real(small: ComplexArray, amplitude: ComplexArray) -> Array:
    """Return the responses (k, 2j, q) of amplitudes (k, j) that are small."""
    each = (amplitude @ small.swapaxes(1, 2)).transpose(1, 2, 0)
    return np.concatenate([each.real, each.imag], axis=1)


@dataclass(frozen=True)
class _Side:
    """What one sideband says of the object field, for all holograms.

    Attributes
    ----------
    rows : (2, 2, k, n) float
        Products of the derivatives of the block amplitudes by real and imaginary displacement with
        those by log magnitude and phase of the object field.
    shown : (k, n) float
        Power of the block amplitudes.
    eliminated : tuple of (k, 2j), (k, 2j) and (k, c) float, optional
        Elements between amplitudes and the free brightness and phase of each hologram, and those of
        the coefficients of the field, in units of the power; None for the first sideband.
    """

    rows: Array
    shown: Array
    eliminated: tuple[Array, Array, Array] | None = None


@dataclass(frozen=True)
class LinearisedSweep:
    """Block amplitudes linearised in displacements, gains and the object field's smooth factor.

    Products with the largest matrices are found without them: matrices themselves are set up when
    they are asked for.

    Attributes
    ----------
    normal : Normal
        Normal equations of each of k holograms.
    field_gradient : (k, 2c) float
        Negative gradient of the coefficients of the log factor (of its magnitude, then of its
        phase), of weighted holograms.
    functions, smooth : (n, j) and (n, c) float
    weight : (k,) float
    sides : sequence of _Side
        First sideband, then the others.
    """

    normal: Normal
    field_gradient: Array
    functions: Array
    smooth: Array
    weight: Array
    sides: Sequence[_Side]

    @cached_property
    def coupling(self) -> Array:
        """Elements (k, 2j + 1, 2c) of the normal matrix between holograms and coefficients."""
        size, count = self.functions.shape[1], self.smooth.shape[1]
        products = (self.functions[:, :, None] * self.smooth[:, None, :]).reshape(
            len(self.functions), -1
        )
        coupling = np.zeros((len(self.weight), 2 * size + 1, 2 * count))
        coupling[:, -1, :count] = self.sides[0].shown @ self.smooth

        def fill(some: slice) -> None:
            for side in self.sides:
                rows = side.rows[:, :, some]
                # One product: its time is that of reading the products of functions.
                blocks = rows.reshape(-1, len(products)) @ products
                # From (2, 2, s, j c) to amplitudes, then coefficients of magnitude and phase.
                blocks = blocks.reshape(*rows.shape[:3], size, count).transpose(2, 0, 3, 1, 4)
                coupling[some, :-1] += blocks.reshape(rows.shape[2], 2 * size, 2 * count)
                if side.eliminated is not None:
                    of_gain, of_phase, field = (each[some] for each in side.eliminated)
                    coupling[some, :-1, :count] -= of_gain[:, :, None] * field[:, None]
                    coupling[some, :-1, count:] -= of_phase[:, :, None] * field[:, None]

        map_threads(fill, len(self.weight))
        return coupling

    @cached_property
    def field_matrix(self) -> Array:
        """Normal matrix (k, c, c) of the coefficients, of weighted holograms.

        It is that of the magnitude, and that of the phase.
        """
        one, other = triangle(self.smooth.shape[1])
        pairs = self.smooth[:, one] * self.smooth[:, other]
        found = np.empty((len(self.weight), *2 * (self.smooth.shape[1],)))
        write_symmetric(found, self._power @ pairs)
        for common, eliminated in self._free:
            found -= common[:, :, None] * eliminated[:, None]
        return found

    @property
    def whole_field_matrix(self) -> Array:
        """Sum (c, c) of `field_matrix` over holograms."""
        found: Array = self.smooth.T @ (self._power.sum(axis=0)[:, None] * self.smooth)
        for common, eliminated in self._free:
            found = found - common.T @ eliminated
        return found

    @property
    def _power(self) -> Array:
        power: Array = np.sum([side.shown for side in self.sides], axis=0)
        return self.weight[:, None] * power

    @property
    def _free(self) -> list[tuple[Array, Array]]:
        """What the free brightness and phase of other sidebands take, as products (k, c)."""
        return [
            (self.weight[:, None] * (side.shown @ self.smooth), side.eliminated[2])
            for side in self.sides
            if side.eliminated is not None
        ]

    def on_field(self, holograms: Array) -> Array:
        """Return the products (k, 2c) of `coupling` with changes of holograms (k, 2j + 1)."""
        size = self.functions.shape[1]
        moved = [holograms[:, :size] @ self.functions.T, holograms[:, size:-1] @ self.functions.T]
        onto = np.zeros((2, *self.sides[0].shown.shape))
        onto[0] = holograms[:, -1:] * self.sides[0].shown
        eliminated = np.zeros((len(holograms), 2 * self.smooth.shape[1]))
        for side in self.sides:
            onto += side.rows[0] * moved[0] + side.rows[1] * moved[1]
            if side.eliminated is not None:
                of_gain, of_phase, field = side.eliminated
                louder, turned = (
                    np.sum(each * holograms[:, :-1], axis=1)[:, None] * field
                    for each in (of_gain, of_phase)
                )
                eliminated += np.concatenate([louder, turned], axis=1)
        return np.concatenate([each @ self.smooth for each in onto], axis=1) - eliminated


def smooth_functions(x_m: Array, y_m: Array) -> Array:
    """Return Legendre polynomials (n, c) at points (n,) of the reed; the first is constant."""
    x, y = (2 * (at - at.min()) / max(float(np.ptp(at)), 1e-12) - 1 for at in (x_m, y_m))
    along, across = (np.polynomial.legendre.legvander(at, _DEGREE) for at in (x, y))
    return np.stack([along[:, i] * across[:, j] for i, j in _degrees()], axis=1)


def _degrees() -> list[tuple[int, int]]:
    """Return the degrees in x and y of the smooth functions."""
    return [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]


def of_low_degree(degree: int) -> IndexArray:
    """Return which parameters of the common-mode error have a total degree of 1 up to `degree`."""
    low = np.array([c for c, (i, j) in enumerate(_degrees()) if 0 < i + j <= degree])
    # The constant of the phase is no parameter.
    return np.concatenate([low, len(_degrees()) - 1 + low])


def linearise(
    problem: Problem,
    smooth: Array,
    object_field: ComplexArray,
    a: ComplexArray,
    gain: Array,
    weight: Array,
) -> LinearisedSweep:
    """Linearise all block amplitudes in the object field, amplitudes and log gains.

    Parameters
    ----------
    problem : Problem
        In double precision: along flat directions, the effects of object field and displacement
        cancel to one part in a million.
    smooth : (n, c) float
        See `smooth_functions`.
    object_field : (n,) or (k, n) complex
    a : (k, j) complex
        Amplitudes.
    gain : (k,) float
        Log gains.
    weight : (k,) float
        Weight of each hologram in the equations of the object field.
    """
    normal = Normal.empty(len(a), problem.functions.shape[1])

    def fill(some: slice) -> tuple[list[_Side], Array, Array]:
        steps = np.arange(len(a))[some]
        here, others = fill_normal(normal, some, problem, object_field, steps, a[some], gain[some])
        first, louder, turned = _of_field(here, weight[some])
        sides = [first]
        for other in others:
            present = other.present[:, None]
            seen, *more = _of_field(other.here, weight[some] * other.present)
            shown = present * seen.shown
            # Brightness and phase of these holograms are free: they are eliminated.
            field = (shown @ smooth) / other.known[:, None]
            free = other.of_gain, other.of_phase, field
            sides.append(_Side(present * seen.rows, shown, free))
            louder, turned = louder + more[0], turned + more[1]
        return sides, louder, turned

    parts = map_threads(fill, len(a))
    gradients = [np.concatenate([part[which] for part in parts]) @ smooth for which in (1, 2)]
    sides = [_joined(each) for each in zip(*(part[0] for part in parts), strict=True)]
    field_gradient = np.concatenate(gradients, axis=1)
    return LinearisedSweep(normal, field_gradient, problem.functions, smooth, weight, sides)


def _of_field(here: Local, weight: Array) -> tuple[_Side, Array, Array]:
    """Return what a sideband says of the object field of s holograms.

    Returns
    -------
    side : _Side
    louder, turned : (s, n) float
        Negative gradients of log magnitude and phase, of weighted holograms.
    """
    square = (here.gain**2).astype(float)
    power = square * here.power
    rows = (
        here.uu * here.u + here.vu * here.v, here.vu * here.u - here.uu * here.v,
        here.uv * here.u + here.vv * here.v, here.vv * here.u - here.uv * here.v,
    )  # fmt: skip
    both = np.stack([power * each for each in rows]).reshape(2, 2, *power.shape)
    pulled = weight[:, None] * here.gain
    return (
        _Side(both, square * (here.u * here.u + here.v * here.v) * here.power),
        pulled * (here.u * here.residual_u + here.v * here.residual_v),
        pulled * (here.u * here.residual_v - here.v * here.residual_u),
    )


def _joined(parts: Sequence[_Side]) -> _Side:
    """Join what a sideband says of some of the holograms, and of others."""
    free = [part.eliminated for part in parts if part.eliminated is not None]
    eliminated = None
    if free:
        of_gain, of_phase, field = (np.concatenate(each) for each in zip(*free, strict=True))
        eliminated = of_gain, of_phase, field
    rows = np.concatenate([part.rows for part in parts], axis=2)
    return _Side(rows, np.concatenate([part.shown for part in parts]), eliminated)


def field_factor(smooth: Array, move: Array) -> NDArray[np.complex64]:
    """Return the smooth factor (..., n) of the object field.

    Parameters
    ----------
    smooth : (n, c) float
        See `smooth_functions`.
    move : (..., 2c - 1) float
        Coefficients of its logarithm: of the magnitude, then of the phase without the constant,
        which belongs to the holograms and is arbitrary.
    """
    factor: NDArray[np.complex64] = np.exp(log_field_factor(smooth, move)).astype(np.complex64)
    return factor


def log_field_factor(smooth: Array, move: Array) -> ComplexArray:
    """Return the logarithm (..., n) of `field_factor`."""
    count = smooth.shape[1]
    factor: ComplexArray = move[..., :count] @ smooth.T + 1j * (move[..., count:] @ smooth[:, 1:].T)
    return factor


@dataclass(frozen=True)
class FieldStep:
    """A Newton step of the object field's factor and of all holograms.

    Attributes
    ----------
    move : (q,) float
        See `field_factor`.
    holograms : (k, 2j + 1) float
        Changes of amplitudes and log gains.
    linear : LinearisedSweep
        The equations that were solved.
    held : (2j + 1, 2j + 1) float
        Half the prior precision of amplitudes and log gains around 0.
    alone : (k, 2j + 1) float
        Changes of amplitudes and log gains where the factor stays as it is.
    """

    move: Array
    holograms: Array
    linear: LinearisedSweep
    held: Array
    alone: Array

    @cached_property
    def reply(self) -> Array:
        """Changes (k, 2j + 1, q) of holograms against which the factor's coefficients are held."""
        reply: Array = np.linalg.solve(self.linear.normal.matrix + self.held, self._coupling)
        return reply

    @cached_property
    def curvature(self) -> Array:
        """Half the inverse covariance (q, q) of the factor, without its prior."""
        linear, coupling = self.linear, self._coupling
        count, whole = linear.smooth.shape[1], linear.whole_field_matrix
        field = np.zeros((2 * count, 2 * count))
        field[:count, :count] = field[count:, count:] = whole
        # One product of matrices, over holograms and their unknowns.
        weighed = (linear.weight[:, None, None] * coupling).reshape(-1, coupling.shape[2])
        taken = weighed.T @ self.reply.reshape(weighed.shape)
        kept = _kept(count)
        schur: Array = field[np.ix_(kept, kept)] - 0.5 * (taken + taken.T)
        return schur

    @property
    def common_response(self) -> Array:
        """Response of `common_mode`."""
        return -self.reply[:, :-1]

    @cached_property
    def common_mode(self) -> CommonModeError:
        """Uncertainty of the factor and its effect on the displacements."""
        linear, coupling = self.linear, self._coupling
        count = linear.smooth.shape[1]
        kept, weight = _kept(count), linear.weight
        schur = -weight[:, None, None] * (coupling.swapaxes(1, 2) @ self.reply)
        magnitude, phase = slice(count), slice(count, None)
        schur[:, magnitude, magnitude] += linear.field_matrix
        schur[:, phase, phase] += linear.field_matrix[:, 1:, 1:]
        force = linear.field_gradient[:, kept] - weight[:, None] * np.einsum(
            "kxc,kx->kc", coupling, self.alone
        )
        # Half the precision: the misfit, of noise of variance 1, is half of χ².
        return CommonModeError(-self.reply[:, :-1], schur + schur.swapaxes(1, 2), 2 * force)

    @cached_property
    def _coupling(self) -> Array:
        coupling: Array = self.linear.coupling[:, :, _kept(self.linear.smooth.shape[1])]
        return coupling


def _kept(count: int) -> IndexArray:
    """Return the coefficients without the constant of the phase, which is arbitrary."""
    return np.delete(np.arange(2 * count), count)


def field_step(
    linear: LinearisedSweep,
    held: Array,
    x: Array,
    *,
    common: bool = True,
) -> FieldStep:
    """Solve for the change of the object field's factor and of all holograms.

    Parameters
    ----------
    linear : LinearisedSweep
    held : (2j + 1, 2j + 1) float
        Half the prior precision of amplitudes and log gains around 0.
    x : (k, 2j + 1) float
        Amplitudes (real, then imaginary parts) and log gains.
    common : bool
        Whether the factor changes; if not, holograms alone do.
    """
    count, matrix = linear.smooth.shape[1], linear.normal.matrix + held
    kept, pull = _kept(count), linear.normal.gradient - x @ held
    alone = np.linalg.solve(matrix, pull[..., None])[..., 0]
    step = FieldStep(np.zeros(len(kept)), alone, linear, held, alone)
    if not common:
        return step
    of_holograms = linear.weight @ linear.on_field(alone)
    force = (linear.field_gradient.sum(axis=0) - of_holograms)[kept]
    # Half of the precisions of the prior, and of what holds a step back.
    weak = 0.5 * (_LOOSE**-2 + _STEP**-2) * np.eye(len(kept))
    move = np.zeros(2 * count)
    move[kept] = np.linalg.solve(step.curvature + weak, force)
    return replace(step, move=move[kept], holograms=alone - step.reply @ move[kept])
