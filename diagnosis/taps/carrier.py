"""Tap T5: light that no vibration has shifted, seen where the reed hardly moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquire.runfile import Run
from diagnosis.block import Block, Place, block
from diagnosis.campaign import Part
from diagnosis.taps.vibration import SweepReading
from physics.effects.form import Tap
from physics.reed.geometry import half_width_m
from physics.twin import Twin

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

# From here to the clamp a reed hardly moves.
_CALM_M = 2e-3
# Of many holograms those count that are calmest.
_CALMEST = 0.25
_LEAST_PIXELS = 20


@dataclass(frozen=True)
class Carrier:
    """Light of the reed at rest in the holograms of one sweep, beside its clamp.

    Attributes
    ----------
    name : str
        Of the sweep.
    share : float
        Amplitude in units of that of the light at rest, in the calmest holograms.
    error : float
        Standard deviation that noise gives it in one hologram.
    volts : float
        Geometric mean.
    """

    name: str
    share: float
    error: float
    volts: float


def read_carriers(sweeps: Sequence[Part], stills: Sequence[Part]) -> list[Carrier]:
    """Read all sweeps of clampings of which there is light at rest, and whose clamp is seen."""
    found = []
    stills = [part for part in stills if part.good_steps]
    for clamping in sorted({part.clamping for part in stills}):
        first = next(part for part in stills if part.clamping == clamping)
        at_rest, calm = first.run, _calm(first.run)
        if np.count_nonzero(calm) < _LEAST_PIXELS:
            continue
        light, power = _light(first, calm)
        for part in sweeps:
            same = np.array_equal(part.run.x_m, at_rest.x_m) and len(part.run.y_m) == len(calm)
            if part.clamping == clamping and same:
                found.append(_carrier(part, calm, light, power))
    return found


def _calm(run: Run) -> NDArray[np.bool_]:
    """Which pixels (height, width) show the reed beside its clamp."""
    reed = run.reed_file().geometry()
    near = run.x_m > reed.clamp.x_m[0] - _CALM_M
    inside = np.abs(run.y_m)[:, None] < half_width_m(reed.outline, run.x_m)
    calm: NDArray[np.bool_] = near & inside
    return calm


def _light(part: Part, calm: NDArray[np.bool_]) -> tuple[Complex, float]:
    """Mean light (n,) of a reed at rest, and the sum of its squares without noise."""
    fields, noises = [], []
    for step in part.good_steps:
        halves = part.run.reconstruction.quadratures(part.run.frames(step.position))
        fields.append(halves.field[calm])
        noises.append(halves.noise)
    turned = [f * np.exp(-1j * np.angle(np.vdot(fields[0], f))) for f in fields]
    mean = np.mean(turned, axis=0)
    left = float(np.mean(noises)) / len(fields) * mean.size
    return mean, float(np.vdot(mean, mean).real) - left


def _carrier(part: Part, calm: NDArray[np.bool_], light: Complex, power: float) -> Carrier:
    run = part.run
    steps = [step for step in part.good_steps if step.order == run.sideband_order]
    seen = [abs(np.vdot(light, run.field(step.position)[calm])) / power for step in steps]
    noise = float(np.median([step.noise_level for step in steps]))
    volts = float(np.exp(np.mean([np.log(max(step.volts, 1e-6)) for step in steps])))
    return Carrier(part.name, float(np.quantile(seen, _CALMEST)), np.sqrt(noise / power), volts)


# --- Beside the twin ----------------------------------------------------------------------------
# What reeds move by there in calm holograms, in units of the light, per volt; log of how much that
# differs from reed to reed, and from sweep to sweep.
_MOVES, _REEDS, _SWEEPS = 6e-4, 0.4, 0.15
# That quantile of numbers that are noise alone, in units of its root mean square.
_NOISE = float(np.sqrt(-np.log1p(-_CALMEST)))


@dataclass(frozen=True)
class Leaks:
    """What is in sweeps that fits do not expect: a carrier, the next sideband.

    Attributes
    ----------
    carrier : dict of float
        Over what moves in each sweep, by its name.
    mixing : float
        Of the next sideband, in units of the own.
    """

    carrier: dict[str, float]
    mixing: float


def leaks_in(carriers: Sequence[Carrier], sweeps: Sequence[SweepReading], mixing: float) -> Leaks:
    """What leaks into each sweep.

    Parameters
    ----------
    carriers : sequence of Carrier
    sweeps : sequence of SweepReading
    mixing : float
        See `diagnosis.taps.light.mixing_in`.
    """
    share = dict(
        zip([c.name for c in carriers], [c.share for c in carriers] - _floor(carriers), strict=True)
    )
    carrier = {
        sweep.name: max(share.get(sweep.name, 0.0), 0.0) / float(np.median(sweep.amplitude_rad))
        for sweep in sweeps
    }
    return Leaks(carrier, mixing)


def _floor(carriers: Sequence[Carrier]) -> Array:
    """What is taken for a carrier (c,) where none leaks in."""
    return np.array([np.hypot(_MOVES * c.volts, _NOISE * c.error) for c in carriers])


def carrier_block(carriers: Sequence[Carrier]) -> Block:
    """Carrier in the sideband of each sweep."""
    floor = _floor(carriers)
    noise = np.array([c.error for c in carriers]) * 0.3

    def predict(twin: Twin) -> Array:
        amplitude: Array = np.hypot(twin.beams.leak, floor)
        return amplitude

    covariance = np.diag(noise**2 + (_SWEEPS * floor) ** 2)
    covariance += _REEDS**2 * np.multiply.outer(floor, floor)
    places = [Place("carrier beside the clamp", level=c.name) for c in carriers]
    values = [c.share for c in carriers]
    return block("carrier", Tap.MAPS, values, covariance, places, ("beams",), predict)
