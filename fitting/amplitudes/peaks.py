"""Largest displacement of the reed in every hologram, and of each mode at its resonance.

All displacements are amplitudes (from rest to the largest deflection, half of peak to peak) out of
the plane of the reed. Light falls on the reed and is observed along its normal, so that the phase
amplitude is ``4πw/λ`` (T. Kreis, Handbook of Holographic Interferometry, 2005, section 4.1: the
sensitivity vector is then 4π/λ long and normal to the surface).
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fitting.amplitudes.vamp import VampPoints
from fitting.modal.identify import JointFit
from fitting.reed_place import moves
from holography.arrays import Array
from holography.fringes import displacement_m

Scalar = TypeVar("Scalar", np.float64, np.complex128)

# Relative error of a displacement that few functions continue from the blocks to the contour: 68 %
# of those of random canes are smaller (`python -m studies.amplitudes --continuation`).
_CONTINUATION = 1e-3
# Precision of amplitudes that a hologram does not determine, rad⁻²: 100 rad is 5 µm.
_LOOSE = 100.0**-2


@dataclass(frozen=True)
class PeakAmplitudes:
    """Largest displacement over the vamp in each of k holograms.

    Attributes
    ----------
    nm, error_nm : (k,) float
        Amplitude and its standard error; NaN where a hologram is not explained, and errors where
        the method does not know them.
    x_m, y_m : (k,) float
        Point of the largest displacement.
    """

    nm: Array
    error_nm: Array
    x_m: Array
    y_m: Array


@dataclass(frozen=True)
class ModeAmplitude:
    """Displacement of one mode, driven at its own eigenfrequency, where it moves most.

    Attributes
    ----------
    nm, error_nm : float
        Amplitude and its standard error.
    x_m, y_m : float
        Point of the largest displacement.
    volts : float
        Peak volts of the drive at that frequency.
    scatter : float
        Standard deviation of the drive around one that is smooth in frequency, in nepers: of what
        `nm` is measured with, over what the volts give on average.
    """

    nm: float
    error_nm: float
    x_m: float
    y_m: float
    volts: float
    scatter: float

    @property
    def nm_per_v(self) -> float:
        """Amplitude per peak volt of the drive."""
        return self.nm / self.volts

    @property
    def nm_per_v_error(self) -> float:
        """Its standard error, as another sweep with the same volts would have it."""
        return self.nm_per_v * float(np.hypot(self.error_nm / self.nm, self.scatter))


def peak_amplitudes(fit: JointFit, points: VampPoints, wavelength_m: float) -> PeakAmplitudes:
    """Return the largest displacement of the reed in every hologram.

    These are the displacements of the holograms themselves, before modes are fitted to them. Their
    errors come from the noise of the hologram, from the common-mode error, from the place of the
    reed in the image, and from the continuation to the contour.

    Parameters
    ----------
    fit : JointFit
    points : VampPoints
    wavelength_m : float
        Wavelength of the light.
    """
    found, functions = fit.displacements, points.functions
    u = found.amplitude_rad @ functions.T
    holograms, top = np.arange(len(u)), np.abs(u).argmax(axis=1)
    size = np.abs(u)[holograms, top]
    direction = u[holograms, top] / np.maximum(size, 1e-12)
    by = _along(direction, functions[top])
    information = found.information + _LOOSE * np.eye(by.shape[1])
    variance = np.einsum("ka,ka->k", by, np.linalg.solve(information, by[..., None])[..., 0])
    common = np.einsum("ka,kaq->kq", by, found.common_mode.response)
    shared = np.linalg.solve(found.common_mode.whole, common.T)
    variance += np.einsum("kq,qk->k", common, shared) + (_CONTINUATION * size) ** 2
    variance += (_by_magnitude(common) * fit.modal.magnitude_error) ** 2
    for k, point in enumerate(top):
        by_place = _by_place(points, point, found.amplitude_rad[k]) * direction[k].conj()
        variance[k] += by_place.real @ fit.block_amplitudes.place.covariance @ by_place.real
    known = found.reached & np.any(found.information, axis=(1, 2))
    nm = 1e9 * displacement_m(np.stack([size, np.sqrt(variance)]), wavelength_m)
    value, error = np.where(known, nm, np.nan)
    return PeakAmplitudes(value, error, points.x_m[top], points.y_m[top])


def mode_amplitudes(
    fit: JointFit, points: VampPoints, wavelength_m: float
) -> dict[str, ModeAmplitude]:
    """Return the displacement of each mode at its resonance, by name.

    The modal fit moves all displacements within their common-mode error, to make up for shapes
    that are not exactly those of the finite elements. It adds this move to the displacements, so
    that a turn of their phase by 0.1 rad increases them by 0.5 %. The holograms alone determine
    their size better: the mode is scaled by what the move has done at its largest point, in the
    explained hologram nearest to its resonance. The error comes from the covariance of the modal
    fit, from the common-mode error of the holograms, from the place of the reed in the image, and
    from the continuation to the contour.

    Parameters
    ----------
    fit : JointFit
    points : VampPoints
    wavelength_m : float
        Wavelength of the light.
    """
    found, modal, functions = fit.displacements, fit.modal, points.functions
    log_hz, answer = np.log(fit.block_amplitudes.drive_hz), {}
    explained = found.reached & np.any(found.information, axis=(1, 2)) & ~modal.off
    # If none is, no mode is identified.
    unlikely = np.where(explained | ~explained.any(), 0.0, np.inf)
    for a, name in enumerate(fit.names):
        moved = functions @ modal.resonant.amplitude_rad[a]
        top = int(np.abs(moved).argmax())
        nearest = int((np.abs(log_hz - np.log(modal.hz[a])) + unlikely).argmin())
        here = functions[top] @ found.amplitude_rad[nearest]
        response = found.common_mode.response[nearest]
        real, imaginary = np.split(response @ modal.common_mode_shift[nearest], 2)
        there = here + functions[top] @ (real + 1j * imaginary)
        # What nothing shows is as the modal fit has it.
        rad = abs(moved[top]) * (abs(here) / abs(there) if here and there else 1.0)
        by = _along(np.array([here]), functions[top : top + 1])[0]
        common = by @ response / max(abs(here) ** 2, 1e-12)
        own = functions[top] @ modal.resonant.covariance[a] @ functions[top]
        shared = common @ np.linalg.solve(found.common_mode.whole, common) + _CONTINUATION**2
        shared += (_by_magnitude(common) * modal.magnitude_error[nearest]) ** 2
        by_place = _by_place(points, top, modal.resonant.amplitude_rad[a])
        own += by_place @ fit.block_amplitudes.place.covariance @ by_place
        nm, error_nm = 1e9 * displacement_m([rad, np.sqrt(own + rad**2 * shared)], wavelength_m)
        log_volts = np.interp(np.log(modal.hz[a]), log_hz, np.log(fit.block_amplitudes.volts))
        # The drive at the resonance is interpolated between two holograms, and so is its scatter.
        share = np.interp(np.log(modal.hz[a]), log_hz, np.arange(len(log_hz))) % 1
        answer[name] = ModeAmplitude(
            nm=float(nm),
            error_nm=float(error_nm),
            x_m=float(points.x_m[top]),
            y_m=float(points.y_m[top]),
            volts=float(np.exp(log_volts)),
            scatter=modal.state.gain * float(np.hypot(share, 1 - share)),
        )
    return answer


def _by_place(points: VampPoints, point: int, amplitude: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return derivatives (4,) of the displacement at a point by the place of the reed.

    Amplitudes (j,) of the functions are fitted where the reed is taken to lie. If it lies
    elsewhere, they give the displacement of another point of it.
    """
    moved = moves(points.x_m[point], points.y_m[point])
    answer: NDArray[Scalar] = (points.slopes[:, point] @ amplitude) @ moved
    return answer


def _by_magnitude(common: Array) -> Array:
    """Return derivatives (...) by the magnitude of the object field, of those (..., q) by all."""
    return common[..., 0] if common.shape[-1] else np.zeros(common.shape[:-1])


def _along(direction: Array, functions: Array) -> Array:
    """Return derivatives (k, 2j) of displacements along unit vectors (k,) by amplitudes."""
    turned = direction[:, None] * functions
    return np.concatenate([turned.real, turned.imag], axis=1)
