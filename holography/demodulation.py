"""Four-phase demodulation: four frames → one complex hologram; phase steps and leakage.

Frame m = 0…3 starts at ``m / f_CCD``. A beat ``2 Re[c exp(2πi·offset·t)]`` between object light
and local oscillator (LO) advances by a quarter of a turn per frame if ``offset = -f_CCD/4``. With
the LO shifted by ``n·f + f_CCD/4``, this is the beat of sideband n (``docs/decisions/0001``).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.optimize

# Exact quadrature (``docs/decisions/0001``).
NOMINAL_STEPS_RAD = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)

# Rows that are converted at a time. Chosen: strips of four frames fit into the processor's cache.
_STRIP_ROWS = 128
# Width of the filter for the background, in pixels. Chosen: wider than a fringe or a speckle,
# narrower than the profile of a beam.
_BACKGROUND_PX = 65
# Largest condition number of the model of the frames. Chosen: above it, noise decides what counts
# as fringes and what as background.
_MAX_CONDITION = 15.0
# Largest standard error of a measured step. Chosen: three degrees; series without fringes, and
# series with fewer than three phases, exceed it.
_MAX_STEP_ERROR_RAD = 0.05
# Starting points of the fit of the steps, relative to the nominal steps. Chosen: from 0.6 to 1.2 of
# the nominal ones, because the fit has several minima.
_STEP_SCALES = (1.0, 0.6, 0.8, 1.2)


def four_phase(
    frames: npt.ArrayLike, out: npt.NDArray[np.complex64] | None = None
) -> npt.NDArray[np.complex64]:
    """Demodulate four frames in quadrature, ``H = (I0 - I2) + j(I1 - I3)``.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        Frames of uint8, uint16 or float32. Differences of unsigned frames do not wrap; other real
        types are rounded to float32.
    out : ndarray of complex64, shape (ny, nx), optional
        Array to which the hologram is written.

    Returns
    -------
    ndarray of complex64, shape (ny, nx)
        ``4c`` for frames ``I_m = a + 2 Re[c exp(-iπm/2)]``, with ``c = E · conj(E_LO)``.

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers, or `out` does not fit.

    Notes
    -----
    E and E_LO are amplitudes of ``exp(+2πiνt)``. With that time factor, light that diverges from
    the object has the phase factor ``exp(-ikr)``, which `holography.fresnel` focuses at a positive
    distance.
    """
    frames = _four_frames(frames)
    if out is None:
        out = np.empty(frames.shape[1:], dtype=np.complex64)
    elif out.shape != frames.shape[1:] or out.dtype != np.complex64:
        raise ValueError(
            f"four_phase: out is {out.dtype} {out.shape}, the hologram complex64 "
            f"{frames.shape[1:]}; give an array of that type and shape"
        )
    for top in range(0, out.shape[0], _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        strip = frames[:, rows].astype(np.float32)
        np.subtract(strip[0], strip[2], out=out.real[rows])
        np.subtract(strip[1], strip[3], out=out.imag[rows])
    return out


def unused_combination(frames: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return ``(I0 + I2) - (I1 + I3)``, which a hologram does not use.

    In exact quadrature, background and fringes cancel in it.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        Frames of uint8, uint16 or float32.

    Returns
    -------
    ndarray of float32, shape (ny, nx)

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers.
    """
    frames = _four_frames(frames)
    unused = np.empty(frames.shape[1:], dtype=np.float32)
    for top in range(0, len(unused), _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        strip = frames[:, rows].astype(np.float32)
        np.subtract(strip[0] + strip[2], strip[1] + strip[3], out=unused[rows])
    return unused


@dataclass(frozen=True, eq=False)
class PhaseSteps:
    """Measured phase steps of four frames, with the brightness and contrast of each frame.

    The frames are ``I_m = powers[m] · (a + visibilities[m] · 2 Re[c exp(-i·steps_rad[m])])``.

    Attributes
    ----------
    steps_rad : ndarray of float64, shape (4,)
        Cumulative phase steps; the first is 0. ``(0, π/2, π, 3π/2)`` is exact quadrature.
    powers : ndarray of float64, shape (4,)
        Mean intensity of each frame, relative to the mean of all.
    visibilities : ndarray of float64, shape (4,)
        Fringe amplitude of each frame divided by its mean intensity, relative to the mean of all.
        All are 1 if both beams drifted together; they differ if only one of the beams did.
    closure : float
        `closure` of the frames without any correction. NaN if it was not measured.
    error_rad : float
        Standard error of the steps, if covariances scatter by the mean variance of the frames
        divided by the square root of the number of pixels. NaN if it was not measured.
    """

    steps_rad: npt.NDArray[np.float64]
    powers: npt.NDArray[np.float64]
    visibilities: npt.NDArray[np.float64]
    closure: float = np.nan
    error_rad: float = np.nan


def measure_phase_steps(frames: npt.ArrayLike) -> PhaseSteps:
    """Measure steps, powers and visibilities from the frames alone.

    Powers come from the mean intensities, so the fringes must average out over the frame. Steps
    and visibilities come from the 4×4 covariance of the power-normalised, high-passed frames,
    ``C_mn = A + s_m s_n cos(θ_m - θ_n) + σ² δ_mn``: ten numbers for nine unknowns (variance A of
    the background, fringe amplitudes s, steps θ, noise σ²).

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        Frames of uint8, uint16 or float32, with many fringes or speckles: all values of the phase
        must be equally frequent, independently of the background.

    Returns
    -------
    PhaseSteps
        Frames cannot distinguish the steps θ from -θ. The sign is chosen such that the steps are
        nearer to +π/2; each step is within π of that.

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers, a frame is dark, there are no fringes
        above the noise, or the phase does not change from frame to frame.

    Notes
    -----
    A principal component analysis of the frames minus their mean would assume
    ``Σ exp(iθ_m) = 0``; the mean of frames with unequal steps contains fringes. On the public
    Fresnel lens series its steps are wrong by up to 40°, while the covariance fit agrees with the
    phases of the off-axis carrier within 1.5° (``tests/peers/test_public_holograms.py``).
    """
    frames = _four_frames(frames)
    means = frames.mean(axis=(1, 2), dtype=np.float64)
    if not means.min() > 0:
        raise ValueError(
            f"measure_phase_steps: mean intensities are {means.round(3)}; "
            "every frame needs light, measure the series again"
        )
    powers = means / means.mean()
    covariance = _covariance(frames, powers)
    amplitudes, steps_rad, error_rad = _fit_covariance(covariance, frames[0].size)
    if not error_rad < _MAX_STEP_ERROR_RAD:
        raise ValueError(
            "measure_phase_steps: the frames show no stepped fringes above their noise; "
            "check the frequency of the LO, and use a series with more object light"
        )
    visibilities = amplitudes / amplitudes.mean()
    return PhaseSteps(steps_rad, powers, visibilities, closure(frames), error_rad)


def unequal_steps(frames: npt.ArrayLike, steps: PhaseSteps) -> npt.NDArray[np.complex64]:
    """Demodulate four frames whose steps and powers are known, by least squares per pixel.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        Frames of uint8, uint16 or float32.
    steps : PhaseSteps
        Phase steps of these frames.

    Returns
    -------
    ndarray of complex64, shape (ny, nx)
        ``4c`` of the model of `PhaseSteps`. For exact quadrature and equal powers it equals the
        result of `four_phase`.

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers, or the steps do not separate fringes
        from background (fewer than three different phases).
    """
    frames = _four_frames(frames)
    inverse = np.linalg.pinv(_design(steps))
    weights = 4 * (inverse[1] + 1j * inverse[2]) / steps.powers
    hologram = np.empty(frames.shape[1:], dtype=np.complex64)
    hologram.real = _combine(weights.real, frames)
    hologram.imag = _combine(weights.imag, frames)
    return hologram


def closure(frames: npt.ArrayLike, steps: PhaseSteps | None = None) -> float:
    """Return the part of four frames that background and fringes do not explain.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        Frames of uint8, uint16 or float32.
    steps : PhaseSteps, optional
        Phase steps of the frames. Default: exact quadrature and equal powers.

    Returns
    -------
    float
        ``rms(I0 + I2 - I1 - I3) / rms(H)`` without `steps`. With `steps`, the same for the one
        combination of frames in which background and fringes cancel. Noise of standard deviation σ
        in each frame contributes ``2σ / rms(H)``.

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers, hold no fringes, or the steps do not
        separate fringes from background.
    """
    frames = _four_frames(frames)
    if steps is None:
        ones = np.ones(4)
        steps = PhaseSteps(np.array(NOMINAL_STEPS_RAD), ones, ones)
    left = np.linalg.svd(_design(steps))[0]
    # left[:, 3] is the unit vector orthogonal to the model; (1, -1, 1, -1)/2 in quadrature.
    residual = _combine(2 * left[:, 3] / steps.powers, frames)
    fringes = _rms(unequal_steps(frames, steps))
    # 1e-6 is the size of rounding errors in float32.
    if not fringes > 1e-6 * _rms(frames[0]):
        raise ValueError("closure: all frames are equal; check light, shutter and LO")
    return _rms(residual) / fringes


def sideband_gain(
    offset_hz: npt.ArrayLike, frame_rate_hz: float, exposure_s: float
) -> npt.NDArray[np.complex128]:
    """Return the complex gain of four-phase demodulation for beats of given frequencies.

    ``H = Σ_m (1, j, -1, -j)_m · 2 Re[c ⟨exp(2πi·offset·t)⟩_m] = G(offset) c + G(-offset) conj(c)``
    where ⟨ ⟩_m is the mean over the exposure of frame m, which begins at ``m / frame_rate_hz``.

    Parameters
    ----------
    offset_hz : array_like
        Frequency of the beat, light minus LO. For sideband k, with the LO tuned to sideband n, it
        is ``(k - n)·f - f_CCD/4``.
    frame_rate_hz : float
        Frame rate ``f_CCD``.
    exposure_s : float
        Exposure of one frame, at most ``1 / frame_rate_hz``.

    Returns
    -------
    ndarray of complex128
        Gain G, of the shape of `offset_hz`, in units of the mean of one frame. Its modulus at
        ``-f_CCD/4`` is 4 sinc(1/4) = 3.60 for an exposure of a whole frame, and 4 for a short one;
        it is 0 at the offsets 0, ``+f_CCD/4`` and ``f_CCD/2``.

    Raises
    ------
    ValueError
        If frame rate or exposure is not positive, or frames would overlap.
    """
    _require_timing(frame_rate_hz, exposure_s)
    offset = np.asarray(offset_hz, dtype=np.float64)
    frame_mean = np.sinc(offset * exposure_s) * np.exp(1j * np.pi * offset * exposure_s)
    turn = 1j * np.exp(2j * np.pi * offset / frame_rate_hz)
    gain: npt.NDArray[np.complex128] = np.asarray(
        frame_mean * (1 + turn) * (1 + turn**2), dtype=np.complex128
    )
    return gain


def carrier_leak(
    drive_hz: npt.ArrayLike,
    frame_rate_hz: float,
    exposure_s: float,
    order: int = 1,
    *,
    off_axis: bool = False,
) -> npt.NDArray[np.float64]:
    """Return how much of the carrier leaks into the hologram of one sideband.

    The LO is tuned to ``order·f + f_CCD/4``. The amplitude of the carrier (unshifted light) in the
    hologram, relative to that of the sideband, is the returned value times
    ``|J_0(φ) / J_order(φ)|``.

    Parameters
    ----------
    drive_hz : array_like
        Frequency f of the vibration.
    frame_rate_hz : float
        Frame rate ``f_CCD``.
    exposure_s : float
        Exposure of one frame, at most ``1 / frame_rate_hz``.
    order : int
        Sideband n to which the LO is tuned.
    off_axis : bool
        True counts only the carrier in the image. False also counts its twin image, as a root mean
        square over the random phase of speckle; a crop off axis removes the twin.

    Returns
    -------
    ndarray of float64
        Leak, of the shape of `drive_hz`. For order 1 it is zero at odd multiples of ``f_CCD/4``,
        and off axis also at odd multiples of ``f_CCD/2``.

    Raises
    ------
    ValueError
        If frame rate or exposure is not positive, or frames would overlap.
    """
    difference_hz = order * np.asarray(drive_hz, dtype=np.float64) + frame_rate_hz / 4
    leak = np.abs(sideband_gain(-difference_hz, frame_rate_hz, exposure_s))
    if not off_axis:
        leak = np.hypot(leak, np.abs(sideband_gain(difference_hz, frame_rate_hz, exposure_s)))
    selected = np.abs(sideband_gain(-frame_rate_hz / 4, frame_rate_hz, exposure_s))
    return np.asarray(leak / selected, dtype=np.float64)


def _four_frames(frames: npt.ArrayLike) -> npt.NDArray[np.generic]:
    frames = np.asarray(frames)
    if frames.ndim != 3 or len(frames) != 4 or frames.dtype.kind not in "uif":
        raise ValueError(
            f"four-phase demodulation: frames are {frames.dtype} {frames.shape}; "
            "give four real images of one shape, (4, rows, columns)"
        )
    return frames


def _require_timing(frame_rate_hz: float, exposure_s: float) -> None:
    # 1e-9 allows for the rounding of an exposure that was computed as 1 / frame rate.
    if not (frame_rate_hz > 0 and 0 < exposure_s * frame_rate_hz <= 1 + 1e-9):
        raise ValueError(
            f"four-phase demodulation: frame rate {frame_rate_hz} Hz with exposure {exposure_s} s; "
            "both must be positive, and an exposure lasts at most one frame"
        )


def _covariance(
    frames: npt.NDArray[np.generic], powers: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the covariance (4, 4) of the normalised frames without their smooth background."""
    fringes = []
    for frame, power in zip(frames, powers, strict=True):
        normalised = frame.astype(np.float32) / np.float32(power)
        normalised -= scipy.ndimage.uniform_filter(normalised, _BACKGROUND_PX, mode="reflect")
        fringes.append(normalised.ravel())
    covariance: npt.NDArray[np.float64] = np.cov(fringes, dtype=np.float64)
    return covariance


def _fit_covariance(
    covariance: npt.NDArray[np.float64], pixels: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]:
    """Return fringe amplitudes (4,), steps (4,) in rad, and the standard error of the steps."""
    scale = np.trace(covariance) / 4 or 1.0
    upper = np.triu_indices(4)
    measured = covariance[upper] / scale

    def misfit(unknowns: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        (background, noise), amplitudes, steps_rad = np.split(unknowns, (2, 6))
        phases = np.r_[0.0, steps_rad]
        model = np.outer(amplitudes, amplitudes) * np.cos(phases[:, None] - phases)
        model += background + noise * np.eye(4)
        difference: npt.NDArray[np.float64] = model[upper] - measured
        return difference

    lowest = np.r_[np.zeros(6), np.full(3, -np.inf)]
    fits = [
        scipy.optimize.least_squares(
            misfit,
            np.r_[0.1, 0.01, np.full(4, 0.9), factor * np.array(NOMINAL_STEPS_RAD[1:])],
            bounds=(lowest, np.inf),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        for factor in _STEP_SCALES
    ]
    best = min(fits, key=lambda fit: float(fit.cost))
    amplitudes: npt.NDArray[np.float64] = np.sqrt(scale) * best.x[2:6]
    _, stretch, directions = np.linalg.svd(np.asarray(best.jac, dtype=np.float64))
    variances = np.sum((directions / np.maximum(stretch, 1e-12)[:, None]) ** 2, axis=0) / pixels
    error_rad = float(np.sqrt(variances[6:].max()))
    return amplitudes, _forward(np.r_[0.0, best.x[6:]]), error_rad


def _forward(phases_rad: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return cumulative steps from 0, with the sign and multiples of 2π nearest to π/2 each."""
    increments = np.diff(phases_rad)
    if np.sum(np.sin(increments)) < 0:
        increments = -increments
    near_quadrature = np.angle(np.exp(1j * (increments - np.pi / 2))) + np.pi / 2
    return np.concatenate(([0.0], np.cumsum(near_quadrature)))


def _design(steps: PhaseSteps) -> npt.NDArray[np.float64]:
    """Return the matrix (4, 3) that maps background, Re c and Im c to the normalised frames."""
    design = np.ones((4, 3))
    design[:, 1] = 2 * steps.visibilities * np.cos(steps.steps_rad)
    design[:, 2] = 2 * steps.visibilities * np.sin(steps.steps_rad)
    if not np.linalg.cond(design) < _MAX_CONDITION:
        raise ValueError(
            f"phase steps of {np.rad2deg(steps.steps_rad).round(1)} degrees with visibilities "
            f"{steps.visibilities.round(2)} do not separate fringes from background; "
            "check the frequency of the LO and the light, and measure the series again"
        )
    return design


def _combine(
    weights: npt.NDArray[np.float64], frames: npt.NDArray[np.generic]
) -> npt.NDArray[np.float32]:
    """Return the weighted sum (ny, nx) of the frames."""
    total = np.zeros(frames.shape[1:], dtype=np.float32)
    for weight, frame in zip(weights.astype(np.float32), frames, strict=True):
        total += np.multiply(frame, weight, dtype=np.float32, casting="same_kind")
    return total


def _rms(field: npt.NDArray[np.generic]) -> float:
    modulus = np.abs(field).astype(np.float64)
    return float(np.sqrt(np.mean(modulus**2)))
