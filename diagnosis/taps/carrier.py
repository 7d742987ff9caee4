"""Tap T5: light that no vibration has shifted, seen where the reed hardly moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquire.runfile import Run
from diagnosis.block import Block, Place, block
from diagnosis.campaign import Part
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
    for clamping in sorted({part.clamping for part in stills}):
        at_rest = next(part for part in stills if part.clamping == clamping).run
        calm = _calm(at_rest)
        if np.count_nonzero(calm) < _LEAST_PIXELS:
            continue
        light, noise = _light(at_rest, calm)
        for part in sweeps:
            same = np.array_equal(part.run.x_m, at_rest.x_m) and len(part.run.y_m) == len(calm)
            if part.clamping == clamping and same:
                found.append(_carrier(part, calm, light, noise))
    return found


def _calm(run: Run) -> NDArray[np.bool_]:
    """Which pixels (height, width) show the reed beside its clamp."""
    reed = run.reed_file().geometry()
    near = run.x_m > reed.clamp.x_m[0] - _CALM_M
    inside = np.abs(run.y_m)[:, None] < half_width_m(reed.outline, run.x_m)
    calm: NDArray[np.bool_] = near & inside
    return calm


def _light(run: Run, calm: NDArray[np.bool_]) -> tuple[Complex, float]:
    """Mean light (n,) of a reed at rest, and the sum of its squares without noise."""
    fields, noises = [], []
    for step in run.steps:
        if step.verdict.measured:
            halves = run.reconstruction.quadratures(run.frames(step.position))
            fields.append(halves.field[calm])
            noises.append(halves.noise)
    turned = [f * np.exp(-1j * np.angle(np.vdot(fields[0], f))) for f in fields]
    mean = np.mean(turned, axis=0)
    left = float(np.mean(noises)) / len(fields) * mean.size
    return mean, float(np.vdot(mean, mean).real) - left


def _carrier(part: Part, calm: NDArray[np.bool_], light: Complex, power: float) -> Carrier:
    run = part.run
    steps = [s for s in run.steps if s.verdict.measured and s.order == run.sideband_order]
    seen = [abs(np.vdot(light, run.field(step.position)[calm])) / power for step in steps]
    noise = float(np.median([step.noise_level for step in steps]))
    volts = float(np.exp(np.mean([np.log(max(step.volts, 1e-6)) for step in steps])))
    return Carrier(part.name, float(np.quantile(seen, _CALMEST)), np.sqrt(noise / power), volts)


# --- Beside the twin ----------------------------------------------------------------------------
# What reeds move by there in calm holograms, in units of the light, per volt; log of how much that
# differs from reed to reed, and from sweep to sweep.
_MOVES, _REEDS, _SWEEPS = 6e-4, 0.4, 0.15
# Calmest of numbers that are noise alone, in units of it.
_NOISE = 0.76


def carrier_block(carriers: Sequence[Carrier]) -> Block:
    """Carrier in the sideband of each sweep."""
    floor = np.array([np.hypot(_MOVES * c.volts, _NOISE * c.error) for c in carriers])
    noise = np.array([c.error for c in carriers]) * 0.3

    def predict(twin: Twin) -> Array:
        amplitude: Array = np.hypot(twin.beams.leak, floor)
        return amplitude

    covariance = np.diag(noise**2 + (_SWEEPS * floor) ** 2)
    covariance += _REEDS**2 * np.multiply.outer(floor, floor)
    places = [Place("carrier beside the clamp", level=c.name) for c in carriers]
    values = [c.share for c in carriers]
    return block("carrier", Tap.MAPS, values, covariance, places, ("beams",), predict)
