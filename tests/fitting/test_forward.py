"""From moduli to frequencies: the paper's formula and tables, and the finite elements."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulated.settings import cane_of
from fitting.forward import (
    PaperModel,
    cents_of,
    finite_element_model,
    hz_of,
    name_similarity,
    viscoelastic_cents,
)
from fitting.paper import constants as paper
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import viscoelastic_mode
from physics.reed.reduction.metamodel import (
    EXPONENT_E_L,
    EXPONENT_G_LT,
    REFERENCE_HZ,
)

# Eq. 1 at E_L = 14 GPa, G_LT = 1.1 GPa without adjustments, Hz, and hypothesis H4 at e = 0 against
# the means of Table 1, cents: worked out from the paper's text by another program.
EQ_1_HZ = {
    "F1": 2208,
    "T1": 3582,
    "F2": 5207,
    "T2": 6124,
    "X1": 6863,
    "F3": 9831,
    "T3": 9532,
    "X2": 11136,
    "X3": 11941,
    "T4": 14149,
    "F4": 16480,
}
H4_CENTS = {
    "A": (3, -1, 11, 19, 23, 0, 11, 37, 21, 20, -3),
    "B": (0, 15, -1, 18, 12, 10, 26, -2, -32, 13, 2),
}
H4_RMS_CENTS = {"A": 17.6, "B": 15.5}
MIDDLING_PA = np.full(11, 13.5e9), np.full(11, 1.0e9)


def only(mode, value, default):
    """One value for one mode, another for all others."""
    return np.where(np.array(PAPER_MODES) == mode, value, default)


# --- Cents -------------------------------------------------------------------------------------


@given(st.floats(20, 20e3))
def test_cents_and_hertz_are_inverse(hz):
    assert hz_of(cents_of(hz)) == pytest.approx(hz, rel=1e-12)


def test_cents_count_from_f6():
    assert cents_of(1396.9) == 0
    assert cents_of(2 * 1396.9) == pytest.approx(1200)
    assert hz_of(25 * 184) == pytest.approx(19911.9, abs=0.1)


# --- The paper's formula -----------------------------------------------------------------------


def test_eq_1_of_f1_by_hand():
    # 13 500 MPa and 1000 MPa with the exponents of Table 9.
    E, G = 13_500**-0.66643, 1000**0.7627
    by_hand = 2334.56 - 1165877 * E + 0.2763 * G - 21.99 * E * G + 145883795 * E**2
    by_hand += -0.000324 * G**2 - 26.27
    assert PaperModel().elastic_cents(*MIDDLING_PA)[0] == pytest.approx(by_hand, abs=1e-9)


def test_eq_1_at_the_reference_material():
    cents = PaperModel().elastic_cents(np.full(11, 14e9), np.full(11, 1.1e9))
    without = cents - [paper.H4_ADJUSTMENT_CENTS[name] for name in PAPER_MODES]
    for name, hz in zip(PAPER_MODES, hz_of(without), strict=True):
        assert hz == pytest.approx(EQ_1_HZ[name], abs=0.6)


def test_every_mode_has_moduli_of_its_own():
    softer = PaperModel().elastic_cents(only("F2", 10e9, 13.5e9), np.full(11, 1.0e9))
    moved = softer != PaperModel().elastic_cents(*MIDDLING_PA)
    assert [name for name, m in zip(PAPER_MODES, moved, strict=True) if m] == ["F2"]


def test_numbers_are_those_of_the_paper(tables):
    printed = tables["metamodel"]["modes"]
    assert {name: tuple(row["a"]) for name, row in printed.items()} == paper.TABLE_9
    assert tables["h4"]["a_m0_adjustment_cents"] == paper.H4_ADJUSTMENT_CENTS
    assert tables["metamodel"]["exponent_EL"] == EXPONENT_E_L
    assert tables["metamodel"]["exponent_GLT"] == EXPONENT_G_LT
    assert tables["metamodel"]["reference_hz"] == REFERENCE_HZ
    assert tables["hypotheses"]["H4"]["rmsd_cents"] == paper.H4_MISFIT_CENTS
    observed = tables["observed_resonances"]
    for name, means in paper.MEAN_HZ.items():
        assert means == (observed[name]["A"]["mean_hz"], observed[name]["B"]["mean_hz"])


@pytest.mark.parametrize("series", list(Series))
def test_h4_meets_the_means_of_table_1(series):
    cents = viscoelastic_cents(PaperModel(), viscoelastic_cane(Components(), series), series)
    column = list(Series).index(series)
    means = np.array([paper.MEAN_HZ[name][column] for name in PAPER_MODES], dtype=float)
    deviation = cents - cents_of(means)
    assert np.sqrt(np.mean(deviation**2)) == pytest.approx(H4_RMS_CENTS[series], abs=0.1)
    assert deviation == pytest.approx(np.array(H4_CENTS[series]), abs=0.6)


def test_one_iteration_is_within_three_cents_of_many():
    for series in Series:
        cane = viscoelastic_cane(Components(), series)
        once, often = (
            viscoelastic_cents(m, cane, series) for m in (PaperModel(), PaperModel(iterations=12))
        )
        assert np.abs(once - often).max() <= 3.2


# --- Finite elements ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def canes():
    """Canes of the population, with the series that they are in."""
    names = [f"forward-{number}" for number in range(6)]
    return [(viscoelastic_cane(cane_of(n), s), s) for n in names for s in Series]


@pytest.fixture(scope="module")
def deviations(reed, model, canes):
    """Table less reduced basis in cents, for names that the shapes bear out, by mode."""
    answer = {name: [] for name in PAPER_MODES}
    for cane, series in canes:
        cents = viscoelastic_cents(model, cane, series)
        similarity = name_similarity(model, cane, cents)
        for name, at, how_like in zip(PAPER_MODES, cents, similarity, strict=True):
            if how_like >= 0.85:
                mode = viscoelastic_mode(reed, cane, name, float(hz_of(at)))
                answer[name].append(at - float(cents_of(mode.frequency_hz)))
    return answer


@pytest.mark.parametrize("mode", ["F1", "T1", "X1", "F3", "T3", "X2", "X3"])
def test_the_table_follows_the_reduced_basis_to_half_a_cent(deviations, mode):
    assert len(deviations[mode]) >= 8
    assert np.abs(deviations[mode]).max() < 0.5


@pytest.mark.parametrize("mode", ["F2", "T2", "T4", "F4"])
def test_the_table_follows_modes_that_cross_another_but_for_single_reeds(deviations, mode):
    # F2 and T2, T4 and F4 exchange names where they cross; the splines feel the jump nearby.
    assert np.median(np.abs(deviations[mode])) < 0.2
    assert np.abs(deviations[mode]).max() < 10


def test_each_iteration_ends_at_its_own_frequency(model, canes):
    for cane, series in canes:
        cents = viscoelastic_cents(model, cane, series)
        moduli = (
            storage_modulus_pa(zener, hz_of(cents)) for zener in (cane.young_L, cane.shear_LT)
        )
        assert model.elastic_cents(*moduli) == pytest.approx(cents, abs=0.02)


@pytest.mark.parametrize("which", [0, 1])
def test_derivatives_are_smooth_across_the_table(model, which):
    """Away from crossings a stiffer cane sounds higher, and the slope has no kinks."""
    steps = np.linspace(-0.15, 0.15, 61)
    moduli = [np.tile(m[:, None], len(steps)) for m in MIDDLING_PA]
    moduli[which] = moduli[which] * np.exp(steps)
    cents = np.stack([model.elastic_cents(*at) for at in zip(*(m.T for m in moduli), strict=True)])
    for name in ("F1", "T1", "X1", "F3", "T3"):
        slope = np.gradient(cents[:, PAPER_MODES.index(name)], steps)
        # Twice as stiff is at most half an octave higher; what E_L bends, G_LT need not.
        assert slope.min() > 0
        assert slope.max() < 1200 / np.log(2) / 2
        assert np.abs(np.diff(slope)).max() < 0.02 * np.abs(slope).max() + 0.5


def test_moduli_beyond_the_table_are_taken_at_its_edge(model):
    one = np.ones(11)
    assert model.elastic_cents(40e9 * one, one * 1e9) == pytest.approx(
        model.elastic_cents(22e9 * one, one * 1e9)
    )
    assert np.isfinite(model.elastic_cents(-one, 0 * one)).all()


def test_similarity_distinguishes_pure_modes_from_those_that_cross(model):
    pure = dict(zip(PAPER_MODES, model.similarity(*MIDDLING_PA), strict=True))
    assert min(pure[name] for name in ("F1", "T1", "F2", "X1", "T3")) > 0.9
    # T4 meets F4 where the cane is soft along the grain and stiff in shear.
    crossing = np.linspace(1.2e9, 2.1e9, 40)
    similarity = [model.similarity(np.full(11, 10.5e9), np.full(11, G)) for G in crossing]
    assert min(row[PAPER_MODES.index("T4")] for row in similarity) < 0.85
    assert min(row[PAPER_MODES.index("F1")] for row in similarity) > 0.9
    assert (PaperModel().similarity(*MIDDLING_PA) == 1).all()


def test_only_the_modes_asked_for_are_tabulated(reed, model, monkeypatch):
    monkeypatch.setattr("fitting.forward._E_L_PA", np.geomspace(7e9, 22e9, 4))
    monkeypatch.setattr("fitting.forward._G_LT_PA", np.geomspace(0.4e9, 2.1e9, 4))
    few = finite_element_model(reed, ("T1", "F1"))
    assert few.modes == ("T1", "F1")
    cents = few.elastic_cents(np.full(2, 7e9), np.full(2, 0.4e9))
    expected = model.elastic_cents(np.full(11, 7e9), np.full(11, 0.4e9))
    assert cents == pytest.approx(expected[[1, 0]], abs=1e-6)
