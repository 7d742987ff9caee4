"""Search for all explanations of a sweep that its holograms allow, and weigh them.

What a mode explains, a ripple or a line of the drive may explain, too. All explanations are
compared by their evidence, with one scatter.
"""

from dataclasses import dataclass, replace

import numpy as np

from fitting.modal.drive.lines import (
    TakenMode,
    away_from,
    drive_lines,
    expecting,
    explained_by_lines,
    taken_modes,
)
from fitting.modal.drive.prior import Ripple, smooth_ripple, strong_ripple
from fitting.modal.expected.prior import Prior
from fitting.modal.first_state import FIRST_SCATTER, participation_scale, staged
from fitting.modal.model import Model, State, rescaled, stage_prior
from fitting.modal.noise import noise_of
from fitting.modal.rounds import (
    LAST,
    Given,
    Optimum,
    Scatter,
    in_rounds,
    likeliest,
    probabilities,
    with_ripple,
)
from fitting.parallel.processes import map_processes
from holography.arrays import Array

# How often the discrepancy is estimated.
ROUNDS = 3
# Explanations of a sweep are given up below this probability. Chosen: that of a normal distribution
# beyond three standard errors.
IMPROBABLE = 1.3e-3
# Prior standard deviation of a log frequency that is held: a small part of the width of a mode.
_HELD = 1e-3


@dataclass(frozen=True)
class Search:
    """Optima whose evidence can be compared.

    Attributes
    ----------
    bare : Model
        Model that expects no line of the drive, at the drive's level in these optima.
    given : Given
    optima : list of Optimum
        All with the same scatter.
    """

    bare: Model
    given: Given
    optima: list[Optimum]


def searched(
    model: Model, given: Given, state: State, scatter: Scatter, centre_hz: Array
) -> Search:
    """Find the ripple and the lines of the drive, and modes in place of lines, from a state.

    Parameters
    ----------
    model : Model
        Expects no line of the drive.
    given : Given
    state : State
    scatter : Scatter
    centre_hz : (a,) float
        Start frequencies of the active modes.
    """
    found = _with_lines(Search(model, given, _optima(model, given, state, scatter)))
    return _challenged(found, centre_hz)


def _with_lines(search: Search) -> Search:
    """Try to explain the drive by its lines, too."""
    explained = explained_by_lines(likeliest(search.optima), search.given, search.bare)
    return replace(search, optima=[*search.optima, *explained])


def _optima(model: Model, given: Given, state: State, scatter: Scatter) -> list[Optimum]:
    """Find the ripple of the drive from a smooth and from a strong one, in parallel."""

    def optimum(ripple: Ripple) -> Optimum:
        return with_ripple(replace(model, ripple=ripple), given, state, scatter)

    return list(map_processes(optimum, (smooth_ripple(model.ripple), strong_ripple(model.ripple))))


def _challenged(search: Search, centre_hz: Array) -> Search:
    """Try, for each line of the drive that may have taken a mode, the mode in its place."""
    tried = set[int]()
    while True:
        best = likeliest(search.optima)
        taken = [
            each
            for each in taken_modes(best, drive_lines(best, search.bare))
            if each.mode not in tried
        ]
        if not taken:
            return search
        tried.add(taken[0].mode)
        search = _with_mode_for_line(search, taken[0], centre_hz)


def _with_mode_for_line(search: Search, taken: TakenMode, centre_hz: Array) -> Search:
    """Try to explain a sweep by a mode where the drive has a line.

    The resonance of a mode that moves the reed almost alone looks like a line of the drive. With
    that line the fit leaves less scatter, so that the line seems sure. Modes and scatter are
    therefore found again, first with the mode held in its place. Both explanations are compared
    with that scatter, and the likelier one is taken.
    """
    best, given, bare = likeliest(search.optima), search.given, search.bare
    displacements, noise = given.displacements, noise_of(given.displacements)
    # Without the notches of distant lines, modes are found in their place.
    modes = np.concatenate([np.log(centre_hz), best.logs[: len(centre_hz)]])
    expected = expecting(bare, away_from(drive_lines(best, bare), modes))
    model, state = staged(expected, displacements, noise, given.drift, centre_hz)
    prior = stage_prior(model, LAST, centre_hz, participation_scale(model, state))
    held, state = _held_at(model, prior, state, taken)
    there = Given(displacements, given.drift, noise, held)
    end, there = in_rounds(model, there, state, FIRST_SCATTER, ROUNDS)
    state, scatter = end.state, end.next_scatter
    bare = replace(bare, log_volts=bare.log_volts + (model.log_volts - expected.log_volts)[0])
    best_held = likeliest(_optima(bare, there, state, scatter))
    other = Search(bare, replace(there, prior=prior), [best_held])
    return _weighed(search, other, scatter)


def _weighed(search: Search, other: Search, scatter: Scatter) -> Search:
    """Return a search with the optima of another one, too, unless these are improbable."""
    now, before = _compared(other, scatter), _compared(search, scatter)
    both = [*now.optima, *before.optima]
    if np.sum(probabilities(both)[: len(now.optima)]) < IMPROBABLE:
        return search
    # Later comparisons need the prior and the noise of the likeliest.
    likelier = max(now, before, key=lambda each: likeliest(each.optima).log_evidence)
    return replace(likelier, optima=both)


def _compared(search: Search, scatter: Scatter) -> Search:
    """Find the likeliest optimum again, such that its evidence can be compared.

    Lines of the drive are looked for if it expects none yet. Participations are expected as large
    as it has them: some 250 numbers have this prior, and with that of a start, whose drive is
    louder or softer, the evidence differed by 130 (decision 0056).
    """
    found = likeliest(search.optima)
    scale = participation_scale(found.model, found.end.state)
    given = replace(search.given, prior=rescaled(search.given.prior, found.model, LAST, scale))
    again = with_ripple(found.model, given, found.end.state, scatter)
    compared = Search(search.bare, given, [again])
    return compared if found.model.line_weight else _with_lines(compared)


def _held_at(model: Model, prior: Prior, state: State, taken: TakenMode) -> tuple[Prior, State]:
    """Put a mode where a line is, and hold its frequency there."""
    x, precision, centre = state.x.copy(), prior.precision.copy(), prior.centre.copy()
    at = taken.mode, 2 * model.powers.shape[1]
    x[at], x[at[0], at[1] + 1] = taken.log_hz, taken.log_loss
    centre[at], precision[at] = taken.log_hz, _HELD**-2
    return replace(prior, centre=centre, precision=precision), replace(state, x=x)
