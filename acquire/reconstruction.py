"""From the frames of one step to the light field around the reed.

The runner reconstructs while it measures, and the reader of a run file that kept its frames
reconstructs later; both do it here, so both get the same bits.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from holography.demodulation import four_phase
from holography.fresnel import FresnelTransform
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

    def image(self, frames: npt.ArrayLike) -> npt.NDArray[np.complex64]:
        """Object image (ny, nx) complex64 of four frames (4, ny, nx).

        Raises
        ------
        ValueError
            If the frames are not four images of the sensor's shape.
        """
        return self.transform.to_object(four_phase(frames))

    def field(self, frames: npt.ArrayLike) -> npt.NDArray[np.complex64]:
        """Field around the reed (height, width) complex64 of four frames (4, ny, nx).

        Raises
        ------
        ValueError
            As for `image`.
        """
        return self.region.crop(self.image(frames)).copy()


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
