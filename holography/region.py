"""Rectangular regions of an image, such as the part of a reconstruction with the reed."""

import math
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from holography.fresnel import FresnelTransform

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Region:
    """Rectangular region of whole pixels.

    Attributes
    ----------
    row, column : int
        First row and first column, counted from 0.
    height, width : int
        Number of rows and of columns.

    Raises
    ------
    ValueError
        If the origin is negative or the size is not positive.
    """

    row: int
    column: int
    height: int
    width: int

    def __post_init__(self) -> None:
        if self.row < 0 or self.column < 0 or self.height < 1 or self.width < 1:
            raise ValueError(f"{self}: give an origin of at least 0 and a size of at least 1")

    @property
    def slices(self) -> tuple[slice, slice]:
        """Return the rows and columns as slices."""
        return (
            slice(self.row, self.row + self.height),
            slice(self.column, self.column + self.width),
        )

    def crop(self, image: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """Return a view of the region in an image.

        Parameters
        ----------
        image : ndarray, shape (..., ny, nx)

        Returns
        -------
        ndarray, shape (..., height, width)
            View, which shares memory with `image`.

        Raises
        ------
        ValueError
            If the region leaves the image.
        """
        self.require_inside(image.shape)
        view: npt.NDArray[Scalar] = image[(..., *self.slices)]
        return view

    def paste(self, field: npt.NDArray[Scalar], shape: tuple[int, int]) -> npt.NDArray[Scalar]:
        """Return an image with `field` in the region and zeros elsewhere; adjoint of `crop`.

        Parameters
        ----------
        field : ndarray, shape (..., height, width)
        shape : tuple of int
            Rows and columns of the image, ``(ny, nx)``.

        Returns
        -------
        ndarray, shape (..., ny, nx)
            Image with the dtype of `field`.

        Raises
        ------
        ValueError
            If `field` has another size than the region, or the region leaves the image.
        """
        if field.shape[-2:] != (self.height, self.width):
            raise ValueError(
                f"{self}: the field to paste has shape {field.shape}; "
                f"give one whose last axes are {(self.height, self.width)}"
            )
        self.require_inside(shape)
        image = np.zeros((*field.shape[:-2], *shape), dtype=field.dtype)
        image[(..., *self.slices)] = field
        return image

    def require_inside(self, shape: tuple[Any, ...]) -> None:
        """Raise a ValueError if the region leaves an image of a shape (..., ny, nx)."""
        rows, columns = shape[-2:]
        if self.row + self.height > rows or self.column + self.width > columns:
            raise ValueError(
                f"{self}: leaves the image of {rows}x{columns} pixels; "
                "move the region, or use the image for which it was made"
            )


def region_from_metres(
    centre_m: tuple[float, float], size_m: tuple[float, float], transform: FresnelTransform
) -> Region:
    """Return the smallest region of an object image that covers a rectangle given in metres.

    Parameters
    ----------
    centre_m : tuple of float
        Centre ``(y, x)`` of the rectangle relative to the optical axis, in m, positive towards
        higher rows and columns.
    size_m : tuple of float
        Height and width of the rectangle, in m.
    transform : FresnelTransform
        Transform that gives pitch and shape of the object image. Pixel i covers
        ``(i - 1/2, i + 1/2)`` pitches, counted from the axis.

    Returns
    -------
    Region

    Raises
    ------
    ValueError
        If a size is not positive, or the rectangle leaves the object plane.
    """
    starts, counts = [], []
    for centre, size, pitch, count in zip(
        centre_m, size_m, transform.object_pitch_m, transform.shape, strict=True
    ):
        axis_edge = count // 2 + 0.5
        start = math.floor((centre - size / 2) / pitch + axis_edge)
        stop = math.ceil((centre + size / 2) / pitch + axis_edge)
        if not size > 0 or start < 0 or stop > count:
            raise ValueError(
                f"region_from_metres: {size:g} m around {centre:g} m leaves the object plane of "
                f"{count} pixels of {pitch:.4g} m; give a positive size within "
                f"{-axis_edge * pitch:.4g} to {(count - axis_edge) * pitch:.4g} m"
            )
        starts.append(start)
        counts.append(stop - start)
    return Region(starts[0], starts[1], counts[0], counts[1])
