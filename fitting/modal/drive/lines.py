"""Lines of the drive as poles with notches: what a chamber does, in four numbers each.

The finer structure of `fitting.modal.drive.prior` may follow a pole, but it is as rough on both
sides, and a notch is sharper than it is. Where a mode lies in a notch, it then takes a part of it.
A resonant path in parallel to the direct one has pole and notch at once: its log gain is added to
what is expected of the drive, with the covariance that the errors of its numbers have there
(decisions 0036 and 0038).
"""

from dataclasses import dataclass, replace

import numpy as np

from fitting.acoustics.poles import (
    MOST_DB,
    NEXT_TO_CENTS,
    DriveLines,
    height_db,
    lines_of_drive,
    log_gain,
)
from fitting.modal.drive.prior import smooth_ripple
from fitting.modal.model import Model
from fitting.modal.rounds import Given, Optimum, likeliest, with_ripple
from holography.arrays import Array

# Prior of the numbers of lines, in standard errors of the drive in which they were found. First
# order still holds there. The errors of lines become 11 % too small, as their data are used twice.
_PRIOR_ERRORS = 2.0
# Lines are found again until all numbers move by less than this fraction of their standard errors,
# and how often at most. Chosen: after three turns, F2 in a notch moved by less than a tenth of its
# standard error (decision 0075).
_SMALL_PART, _MOST_TURNS = 0.3, 5
_CENT = float(np.log(2) / 1200)


def explained_by_lines(at: Optimum, given: Given, bare: Model) -> list[Optimum]:
    """Explain the drive of an optimum by its lines, with and without those next to modes.

    A mode that is not quite in its place leaves a low line there, which then takes its part. Which
    of both explanations is right is seen only when both have come to rest (decision 0082).

    Parameters
    ----------
    at, given, bare
        See `with_lines`.

    Returns
    -------
    list of Optimum
        Empty if there are no lines.
    """
    lines, limits = drive_lines(at, bare), [MOST_DB, -np.inf]
    counts = [len(_apart_from_modes(lines, at, limit).parameters) for limit in limits]
    different = limits if counts[0] > counts[1] else limits[:1]
    found = [with_lines(at, given, bare, limit) for limit in different]
    return [each for each in found if each is not None]


def with_lines(at: Optimum, given: Given, bare: Model, most_db: float = MOST_DB) -> Optimum | None:
    """Explain the drive of an optimum by its lines, and fit again; None if all may be modes.

    A mode next to a line has taken a part of it. With what is found of the line, the mode moves to
    its place, and the line shows better in the drive that is left: both are found in turns.

    Parameters
    ----------
    at : Optimum
    given : Given
    bare : Model
        Without any line.
    most_db : float, optional
        Lines next to a mode that are higher are taken for that mode.

    Returns
    -------
    Optimum or None
        With the scatter of `at`, so that their evidence can be compared. If lines do not come to
        rest, it is the likeliest of all turns.
    """
    start, found = replace(bare, ripple=smooth_ripple(at.model.ripple)), list[Optimum]()
    lines, now = _apart_from_modes(drive_lines(at, bare), at, most_db), at
    for turn in range(1, _MOST_TURNS + 1):
        if not lines.parameters.size:
            return None
        now = with_ripple(expecting(start, lines), given, now.end.state, at.end.scatter)
        # With its modes where they are now, a line that it has expected may be one of them.
        if len(_apart_from_modes(lines, now, most_db).parameters) == len(lines.parameters):
            found.append(now)
        if turn == _MOST_TURNS:
            break
        # The drive of this optimum seems surer than it is, as lines were expected in it.
        shown = _lines(now, bare, at.magnitude_covariance)
        before, lines = lines, _apart_from_modes(shown, now, most_db)
        if _agree(before, lines):
            return now
    return likeliest(found) if found else None


def _apart_from_modes(lines: DriveLines, at: Optimum, most_db: float) -> DriveLines:
    """Leave out lines next to modes that are higher than some dB."""
    modes, losses = at.logs.reshape(2, -1)
    own = [_may_be_a_mode(line, modes, np.exp(losses), most_db) for line in lines.parameters]
    return lines.only(~np.array(own, bool))


def _agree(before: DriveLines, after: DriveLines) -> bool:
    """Whether lines have moved by a small part of their standard errors."""
    if before.parameters.shape != after.parameters.shape:
        return False
    moved = (after.parameters - before.parameters).ravel()
    return bool(np.all(np.abs(moved) < _SMALL_PART * np.sqrt(np.diag(before.covariance))))


def drive_lines(at: Optimum, bare: Model) -> DriveLines:
    """Find the lines in the drive of an optimum; for `bare` see `with_lines`."""
    return _lines(at, bare, at.magnitude_covariance)


def _lines(at: Optimum, bare: Model, covariance: Array) -> DriveLines:
    magnitude, off = at.end.state.log_drive.real - bare.log_volts, at.end.noise.inflation > 1
    return lines_of_drive(bare.hz, magnitude, covariance, at.end.state.gain, off)


def expecting(model: Model, lines: DriveLines) -> Model:
    """Return a model that expects lines of the drive, within twice their standard errors."""
    if not lines.parameters.size:
        return model
    errors = lines.gain_covariance(model.hz, _PRIOR_ERRORS)
    return replace(
        model,
        log_volts=model.log_volts + log_gain(lines.parameters, model.hz),
        ripple=replace(model.ripple, coarse=model.ripple.coarse + errors),
        line_weight=lines.log_weight(model.hz, _PRIOR_ERRORS),
    )


def away_from(lines: DriveLines, log_hz: Array) -> DriveLines:
    """Return the lines that are next to none of some modes, at log frequencies (a,)."""
    apart = np.abs(np.subtract.outer(lines.parameters[:, 0], log_hz))
    return lines.only(np.all(apart > NEXT_TO_CENTS * _CENT, axis=1))


@dataclass(frozen=True)
class TakenMode:
    """A mode whose resonance a line of the drive may have taken.

    Attributes
    ----------
    mode : int
        Among the active modes.
    log_hz, log_loss : float
        Of the line, as if it was the mode.
    """

    mode: int
    log_hz: float
    log_loss: float


def taken_modes(at: Optimum, lines: DriveLines) -> list[TakenMode]:
    """Return the modes whose resonance a line may have taken, the highest lines first.

    A line that is higher than those of loudspeakers and chambers may be a mode next to it. Next to
    a line that has taken all of its resonance, a mode may be found anywhere: lines of any height
    may be modes that were expected next to them, and were found farther away.
    """
    model, found = at.model, dict[int, TakenMode]()
    modes = at.logs[: len(model.active)]
    expected = np.log(model.reference_hz[model.active])
    for line in sorted(lines.parameters, key=height_db, reverse=True):
        before = np.abs(expected - line[0])
        near = int(np.abs(modes - line[0]).argmin())
        if not _may_be_a_mode(line, modes, NEXT_TO_CENTS * _CENT):
            near = int(before.argmin())
            escaped = np.abs(modes[near] - expected[near]) > before[near]
            if before[near] > NEXT_TO_CENTS * _CENT or not escaped:
                continue
        found.setdefault(near, TakenMode(near, float(line[0]), -float(line[1])))
    return list(found.values())


def _may_be_a_mode(
    line: Array, log_hz: Array, width: Array | float, most_db: float = MOST_DB
) -> bool:
    """Whether a line (4,) is suspiciously high, and next to a mode, at log frequencies (n,).

    `width` (n,), in log frequency, is how far a line may be from a mode.
    """
    near = np.any(np.abs(log_hz - line[0]) < width)
    return bool(near and height_db(line) > most_db)
