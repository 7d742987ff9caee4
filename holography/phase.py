"""By how much the light turns from one frame to the next, measured from the frames themselves.

Four frames ``I_m = a + 2 Re[c exp(-i m δ)]`` give two differences, I0 − I2 and I1 − I3, in which
what does not beat is gone. On the image off the axis each shows the object alone, without its
twin; the second is the first turned by −δ, pixel by pixel.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

# A quarter of a turn per frame is what demodulation presumes.
_QUARTER_RAD = 0.5 * np.pi


@dataclass(frozen=True, slots=True)
class PhaseAdvance:
    """Turn of the light from one frame to the next, less a quarter of a turn.

    Attributes
    ----------
    error_rad : float
        Within ±π; NaN where there is no light. Positive where the light turns too fast: the
        difference of the synthesizers is then higher than the lock asks for.
    standard_error_rad : float
        From the noise of the image.
    """

    error_rad: float
    standard_error_rad: float


def phase_advance(
    even: npt.NDArray[np.complex64], odd: npt.NDArray[np.complex64], noise: float
) -> PhaseAdvance:
    """Measure the phase advance of one acquisition.

    Parameters
    ----------
    even, odd : (height, width) complex64
        Images of I0 − I2 and I1 − I3 in the region that the object's image fills.
    noise : float
        Mean ``|U|²`` of either where there is nothing but noise, in the same units.

    Returns
    -------
    PhaseAdvance
        With an infinite standard error where the region holds no more than noise.

    Notes
    -----
    The phase of ``Σ U1 U0*`` is that of all pixels, each weighted by its light. Its noise is
    circular: of N pixels with signal S and noise P per pixel it has the standard error
    ``√((2SP + P²) / 2N) / S``.
    """
    product = np.vdot(even, odd)
    power = 0.5 * (np.vdot(even, even).real + np.vdot(odd, odd).real)
    signal = float(power) / even.size - noise
    if not (signal > 0 and abs(product) > 0):
        return PhaseAdvance(np.nan, np.inf)
    # The second difference is the first turned by −δ: δ is minus the phase of the product.
    error_rad = float(np.angle(np.conj(product) * np.exp(-1j * _QUARTER_RAD)))
    spread = np.sqrt((2 * signal * noise + noise**2) / (2 * even.size)) / signal
    return PhaseAdvance(error_rad, float(spread))
