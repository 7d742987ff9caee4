"""Fresnel propagation of light from a small part of the object plane."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft

from holography.arrays import Array
from holography.fresnel import Complex64Array, FresnelTransform
from holography.region import Region


@dataclass(frozen=True)
class RegionTransform:
    """`FresnelTransform.to_sensor` of light that all comes from one region of the object plane.

    The discrete Fourier transform runs along the rows of the region only, then along all columns.
    Chirps are applied as vectors, those along rows before the columns are filled.

    Attributes
    ----------
    transform : FresnelTransform
    region : Region
        In the object plane of the transform.
    offset : tuple of float
        Where the light of each pixel really comes from, in pixels of the object plane from the
        middle of its pixel, along y and x. The phase that the distance from the middle adds on the
        object plane is left out.

    Raises
    ------
    ValueError
        If the region leaves the object plane.
    """

    transform: FresnelTransform
    region: Region
    offset: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        self.region.require_inside(self.transform.shape)

    def to_sensor(self, light: Complex64Array) -> Complex64Array:
        """Return the field on the sensor.

        Parameters
        ----------
        light : (height, width) complex64
            Field in the region.

        Returns
        -------
        (ny, nx) complex64
            What `FresnelTransform.to_sensor` gives for the region in a dark object plane, with
            the light where the offset says.

        Raises
        ------
        ValueError
            If the light has another shape than the region.
        """
        if light.shape != self._image.shape:
            raise ValueError(
                f"RegionTransform: the light has shape {light.shape}; give one of the shape of the "
                f"region, {self._image.shape}"
            )
        ny, nx = self.transform.shape
        down, across = self._phasors
        part = scipy.fft.ifft(light * self._image, nx, axis=1, norm="ortho", overwrite_x=True)
        part *= across
        columns = scipy.fft.ifft(part, ny, axis=0, norm="ortho", overwrite_x=True)
        field: Complex64Array = columns.astype(np.complex64, copy=False)
        field *= down[:, None]
        return field

    @cached_property
    def _image(self) -> Complex64Array:
        """Chirp (height, width) of the region."""
        _, image = self.transform.cycles()
        rows, columns = (
            np.exp(-2j * np.pi * cycles[part])
            for cycles, part in zip(image, self.region.slices, strict=True)
        )
        chirp: Complex64Array = np.multiply.outer(rows, columns).astype(np.complex64)
        return chirp

    @cached_property
    def _phasors(self) -> tuple[Complex64Array, Complex64Array]:
        """Factors (ny,) and (nx,) on the sensor: its chirp, where the region lies, the offset.

        The cross term of the Fresnel integral is ``exp(2πi·x·u/(λz))``, and a pixel of the object
        plane is ``λz`` over the size of the sensor.
        """
        sensor, _ = self.transform.cycles()
        starts = (self.region.row, self.region.column)
        down, across = (
            np.exp(2j * np.pi * _turns(n, start, part) - 2j * np.pi * cycles).astype(np.complex64)
            for n, start, part, cycles in zip(
                self.transform.shape, starts, self.offset, sensor, strict=True
            )
        )
        return down, across


def _turns(count: int, start: int, offset: float) -> Array:
    """Return the phase in cycles (count,) of light that begins at a pixel and has an offset."""
    at = np.arange(count)
    return (start * at + offset * (at - count // 2)) / count
