"""Reduced reeds from the cache, or built and kept: building one takes a minute or two."""

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from physics.reed.cache import Arrays, kept
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.mesh import STANDARD, MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.reduced.air_matrices import AirMatrices
from physics.reed.reduced.build import build_reduced_reed
from physics.reed.reduced.reed import (
    BasisSettings,
    FrontEdge,
    ReducedReed,
    ReedPart,
    ShapeMeasures,
)

_OF_REED = ("plan_m", "load_points_m", "bark_m", "area_m2", "strip_m2")
_OF_PART = tuple(f.name for f in fields(ReedPart) if f.name not in ("held", "measures"))
_OF_MEASURES = tuple(f.name for f in fields(ShapeMeasures))
_OF_EDGE = tuple(f.name for f in fields(FrontEdge))
_OF_AIR = ("mass_kg", "resistance_kg_s", "wall_kg")
_WHOLE = "whole"


def reduced_reed(
    geometry: ReedGeometry | None = None,
    level: MeshLevel = STANDARD,
    settings: BasisSettings | None = None,
    announce: Callable[[str], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> ReducedReed:
    """Reduced reed from the cache, or built and kept.

    Parameters
    ----------
    geometry : ReedGeometry, optional
        The paper's reed if not given.
    level : MeshLevel
    settings : BasisSettings, optional
    announce : callable, optional
        Called with one sentence on what is being waited for, if anything.
    progress : callable, optional
        Called with the fraction of a build that is done.

    Raises
    ------
    ImpossibleReedError
        For an impossible geometry or material (see `build_reduced_reed`).
    """
    geometry, settings = geometry or ReedGeometry(), settings or BasisSettings()

    def build() -> ReducedReed:
        if announce:
            announce("computing the reed's modes by finite elements (kept for the next time)")
        return build_reduced_reed(geometry, level, settings, progress or (lambda _: None))

    def restored(arrays: Arrays) -> ReducedReed:
        return _restored(geometry, settings, arrays)

    return kept("reed", (geometry, level, settings), build, _arrays, restored, announce)


def _arrays(reed: ReducedReed) -> Arrays:
    arrays = {name: getattr(reed, name) for name in _OF_REED}
    arrays |= {f"edge_{name}": getattr(reed.edge, name) for name in _OF_EDGE}
    if reed.air is not None:
        arrays["air_hz"] = reed.air.hz
        for name in _OF_AIR:
            each = zip(reed.loose, getattr(reed.air, name), strict=True)
            arrays |= {f"{key or _WHOLE}_air_{name}": own for key, own in each}
    for key, part in reed.loose.items():
        prefix = key or _WHOLE
        arrays[f"{prefix}_held"] = np.array(part.held)
        arrays |= {f"{prefix}_{name}": getattr(part, name) for name in _OF_PART}
        for symmetry, own in part.measures.items():
            arrays |= {f"{prefix}_{symmetry}_{name}": getattr(own, name) for name in _OF_MEASURES}
    return arrays


def _restored(geometry: ReedGeometry, settings: BasisSettings, arrays: Arrays) -> ReducedReed:
    whole = f"{_WHOLE}_held" in arrays
    loose: dict[Symmetry | None, ReedPart] = {}
    for key in (None,) if whole else tuple(Symmetry):
        prefix = key or _WHOLE
        loose[key] = ReedPart(
            held=int(arrays[f"{prefix}_held"]),
            measures={
                symmetry: ShapeMeasures(
                    **{name: arrays[f"{prefix}_{symmetry}_{name}"] for name in _OF_MEASURES}
                )
                for symmetry in (Symmetry if whole else (Symmetry(prefix),))
            },
            **{name: arrays[f"{prefix}_{name}"] for name in _OF_PART},
        )
    air = {name: [arrays[f"{key or _WHOLE}_air_{name}"] for key in loose] for name in _OF_AIR}
    return ReducedReed(
        geometry=geometry,
        box=settings.box,
        loose=loose,
        air=AirMatrices(arrays["air_hz"], **air),
        edge=FrontEdge(**{name: arrays[f"edge_{name}"] for name in _OF_EDGE}),
        **{name: arrays[name] for name in _OF_REED},
    )
