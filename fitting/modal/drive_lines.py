"""Lines of the drive as poles with notches: what a chamber does, in four numbers each.

The finer structure of `fitting.modal.drive_prior` may follow a pole, but it is as rough on both
sides, and a notch is sharper than it is. Where a mode lies in a notch, it then takes a part of it.
A resonant path in parallel to the direct one has pole and notch at once: its log gain is added to
what is expected of the drive, with the covariance that the errors of its numbers have there
(decisions 0036 and 0038).
"""

from dataclasses import replace

import numpy as np

from fitting.acoustics.poles import (
    MOST_DB,
    NEXT_TO_CENTS,
    DriveLines,
    height_db,
    lines_of_drive,
    log_gain,
)
from fitting.modal.drive_prior import smooth_ripple
from fitting.modal.model import Model
from fitting.modal.rounds import Given, Optimum, with_ripple
from holography.arrays import Array

# Prior of the numbers of lines, in standard errors of the drive in which they were found. First
# order still holds there. The errors of lines become 11 % too small, as their data are used twice.
_PRIOR_ERRORS = 2.0
_CENT = float(np.log(2) / 1200)


def with_lines(at: Optimum, given: Given, bare: Model) -> Optimum | None:
    """Explain the drive of an optimum by its lines, and fit again; None if it has none.

    Parameters
    ----------
    at : Optimum
    given : Given
    bare : Model
        Without any line.

    Returns
    -------
    Optimum or None
        With the scatter of `at`, so that their evidence can be compared.
    """
    modes = at.logs[: len(bare.active)]
    lines = drive_lines(at, bare)
    lines = lines.only(
        np.array([not _may_be_a_mode(line, modes) for line in lines.parameters], bool)
    )
    if not lines.parameters.size:
        return None
    start = replace(bare, ripple=smooth_ripple(at.model.ripple))
    return with_ripple(expecting(start, lines), given, at.end.state, at.end.scatter)


def drive_lines(at: Optimum, bare: Model) -> DriveLines:
    """Find the lines in the drive of an optimum; for `bare` see `with_lines`."""
    magnitude = at.end.state.log_drive.real - bare.log_volts
    return lines_of_drive(
        bare.hz,
        magnitude,
        at.magnitude_covariance,
        at.end.state.gain,
        at.end.noise.inflation > 1,
    )


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


def _may_be_a_mode(line: Array, log_hz: Array) -> bool:
    """Whether a line (4,) is next to a mode, at log frequencies (a,), and suspiciously high."""
    near = np.abs(log_hz - line[0]).min() < NEXT_TO_CENTS * _CENT
    return bool(near and height_db(line) > MOST_DB)
