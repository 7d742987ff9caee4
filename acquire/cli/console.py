"""Consoles of the command line: results on standard output, messages on standard error.

Every verb prints through this module. Text from files, instruments and the command line is shown as
text: rich does not interpret markup and emoji codes in it, and characters that do not print appear
as escapes. A run goes on when its terminal is closed, or when nothing reads its pipe any more.
"""

import contextlib
import errno
import json
import os
import stat
import sys
from collections.abc import Iterator
from typing import TextIO, cast

from rich.console import (
    Console,
    ConsoleOptions,
    ConsoleRenderable,
    RenderHook,
    RenderResult,
)
from rich.segment import Segment

from reports.errors import OutputFailedError
from reports.plain_text import visible


def results() -> Console:
    """Return a console on standard output.

    Printing raises `OutputFailedError` if standard output is a file that cannot be written. Output
    to a closed terminal or pipe is dropped.
    """
    return _console(_StandardStream(sys.stdout, required=True))


def messages() -> Console:
    """Return a console on standard error. Messages that cannot be written are dropped."""
    return _console(_StandardStream(sys.stderr, required=False))


def show_message(text: str) -> None:
    """Print a message on standard error."""
    messages().print(text, soft_wrap=True)


def show_json(value: object) -> None:
    """Print a result as JSON, in which all characters beyond ASCII are escaped.

    Raises
    ------
    OutputFailedError
        See `results`.
    """
    stream = _StandardStream(sys.stdout, required=True)
    stream.write(json.dumps(value, indent=2) + "\n")
    stream.flush()


def _console(stream: "_StandardStream") -> Console:
    # A `_StandardStream` has every method that Rich calls.
    file = cast(TextIO, stream)
    console = Console(file=file, highlight=False, markup=False, emoji=False)
    console.push_render_hook(_ShownAsText())
    return console


class _ShownAsText(RenderHook):
    """Replaces unprintable characters by escapes in everything that a console prints."""

    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        """Wrap each object that is about to be rendered."""
        return [_Shown(renderable) for renderable in renderables]


class _Shown:
    """Renders another object, with its text made visible; rich's own control codes stay."""

    def __init__(self, renderable: ConsoleRenderable) -> None:
        self._renderable = renderable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for segment in console.render(self._renderable, options):
            shown = Segment(visible(segment.text), segment.style)
            yield segment if segment.control else shown


class _StandardStream:
    """Standard stream that drops what is written after its reader has gone.

    Parameters
    ----------
    stream : text file, optional
        None if the process was started without it.
    required : bool
        Whether a full or broken disk is an error; if not, the output is dropped there too.
    """

    def __init__(self, stream: TextIO | None, *, required: bool) -> None:
        # Rich puts a proxy in its place while it shows a progress bar.
        self._stream: TextIO | None = getattr(stream, "rich_proxied_file", stream)
        self._required = required

    @property
    def encoding(self) -> str:
        """Encoding of the stream."""
        return getattr(self._stream, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        """Whether it is a terminal that is still there."""
        return self._stream is not None and self._stream.isatty()

    def write(self, text: str) -> int:
        """Write a text; characters that the stream's encoding lacks are escaped."""
        if self._stream is not None:
            encodable = text.encode(self.encoding, "backslashreplace").decode(self.encoding)
            with self._minding_losses():
                self._stream.write(encodable)
        return len(text)

    def flush(self) -> None:
        """Write out what is in the buffer."""
        if self._stream is not None:
            with self._minding_losses():
                self._stream.flush()

    @contextlib.contextmanager
    def _minding_losses(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            gone = _reader_is_gone(self._stream, error)
            _send_nowhere(self._stream)
            self._stream = None
            if self._required and not gone:
                raise OutputFailedError(
                    f"standard output: cannot be written ({error.strerror or error}); free space "
                    "or mend the disk, or send the output elsewhere"
                ) from error


def _reader_is_gone(stream: TextIO | None, error: OSError) -> bool:
    """Whether the other end of a pipe or a terminal was closed, rather than a disk refused."""
    if error.errno == errno.EPIPE:
        return True
    if stream is None or error.errno != errno.EIO:
        return False
    # For a closed terminal isatty says no, but it still is a character device.
    try:
        return stat.S_ISCHR(os.fstat(stream.fileno()).st_mode)
    except OSError:
        return False


def _send_nowhere(stream: TextIO | None) -> None:
    """Connect a stream to the null device, which takes what is left in its buffer.

    Python writes the buffer when the process ends, and changes the exit status if that fails. See
    "Note on SIGPIPE" in the documentation of Python's module `signal`.
    """
    # Streams of tests have no descriptor.
    with contextlib.suppress(OSError):
        if stream is not None:
            descriptor = stream.fileno()
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, descriptor)
            os.close(null)
