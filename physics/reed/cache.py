"""Keep what takes seconds or a minute to compute and is the same every time.

An entry is a file of arrays. Its name covers every input, the code of this package and the versions
of numpy and scipy, so it is never stale. A damaged entry is made anew; a folder that cannot be
written to costs time, not results.
"""

import contextlib
import fcntl
import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from physics.reed.anatomy import Anatomy, build_anatomy
from physics.reed.basis import BasisSettings, HalfBasis, ReducedReed, build_reduced_reed
from physics.reed.fem import Symmetry
from physics.reed.geometry import ReedGeometry
from physics.reed.mesh import MeshLevel
from physics.reed.whole import WholeReed, build_whole_reed

Made = TypeVar("Made")
_ANATOMY = ("bark_m", "area_m2", "strip_m2")
_UNREADABLE = (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile)
Arrays = Mapping[str, NDArray[Any]]

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


def kept(
    kind: str,
    inputs: Sequence[object],
    make: Callable[[], Made],
    to_arrays: Callable[[Made], Arrays],
    from_arrays: Callable[[Arrays], Made],
) -> Made:
    """Read something from the cache, or make it and keep it.

    Parameters
    ----------
    kind : str
        First part of the entry's name.
    inputs : sequence
        All that decides what is made, told apart by what ``repr`` says of it.
    make : callable
        May raise what it likes; then nothing is kept.
    to_arrays, from_arrays : callable
        What is made ↔ named arrays, of numbers or texts.
    """
    path = cache_directory() / f"{kind}-{_key(inputs)}.npz"
    with contextlib.suppress(*_UNREADABLE):
        return _load(path, from_arrays)
    with _alone(path):
        # Another program may have made it meanwhile.
        with contextlib.suppress(*_UNREADABLE):
            return _load(path, from_arrays)
        made = make()
        with contextlib.suppress(OSError):
            _save(path, to_arrays(made))
    return made


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Wait while another program makes the same; where that cannot be told, do not."""
    lock = path.with_suffix(".lock")
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            lock.parent.mkdir(parents=True, exist_ok=True)
            held.callback(lock.unlink, missing_ok=True)
            fcntl.flock(held.enter_context(lock.open("w")), fcntl.LOCK_EX)
        yield


def _key(inputs: Sequence[object]) -> str:
    digest = hashlib.sha256(repr(tuple(inputs)).encode())
    digest.update(f"numpy {np.__version__} scipy {scipy.__version__}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:24]


def _load(path: Path, from_arrays: Callable[[Arrays], Made]) -> Made:
    # Opened here: numpy leaves a file open that turns out to be no archive.
    with path.open("rb") as entry, np.load(entry, allow_pickle=False) as arrays:
        return from_arrays(arrays)


def _save(path: Path, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed: two programs that build at once never see half a file.
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as part:
        unfinished = Path(part.name)
        try:
            np.savez(part, allow_pickle=False, **arrays)
        except BaseException:
            unfinished.unlink()
            raise
    unfinished.replace(path)


def reduced_reed(
    geometry: ReedGeometry | None = None,
    level: MeshLevel = STANDARD,
    settings: BasisSettings | None = None,
    announce: Callable[[str], None] | None = None,
) -> ReducedReed:
    """Reduced reed from the cache, or built and kept.

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

    def build() -> ReducedReed:
        if announce:
            announce("computing the reed's modes by finite elements (kept for the next time)")
        return build_reduced_reed(geometry, level, settings)

    def restored(arrays: Arrays) -> ReducedReed:
        return _reed_of(geometry, settings, arrays)

    return kept("reed", (geometry, level, settings), build, _arrays, restored)


def _reed_of(geometry: ReedGeometry, settings: BasisSettings, arrays: Arrays) -> ReducedReed:
    halves = {
        symmetry: HalfBasis(**{f.name: arrays[f"{symmetry}_{f.name}"] for f in fields(HalfBasis)})
        for symmetry in Symmetry
    }
    return ReducedReed(geometry, settings.cane, arrays["plan_m"], arrays["load_points_m"], halves)


def _arrays(reed: ReducedReed) -> Arrays:
    arrays = {"plan_m": reed.plan_m, "load_points_m": reed.load_points_m}
    for symmetry, half in reed.halves.items():
        arrays |= {f"{symmetry}_{f.name}": getattr(half, f.name) for f in fields(HalfBasis)}
    return arrays


def whole_reed(
    geometry: ReedGeometry,
    level: MeshLevel = STANDARD,
    settings: BasisSettings | None = None,
    announce: Callable[[str], None] | None = None,
) -> WholeReed:
    """Whole reed from the cache, or built and kept; see `reduced_reed`.

    Raises
    ------
    ValueError
        For an impossible geometry or material (see `build_whole_reed`).
    """
    settings = settings or BasisSettings()

    def build() -> WholeReed:
        if announce:
            announce("computing the whole reed's modes by finite elements (kept for the next time)")
        return build_whole_reed(geometry, level, settings)

    def to_arrays(reed: WholeReed) -> Arrays:
        return {name: getattr(reed, name) for name in names}

    def restored(arrays: Arrays) -> WholeReed:
        return WholeReed(geometry, settings.cane, **{name: arrays[name] for name in names})

    names = [f.name for f in fields(WholeReed) if f.name not in ("geometry", "cane")]
    return kept("whole", (geometry, level, settings), build, to_arrays, restored)


def anatomy(
    geometry: ReedGeometry | None = None,
    level: MeshLevel = STANDARD,
    settings: BasisSettings | None = None,
    announce: Callable[[str], None] | None = None,
) -> Anatomy:
    """Anatomy of a reed from the cache, or built and kept; see `reduced_reed`.

    Raises
    ------
    ValueError
        For an impossible geometry or material (see `build_anatomy`).
    """
    geometry, settings = geometry or ReedGeometry(), settings or BasisSettings()

    def build() -> Anatomy:
        if announce:
            announce("laying the reed open by finite elements (kept for the next time)")
        return build_anatomy(geometry, level, settings)

    def to_arrays(made: Anatomy) -> Arrays:
        arrays = {f"reed_{name}": array for name, array in _arrays(made.reed).items()}
        arrays |= {name: getattr(made, name) for name in _ANATOMY}
        for symmetry in Symmetry:
            arrays[f"{symmetry}_clamped"] = np.array(made.clamped[symmetry])
            arrays[f"{symmetry}_strain"] = made.strain[symmetry]
            arrays[f"{symmetry}_motion"] = made.motion[symmetry]
        return arrays

    def restored(arrays: Arrays) -> Anatomy:
        reed = _reed_of(
            geometry, settings, {name[5:]: arrays[name] for name in arrays if name[:5] == "reed_"}
        )
        return Anatomy(
            reed=reed,
            clamped={symmetry: int(arrays[f"{symmetry}_clamped"]) for symmetry in Symmetry},
            strain={symmetry: arrays[f"{symmetry}_strain"] for symmetry in Symmetry},
            motion={symmetry: arrays[f"{symmetry}_motion"] for symmetry in Symmetry},
            **{name: arrays[name] for name in _ANATOMY},
        )

    return kept("anatomy", (geometry, level, settings), build, to_arrays, restored)
