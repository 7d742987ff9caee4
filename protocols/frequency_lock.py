"""The lock between drive, camera and synthesizers, in exact rationals.

Four frames step in quadrature only if ``f_AOM1 − f_AOM2 = n·f + f_CCD/4`` (decision 0001), and
all three frequencies live on grids of their own: the synthesizers' step, the generator's step, the
camera's frame rate. This module finds the drive nearest to what was asked at which the condition
holds exactly, and the residual where no such drive is near.
"""

import math
from fractions import Fraction
from typing import Final

# A drive further away than half of this would no longer be the one that was asked (1 Hz is
# 1.2 cents at the lowest step of the paper's sweep), so a coarser exact grid is passed over.
COARSEST_GRID_HZ: Final = Fraction(1)


def nearest_multiple(value: Fraction, step: Fraction) -> Fraction:
    """Return the whole multiple of `step` nearest to `value`; a tie goes to the even multiple."""
    return round(value / step) * step


def lock_target_hz(drive_hz: Fraction, order: int, frame_rate_hz: Fraction) -> Fraction:
    """Return the difference f_AOM1 − f_AOM2 at which sideband `order` steps in quadrature.

    Parameters
    ----------
    drive_hz : Fraction
        Frequency of the tweeter.
    order : int
        Sideband n; 0 is the carrier.
    frame_rate_hz : Fraction
        Frame rate of the camera, f_CCD.

    Returns
    -------
    Fraction
        ``n·f + f_CCD/4``.
    """
    return order * drive_hz + frame_rate_hz / 4


def snap_drive(
    asked_hz: Fraction,
    order: int,
    frame_rate_hz: Fraction,
    synthesizer_step_hz: Fraction,
    generator_step_hz: Fraction,
) -> Fraction:
    """Return the drive nearest to `asked_hz` that the instruments can lock to.

    Where a grid of drives exists that satisfies the lock exactly (`exact_drive_grid`) and is no
    coarser than `COARSEST_GRID_HZ`, the nearest of its points. Otherwise (a synthesizer with a
    binary tuning word, say) the nearest drive that would lock exactly, rounded to the generator's
    grid: what is left then is at most ``|n|`` times half a generator step.

    Parameters
    ----------
    asked_hz : Fraction
        Frequency that the protocol asks for.
    order : int
        Sideband n; 0 is the carrier.
    frame_rate_hz, synthesizer_step_hz, generator_step_hz : Fraction
        Frame rate f_CCD and the steps of the two instruments, all above 0.

    Returns
    -------
    Fraction
        A whole multiple of `generator_step_hz`; it never decreases when `asked_hz` grows.

    Examples
    --------
    >>> step, microhertz = Fraction(1, 10), Fraction(1, 1_000_000)
    >>> float(snap_drive(Fraction("2033.075"), 1, Fraction("12.4"), step, microhertz))
    2033.1
    """
    grid = exact_drive_grid(order, frame_rate_hz, synthesizer_step_hz, generator_step_hz)
    if grid is not None and grid[1] <= COARSEST_GRID_HZ:
        offset_hz, spacing_hz = grid
        return offset_hz + nearest_multiple(asked_hz - offset_hz, spacing_hz)
    if order == 0:
        return nearest_multiple(asked_hz, generator_step_hz)
    target_hz = lock_target_hz(asked_hz, order, frame_rate_hz)
    locked_hz = nearest_multiple(target_hz, synthesizer_step_hz) - frame_rate_hz / 4
    return nearest_multiple(locked_hz / order, generator_step_hz)


def exact_drive_grid(
    order: int,
    frame_rate_hz: Fraction,
    synthesizer_step_hz: Fraction,
    generator_step_hz: Fraction,
) -> tuple[Fraction, Fraction] | None:
    """Find every drive on the generator's grid at which the lock is exact.

    With drive = a·g the condition n·a·g + f_CCD/4 = b·s is a linear congruence in the whole
    numbers a and b once g, s and f_CCD/4 are written over one denominator.

    Parameters
    ----------
    order : int
        Sideband n; 0 is the carrier.
    frame_rate_hz, synthesizer_step_hz, generator_step_hz : Fraction
        f_CCD, s and g, all above 0.

    Returns
    -------
    tuple of Fraction or None
        ``(offset_hz, spacing_hz)`` with ``0 ≤ offset < spacing``: the drives are
        ``offset + whole number · spacing``. None if there is no such drive.
    """
    quarter_hz = frame_rate_hz / 4
    per_step_hz = order * generator_step_hz
    scale = math.lcm(
        quarter_hz.denominator, per_step_hz.denominator, synthesizer_step_hz.denominator
    )
    factor, modulus = int(per_step_hz * scale), int(synthesizer_step_hz * scale)
    residue = int(-quarter_hz * scale)
    common = math.gcd(factor, modulus)
    if residue % common:
        return None
    period = modulus // common
    first = (residue // common) * pow(factor // common, -1, period) % period
    return first * generator_step_hz, period * generator_step_hz


def difference_hz(
    drive_hz: Fraction, order: int, frame_rate_hz: Fraction, synthesizer_step_hz: Fraction
) -> Fraction:
    """Return the difference f_AOM1 − f_AOM2 on the synthesizers' grid nearest to the lock.

    Parameters
    ----------
    drive_hz, order, frame_rate_hz
        As for `lock_target_hz`.
    synthesizer_step_hz : Fraction
        Step of both synthesizers; on one clock only the difference of their tuning words counts.

    Returns
    -------
    Fraction
        A whole multiple of `synthesizer_step_hz`.
    """
    return nearest_multiple(lock_target_hz(drive_hz, order, frame_rate_hz), synthesizer_step_hz)


def lock_residual_hz(
    drive_hz: Fraction, order: int, frame_rate_hz: Fraction, difference_hz: Fraction
) -> Fraction:
    """Return by how much a realised difference misses the lock; 0 is a perfect one.

    Parameters
    ----------
    drive_hz, order, frame_rate_hz
        As for `lock_target_hz`.
    difference_hz : Fraction
        f_AOM1 − f_AOM2 as the synthesizers play it.

    Returns
    -------
    Fraction
        Realised minus wanted difference.
    """
    return difference_hz - lock_target_hz(drive_hz, order, frame_rate_hz)


def phase_error_rad(residual_hz: Fraction, frames: int, frame_rate_hz: Fraction) -> float:
    """Return the phase by which a residual turns the hologram over one acquisition.

    Parameters
    ----------
    residual_hz : Fraction
        From `lock_residual_hz`.
    frames : int
        Frames of one acquisition.
    frame_rate_hz : Fraction
        Frame rate of the camera, f_CCD.

    Returns
    -------
    float
        ``2π·|residual|·frames/f_CCD`` in rad.
    """
    return 2 * math.pi * float(abs(residual_hz) * frames / frame_rate_hz)
