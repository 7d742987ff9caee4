"""From a run file to a reed: what `acquire fit` says of a reed whose cane is known."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import acquire
from drivers.simulated.settings import cane_of
from fitting.cane.fit_runs import (
    fit_runs,
    fit_sweep,
    middling_modes,
    mode_shapes,
    model_name,
)
from fitting.cane.reed_fit import fit_components
from fitting.cane.sweep_fit import ReedFit, _place_of
from fitting.errors import FitError
from fitting.forward import PaperModel
from fitting.fringes.pictures import read_pictures
from fitting.reed_place import ReedPlace
from physics.errors import ImpossibleReedError
from physics.reed.cane.viscoelastic import (
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.mode_classification import PAPER_MODES, is_symmetric
from runs.errors import RunFileError
from runs.reader import Run
from studies.recovery import CLAIMED
from tests.threads import ReachedError, count_of_threads, count_threads, two_threads

REED = "R07"
# First and last k of pictures in which T1 has most fringes.
NEAR_T1 = 45, 77


@pytest.fixture(scope="module")
def sweep(fitted):
    return fitted.sweeps[0]


@pytest.fixture(scope="module")
def fitted_whole(made_once, fit_once):
    """Pictures of the whole sensor, as the claims of `studies.recovery` are: every second step."""
    plan = acquire.plan(acquire.load("seriesA").replace({"sweep.stride": 2, "sweep.last": 173}))
    path = made_once("whole.h5", lambda path: acquire.run(plan, path, reed=REED))
    return fit_once([path], method="picture")


@pytest.fixture
def quick_model(model, reed, monkeypatch):
    """Tabulate the finite elements once for all fits of this module."""
    monkeypatch.setattr("fitting.cane.fit_runs.finite_element_model", lambda _: model)


def test_fits_are_computed_on_one_thread(sweep_a, monkeypatch):
    """Threads of small matrices wait for each other: tables of modes took twice as long."""
    monkeypatch.setattr("fitting.cane.fit_runs.finite_element_model", count_threads)
    with two_threads():
        with pytest.raises(ReachedError) as reached:
            fit_runs([sweep_a])
        assert reached.value.args == (1,)
        assert count_of_threads() == 2


# --- The whole way -----------------------------------------------------------------------------


def test_the_claimed_modes_are_named_within_two_pictures_of_the_truth(fitted_whole, true_hz):
    (sweep,) = fitted_whole.sweeps
    assert set(CLAIMED) <= set(sweep.resonances)
    for name, found in sweep.resonances.items():
        if name in true_hz:
            assert abs(1200 * np.log2(found.frequency_hz / true_hz[name])) < 50


def test_resonances_are_pictures_of_the_run(sweep, sweep_a):
    with Run.open(sweep_a) as run:
        driven = {step.index: float(step.read_drive_hz) for step in run}
    hz = [found.frequency_hz for found in sweep.resonances.values()]
    assert hz == sorted(hz)
    for name, found in sweep.resonances.items():
        assert found.name == name
        assert found.frequency_hz == driven[found.step_index]
        assert found.error_cents == pytest.approx(50 / np.sqrt(12), abs=0.05)
        assert found.amplitude_rad > 0.1


def test_the_acoustic_line_is_no_mode(sweep):
    assert all(abs(found.step_index - 78) > 2 for found in sweep.resonances.values())


def test_the_components_are_those_of_the_cane(fitted_whole):
    cane, parameters = cane_of(REED), fitted_whole.parameters
    assert list(parameters.components) == ["e1", "e2", "e3"]
    for name, estimate in parameters.components.items():
        assert 0.02 < estimate.error < 0.6
        assert abs(estimate.value - getattr(cane, name)) < 4 * estimate.error
    assert parameters.physical
    assert fitted_whole.reason == ""


def test_the_moduli_are_those_of_the_cane(fitted):
    cane = viscoelastic_cane(cane_of(REED), Series.A)
    moduli = fitted.parameters.moduli["A"]
    true_mpa = {
        "E1_mpa": cane.young_L.spring_mpa,
        "E2_mpa": cane.young_L.arm_spring_mpa,
        "G1_mpa": cane.shear_LT.spring_mpa,
        "G2_mpa": cane.shear_LT.arm_spring_mpa,
        "E_4kHz_mpa": 1e-6 * storage_modulus_pa(cane.young_L, 4000.0),
        "G_4kHz_mpa": 1e-6 * storage_modulus_pa(cane.shear_LT, 4000.0),
    }
    for name, value in true_mpa.items():
        assert abs(moduli[name].value - value) < 4 * moduli[name].error


def test_the_paper_s_model_fits_the_same_resonances(sweep):
    parameters = fit_components({Series.A: sweep.resonances}, PaperModel())
    assert parameters.model == "paper (Table 9, H4)"
    assert list(parameters.components) == ["e1", "e2", "e3"]
    # Its T3 and X3 are those of a stiffer mesh than the twin's.
    assert parameters.rms_cents < 60


# --- JSON --------------------------------------------------------------------------------------

KEYS = ["modes", "components", "moduli", "rms_cents", "reduced_chi2", "residual_cents"]
KEYS += ["excess_scatter_cents"]
KEYS += ["left_out", "at_limit", "physical", "model", "losses", "reason", "runs"]


def test_json_has_the_documented_keys(fitted, sweep_a):
    answer = json.loads(json.dumps(fitted.to_json(), allow_nan=False))
    assert sorted(answer) == sorted(KEYS)
    for mode in answer["modes"].values():
        assert sorted(mode) == [
            "amplitude_error_nm", "amplitude_nm", "error_cents", "hz", "identified", "method",
            "nm_per_v", "nm_per_v_error", "step_index",
        ]  # fmt: skip
        # The method of the paper knows no errors.
        assert mode["amplitude_error_nm"] is mode["nm_per_v_error"] is None
        assert mode["amplitude_nm"] > 5
    assert all(sorted(e) == ["error", "value"] for e in answer["components"].values())
    assert all(list(answer[key]) == ["A"] for key in ("moduli", "residual_cents", "left_out"))
    # The method of the paper has no loss factors.
    assert answer["losses"] == {}
    names = ["E1_mpa", "E2_mpa", "E_4kHz_mpa", "G1_mpa", "G2_mpa", "G_4kHz_mpa"]
    assert sorted(answer["moduli"]["A"]) == names
    assert set(answer["residual_cents"]["A"]) | set(answer["left_out"]["A"]) == set(answer["modes"])
    (run,) = answer["runs"]
    peak, response = run.pop("peak"), run.pop("response")
    assert peak["nm"] == max(response["peak_nm"])
    assert peak["nm"] > max(mode["amplitude_nm"] for mode in answer["modes"].values()) / 2
    assert {len(values) for values in response.values()} == {87}
    assert run == {
        "path": str(sweep_a), "reed": REED, "series": "A", "modes": answer["modes"],
        "not_sure": {}, "not_identified": {}, "excitation_peaks": [], "place": None,
    }  # fmt: skip


def test_the_place_of_the_reed_is_stated_with_its_errors(sweep):
    place = ReedPlace(1e-4, -2e-4, 3e-3, 4e-3, np.diag(np.square([1e-5, 2e-5, 1e-3, 2e-3])))
    joint = SimpleNamespace(block_amplitudes=SimpleNamespace(place=place))
    assert _place_of(replace(sweep, joint=joint)) == pytest.approx(
        {
            "along_mm": 0.1, "along_error_mm": 0.01, "across_mm": -0.2, "across_error_mm": 0.02,
            "turn_mrad": 3.0, "turn_error_mrad": 1.0,
            "larger_percent": 0.4, "larger_error_percent": 0.2,
        }
    )  # fmt: skip


def test_documented_keys_are_all_there_are(fitted, request):
    text = (request.config.rootpath / "docs/reference/json.md").read_text(encoding="utf-8")
    table = text.split("## `acquire fit`\n")[1].split("\n## ")[0]
    documented = {
        part.split("[")[0].split(".")[0].strip("`")
        for line in table.splitlines()
        if line.startswith("| `")
        for part in line.split("|")[1].strip().split(", ")
    }
    assert documented == set(fitted.to_json())


def test_json_without_parameters_has_the_same_keys(sweep):
    answer = json.loads(json.dumps(ReedFit((sweep,), None, "too few").to_json(), allow_nan=False))
    assert sorted(answer) == sorted(KEYS)
    assert answer["reason"] == "too few"
    assert answer["components"] is None
    assert answer["moduli"] is None


# --- Parts of a sweep --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def around_t1():
    """First and last k around T1 and the light that other modes throw on the reed."""
    return 41, 99


@pytest.mark.slow
def test_a_spoilt_picture_is_not_picked_and_widens_the_error(
    changed, reed, model, around_t1, sweep
):
    k = sweep.resonances["T1"].step_index
    with Run.open(changed(only=around_t1, verdicts={k: "saturated"})) as run:
        found = fit_sweep(run, reed, model).resonances["T1"]
    assert abs(found.step_index - k) == 2
    # A neighbour 50 cents away on one side, 100 on the other.
    assert found.error_cents == pytest.approx(75 / np.sqrt(12), abs=0.05)


def test_a_sweep_away_from_all_modes_is_an_error_not_an_empty_result(changed, reed, model):
    path = changed(only=(33, 49))
    with Run.open(path) as run, pytest.raises(FitError, match=r"no mode of a .* shows in 9"):
        fit_sweep(run, reed, model)


def test_shapes_have_the_symmetry_of_their_names(reed, sweep_a):
    with Run.open(sweep_a) as run:
        pictures = read_pictures(run)
    middling = middling_modes(reed)
    shapes = mode_shapes(reed, pictures, middling)
    assert shapes.shape == (len(pictures.x_m), len(middling))
    assert np.abs(shapes).max(axis=0) == pytest.approx(1, abs=1e-6)
    mirrored = mode_shapes(reed, _mirrored(pictures), middling)
    for name, there, here in zip(middling, mirrored.T, shapes.T, strict=True):
        sign = 1 if is_symmetric(name) else -1
        assert there == pytest.approx(sign * here, abs=1e-5)
    # F1 swings most at the tip.
    f1 = shapes[:, list(middling).index("F1")]
    assert pictures.x_m[np.abs(f1).argmax()] < 2e-3


def _mirrored(pictures):
    return type(pictures)(
        pictures.brightness, pictures.x_m, -pictures.y_m, pictures.step_index, pictures.drive_hz
    )


def test_pictures_are_made_of_the_vamp_s_modes_below_20_khz(reed):
    middling = middling_modes(reed)
    assert tuple(middling)[: len(PAPER_MODES)] == PAPER_MODES
    assert tuple(middling)[len(PAPER_MODES) :] == ("T5", "X4", "X5", "X6")
    assert max(mode.frequency_hz for mode in middling.values()) < 20e3


# --- What is refused ---------------------------------------------------------------------------


def test_two_reeds_are_not_fitted_together(changed, quick_model):
    a = changed("a.h5", only=NEAR_T1)
    b = changed("b.h5", only=NEAR_T1, name="R08", series="B")
    with pytest.raises(
        FitError, match=r"series A and B of one reed.*reed R07 .clarinet., series A.*reed R08"
    ):
        fit_runs([a, b])


def test_one_series_twice_is_not_fitted_together(changed, quick_model):
    a, again = changed("a.h5", only=NEAR_T1), changed("again.h5", only=NEAR_T1)
    with pytest.raises(
        FitError, match=r"again.h5: reed R07 .clarinet., series A.*fit them one by one"
    ):
        fit_runs([a, again])


def test_a_series_that_is_neither_a_nor_b_has_modes_but_no_parameters(changed, quick_model):
    fit = fit_runs([changed(only=NEAR_T1, series="damp")], method="picture")
    assert "T1" in fit.sweeps[0].resonances
    assert fit.parameters is None
    assert "'damp'" in fit.reason


def test_series_b_alone_has_modes_but_no_parameters(changed, quick_model):
    fit = fit_runs([changed(only=NEAR_T1, series="B")], method="picture")
    assert fit.sweeps[0].resonances
    assert fit.parameters is None
    assert "series A" in fit.reason


def test_too_few_modes_give_no_parameters_and_say_so(changed, quick_model, around_t1, sweep):
    inside = [
        name
        for name, found in sweep.resonances.items()
        if around_t1[0] < found.step_index < around_t1[1]
    ]
    fit = fit_runs([changed(only=around_t1)], method="picture")
    assert set(fit.sweeps[0].resonances) == set(inside)
    assert fit.parameters is None
    assert f"{len(inside)} resonances cannot fix 3 components" in fit.reason


def test_cane_that_is_impossible_takes_no_resonance_away(changed, quick_model, monkeypatch):
    def impossible(*_args):
        raise ImpossibleReedError("no such cane")

    monkeypatch.setattr("fitting.cane.fit_runs._parameters", impossible)
    fit = fit_runs([changed(only=NEAR_T1)], method="picture")
    assert fit.sweeps[0].resonances
    assert fit.parameters is None
    assert fit.reason == "no such cane"


def test_an_unknown_forward_model_is_refused():
    with pytest.raises(FitError, match=r"no forward model 'magic'.*fem, paper"):
        model_name("magic")
    assert model_name("paper") == "paper"


def test_a_file_that_is_no_run_is_refused(tmp_path, quick_model):
    path = tmp_path / "no.h5"
    with pytest.raises(RunFileError, match="no such file"):
        fit_runs([path], method="picture")
    path.write_text("not HDF5")
    with pytest.raises(RunFileError, match="HDF5 file"):
        fit_runs([path], method="picture")
