"""Keep bases over materials between runs: they cost a minute to build and never change."""

import contextlib
import hashlib
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from physics.reed.cache import STANDARD, cache_directory
from physics.reed.fem import Symmetry
from physics.reed.geometry import ReedGeometry
from physics.reed.material_basis import HalfMaterialBasis, MaterialBasis
from physics.reed.material_snapshots import TrainingSettings
from physics.reed.material_training import build_material_basis
from physics.reed.mesh import MeshLevel

_ARRAYS = ("components", "loadings", "named_shapes")


def material_basis(
    geometry: ReedGeometry | None = None,
    level: MeshLevel = STANDARD,
    settings: TrainingSettings | None = None,
    announce: Callable[[str], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> MaterialBasis:
    """Basis over materials from the cache, or built and kept.

    The key covers every input, the code of this package and the versions of numpy and scipy, so
    an entry is never stale. A damaged entry is built anew; a folder that cannot be written to
    costs time, not results.

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
        For an impossible geometry (see `build_material_basis`).
    """
    geometry, settings = geometry or ReedGeometry(), settings or TrainingSettings()
    path = cache_directory() / f"material-{_key(geometry, level, settings)}.npz"
    with contextlib.suppress(OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile):
        return _load(path, geometry, settings)
    if announce:
        announce("computing the reed's basis over materials by finite elements (kept)")
    basis = build_material_basis(geometry, level, settings, progress)
    with contextlib.suppress(OSError):
        _save(path, basis)
    return basis


def _key(*inputs: Any) -> str:
    digest = hashlib.sha256(repr(inputs).encode())
    digest.update(f"numpy {np.__version__} scipy {scipy.__version__}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:24]


def _save(path: Path, basis: MaterialBasis) -> None:
    arrays = {"names": np.array(basis.names)}
    for symmetry, half in basis.halves.items():
        arrays |= {f"{symmetry}_{name}": getattr(half, name) for name in _ARRAYS}
        arrays[f"{symmetry}_names"] = np.array(half.names)
        arrays[f"{symmetry}_error_cents"] = np.array(half.error_cents)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed: two programs that build at once never see half a file.
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as part:
        np.savez(part, allow_pickle=False, **arrays)
    Path(part.name).replace(path)


def _load(path: Path, geometry: ReedGeometry, settings: TrainingSettings) -> MaterialBasis:
    # Opened here: numpy leaves a file open that turns out to be no archive.
    with path.open("rb") as kept, np.load(kept, allow_pickle=False) as arrays:
        halves = {
            symmetry: HalfMaterialBasis(
                names=tuple(arrays[f"{symmetry}_names"].tolist()),
                error_cents=float(arrays[f"{symmetry}_error_cents"]),
                **{name: arrays[f"{symmetry}_{name}"] for name in _ARRAYS},
            )
            for symmetry in Symmetry
        }
        return MaterialBasis(geometry, settings.box, tuple(arrays["names"].tolist()), halves)
