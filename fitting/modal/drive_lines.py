"""Lines of the drive as poles with notches: what a chamber does, in four numbers each.

The finer structure of `fitting.modal.drive_prior` may follow a pole, but it is as rough on both
sides, and a notch is sharper than it is. Where a mode lies in a notch, it then takes a part of it.
A resonant path in parallel to the direct one has pole and notch at once: its log gain is added to
what is expected of the drive, with the covariance that the prior of its numbers has there
(decision 0036).
"""

from dataclasses import replace

import numpy as np

from fitting.acoustics.poles import (
    MOST_DB,
    NEXT_TO_CENTS,
    height_db,
    line_covariance,
    lines_of_drive,
    log_gain,
)
from fitting.modal.drive_prior import smooth_ripple
from fitting.modal.rounds import Given, Optimum, with_ripple
from holography.arrays import Array

_CENT = float(np.log(2) / 1200)


def with_lines(at: Optimum, given: Given) -> Optimum | None:
    """Explain the drive of an optimum by its lines, and fit again; None if it has none.

    Parameters
    ----------
    at : Optimum
    given : Given

    Returns
    -------
    Optimum or None
        With the scatter of `at`, so that their evidence can be compared.
    """
    model, end = at.model, at.end
    magnitude = end.state.log_drive.real - model.log_volts
    lines = lines_of_drive(
        model.hz, magnitude, at.magnitude_covariance, end.state.gain, end.noise.inflation > 1
    )
    modes = at.logs[: len(model.active)]
    lines = np.array([line for line in lines if not _may_be_a_mode(line, modes)])
    if not lines.size:
        return None
    ripple = smooth_ripple(model.ripple)
    expected = replace(
        model,
        log_volts=model.log_volts + log_gain(lines, model.hz),
        ripple=replace(ripple, coarse=ripple.coarse + line_covariance(lines, model.hz)),
    )
    return with_ripple(expected, given, end.state, end.scatter)


def _may_be_a_mode(line: Array, log_hz: Array) -> bool:
    """Whether a line (4,) is next to a mode, at log frequencies (a,), and suspiciously high."""
    near = np.abs(log_hz - line[0]).min() < NEXT_TO_CENTS * _CENT
    return bool(near and height_db(line) > MOST_DB)
