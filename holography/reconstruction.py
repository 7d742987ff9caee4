"""Reconstruct the light field around the reed from the frames of one step.

The runner reconstructs while it measures. The reader of a run file that kept frames reconstructs
later. Both use this module, so they get identical results.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from holography.demodulation import four_phase, unused_combination
from holography.fresnel import FresnelTransform
from holography.phase import SteadyTurn, steady_turn
from holography.region import Region

# Mean square of a Hann window, which is what it leaves of white noise; and the correlation of noise
# at neighbouring pixels, and at the next ones, of an image under it: the window is the sum
# (−¼, ½, −¼) over neighbours.
_HANN_POWER, _HANN_CORRELATION = 3 / 8, (-2 / 3, 1 / 6)


@dataclass(frozen=True)
class Reconstruction:
    """Geometry of a run, which turns its frames into fields.

    Attributes
    ----------
    transform : FresnelTransform
        Transform between sensor and reed, for the shape of the frames.
    region : Region
        Part of the object image that holds the reed.
    """

    transform: FresnelTransform
    region: Region

    @property
    def empty(self) -> Region:
        """Return the part of the object image that holds only noise, see `empty_region`."""
        return empty_region(self.transform.shape, self.region)

    def only_noise(self, image: npt.NDArray[np.complex64]) -> npt.NDArray[np.complex64]:
        """Return the empty region of an image, without the side lobes of the reed's light.

        A rectangular sensor spreads some 10⁻⁴ of the reed's light over the empty region, as much as
        a tenth of the noise where that is small. The region lies beyond the reed along one axis; a
        Hann window along it removes that light. Noise keeps its power per pixel.

        Parameters
        ----------
        image : (..., ny, nx) complex64
            In the object plane.

        Returns
        -------
        (..., rows, columns) complex64
        """
        empty, axis = self.empty, self._window_axis
        start, count = ((empty.row, empty.height), (empty.column, empty.width))[axis]
        windowed = self.transform.of_windowed(image, start, count, axis)
        scaled: npt.NDArray[np.complex64] = windowed * np.float32(_HANN_POWER**-0.5)
        return scaled

    @property
    def _window_axis(self) -> int:
        """Axis along which the empty region lies beyond the reed: it spans the other one."""
        return 0 if self.empty.width == self.transform.shape[1] else 1

    @property
    def independent_noise(self) -> float:
        """Return how many independent pixels know as much of the noise as the empty region does.

        Mean ``|H|²`` of circular Gaussian noise over n pixels in a row has the relative variance
        ``(1 + 2 Σ (1 − k/n) ρ_k²) / n`` with the correlation ρ_k of pixels k apart.
        """
        empty = self.empty
        along = (empty.height, empty.width)[self._window_axis]
        shared = sum(
            2 * max(1 - k / along, 0.0) * rho**2 for k, rho in enumerate(_HANN_CORRELATION, 1)
        )
        return empty.height * empty.width / (1 + shared)

    def field(self, frames: npt.ArrayLike) -> npt.NDArray[np.complex64]:
        """Return the field around the reed from four frames.

        Parameters
        ----------
        frames : (4, ny, nx) uint16

        Returns
        -------
        (height, width) complex64

        Raises
        ------
        ValueError
            If the frames are not four images of the sensor's shape.
        """
        return self.quadratures(frames).field

    def quadratures(self, frames: npt.ArrayLike) -> "Quadratures":
        """Return both halves of a hologram, I0 − I2 and I1 − I3, in the object plane.

        Parameters
        ----------
        frames : (4, ny, nx) uint16

        Raises
        ------
        ValueError
            If the frames are not four images of the sensor's shape.
        """
        hologram = four_phase(frames)
        images = [self.transform.to_object(part) for part in (hologram.real, hologram.imag)]
        even, odd = (self.region.crop(image).copy() for image in images)
        empty = np.stack([self.only_noise(image) for image in images])
        return Quadratures(even, odd, empty)

    def steady_turn(self, frames: npt.ArrayLike, halves: "Quadratures") -> SteadyTurn:
        """Measure the phase turn between four frames, see `holography.phase.steady_turn`.

        Parameters
        ----------
        frames : (4, ny, nx) uint16
        halves : Quadratures
            Result of `quadratures` for these frames.
        """
        unused = self.region.crop(self.transform.to_object(unused_combination(frames)))
        # A hologram holds the noise of four frames.
        return steady_turn(halves.even, halves.odd, unused, 0.25 * halves.noise)


@dataclass(frozen=True, eq=False)
class Quadratures:
    """The two halves of a hologram, each transformed to the object plane.

    Attributes
    ----------
    even, odd : (height, width) complex64
        Images of I0 − I2 and I1 − I3 around the reed.
    empty : (2, rows, columns) complex64
        Both images in the region that holds only noise, see `Reconstruction.only_noise`.
    """

    even: npt.NDArray[np.complex64]
    odd: npt.NDArray[np.complex64]
    empty: npt.NDArray[np.complex64]

    @property
    def field(self) -> npt.NDArray[np.complex64]:
        """Return the field (height, width) complex64 around the reed, see `four_phase`."""
        field: npt.NDArray[np.complex64] = self.even + np.complex64(1j) * self.odd
        return field

    @property
    def noise(self) -> float:
        """Return the mean ``|H|²`` of the region that holds only noise."""
        return mean_power(self.empty[0] + np.complex64(1j) * self.empty[1])


def mean_power(field: npt.NDArray[np.complex64]) -> float:
    """Return the mean ``|H|²`` of a field."""
    return float(np.mean(np.square(field.real)) + np.mean(np.square(field.imag)))


def empty_region(shape: tuple[int, int], region: Region) -> Region:
    """Return a part of an object image that neither the reed's image nor its twin image reaches.

    The twin image is the reed's point reflection in the optical axis, out of focus. Four strips
    remain on the left, right, above and below both images; the result is the outer half of the
    largest one.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the image.
    region : Region
        Region of the reed's image.

    Returns
    -------
    Region
    """
    strips = []
    for axis, (count, start, length) in enumerate(
        zip(shape, (region.row, region.column), (region.height, region.width), strict=True)
    ):
        mirrored = 2 * (count // 2) - start - length + 1
        before = min(start, mirrored)
        after = count - max(start, mirrored) - length
        for free, at_end in ((before, False), (after, True)):
            depth = max(free // 2, 1)
            strips.append((depth * shape[1 - axis], axis, count - depth if at_end else 0, depth))
    _, axis, start, depth = max(strips)
    if axis == 0:
        return Region(start, 0, depth, shape[1])
    return Region(0, start, shape[0], depth)
