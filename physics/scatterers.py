"""Points of a reed that scatter light to the sensor."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, Complex64Array
from holography.fresnel import FresnelTransform
from holography.fresnel_region import RegionTransform
from holography.region import Region
from physics.optics import reed_axes_m, reed_region
from physics.parameters.optics import Layout
from physics.reed.geometry import Outline
from physics.reed.surface import on_reed

# Where the points of each lattice lie, in pixels of the image from their middle, along y and x. Two
# lattices put light at all places that an image of this sensor can tell from those of pixels.
_OFFSETS: dict[Literal[1, 2], tuple[tuple[float, float], ...]] = {
    1: ((0.0, 0.0),),
    2: ((-0.25, -0.25), (0.25, 0.25)),
}


@dataclass(frozen=True)
class _Lattice:
    """Points at one place in each pixel.

    Attributes
    ----------
    lit : (height, width) bool
        Pixels of the region whose point lies on the reed.
    transform : RegionTransform
        From these points to the sensor.
    """

    lit: NDArray[np.bool_]
    transform: RegionTransform


@dataclass(frozen=True)
class Scatterers:
    """Points of the reed's image, in one or two lattices of its pitch.

    Attributes
    ----------
    x_m, y_m : (n,) float
        Coordinates on the reed; lattice by lattice, row by row.
    region : Region
    lattices : tuple of _Lattice
    """

    x_m: Array
    y_m: Array
    region: Region
    lattices: tuple[_Lattice, ...]

    @classmethod
    def of(
        cls,
        layout: Layout,
        transform: FresnelTransform,
        outline: Outline,
        lattices: Literal[1, 2],
    ) -> "Scatterers":
        """Set up the points of one or two lattices on a reed."""
        region = reed_region(layout, transform)
        y, x = np.meshgrid(*reed_axes_m(layout, region, transform), indexing="ij")
        pitch_y, pitch_x = transform.object_pitch_m
        made, places = [], []
        for down, across in _OFFSETS[lattices]:
            at = x + across * pitch_x, y + down * pitch_y
            lit = on_reed(outline, *at)
            made.append(_Lattice(lit, RegionTransform(transform, region, (down, across))))
            places.append([each[lit] for each in at])
        x_m, y_m = (np.concatenate(each) for each in zip(*places, strict=True))
        return cls(x_m, y_m, region, tuple(made))

    def drawn(self, draw: Sequence[Complex64Array]) -> Complex64Array:
        """Return the values (n,) at the points, of one image (height, width) for each lattice."""
        return np.concatenate([each[a.lit] for each, a in zip(draw, self.lattices, strict=True)])

    def to_sensor(self, light: Complex64Array) -> Complex64Array:
        """Return the wave (ny, nx) on the sensor of light (n,) at the points.

        The phase that the distance of a point from the middle of its pixel adds is left out, as the
        phases of rough points are random.
        """
        ends = np.cumsum([np.count_nonzero(each.lit) for each in self.lattices])
        waves = []
        for each, part in zip(self.lattices, np.split(light, ends[:-1]), strict=True):
            patch = np.zeros(each.lit.shape, dtype=np.complex64)
            patch[each.lit] = part
            waves.append(each.transform.to_sensor(patch))
        total = waves[0]
        for wave in waves[1:]:
            total += wave
        return total
