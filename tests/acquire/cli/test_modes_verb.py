"""`acquire modes`: what it prints, what its options do, and how it refuses."""

import functools

import numpy as np
import pytest

from physics.reed.elements.mesh import MeshLevel
from physics.reed.reduced.reed import BasisSettings

FAST = ("--mesh", "fast")


@pytest.fixture(scope="module")
def clarinet(cli):
    answer = cli("modes", "--json", *FAST)
    assert answer.status == 0, answer.err
    return answer.json


def hz(answer):
    return {mode["name"]: mode["hz"] for mode in answer["modes"]}


def test_json_lists_the_modes_of_the_paper(clarinet):
    assert set(clarinet) == {"reed", "material", "modes"}
    assert clarinet["reed"] == "clarinet"
    for mode in clarinet["modes"]:
        assert list(mode) == ["name", "hz", "class", "symmetry", "similarity"]
    listed = {mode["name"]: (mode["class"], mode["symmetry"]) for mode in clarinet["modes"]}
    assert listed["F1"] == ("flexural", "symmetric")
    assert listed["T1"] == ("transversal", "antisymmetric")
    assert listed["X2"] == ("generic", "symmetric")
    assert listed["L1"] == ("lateral", "antisymmetric")
    assert listed["H1"] == ("heel", "symmetric")
    assert set(listed) >= {*(f"F{k}" for k in range(1, 5)), *(f"T{k}" for k in range(1, 6))}
    assert set(listed) >= {f"X{k}" for k in range(1, 7)}
    frequencies = [mode["hz"] for mode in clarinet["modes"]]
    assert frequencies == sorted(frequencies)
    assert frequencies[-1] < 20_000


def test_the_table_has_the_same(cli, clarinet):
    answer = cli("modes", "clarinet", *FAST)
    assert answer.status == 0
    for mode in clarinet["modes"]:
        row = next(line for line in answer.out.splitlines() if f" {mode['name']} " in line)
        assert f"{mode['hz']:.1f}" in row.split()
        assert mode["class"] in row
        assert mode["symmetry"] in row
    assert "above F6" in answer.out


@pytest.mark.parametrize(
    ("options", "raised"),
    [
        (("--e-l", "20 GPa"), "F1"),
        (("--E-L", "20 GPa"), "F1"),
        (("--g-lt", "2 GPa"), "T1"),
        (("--e-t", "1 GPa"), "T2"),
        (("--G-LR", "4 GPa"), "F4"),
        (("--g-tr", "4 GPa"), "T4"),
        (("--e-r", "2 GPa"), "F3"),
        (("--thickness-offset", "20 um"), "T2"),
        (("--density", "450 kg/m^3"), "F2"),
        (("--nu-lt", "0.6"), "F1"),
        (("--nu-tr", "0.6"), "F3"),
        (("--nu-lr", "0.6"), "F1"),
    ],
)
def test_every_constant_has_an_option(cli, clarinet, options, raised):
    """All are stiffer or lighter than the reference, and raise the mode that hangs on it most."""
    answer = cli("modes", "--json", *FAST, *options)
    assert answer.status == 0, answer.err
    assert hz(answer.json)[raised] > hz(clarinet)[raised] * (1 + 1e-5)


def test_density_acts_by_its_root(cli, clarinet):
    heavy = hz(cli("modes", "--json", "--density", "2.08 g/cm^3", *FAST).json)
    np.testing.assert_allclose(heavy["F1"], hz(clarinet)["F1"] / 2, rtol=1e-9)


def test_warm_and_dry_cane(cli):
    ambient, warm, dry = (
        hz(cli("modes", "alto-saxophone", "--json", *FAST, *options).json)
        for options in ((), ("--temperature", "40 degC"), ("--dryness", "1"))
    )
    assert warm["F1"] < ambient["F1"]
    # As the paper's population from series A to series B.
    assert dry["F2"] < ambient["F2"]
    assert dry["T1"] > ambient["T1"]


def test_both_moduli_fix_viscoelastic_cane(cli):
    options = ("--e-l", "14 GPa", "--g-lt", "1.1 GPa")
    material = cli("modes", "alto-saxophone", "--json", *FAST, *options).json["material"]
    assert material["viscoelastic"] is None
    assert (material["E_L_pa"], material["G_LT_pa"]) == (14e9, 1.1e9)


def test_pictures_are_drawn(cli, folder):
    answer = cli("modes", *FAST, "--pictures", "modes.png")
    assert answer.status == 0, answer.err
    assert "modes.png" in answer.out
    assert (folder / "modes.png").read_bytes().startswith(b"\x89PNG")


def test_a_measured_thickness_need_not_be_even(cli, folder, clarinet):
    """One corner of the tip is a few µm thicker: little changes, and no mode is lost."""
    text = _clarinet().replace(
        "  # thickness_offset: 10 um",
        "  thickness_map: {x: [2 mm, 20 mm], y: [-5 mm, 0 mm, 6 mm], "
        "deviation: [[3 um, 0 um, -1 um], [-2 um, 0 um, 2 um]]}",
    )
    (folder / "mine.yaml").write_text(text)
    answer = cli("modes", "mine.yaml", "--json", *FAST, "--pictures", "modes.png")
    assert answer.status == 0, answer.err
    assert (folder / "modes.png").read_bytes().startswith(b"\x89PNG")
    uneven, even = answer.json["modes"], clarinet["modes"]
    assert len(uneven) == len(even)
    kinds = {mode["name"]: (mode["class"], mode["symmetry"]) for mode in even}
    assert kinds == {mode["name"]: (mode["class"], mode["symmetry"]) for mode in uneven}
    changes = np.array([hz(answer.json)[name] / hz(clarinet)[name] - 1 for name in kinds])
    assert 1e-4 < np.abs(changes).max() < 5e-3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("tenor",), "nor a shipped reed of that name; "),
        (("clarinett",), "did you mean clarinet? shipped are alto-saxophone, bass-clarinet, clar"),
        (("--e-l", "-3 GPa"), "cane.E_L: '-3 GPa' should be greater than 0"),
        (("--e-l", "13"), "cane.E_L: '13' is not a number with a unit; write a modulus such as"),
        (("--e-l", "13 GHz"), "cane.E_L: '13 GHz' is not a modulus"),
        (("--density", "0 kg/m^3"), "cane.density: '0 kg/m^3' should be greater than 0"),
        (("--nu-lt", "9"), "cane: with nu_LT 9, nu_LR 0.22 and nu_TR 0.22 the stiffness is not p"),
        (("--thickness-offset", "-1 mm"), "geometry.thickness_offset: the reed is -926.0 µm thic"),
        (("--temperature", "25 degC"), "conditions: temperature and dryness apply to v"),
        (("--dryness", "0.5"), "conditions: temperature and dryness apply to viscoelas"),
        (("alto-saxophone", "--dryness", "2"), "conditions.dryness: 2.0 should be less than"),
        (("alto-saxophone", "--e-l", "13 GPa"), "cane.E_L: is fixed, but cane.viscoelastic makes"),
        (("--mesh", "finest"), "there is no mesh 'finest'; known are fine, standard, fast, basis"),
        (("--mesh", "basis", "--e-l", "25 GPa"), "cane.E_L: 25000 MPa lies outside the basis, wh"),
        (
            ("--mesh", "basis", "--thickness-offset", "9 um"),
            "geometry.thickness_offset: +9 µm",
        ),
        (("--mesh", "basis", "--pictures", "modes.png"), "a basis has no shapes to draw; use --m"),
        (("--pictures", "nowhere/modes.png"), "there is no folder nowhere"),
        (("--pictures", "modes.pdf"), "pictures are written as PNG"),
    ],
)
def test_mistakes_are_reported_in_one_line(cli, folder, arguments, words):
    answer = cli("modes", *arguments)
    assert answer.status == 2
    assert answer.out == ""
    (line,) = answer.err.strip().splitlines()
    assert line.startswith("acquire: ")
    assert words in line


@pytest.fixture
def coarse_basis(monkeypatch, tmp_path):
    """A basis that is built within seconds."""
    monkeypatch.setenv("REEDBENCH_CACHE", str(tmp_path / "kept"))
    monkeypatch.setattr("fitting.reed_modes.STANDARD", MeshLevel((2, 2, 2), edge_breaks_m=()))
    few = functools.partial(BasisSettings, snapshots=4)
    monkeypatch.setattr("fitting.reed_modes.BasisSettings", few)


@pytest.mark.usefixtures("coarse_basis")
def test_a_basis_answers_at_once_when_it_has_been_built(cli):
    first = cli("modes", "--mesh", "basis", "--json")
    assert first.status == 0, first.err
    assert "computing the reed's modes by finite elements (kept" in first.err
    assert "building" in first.err
    assert "100%" in first.err
    # Whatever cane and offset are asked for.
    options = ("--e-l", "12 GPa", "--density", "480 kg/m^3", "--thickness-offset", "5 um")
    second = cli("modes", "--mesh", "basis", "--json", *options)
    assert second.err == ""
    assert [list(mode) for mode in second.json["modes"]] == [
        ["name", "hz", "class", "symmetry", "similarity"]
    ] * len(second.json["modes"])
    assert hz(second.json)["T1"] > hz(first.json)["T1"]


@pytest.mark.usefixtures("coarse_basis")
def test_the_table_of_a_basis_marks_names_in_doubt(cli):
    options = ("--e-l", "18 GPa", "--g-lt", "0.45 GPa")
    listed = cli("modes", "--mesh", "basis", "--json", *options).json["modes"]
    doubtful = [mode["name"] for mode in listed if mode["similarity"] < 0.5]
    assert 0 < len(doubtful) < len(listed)
    table = cli("modes", "--mesh", "basis", *options).out
    for mode in listed:
        assert (f" {mode['name']}? " in table) == (mode["name"] in doubtful)
        assert (f" {mode['name']} " in table) != (mode["name"] in doubtful)


def test_a_clamp_outside_the_reed_names_file_and_line(cli, folder):
    (folder / "mine.yaml").write_text(_clarinet().replace("to: 61.2 mm", "to: 70 mm"))
    answer = cli("modes", "mine.yaml")
    assert answer.status == 2
    line = next(n for n, text in enumerate(_clarinet().splitlines(), 1) if "  clamp:" in text)
    assert answer.err.startswith(f"acquire: mine.yaml:{line}: geometry.clamp: the clamp, from 38.2")


def _clarinet():
    from protocols.reed import ReedFile

    return ReedFile.from_file("clarinet").text


def test_help_names_every_constant(cli):
    text = cli("modes", "--help").out
    for constant in ("e-l", "e-t", "e-r", "g-lt", "g-lr", "g-tr", "nu-lt", "nu-lr", "nu-tr"):
        assert f"--{constant}" in text
    assert "--density" in text
    assert "--thickness-offset" in text
