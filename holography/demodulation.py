"""Four frames → one complex hologram, and what the four frames let through besides.

Frame m = 0…3 starts at ``m / f_CCD``. A beat ``2 Re[c exp(2πi·offset·t)]`` between object light
and local oscillator (LO) is stepped in quadrature when ``offset = -f_CCD/4``; with the LO shifted
by ``n·f + f_CCD/4`` that is the beat of sideband n (``docs/decisions/0001``).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.optimize

NOMINAL_STEPS_RAD = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)

# Cast strip by strip: four strips stay in the cache.
_STRIP_ROWS = 128
# Wider than a fringe or a speckle, narrower than the profile of a beam.
_BACKGROUND_PX = 65
# Beyond this fringes and background are told apart by noise.
_WORST_CONDITION = 15.0
# Three degrees. Series without fringes, or stepped through fewer than three phases, exceed it.
_WORST_STEP_ERROR_RAD = 0.05
# Starting points of the fit of the steps, relative to the nominal ones.
_STEP_SCALES = (1.0, 0.6, 0.8, 1.2)


def four_phase(
    frames: npt.ArrayLike, out: npt.NDArray[np.complex64] | None = None
) -> npt.NDArray[np.complex64]:
    """Demodulate four frames in quadrature, ``H = (I0 - I2) + j(I1 - I3)``.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        uint8, uint16 or float32. Unsigned frames do not wrap; other real types are rounded to
        float32.
    out : ndarray of complex64, shape (ny, nx), optional
        Where to put the hologram.

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
    E and E_LO are amplitudes of ``exp(+2πiνt)``. With that time factor light that diverges from
    the object carries ``exp(-ikr)``, which is what `holography.fresnel` focuses at a positive
    distance.
    """
    frames = _four_frames(frames)
    if out is None:
        out = np.empty(frames.shape[1:], dtype=np.complex64)
    elif out.shape != frames.shape[1:] or out.dtype != np.complex64:
        raise ValueError(
            f"four_phase: out is {out.dtype} {out.shape}, the hologram complex64 "
            f"{frames.shape[1:]}; hand in an array of that type and shape"
        )
    for top in range(0, out.shape[0], _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        strip = frames[:, rows].astype(np.float32)
        np.subtract(strip[0], strip[2], out=out.real[rows])
        np.subtract(strip[1], strip[3], out=out.imag[rows])
    return out


def unused_combination(frames: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return ``(I0 + I2) - (I1 + I3)``, which a hologram does not use.

    In exact quadrature background and fringes cancel in it.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        uint8, uint16 or float32.

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
    """How four real frames were stepped.

    The frames are ``I_m = powers[m] · (a + visibilities[m] · 2 Re[c exp(-i·steps_rad[m])])``.

    Attributes
    ----------
    steps_rad : ndarray of float64, shape (4,)
        Cumulative phase steps; the first is 0. ``(0, π/2, π, 3π/2)`` is exact quadrature.
    powers : ndarray of float64, shape (4,)
        Mean intensity of each frame, relative to the mean of all.
    visibilities : ndarray of float64, shape (4,)
        Fringe amplitude of each frame over its mean intensity, relative to the mean of all.
        Ones where the whole light drifted; not ones where one of the two beams did.
    closure : float
        `closure` of the frames as they came, before any correction. NaN where it was not measured.
    error_rad : float
        Standard error of the steps, where covariances scatter by the mean variance of the frames
        over the square root of the number of pixels. NaN where it was not measured.
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
        uint8, uint16 or float32. Many fringes or speckles are needed (the phase must take all
        values with equal weight, independently of the background).

    Returns
    -------
    PhaseSteps
        Of ``±θ``, which no series can tell apart, the one whose steps are nearer to +π/2; each
        step is within π of that.

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers, a frame is dark, there are no fringes
        above the noise, or they were not stepped.

    Notes
    -----
    The principal components of the frames minus their mean presume ``Σ exp(iθ_m) = 0``: the mean
    of unequally stepped frames contains fringes. On the public Fresnel lens series they are wrong
    by up to 40° per step; the covariance fit agrees with the phases of its off-axis carrier within
    1.5° (``tests/peers/test_public_holograms.py``).
    """
    frames = _four_frames(frames)
    means = frames.mean(axis=(1, 2), dtype=np.float64)
    if not means.min() > 0:
        raise ValueError(
            f"measure_phase_steps: mean intensities are {means.round(3)}; "
            "every frame needs light, take the series again"
        )
    powers = means / means.mean()
    covariance = _covariance(frames, powers)
    amplitudes, steps_rad, error_rad = _fit_covariance(covariance, frames[0].size)
    if not error_rad < _WORST_STEP_ERROR_RAD:
        raise ValueError(
            "measure_phase_steps: the frames hold no stepped fringes above their noise; "
            "check LO detuning and measure the steps on a series with more object light"
        )
    visibilities = amplitudes / amplitudes.mean()
    return PhaseSteps(steps_rad, powers, visibilities, closure(frames), error_rad)


def unequal_steps(frames: npt.ArrayLike, steps: PhaseSteps) -> npt.NDArray[np.complex64]:
    """Demodulate four frames whose steps and powers are known, by least squares per pixel.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        uint8, uint16 or float32.
    steps : PhaseSteps
        Of this series.

    Returns
    -------
    ndarray of complex64, shape (ny, nx)
        ``4c`` of the model of `PhaseSteps`; for exact steps and equal powers, `four_phase`.

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers, or the steps cannot tell fringes from
        background (fewer than three different phases).
    """
    frames = _four_frames(frames)
    inverse = np.linalg.pinv(_design(steps))
    weights = 4 * (inverse[1] + 1j * inverse[2]) / steps.powers
    hologram = np.empty(frames.shape[1:], dtype=np.complex64)
    hologram.real = _combine(weights.real, frames)
    hologram.imag = _combine(weights.imag, frames)
    return hologram


def closure(frames: npt.ArrayLike, steps: PhaseSteps | None = None) -> float:
    """What four frames contain that background and fringes cannot explain, relative to the fringes.

    Parameters
    ----------
    frames : array_like, shape (4, ny, nx)
        uint8, uint16 or float32.
    steps : PhaseSteps, optional
        Without it exact quadrature and equal powers are presumed.

    Returns
    -------
    float
        ``rms(I0 + I2 - I1 - I3) / rms(H)`` without `steps`; with them the same of the one
        combination of frames in which background and fringes cancel. The floor is noise: σ of
        the frames gives ``2σ / rms(H)``.

    Raises
    ------
    ValueError
        If the frames are not four images of real numbers, hold no fringes, or the steps cannot
        tell fringes from background.
    """
    frames = _four_frames(frames)
    if steps is None:
        ones = np.ones(4)
        steps = PhaseSteps(np.array(NOMINAL_STEPS_RAD), ones, ones)
    left = np.linalg.svd(_design(steps))[0]
    # The unit vector that is orthogonal to the model; (1, -1, 1, -1)/2 in quadrature.
    residual = _combine(2 * left[:, 3] / steps.powers, frames)
    fringes = _rms(unequal_steps(frames, steps))
    if not fringes > 1e-6 * _rms(frames[0]):  # the rounding of float32
        raise ValueError("closure: all frames are equal; check light, shutter and LO")
    return _rms(residual) / fringes


def sideband_gain(
    offset_hz: npt.ArrayLike, frame_rate_hz: float, exposure_s: float
) -> npt.NDArray[np.complex128]:
    """Complex gain of the four-phase demodulation for one beat.

    ``H = Σ_m (1, j, -1, -j)_m · 2 Re[c ⟨exp(2πi·offset·t)⟩_m] = G(offset) c + G(-offset) conj(c)``
    where ⟨ ⟩_m is the mean over the exposure of frame m, from ``m / frame_rate_hz`` on.

    Parameters
    ----------
    offset_hz : array_like
        Frequency of the beat, light minus LO. That of sideband k with the LO tuned to sideband n
        is ``(k - n)·f - f_CCD/4``.
    frame_rate_hz : float
        Frame rate ``f_CCD``.
    exposure_s : float
        Exposure of one frame, at most ``1 / frame_rate_hz``.

    Returns
    -------
    ndarray of complex128
        G, in the unit "mean of one frame": 4 sinc(1/4) = 3.60 in modulus at ``-f_CCD/4`` with a
        full exposure, 4 with a short one; it vanishes at the offsets 0, ``+f_CCD/4`` and
        ``f_CCD/2``.

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
    """How much unshifted light a hologram of one sideband lets through.

    The LO is tuned to ``order·f + f_CCD/4``. The amplitude of the unshifted light in the hologram,
    relative to that of the sideband, is this figure times ``|J_0(φ) / J_order(φ)|``.

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
        Count only the carrier that lands on the image. Its twin, which an off-axis crop removes,
        is counted by default (rms over the random phase of speckle).

    Returns
    -------
    ndarray of float64
        Of the shape of `drive_hz`. With order 1, zero at odd multiples of ``f_CCD/4``; off axis
        at odd multiples of ``f_CCD/2`` too.

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
    # One part in 10⁹ for an exposure computed as 1 / frame rate.
    if not (frame_rate_hz > 0 and 0 < exposure_s * frame_rate_hz <= 1 + 1e-9):
        raise ValueError(
            f"four-phase demodulation: frame rate {frame_rate_hz} Hz with exposure {exposure_s} s; "
            "both are positive and an exposure lasts at most one frame"
        )


def _covariance(
    frames: npt.NDArray[np.generic], powers: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Covariance of the normalised frames without their smooth background, shape (4, 4)."""
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
    """Fringe amplitudes and steps, both of shape (4,), and the standard error of the steps."""
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
    """Cumulative steps from 0, each within π of π/2, in the direction of most quadrature."""
    increments = np.diff(phases_rad)
    if np.sum(np.sin(increments)) < 0:
        increments = -increments
    near_quadrature = np.angle(np.exp(1j * (increments - np.pi / 2))) + np.pi / 2
    return np.concatenate(([0.0], np.cumsum(near_quadrature)))


def _design(steps: PhaseSteps) -> npt.NDArray[np.float64]:
    """Matrix (4, 3) from background, real and imaginary part of c to the normalised frames."""
    design = np.ones((4, 3))
    design[:, 1] = 2 * steps.visibilities * np.cos(steps.steps_rad)
    design[:, 2] = 2 * steps.visibilities * np.sin(steps.steps_rad)
    if not np.linalg.cond(design) < _WORST_CONDITION:
        raise ValueError(
            f"phase steps of {np.rad2deg(steps.steps_rad).round(1)} degrees with visibilities "
            f"{steps.visibilities.round(2)} do not tell fringes from background; "
            "check LO detuning and light, and take the series again"
        )
    return design


def _combine(
    weights: npt.NDArray[np.float64], frames: npt.NDArray[np.generic]
) -> npt.NDArray[np.float32]:
    """Weighted sum of the frames."""
    total = np.zeros(frames.shape[1:], dtype=np.float32)
    for weight, frame in zip(weights.astype(np.float32), frames, strict=True):
        total += np.multiply(frame, weight, dtype=np.float32, casting="same_kind")
    return total


def _rms(field: npt.NDArray[np.generic]) -> float:
    modulus = np.abs(field).astype(np.float64)
    return float(np.sqrt(np.mean(modulus**2)))
