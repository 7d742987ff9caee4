"""Files that the verbs write: pages, pictures, tables, campaigns. One rule holds for all of them.

An output replaces nothing but an older output of its own kind. Each kind has a mark in its content,
so that a file of the same name that a person, or another verb, made is recognised and left alone.
A file is written under another name in the same folder, and renamed when it is whole.

Run files and documents have rules of their own, see `runs.writer`.
"""

import contextlib
import os
import secrets
import stat
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final, Literal

from reports.errors import OutputFailedError, OutputRefusedError

# Marks stand at the beginning of a file; matplotlib writes PNG texts before the picture's data.
_HEAD_BYTES: Final = 4096
# NAME_MAX of limits.h, on Linux and macOS.
_NAME_MAX_BYTES: Final = 255
# PNG (ISO/IEC 15948), sections 5.2 and 5.3: 8 bytes of signature; then chunks of a length and a
# type (4 bytes each), data, and 4 bytes of checksum.
_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNK_FRAME_BYTES: Final = 12


# --- Kinds of files ----------------------------------------------------------------------------


@dataclass(frozen=True)
class OutputKind:
    """A kind of file that this program writes.

    Attributes
    ----------
    name : str
        What messages call it.
    form : {'text', 'png'}
    mark : str
        What tells it from all other files: the first characters of a text, or what a picture says
        under "Software" in its PNG texts. Its writer writes it.
    """

    name: str
    form: Literal["text", "png"]
    mark: str

    def is_kind_of(self, head: bytes) -> bool:
        """Whether a file that begins with `head` is of this kind."""
        mark = self.mark.encode()
        return head.startswith(mark) if self.form == "text" else _png_software(head) == mark


def page_kind(name: str) -> OutputKind:
    """HTML page; its mark is the beginning of the document up to the title."""
    start = '<!doctype html><html lang="en"><head><meta charset="utf-8">'
    generator = f'<meta name="generator" content="reedbench {name}">'
    return OutputKind(f"{name} page", "text", start + generator)


def picture_kind(name: str) -> OutputKind:
    """PNG picture."""
    return OutputKind(f"{name} picture", "png", f"reedbench {name}")


def table_kind(name: str, columns: Sequence[str]) -> OutputKind:
    """CSV table; its mark is the line of its columns."""
    return OutputKind(f"table of {name}", "text", ",".join(columns) + "\n")


def description_kind(name: str) -> OutputKind:
    """YAML file; its mark is a comment in the first line."""
    return OutputKind(name, "text", f"# reedbench {name}\n")


def _png_software(head: bytes) -> bytes | None:
    """What a PNG picture says under "Software"."""
    if not head.startswith(_PNG_SIGNATURE):
        return None
    place = len(_PNG_SIGNATURE)
    while place + 8 <= len(head):
        length, kind = struct.unpack_from(">I4s", head, place)
        keyword, _, text = head[place + 8 : place + 8 + length].partition(b"\0")
        if kind == b"tEXt" and keyword == b"Software":
            return text
        place += length + _PNG_CHUNK_FRAME_BYTES
    return None


# --- Where a file may be written ---------------------------------------------------------------


@dataclass(frozen=True)
class Output:
    """A file to write.

    Attributes
    ----------
    path : Path
    kind : OutputKind
    option : str, optional
        Option of the command line that names another place; None if there is none.
    """

    path: Path
    kind: OutputKind
    option: str | None = "--out"

    @property
    def elsewhere(self) -> str:
        """What a person can do if nothing can be written there."""
        if self.option is None:
            return "free space there"
        return f"choose another place with {self.option}"


def require_writable(
    outputs: Iterable[Output], inputs: Iterable[Path] = (), *, makes_folder: bool = False
) -> None:
    """Refuse, before anything is computed, outputs that must not or cannot be written.

    Parameters
    ----------
    outputs : iterable of Output
        All that a command writes.
    inputs : iterable of Path
        What it reads. None of them is replaced, under whatever name, symbolic or hard link.
    makes_folder : bool
        Whether a folder that is missing will be made.

    Raises
    ------
    OutputRefusedError
        If a file is there that is not an output of the same kind, or is a link, an input or another
        output of the command; if the folder is missing or write-protected, or the name too long.
    """
    reads, taken = tuple(inputs), set()
    for output in outputs:
        if any(_same_file(output.path, path) for path in reads):
            raise _refused(output, "it is an input of this command")
        place = (os.path.realpath(output.path.parent), output.path.name)
        if place in taken:
            raise _refused(output, "another output of this command has the same name")
        taken.add(place)
        _require_place(output, makes_folder)


def _require_place(output: Output, makes_folder: bool) -> None:
    path, folder = output.path, output.path.parent
    if len(os.fsencode(path.name)) > _NAME_MAX_BYTES:
        raise _refused(output, "its name is too long")
    try:
        found = path.lstat()
    except FileNotFoundError:
        if makes_folder and not folder.exists():
            return
        if not folder.is_dir():
            raise _refused(output, f"there is no folder {folder}") from None
    except OSError as error:
        raise _refused(output, error.strerror or "unknown reason") from error
    else:
        _require_own(output, found)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise _refused(output, "permission denied")


def _require_own(output: Output, found: os.stat_result) -> None:
    """Refuse to replace a file that is not an output of the same kind."""
    path = output.path
    if stat.S_ISLNK(found.st_mode):
        # What it points to may be in a folder where a renamed file would not replace it.
        raise _refused(output, "it is a link")
    if stat.S_ISDIR(found.st_mode):
        raise _refused(output, "it is a folder")
    if not stat.S_ISREG(found.st_mode):
        raise _refused(output, "it is not a regular file")
    if not os.access(path, os.W_OK):
        raise _refused(output, "permission denied")
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise _refused(output, error.strerror or "unknown reason") from error
    if not output.kind.is_kind_of(head):
        other = "" if output.option is None else f", or {output.elsewhere}"
        raise OutputRefusedError(
            f"{path}: is there already and is not a {output.kind.name} of this program, so it is "
            f"not replaced; move it away{other}"
        )


def _same_file(output: Path, source: Path) -> bool:
    try:
        return os.path.samefile(output, source)
    except OSError:
        # One of them is not there yet.
        return os.path.realpath(output) == os.path.realpath(source)


def _refused(output: Output, reason: str) -> OutputRefusedError:
    return OutputRefusedError(f"{output.path}: cannot be written ({reason}); {output.elsewhere}")


# --- Writing -----------------------------------------------------------------------------------


@contextmanager
def replacing(output: Output) -> Iterator[BinaryIO]:
    """Open an output for writing; it appears whole, or not at all.

    What is written goes into a new file in the same folder, which takes the output's name when the
    block ends. If the block raises, or the disk refuses, an older output stays as it was.

    Yields
    ------
    file
        Takes bytes.

    Raises
    ------
    OutputRefusedError
        If the output must not or cannot be written there, see `require_writable`; also if a file
        of that name has come meanwhile.
    OutputFailedError
        If the disk refuses.
    """
    require_writable([output])
    path = output.path
    # Short, because the name of the output may be as long as names can be.
    part = path.with_name(f".acquire-{secrets.token_hex(8)}.part")
    try:
        # O_EXCL follows no link; the mode is masked by the umask as that of any new file.
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            with open(descriptor, "wb") as file:
                _keep_mode(path, descriptor)
                yield file
                file.flush()
                os.fsync(descriptor)
            require_writable([output])
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink()
            raise
    except OSError as error:
        raise OutputFailedError(
            f"{path}: cannot be written ({error.strerror or error}); free space or mend the disk, "
            f"or {output.elsewhere}"
        ) from error


def write_output(output: Output, content: bytes | str) -> None:
    """Write an output from its whole content; it appears whole, or not at all.

    Parameters
    ----------
    output : Output
    content : bytes or str
        A text is written in UTF-8.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        See `replacing`.
    """
    with replacing(output) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def _keep_mode(path: Path, descriptor: int) -> None:
    """Give a file the rights of the one that it replaces, as writing into that would."""
    try:
        old = stat.S_IMODE(path.lstat().st_mode)
    except FileNotFoundError:
        return
    if old != stat.S_IMODE(os.fstat(descriptor).st_mode):
        os.fchmod(descriptor, old)
