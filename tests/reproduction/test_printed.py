"""The project's copy of the printed numbers against the transcript, the text and itself."""

import re
from pathlib import Path

import pytest

from fitting.paper import constants as paper
from fitting.paper.printed import TABLE_3_CONSTANTS, Printed
from fitting.statistics import synthetic
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import Series, h4_matrix
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduction.metamodel import (
    EXPONENT_E_L,
    EXPONENT_G_LT,
    REFERENCE_HZ,
)
from physics.reed.reduction.sensitivity import CONSTANTS, field_of

PAPER = Path(__file__).parents[3] / "shared" / "paper"


@pytest.fixture(scope="module")
def latex():
    files = sorted(PAPER.glob("000_*.txt"))
    if not files:
        pytest.skip("the paper is not next to this checkout")
    return files[0].read_text()


def plain(value):
    """Lists for tuples, everywhere: as a YAML file has it."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items() if part is not None}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value


def test_the_copy_is_the_transcript(numbers, tables):
    ours = numbers.model_dump()
    for key, theirs in tables.items():
        if key == "hypotheses":
            theirs = {
                name: {**row, "other": int(row["other"].rpartition(" ")[2])}
                for name, row in theirs.items()
            }
        assert plain(ours[key]) == plain(theirs), key


def test_every_further_number_is_in_the_text(numbers, latex):
    """Numbers as the text writes them: without thousands marks, words for a few."""
    written = set(re.findall(r"\d+\.?\d*", latex.replace("{,}", "")))
    known = {float(number) for number in written}
    # Two and ten to the seventh are written otherwise; rows and columns of figures are words.
    known |= {1e7}
    for value in numbers.text.values():
        assert float(value) in known, value
    for part in (numbers.notes_hz, numbers.lord, numbers.correlations_with_F1.values()):
        assert {float(value) for value in part} <= known
    for loadings in numbers.residual_loadings:
        assert {abs(value) for value in loadings.values()} <= known
    for by_series in numbers.storage_moduli_mpa.values():
        assert {value for pair in by_series.values() for value in pair} <= known


def test_places_in_figure_2_are_in_its_caption(numbers, latex):
    caption = latex[latex.index("Typical holographic patterns of series A") :][:1600]
    places = {"F1": "1st row, 19th", "T1": "3rd row, 10th", "F2": "4th row, 7th"}
    places |= {"T2": "4th row, penultimate", "X1": "5th row, 5th"}
    ordinals = {"1st": 1, "3rd": 3, "4th": 4, "5th": 5, "7th": 7, "10th": 10, "19th": 19}
    for mode, words in places.items():
        assert f"${mode}$ ({words} picture)" in " ".join(caption.split()).replace("$\n", "$ ")
        row, place = (word.split()[0] for word in words.split(", "))
        assert numbers.figure_2[mode] == (ordinals[row], ordinals.get(place, 25))
    assert "6th row, 4th and 5th" in " ".join(caption.split())
    assert "3rd line, 21th picture" in " ".join(caption.split())


def test_the_software_uses_the_same_numbers(numbers):
    for name in PAPER_MODES:
        assert numbers.metamodel.modes[name].a == paper.TABLE_9[name]
        both = numbers.observed_resonances[name]
        assert tuple(both[series].mean_hz for series in Series) == paper.MEAN_HZ[name]
    assert numbers.h4.a_m0_adjustment_cents == paper.H4_ADJUSTMENT_CENTS
    assert numbers.hypotheses["H4"].rmsd_cents == paper.H4_MISFIT_CENTS
    for name, counts in synthetic.IDENTIFIED.items():
        both = numbers.observed_resonances[name]
        assert tuple(both[series].identified for series in Series) == counts
    assert numbers.metamodel.reference_hz == REFERENCE_HZ
    assert numbers.metamodel.exponent_EL == EXPONENT_E_L
    assert numbers.metamodel.exponent_GLT == EXPONENT_G_LT
    h4, M = numbers.h4, h4_matrix(Series.A)
    assert [M[0, 0], M[0, 2], M[1, 0], M[2, 0]] == pytest.approx([h4.d10, h4.d12, h4.d20, h4.d30])
    assert [M[3, 1], M[5, 0]] == pytest.approx([h4.d41, h4.d60])


def test_constants_are_those_of_the_reference_material(numbers):
    assert tuple(TABLE_3_CONSTANTS.values()) == CONSTANTS
    cane, material = Cane(), numbers.reference_material
    for constant in CONSTANTS:
        factor = 1 if constant.startswith("nu") else 1e6
        assert getattr(cane, field_of(constant)) == factor * getattr(material, constant)
    assert cane.density_kg_m3 == material.density_kg_m3


def test_a_number_too_many_is_refused(numbers):
    with pytest.raises(ValueError, match="extra"):
        Printed.model_validate({**numbers.model_dump(), "extra": 1})
