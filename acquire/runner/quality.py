"""Judge one acquisition from its numbers: return a verdict and a sentence.

If several things are wrong with a step, the most severe one is its verdict. Verdicts are sorted in
`SEVERITY` such that each makes those after it meaningless: frames that are missing, out of order or
incomplete have no known phase steps; frames from before the setting settled show another setting;
without the frequency lock the hologram shows no sideband; saturated frames distort it; frames that
differ in brightness or image do not show one vibration; a missing signal is a fault only if all of
this is right; and only a signal can prove the frequency lock.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np

from acquire.runner.frame_quality import frame_rate_hz
from drivers.roles import Frame
from holography.phase import SteadyTurn
from holography.reconstruction import Reconstruction
from protocols.frequency_lock import lock_residual_hz, phase_error_rad
from runs.verdict import Judgement, ReadBack, Verdict

SEVERITY: Final = (
    Verdict.DROPPED,
    Verdict.DISORDERED,
    Verdict.PARTIAL,
    Verdict.STALE,
    Verdict.SETTINGS,
    Verdict.LOCK,
    Verdict.SATURATED,
    Verdict.LIGHT,
    Verdict.UNSTEADY,
    Verdict.NO_SIGNAL,
    Verdict.UNPROVEN,
    Verdict.OK,
)

# Allowed deviation in standard errors. Gaussian noise alone exceeds it once in three million times.
_DEVIATIONS: Final = 5.0
# Largest turn of the phase per frame that other sidebands cause. Chosen: 1.5 times the 0.02 rad
# over four frames (2 to 9 mHz) that the simulated bench shows at steps of large amplitude.
_SIDEBANDS_RAD: Final = 0.0075
# Power of the carrier over the noise, where the reed hardly moves. Chosen: the value of a good
# image. The carrier of a worse image leaks less than is then allowed for.
_CARRIER_TO_NOISE: Final = 1000.0
# A turn that is wrong by ε per frame reduces the amplitude of a hologram by the fraction
# 1 − cos(ε) cos(ε/2) ≈ 0.625 ε². Chosen: 2 %, four times the 0.5 % by which beams scatter from step
# to step on a good optical table.
_AMPLITUDE_LOSS: Final = 0.02
_SPOILING_TURN_RAD: Final = math.sqrt(_AMPLITUDE_LOSS / 0.625)
# Largest uncertainty of the turn that still proves the lock. A wrong pair of frequencies turns the
# phase by any angle within ±π per frame; chosen: it passes with a probability below one in twenty.
_SHOWN_RAD: Final = 0.05 * math.pi
# Limits of the power fraction that a uniform turn leaves unexplained. The upper limit is an
# amplitude of 0.2: a path that jitters by 0.1 rad within four frames, as on an ordinary table,
# exceeds it once in 3000 steps, and volts that halve between frames leave 0.24. An amplitude of
# 0.05 is always allowed. Chosen.
_UNEXPLAINED_MAX: Final = 0.2**2
_UNEXPLAINED_ALWAYS: Final = 0.05**2
# Allowed unexplained power over that which is usual in this run. Chosen: five times the amplitude.
_UNEXPLAINED_FACTOR: Final = 5.0**2
# Steps after which the usual values of a run are used. Chosen: the scatter of eight steps has a
# standard error of a quarter, 1/√(2·8).
_STEPS_KNOWN: Final = 8
# Allowed relative difference of brightness between frames of a step, and between neighbouring steps
# of the same exposure. The power of a good laser varies by 0.2 % within seconds and by some per
# cent within minutes. Chosen: ten times the former, and 5 %.
_BRIGHTNESS_WITHIN: Final = 0.02
_BRIGHTNESS_BETWEEN: Final = 0.05
# Allowed difference of brightness without light. Chosen: a dark level drifts by about 1 dn.
_DARK_LEVEL_DN: Final = 1.0
# Steps that are needed for a usual brightness. Chosen: the fewest whose median ignores an outlier.
_NEIGHBOURS: Final = 3
# Allowed difference between read-back and planned volts, relative and in V. Generators report volts
# with four digits or more, and their smallest amplitude is 2 mVpp.
_VOLTS_RELATIVE: Final = 1e-3
_VOLTS_ABSOLUTE: Final = 1e-3
# Allowed difference between read-back and planned drive: drive frequencies are planned to 1 µHz.
_DRIVE_TOLERANCE_HZ: Final = Fraction(1, 1_000_000)
# Allowed deviation of the signal, in standard deviations. Noise alone exceeds it once in three
# million steps.
_SIGNAL_DEVIATIONS: Final = 5.0


@dataclass(frozen=True, slots=True)
class LockCondition:
    """Condition that a step must satisfy to be locked.

    Attributes
    ----------
    order : int
        Order n of the sideband.
    frame_rate_hz : Fraction
        Requested frame rate f_CCD.
    tolerance_rad : float
        Largest error of the phase over all frames of an acquisition.
    """

    order: int
    frame_rate_hz: Fraction
    tolerance_rad: float


@dataclass(frozen=True, slots=True)
class Usual:
    """Usual values of the last steps of a run.

    Attributes
    ----------
    steps : int
        Number of steps in which the turn of the light was measured. If it is 0, the next three
        values are NaN.
    turn_rad, turn_scatter_rad : float
        Median of `SteadyTurn.error_rad`, and its standard deviation from step to step.
    unexplained : float
        Median of `SteadyTurn.unexplained`.
    neighbours : int
        Number of steps of the same exposure whose brightness is known.
    brightness_dn : float
        Median brightness of the frames of these steps; NaN without such steps.
    """

    steps: int = 0
    turn_rad: float = math.nan
    turn_scatter_rad: float = math.nan
    unexplained: float = math.nan
    neighbours: int = 0
    brightness_dn: float = math.nan


def most_severe(judgements: Iterable[Judgement | None]) -> Judgement:
    """Return the most severe judgement according to `SEVERITY`; `OK` if all are None."""
    found = [judgement for judgement in judgements if judgement is not None]
    if not found:
        return Judgement(Verdict.OK, "no fault found")
    return min(found, key=lambda judgement: SEVERITY.index(judgement.verdict))


def judge_lock(
    read_back: ReadBack, frames: Sequence[Frame], condition: LockCondition
) -> Judgement | None:
    """Return `LOCK` if the phase error over the acquisition exceeds the tolerance.

    The error is computed from the frequencies that the instruments reported. If there are two or
    more frames, it is also computed from the frame rate according to their time stamps and numbers.

    Parameters
    ----------
    read_back : ReadBack
    frames : sequence of Frame
        At least one frame.
    condition : LockCondition

    Returns
    -------
    Judgement or None
        None if the lock held.
    """
    asked_hz, count = condition.frame_rate_hz, len(frames)
    difference_hz = read_back.aom1_hz - read_back.aom2_hz
    residual_hz = lock_residual_hz(read_back.drive_hz, condition.order, asked_hz, difference_hz)
    turn_rad = phase_error_rad(residual_hz, count, asked_hz)
    if turn_rad > condition.tolerance_rad:
        return Judgement(
            Verdict.LOCK,
            f"AOM1 and AOM2 differ by {float(difference_hz):.10g} Hz, {float(residual_hz):.3g} Hz "
            f"off the lock: the phase error is {turn_rad:.3g} rad, tolerance "
            f"{condition.tolerance_rad:g} rad; check both synthesizers",
        )
    measured_hz = frame_rate_hz(frames)
    if measured_hz is None:
        return None
    error_hz = Fraction(measured_hz) - asked_hz
    turn_rad = phase_error_rad(residual_hz - error_hz / 4, count, asked_hz)
    if turn_rad > condition.tolerance_rad:
        return Judgement(
            Verdict.LOCK,
            f"the camera takes {measured_hz:.7g} frames per second instead of "
            f"{float(asked_hz):.7g}: the phase error is {turn_rad:.3g} rad, tolerance "
            f"{condition.tolerance_rad:g} rad; check its trigger and clock",
        )
    return None


def judge_settings(
    planned_hz: Fraction, planned_v: float, before: ReadBack, after: ReadBack
) -> Judgement | None:
    """Return `SETTINGS` if settings changed during the frames, or the drive is not as planned.

    `judge_lock` judges the frequencies of the synthesizers; here they must only be constant.

    Parameters
    ----------
    planned_hz : Fraction
        Planned drive frequency.
    planned_v : float
        Planned peak volts at the load.
    before, after : ReadBack
        Settings that were read before and after the frames.

    Returns
    -------
    Judgement or None
        None if the settings are right.
    """
    if before != after:
        changed = (before.aom1_hz, before.aom2_hz) != (after.aom1_hz, after.aom2_hz)
        which = "the synthesizers" if changed else "the generator"
        return Judgement(
            Verdict.SETTINGS,
            f"{which} changed during the frames, from {_settings(before)} to {_settings(after)}; "
            "check that no one uses a front panel",
        )
    off_v = abs(before.volts - planned_v)
    # Negated, so that NaN counts as wrong.
    if not off_v <= _VOLTS_RELATIVE * planned_v + _VOLTS_ABSOLUTE:
        wrong = f"{before.volts:g} V instead of {planned_v:g} V"
    elif abs(before.drive_hz - planned_hz) > _DRIVE_TOLERANCE_HZ:
        wrong = f"{float(before.drive_hz):.10g} Hz instead of {float(planned_hz):.10g} Hz"
    else:
        return None
    return Judgement(
        Verdict.SETTINGS,
        f"the generator plays {wrong}; check its own limits, and that no one uses its front panel",
    )


def _settings(read_back: ReadBack) -> str:
    difference_hz = float(read_back.aom1_hz - read_back.aom2_hz)
    return f"{difference_hz:.10g} Hz and {float(read_back.drive_hz):.10g} Hz, {read_back.volts:g} V"


def judge_light(frames: Sequence[Frame], dark_dn: float, usual: Usual) -> Judgement | None:
    """Return `LIGHT` if one frame differs in brightness from the others, or all from earlier steps.

    Parameters
    ----------
    frames : sequence of Frame
        At least one frame.
    dark_dn : float
        Mean pixel value of a frame without light.
    usual : Usual
        Usual values of the steps before.

    Returns
    -------
    Judgement or None
        None if the brightness is as usual.
    """
    levels_dn = brightness_dn(frames, dark_dn)
    median_dn = float(np.median(levels_dn))
    worst = int(np.argmax([abs(level_dn - median_dn) for level_dn in levels_dn]))
    if abs(levels_dn[worst] - median_dn) > _BRIGHTNESS_WITHIN * abs(median_dn) + _DARK_LEVEL_DN:
        fraction = levels_dn[worst] / median_dn if median_dn else math.nan
        return Judgement(
            Verdict.LIGHT,
            f"frame {frames[worst].id} has {fraction:.1%} of the light of the others; check the "
            "laser, the lamp and the shutters",
        )
    if usual.neighbours < _NEIGHBOURS:
        return None
    allowed_dn = _BRIGHTNESS_BETWEEN * abs(usual.brightness_dn) + _DARK_LEVEL_DN
    if abs(median_dn - usual.brightness_dn) <= allowed_dn:
        return None
    return Judgement(
        Verdict.LIGHT,
        f"the frames have {median_dn / usual.brightness_dn:.1%} of the light of the steps before; "
        "check the laser, the lamp and the shutters",
    )


def brightness_dn(frames: Sequence[Frame], dark_dn: float) -> list[float]:
    """Return the mean value of each frame minus that of a dark frame, in dn."""
    return [float(np.mean(frame.image)) - dark_dn for frame in frames]


def turn_uncertainty_rad(turn: SteadyTurn, carrier_leak: float) -> float:
    """Return the largest error of the measured turn per frame if the lock is perfect.

    It is the sum of five standard errors, the effect of other sidebands, and the effect of the
    carrier. Where the reed hardly moves, the carrier is much stronger than the sideband: it can
    turn each difference of two frames by the ratio of leaked carrier and sideband amplitude.

    Parameters
    ----------
    turn : SteadyTurn
    carrier_leak : float
        Amplitude of the carrier in the hologram, divided by that of the sideband, if both had the
        same amplitude in the light.
    """
    leaked_rad = _SIDEBANDS_RAD + 2 * carrier_leak * _carrier(turn)
    return _DEVIATIONS * turn.standard_error_rad + leaked_rad


def _carrier(turn: SteadyTurn) -> float:
    """Return the largest possible ratio of the amplitudes of carrier and sideband."""
    # 1e-3 avoids a division by zero without light.
    return math.sqrt(_CARRIER_TO_NOISE / max(turn.signal_to_noise, 1e-3))


def judge_turn(
    turn: SteadyTurn, condition: LockCondition, carrier_leak: float, usual: Usual
) -> Judgement | None:
    """Return `LOCK` if the light has a wrong frequency, `UNSTEADY` if the optical path moves.

    Both turn the phase from frame to frame. A wrong frequency does so by the same amount at every
    step, or at a single step; a moving path does so at random at all steps. A turn is a fault if it
    spoils the hologram, or is far from what is usual in this run.

    Parameters
    ----------
    turn : SteadyTurn
        Turn that was measured in the frames.
    condition : LockCondition
    carrier_leak : float
        See `turn_uncertainty_rad`.
    usual : Usual
        Usual values of the steps before.

    Returns
    -------
    Judgement or None
        None if the turn is right, or cannot be measured for lack of light.
    """
    # With less than five deviations of light the turn is not known: noise, too, has most of its
    # power along some turn. An image of noise scatters by 1/√2 of what is left unexplained.
    seen = turn.unexplained_error < math.sqrt(2) / _DEVIATIONS
    if not (seen and turn.standard_error_rad < 1 / _DEVIATIONS):
        return None
    error_rad, uncertain_rad = abs(turn.error_rad), turn_uncertainty_rad(turn, carrier_leak)
    spoilt = error_rad > _SPOILING_TURN_RAD + uncertain_rad
    known = usual.steps >= _STEPS_KNOWN
    scatter_rad = usual.turn_scatter_rad if known else 0.0
    unlike_rad = abs(turn.error_rad - usual.turn_rad) if known else math.inf
    unusual = known and unlike_rad > _DEVIATIONS * scatter_rad + uncertain_rad
    if not (spoilt or unusual):
        return None
    error_hz = turn.error_rad / (2 * math.pi) * float(condition.frame_rate_hz)
    if error_rad > math.pi - _SPOILING_TURN_RAD - uncertain_rad:
        return Judgement(
            Verdict.LOCK,
            "the phase of the light turns backwards, as if AOM1 and AOM2 were exchanged; exchange "
            "their cables",
        )
    if spoilt and not unusual and known and abs(usual.turn_rad) < 0.5 * error_rad:
        return Judgement(
            Verdict.UNSTEADY,
            f"the phase of the light drifts by {turn.error_rad:+.3g} rad per frame, at random from "
            f"step to step ({scatter_rad:.2g} rad are usual): the optical path moves; look for "
            "draughts and vibration",
        )
    at = "at this step alone" if unusual else "as at the steps before" if known else "at this step"
    return Judgement(
        Verdict.LOCK,
        f"the phase of the light turns by {turn.error_rad:+.3g} rad per frame too much, "
        f"{error_hz:+.3g} Hz off the lock {at}; check that synthesizers, generator and camera "
        "share one clock",
    )


def common_turn(usual: Usual, condition: LockCondition, count: int) -> str:
    """Return a remark if the phase turns by the same error at every step; empty if it does not.

    Such an error spoils no step. It shows that synthesizers, generator and camera do not share one
    clock, or that the optical path drifts in one direction.

    Parameters
    ----------
    usual : Usual
        Usual values of the whole run.
    condition : LockCondition
    count : int
        Frames of an acquisition.
    """
    # If the error spoils steps, their verdicts report it.
    if usual.steps < _STEPS_KNOWN or abs(usual.turn_rad) > _SPOILING_TURN_RAD:
        return ""
    uncertain_rad = _SIDEBANDS_RAD + _DEVIATIONS * usual.turn_scatter_rad / math.sqrt(usual.steps)
    if abs(usual.turn_rad) <= condition.tolerance_rad / count + uncertain_rad:
        return ""
    error_hz = usual.turn_rad / (2 * math.pi) * float(condition.frame_rate_hz)
    return (
        f"at all steps the phase of the light turns by {usual.turn_rad:+.2g} rad per frame too "
        f"much ({error_hz:+.2g} Hz), which spoils no step; check that synthesizers, generator and "
        "camera share one clock"
    )


def judge_steady(turn: SteadyTurn, carrier_leak: float, usual: Usual) -> Judgement | None:
    """Return `UNSTEADY` if a uniform turn leaves too much of the image's power unexplained.

    Possible causes: an exposure is missing or came twice although the frame numbers have no gap,
    the volts or the light changed between the frames, or the optical path jumped.

    Parameters
    ----------
    turn : SteadyTurn
    carrier_leak : float
        See `turn_uncertainty_rad`.
    usual : Usual
        Usual values of the steps before.

    Returns
    -------
    Judgement or None
        None if the image turns uniformly, or there is too little light to know.
    """
    if not turn.unexplained_error < 1 / _DEVIATIONS:
        return None
    allowed = _UNEXPLAINED_MAX
    if usual.steps >= _STEPS_KNOWN:
        scaled = _UNEXPLAINED_FACTOR * usual.unexplained
        allowed = min(max(scaled, _UNEXPLAINED_ALWAYS), _UNEXPLAINED_MAX)
    allowed += _DEVIATIONS * turn.unexplained_error + (carrier_leak * _carrier(turn)) ** 2
    if turn.unexplained <= allowed:
        return None
    return Judgement(
        Verdict.UNSTEADY,
        f"{turn.unexplained:.1%} of the image's power does not turn with the rest (allowed: "
        f"{allowed:.1%}): the volts, the light or the optical path changed between the frames, or "
        "an exposure is missing; check the camera's trigger and the generator",
    )


def judge_shown(turn: SteadyTurn, carrier_leak: float) -> Judgement | None:
    """Return `UNPROVEN` if the light is too weak to prove the frequency lock.

    Use it only if the synthesizers' read-back does not prove the lock either.

    Parameters
    ----------
    turn : SteadyTurn
    carrier_leak : float
        See `turn_uncertainty_rad`.

    Returns
    -------
    Judgement or None
        None if the light proves the lock.
    """
    uncertain_rad = turn_uncertainty_rad(turn, carrier_leak)
    if uncertain_rad < _SHOWN_RAD:
        return None
    return Judgement(
        Verdict.UNPROVEN,
        f"the frequency lock is not proven: the turn of the light is uncertain by "
        f"{uncertain_rad:.2g} rad per frame (needed: {_SHOWN_RAD:.2g} rad), and the synthesizers "
        "only return the settings that were sent to them; drive the reed with more volts",
    )


def judge_signal(signal_to_noise: float, reconstruction: Reconstruction) -> Judgement | None:
    """Return `NO_SIGNAL` if the light in the reed's region could be noise.

    Parameters
    ----------
    signal_to_noise : float
        Mean ``|H|²`` in the reed's region over that of the empty region.
    reconstruction : Reconstruction
        Holds the two regions, see `signal_threshold`.
    """
    threshold = signal_threshold(reconstruction)
    if signal_to_noise > threshold:
        return None
    return Judgement(
        Verdict.NO_SIGNAL,
        f"the reed shows no motion: signal to noise {signal_to_noise:.4g} (needed: "
        f"{threshold:.4g}); check the loudspeaker's cable, amplifier, laser and shutters",
    )


def signal_threshold(reconstruction: Reconstruction) -> float:
    """Return the ratio of two noise means that noise exceeds once in three million times.

    Noise is circular Gaussian, so its ``|H|²`` has an exponential distribution, whose standard
    deviation equals its mean. The ratio of the means over N independent pixels of the reed's region
    and M of the empty one is therefore 1 with the standard deviation ``√(1/N + 1/M)``; five of
    these are allowed.
    """
    region = reconstruction.region
    inverse = 1 / (region.height * region.width) + 1 / reconstruction.independent_noise
    return 1 + _SIGNAL_DEVIATIONS * math.sqrt(inverse)
