"""A second way to draw the lines across a reed along which its modes have an order.

The elements follow the arc of the tip, and so do the lines along which
`physics.reed.mode_classification` counts. Straight lines, x = constant, are as good. The tip moves
most, and there the two differ by 1.6 mm: a mode that is between two names (T5 and X6 at 16 kHz) may
have one name along one kind of lines, and the other along the other.
"""

from dataclasses import replace

import numpy as np

from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import half_width_m
from physics.reed.mode_classification import vamp_profiles
from physics.reed.reduced.reed import ReducedReed, ReedPart
from physics.reed.surface import surface_shapes

# Lines and points on each from the axis to the side. Chosen: as far apart as the nodes of the
# elements along the reed, 0.5 mm, and three for each of the six waves that profiles resolve.
_LINE_STEP_M, _ACROSS = 0.5e-3, 18


def with_straight_lines(reed: ReducedReed) -> ReducedReed:
    """Return a reed with `ShapeMeasures` of its vamp along straight lines across.

    Parameters
    ----------
    reed : ReducedReed

    Returns
    -------
    ReducedReed
        In all else the same.
    """
    end_m = float(reed.geometry.vamp_x_m[-1])
    x_m = np.arange(_LINE_STEP_M, end_m, _LINE_STEP_M)[:, None]
    y_m = np.linspace(0.0, 1.0, _ACROSS) * half_width_m(reed.geometry.outline, x_m)
    plan_m = np.stack(np.broadcast_arrays(x_m, y_m), axis=-1)
    right = surface_shapes(reed, plan_m[..., 0].ravel(), y_m.ravel(), loose=True)
    left = surface_shapes(reed, plan_m[..., 0].ravel(), -y_m.ravel(), loose=True)
    loose: dict[Symmetry | None, ReedPart] = {}
    for key, part in reed.loose.items():
        measures = {}
        for symmetry, own in part.measures.items():
            sign = 1.0 if symmetry is Symmetry.SYMMETRIC else -1.0
            bark = 0.5 * (right[key] + sign * left[key]).astype(float)
            profiles, points = vamp_profiles(plan_m, bark.reshape(*y_m.shape, -1), end_m)
            measures[symmetry] = replace(own, profiles=profiles, vamp_square=points.T @ points)
        loose[key] = replace(part, measures=measures)
    return replace(reed, loose=loose)
