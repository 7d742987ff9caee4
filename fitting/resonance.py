"""A resonance of a reed, however it was found."""

from dataclasses import dataclass

import numpy as np

from holography.arrays import Array

# The peak response of a mode is looked for this near to its resonance.
_PEAK_CENTS = 150.0


@dataclass(frozen=True)
class Resonance:
    """A mode found in a sweep.

    Attributes
    ----------
    name : str
        With a question mark if it is not sure.
    frequency_hz : float
        Drive frequency of the picture.
    error_cents : float
        Standard error: the picture may be off by half its distance to its neighbours.
    step_index : int
        Index of the picture in the protocol.
    amplitude_rad : float
        Phase amplitude of the mode in that picture, at the points that the fit uses.
    method : str
        ``picture``, or ``joint`` (see `fitting.modal.identify`), which alone knows what follows.
    response_hz : float, optional
        Drive frequency of the mode's peak response. It differs from the eigenfrequency where the
        drive changes steeply.
    loss_factor, loss_error : float, optional
        The error is relative.
    loss_error_shared : float
        Part of it that the modes of a sweep have in common: how stiffness grows with frequency.
    participation : float, optional
        How strongly the drive excites the mode, relative to the mode that it excites most.
    similarity : float, optional
        Modal assurance criterion of its shape and the finite-element shape of its name.
    amplitude_nm : float, optional
        Displacement where the mode moves most, from rest to the largest deflection, out of the
        plane of the reed: of a joint fit at the eigenfrequency, else in that picture.
    amplitude_error_nm : float, optional
        Its standard error (joint fit).
    nm_per_v : float, optional
        `amplitude_nm` per peak volt of the drive.
    nm_per_v_error : float, optional
        Its standard error: that of the amplitude, and what the drive scatters from hologram to
        hologram (joint fit).
    largest_m : (float, float), optional
        Where that is: distances from the tip and from the axis (joint fit).
    name_probability : float, optional
        Probability of its name (joint fit). It is not sure below 0.95.
    candidates : tuple of (str, float)
        Names that it may have, with their probabilities, the most probable first (joint fit).
    """

    name: str
    frequency_hz: float
    error_cents: float
    step_index: int
    amplitude_rad: float
    method: str = "picture"
    response_hz: float | None = None
    loss_factor: float | None = None
    loss_error: float | None = None
    loss_error_shared: float = 0.0
    participation: float | None = None
    similarity: float | None = None
    amplitude_nm: float | None = None
    amplitude_error_nm: float | None = None
    nm_per_v: float | None = None
    nm_per_v_error: float | None = None
    largest_m: tuple[float, float] | None = None
    name_probability: float | None = None
    candidates: tuple[tuple[str, float], ...] = ()


def peak_response_hz(drive_hz: Array, amplitude: Array, hz: float) -> float:
    """Return the frequency of the peak response near a resonance, by a parabola.

    Parameters
    ----------
    drive_hz : (k,) float
    amplitude : (k,) float
        Of the mode, at these frequencies.
    hz : float
        Frequency of the resonance.
    """
    cents = 1200 * np.log2(drive_hz / hz)
    near = np.flatnonzero(np.abs(cents) < _PEAK_CENTS)
    if not near.size:
        return hz
    top = int(near[np.argmax(amplitude[near])])
    if top in (0, len(cents) - 1):
        return float(drive_hz[top])
    three = slice(top - 1, top + 2)
    bend, slope, _ = np.polyfit(cents[three] - cents[top], np.log(amplitude[three]), 2)
    shift = -slope / (2 * bend) if bend < 0 else 0.0
    return float(drive_hz[top] * 2 ** (shift / 1200))
