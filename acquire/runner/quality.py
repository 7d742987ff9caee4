"""What one acquisition is worth: a verdict and a sentence, from numbers alone.

Of all that is wrong with a step the most severe is its verdict. `SEVERITY` orders them such that
each makes those after it meaningless: frames that are not consecutive, not in order or not whole
have no phase steps; frames from before the setting measure another setting; without a lock no
sideband is seen; saturated frames distort it; what changed between the frames is no image of one
vibration; only light that could have been there can be missed; and only light that is there can
show that the lock held.
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

# Once in three million measurements noise alone exceeds this.
_DEVIATIONS: Final = 5.0
# By how much other sidebands turn the light from frame to frame, at most: 0.02 rad over four frames
# on the simulated bench (2 to 9 mHz at steps of large amplitude), and a half more.
_SIDEBANDS_RAD: Final = 0.0075
# Power of all light of the object over the noise: what the carrier has where the reed hardly moves.
# A good image; on a worse one less is leaked than is allowed for.
_CARRIER_TO_NOISE: Final = 1000.0
# A turn that is wrong by ε per frame takes the share 1 − cos(ε) cos(ε/2) ≈ 0.625 ε² off the
# amplitude of a hologram. Chosen: 2 %, four times the 0.5 % by which beams scatter from step to
# step on a table in good order.
_AMPLITUDE_LOSS: Final = 0.02
_SPOILING_TURN_RAD: Final = math.sqrt(_AMPLITUDE_LOSS / 0.625)
# A wrong pair of frequencies turns the light by anything within ±π per frame. The lock counts as
# shown if it would pass with a chance of less than one in twenty.
_SHOWN_RAD: Final = 0.05 * math.pi
# Of the power of an image, what a steady turn may leave unexplained: at most that of an amplitude
# of 0.2 (a path that jitters by 0.1 rad within four frames, as on an ordinary table, exceeds it
# once in 3000 steps; volts that halve leave 0.24), and always that of 0.05.
_UNEXPLAINED_MOST: Final = 0.2**2
_UNEXPLAINED_ALWAYS: Final = 0.05**2
# Chosen: five times the amplitude that is usual in this run.
_UNEXPLAINED_USUAL: Final = 5.0**2
# Steps from which the scatter of a run is known to a quarter of itself.
_STEPS_KNOWN: Final = 8
# Lasers in good order keep to 0.2 % within seconds and to some per cent within minutes. Chosen: ten
# times the former between the frames of a step, and 5 % between neighbouring steps.
_BRIGHTNESS_WITHIN: Final = 0.02
_BRIGHTNESS_BETWEEN: Final = 0.05
# The level of a sensor without light wanders by about a number.
_DARK_LEVEL_DN: Final = 1.0
_NEIGHBOURS: Final = 3
# Generators say volts to four digits or more, and their least amplitude is 2 mVpp.
_VOLTS_SHARE: Final = 1e-3
_VOLTS_LEAST: Final = 1e-3
# Grid of the drive's frequencies in a plan.
_DRIVE_HZ: Final = Fraction(1, 1_000_000)
# Once in three million empty steps noise alone exceeds this.
_SIGNAL_DEVIATIONS: Final = 5.0


@dataclass(frozen=True, slots=True)
class LockCondition:
    """What a step has to satisfy to be locked.

    Attributes
    ----------
    order : int
        Sideband n.
    frame_rate_hz : Fraction
        f_CCD, as asked for.
    tolerance_rad : float
        By how much the phase may turn over the acquisition.
    """

    order: int
    frame_rate_hz: Fraction
    tolerance_rad: float


@dataclass(frozen=True, slots=True)
class Usual:
    """What the steps of a run have been like so far.

    Attributes
    ----------
    steps : int
        That tell of the turn of the light. 0 if none does; the next three are NaN then.
    turn_rad, turn_scatter_rad : float
        Median of `SteadyTurn.error_rad`, and its scatter as a standard deviation.
    unexplained : float
        Median of `SteadyTurn.unexplained`.
    neighbours : int
        Steps of the same exposure that tell of the brightness. 0 if none does.
    brightness_dn : float
        Median brightness of a frame in the last of these.
    """

    steps: int = 0
    turn_rad: float = math.nan
    turn_scatter_rad: float = math.nan
    unexplained: float = math.nan
    neighbours: int = 0
    brightness_dn: float = math.nan


def most_severe(judgements: Iterable[Judgement | None]) -> Judgement:
    """Return the judgement that `SEVERITY` has first; that all is well if there is none."""
    found = [judgement for judgement in judgements if judgement is not None]
    if not found:
        return Judgement(Verdict.OK, "all is well")
    return min(found, key=lambda judgement: SEVERITY.index(judgement.verdict))


def judge_lock(
    read_back: ReadBack, frames: Sequence[Frame], condition: LockCondition
) -> Judgement | None:
    """`LOCK` if the phase turns by more than the tolerance over the acquisition.

    The residual is that of the frequencies read back and, where two frames or more were taken, of
    the frame rate that their time stamps and ids tell.

    Parameters
    ----------
    read_back : ReadBack
    frames : sequence of Frame
        At least one.
    condition : LockCondition
    """
    asked_hz, count = condition.frame_rate_hz, len(frames)
    difference_hz = read_back.aom1_hz - read_back.aom2_hz
    residual_hz = lock_residual_hz(read_back.drive_hz, condition.order, asked_hz, difference_hz)
    turn_rad = phase_error_rad(residual_hz, count, asked_hz)
    if turn_rad > condition.tolerance_rad:
        return Judgement(
            Verdict.LOCK,
            f"AOM1 and AOM2 differ by {float(difference_hz):.10g} Hz, {float(residual_hz):.3g} Hz "
            f"off the lock: the phase turns by {turn_rad:.3g} rad, tolerance "
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
            f"{float(asked_hz):.7g}: the phase turns by {turn_rad:.3g} rad, tolerance "
            f"{condition.tolerance_rad:g} rad; check its trigger and clock",
        )
    return None


def judge_settings(
    planned_hz: Fraction, planned_v: float, before: ReadBack, after: ReadBack
) -> Judgement | None:
    """`SETTINGS` unless the planned drive was played before the frames and after them.

    Whether both synthesizers were right, `judge_lock` says; here they only must not have changed.

    Parameters
    ----------
    planned_hz, planned_v : Fraction, float
        Drive of the step.
    before, after : ReadBack
    """
    if before != after:
        changed = (before.aom1_hz, before.aom2_hz) != (after.aom1_hz, after.aom2_hz)
        which = "the synthesizers" if changed else "the generator"
        return Judgement(
            Verdict.SETTINGS,
            f"{which} changed during the frames, from {_played(before)} to {_played(after)}; look "
            "whether somebody uses a front panel",
        )
    off_v = abs(before.volts - planned_v)
    # Written so that NaN is refused too.
    if not off_v <= _VOLTS_SHARE * planned_v + _VOLTS_LEAST:
        wrong = f"{before.volts:g} V instead of {planned_v:g} V"
    elif abs(before.drive_hz - planned_hz) > _DRIVE_HZ:
        wrong = f"{float(before.drive_hz):.10g} Hz instead of {float(planned_hz):.10g} Hz"
    else:
        return None
    return Judgement(
        Verdict.SETTINGS,
        f"the generator plays {wrong}; it may limit itself, or its front panel is in use",
    )


def _played(read_back: ReadBack) -> str:
    difference_hz = float(read_back.aom1_hz - read_back.aom2_hz)
    return f"{difference_hz:.10g} Hz and {float(read_back.drive_hz):.10g} Hz, {read_back.volts:g} V"


def judge_light(frames: Sequence[Frame], dark_dn: float, usual: Usual) -> Judgement | None:
    """`LIGHT` if one frame, or all of them, are brighter or darker than those around them.

    Parameters
    ----------
    frames : sequence of Frame
        At least one.
    dark_dn : float
        What a frame without light has per pixel.
    usual : Usual
        Of the steps before.
    """
    levels_dn = brightness_dn(frames, dark_dn)
    median_dn = float(np.median(levels_dn))
    worst = int(np.argmax([abs(level_dn - median_dn) for level_dn in levels_dn]))
    if abs(levels_dn[worst] - median_dn) > _BRIGHTNESS_WITHIN * abs(median_dn) + _DARK_LEVEL_DN:
        share = levels_dn[worst] / median_dn if median_dn else math.nan
        return Judgement(
            Verdict.LIGHT,
            f"frame {frames[worst].id} has {share:.1%} of the light of the others; look at the "
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
        "look at the laser, the lamp and the shutters",
    )


def brightness_dn(frames: Sequence[Frame], dark_dn: float) -> list[float]:
    """Return the mean of each frame over that of a dark one."""
    return [float(np.mean(frame.image)) - dark_dn for frame in frames]


def turn_uncertainty_rad(turn: SteadyTurn, carrier_leak: float) -> float:
    """Return by how much the turn of a perfect lock may seem wrong per frame.

    Five standard errors, what other sidebands leak, and what the carrier leaks: where the reed
    hardly moves it is many times as strong as the sideband, and may turn each of the differences of
    frames by as much as it has of the sideband's amplitude.

    Parameters
    ----------
    turn : SteadyTurn
    carrier_leak : float
        Amplitude of the carrier in the hologram per unit of the sideband's, were they equal.
    """
    leaked_rad = _SIDEBANDS_RAD + 2 * carrier_leak * _carrier(turn)
    return _DEVIATIONS * turn.standard_error_rad + leaked_rad


def _carrier(turn: SteadyTurn) -> float:
    """Amplitude of the carrier per amplitude of the sideband, at most."""
    return math.sqrt(_CARRIER_TO_NOISE / max(turn.signal_to_noise, 1e-3))


def judge_turn(
    turn: SteadyTurn, condition: LockCondition, carrier_leak: float, usual: Usual
) -> Judgement | None:
    """`LOCK` if the light shows a wrong frequency, `UNSTEADY` if it shows a path that moves.

    Both turn the light from frame to frame. A wrong frequency does so by the same amount at every
    step, or at one step alone among others that are steady; a path drifts at random, at all steps.
    A turn counts if it spoils the hologram, or if it is far outside what is usual in this run.

    Parameters
    ----------
    turn : SteadyTurn
        Measured from the frames.
    condition : LockCondition
    carrier_leak : float
        See `turn_uncertainty_rad`.
    usual : Usual
        Of the steps before.
    """
    # Where there is hardly any light, its deviations are the inverse of this error.
    if not turn.standard_error_rad < 1 / _DEVIATIONS:
        return None
    error_rad, uncertain_rad = abs(turn.error_rad), turn_uncertainty_rad(turn, carrier_leak)
    spoilt = error_rad > _SPOILING_TURN_RAD + uncertain_rad
    known = usual.steps >= _STEPS_KNOWN
    scatter_rad = usual.turn_scatter_rad if known else 0.0
    apart_rad = abs(turn.error_rad - usual.turn_rad) if known else math.inf
    unusual = known and apart_rad > _DEVIATIONS * scatter_rad + uncertain_rad
    if not (spoilt or unusual):
        return None
    error_hz = turn.error_rad / (2 * math.pi) * float(condition.frame_rate_hz)
    if error_rad > math.pi - _SPOILING_TURN_RAD - uncertain_rad:
        return Judgement(
            Verdict.LOCK,
            "the light turns backwards, as if AOM1 and AOM2 were exchanged; exchange their cables, "
            "or the two outputs in the wiring",
        )
    if spoilt and not unusual and known and abs(usual.turn_rad) < 0.5 * error_rad:
        return Judgement(
            Verdict.UNSTEADY,
            f"the light drifts by {turn.error_rad:+.3g} rad per frame, at random from step to step "
            f"({scatter_rad:.2g} rad are usual); the optical path moves, look for draughts and "
            "vibration",
        )
    where = "at this step alone" if unusual else "as at the steps before" if known else "here"
    return Judgement(
        Verdict.LOCK,
        f"the light turns by {turn.error_rad:+.3g} rad per frame too much, {error_hz:+.3g} Hz off "
        f"the lock {where}; check that synthesizers, generator and camera share one clock",
    )


def common_turn(usual: Usual, condition: LockCondition, count: int) -> str:
    """Say by how much the light turns too far at every step; empty if that is within tolerance.

    It spoils no step, but synthesizers, generator and camera then do not share one clock, or the
    path drifts in one direction.

    Parameters
    ----------
    usual : Usual
        Of the whole run.
    condition : LockCondition
    count : int
        Frames of an acquisition.
    """
    # Where it spoils steps, they say so themselves.
    if usual.steps < _STEPS_KNOWN or abs(usual.turn_rad) > _SPOILING_TURN_RAD:
        return ""
    uncertain_rad = _SIDEBANDS_RAD + _DEVIATIONS * usual.turn_scatter_rad / math.sqrt(usual.steps)
    if abs(usual.turn_rad) <= condition.tolerance_rad / count + uncertain_rad:
        return ""
    error_hz = usual.turn_rad / (2 * math.pi) * float(condition.frame_rate_hz)
    return (
        f"at all steps the light turns by {usual.turn_rad:+.2g} rad per frame too much "
        f"({error_hz:+.2g} Hz); no step is spoilt, but check that synthesizers, generator and "
        "camera share one clock"
    )


def judge_steady(turn: SteadyTurn, carrier_leak: float, usual: Usual) -> Judgement | None:
    """`UNSTEADY` if a steady turn leaves too much of the image's power unexplained.

    Then an exposure is missing or came twice although the frames are numbered without a gap, the
    volts or the light changed between the frames, or the path jumped.

    Parameters
    ----------
    turn : SteadyTurn
    carrier_leak : float
        See `turn_uncertainty_rad`.
    usual : Usual
        Of the steps before.
    """
    if not turn.unexplained_error < 1 / _DEVIATIONS:
        return None
    allowed = _UNEXPLAINED_MOST
    if usual.steps >= _STEPS_KNOWN:
        usually = _UNEXPLAINED_USUAL * usual.unexplained
        allowed = min(max(usually, _UNEXPLAINED_ALWAYS), _UNEXPLAINED_MOST)
    allowed += _DEVIATIONS * turn.unexplained_error + (carrier_leak * _carrier(turn)) ** 2
    if turn.unexplained <= allowed:
        return None
    return Judgement(
        Verdict.UNSTEADY,
        f"{turn.unexplained:.1%} of the image's power do not turn with the rest, at most "
        f"{allowed:.1%} may; the volts, the light or the path changed between the frames, or an "
        "exposure is missing: check the camera's trigger and the generator",
    )


def judge_shown(turn: SteadyTurn, carrier_leak: float) -> Judgement | None:
    """`UNPROVEN` if the light is too weak to show that the lock held.

    To be asked where the synthesizers' read-back does not show it either.

    Parameters
    ----------
    turn : SteadyTurn
    carrier_leak : float
        See `turn_uncertainty_rad`.
    """
    uncertain_rad = turn_uncertainty_rad(turn, carrier_leak)
    if uncertain_rad < _SHOWN_RAD:
        return None
    return Judgement(
        Verdict.UNPROVEN,
        f"the lock is not shown: the light's turn is uncertain by {uncertain_rad:.2g} rad per "
        f"frame, {_SHOWN_RAD:.2g} rad are needed, and the synthesizers only repeat what they were "
        "told; drive the reed more strongly to see the lock",
    )


def judge_signal(signal_to_noise: float, reed_pixels: int, empty_pixels: int) -> Judgement | None:
    """`NO_SIGNAL` if the light in the reed's region could be noise, see `signal_threshold`."""
    threshold = signal_threshold(reed_pixels, empty_pixels)
    if signal_to_noise > threshold:
        return None
    return Judgement(
        Verdict.NO_SIGNAL,
        f"the reed shows no motion: signal to noise {signal_to_noise:.4g}, at least "
        f"{threshold:.4g} is needed; check the loudspeaker's cable, amplifier, laser and shutters",
    )


def signal_threshold(reed_pixels: int, empty_pixels: int) -> float:
    """Return the ratio of two means of noise that chance exceeds once in three million.

    Noise is circular Gaussian, so its ``|H|²`` is exponential with a standard deviation of one
    mean. The ratio of means over N and M pixels is then 1 with standard deviation
    ``√(1/N + 1/M)``; five of these are allowed.
    """
    return 1 + _SIGNAL_DEVIATIONS * math.sqrt(1 / reed_pixels + 1 / empty_pixels)
