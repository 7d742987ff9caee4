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
    end, hz = at.end, bare.hz
    magnitude = end.state.log_drive.real - bare.log_volts
    lines = lines_of_drive(
        hz, magnitude, at.magnitude_covariance, end.state.gain, end.noise.inflation > 1
    )
    modes = at.logs[: len(bare.active)]
    chambers = [not _may_be_a_mode(line, modes) for line in lines.parameters]
    lines = lines.only(np.array(chambers, dtype=bool))
    if not lines.parameters.size:
        return None
    ripple = smooth_ripple(at.model.ripple)
    coarse = bare.ripple.coarse + lines.gain_covariance(hz, _PRIOR_ERRORS)
    expected = replace(
        bare,
        log_volts=bare.log_volts + log_gain(lines.parameters, hz),
        ripple=replace(ripple, coarse=coarse),
        line_weight=lines.log_weight(hz, _PRIOR_ERRORS),
    )
    return with_ripple(expected, given, end.state, end.scatter)


def _may_be_a_mode(line: Array, log_hz: Array) -> bool:
    """Whether a line (4,) is next to a mode, at log frequencies (a,), and suspiciously high."""
    near = np.abs(log_hz - line[0]).min() < NEXT_TO_CENTS * _CENT
    return bool(near and height_db(line) > MOST_DB)
