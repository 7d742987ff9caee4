"""Keep reduced reeds between runs: they cost seconds to build and are the same every time."""

import contextlib
import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import scipy

from physics.reed.basis import BasisSettings, HalfBasis, ReducedReed, build_reduced_reed
from physics.reed.fem import Symmetry
from physics.reed.geometry import ReedGeometry
from physics.reed.mesh import MeshLevel

# How far each level lies from the limit of ever finer meshes: `python -m benchmarks.convergence`.
# Every mode below 20 kHz within 10 cents, those of the heel included.
FINE = MeshLevel(orders=(4, 4, 4), heel_element_m=4.5e-3, z_breaks=(0.0, 0.94, 1.0))
# Every mode of the vamp within 10 cents; a basis of it is built within seconds and 2 GiB.
STANDARD = MeshLevel(orders=(4, 4, 3), heel_element_m=8e-3, z_breaks=(0.0, 0.9, 1.0))
# Every mode of the vamp within 45 cents, in a fraction of a second.
FAST = MeshLevel(orders=(3, 3, 2), edge_breaks_m=())


def cache_directory() -> Path:
    """Folder of the cache: ``$REEDBENCH_CACHE``, else ``reedbench`` in the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.environ.get("REEDBENCH_CACHE") or Path(base, "reedbench")).expanduser()


def reduced_reed(
    geometry: ReedGeometry | None = None,
    level: MeshLevel = STANDARD,
    settings: BasisSettings | None = None,
    announce: Callable[[str], None] | None = None,
) -> ReducedReed:
    """Reduced reed from the cache, or built and kept.

    The key covers every input, the code of this package and the versions of numpy and scipy, so
    an entry is never stale. A damaged entry is built anew; a folder that cannot be written to
    costs time, not results.

    Parameters
    ----------
    geometry : ReedGeometry, optional
        The paper's reed if not given.
    level : MeshLevel
    settings : BasisSettings, optional
    announce : callable, optional
        Told what is being waited for, if anything.

    Raises
    ------
    ValueError
        For an impossible geometry or material (see `build_reduced_reed`).
    """
    geometry, settings = geometry or ReedGeometry(), settings or BasisSettings()
    path = cache_directory() / f"reed-{_key(geometry, level, settings)}.npz"
    with contextlib.suppress(OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile):
        return _load(path, geometry, settings)
    if announce:
        announce("computing the reed's modes by finite elements (kept for the next time)")
    reed = build_reduced_reed(geometry, level, settings)
    with contextlib.suppress(OSError):
        _save(path, reed)
    return reed


def _key(geometry: ReedGeometry, level: MeshLevel, settings: BasisSettings) -> str:
    digest = hashlib.sha256(repr((geometry, level, settings)).encode())
    digest.update(f"numpy {np.__version__} scipy {scipy.__version__}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:24]


def _save(path: Path, reed: ReducedReed) -> None:
    arrays = {"plan_m": reed.plan_m, "load_points_m": reed.load_points_m}
    for symmetry, half in reed.halves.items():
        arrays |= {f"{symmetry}_{f.name}": getattr(half, f.name) for f in fields(HalfBasis)}
    path.parent.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed: two programs that build at once never see half a file.
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as part:
        np.savez(part, allow_pickle=False, **arrays)
    Path(part.name).replace(path)


def _load(path: Path, geometry: ReedGeometry, settings: BasisSettings) -> ReducedReed:
    # Opened here: numpy leaves a file open that turns out to be no archive.
    with path.open("rb") as kept, np.load(kept, allow_pickle=False) as arrays:
        halves = {
            symmetry: HalfBasis(
                **{f.name: arrays[f"{symmetry}_{f.name}"] for f in fields(HalfBasis)}
            )
            for symmetry in Symmetry
        }
        return ReducedReed(
            geometry, settings.cane, arrays["plan_m"], arrays["load_points_m"], halves
        )
