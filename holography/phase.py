"""By how much the light turns from one frame to the next, measured from the frames themselves.

Four frames ``I_m = a + 2 Re[c exp(-i m δ)]``, transformed to the object, show at the reed's image
``U_m = A + c exp(-i m δ)``: what does not beat, and the reed without its twin image, which turns
by −δ from each frame to the next.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.optimize

# A quarter of a turn per frame is what demodulation presumes.
_QUARTER_RAD = 0.5 * np.pi
# Advances per frame that are tried; finer than the width of the maximum, about a radian.
_TRIED_RAD = np.linspace(0.1, 2 * np.pi - 0.1, 257)

# What small phases of the four frames add to the turn that `steady_turn` finds, per frame. Least
# squares with an unknown image and background leave the component of dU/dδ across both: near a
# quarter of a turn only the first and the last frame count.
TURN_OF_FRAMES = (-1 / 3, 0.0, 0.0, 1 / 3)


@dataclass(frozen=True, slots=True)
class SteadyTurn:
    """How well four frames fit one image that turns steadily before a constant background.

    Attributes
    ----------
    error_rad : float
        Turn from one frame to the next less a quarter of a turn, within ±π; NaN without light.
        Positive where the light turns too fast.
    standard_error_rad : float
        From the noise of the image; infinite without light.
    unexplained : float
        Power that such an image does not explain, per power of the image; 0 is a perfect fit, and
        noise scatters around it. NaN without light.
    unexplained_error : float
        Its standard error from the noise of the image; infinite without light.
    signal_to_noise : float
        Power of the image in a hologram, per power of its noise; 0 without light.
    """

    error_rad: float
    standard_error_rad: float
    unexplained: float
    unexplained_error: float
    signal_to_noise: float


NO_TURN = SteadyTurn(np.nan, np.inf, np.nan, np.inf, 0.0)


def steady_turn(
    even: npt.NDArray[np.complex64],
    odd: npt.NDArray[np.complex64],
    unused: npt.NDArray[np.complex64],
    noise: float,
) -> SteadyTurn:
    """Fit a steady turn to all that four frames say besides their mean.

    Parameters
    ----------
    even, odd, unused : (height, width) complex64
        Images of I0 − I2, I1 − I3 and (I0 + I2) − (I1 + I3) in the region of the object's image.
    noise : float
        Mean power of one frame's image where there is nothing but noise, in the same units.

    Notes
    -----
    Frames ``U_m = A + c z^m + noise`` with ``z = exp(-iδ)`` differ from their mean by ``s(δ) c`` in
    the orthonormal combinations even/√2, odd/√2 and unused/2, whose noises are equal and
    independent. Of all δ that of most power along ``s(δ)`` is the most likely, whatever A and c are
    in each pixel. For N pixels of signal power S and noise P, its variance is
    ``P (1 + P / S|s|²) / (2 N S K)`` with ``K = |s'|² − |s†s'|² / |s|²``: 3 at a quarter of a turn,
    three times better than by I0 − I2 and I1 − I3 alone. What lies across ``s(δ)`` holds noise
    only, unless frames were lost or light, volts or path changed between them.
    """
    parts = np.stack([even.ravel(), odd.ravel(), unused.ravel()]).astype(np.complex128)
    parts *= np.array([1 / np.sqrt(2), 1 / np.sqrt(2), 0.5])[:, None]
    gram = parts @ parts.conj().T / even.size
    advance_rad = _most_power(gram)
    signature, slope = _signature(advance_rad), _slope(advance_rad)
    size = float(np.vdot(signature, signature).real)
    along = _power_along(gram, signature)
    image = along - noise
    if not image > 0:
        return NO_TURN
    across = float(np.trace(gram).real) - along - 2 * noise
    across_slope = abs(np.vdot(signature, slope)) ** 2 / size
    stiffness = float(np.vdot(slope, slope).real - across_slope)
    variance = noise * (1 + noise / image) * size / (2 * even.size * image * stiffness)
    return SteadyTurn(
        error_rad=float(np.angle(np.exp(1j * (advance_rad - _QUARTER_RAD)))),
        standard_error_rad=float(np.sqrt(variance)),
        unexplained=across / image,
        # Two dimensions of noise, and the cross term of what is unexplained with it.
        unexplained_error=float(np.sqrt(2 / even.size) * noise / image),
        signal_to_noise=image / noise if noise > 0 else np.inf,
    )


def _most_power(gram: npt.NDArray[np.complex128]) -> float:
    """Advance per frame at which the turning image has most power."""
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
    power = np.vdot(signature, gram @ signature).real / np.vdot(signature, signature).real
    return float(power)


def _signature(advance_rad: npt.ArrayLike) -> npt.NDArray[np.complex128]:
    """What a turning image is in the three combinations, shape (…, 3)."""
    z = np.exp(-1j * np.asarray(advance_rad, dtype=np.float64))
    parts = ((1 - z**2) / np.sqrt(2), (z - z**3) / np.sqrt(2), (1 - z + z**2 - z**3) / 2)
    return np.stack(parts, axis=-1)


def _slope(advance_rad: float) -> npt.NDArray[np.complex128]:
    """Derivative of the signature by the advance, shape (3,)."""
    z = np.exp(-1j * advance_rad)
    by_z = np.array([-2 * z / np.sqrt(2), (1 - 3 * z**2) / np.sqrt(2), (-1 + 2 * z - 3 * z**2) / 2])
    slope: npt.NDArray[np.complex128] = by_z * (-1j * z)
    return slope
