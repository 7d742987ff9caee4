"""Reduced reeds kept between runs: the same as built, never stale, never in the way."""

import contextlib
import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from physics.errors import ImpossibleReedError
from physics.reed import cache
from physics.reed.cane.material import Cane
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.reduced.reed import BasisSettings, ReedBox
from physics.reed.reduced.stored import reduced_reed

TINY = MeshLevel(orders=(2, 2, 2), vamp_element_m=14e-3, heel_element_m=23e-3, z_breaks=(0.0, 1.0))
FEW = BasisSettings(ReedBox(), modes=3, size=6, snapshots=0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


@pytest.fixture
def announced():
    return []


def reed(announced=None, geometry=None, settings=FEW):
    announce = None if announced is None else announced.append
    return reduced_reed(geometry, TINY, settings, announce)


def test_a_kept_reed_is_the_one_built(folder, announced):
    built, kept = reed(announced), reed(announced)
    assert len(announced) == 1
    assert len(list(folder.iterdir())) == 1
    np.testing.assert_array_equal(kept.plan_m, built.plan_m)
    np.testing.assert_array_equal(kept.load_points_m, built.load_points_m)
    assert (kept.geometry, kept.cane) == (built.geometry, built.cane)
    assert list(kept.loose) == list(Symmetry)
    for symmetry, part in built.loose.items():
        other = kept.loose[symmetry]
        assert other.held == part.held == 6
        for field in fields(part):
            if field.name not in ("held", "measures"):
                one, same = getattr(part, field.name), getattr(other, field.name)
                np.testing.assert_array_equal(one, same)
        (own,), (others,) = part.measures.values(), other.measures.values()
        for field in fields(own):
            np.testing.assert_array_equal(getattr(own, field.name), getattr(others, field.name))
    for field in fields(built.edge):
        one, same = getattr(built.edge, field.name), getattr(kept.edge, field.name)
        np.testing.assert_array_equal(one, same)


def test_what_two_programs_want_at_once_is_made_once(folder):
    made = []

    def make():
        made.append(len(made))
        time.sleep(0.2)
        return np.arange(3.0)

    def want(_):
        return cache.kept("thing", (), make, lambda x: {"x": x}, lambda arrays: arrays["x"])

    with ThreadPoolExecutor(4) as pool:
        for each in pool.map(want, range(4)):
            np.testing.assert_array_equal(each, np.arange(3.0))
    assert made == [0]
    assert [entry.suffix for entry in folder.iterdir()] == [".npz"]


@pytest.mark.usefixtures("folder")
def test_another_reed_is_built_again(announced):
    reed(announced)
    reed(announced, geometry=replace(ReedGeometry(), thickness_offset_m=1e-6))
    reed(announced, settings=replace(FEW, size=5))
    reed(announced, settings=replace(FEW, box=ReedBox(Cane(E_T_pa=500e6))))
    assert len(announced) == 4


@pytest.mark.parametrize(
    "damage",
    [
        b"",
        b"not an archive",
        None,
    ],
    ids=["empty", "foreign", "cut"],
)
def test_a_damaged_entry_is_built_again(damage, folder, announced):
    built = reed(announced)
    (entry,) = folder.iterdir()
    entry.write_bytes(entry.read_bytes()[:2000] if damage is None else damage)
    again = reed(announced)
    assert len(announced) == 2
    np.testing.assert_array_equal(again.plan_m, built.plan_m)
    reed(announced)
    assert len(announced) == 2


def test_a_changed_bit_is_noticed(folder, announced):
    built = reed(announced)
    (entry,) = folder.iterdir()
    content = bytearray(entry.read_bytes())
    content[len(content) // 2] ^= 1
    entry.write_bytes(content)
    again = reed(announced)
    assert len(announced) == 2
    half = Symmetry.SYMMETRIC
    np.testing.assert_array_equal(again.parts[half].load_z, built.parts[half].load_z)


@pytest.mark.usefixtures("folder")
def test_another_version_of_a_library_or_of_the_code_makes_it_again(monkeypatch, announced):
    reed(announced)
    monkeypatch.setattr(cache.np, "__version__", "0.0")
    reed(announced)
    monkeypatch.setattr(cache.Path, "read_bytes", lambda source: b"other code")
    reed(announced)
    assert len(announced) == 3


EDITED = """
import sys
from pathlib import Path
import numpy as np
from physics.reed import cache

source = Path(cache.__file__).parent / "elements" / "mesh.py"
assert source.is_relative_to(Path.cwd())
if sys.argv[1] == "1":
    source.write_text(source.read_text() + "# edited")
print(*cache.kept("x", (), lambda: sys.argv[1:], lambda x: {"x": np.array(x)}, lambda a: a["x"]))
"""


@pytest.mark.usefixtures("folder")
def test_what_is_computed_by_code_of_before_an_edit_is_not_taken_for_the_edited_codes(tmp_path):
    shutil.copytree(Path(cache.__file__).parents[1], tmp_path / "physics")
    # As Emacs does while a file has changes that are not saved.
    (tmp_path / "physics" / "reed" / ".#mesh.py").symlink_to("nothing")

    def kept_by(number):
        command = [sys.executable, "-c", EDITED, number]
        done = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    assert [kept_by(number) for number in "12"] == ["1", "2"]


def kept(inputs, make):
    def to_arrays(value):
        return {"value": np.array(value)}

    return cache.kept("number", inputs, make, to_arrays, lambda arrays: float(arrays["value"]))


@pytest.mark.usefixtures("folder")
def test_inputs_are_distinguished_to_the_last_bit():
    assert kept((0.1,), lambda: 1.0) == 1.0
    assert kept((0.1,), lambda: 2.0) == 1.0
    assert kept((np.nextafter(0.1, 1).item(),), lambda: 3.0) == 3.0


def test_what_cannot_be_kept_whole_leaves_nothing_behind(folder, monkeypatch):
    def full(part, **arrays):
        part.write(b"half of it")
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(cache.np, "savez", full)
        assert kept((1,), lambda: 1.0) == 1.0
    assert list(folder.iterdir()) == []
    assert kept((1,), lambda: 2.0) == 2.0


def test_a_folder_that_cannot_be_made_costs_only_time(tmp_path, monkeypatch, announced):
    (tmp_path / "file").touch()
    monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "file" / "below"))
    assert reed(announced).parts[Symmetry.SYMMETRIC].mass.shape == (6, 6)
    reed(announced)
    assert len(announced) == 2


def test_the_folder_is_the_users_unless_said_otherwise(tmp_path, monkeypatch):
    monkeypatch.delenv("REEDBENCH_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_directory() == tmp_path / "reedbench"
    monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "other"))
    assert cache.cache_directory() == tmp_path / "other"


def test_an_impossible_reed_is_not_kept(folder):
    with pytest.raises(ImpossibleReedError, match="thickness"):
        reed(geometry=replace(ReedGeometry(), thickness_offset_m=-90e-6))
    assert not list(folder.iterdir())


# --- What does not verify is built again -------------------------------------------------------


@pytest.fixture
def count(folder):
    """Return a function that wants three numbers, and says how often they were made so far."""
    made = []

    def make():
        made.append(len(made))
        return np.arange(3.0)

    def want(key=1):
        found = cache.kept("x", (key,), make, lambda x: {"x": x}, lambda arrays: arrays["x"])
        np.testing.assert_array_equal(found, np.arange(3.0))
        return len(made)

    return want


@pytest.fixture
def entry(count, folder):
    """The path of an entry, made once."""
    assert count() == 1
    (path,) = folder.iterdir()
    return path


def test_an_entry_cut_anywhere_is_built_again(entry, count):
    whole = entry.read_bytes()
    lengths = {0, 1, 49, 50, 51, *range(2, len(whole), 7), *range(len(whole) - 60, len(whole))}
    for number, length in enumerate(sorted(lengths)):
        entry.write_bytes(whole[:length])
        assert count() == 2 + number
        assert count() == 2 + number
    assert entry.read_bytes() == whole


def test_a_changed_byte_anywhere_is_noticed(entry, count):
    whole, rng = entry.read_bytes(), np.random.default_rng(5)
    for number, place in enumerate(rng.choice(len(whole), 200, replace=False)):
        content = bytearray(whole)
        content[place] ^= rng.integers(1, 256)
        entry.write_bytes(content)
        assert count() == 2 + number
    entry.write_bytes(whole + b"more")
    assert count() == 3 + number


def _resaved(change):
    def damage(entry):
        with np.load(entry) as arrays:
            content = change(dict(arrays))
        with entry.open("wb") as file:
            np.savez(file, **content)

    return damage


def _resaved_with_the_old_end(entry):
    """A file that keeps all that is no array."""
    whole, times = bytearray(entry.read_bytes()), np.float64(1.3)
    old, new = np.arange(3.0).tobytes(), (times * np.arange(3.0)).tobytes()
    whole[whole.index(old) : whole.index(old) + len(old)] = new
    entry.write_bytes(whole)


def _folder(entry):
    entry.unlink()
    entry.mkdir()


def _full_folder(entry):
    _folder(entry)
    (entry / "something").write_text("in it")


def _link(entry):
    copy = entry.parent.parent / "elsewhere.npz"
    entry.rename(copy)
    entry.symlink_to(copy)


def _link_to_nothing(entry):
    entry.unlink()
    entry.symlink_to(entry.parent / "nothing")


def _pipe(entry):
    entry.unlink()
    os.mkfifo(entry)


DAMAGES = {
    "times 1.3": _resaved(lambda arrays: {"x": 1.3 * arrays["x"]}),
    "times 1.3, same seal": _resaved_with_the_old_end,
    "not a number": _resaved(lambda arrays: {"x": np.array([0.0, np.nan, 2.0])}),
    "other shape": _resaved(lambda arrays: {"x": arrays["x"][:2]}),
    "other type": _resaved(lambda arrays: {"x": arrays["x"].astype(np.float32)}),
    "missing array": _resaved(lambda arrays: {}),
    "extra array": _resaved(lambda arrays: {**arrays, "y": arrays["x"]}),
    "same arrays, no seal": _resaved(lambda arrays: arrays),
    "pickle": _resaved(lambda arrays: {"x": np.array([{}, None, 1], dtype=object)}),
    "folder": _folder,
    "full folder": _full_folder,
    "link": _link,
    "link to nothing": _link_to_nothing,
    "pipe": _pipe,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_what_does_not_verify_is_never_used_and_replaced(damage, entry, count, capfd):
    damage(entry)
    assert count() == 2
    assert count() == 2
    assert list(entry.parent.iterdir()) == [entry]
    assert entry.is_file()
    assert not entry.is_symlink()
    assert capfd.readouterr() == ("", "")


def test_a_link_at_an_entrys_name_leaves_its_target_alone(entry, count):
    target = entry.parent.parent / "target"
    target.write_text("others's")
    entry.unlink()
    entry.symlink_to(target)
    assert count() == 2
    assert target.read_text() == "others's"


def test_an_entry_of_another_key_under_this_name_is_not_used(entry, count, folder):
    count(2)
    (other,) = set(folder.iterdir()) - {entry}
    entry.write_bytes(other.read_bytes())
    assert count() == 3
    assert count() == 3


def test_an_entry_that_may_not_be_read_costs_only_time(entry, count):
    entry.chmod(0)
    # The administrator may read it.
    assert count() == (1 if os.access(entry, os.R_OK) else 2)
    entry.chmod(0o600)
    count()


def test_a_large_file_without_a_seal_is_not_read(entry, count):
    with entry.open("r+b") as file:
        # Sparse: more than any memory.
        file.truncate(2**43)
    assert count() == 2


@pytest.mark.parametrize("value", [np.nan, np.inf, complex(0, np.nan)])
def test_numbers_that_are_not_finite_are_not_kept(value, folder):
    made = []

    def make():
        made.append(value)
        return {"good": np.arange(3.0), "names": np.array(["a"]), "bad": np.array([1.0, value])}

    for _ in range(2):
        found = cache.kept("bad", (), make, lambda x: x, lambda arrays: arrays)
        np.testing.assert_array_equal(found["bad"], [1.0, value])
    assert len(made) == 2
    assert not list(folder.iterdir())


# --- Writing -----------------------------------------------------------------------------------


def test_the_rights_of_an_entry_follow_the_umask(count, folder):
    before = os.umask(0o027)
    try:
        count()
    finally:
        os.umask(before)
    (path,) = folder.iterdir()
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_disk_that_is_full_costs_only_time(count, folder):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2, hard))
    try:
        assert count() == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(folder.iterdir()) == []
    assert (count(), count()) == (2, 2)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EIO])
@pytest.mark.parametrize("name", ["open", "fsync"])
def test_a_disk_that_refuses_costs_only_time(name, number, entry, count, monkeypatch):
    damaged = entry.read_bytes()[:-1]
    entry.write_bytes(damaged)
    really_open = os.open

    def refuse(path, *arguments):
        if name == "open" and not arguments[0] & os.O_CREAT:
            return really_open(path, *arguments)
        raise OSError(number, os.strerror(number), path)

    with monkeypatch.context() as patch:
        patch.setattr(os, name, refuse)
        assert (count(), count()) == (2, 3)
    assert list(entry.parent.iterdir()) == [entry]
    assert entry.read_bytes() == damaged
    assert (count(), count()) == (4, 4)


def test_what_a_killed_writer_left_is_removed(folder, count):
    folder.mkdir()
    assert count() == 1
    (path,) = folder.iterdir()
    path.rename(path.with_suffix(".0123456789abcdef.part"))
    (folder / "other-1.0123.part").touch()
    assert count() == 2
    assert {left.name for left in folder.iterdir()} == {path.name, "other-1.0123.part"}


def test_a_user_without_a_home_computes(monkeypatch):
    for name in ("HOME", "REEDBENCH_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def unknown(_):
        raise KeyError("getpwuid(): uid not found")

    monkeypatch.setattr("pwd.getpwuid", unknown)
    assert kept((1,), lambda: 1.0) == 1.0
    assert kept((1,), lambda: 2.0) == 2.0


# --- Locking -----------------------------------------------------------------------------------


def lock_of(folder):
    """Path of the lock of the entry that `count` makes."""
    (path,) = folder.glob("x-*.npz")
    path.unlink()
    return path.with_suffix(".lock")


def test_a_link_at_the_locks_name_is_not_followed(count, folder, tmp_path):
    count()
    target = tmp_path / "target"
    target.write_text("others's")
    lock_of(folder).symlink_to(target)
    assert (count(), count()) == (2, 2)
    assert target.read_text() == "others's"


@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo])
def test_what_is_no_file_at_the_locks_name_is_not_waited_for(make, count, folder):
    count()
    make(lock_of(folder))
    assert (count(), count()) == (2, 2)


def test_a_lock_left_by_a_killed_process_is_taken_over(count, folder):
    count()
    lock_of(folder).write_text("123\n")
    assert (count(), count()) == (2, 2)
    assert [left.suffix for left in folder.iterdir()] == [".npz"]


@pytest.mark.usefixtures("folder")
def test_two_never_compute_the_same_at_once_even_if_it_is_not_kept():
    working, most = [], []

    def make():
        working.append(1)
        most.append(len(working))
        time.sleep(0.12)
        working.pop()
        raise ValueError("impossible")

    def want(number):
        # Some come while another computes, some just as one has ended.
        time.sleep(0.05 * number)
        with contextlib.suppress(ValueError):
            kept((1,), make)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(want, range(8)))
    assert most == [1] * 8


@contextlib.contextmanager
def computing(value, **more):
    """Compute a number on another thread until the context ends."""
    begun, go_on = threading.Event(), threading.Event()

    def make():
        begun.set()
        assert go_on.wait(10)
        return value

    with ThreadPoolExecutor(1) as pool:
        pool.submit(kept, (1,), make)
        try:
            assert begun.wait(10)
            yield go_on
        finally:
            go_on.set()


def wait_for_number(announce, make=lambda: 2.0):
    return cache.kept(
        "number",
        (1,),
        make,
        lambda value: {"value": np.array(value)},
        lambda arrays: float(arrays["value"]),
        announce,
    )


@pytest.mark.usefixtures("folder")
def test_what_is_waited_for_is_announced_once(announced):
    with computing(1.0) as go_on:

        def hear(sentence):
            announced.append(sentence)
            threading.Timer(0.3, go_on.set).start()

        assert wait_for_number(hear) == 1.0
    (sentence,) = announced
    assert f"process {os.getpid()}" in sentence
    assert ".lock" in sentence
    assert "Ctrl-C" in sentence


@pytest.mark.usefixtures("folder")
def test_an_interrupt_ends_the_wait(announced, awake_s):
    def hear(sentence):
        announced.append(sentence)
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()

    with computing(1.0):
        began_s = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            wait_for_number(hear)
        assert awake_s(began_s) < 2
    assert len(announced) == 1
    assert wait_for_number(None) == 1.0


@pytest.mark.usefixtures("folder")
def test_a_process_that_does_not_go_on_is_not_waited_for_for_ever(monkeypatch):
    monkeypatch.setattr(cache, "_PATIENCE_S", 0.2)
    with computing(1.0):
        assert wait_for_number(None) == 2.0


@pytest.mark.usefixtures("folder")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_process_forked_meanwhile_does_not_keep_the_lock():
    waiter = threading.Thread(target=kept, args=((1,), lambda: 2.0), daemon=True)
    forked = []

    def make():
        forked.append(os.fork())
        if forked == [0]:
            time.sleep(8)
            os._exit(0)
        waiter.start()
        time.sleep(0.2)
        return np.nan

    kept((1,), make)
    waiter.join(2)
    still_waits = waiter.is_alive()
    os.kill(forked[0], signal.SIGKILL)
    os.waitpid(forked[0], 0)
    assert not still_waits


SIX = """
import os, sys, time
import numpy as np
from physics.reed import cache

def make():
    with open(sys.argv[1], "a") as made:
        made.write("made\\n")
    time.sleep(0.5)
    return np.random.default_rng().random(1000)

def want():
    found = cache.kept("x", (), make, lambda x: {"x": x}, lambda arrays: arrays["x"])
    return found.tobytes().hex()

children = []
for number in range(6):
    child = os.fork()
    if not child:
        with open(f"{sys.argv[1]}.{number}", "w") as out:
            out.write(want())
        os._exit(0)
    children.append(child)
sys.exit(max(os.waitpid(child, 0)[1] for child in children))
"""


def test_six_processes_on_an_empty_cache_compute_once_and_agree(folder, tmp_path):
    made = tmp_path / "made"
    subprocess.run([sys.executable, "-c", SIX, made], check=True, timeout=30)
    assert made.read_text() == "made\n"
    assert len({(tmp_path / f"made.{number}").read_text() for number in range(6)}) == 1
    assert [entry.suffix for entry in folder.iterdir()] == [".npz"]
