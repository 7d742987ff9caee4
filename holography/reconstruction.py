"""From the frames of one step to the light field around the reed.

The runner reconstructs while it measures, and the reader of a run file that kept its frames
reconstructs later; both do it here, so both get the same bits.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from holography.demodulation import four_phase, unused_combination
from holography.fresnel import FresnelTransform
from holography.phase import SteadyTurn, steady_turn
from holography.region import Region


@dataclass(frozen=True)
class Reconstruction:
    """How frames of one run become fields.

    Attributes
    ----------
    transform : FresnelTransform
        Between the sensor, of the shape of the frames, and the reed.
    region : Region
        Part of the object image that holds the reed.
    """

    transform: FresnelTransform
    region: Region

    @property
    def empty(self) -> Region:
        """Part of the object image that holds nothing but noise, see `empty_region`."""
        return empty_region(self.transform.shape, self.region)

    def field(self, frames: npt.ArrayLike) -> npt.NDArray[np.complex64]:
        """Field around the reed (height, width) complex64 of four frames (4, ny, nx).

        Raises
        ------
        ValueError
            If the frames are not four images of the sensor's shape.
        """
        return self.quadratures(frames).field

    def quadratures(self, frames: npt.ArrayLike) -> "Quadratures":
        """Both halves of a hologram, I0 − I2 and I1 − I3, on the object plane.

        Raises
        ------
        ValueError
            As for `field`.
        """
        hologram = four_phase(frames)
        images = [self.transform.to_object(part) for part in (hologram.real, hologram.imag)]
        even, odd = (self.region.crop(image).copy() for image in images)
        empty = np.stack([self.empty.crop(image) for image in images])
        return Quadratures(even, odd, empty)

    def steady_turn(self, frames: npt.ArrayLike, halves: "Quadratures") -> SteadyTurn:
        """How well four frames fit one steadily turning image, see `holography.phase.steady_turn`.

        Parameters
        ----------
        frames : (4, ny, nx)
        halves : Quadratures
            Of these frames.
        """
        unused = self.region.crop(self.transform.to_object(unused_combination(frames)))
        # A hologram holds the noise of four frames.
        return steady_turn(halves.even, halves.odd, unused, 0.25 * halves.noise)


@dataclass(frozen=True, eq=False)
class Quadratures:
    """A hologram in two halves, each transformed to the object plane.

    Attributes
    ----------
    even, odd : (height, width) complex64
        Images of I0 − I2 and I1 − I3 around the reed.
    empty : (2, rows, columns) complex64
        Of both, where there is nothing but noise.
    """

    even: npt.NDArray[np.complex64]
    odd: npt.NDArray[np.complex64]
    empty: npt.NDArray[np.complex64]

    @property
    def field(self) -> npt.NDArray[np.complex64]:
        """Field around the reed (height, width) complex64, see `four_phase`."""
        field: npt.NDArray[np.complex64] = self.even + np.complex64(1j) * self.odd
        return field

    @property
    def noise(self) -> float:
        """Mean |H|² of the field where there is nothing but noise."""
        return mean_power(self.empty[0] + np.complex64(1j) * self.empty[1])


def mean_power(field: npt.NDArray[np.complex64]) -> float:
    """Mean ``|H|²`` of a field."""
    return float(np.mean(np.square(field.real)) + np.mean(np.square(field.imag)))


def empty_region(shape: tuple[int, int], region: Region) -> Region:
    """Return the part of an object image that neither the reed's image nor its twin reaches.

    Of the four strips beside, above and below reed and twin image (the reed's point reflection in
    the optical axis, out of focus), the outer half of the largest.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the image.
    region : Region
        The reed's.

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
        for room, at_end in ((before, False), (after, True)):
            depth = max(room // 2, 1)
            strips.append((depth * shape[1 - axis], axis, count - depth if at_end else 0, depth))
    _, axis, start, depth = max(strips)
    if axis == 0:
        return Region(start, 0, depth, shape[1])
    return Region(0, start, shape[0], depth)
