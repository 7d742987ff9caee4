"""Carrier light in the holograms of sweeps, seen near the clamp."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from diagnosis.campaign import CampaignRun
from fitting.holograms.block_amplitudes import UnshiftedLight
from holography.arrays import Array, ComplexArray
from physics.reed.geometry import half_width_m
from runs.reader import Run
from runs.records import StepRecord

# Length next to the clamp, m, where a reed hardly moves.
_STILL_M = 2e-3
# Quantile of holograms, by carrier, that counts: those of small amplitude.
_QUANTILE = 0.25
_LEAST_PIXELS = 20
# Light is seen if it exceeds the noise by this many standard deviations.
_SEEN = 5.0
# From here to the clamp a reed bends simply. Less than that share of unshifted light is left alone.
_BENT_M, _LEAST_TAKEN_OFF = 6e-3, 5e-3


@dataclass(frozen=True)
class CarrierReading:
    """Light of the reed at rest in the holograms of one sweep, near its clamp.

    Attributes
    ----------
    name : str
        Of the sweep.
    share : float
        Amplitude in units of that of the light at rest, in holograms of small amplitude.
    error : float
        Standard deviation that noise gives it in one hologram.
    volts : float
        Geometric mean.
    """

    name: str
    share: float
    error: float
    volts: float


def read_carriers(
    sweeps: Sequence[CampaignRun], stills: Sequence[CampaignRun]
) -> list[CarrierReading]:
    """Read all sweeps of clampings of which there is light at rest, and whose clamp is seen."""
    found = []
    stills = [part for part in stills if part.good_steps]
    for clamping in sorted({part.clamping for part in stills}):
        first = next(part for part in stills if part.clamping == clamping)
        near_clamp = _near_clamp(first.run, _STILL_M)
        if np.count_nonzero(near_clamp) < _LEAST_PIXELS:
            continue
        at_rest, noise = _at_rest(first)
        light = at_rest[near_clamp]
        power = float(np.vdot(light, light).real) - noise * light.size
        if power < _SEEN * noise * np.sqrt(light.size):
            continue
        shown = [part for part in sweeps if _steps(part) and _show_same(part, first)]
        found += [_carrier(part, near_clamp, light, power) for part in shown]
    return found


def _steps(part: CampaignRun) -> list[StepRecord]:
    """Return the good steps of the sideband that pictures show."""
    return [step for step in part.good_steps if step.order == part.run.sideband_order]


def _show_same(sweep: CampaignRun, still: CampaignRun) -> bool:
    """Whether a sweep shows what is at rest in the same speckle and the same pixels."""
    shown, at_rest = sweep.run, still.run
    same = np.array_equal(shown.x_m, at_rest.x_m) and np.array_equal(shown.y_m, at_rest.y_m)
    return same and sweep.clamping == still.clamping


def _near_clamp(run: Run, length_m: float) -> NDArray[np.bool_]:
    """Return which pixels (height, width) show the reed near its clamp."""
    reed = run.reed_file().geometry()
    near = run.x_m > reed.clamp.x_m[0] - length_m
    inside = np.abs(run.y_m)[:, None] < half_width_m(reed.outline, run.x_m)
    shown: NDArray[np.bool_] = near & inside
    return shown


def _at_rest(part: CampaignRun) -> tuple[ComplexArray, float]:
    """Mean light (height, width) of a reed at rest, and the variance of its noise."""
    fields, noises = [], []
    for step in part.good_steps:
        halves = part.run.reconstruction.quadratures(part.run.frames(step.position))
        fields.append(halves.field)
        noises.append(halves.noise)
    turned = [f * np.exp(-1j * np.angle(np.vdot(fields[0], f))) for f in fields]
    return np.mean(turned, axis=0), float(np.mean(noises)) / len(fields)


def _carrier(
    part: CampaignRun, near_clamp: NDArray[np.bool_], light: ComplexArray, power: float
) -> CarrierReading:
    run = part.run
    steps = _steps(part)
    seen = [abs(np.vdot(light, run.field(step.position)[near_clamp])) / power for step in steps]
    noise = float(np.median([step.noise_level for step in steps]))
    volts = float(np.exp(np.mean([np.log(max(step.volts, 1e-6)) for step in steps])))
    return CarrierReading(
        part.name, float(np.quantile(seen, _QUANTILE)), np.sqrt(noise / power), volts
    )


def unshifted_light(
    sweeps: Sequence[CampaignRun], stills: Sequence[CampaignRun], carriers: Sequence[CarrierReading]
) -> dict[str, UnshiftedLight]:
    """Light that leaks into sweeps, by their names, where it is so much that fits would suffer.

    It is as large in all holograms of a sweep, and its phase in each is what the reed shows where
    it would meet its clamp. The sweep of smallest amplitude determines how large. Sweeps of one
    level do not tell it from what moves.

    Parameters
    ----------
    sweeps, stills : sequence of CampaignRun
    carriers : sequence of CarrierReading
        By `read_carriers`.
    """
    if not carriers:
        return {}
    number = int(np.argmin([carrier.volts for carrier in carriers]))
    calmest, usual = carriers[number], float(carrier_floor(carriers)[number])
    share = float(np.sqrt(max(calmest.share**2 - usual**2, 0.0)))
    if share < max(_LEAST_TAKEN_OFF, 2 * usual):
        return {}
    found: dict[str, UnshiftedLight] = {}
    for still in [part for part in stills if part.good_steps]:
        shown = [p for p in sweeps if p.name not in found and _show_same(p, still)]
        if shown:
            light, _ = _at_rest(still)
            found |= {part.name: _unshifted(part, light, share) for part in shown}
    return found


def _unshifted(part: CampaignRun, at_rest: ComplexArray, share: float) -> UnshiftedLight:
    """Light at rest (height, width) that leaks into each hologram of a sweep by so much."""
    run = part.run
    near = _near_clamp(run, _BENT_M)
    y_m, x_m = (at[near] for at in np.meshgrid(run.y_m, run.x_m, indexing="ij"))
    away = (run.reed_file().geometry().clamp.x_m[0] - x_m) / _BENT_M
    aside = y_m / max(float(np.abs(y_m).max()), 1e-12)
    # A reed bends from its clamp on, and twists.
    moved = np.stack([away**0, away**2, away**3, away**2 * aside], axis=1)
    of_light = np.linalg.pinv(at_rest[near][:, None] * moved)[0]
    shares = {}
    for step in part.good_steps:
        seen = complex(of_light @ run.field(step.position)[near])
        shares[step.position] = share * seen / max(abs(seen), 1e-12)
    return UnshiftedLight(at_rest.astype(np.complex64), shares)


# That quantile of numbers that are noise alone, in units of its root mean square.
_NOISE = float(np.sqrt(-np.log1p(-_QUANTILE)))
# Sweeps tell vibration from leaked light if the loudest has this many times the volts of another.
_LOUDER = 1.5


def carrier_floor(carriers: Sequence[CarrierReading]) -> Array:
    """Return the apparent carrier (c,) where none leaks in: noise, and a reed that moves.

    Reeds move in proportion to the volts; what leaks in is as large at all levels. Of sweeps of one
    level, all that they show may be what moves. A campaign without light at rest has no carriers.
    """
    volts = np.array([c.volts for c in carriers])
    noise = _NOISE * np.array([c.error for c in carriers])
    square = np.array([c.share for c in carriers]) ** 2 - noise**2
    moves = float(np.sqrt(np.median(np.maximum(square, 0.0) / volts**2))) if volts.size else 0.0
    if volts.size and volts.max() > _LOUDER * volts.min():
        columns = np.stack([np.ones_like(volts), volts**2], axis=1)
        # Shares are known within a share of themselves, and so are their squares.
        weight = 1 / np.maximum(np.abs(square), noise**2)
        found, _ = nnls(columns * weight[:, None], np.maximum(square, 0.0) * weight)
        moves = float(np.sqrt(found[1]))
    return np.hypot(moves * volts, noise)
