"""Displacement of a reed over a sweep: of the whole reed in every hologram, and of each mode."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.amplitudes.peaks import (
    ModeAmplitude,
    PeakAmplitudes,
    mode_amplitudes,
    peak_amplitudes,
)
from fitting.amplitudes.vamp import VampPoints
from fitting.modal.identify import JointFit
from fitting.resonance import Resonance
from holography.arrays import Array


@dataclass(frozen=True)
class Peak:
    """Largest displacement of a sweep.

    Attributes
    ----------
    nm : float
        Amplitude.
    error_nm : float or None
        Its standard error; None if the method does not know it.
    hz, volts : float
        Drive frequency and peak volts of that hologram.
    step_index : int
        Index of the hologram in the protocol.
    x_mm, y_mm : float
        Distances from the tip and from the axis.
    """

    nm: float
    error_nm: float | None
    hz: float
    volts: float
    step_index: int
    x_mm: float
    y_mm: float


@dataclass(frozen=True)
class Response:
    """Displacements of a reed and of each of its modes in k holograms.

    Attributes
    ----------
    drive_hz : (k,) float
    step_index : (k,) int
        Index of each hologram in the protocol.
    volts : (k,) float
        Peak volts at the load.
    names : tuple of str
    amplitude_nm : (k, m) float
        Amplitude of each mode where it moves most.
    peak : PeakAmplitudes
        Of the whole reed.
    off : (k,) bool
        Holograms that contradict the fitted modes. They may lie in a wrong fringe.
    wavelength_m : float
        Wavelength of the light.
    """

    drive_hz: Array
    step_index: NDArray[np.intp]
    volts: Array
    names: tuple[str, ...]
    amplitude_nm: Array
    peak: PeakAmplitudes
    off: NDArray[np.bool_]
    wavelength_m: float

    @property
    def largest(self) -> Peak | None:
        """Largest displacement of the sweep; None if no hologram is explained."""
        known = np.where(self.off, np.nan, self.peak.nm)
        if np.isnan(known).all():
            return None
        k = int(np.nanargmax(known))
        return Peak(
            nm=float(self.peak.nm[k]),
            error_nm=_number(self.peak.error_nm[k]),
            hz=float(self.drive_hz[k]),
            volts=float(self.volts[k]),
            step_index=int(self.step_index[k]),
            x_mm=1e3 * float(self.peak.x_m[k]),
            y_mm=1e3 * float(self.peak.y_m[k]),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the displacement of the whole reed in every hologram, with stable keys."""
        return {
            "hz": [float(hz) for hz in self.drive_hz],
            "step_index": [int(k) for k in self.step_index],
            "volts": [float(v) for v in self.volts],
            "peak_nm": [_number(nm) for nm in self.peak.nm],
            "peak_error_nm": [_number(nm) for nm in self.peak.error_nm],
            "x_mm": [round(1e3 * float(x), 3) for x in self.peak.x_m],
            "y_mm": [round(1e3 * float(y), 3) for y in self.peak.y_m],
            "off": [bool(off) for off in self.off],
        }


def joint_response(
    fit: JointFit, points: VampPoints, wavelength_m: float
) -> tuple[Response, dict[str, Resonance], dict[str, Resonance]]:
    """Return the displacements of a jointly fitted sweep, and those of its modes.

    The modes are those with a sure name, and then the others (see `JointFit`).

    Parameters
    ----------
    fit : JointFit
    points : VampPoints
    wavelength_m : float
        Wavelength of the light.
    """
    blocks, modal = fit.block_amplitudes, fit.modal
    found = mode_amplitudes(fit, points, wavelength_m)
    nm = np.array([found[name].nm for name in fit.names])
    # Deflections at a mode's largest point, per unit of those of its finite-element shape.
    resonant = np.linalg.norm(modal.resonant.amplitude_rad, axis=1)
    nm_per_rad = nm * np.linalg.norm(modal.shapes, axis=1) / resonant
    response = Response(
        drive_hz=blocks.drive_hz,
        step_index=blocks.step_index,
        volts=blocks.volts,
        names=fit.names,
        amplitude_nm=np.abs(modal.modal_rad) * nm_per_rad,
        peak=peak_amplitudes(fit, points, wavelength_m),
        off=modal.off,
        wavelength_m=wavelength_m,
    )
    modes = [_with_amplitudes(each, found) for each in (fit.resonances, fit.not_sure)]
    return response, modes[0], modes[1]


def _with_amplitudes(
    resonances: Mapping[str, Resonance], found: Mapping[str, ModeAmplitude]
) -> dict[str, Resonance]:
    return {
        name: replace(
            resonance,
            amplitude_nm=found[name].nm,
            amplitude_error_nm=found[name].error_nm,
            nm_per_v=found[name].nm_per_v,
            nm_per_v_error=found[name].nm_per_v_error,
            largest_m=(found[name].x_m, found[name].y_m),
        )
        for name, resonance in resonances.items()
    }


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
