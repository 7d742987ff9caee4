"""Reed files: what they say of a reed, and how reeds that cannot be are refused."""

import functools
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting.reed_modes import (
    MESHES,
    changed,
    doubts_marked,
    mesh_level,
    modes_by_basis,
    modes_of,
    modes_to_json,
)
from physics.reed.cane.conditions import at_temperature
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import (
    ClampSide,
    ReedGeometry,
    half_width_m,
    thickness_m,
)
from physics.reed.reduced.reed import BasisSettings
from protocols.errors import ProtocolError
from protocols.protocol import find_protocol
from protocols.reed import ReedFile, shipped_reeds
from protocols.units import format_quantity, parse_quantity
from protocols.yaml_files.strict_yaml import find_description
from tests.protocols.refusals import refusal

PROTOCOLS = Path(__file__).parents[2] / "protocols"

CLARINET = find_description("clarinet", "reed", "reeds").read_text(encoding="utf-8")
ALTO = find_description("alto-saxophone", "reed", "reeds").read_text(encoding="utf-8")
COARSE = MeshLevel(orders=(2, 2, 2), edge_breaks_m=())


# --- What a file says --------------------------------------------------------------------------


def test_the_clarinet_is_the_reed_of_the_paper_to_the_last_bit():
    """Equal to the last bit, so that what is computed of one is found for the other."""
    reed = ReedFile.from_file()
    assert reed.geometry() == ReedGeometry()
    assert repr(reed.geometry()) == repr(ReedGeometry())
    assert reed.cane() == Cane()
    assert repr(reed.cane()) == repr(Cane())
    assert reed.viscoelastic() is None


def test_shipped_reeds_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = shipped_reeds()
    assert {"alto-saxophone", "bass-clarinet", "clarinet"} <= set(shipped)
    assert list(shipped) == sorted(path.stem for path in (PROTOCOLS / "reeds").glob("*.yaml"))
    for name in ("clarinet", "clarinet.yaml", "reeds/clarinet", "protocols/reeds/clarinet.yaml"):
        assert ReedFile.from_file(name) == ReedFile.from_file()
    message = refusal(ReedFile.from_file, "clarinette")
    assert f"did you mean clarinet? shipped are {', '.join(shipped)}" in message


@pytest.mark.parametrize("name", shipped_reeds())
def test_written_content_reads_as_the_same(name):
    original = ReedFile.from_file(name)
    again = ReedFile.from_text(original.replace({}).text)
    assert again == original
    assert again.sha256 == original.sha256
    assert (again.geometry(), again.cane()) == (original.geometry(), original.cane())


@pytest.mark.parametrize("name", ["alto-saxophone", "bass-clarinet"])
def test_larger_reeds_are_larger_and_say_that_they_are_not_measured(name):
    reed, clarinet = ReedFile.from_file(name), ReedGeometry()
    assert "illustrative, not measured" in reed.text
    geometry = reed.geometry()
    outline = geometry.outline
    assert outline.length_m > clarinet.outline.length_m
    assert geometry.vamp_x_m[-1] > clarinet.vamp_x_m[-1]
    x = np.linspace(0.05e-3, outline.length_m, 400)
    widest_mm = 2e3 * half_width_m(outline, x).max()
    # Between the clarinet's 13 mm and the tenor saxophone's 17 to 18 mm.
    assert 15 < widest_mm < 17
    for share in (0.0, 0.5, 0.999):
        assert thickness_m(geometry, x, share * half_width_m(outline, x)).min() > 0


def test_widths_at_tip_and_butt_make_the_taper():
    reed = ReedFile.from_file().replace({"geometry.outline.half_width_at_butt": "6.575 mm"})
    assert reed.geometry().outline.side_taper == 0
    wider = ReedFile.from_file().replace({"geometry.outline.half_width_at_butt": "6 mm"})
    assert half_width_m(wider.geometry().outline, np.array(67.5e-3)) == pytest.approx(6e-3)


def test_clamp_offset_and_map_reach_the_geometry():
    deviation = {
        "x": ["2 mm", "20 mm"],
        "y": ["-5 mm", "0 mm", "5 mm"],
        "deviation": [["3 um", "0 um", "3 um"], ["-5 um", "1 um", "-5 um"]],
    }
    reed = ReedFile.from_file().replace(
        {
            "geometry.clamp": {"from": "40 mm", "to": "60 mm", "inner": "2 mm", "outer": "3 mm"},
            "geometry.thickness_offset": "10 um",
            "geometry.thickness_map": deviation,
        }
    )
    geometry = reed.geometry()
    clamp = geometry.clamp
    assert (clamp.x_m, clamp.y_m, clamp.side) == ((40e-3, 60e-3), (2e-3, 3e-3), ClampSide.BARK)
    side = reed.replace({"geometry.clamp.side": "both"}).geometry().clamp.side
    assert side is ClampSide.BOTH
    drawn = ReedGeometry()
    x, y = np.array([20e-3, 2e-3]), np.array([0.0, -5e-3])
    added = thickness_m(geometry, x, y) - thickness_m(drawn, x, y)
    np.testing.assert_allclose(added, [11e-6, 13e-6], atol=1e-12)


def test_file_that_leaves_out_what_it_may():
    content = yaml.safe_load(CLARINET)
    del content["geometry"]["clamp"]["side"]
    assert ReedFile.from_text(yaml.safe_dump(content)).geometry() == ReedGeometry()


# --- Viscoelastic cane -------------------------------------------------------------------------


def test_viscoelastic_cane_has_the_storage_moduli_of_a_frequency():
    reed = ReedFile.from_file("alto-saxophone").replace(
        {"cane.viscoelastic": {"e1": 1.0, "e2": -0.5, "e3": 0.25, "e4": 2.0}}
    )
    expected = viscoelastic_cane(Components(1.0, -0.5, 0.25, 2.0), Series.A)
    for hz in (1500.0, 9000.0):
        cane = reed.cane(hz)
        assert pytest.approx(float(storage_modulus_pa(expected.young_L, hz))) == cane.E_L_pa
        assert pytest.approx(float(storage_modulus_pa(expected.shear_LT, hz))) == cane.G_LT_pa
        reference = Cane()
        assert replace(cane, E_L_pa=reference.E_L_pa, G_LT_pa=reference.G_LT_pa) == reference


def test_dryness_1_is_series_b_and_temperature_is_applied_after():
    dried = ReedFile.from_file("alto-saxophone").replace({"conditions.dryness": 1})
    series_b = viscoelastic_cane(Components(), Series.B)
    for of_file, of_paper in (
        (dried.viscoelastic().young_L, series_b.young_L),
        (dried.viscoelastic().shear_LT, series_b.shear_LT),
    ):
        assert of_file.spring_mpa == pytest.approx(of_paper.spring_mpa)
        assert of_file.arm_spring_mpa == pytest.approx(of_paper.arm_spring_mpa)
        assert of_file.arm_dashpot_mpa_s == pytest.approx(of_paper.arm_dashpot_mpa_s)
    warm = dried.replace({"conditions.temperature": "308.15 K"})
    assert warm.viscoelastic() == at_temperature(dried.viscoelastic(), 35.0)
    assert warm.cane(4000.0).E_L_pa < dried.cane(4000.0).E_L_pa


def test_fixing_both_moduli_ends_viscoelasticity():
    reed = changed(
        ReedFile.from_file("alto-saxophone"), {"cane.E_L": "13 GPa", "cane.G_LT": "1 GPa"}
    )
    assert reed.viscoelastic() is None
    assert reed.cane() == Cane(E_L_pa=13e9, G_LT_pa=1e9)


def test_what_is_not_asked_stays():
    reed = ReedFile.from_file()
    assert changed(reed, {"cane.E_L": None, "cane.nu_LT": None}) is reed
    other = changed(reed, {"cane.E_L": None, "cane.nu_LT": 0.0})
    assert other.cane() == Cane(nu_LT=0.0)


# --- Reeds that cannot be ----------------------------------------------------------------------

IMPOSSIBLE = {
    # name: (changes, key path and message expected)
    "negative modulus": ({"cane.E_L": "-3 GPa"}, "cane.E_L: '-3 GPa' should be greater than 0"),
    "modulus 0": ({"cane.G_TR": "0 Pa"}, "cane.G_TR: '0 Pa' should be greater than 0"),
    "modulus in Hz": ({"cane.E_L": "13 GHz"}, "cane.E_L: '13 GHz' is not a modulus; write a mod"),
    "modulus without unit": ({"cane.E_L": 14}, "cane.E_L: 14 has no unit"),
    "density 0": ({"cane.density": "0 kg/m^3"}, "cane.density: '0 kg/m^3' should be greater"),
    "areal density": ({"cane.density": "3 kg/m^2"}, "cane.density: '3 kg/m^2' is not a number"),
    "lead": ({"cane.density": "30 g/cm^3"}, "cane.density: '30 g/cm^3' should be less"),
    "not positive definite": (
        {"cane.nu_TR": 1.2},
        "cane: with nu_LT 0.22, nu_LR 0.22 and nu_TR 1.2 the stiffness is not positive definite",
    ),
    "NaN": ({"cane.nu_LT": float("nan")}, "cane.nu_LT: nan should be a finite number"),
    "no moduli": ({"cane.E_L": None}, "cane.E_L: is missing; add it, or give cane.viscoelastic"),
    "moduli twice": ({"cane.viscoelastic": {}}, "cane.E_L: is fixed, but cane.viscoelastic makes"),
    "temperature of fixed moduli": (
        {"conditions.temperature": "25 degC"},
        "conditions: temperature and dryness apply to viscoelastic cane only",
    ),
    "clamp behind the reed": (
        {"geometry.clamp.to": "70 mm"},
        "geometry.clamp: the clamp, from 38.2 to 70 mm, lies outside the reed, which is 67.5 mm",
    ),
    "clamp away from the reed": (
        {"geometry.clamp.outer": "7 mm"},
        "geometry.clamp: the clamp, 2.5 to 7 mm from the axis, lies outside the reed",
    ),
    "clamp backwards": ({"geometry.clamp.to": "38 mm"}, "geometry.clamp: the ends of the clamp"),
    "clamp at the kink": ({"geometry.clamp.from": "35 mm"}, "geometry.clamp: the clamp, 35 to"),
    "clamp on top": ({"geometry.clamp.side": "top"}, "geometry.clamp.side: 'top' should be 'bark'"),
    "negative thickness": (
        {"geometry.vamp.thickness": [["1 mm"] * 8, ["1 mm"] * 8, ["-1 mm"] * 8]},
        "geometry.vamp.thickness[2][0]: '-1 mm' should be greater than 0",
    ),
    "offset too thin": (
        {"geometry.thickness_offset": "-100 um"},
        "geometry.thickness_offset: the reed is -26.0 µm thick at x = 0.00 mm, y = 0.00 mm",
    ),
    "one abscissa short": (
        {"geometry.vamp.x": ["0 mm", "5 mm", "10 mm", "15 mm", "20 mm", "25 mm", "35 mm"]},
        "geometry.vamp.thickness: row 1 has 8 values for 7 abscissae x; give one each",
    ),
    "two lines": ({"geometry.vamp.y": ["0 mm", "4 mm"]}, "geometry.vamp.y[2]: is missing"),
    "heel too thick": ({"geometry.heel.sagitta": "10 mm"}, "geometry: vamp and heel do not meet"),
    "heel too narrow": ({"geometry.heel.radius": "3 mm"}, "geometry: the heel's radius, 3 mm"),
    "corner off the tip": (
        {"geometry.outline.corner_centre": "20 mm"},
        "geometry: a corner of radius 2.5 mm centred 20 mm from the tip does not touch",
    ),
    "one-sided map": (
        {"geometry.thickness_map": {"x": ["0 mm", "9 mm"], "y": ["0 mm", "9 mm"],
                                    "deviation": [["0 m", "0 m"], ["0 m", "1 um"]]}},
        "geometry.thickness_map.y: lies on one side of the axis only; give values of either sign",
    ),
    "map too thin": (
        {"geometry.thickness_map": {"x": ["0 mm", "9 mm"], "y": ["-9 mm", "9 mm"],
                                    "deviation": [["-1 mm", "-1 mm"], ["0 m", "0 m"]]}},
        "geometry.thickness_map: the reed is -926.0 µm thick",
    ),
    "misspelt": ({"cane.densty": "1 kg/m^3"}, "cane.densty: unknown key; did you mean 'density'?"),
}  # fmt: skip


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_impossible_reed_is_refused_in_one_line(case):
    changes, expected = IMPOSSIBLE[case]
    message = refusal(ReedFile.from_file().replace, changes)
    assert message.startswith(f"clarinet (changed): {expected}")


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("to: 61.2 mm", "to: 70 mm", "geometry.clamp"),
        ("density: 520 kg/m^3", "density: 0 kg/m^3", "cane.density"),
        ("nu_TR: 0.22", "nu_TR: 1.22", "cane"),
        ("radius: 17.4 mm", "radius: 5 mm", "geometry"),
    ],
)
def test_refusals_name_file_line_and_key(old, new, key, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(CLARINET.replace(old, new), encoding="utf-8")
    head = key.rsplit(".", 1)[-1]
    starts = [line.strip().startswith(f"{head}:") for line in CLARINET.splitlines()]
    line = starts.index(True) + 1
    assert refusal(ReedFile.from_file, file).startswith(f"{file}:{line}: {key}: ")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"cane.E_L": "13 GPa"}, "cane.E_L: is fixed, but cane.viscoelastic makes it follow"),
        ({"cane.viscoelastic.e1": -3.0, "cane.viscoelastic.e3": 3.0}, "cane.viscoelastic: G2 = "),
        ({"cane.viscoelastic.e1": 7}, "cane.viscoelastic.e1: 7 should be less than or equal to 6"),
        ({"conditions.dryness": 1.5}, "conditions.dryness: 1.5 should be less than or equal to 1"),
        ({"conditions.temperature": "-300 degC"}, "conditions.temperature: '-300 degC' should be"),
        ({"conditions.temperature": "20 mm"}, "conditions.temperature: '20 mm' is not a temperat"),
        ({"conditions.temperature": "2 kdegC"}, "conditions.temperature: '2 kdegC' has the unk"),
    ],
)
def test_impossible_viscoelastic_cane_is_refused(changes, expected):
    message = refusal(ReedFile.from_file("alto-saxophone").replace, changes)
    assert message.startswith(f"alto-saxophone (changed): {expected}")


def test_a_protocol_is_no_reed():
    sweep = find_protocol("seriesA").read_text(encoding="utf-8")
    message = refusal(ReedFile.from_text, sweep, "seriesA.yaml")
    assert "unknown key; known are name, geometry, cane, conditions" in message


def test_meshes_have_names():
    assert mesh_level("standard") is MESHES["standard"]
    message = refusal(mesh_level, "finest")
    assert message == "there is no mesh 'finest'; known are fine, standard, fast, basis"


@given(st.data())
@settings(deadline=None, max_examples=60)
def test_a_damaged_file_is_read_or_refused(data):
    start = data.draw(st.integers(0, len(ALTO)))
    end = data.draw(st.integers(start, min(start + 20, len(ALTO))))
    damage = data.draw(st.text("[]{}:-&*!|>'\"%@`#,?\t\n 0x_.m", max_size=4))
    message = "read"
    try:
        ReedFile.from_text(ALTO[:start] + damage + ALTO[end:])
    except ProtocolError as error:
        message = str(error)
    assert message.isprintable()


LENGTHS = [
    *(f"geometry.outline.{key}" for key in yaml.safe_load(CLARINET)["geometry"]["outline"]),
    *(f"geometry.clamp.{key}" for key in ("from", "to", "inner", "outer")),
    *(f"geometry.heel.{key}" for key in ("radius", "sagitta")),
    "geometry.thickness_offset",
]


@given(st.sampled_from(LENGTHS), st.integers(-(10**5), 10**5))
@settings(deadline=None, max_examples=100)
def test_any_length_makes_a_reed_or_one_line(key, micrometres):
    """Nothing but a `ProtocolError` comes out, no warning of numpy either (they are errors)."""
    message = f"clarinet (changed): {key}"
    try:
        reed = ReedFile.from_file().replace({key: f"{micrometres} um"})
        assert reed.geometry() == reed.replace({}).geometry()
    except ProtocolError as error:
        message = str(error)
    assert message.isprintable()
    assert message.startswith("clarinet (changed): geometry")


# --- Quantities of reeds -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("14 GPa", "Pa", Fraction(14 * 10**9)),
        ("480 MPa", "Pa", Fraction(480 * 10**6)),
        ("520 kg/m^3", "kg/m^3", Fraction(520)),
        ("0.52 g/cm^3", "kg/m^3", Fraction(520)),
        ("-3.5 degC", "degC", Fraction(-7, 2)),
        ("298.15 K", "degC", Fraction(25)),
    ],
)
def test_units_of_cane_are_exact(text, unit, value):
    assert parse_quantity(text, unit) == value
    assert parse_quantity(format_quantity(value, unit), unit) == value


# --- Modes -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fast_modes():
    return {
        name: modes_of(ReedFile.from_file(name), mesh_level("fast")) for name in shipped_reeds()
    }


@pytest.mark.parametrize("name", ["alto-saxophone", "bass-clarinet", "clarinet"])
def test_every_reed_has_the_classes_of_the_paper_in_order(name, fast_modes):
    modes = {mode.name: mode for mode in fast_modes[name]}
    assert len(modes) == len(fast_modes[name])
    for family in (("F1", "F2", "F3", "F4"), ("T1", "T2", "T3", "T4"), ("X1", "X2", "X3")):
        frequencies = [modes[member].frequency_hz for member in family]
        assert frequencies == sorted(frequencies)
    assert {str(mode.klass) for mode in modes.values()} >= {
        "flexural",
        "transversal",
        "generic",
        "lateral",
    }


def test_larger_reeds_are_lower(fast_modes):
    lowest = {name: modes[0] for name, modes in fast_modes.items()}
    assert {mode.name for mode in lowest.values()} == {"F1"}
    assert lowest["bass-clarinet"].frequency_hz < 0.8 * lowest["clarinet"].frequency_hz
    assert lowest["alto-saxophone"].frequency_hz < 0.9 * lowest["clarinet"].frequency_hz


def test_json_has_what_is_documented(fast_modes):
    elastic, viscoelastic = (
        modes_to_json(ReedFile.from_file(name), fast_modes[name])
        for name in ("clarinet", "alto-saxophone")
    )
    for answer in (elastic, viscoelastic):
        assert set(answer) == {"reed", "material", "modes"}
        for mode in answer["modes"]:
            assert list(mode) == ["name", "hz", "class", "symmetry", "similarity"]
    assert elastic["reed"] == "clarinet"
    assert elastic["material"]["E_L_pa"] == 14e9
    assert elastic["material"]["viscoelastic"] is None
    assert viscoelastic["material"]["E_L_pa"] is None
    assert viscoelastic["material"]["viscoelastic"]["young_L"]["spring_mpa"] == 10300


def test_cane_too_soft_to_count_its_modes_is_refused():
    soft = ReedFile.from_file().replace(
        {f"cane.{name}": "1 Pa" for name in ("E_L", "E_T", "E_R", "G_LT", "G_LR", "G_TR")}
    )
    message = refusal(modes_of, soft, COARSE)
    assert message.startswith("clarinet (changed): the reed has over 100 modes below")


# --- Modes by a basis --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def basis_modes(tmp_path_factory):
    """`modes_by_basis` on a coarse mesh, with a cache of its own, and what it has announced."""
    announced = []
    few = functools.partial(BasisSettings, snapshots=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("REEDBENCH_CACHE", str(tmp_path_factory.mktemp("kept")))
        patch.setattr("fitting.reed_modes.STANDARD", COARSE)
        patch.setattr("fitting.reed_modes.BasisSettings", few)
        yield functools.partial(modes_by_basis, announce=announced.append), announced


def cents_from_elements(modes, reed, count):
    """Deviations of the lowest modes from finite elements on the same mesh, by name."""
    solved = {mode.name: mode for mode in modes_of(reed, COARSE)}
    for mode in modes[:count]:
        assert (mode.klass, mode.symmetry) == (solved[mode.name].klass, solved[mode.name].symmetry)
    return [
        1200 * np.log2(mode.frequency_hz / solved[mode.name].frequency_hz) for mode in modes[:count]
    ]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"cane.E_L": "12 GPa", "cane.G_LT": "1 GPa", "cane.nu_LT": 0.25},
        # Of these quadratic elements strains at the surface are rough.
        {"cane.density": "600 kg/m^3", "geometry.thickness_offset": "-5 um"},
        {"cane.density": "400 kg/m^3"},
    ],
    ids=["as it is", "other cane", "heavier and thinner", "lighter"],
)
def test_a_basis_answers_for_a_reed_as_finite_elements_do(changes, basis_modes):
    answer, announced = basis_modes
    original = ReedFile.from_file()
    reed = changed(original, changes)
    modes = answer(reed, original)
    assert np.abs(cents_from_elements(modes, reed, count=10)).max() < 3
    frequencies = [mode.frequency_hz for mode in modes]
    assert frequencies == sorted(frequencies)
    assert frequencies[-1] < 20e3
    # One basis serves them all.
    assert len(announced) <= 1


def test_a_basis_answers_for_viscoelastic_cane(basis_modes):
    answer, announced = basis_modes
    original = ReedFile.from_file("alto-saxophone")
    before = len(announced)
    for changes in ({}, {"conditions.dryness": 0.5, "geometry.thickness_offset": "5 um"}):
        reed = changed(original, changes)
        modes = answer(reed, original)
        assert np.abs(cents_from_elements(modes, reed, count=10)).max() < 3
    assert len(announced) == before + 1


def test_another_cane_in_the_file_is_another_reference(basis_modes):
    answer, announced = basis_modes
    original = ReedFile.from_file().replace({"cane.E_L": "11 GPa", "cane.density": "600 kg/m^3"})
    before = len(announced)
    modes = answer(original, original)
    assert len(announced) == before + 1
    assert np.abs(cents_from_elements(modes, original, count=10)).max() < 3


OUTSIDE = {
    # name: (changes, message expected)
    "stiff": (
        {"cane.E_L": "25 GPa"},
        "cane.E_L: 25000 MPa lies outside the basis, which answers for 7000 to 22000 MPa; use "
        "--mesh fine",
    ),
    "soft": ({"cane.G_LR": "0.5 GPa"}, "cane.G_LR: 500 MPa lies outside the basis"),
    "ratio": (
        {"cane.nu_TR": 0.35},
        "cane.nu_TR: 0.35 lies outside the basis, which answers for 0.14 to 0.3; use --mesh fine",
    ),
    "heavy": (
        {"cane.density": "800 kg/m^3"},
        "cane.density: 800 kg/m^3 lies outside the basis, which answers for 0 to 629.2 kg/m^3",
    ),
    "thick": (
        {"geometry.thickness_offset": "30 um"},
        "geometry.thickness_offset: +30 µm from the reed's file lie outside the basis, which "
        "answers for -7 to 7 µm; use --mesh fine",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", OUTSIDE)
def test_a_reed_outside_the_basis_is_refused_before_anything_is_computed(case, basis_modes):
    answer, announced = basis_modes
    changes, expected = OUTSIDE[case]
    original = ReedFile.from_file()
    before = len(announced)
    message = refusal(answer, changed(original, changes), original)
    assert message.startswith(f"clarinet (changed): {expected}")
    assert len(announced) == before


def test_viscoelastic_cane_that_leaves_the_box_with_frequency_is_refused(basis_modes):
    answer, _ = basis_modes
    original = ReedFile.from_file("alto-saxophone")
    reed = changed(original, {"cane.viscoelastic.e1": 4.5, "cane.viscoelastic.e3": -4.0})
    assert reed.cane().G_LT_pa < 2.1e9
    message = refusal(answer, reed, original)
    assert "cane.viscoelastic: G_LT of 2" in message
    assert " Hz lies outside the basis, which answers for 400 to 2100 MPa; use --m" in message


def test_names_in_doubt_are_marked(fast_modes):
    clear, doubtful = (
        replace(fast_modes["clarinet"][0], similarity=similarity) for similarity in (0.5, 0.49)
    )
    assert [mode.name for mode in doubts_marked([clear, doubtful])] == ["F1", "F1?"]
