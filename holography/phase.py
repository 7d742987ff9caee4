"""Measure the phase turn of the light from one frame to the next, in the frames themselves.

Four frames ``I_m = a + 2 Re[c exp(-i m δ)]``, transformed to the object, are
``U_m = A + c exp(-i m δ)`` at the image of the reed: A is light that does not beat, and c is the
image of the reed, whose phase turns by −δ from each frame to the next. The twin image is elsewhere.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.optimize

# Turn per frame that four-phase demodulation requires (``docs/decisions/0001``).
_QUARTER_RAD = 0.5 * np.pi
# Turns per frame that are tried first. Chosen: steps of 0.024 rad, much finer than the width of the
# maximum, which is about 1 rad.
_TRIED_RAD = np.linspace(0.1, 2 * np.pi - 0.1, 257)

# Change of the turn that `steady_turn` finds, per small phase error of each of the four frames.
# Derived from its least squares with unknown image and background at a quarter of a turn: only the
# first and the last frame count.
TURN_OF_FRAMES = (-1 / 3, 0.0, 0.0, 1 / 3)


@dataclass(frozen=True, slots=True)
class SteadyTurn:
    """Fit of four frames by one image whose phase turns uniformly, on a constant background.

    Attributes
    ----------
    error_rad : float
        Turn of the phase from one frame to the next minus a quarter of a turn, within ±π. Positive
        if the phase turns too fast; NaN without light.
    standard_error_rad : float
        Standard error of `error_rad` due to noise; infinite without light.
    unexplained : float
        Power that the fit does not explain, divided by the power of the image. 0 is a perfect fit,
        around which noise scatters; NaN without light.
    unexplained_error : float
        Standard error of `unexplained` due to noise; infinite without light.
    signal_to_noise : float
        Power of the image divided by the power of noise in one hologram; 0 without light.
    """

    error_rad: float
    standard_error_rad: float
    unexplained: float
    unexplained_error: float
    signal_to_noise: float


# Result for frames without light.
NO_TURN = SteadyTurn(np.nan, np.inf, np.nan, np.inf, 0.0)


def steady_turn(
    even: npt.NDArray[np.complex64],
    odd: npt.NDArray[np.complex64],
    unused: npt.NDArray[np.complex64],
    noise: float,
) -> SteadyTurn:
    """Fit a uniform turn of the phase to four frames, without their mean.

    Parameters
    ----------
    even, odd, unused : (height, width) complex64
        Images of I0 − I2, I1 − I3 and (I0 + I2) − (I1 + I3) in the region of the object's image.
    noise : float
        Mean power of the image of one frame where it holds noise only, in the same units.

    Returns
    -------
    SteadyTurn

    Notes
    -----
    Frames ``U_m = A + c z^m + noise`` with ``z = exp(-iδ)`` differ from their mean by ``s(δ) c`` in
    the orthonormal combinations even/√2, odd/√2 and unused/2, whose noise is equal and
    independent. The most likely δ is the one with the most power along ``s(δ)``, for any A and c
    in each pixel. For N pixels of signal power S and noise power P, its variance is
    ``P (1 + P / S|s|²) / (2 N S K)`` with ``K = |s'|² − |s†s'|² / |s|²``. K is 3 at a quarter of a
    turn, three times its value if only I0 − I2 and I1 − I3 are used. The components orthogonal to
    ``s(δ)`` hold noise only, unless frames were lost, or light, volts or optical path changed
    between frames.
    """
    parts = np.stack([even.ravel(), odd.ravel(), unused.ravel()]).astype(np.complex128)
    parts *= np.array([1 / np.sqrt(2), 1 / np.sqrt(2), 0.5])[:, None]
    gram = parts @ parts.conj().T / even.size
    advance_rad = _most_power(gram)
    signature, derivative = _signature(advance_rad), _derivative(advance_rad)
    size = float(np.vdot(signature, signature).real)
    along = _power_along(gram, signature)
    image = along - noise
    if not image > 0:
        return NO_TURN
    across = float(np.trace(gram).real) - along - 2 * noise
    derivative_along = abs(np.vdot(signature, derivative)) ** 2 / size
    curvature = float(np.vdot(derivative, derivative).real - derivative_along)
    variance = noise * (1 + noise / image) * size / (2 * even.size * image * curvature)
    return SteadyTurn(
        error_rad=float(np.angle(np.exp(1j * (advance_rad - _QUARTER_RAD)))),
        standard_error_rad=float(np.sqrt(variance)),
        unexplained=across / image,
        # Noise in the two components orthogonal to the signature.
        unexplained_error=float(np.sqrt(2 / even.size) * noise / image),
        signal_to_noise=image / noise if noise > 0 else np.inf,
    )


def _most_power(gram: npt.NDArray[np.complex128]) -> float:
    """Return the turn per frame, in rad, at which the turning image has the most power."""
    tried = _signature(_TRIED_RAD)
    powers = np.einsum("ki,ij,kj->k", tried.conj(), gram, tried).real
    best = int(np.argmax(powers / np.sum(np.abs(tried) ** 2, axis=1)))
    spacing_rad = _TRIED_RAD[1] - _TRIED_RAD[0]
    found = scipy.optimize.minimize_scalar(
        lambda advance_rad: -_power_along(gram, _signature(advance_rad)),
        bounds=(_TRIED_RAD[best] - spacing_rad, _TRIED_RAD[best] + spacing_rad),
        method="bounded",
        options={"xatol": 1e-7},
    )
    return float(found.x)


def _power_along(gram: npt.NDArray[np.complex128], signature: npt.NDArray[np.complex128]) -> float:
    """Return the mean power of the component along a signature."""
    power = np.vdot(signature, gram @ signature).real / np.vdot(signature, signature).real
    return float(power)


def _signature(advance_rad: npt.ArrayLike) -> npt.NDArray[np.complex128]:
    """Return the amplitudes (…, 3) of a turning image in the three combinations."""
    z = np.exp(-1j * np.asarray(advance_rad, dtype=np.float64))
    parts = ((1 - z**2) / np.sqrt(2), (z - z**3) / np.sqrt(2), (1 - z + z**2 - z**3) / 2)
    return np.stack(parts, axis=-1)


def _derivative(advance_rad: float) -> npt.NDArray[np.complex128]:
    """Return the derivative (3,) of the signature with respect to the turn per frame."""
    z = np.exp(-1j * advance_rad)
    by_z = np.array([-2 * z / np.sqrt(2), (1 - 3 * z**2) / np.sqrt(2), (-1 + 2 * z - 3 * z**2) / 2])
    derivative: npt.NDArray[np.complex128] = by_z * (-1j * z)
    return derivative
