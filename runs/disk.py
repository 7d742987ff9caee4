"""Files that HDF5 writes to, and what a disk says when it refuses.

HDF5 does not stand a disk that refuses: errors that come while it closes something are printed and
lost, and the process may crash at its end. So HDF5 writes through a `DiskFile`, which keeps the
error until the writer asks for it.
"""

import contextlib
import errno
import fcntl
import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from runs.errors import DiskError, RunFileError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer, WriteableBuffer

# What the operating system says of a disk that fails, is full, or is gone (errno(3)).
_DISK_FAULTS: Final = frozenset(
    {errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENXIO, errno.ENODEV, errno.ESTALE}
)
# A file system that knows no locks (flock(2)); HDF5 does without them there, too.
_NO_LOCKS: Final = frozenset({errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK})


def give_name(unborn: Path, path: Path) -> None:
    """Give a file that is whole its name, and never take that of another file.

    Raises
    ------
    FileExistsError
        If a file has that name.
    OSError
    """
    try:
        os.link(unborn, path, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:
        # A file system without hard links (FAT, some network folders). Whoever makes a file of this
        # name between the two calls loses it; programs of this project hold the run's lock.
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        unborn.rename(path)
    else:
        unborn.unlink()


class DiskFile(io.RawIOBase):
    """A file for ``h5py.File`` that raises nothing into HDF5; made by `create` and `open_existing`.

    While it is open other programs that ask for HDF5's lock are refused. An error of the disk is
    kept; writing goes on as if nothing had happened, until `check` raises it. After that the file
    can still be used: to a full disk a status may yet be written.
    """

    def __init__(self, path: Path, flags: int) -> None:
        super().__init__()
        self._place = 0
        self._error: OSError | None = None
        self._descriptor = -1
        self._descriptor = os.open(path, flags | os.O_RDWR | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                self.close()
                raise

    @classmethod
    def create(cls, path: Path) -> Self:
        """Make a new file in place of whatever has that name; a link is removed, not followed.

        Raises
        ------
        OSError
        """
        path.unlink(missing_ok=True)
        return cls(path, os.O_CREAT | os.O_EXCL)

    @classmethod
    def open_existing(cls, path: Path) -> Self:
        """Open a file to change it.

        Raises
        ------
        OSError
            `BlockingIOError` if another program has it open and locked.
        """
        return cls(path, 0)

    def check(self) -> None:
        """Raise what the disk refused since the last time.

        Raises
        ------
        OSError
        """
        error, self._error = self._error, None
        if error is not None:
            raise error

    def sync(self) -> None:
        """Wait until all is on the disk.

        Raises
        ------
        OSError
        """
        os.fsync(self._descriptor)
        self.check()

    def readable(self) -> bool:
        """Return True."""
        return True

    def writable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the place of the next byte, and return it."""
        if whence == os.SEEK_CUR:
            offset += self._place
        elif whence == os.SEEK_END:
            offset += os.fstat(self._descriptor).st_size
        self._place = offset
        return self._place

    def tell(self) -> int:
        """Return the place of the next byte."""
        return self._place

    def readinto(self, buffer: "WriteableBuffer") -> int:
        """Read; beyond the end of the file, and where the disk refuses, are zeros."""
        view, done = memoryview(buffer).cast("B"), 0
        with self._errors_kept():
            while done < len(view):
                count = os.preadv(self._descriptor, [view[done:]], self._place + done)
                if not count:
                    break
                done += count
        view[done:] = bytes(len(view) - done)
        self._place += len(view)
        return len(view)

    def write(self, data: "ReadableBuffer") -> int:
        """Write all of it, or keep the error."""
        view, done = memoryview(data).cast("B"), 0
        with self._errors_kept():
            while done < len(view):
                done += os.pwrite(self._descriptor, view[done:], self._place + done)
        self._place += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of the file, or keep the error."""
        size = self._place if size is None else size
        with self._errors_kept():
            os.ftruncate(self._descriptor, size)
        return size

    def flush(self) -> None:
        """Do nothing: what was written is with the operating system already."""

    def close(self) -> None:
        """Close the file. May be called twice."""
        super().close()
        # Its number may belong to another file from now on.
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    @contextlib.contextmanager
    def _errors_kept(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._error = self._error or error


def error_class(error: BaseException) -> type[RunFileError]:
    """Return `DiskError` if it was the disk that refused, `RunFileError` if it was anything else.

    Parameters
    ----------
    error : BaseException
        Of the operating system, or of HDF5, which quotes it.
    """
    number = error.errno if isinstance(error, OSError) else None
    quoted = re.search(r"errno = (\d+)", str(error))
    if number is None and quoted:
        number = int(quoted[1])
    return DiskError if number in _DISK_FAULTS else RunFileError
