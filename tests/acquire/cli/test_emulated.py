"""A sweep through the drivers of real instruments ends as one without wires does."""

import json

import numpy as np
import pytest
import yaml

from protocols.bench import find_bench
from runs.reader import Run

PART = {"camera.width": 640, "camera.height": 512, "sweep.first": 16, "sweep.last": 64}


@pytest.fixture
def emulated_file(tmp_path):
    """Return a function that writes the emulated bench with a coarse reed."""

    def write(**twin):
        content = yaml.safe_load(find_bench("emulated").read_text(encoding="utf-8"))
        content["twin"] = {"mesh": "coarse", **twin}
        path = tmp_path / "wire.yaml"
        path.write_text(yaml.safe_dump(content))
        return path

    return write


@pytest.mark.slow
def test_a_sweep_over_wires_ends_in_the_same_fit(
    cli, folder, protocol_file, bench_file, emulated_file
):
    fits = []
    for name, bench in (("plain", bench_file()), ("wire", emulated_file())):
        out = ["--bench", bench, "--reed", "R07", "--out", f"{name}.h5", "--seed", "4", "--json"]
        said = cli("run", protocol_file(**PART), *out, "--no-fit")
        assert said.status == 0, said.err
        assert json.loads(said.out)["verdicts"] == {"ok": 25}
        # Too few holograms for a joint fit.
        fits.append(cli("fit", f"{name}.h5", "--method", "picture", "--json").json)
    plain, wire = fits
    assert {"F1", "T1"} <= set(wire["modes"])
    assert list(wire["modes"]) == list(plain["modes"])
    for name, mode in plain["modes"].items():
        # Frames are taken at other moments: displacements differ as the pictures below.
        displacements = {
            key: pytest.approx(mode[key], rel=0.05) for key in ("amplitude_nm", "nm_per_v")
        }
        assert wire["modes"][name] == {**mode, **displacements}
    with Run.open("plain.h5") as one, Run.open("wire.h5") as other:
        assert "Novatech 409B at /dev/" in other.identities["synthesizers"]
        assert "SDG2042X" in other.identities["generator"]
        for step, same in zip(one, other, strict=True):
            assert same.read_drive_hz == step.read_drive_hz
            assert same.read_aom1_hz - same.read_aom2_hz == step.read_aom1_hz - step.read_aom2_hz
            # The generator says six digits.
            assert same.read_volts == pytest.approx(step.read_volts, rel=1e-5)
            pictures = [np.abs(run.field(step.position)) ** 2 for run in (one, other)]
            assert np.corrcoef(pictures[0].ravel(), pictures[1].ravel())[0, 1] > 0.95


def test_a_emulated_bench_without_an_amplifier_s_gain_is_refused(
    cli, folder, protocol_file, emulated_file
):
    path = emulated_file()
    path.write_text(path.read_text().replace("amplifier_gain", "gain"))
    said = cli("run", protocol_file(), "--bench", path, "--out", "x.h5")
    assert (said.status, said.out) == (2, "")
    assert "generator.output.gain: unknown key; known are amplifier_gain, load" in said.err
    content = yaml.safe_load(find_bench("emulated").read_text(encoding="utf-8"))
    del content["instruments"]["generator"]["output"]
    path.write_text(yaml.safe_dump(content))
    said = cli("run", protocol_file(), "--bench", path, "--out", "x.h5")
    assert (said.status, said.out) == (2, "")
    assert "instruments.generator.output" in said.err
    assert not (folder / "x.h5").exists()
