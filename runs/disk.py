"""Files that HDF5 writes to, and errors of the disk.

HDF5 does not handle disk errors well: errors that occur while it closes an object are printed and
lost, and the process may crash when it ends. So HDF5 writes through a `DiskFile`, which keeps the
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

# Errors of the operating system for a disk that fails, is full, or was removed (errno(3)).
_DISK_FAULTS: Final = frozenset(
    {errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENXIO, errno.ENODEV, errno.ESTALE}
)
# Errors of a file system that has no locks (flock(2)). HDF5 also works without locks there.
_NO_LOCKS: Final = frozenset({errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK})


def give_name(unborn: Path, path: Path) -> None:
    """Rename a finished file, without ever replacing another file.

    Parameters
    ----------
    unborn : Path
        Current path of the file.
    path : Path
        New path.

    Raises
    ------
    FileExistsError
        If a file already has the new path.
    OSError
        If the file cannot be renamed.
    """
    try:
        os.link(unborn, path, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:
        # The file system has no hard links (FAT, some network folders). A file that another program
        # creates between the two calls is lost; programs of this project hold the run's lock.
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        unborn.rename(path)
    else:
        unborn.unlink()


class DiskFile(io.RawIOBase):
    """File object for ``h5py.File`` that never raises an error into HDF5.

    Use `create` or `open_existing` to open one. While it is open, it holds HDF5's lock, so other
    programs cannot open the file with a lock. An error of the disk is kept, and HDF5 continues as
    if the disk had accepted the bytes, until `check` raises the error. The file can still be used
    after that: a full disk may accept a short status.
    """

    def __init__(self, path: Path, flags: int) -> None:
        super().__init__()
        self._offset = 0
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
        """Create a file, and remove an existing file or link of that name first.

        A link is removed, not followed.

        Raises
        ------
        OSError
            If the file cannot be created.
        """
        path.unlink(missing_ok=True)
        return cls(path, os.O_CREAT | os.O_EXCL)

    @classmethod
    def open_existing(cls, path: Path) -> Self:
        """Open a file for reading and writing.

        Raises
        ------
        OSError
            If the file cannot be opened; `BlockingIOError` if another program has locked it.
        """
        return cls(path, 0)

    def check(self) -> None:
        """Raise the first error of the disk since the last call, if there was one.

        Raises
        ------
        OSError
            The error of the disk.
        """
        error, self._error = self._error, None
        if error is not None:
            raise error

    def sync(self) -> None:
        """Wait until all written bytes are on the disk.

        Raises
        ------
        OSError
            If the disk refused any of them.
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
        """Set the offset of the next byte, and return it."""
        if whence == os.SEEK_CUR:
            offset += self._offset
        elif whence == os.SEEK_END:
            offset += os.fstat(self._descriptor).st_size
        self._offset = offset
        return self._offset

    def tell(self) -> int:
        """Return the offset of the next byte."""
        return self._offset

    def readinto(self, buffer: "WriteableBuffer") -> int:
        """Fill a buffer; with zeros beyond the end of the file and where the disk refuses."""
        view, done = memoryview(buffer).cast("B"), 0
        with self._errors_kept():
            while done < len(view):
                count = os.preadv(self._descriptor, [view[done:]], self._offset + done)
                if not count:
                    break
                done += count
        view[done:] = bytes(len(view) - done)
        self._offset += len(view)
        return len(view)

    def write(self, data: "ReadableBuffer") -> int:
        """Write all bytes, or keep the error for `check`."""
        view, done = memoryview(data).cast("B"), 0
        with self._errors_kept():
            while done < len(view):
                done += os.pwrite(self._descriptor, view[done:], self._offset + done)
        self._offset += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of the file, or keep the error for `check`."""
        size = self._offset if size is None else size
        with self._errors_kept():
            os.ftruncate(self._descriptor, size)
        return size

    def flush(self) -> None:
        """Do nothing: every write goes to the operating system at once."""

    def close(self) -> None:
        """Close the file. May be called twice."""
        super().close()
        # The operating system may give the same number to another file as soon as this is closed.
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
    """Return `DiskError` if an error comes from the disk, `RunFileError` if not.

    Parameters
    ----------
    error : BaseException
        Error of the operating system, or of HDF5, which quotes the operating system.
    """
    number = error.errno if isinstance(error, OSError) else None
    quoted = re.search(r"errno = (\d+)", str(error))
    if number is None and quoted:
        number = int(quoted[1])
    return DiskError if number in _DISK_FAULTS else RunFileError
