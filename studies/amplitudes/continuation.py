"""Errors of largest displacements that come from the functions of the fit alone."""

import numpy as np

from fitting.amplitudes.vamp import vamp_points
from fitting.forward import basis_of
from fitting.fringes.start_frequencies import middling_shapes
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.geometry import half_width_m
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from studies.amplitudes.comparison import model_of

# Steps between those of `continuation`; blocks and edge of a full sensor.
_STRIDE, _BLOCK_M, _EDGE_M = 6, 0.38e-3, 0.25e-3


def continuation(reeds: int, first: int, protocol: str) -> dict[str, float]:
    """Return errors of largest displacements that come from the functions of the fit alone."""
    plan = make_plan(Protocol.from_file(protocol), BenchFile.from_file())
    reed, cane = basis_of(plan.reed), viscoelastic_cane(Components(), Series(plan.protocol.series))
    # Blocks as those of a full sensor.
    along, across = np.arange(0.7e-3, 35.8e-3, _BLOCK_M), np.arange(-6.4e-3, 6.4e-3, _BLOCK_M)
    x_m, y_m = (axis.ravel() for axis in np.meshgrid(along, across))
    inside = half_width_m(reed.geometry.outline, x_m) - np.abs(y_m) > _EDGE_M
    x_m, y_m = x_m[inside], y_m[inside]
    basis = middling_shapes(reed, cane, x_m, y_m)
    points, count = vamp_points(reed, basis, x_m, y_m), len(x_m)
    relative = []
    for number in range(first, first + reeds):
        model = model_of(plan, f"amplitude-{number:02d}")
        drives = [(step.drive_hz, float(step.volts)) for step in plan.steps[::_STRIDE]]
        true = model.displacement_at_m(points.x_m, points.y_m, drives)
        seen = (true[:, :count] @ points.functions[:count] / count) @ points.functions.T
        relative.append(np.abs(seen).max(axis=1) / np.abs(true).max(axis=1) - 1)
    off = np.abs(np.concatenate(relative))
    percentiles = {f"percentile_{p}": float(np.percentile(off, p)) for p in (50, 68, 95)}
    return percentiles | {"rms": float(np.sqrt(np.mean(off**2))), "count": len(off)}
