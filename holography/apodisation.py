"""Images of a hologram whose edges are darkened, so that each pixel shows its own light.

Light ends at the edges of a sensor. The image of a point therefore has side lobes all over the
object plane: along an axis, a tenth of the light that a pixel shows comes from beyond its
neighbours. Where the reed vibrates differently there, this tenth darkens the pixel and adds noise.
A Tukey window takes the edges of the sensor down to zero over a fraction of its length. At more
than 1/fraction pixels, side lobes then fall by 18 dB per octave (F. J. Harris, Proc. IEEE 66, 51
(1978)). The price is resolution, and noise that neighbouring pixels have in common.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
import scipy.optimize
from scipy.linalg import toeplitz

from holography.arrays import Array, Complex64Array
from holography.fresnel import FresnelTransform
from holography.region import Region

# Points at which a window is sampled where its integrals are needed, and points of a pixel at which
# the image of a point is. With four times as many, fractions of light change by 5·10⁻⁵ at most.
_SAMPLES, _WITHIN_PIXEL = 4096, 16
# How well the fraction of a window is found.
_TOLERANCE = 1e-4
# Pixels of darkness around a region: side lobes that reach across them come back at its other end,
# with 10⁻⁶ of the power of the middle if a quarter of the sensor is darkened, less if more is.
_MARGIN = 16


@dataclass(frozen=True)
class Taper:
    """Tukey window along one axis of a sensor.

    Attributes
    ----------
    fraction : float
        Part of the sensor, half of it at either edge, over which it rises as half a cosine: 0 for
        no window, 1 for a Hann window.

    Raises
    ------
    ValueError
        If the fraction is not within 0 and 1.
    """

    fraction: float

    def __post_init__(self) -> None:
        if not 0 <= self.fraction <= 1:
            raise ValueError(f"Taper: fraction is {self.fraction}; give a number from 0 to 1")

    def window(self, count: int) -> Array:
        """Return the window (count,) float, at equal distances from one edge to before the other.

        Its mean square is 1: white noise keeps its power.
        """
        edge = np.minimum(np.arange(count), count - np.arange(count)) / count
        rising = edge < 0.5 * self.fraction
        cosine = np.cos(2 * np.pi * edge / max(self.fraction, 1 / count))
        window = np.where(rising, 0.5 - 0.5 * cosine, 1.0)
        scaled: Array = window / np.sqrt(np.mean(window**2))
        return scaled

    def light_from_beyond(self, pixels: int) -> float:
        """Return the fraction of a pixel's light that comes from farther away than some pixels."""
        place = np.arange(_SAMPLES) / _SAMPLES - 0.5
        distance = np.linspace(0, pixels, _WITHIN_PIXEL * pixels + 1)
        phase = 2 * np.pi * np.outer(distance, place)
        image = np.cos(phase) @ self.window(_SAMPLES) / _SAMPLES
        return float(1 - 2 * np.trapezoid(image**2, distance))

    def light_moments(self, pixels: int) -> tuple[Array, Array]:
        """Return the moments of where the light of some pixels comes from, as quadratic forms.

        Scatterers with random phases that show an image r at some pixels are likeliest ``PᴴC⁻¹r``,
        with the images P of points and their products C, the correlation of noise. The sum ``Σ r̄
        H`` of other images H of the same scatterers weights each by ``r̄ᵀ P(x) P(x)ᴴ C⁻¹ r``.

        Parameters
        ----------
        pixels : int
            Neighbours along an axis.

        Returns
        -------
        first, second : (pixels, pixels) float
            Matrices M for which ``Re r̄ᵀ M r / r̄ᵀ r`` is the mean position, and the mean squared
            position, in pixels from the middle.
        """
        place = np.arange(pixels) - 0.5 * (pixels - 1)
        among = toeplitz(self.noise_correlation(pixels))
        inverse = np.linalg.inv(among)
        turned = [0.5 * (np.diag(x) + among @ np.diag(x) @ inverse) for x in (place, place**2)]
        return turned[0], turned[1] + toeplitz(self._bend(pixels)) @ inverse

    def _bend(self, pixels: int) -> Array:
        """Return ``∫W'² cos(2πdν) / (4π² ∫W²)`` (pixels,) at distances d.

        At 0 it is the variance of the image of a point; without a window this has none, and 0 is
        returned. The product of the images of two points at p and q, of correlation ρ, has a mean
        squared position of ``½(p² + q²) ρ`` and this.
        """
        if not self.fraction:
            return np.zeros(pixels)
        place = np.arange(_SAMPLES) / _SAMPLES
        edge = np.minimum(place, 1 - place)
        rising = edge < 0.5 * self.fraction
        # Of a window that is 1 in the middle: W'² = 4π² slope², and ∫W² = 1 − 5/8 of the fraction.
        slope = np.where(rising, 0.5 * np.sin(2 * np.pi * edge / self.fraction) / self.fraction, 0)
        spectrum = scipy.fft.fft(slope**2).real / _SAMPLES
        return np.asarray(spectrum[:pixels] / (1 - 0.625 * self.fraction))

    def noise_correlation(self, pixels: int) -> Array:
        """Return the correlation (pixels,) float of white noise at pixels this far apart."""
        spectrum = scipy.fft.fft(self.window(_SAMPLES) ** 2).real / _SAMPLES
        return np.asarray(spectrum[:pixels])

    def independent_fraction(self, pixels: int) -> float:
        """Return the number of independent sums of `pixels` pixels, over that of all.

        Light scattered by a rough surface is correlated as its noise is. The noise of a sum that is
        weighted with this light has therefore ``Σ ρ²`` times the variance that white noise has,
        summed over all distances. What pixels of one sum have in common is left out.
        """
        among = self.noise_correlation(pixels)
        apart = np.abs(np.subtract.outer(np.arange(pixels), np.arange(pixels)))
        within = float(np.sum(among[apart] ** 2)) / pixels
        return within / float(np.mean(self.window(_SAMPLES) ** 4))


@lru_cache(maxsize=64)
def least_taper(pixels: int, light: float) -> Taper:
    """Return the least taper with which little light comes from farther away than some pixels.

    Parameters
    ----------
    pixels : int
    light : float
        Largest fraction of a pixel's light that may come from there.

    Raises
    ------
    ValueError
        If there is none: the image of a point is wider than that.
    """

    def excess(fraction: float) -> float:
        return Taper(fraction).light_from_beyond(pixels) - light

    if excess(1.0) > 0:
        raise ValueError(
            f"least_taper: with any window, more than {light:.2g} of the light of a pixel comes "
            f"from farther than {pixels} pixels; take more pixels together"
        )
    if excess(0.0) <= 0:
        return Taper(0.0)
    found = scipy.optimize.bisect(excess, 0.0, 1.0, xtol=_TOLERANCE)
    return Taper(min(float(found) + _TOLERANCE, 1.0))


def apodised(
    field: Complex64Array, transform: FresnelTransform, region: Region, tapers: tuple[Taper, Taper]
) -> Complex64Array:
    """Return the image of a region as if the sensor had a window.

    Parameters
    ----------
    field : (height, width) complex64
        Part of a result of `FresnelTransform.to_object`; the rest of the image is taken to be dark.
    transform : FresnelTransform
    region : Region
        Where this part lies.
    tapers : tuple of Taper
        Along rows and columns.

    Returns
    -------
    (height, width) complex64
        Without the chirp of the object plane, which is the same in all holograms.
    """
    chirp = region.crop(transform.object_chirp)
    size = [
        min(scipy.fft.next_fast_len(length + _MARGIN), whole)
        for length, whole in zip(field.shape, transform.shape, strict=True)
    ]
    spectrum = scipy.fft.fft2(field * chirp.conj(), size)
    rows, columns = (
        taper.window(n).astype(np.float32) for taper, n in zip(tapers, size, strict=True)
    )
    spectrum *= rows[:, None] * columns
    image = scipy.fft.ifft2(spectrum, overwrite_x=True)[: field.shape[0], : field.shape[1]]
    return np.ascontiguousarray(image, np.complex64)
