"""What sealed recordings hold: the effect, for whoever measures, and no word of it."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import yaml

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind import cases
from blind.cases import (
    Label,
    drawn_label,
    healthy_world,
    record_case,
    stated_sizes,
)
from blind.effects import BY_NAME, KINDS
from blind.laboratory import FRAME_S, Laboratory
from blind.reed import Build, make_reed
from blind.world import World
from runs.reader import Run
from studies.sealed.leaks import disguised

# A laboratory records whole runs.
pytestmark = pytest.mark.slow

# Of the reed's own shape and wood: their modes are other ones.
_OF_THE_BUILD = {
    kind.name
    for kind in KINDS
    if kind.change(World(), 1.0, np.random.default_rng(0)).build != World().build
}
# Numbers of steps that are measured; all others are settings.
_MEASURED = {"signal_to_noise", "noise_level", "lock_error_hz", "lock_error_se_hz"}
# They follow from the numbers and the pictures.
_MEASURED |= {"pixel_checksum", "row_checksum"}


class ShortLaboratory(Laboratory):
    """A laboratory that takes little of a campaign."""

    def campaign(self, names=()):
        yield self._recording("dark", "dark", [], 0.0)
        yield self._recording("rest1", "order0", [], 0.0)
        yield self._recording("up", "sweep", [60, 61], 1.0)


@pytest.fixture(scope="module")
def plain_reed():
    return make_reed(Build())


@pytest.fixture
def short(plain_reed, monkeypatch):
    monkeypatch.setattr("blind.laboratory.make_reed", lambda _build: plain_reed)
    monkeypatch.setattr(cases, "Laboratory", ShortLaboratory)


def _taken(world):
    """Yield all kinds of pictures, late in a campaign, in which everything has begun."""
    laboratory = Laboratory(world)
    laboratory._now_s, laboratory._length_s, laboratory._clamping = 3600.0, 5000.0, 1  # noqa: SLF001  # nothing else lets an hour pass
    yield laboratory._swept(60, 1.0).image  # noqa: SLF001  # a campaign takes half a minute
    for kind in ("dark", "flat", "lo_only", "object_only", "order0", "order0", "order0"):
        yield laboratory._still(0, kind, FRAME_S).frames  # noqa: SLF001  # the same


@pytest.fixture(scope="module")
def well(plain_reed):
    """A laboratory with nothing wrong, and its pictures."""
    world = replace(healthy_world(3), build=Build())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("blind.laboratory.make_reed", lambda _build: plain_reed)
        return world, list(_taken(world))


@pytest.mark.parametrize("name", [k.name for k in KINDS if k.name not in _OF_THE_BUILD])
def test_what_is_sealed_is_in_what_is_recorded(name, short, well):
    world, pictures = well
    # Rare things are made frequent.
    size = 30.0 if name == "lost_frames" else 1.0
    sick = BY_NAME[name].change(world, size, np.random.default_rng(0))
    equal = (np.array_equal(a, b) for a, b in zip(pictures, _taken(sick), strict=True))
    assert not all(equal)


def test_what_is_not_sealed_is_recorded_again_the_same(short, well):
    world, pictures = well
    assert all(np.array_equal(a, b) for a, b in zip(pictures, _taken(world), strict=True))


def _settings(folder):
    """All that run files hold but for what was measured, by file and place."""
    found = {}
    for path in sorted(folder.glob("*.h5")):
        with h5py.File(path) as file:

            def keep(place, thing, name=path.name):
                found[name, place] = {k: repr(v) for k, v in thing.attrs.items()}
                measured = place.startswith("entry/data/f") or place.split("/")[-1] in _MEASURED
                if isinstance(thing, h5py.Dataset) and not measured:
                    found[name, place, "value"] = repr(thing[()])

            file.visititems(keep)
            found[path.name] = {k: repr(v) for k, v in file.attrs.items()}
    return found


def test_only_pictures_and_what_is_read_from_them_reveal_an_effect(short, tmp_path):
    for folder, effects in (
        ("well", ()),
        ("sick", (("carrier_leak", 4.0), ("fixed_pattern_noise", 4.0))),
    ):
        record_case(tmp_path / folder, "a", Label(1, effects, True, 5))
    well, sick = (_settings(tmp_path / folder / "a") for folder in ("well", "sick"))
    assert len(well) > 200
    assert well == sick
    assert not any(path.suffix != ".h5" for path in (tmp_path / "sick" / "a").iterdir())


def test_checksums_are_those_that_the_other_side_expects(short, tmp_path):
    record_case(tmp_path, "a", Label(0, (), True, 5))
    for path in (tmp_path / "a").glob("*.h5"):
        with Run.open(path) as run:
            for step in run:
                assert np.isfinite(run.field(step.position)).all()


def test_a_laboratory_states_what_it_knows_and_not_what_is_withheld(short, tmp_path):
    label = drawn_label(6, 3, 5)
    record_case(tmp_path, "a", label)
    (withheld, _), *_ = label.effects
    known = yaml.safe_load((tmp_path / "a" / "bench.yaml").read_text())["known"]
    assert set(known) == {name for name, _ in label.told} == set(stated_sizes(label))
    assert withheld not in known
    for path in (tmp_path / "a").iterdir():
        assert withheld.encode() not in path.read_bytes()


def test_a_case_is_there_once_it_is_whole(short, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cases, "write_recording", fail)
    with pytest.raises(OSError, match="No space left"):
        record_case(tmp_path, "a", Label(0, (), True, 5))
    assert [path.name for path in tmp_path.iterdir()] == ["a.cut"]


def test_a_disguise_leaves_nothing_but_what_was_measured(short, tmp_path):
    record_case(tmp_path, "a", Label(1, (("carrier_leak", 4.0),), True, 5))
    (tmp_path / "copy").mkdir()
    disguised(tmp_path / "a", tmp_path / "copy", parts=True)
    copies = sorted((tmp_path / "copy").iterdir())
    assert len(copies) == 3
    assert not {path.name for path in copies} & {path.name for path in (tmp_path / "a").iterdir()}
    for path in copies:
        with h5py.File(path) as copy:
            kind = copy["entry/acquisition/kind"].asstr()[()]
            number = {"dark": "dark", "order0": "rest1", "sweep": "up"}[kind]
            with h5py.File(tmp_path / "a" / f"{number}.h5") as own:
                name = own["entry/data"].attrs["signal"]
                assert (copy["entry/data"][name][()] == own["entry/data"][name][()]).all()
                for place in ("entry/sample/name", "entry/start_time", "entry/acquisition/part"):
                    assert copy[place].asstr()[()] != own[place].asstr()[()]
                assert "laboratory a" not in copy["entry/provenance/bench"].asstr()[()]
                assert not copy["entry/program_name"].asstr()[()]
        assert path.stat().st_mtime == pytest.approx(1e9, abs=100)


# Sizes of twice the usual in the terms of the catalogue, worked out by hand.
STATED = {
    "tweeter_compression": {"fraction": 0.3},
    "amplifier_rolloff": {"inverse_corner": 1 / 3},
    "acoustic_resonance": {"excess": 1.0},
    "second_acoustic_resonance": {"strength": 0.12},
    "chamber_leakage": {"fraction": 0.3},
    "air_load": {"fraction": 0.5},
    "frequency_dependent_damping": {"exponent": 0.2},
    "density": {"density": 0.06},
    "transverse_modulus": {"E_T": 0.2},
    "thickness_offset": {"thickness": 12e-6},
    "thickness_wedge": {"thickness": 12e-6},
    "thickness_crown": {"thickness": 12e-6},
    "thickness_tilt": {"thickness": 10e-6},
    "tip_mass": {"mass": 0.8e-6},
    "clamp_compliance": {"compliance": 4e-13},
    "clamp_asymmetry": {"compliance": 4e-13},
    "hardening_nonlinearity": {"fraction": 8e-4},
    "temperature_drift": {"rate": 8.0},
    "drying": {"fraction": 0.2},
    "bench_vibration": {"jitter": 0.1},
    "synthesizer_detuning": {"offset": 0.02},
    "generator_clock": {"ratio": 4.0},
    "synthesizer_drift": {"rate": 0.1},
    "lost_frames": {"fraction": 0.02},
    "laser_power_drift": {"loss_rate": 0.3},
    "laser_mode_hop": {"contrast_loss": 0.16},
    "speckle_decorrelation": {"contrast_loss": 6e-4},
    "sideband_crosstalk": {"fraction": 0.06},
    "carrier_leak": {"fraction": 0.02},
    "phase_step_error": {"error": 0.1},
    "defocus": {"distance": 0.04},
    "vignetting": {"fraction": 0.1},
    "fixed_pattern_noise": {"rms": 0.02},
    "hot_pixels": {"fraction": 0.004},
    "read_noise": {"log_factor": np.log(1.6)},
    "sensor_nonlinearity": {"fraction": 0.06},
}
# Of these what is drawn at random is stated: only a sum of squares is known beforehand.
AT_RANDOM = {"transverse_shear": 0.3, "lo_misalignment": 0.8e-3}


def test_sizes_are_reported_as_they_are():
    stated = {
        kind.name: kind.sizes(World(), kind.change(World(), 2.0, np.random.default_rng(0)))
        for kind in KINDS
        if kind.sizes is not None
    }
    assert set(stated) == {*STATED, *AT_RANDOM, "viscoelastic_stiffening"}
    for name, sizes in STATED.items():
        assert stated[name] == pytest.approx(sizes, rel=1e-9), name
    for name, size in AT_RANDOM.items():
        assert np.hypot(*stated[name].values()) == pytest.approx(size, rel=1e-9)
    powers = stated["viscoelastic_stiffening"]
    assert powers["E_L"] / 0.08 + powers["G_LT"] / 0.12 == pytest.approx(1.0)
    other = BY_NAME["clamp_asymmetry"]
    sick = other.change(World(), -2.0, np.random.default_rng(0))
    assert other.sizes(World(), sick) == pytest.approx({"compliance": -4e-13})
