"""Outputs: what they replace, what they refuse to replace, and what a bad disk leaves."""

import errno
import io
import os
import resource
import stat
import struct
import threading
import zlib
from contextlib import contextmanager

import pytest
from matplotlib.figure import Figure

from reports import own_output
from reports.errors import OutputFailedError, OutputRefusedError
from reports.own_output import (
    Output,
    description_kind,
    page_kind,
    picture_kind,
    replacing,
    require_writable,
    table_kind,
    write_output,
)

PAGE, PICTURE = page_kind("report"), picture_kind("response")
TABLE, CAMPAIGN = table_kind("components", ("reed", "e1")), description_kind("next campaign")
KINDS = (PAGE, PICTURE, TABLE, CAMPAIGN)


def _chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _content(kind, more="more"):
    """What a writer of a kind would write."""
    if kind.form == "text":
        return f"{kind.mark}{more}".encode()
    texts = [_chunk(b"tEXt", b"Software\0" + kind.mark.encode()), _chunk(b"IDAT", more.encode())]
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", bytes(13)) + b"".join(texts)


# --- Kinds -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_an_output_is_recognised_by_its_content(kind, tmp_path):
    path = tmp_path / "any.name"
    for other in KINDS:
        path.write_bytes(_content(other))
        if other is kind:
            require_writable([Output(path, kind)])
        else:
            with pytest.raises(OutputRefusedError, match="move it away"):
                require_writable([Output(path, kind)])


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"\x89HDF\r\n\x1a\n",
        b"\x89PNG\r\n\x1a\n",
        b"\x89PNG\r\n\x1a\n" + b"\xff" * 40,
        b"<!doctype html><html><head><meta name='generator' content='reedbench report'></head>",
        b"reed,e1,e2\nR1,0,0\n",
        b"reed,e1\r\nR1,0\r\n",
        b"name: mine\n# reedbench next campaign\n",
        _content(picture_kind("modes")),
        _content(page_kind("diagnosis")),
    ],
)
def test_files_of_others_are_never_replaced(kind, content, tmp_path):
    path = tmp_path / "mine"
    path.write_bytes(content)
    with pytest.raises(OutputRefusedError, match="move it away, or choose another place with --to"):
        write_output(Output(path, kind, "--to"), _content(kind))
    assert path.read_bytes() == content
    assert os.listdir(tmp_path) == ["mine"]


def test_a_picture_of_matplotlib_says_what_it_is():
    figure, buffer = Figure(figsize=(1, 1)), io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": PICTURE.mark})
    assert PICTURE.is_kind_of(buffer.getvalue()[:4096])
    assert not picture_kind("contact sheet").is_kind_of(buffer.getvalue()[:4096])


# --- Places ------------------------------------------------------------------------------------


def test_places_that_cannot_be_written_are_refused(tmp_path, monkeypatch):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("text")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("nothing")
    refused = {
        "no/page.html": "there is no folder",
        "file/page.html": "Not a directory",
        "folder": "it is a folder",
        "pipe": "not a regular file",
        "link": "it is a link",
        f"{'n' * 256}": "too long",
    }
    for name, reason in refused.items():
        with pytest.raises(OutputRefusedError, match=f"{reason}.*--next") as refused:
            require_writable([Output(tmp_path / name, PAGE, "--next")])
        assert "\n" not in str(refused.value)
        assert refused.value.exit_status == 2
    require_writable([Output(tmp_path / ("n" * 255), PAGE)])
    require_writable([Output(tmp_path / "no" / "page.html", PAGE)], makes_folder=True)
    with pytest.raises(OutputRefusedError, match="too long"):
        require_writable([Output(tmp_path / "no" / ("n" * 256), PAGE)], makes_folder=True)
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(OutputRefusedError, match="permission denied"):
        require_writable([Output(tmp_path / "page.html", PAGE)])


def test_a_file_that_is_write_protected_stays(tmp_path, monkeypatch):
    page = tmp_path / "page.html"
    page.write_bytes(_content(PAGE))
    monkeypatch.setattr(os, "access", lambda path, mode: path != page)
    with pytest.raises(OutputRefusedError, match="permission denied"):
        write_output(Output(page, PAGE), b"new")


def test_no_input_is_replaced_under_any_name(tmp_path):
    source, other = tmp_path / "source.html", tmp_path / "other.html"
    source.write_bytes(_content(PAGE))
    link, hard = tmp_path / "link.html", tmp_path / "hard.html"
    link.symlink_to(source)
    hard.hardlink_to(source)
    for output in (source, link, hard, tmp_path / "." / "source.html"):
        with pytest.raises(OutputRefusedError, match="is an input of this command"):
            require_writable([Output(output, PAGE)], [other, source])
    # Neither is what a command is about to make before it reads it.
    with pytest.raises(OutputRefusedError, match="is an input of this command"):
        require_writable([Output(other, PAGE)], [other])
    require_writable([Output(other, PAGE)], [source])


def test_two_outputs_have_two_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outputs = [
        Output(tmp_path / "a", PAGE),
        Output(tmp_path.joinpath("..", tmp_path.name, "a"), TABLE),
    ]
    with pytest.raises(OutputRefusedError, match="same name"):
        require_writable(outputs)
    require_writable([outputs[0], Output(tmp_path / "b", TABLE)])


# --- Writing -----------------------------------------------------------------------------------


@pytest.fixture
def page(tmp_path):
    """An older page, where a newer one is to be."""
    page = tmp_path / "page.html"
    page.write_bytes(_content(PAGE, "old"))
    return page


def test_an_older_output_is_replaced(page):
    for more in ("new", "newer ü"):
        write_output(Output(page, PAGE), f"{PAGE.mark}{more}")
        assert page.read_text("utf-8") == f"{PAGE.mark}{more}"
    assert os.listdir(page.parent) == ["page.html"]


def test_readers_see_the_old_or_the_new(page):
    with page.open("rb") as reader, replacing(Output(page, PAGE)) as file:
        file.write(_content(PAGE, "new" * 9999))
        file.flush()
        assert page.read_bytes() == reader.read() == _content(PAGE, "old")
    assert page.read_bytes() == _content(PAGE, "new" * 9999)


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_a_new_file_has_the_rights_that_the_umask_gives(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_output(Output(tmp_path / "a", PAGE), b"")
        (tmp_path / "b").write_bytes(b"")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_a_file_keeps_its_rights(page):
    page.chmod(0o640)
    write_output(Output(page, PAGE), b"new")
    assert stat.S_IMODE(page.stat().st_mode) == 0o640


def test_a_file_that_comes_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "page.html"

    def overtaken():
        with replacing(Output(path, PAGE)) as file:
            file.write(b"new")
            path.write_text("of a person")

    with pytest.raises(OutputRefusedError, match="move it away"):
        overtaken()
    assert path.read_text() == "of a person"
    assert os.listdir(tmp_path) == ["page.html"]


def test_a_name_may_be_as_long_as_names_can_be(tmp_path):
    write_output(Output(tmp_path / ("ü" * 127), PAGE), b"new")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"new"]


# --- Disks that refuse -------------------------------------------------------------------------


@pytest.mark.parametrize("function", ["open", "fsync", "replace"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EDQUOT, errno.EROFS])
def test_a_disk_that_refuses_is_a_failure_and_leaves_the_old(page, monkeypatch, function, number):
    def refuse(*args, **kwargs):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(own_output.os, function, refuse)
    with pytest.raises(OutputFailedError, match=os.strerror(number)) as failed:
        write_output(Output(page, PAGE), b"new")
    monkeypatch.undo()
    assert failed.value.exit_status == 1
    assert "\n" not in str(failed.value)
    assert page.read_bytes() == _content(PAGE, "old")
    assert os.listdir(page.parent) == ["page.html"]


@contextmanager
def _largest_file(size_bytes):
    """Let files of this process grow no further, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [100, 20_000])
def test_no_part_of_an_output_is_left_where_it_does_not_fit(page, size):
    # The smaller fails when the buffer is handed over, the larger when it is written.
    with pytest.raises(OutputFailedError), _largest_file(50):
        write_output(Output(page, PAGE), b"n" * size)
    assert page.read_bytes() == _content(PAGE, "old")
    assert os.listdir(page.parent) == ["page.html"]


@pytest.mark.parametrize("trouble", [KeyboardInterrupt, ZeroDivisionError, SystemExit])
def test_what_breaks_off_leaves_the_old(page, trouble):
    def break_off():
        with replacing(Output(page, PAGE)) as file:
            file.write(b"half")
            raise trouble

    with pytest.raises(trouble):
        break_off()
    assert page.read_bytes() == _content(PAGE, "old")
    assert os.listdir(page.parent) == ["page.html"]


def test_two_writers_leave_one_whole_output(tmp_path):
    output = Output(tmp_path / "page.html", PAGE)
    contents = [_content(PAGE, str(k) * 50_000) for k in range(4)]
    threads = [threading.Thread(target=write_output, args=(output, c)) for c in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert output.path.read_bytes() in contents
    assert os.listdir(tmp_path) == ["page.html"]
