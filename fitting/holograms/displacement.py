"""From phasors to displacement: the complex vibration of the whole reed in every hologram.

The phasors of a block are ``A c_k F(u_k)`` (see `fitting.holograms.block_amplitudes`): its light A
is unknown and the same in all holograms, c_k a phase of the hologram, ``u_k = Σ_j a_kj Φ_j`` the
complex phase amplitude there, made of few functions Φ. Light and amplitudes are found in
turns by least squares, from a start that `fitting.holograms.continuation` finds; the phase of a
hologram is that of its amplitudes, for ``F(u e^{iθ}) = F(u) e^{iθ}``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitError
from fitting.holograms.alternating_minimisation import (
    FINAL_RAD,
    Solution,
    settle,
)
from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import Phasors
from fitting.holograms.continuation import (
    ALIKE,
    DESCENT,
    enough,
    solve,
)
from fitting.holograms.levenberg_marquardt import GAIN_HELD, descend
from fitting.holograms.object_field import (
    LightStep,
    SharedError,
    light_factor,
    smooth_functions,
)
from fitting.holograms.problem import Problem
from fitting.holograms.shape_basis import ShapeBasis

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complex64]
Amplitudes = NDArray[np.complexfloating[Any, Any]]
Steps = NDArray[np.intp]

_FINAL_TURNS, _QUICK_TURNS = 4, 2
# If a smaller share of the holograms is explained the search goes on from settled light.
_ENOUGH = 0.95
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
    shared : SharedError
        What all of them may be off together, beside that.
    misfit : (k,) float
        Mean square of what is left of the phasors, in units of the noise: 1 is noise alone.
    gain : (k,) float
        Log of what holograms are brighter by.
    light : (n,) complex64
        Of each block, in units of the noise.
    reached : (k,) bool
        Whether the fit of a hologram has come near to its noise.
    """

    amplitude_rad: Amplitudes
    information: Array
    shared: SharedError
    misfit: Array
    gain: Array
    light: Complex
    reached: NDArray[np.bool_]


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
        If hardly any hologram can be explained.
    """
    whole = Problem.of(phasors.value, basis.functions, BesselTable(), phasors.others)
    search = solve(replace(whole, others=()), phasors, basis)
    if search.explained.mean() > _ENOUGH:
        return _finished(whole, phasors, search.solution, search.solved, _FINAL_TURNS)
    # Light that has settled shows more than that of the search.
    better = _finished(whole, phasors, search.solution, search.best_explained, _QUICK_TURNS)
    search.go_on_with(Solution(better.amplitude_rad, better.gain, better.light), better.misfit)
    return _finished(whole, phasors, search.solution, search.solved, _QUICK_TURNS)


def refit_displacements(
    phasors: Phasors,
    basis: ShapeBasis,
    before: Displacements,
    expected_rad: Sequence[Amplitudes],
    off: NDArray[np.bool_],
    together: Array,
) -> Displacements:
    """Fit a sweep once more, from what is known of it by now.

    Parameters
    ----------
    phasors : Phasors
    basis : ShapeBasis
    before : Displacements
    expected_rad : sequence of (k, j) complex
        What amplitudes may be, up to a phase of each hologram; of those that explain a hologram
        alike the last counts.
    off : (k,) bool
        Holograms that are tried from there: they show something else so far, or nothing.
    together : (q,) float
        What all displacements are off together (see `fitting.holograms.object_field.SharedError`).

    Raises
    ------
    FitError
        If no hologram can be explained.
    """
    whole = Problem.of(phasors.value, basis.functions, BesselTable(), phasors.others)
    light = before.light * light_factor(smooth_functions(phasors.x_m, phasors.y_m), together)
    changes = before.shared.response @ together
    size = before.amplitude_rad.shape[1]
    a = before.amplitude_rad + changes[:, :size] + 1j * changes[:, size:]
    steps, gain, misfit = np.flatnonzero(off), before.gain.copy(), before.misfit.copy()
    weak = FINAL_RAD**-2 * np.eye(size)
    good = np.minimum(ALIKE * misfit[steps], np.maximum(_FLOOR, enough(phasors)[steps]))
    for expected in expected_rad:
        start = whole.turned(light, steps, expected[steps])
        tried, louder, left = descend(
            whole, light, steps, (start, np.zeros(len(steps))), DESCENT, weak
        )
        found = left / whole.seen[steps]
        better = found < good
        chosen = steps[better]
        a[chosen], gain[chosen], misfit[chosen] = tried[better], louder[better], found[better]
        alike = np.minimum(good, ALIKE * np.maximum(found, 1))
        good = np.where(better, alike, good)
    at, solved = Solution(a, gain, light), np.isfinite(misfit)
    if not solved.any():
        raise FitError(
            f"none of {len(solved)} holograms shows what another run has told; measure it anew, or "
            "fit it by itself"
        )
    return _finished(whole, phasors, at, solved, _QUICK_TURNS)


def _finished(
    whole: Problem,
    phasors: Phasors,
    at: Solution,
    solved: NDArray[np.bool_],
    turns: int,
) -> Displacements:
    """Let light and amplitudes of the solved holograms settle."""
    steps = np.flatnonzero(solved)
    smooth = smooth_functions(phasors.x_m, phasors.y_m)
    problem = whole.some(steps)
    exact = problem.exact()
    at = Solution(at.amplitude[steps], at.gain[steps], at.light)
    for _ in range(turns):
        at, step = settle(problem, exact, smooth, at)
    return _told(len(phasors.drive_hz), steps, at, step, problem.seen)


def _told(
    holograms: int, solved: Steps, at: Solution, step: LightStep, seen: Array
) -> Displacements:
    """Put together what the solved holograms tell; the others tell nothing."""
    end, size = step.linear.normal, at.amplitude.shape[1]
    of_these = end.misfit / seen
    # The gain of a hologram is nobody's concern any more; it takes information with it.
    coupling, known = end.matrix[:, :-1, -1:], end.matrix[:, -1, -1] + GAIN_HELD
    told = end.matrix[:, :-1, :-1] - coupling @ coupling.swapaxes(1, 2) / known[:, None, None]
    amplitude: Amplitudes = np.zeros((holograms, size), complex)
    information = np.zeros((holograms, 2 * size, 2 * size))
    response = np.zeros((holograms, *step.shared.response.shape[1:]))
    misfit, gain = np.full(holograms, np.inf), np.zeros(holograms)
    amplitude[solved], gain[solved], misfit[solved] = at.amplitude, at.gain, of_these
    # Noise of variance 1 has half of it in either part.
    information[solved] = 2 * told / np.maximum(of_these, 1)[:, None, None]
    response[solved] = step.shared.response
    return Displacements(
        amplitude_rad=amplitude,
        information=information,
        shared=SharedError(response, step.shared.precision),
        misfit=misfit,
        gain=gain,
        light=at.light,
        reached=misfit < _FLOOR,
    )
