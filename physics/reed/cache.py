"""Keep on disk what takes seconds or a minute to compute and gives the same result every time.

An entry is a file of arrays. Its name covers every input, the code of this package and the versions
of numpy and scipy, so an entry is never out of date. It ends in a seal: the version of the format,
and a digest of all that comes before and of the entry's name. What does not verify is built again
and replaced. A folder that cannot be written to costs time, not results.
"""

import contextlib
import fcntl
import hashlib
import io
import os
import secrets
import shutil
import stat
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

Made = TypeVar("Made")
Arrays = Mapping[str, NDArray[Any]]

# Raised by an entry that is absent, damaged, or holds other arrays than it should.
_UNUSABLE: Final = (OSError, KeyError, ValueError)
# First bytes of a seal; the digit is the version of the format.
_SEAL_MARK: Final = b"reedbench entry 1\n"
_SEAL_BYTES: Final = len(_SEAL_MARK) + hashlib.sha256().digest_size
# A link is not followed, and a pipe without a writer is not waited for.
_OPEN_FLAGS: Final = os.O_NOFOLLOW | os.O_NONBLOCK
# Chosen: a program that waits loses at most this, and asks the disk this often.
_POLL_S: Final = 0.05
# Chosen: about ten times the longest build (a reduced reed, 1 min). A program that was
# stopped (Ctrl-Z) keeps its lock; others then compute for themselves.
_PATIENCE_S: Final = 600.0


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
    announce: Callable[[str], None] | None = None,
) -> Made:
    """Read something from the cache, or make it and keep it.

    Only one program makes the same thing at a time; the others wait and read it.

    Parameters
    ----------
    kind : str
        First part of the entry's name.
    inputs : sequence
        All that decides what is made; two inputs are the same if ``repr`` is.
    make : callable
        May raise any exception; then nothing is kept.
    to_arrays, from_arrays : callable
        Convert what is made to named arrays, of numbers or texts, and back. Arrays with a number
        that is not finite are not kept.
    announce : callable, optional
        Called with one sentence if another program has to be waited for.
    """
    try:
        path = cache_directory() / f"{kind}-{_key(inputs)}.npz"
    except RuntimeError:
        # Nothing says where this user's home is.
        return make()
    with contextlib.suppress(*_UNUSABLE):
        return from_arrays(_load(path))
    with _alone(path, announce):
        # Another program may have made it meanwhile.
        with contextlib.suppress(*_UNUSABLE):
            return from_arrays(_load(path))
        made = make()
        with contextlib.suppress(OSError):
            _save(path, to_arrays(made))
    return made


@contextlib.contextmanager
def _alone(path: Path, announce: Callable[[str], None] | None) -> Iterator[None]:
    """Wait while another program makes the same; where that cannot be known, do not wait."""
    lock = path.with_suffix(".lock")
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            lock.parent.mkdir(parents=True, exist_ok=True)
            held.callback(_release, lock, _acquire(lock, announce or (lambda _: None)))
        yield


def _acquire(lock: Path, announce: Callable[[str], None]) -> int:
    """Return the descriptor of a lock file that no other program holds.

    Raises
    ------
    OSError
        If it cannot be locked, or is not free within `_PATIENCE_S`.
    """
    start_s, announced = time.monotonic(), False
    while True:
        descriptor = _open_file(lock, os.O_RDWR | os.O_CREAT)
        try:
            if _is_ours(descriptor, lock):
                return descriptor
            number = os.pread(descriptor, 20, 0).strip()
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        if time.monotonic() - start_s > _PATIENCE_S:
            raise TimeoutError(f"{lock}: is still held")
        if not announced:
            announced = True
            holder = f"process {number.decode()}" if number.isdigit() else "another program"
            announce(
                f"waiting for {holder}, which is computing the same (it holds {lock}); "
                "Ctrl-C ends the wait"
            )
        # Not a lock that blocks: Ctrl-C reaches a program that sleeps.
        time.sleep(_POLL_S)


def _is_ours(descriptor: int, lock: Path) -> bool:
    """Whether an open file can be locked; then the number of this process is written in it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Whoever held it has removed its name since it was opened: others lock another file now.
        if not os.path.samestat(os.fstat(descriptor), lock.lstat()):
            return False
    except (BlockingIOError, FileNotFoundError):
        return False
    # The lock holds on a disk that is full, too.
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    return True


def _release(lock: Path, descriptor: int) -> None:
    """Remove a lock file that is held, and let go of it."""
    with contextlib.suppress(OSError):
        lock.unlink()
    # Closing is not enough: processes forked meanwhile have the same open file.
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    os.close(descriptor)


def _code_digest() -> bytes:
    """Digest of the source of `physics.reed` as it is on the disk now."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        # Editors leave links to nothing next to a file that is being edited.
        with contextlib.suppress(OSError):
            digest.update(source.read_bytes())
    return digest.digest()


# What a running program computes with, whatever is done to the files afterwards.
_CODE_AT_START: Final = _code_digest()


def _key(inputs: Sequence[object]) -> str:
    digest = hashlib.sha256(repr(tuple(inputs)).encode())
    digest.update(f"numpy {np.__version__} scipy {scipy.__version__}".encode())
    # Both: parts of the package that are imported late are those of now.
    digest.update(_CODE_AT_START + _code_digest())
    return digest.hexdigest()[:24]


def _seal(name: str, content: bytes | memoryview) -> bytes:
    """Return the last bytes of an entry of this name."""
    digest = hashlib.sha256(_SEAL_MARK + name.encode() + b"\n")
    digest.update(content)
    return _SEAL_MARK + digest.digest()


def _load(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of an entry.

    Raises
    ------
    OSError, ValueError
        If there is no entry of this name, or it does not verify.
    """
    with open(path, "rb", opener=_open_file) as entry:
        if not stat.S_ISREG(os.fstat(entry.fileno()).st_mode):
            raise ValueError(f"{path}: is not a file")
        # First, so that a large file that is no entry is not read.
        entry.seek(-_SEAL_BYTES, os.SEEK_END)
        seal = entry.read()
        if not seal.startswith(_SEAL_MARK):
            raise ValueError(f"{path}: has no seal of this version")
        entry.seek(0)
        content = entry.read()
    if _seal(path.name, memoryview(content)[:-_SEAL_BYTES]) != content[-_SEAL_BYTES:]:
        raise ValueError(f"{path}: does not match its digest")
    # Only now: numpy and zipfile meet nothing that was not written here.
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


def _save(path: Path, arrays: Arrays) -> None:
    """Write an entry, unless a number in it is not finite.

    Raises
    ------
    OSError
        If the folder or the disk refuses; then the entry is as it was before.
    """
    if not all(np.isfinite(a).all() for a in arrays.values() if a.dtype.kind in "fc"):
        return
    content = _sealed(path.name, arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Left by a program that was killed while it wrote: only the holder of the lock writes.
    for left in path.parent.glob(f"{path.stem}.*.part"):
        left.unlink(missing_ok=True)
    # Written under another name first: programs that read at the same time never see half a file.
    unfinished = path.with_suffix(f".{secrets.token_hex(8)}.part")
    try:
        with open(unfinished, "xb", opener=_open_file) as part:
            part.write(content)
            part.flush()
            os.fsync(part.fileno())
        if path.is_dir() and not path.is_symlink():
            # A file cannot be renamed to the name of a folder.
            shutil.rmtree(path)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _sealed(name: str, arrays: Arrays) -> bytes:
    """Return the bytes of an entry: an archive of arrays whose comment is the seal."""
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, **arrays)
    with zipfile.ZipFile(archive, "a") as opened:
        # Holds the place: the digest also covers the length of the comment.
        opened.comment = bytes(_SEAL_BYTES)
    content = archive.getbuffer()[:-_SEAL_BYTES]
    return b"".join((content, _seal(name, content)))


def _open_file(path: str | Path, flags: int) -> int:
    return os.open(path, flags | _OPEN_FLAGS, 0o666)
