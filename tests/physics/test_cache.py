"""Reduced reeds kept between runs: the same as built, never stale, never in the way."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import numpy as np
import pytest

from physics.reed import cache
from physics.reed.basis import BasisSettings, HalfBasis
from physics.reed.fem import Symmetry
from physics.reed.geometry import ReedGeometry
from physics.reed.mesh import MeshLevel

TINY = MeshLevel(orders=(2, 2, 2), vamp_element_m=14e-3, heel_element_m=23e-3, z_breaks=(0.0, 1.0))
FEW = BasisSettings(E_L_pa=(14e9, 14e9), G_LT_pa=(1.1e9, 1.1e9), modes=3, size=6)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


@pytest.fixture
def announced():
    return []


def reed(announced=None, geometry=None, settings=FEW):
    announce = None if announced is None else announced.append
    return cache.reduced_reed(geometry, TINY, settings, announce)


def test_a_kept_reed_is_the_one_built(folder, announced):
    built, kept = reed(announced), reed(announced)
    assert len(announced) == 1
    assert len(list(folder.iterdir())) == 1
    np.testing.assert_array_equal(kept.plan_m, built.plan_m)
    np.testing.assert_array_equal(kept.load_points_m, built.load_points_m)
    assert (kept.geometry, kept.cane) == (built.geometry, built.cane)
    for symmetry in Symmetry:
        for field in fields(HalfBasis):
            np.testing.assert_array_equal(
                getattr(kept.halves[symmetry], field.name),
                getattr(built.halves[symmetry], field.name),
            )


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
def test_another_reed_is_built_anew(announced):
    reed(announced)
    reed(announced, geometry=replace(ReedGeometry(), thickness_offset_m=1e-6))
    reed(announced, settings=replace(FEW, size=5))
    reed(announced, settings=replace(FEW, cane=replace(FEW.cane, E_T_pa=500e6)))
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
def test_a_damaged_entry_is_built_anew(damage, folder, announced):
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
    np.testing.assert_array_equal(again.halves[half].load_z, built.halves[half].load_z)


@pytest.mark.usefixtures("folder")
def test_another_version_of_a_library_or_of_the_code_makes_it_anew(monkeypatch, announced):
    reed(announced)
    monkeypatch.setattr(cache.np, "__version__", "0.0")
    reed(announced)
    monkeypatch.setattr(cache.Path, "read_bytes", lambda source: b"other code")
    reed(announced)
    assert len(announced) == 3


def kept(inputs, make):
    def to_arrays(value):
        return {"value": np.array(value)}

    return cache.kept("number", inputs, make, to_arrays, lambda arrays: float(arrays["value"]))


@pytest.mark.usefixtures("folder")
def test_inputs_are_told_apart_to_the_last_bit():
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
    assert reed(announced).halves[Symmetry.SYMMETRIC].mass.shape == (6, 6)
    reed(announced)
    assert len(announced) == 2


def test_the_folder_is_the_users_unless_said_otherwise(tmp_path, monkeypatch):
    monkeypatch.delenv("REEDBENCH_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_directory() == tmp_path / "reedbench"
    monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "other"))
    assert cache.cache_directory() == tmp_path / "other"


def test_an_impossible_reed_is_not_kept(folder):
    with pytest.raises(ValueError, match="thickness"):
        reed(geometry=replace(ReedGeometry(), thickness_offset_m=-90e-6))
    assert not list(folder.iterdir())
