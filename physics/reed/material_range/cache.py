"""Keep bases over materials between runs: they cost most of a minute to build."""

from collections.abc import Callable

import numpy as np

from physics.reed.elements.fem import Symmetry
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.material_range.basis import HalfMaterialBasis, MaterialBasis
from physics.reed.material_range.snapshots import TrainingSettings
from physics.reed.material_range.training import build_material_basis
from physics.reed.modes import ModeClass
from physics.reed.reduction.cache import (
    STANDARD,
    Arrays,
    kept,
)

_ARRAYS = ("components", "loadings", "named_shapes")


def material_basis(
    geometry: ReedGeometry | None = None,
    level: MeshLevel = STANDARD,
    settings: TrainingSettings | None = None,
    announce: Callable[[str], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> MaterialBasis:
    """Basis over materials from the cache (see `cache.kept`), or built and kept.

    Parameters
    ----------
    geometry : ReedGeometry, optional
        The paper's reed if not given.
    level : MeshLevel
    settings : TrainingSettings, optional
    announce : callable, optional
        Told what is being waited for, if anything.
    progress : callable, optional
        Told the share of it that is done, from 0 to 1.

    Raises
    ------
    ValueError
        As `build_material_basis`.
    """
    geometry, settings = geometry or ReedGeometry(), settings or TrainingSettings()

    def build() -> MaterialBasis:
        if announce:
            announce("computing the reed's basis over materials by finite elements (kept)")
        return build_material_basis(geometry, level, settings, progress)

    def restored(arrays: Arrays) -> MaterialBasis:
        halves = {
            symmetry: HalfMaterialBasis(
                names=tuple(arrays[f"{symmetry}_names"].tolist()),
                error_cents=float(arrays[f"{symmetry}_error_cents"]),
                **{name: arrays[f"{symmetry}_{name}"] for name in _ARRAYS},
            )
            for symmetry in Symmetry
        }
        classes = tuple(ModeClass(value) for value in arrays["classes"].tolist())
        names = tuple(arrays["names"].tolist())
        return MaterialBasis(geometry, settings.box, names, classes, halves)

    return kept("material", (geometry, level, settings), build, _arrays, restored, announce)


def _arrays(basis: MaterialBasis) -> Arrays:
    arrays = {"names": np.array(basis.names), "classes": np.array(basis.classes)}
    for symmetry, half in basis.halves.items():
        arrays |= {f"{symmetry}_{name}": getattr(half, name) for name in _ARRAYS}
        arrays[f"{symmetry}_names"] = np.array(half.names)
        arrays[f"{symmetry}_error_cents"] = np.array(half.error_cents)
    return arrays
