"""The public library against sweeps whose modes are known."""

import sys

import numpy as np
import pytest

from studies.modal_peer import PeerMode, peer_modes, peer_version
from tests.numbers import cents

DRIVE_HZ = 1417.0 * 2 ** (np.arange(184) * 25 / 1200)
LOSS = 0.03
MODES_HZ = {
    "one": 2010.0,
    "two": 3310.0,
    "three": 5080.0,
    "four": 5900.0,
    "five": 6830.0,
    "six": 7800.0,
    "seven": 9400.0,
    "eight": 9700.0,
    "nine": 11000.0,
    "ten": 12450.0,
    "eleven": 13900.0,
    "twelve": 15900.0,
    "thirteen": 16600.0,
    "fourteen": 17500.0,
}
BEYOND_HZ = (20500.0, 21800.0, 24000.0, 33000.0)


@pytest.fixture(scope="module")
def library():
    return pytest.importorskip("sdypy.EMA", reason="needs sdypy-EMA, of the extra bench")


needs_library = pytest.mark.usefixtures("library")


def sweep(modes_hz, rng, loss=LOSS, noise=0.01, points=40, drive_hz=DRIVE_HZ):
    """Response of modes with random real shapes and complex participations, and its noise."""
    modes_hz = np.array(list(modes_hz))
    shapes = rng.standard_normal((len(modes_hz), points))
    participation = rng.uniform(0.7, 1.4, len(modes_hz)) * np.exp(
        2j * np.pi * rng.random(len(modes_hz))
    )
    h = 1 / (1 + 1j * loss - (drive_hz[:, None] / modes_hz) ** 2)
    clean = (h * participation) @ shapes
    rough = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
    return clean + noise * np.sqrt(np.mean(np.abs(clean) ** 2) / 2) * rough


@pytest.fixture(scope="module")
def response():
    return sweep([*MODES_HZ.values(), *BEYOND_HZ], np.random.default_rng(5))


@pytest.fixture(scope="module")
def found(library, response):
    return peer_modes(DRIVE_HZ, response, MODES_HZ)


def test_finds_all_modes_of_a_reed_where_they_are(found):
    assert list(found) == list(MODES_HZ)
    errors = np.array([cents(found[name].hz, hz) for name, hz in MODES_HZ.items()])
    assert np.abs(errors).max() < 3
    assert np.sqrt(np.mean(errors**2)) < 1
    losses = [mode.loss_factor for mode in found.values()]
    np.testing.assert_allclose(losses, LOSS, rtol=0.15)


def test_expectations_need_only_be_near(response, found):
    off = {
        name: hz * 2 ** ((25 if number % 2 else -25) / 1200)
        for number, (name, hz) in enumerate(MODES_HZ.items())
    }
    again = peer_modes(DRIVE_HZ, response, off)
    assert list(again) == list(found)
    # The same poles; its rounding differs with where it begins.
    for name, mode in again.items():
        assert cents(mode.hz, found[name].hz) == pytest.approx(0.0, abs=0.01)


@needs_library
@pytest.mark.parametrize("loss", [0.04, 0.08])
def test_loss_is_hysteretic_and_frequency_undamped(loss):
    # The moduli of the poles, which the library calls natural, would be 0.7 and 2.8 cents off.
    apart_hz = {str(hz): hz for hz in (2000.0, 3000.0, 4500.0, 7000.0, 10000.0, 15000.0)}
    few = peer_modes(DRIVE_HZ, sweep(apart_hz.values(), np.random.default_rng(0), loss), apart_hz)
    assert list(few) == list(apart_hz)
    assert abs(np.median([cents(few[name].hz, hz) for name, hz in apart_hz.items()])) < 0.35
    np.testing.assert_allclose([mode.loss_factor for mode in few.values()], loss, rtol=0.05)


@needs_library
def test_close_modes_do_not_share_a_pole(response):
    # Both are expected nearest to the lower one.
    near = peer_modes(DRIVE_HZ, response, {"lower": 9380.0, "upper": 9500.0})
    assert abs(cents(near["lower"].hz, MODES_HZ["seven"])) < 3
    assert abs(cents(near["upper"].hz, MODES_HZ["eight"])) < 3


@needs_library
def test_leaves_out_what_is_not_there(response):
    quarter_tones_hz = 1430.0 * 2 ** (np.arange(90) / 24)
    there_hz = np.array([*MODES_HZ.values(), *BEYOND_HZ])
    away = np.abs(cents(quarter_tones_hz[:, None], there_hz)).min(axis=1) > 115
    absent = {str(hz): float(hz) for hz in quarter_tones_hz[away]}
    assert len(absent) > 30
    assert peer_modes(DRIVE_HZ, response, absent) == {}


@needs_library
def test_leaves_out_what_no_cane_loses():
    broad = sweep([5000.0], np.random.default_rng(0), loss=0.2)
    assert peer_modes(DRIVE_HZ, broad, {"it": 5000.0}) == {}


@needs_library
@pytest.mark.parametrize("hz", [2500.0, 4000.0, 9000.0])
def test_needs_no_noise(hz):
    clean = sweep([hz], np.random.default_rng(1), loss=0.04, noise=1e-4)
    mode = peer_modes(DRIVE_HZ, clean, {"it": hz})["it"]
    assert abs(cents(mode.hz, hz)) < 2


def test_neither_scale_nor_sign_matters(response, found):
    # A power of two, for rounding alone moves poles of high orders by some tenths of a cent.
    assert peer_modes(DRIVE_HZ, -(2.0**-30) * response, MODES_HZ) == found


@needs_library
def test_finds_nothing_in_noise_and_prints_nothing(capfd):
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((len(DRIVE_HZ), 20)) + 1j * rng.standard_normal((len(DRIVE_HZ), 20))
    assert peer_modes(DRIVE_HZ, noise, MODES_HZ) == {}
    assert capfd.readouterr() == ("", "")


@needs_library
def test_a_sweep_may_be_shorter_than_a_band_and_lack_steps():
    some_hz = np.delete(DRIVE_HZ[46:70], 7)
    part = sweep([3310.0], np.random.default_rng(8), drive_hz=some_hz)
    mode = peer_modes(some_hz, part, {"it": 3310.0})["it"]
    assert abs(cents(mode.hz, 3310.0)) < 3


@needs_library
def test_nothing_expected_is_nothing_found(response):
    assert peer_modes(DRIVE_HZ, response, {}) == {}


@needs_library
def test_names_the_version():
    version = peer_version()
    assert version is not None
    assert version[0].isdigit()


def test_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sdypy.EMA", None)
    with pytest.raises(ImportError, match=r"sdypy-EMA .*pip install 'reedbench\[bench\]'"):
        peer_modes(DRIVE_HZ, np.ones((len(DRIVE_HZ), 2), complex), {"it": 2000.0})


def test_no_version_without_the_library(monkeypatch):
    monkeypatch.setattr("studies.modal_peer.LIBRARY", "no-such-library-as-this")
    assert peer_version() is None


def test_modes_are_values():
    assert PeerMode(2000.0, 0.03) == PeerMode(2000.0, 0.03)
