"""Points of the vamp at which its largest displacement is looked for: the whole of it.

The block amplitudes lie inside the contour, but a reed moves most at its tip and edges: the largest
displacement of the modes below 20 kHz is 1 to 30 % larger than that at the blocks. Displacements
are therefore continued to the contour with the shapes of the finite elements.
"""

from dataclasses import dataclass

import numpy as np

from fitting.holograms.shape_basis import ShapeBasis
from holography.arrays import Array
from physics.reed.geometry import half_width_m
from physics.reed.reduced.reed import ReducedReed

# Points on each half of the contour. Their distances are 0.25 mm around the tip and 0.6 mm at the
# end of the vamp. Chosen: with twice as many points no largest displacement of a mode below 20 kHz
# changes by more than 0.002 %.
_CONTOUR_POINTS = 120
# Distance over which slopes are differences. Chosen: a small part of the finest shapes, whose waves
# are 4 mm long, and more than what the mesh's outermost chords leave out of the contour.
_SLOPE_M = 0.2e-3


@dataclass(frozen=True)
class VampPoints:
    """Blocks and contour of the vamp, with the functions of a `ShapeBasis` at these points.

    Attributes
    ----------
    x_m, y_m : (p,) float
        Distances from the tip and from the axis; positive y is the reed's left side.
    functions : (p, j) float
    slopes : (2, p, j) float
        Their derivatives by x and y, in 1/m.
    """

    x_m: Array
    y_m: Array
    functions: Array
    slopes: Array


def vamp_points(reed: ReducedReed, basis: ShapeBasis, x_m: Array, y_m: Array) -> VampPoints:
    """Return the blocks of a run and the points of the vamp's contour.

    Parameters
    ----------
    reed : ReducedReed
    basis : ShapeBasis
        At the blocks.
    x_m, y_m : (n,) float
        Blocks.
    """
    count, outline = len(x_m), reed.geometry.outline
    # The square sets points evenly along the round tip, where x hardly changes.
    along = reed.geometry.vamp_x_m[-1] * np.linspace(0, 1, _CONTOUR_POINTS) ** 2
    half = half_width_m(outline, along)
    all_x_m = np.concatenate([x_m, along, along[1:]])
    all_y_m = np.concatenate([y_m, half, -half[1:]])
    # Slopes are differences towards the clamp and towards the axis, where there is reed.
    inwards_m = np.where(all_y_m > 0, -_SLOPE_M, _SLOPE_M)
    everywhere = basis.at(
        reed,
        np.concatenate([all_x_m, all_x_m + _SLOPE_M, all_x_m]),
        np.concatenate([all_y_m, all_y_m, all_y_m + inwards_m]),
    )
    here, along_x, along_y = np.split(everywhere.functions.astype(float), 3)
    slopes = np.stack([(along_x - here) / _SLOPE_M, (along_y - here) / inwards_m[:, None]])
    functions = np.concatenate([basis.functions, here[count:]])
    return VampPoints(all_x_m, all_y_m, functions, slopes)
