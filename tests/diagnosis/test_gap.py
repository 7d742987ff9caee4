"""The gap between run and twin: found where it was planted, and nowhere else."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.reed_file import ReedFile
from diagnosis.gap import MESH_CENTS, ShiftedModel, diagnose
from diagnosis.tables import closing_words, gap_table
from drivers.simulated.twin import cane_of
from fitting.errors import FitError
from fitting.fit import ReedFit, SweepFit
from fitting.forward import PaperModel, finite_element_model, hz_of, viscoelastic_cents
from fitting.picking import Resonance
from fitting.reedfit import fit_components
from physics.effects.air_load import air_load_cents
from physics.reed.cache import reduced_reed
from physics.reed.response import elastic_modes
from physics.reed.viscoelastic import Series, viscoelastic_cane

KIND = ReedFile.from_file()


@pytest.fixture(scope="module")
def reed():
    return reduced_reed()


@pytest.fixture(scope="module")
def model():
    """The paper's formula: what is found does not depend on the model, and it is fast."""
    return PaperModel()


@pytest.fixture(autouse=True)
def _one_model(reed, model, monkeypatch):
    monkeypatch.setattr("diagnosis.gap.basis_of", lambda kind, announce=None: reed)
    monkeypatch.setattr("diagnosis.gap.finite_element_model", lambda _: model)


@pytest.fixture(scope="module")
def air_cents(reed, model):
    """Shift of every mode of the model under the air at its nominal density."""
    shapes = elastic_modes(reed, 13.5e9, 1.0e9)
    return np.array([air_load_cents(reed, shapes[name]) for name in model.modes])


def measured(model, cane, error_cents=0.5, noise_cents=0.0, seed=0):
    """What `acquire fit` would say of series A and B of a reed that obeys a model."""
    rng, sweeps, found = np.random.default_rng(seed), [], {}
    for series in Series:
        cents = viscoelastic_cents(model, viscoelastic_cane(cane, series), series)
        cents = cents + noise_cents * rng.standard_normal(len(cents))
        found[series] = {
            name: Resonance(name, float(hz_of(at)), error_cents, 1, 5.0)
            for name, at in zip(model.modes, cents, strict=True)
        }
        path = Path(f"{series}.h5")
        sweeps.append(SweepFit(path, "planted", str(series), KIND, found[series], None, (), None))
    return ReedFit(tuple(sweeps), fit_components(found, model))


@pytest.fixture(scope="module")
def in_air(model, air_cents):
    """A reed in air, measured so well that what the cane cannot mimic of it shows."""
    return measured(ShiftedModel(model, air_cents, "air"), cane_of("gap-1"))


@pytest.fixture(scope="module")
def diagnosis(reed, model, in_air):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("diagnosis.gap.basis_of", lambda kind, announce=None: reed)
        patch.setattr("diagnosis.gap.finite_element_model", lambda _: model)
        return diagnose(in_air)


# --- A planted effect --------------------------------------------------------------------------


@pytest.mark.parametrize("planted", [1.0, 1.6])
def test_a_planted_effect_is_found_with_its_size_and_closes_the_gap(model, air_cents, planted):
    shifted = ShiftedModel(model, planted * air_cents, "air")
    diagnosis = diagnose(measured(shifted, cane_of("gap-1")))
    assert diagnosis.resolvable
    (trial,) = diagnosis.trials
    assert (trial.effect, trial.stage) == ("air load", "acoustics")
    assert trial.share == pytest.approx(planted, abs=0.02)
    assert trial.rms_before_cents == pytest.approx(diagnosis.rms_cents)
    assert trial.rms_after_cents < 0.2
    assert trial.kappa == pytest.approx(1)


def test_a_planted_effect_is_found_with_finite_elements(reed, air_cents, monkeypatch):
    elements = finite_element_model(reed)
    monkeypatch.setattr("diagnosis.gap.finite_element_model", lambda _: elements)
    shifted = ShiftedModel(elements, air_cents, "air")
    (trial,) = diagnose(measured(shifted, cane_of("gap-1"))).trials
    assert trial.share == pytest.approx(1, abs=0.02)
    assert trial.kappa == pytest.approx(1)


def test_an_effect_with_the_wrong_sign_is_given_no_share(model, air_cents):
    shifted = ShiftedModel(model, -air_cents, "buoyancy")
    (trial,) = diagnose(measured(shifted, cane_of("gap-1"))).trials
    assert trial.share < 0.01
    assert trial.kappa == pytest.approx(0, abs=0.01)
    assert trial.rms_after_cents <= trial.rms_before_cents


def test_cells_are_worst_first(diagnosis):
    ratios = [abs(cell.gap_cents) / cell.floor_cents for cell in diagnosis.cells]
    assert ratios == sorted(ratios, reverse=True)
    assert {cell.series for cell in diagnosis.cells} == {"A", "B"}
    for cell in diagnosis.cells:
        assert cell.floor_cents == pytest.approx(np.hypot(0.5, MESH_CENTS))
    rms = np.sqrt(np.mean([cell.gap_cents**2 for cell in diagnosis.cells]))
    assert diagnosis.rms_cents == pytest.approx(rms)


# --- No effect ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_reed_like_the_twin_has_no_gap_above_the_floor(model, seed):
    fit = measured(model, cane_of(f"gap-{seed}"), 25 / np.sqrt(12), 25 / np.sqrt(12), seed)
    diagnosis = diagnose(fit)
    assert not diagnosis.resolvable
    assert diagnosis.rms_cents < diagnosis.floor_cents
    assert np.isnan(diagnosis.trials[0].kappa)
    assert diagnosis.trials[0].rms_after_cents <= diagnosis.trials[0].rms_before_cents
    assert any("not resolvable" in line for line in closing_words(diagnosis))


def test_an_exact_twin_needs_no_effect(model):
    (trial,) = diagnose(measured(model, cane_of("gap-3"))).trials
    assert trial.share < 0.01
    assert trial.rms_after_cents < 0.1


def test_share_zero_is_the_nominal_model_to_the_last_bit(model, air_cents):
    nominal = ShiftedModel(model, 0.0 * air_cents, "none")
    for E, G in ((8e9, 0.6e9), (13.5e9, 1.0e9), (18e9, 1.4e9)):
        moduli = np.full(11, E), np.full(11, G)
        assert np.array_equal(nominal.elastic_cents(*moduli), model.elastic_cents(*moduli))
        assert np.array_equal(nominal.likeness(*moduli), model.likeness(*moduli))
    assert (nominal.modes, nominal.iterations) == (model.modes, model.iterations)


def test_a_shifted_model_shifts_mode_by_mode():
    shift = np.arange(11.0)
    moduli = np.full(11, 13.5e9), np.full(11, 1.0e9)
    shifted = ShiftedModel(PaperModel(), shift, "shifted").elastic_cents(*moduli)
    assert shifted - PaperModel().elastic_cents(*moduli) == pytest.approx(shift)


# --- What it says ------------------------------------------------------------------------------


def test_without_parameters_there_is_nothing_to_compare(in_air):
    with pytest.raises(FitError, match="nothing to compare the twin with: too few"):
        diagnose(replace(in_air, parameters=None, reason="too few"))


def test_json_is_json(diagnosis):
    unresolved = replace(diagnosis, trials=(replace(diagnosis.trials[0], kappa=float("nan")),))
    for told in (diagnosis, unresolved):
        answer = json.loads(json.dumps(told.to_json(), allow_nan=False))
        assert sorted(answer) == ["cells", "floor_cents", "resolvable", "rms_cents", "trials"]
        assert sorted(answer["cells"][0]) == ["floor_cents", "gap_cents", "mode", "series"]
        trial = ["effect", "kappa", "rms_after_cents", "rms_before_cents", "share", "stage"]
        assert sorted(answer["trials"][0]) == trial
    assert answer["trials"][0]["kappa"] is None


def test_the_table_names_every_cell(diagnosis):
    assert gap_table(diagnosis).row_count == len(diagnosis.cells)
    words = closing_words(diagnosis)
    assert words[-1] == "closing a gap does not prove its cause"
    assert any("air load (acoustics) × 1.0" in line and "100%" in line for line in words)
