"""One fit of all holograms of a run, on the simulated bench with all its noise."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.simulated.settings import cane_of
from fitting.cane.fit_runs import fit_runs, method_name
from fitting.cane.residual_map import residual_map
from fitting.errors import FitError, FitInputError
from fitting.forward import basis_of, cents_of
from fitting.fringes.start_frequencies import _outweighing, _room_cents, start_frequencies
from fitting.modal.identify import (
    _absorbed,
    _hidden,
    fit_jointly,
    joint_fit_of,
    mac,
    with_smooth_drive,
)
from fitting.modal.refit import fit_same_reed
from fitting.names.naming import SURE, ModeNaming, name_modes, reeds_behind
from fitting.reed_place import reed_place
from physics.plausible.reeds import PlausibleReeds
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.modes import HIGHEST_HZ, ModeClass
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.elastic import named_vibrations
from physics.reed.reduced.vibrations import vibrations
from reports.figures.drawing import png_of
from reports.figures.joint_drawing import mode_sheet
from reports.fit_tables import SHORT_JOINT, parameters_table, remarks, short_resonances_table
from runs.reader import Run
from tests.fixtures.sweeps import REED

# A whole sweep is fitted.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def jointly(sweep_a):
    """What `acquire fit --method joint` makes of the run of series A."""
    return fit_runs([sweep_a], method="joint")


@pytest.fixture(scope="module")
def sweep(jointly):
    return jointly.sweeps[0]


# The modes that the paper measures.
MEASURED = ("F1", "T1", "F2", "T2", "X1", "T3", "F3", "X2", "X3")


def cents_apart(one, other):
    """Of frequencies by name."""
    return {name: float(cents_of(one[name]) - cents_of(other[name])) for name in MEASURED}


def found_hz(sweep):
    return {name: mode.frequency_hz for name, mode in sweep.resonances.items()}


def test_frequencies_are_the_eigenfrequencies(sweep, true_hz):
    """On half the steps and a quarter of the sensor."""
    apart = cents_apart(found_hz(sweep), true_hz)
    assert all(abs(cents) < 5 for cents in apart.values()), apart


def test_every_hologram_is_explained_down_to_its_noise(sweep):
    assert sweep.joint.displacements.reached.all()
    assert np.median(sweep.joint.displacements.misfit) == pytest.approx(1.0, abs=0.1)


def test_displacements_have_the_object_field_that_modes_show(sweep):
    """What is left of the common-mode error is so small that displacements are linear in it."""
    joint = sweep.joint
    shift = joint.modal.common_mode_shift[..., None]
    left = np.linalg.norm(joint.displacements.common_mode.response @ shift, axis=(1, 2))
    assert np.median(left / np.linalg.norm(joint.displacements.amplitude_rad, axis=1)) < 0.03
    # The modes explain all but a thousandth of the vibration; with the first displacements, which
    # have 10 % of common-mode error, all but three thousandths.
    assert joint.modal.discrepancy < 1.2e-3


def test_loss_factors_are_those_of_the_bench(sweep):
    """0.03, and more where the storage modulus grows with frequency: ω moves the spring as well."""
    for name in ("F2", "T2", "T3", "X2", "X3"):
        assert 0.028 < sweep.resonances[name].loss_factor < 0.04


def test_both_loss_factors_of_the_cane_are_those_of_the_bench(jointly):
    losses = jointly.losses["A"]
    for one in (losses.normal, losses.shear):
        assert abs(one.value - 0.03) < 3 * one.error
        assert one.error < 2e-3
    answer = json.loads(json.dumps(jointly.to_json()["losses"]["A"], allow_nan=False))
    assert answer["shear"] == {"value": losses.shear.value, "error": losses.shear.error}
    rows = parameters_table(jointly).rows
    assert [row[0] for row in rows[-2:]] == [
        "loss factor, normal strains, series A", "loss factor, shear, series A"
    ]  # fmt: skip


def test_what_is_said_of_a_mode_is_of_that_mode(jointly, sweep):
    run = json.loads(json.dumps(jointly.to_json(), allow_nan=False))["runs"][0]
    parts = [set(run[key]) for key in ("modes", "not_sure", "not_identified")]
    assert set.union(*parts) == set(sweep.joint.names)
    assert sum(map(len, parts)) == len(sweep.joint.names)
    for name, mode in run["modes"].items():
        found = sweep.resonances[name]
        assert mode["method"] == "joint"
        assert mode["identified"] is True
        assert SURE <= mode["name_probability"] <= 1
        assert mode["hz"] == found.frequency_hz
        assert abs(cents_of(mode["response_hz"]) - cents_of(mode["hz"])) < 150
        assert 0 < mode["participation"] <= 1
        assert 0.5 <= mode["similarity"] <= 1
        assert mode["amplitude_nm"] == found.amplitude_nm
        assert 0 < mode["amplitude_error_nm"] < mode["amplitude_nm"]
        assert (1e-3 * mode["x_mm"], 1e-3 * mode["y_mm"]) == pytest.approx(found.largest_m)
        assert {len(values) for values in mode["residual"].values()} == {
            len(residual_map(sweep.joint, name).value)
        }
    assert max(mode["participation"] for mode in run["modes"].values()) == 1


def test_a_residual_map_lies_on_the_reed(sweep):
    left = residual_map(sweep.joint, "F2")
    assert left.x_m.min() > 0
    assert left.x_m.max() < 38e-3
    # Cells of 2 mm on a reed 6.5 mm wide to either side.
    assert np.abs(left.y_m).max() < 7.5e-3
    # Noise, and a little of what is not explained at the height of a resonance.
    assert 0.5 < np.median(left.value) < 20


def test_the_table_gives_loss_and_what_is_not_identified(sweep):
    table = short_resonances_table(sweep)
    assert tuple(column.key for column in table.columns) == SHORT_JOINT
    for record, found in zip(table.records(), sweep.resonances.values(), strict=True):
        assert (record["hz"], record["mac"]) == (found.frequency_hz, found.similarity)
        assert record["loss_factor"] == (found.loss_factor, found.loss_error)
        assert record["amplitude_nm"] == (found.amplitude_nm, found.amplitude_error_nm)
    lines = " ".join(remarks(sweep))
    assert all(name in lines for name in sweep.not_identified)


def test_the_pole_of_the_cavity_is_reported_and_else_only_what_may_be_of_a_mode(sweep):
    """The simulated cavity rings at 4308.6 Hz; its gain is highest a little below."""
    seen = min(sweep.excitation_peaks, key=lambda each: abs(each.peak.hz - 4308.6))
    assert all(each.next_to_mode for each in sweep.excitation_peaks if each is not seen)
    line = seen.peak
    assert abs(line.hz - 4308.6) < 3.5 * line.error_hz
    assert abs(line.quality - 25) < 3.5 * line.quality_error
    assert line.error_hz < 30
    assert 5 < line.height_db < 13
    assert not seen.suspect
    assert any(f"{line.hz:.1f} ± {line.error_hz:.1f} Hz" in text for text in remarks(sweep))


def test_every_identified_mode_is_drawn(sweep):
    figure = mode_sheet(sweep.joint, sweep.resonances)
    words = " ".join(text.get_text() for text in figure.texts)
    for name, found in sweep.resonances.items():
        assert f"{name}   {found.frequency_hz:.1f} Hz" in words
        assert f"MAC {found.similarity:.2f}" in words
        assert f"{found.amplitude_nm:.1f} ± {found.amplitude_error_nm:.1f} nm" in words
    # Hologram, shape, its scale in nm and residual of each; scales of holograms and residuals.
    assert len(figure.axes) == 4 * len(sweep.resonances) + 2
    scales = [[t.get_text() for t in axes.get_xticklabels()] for axes in figure.axes]
    for found in sweep.resonances.values():
        assert [f"−{found.amplitude_nm:.0f} nm", "0", f"+{found.amplitude_nm:.0f} nm"] in scales
    assert png_of(figure).startswith(b"\x89PNG")


def test_modes_of_another_kind_of_reed_are_not_believed(sweep):
    joint = sweep.joint
    few = replace(joint.displacements, reached=np.arange(len(joint.displacements.reached)) % 3 > 0)
    for modal, displacements, reason in (
        (replace(joint.modal, discrepancy=0.3), joint.displacements, "check that reed"),
        (joint.modal, few, "cannot be explained"),
    ):
        found = refit_of(joint, modal=modal, displacements=displacements)
        assert not found.resonances
        assert not found.not_sure
        assert set(found.not_identified) == set(joint.modal.names)
        assert all(reason in each for each in found.not_identified.values())


def refit_of(joint, **changes):
    """The results of a fit with some of its parts changed."""
    changed = replace(joint, **changes)
    return joint_fit_of(changed, changed.naming)


def test_a_resonance_at_the_first_step_is_not_identified(sweep):
    """A resonance shows by both of its sides."""
    joint, found = sweep.joint, sweep.resonances["F1"]
    for inside in (-0.5, 2.0):
        first_hz = found.frequency_hz * (1 - inside * found.loss_factor)
        drive_hz = np.maximum(joint.block_amplitudes.drive_hz, first_hz)
        cut = refit_of(joint, block_amplitudes=replace(joint.block_amplitudes, drive_hz=drive_hz))
        assert ("F1" in cut.resonances) == (inside > 0)
        assert ("F1" in cut.not_identified) == (inside < 0)
        assert "T1" in cut.resonances


def test_a_mode_that_the_drive_has_absorbed_is_not_identified(sweep):
    """No bench has a peak of 21 dB at a mode; one of 12 dB may be an acoustic resonance."""
    joint, found = sweep.joint, sweep.resonances["T2"]
    ratio = joint.block_amplitudes.drive_hz / found.frequency_hz
    for strength, refused in ((0.5, True), (0.15, False)):
        line = 1 + strength / (1 - ratio**2 + 1j * ratio / 20)
        modal = replace(joint.modal, drive=joint.modal.drive * line)
        changed = refit_of(joint, modal=modal)
        assert ("T2" in changed.resonances) == (not refused)
        assert ("T2" in changed.not_identified) == refused
        assert {*changed.resonances, "T2"} == set(sweep.resonances)
        shown = replace(sweep, resonances=changed.resonances, joint=changed)
        (seen,) = (each for each in shown.excitation_peaks if each.mode.name == "T2")
        assert seen.suspect == refused
        assert seen.peak.hz == pytest.approx(found.frequency_hz, rel=5e-3)


def test_a_mode_that_has_left_its_place_to_a_line_is_not_identified(sweep):
    """Next to a line that has taken all of its resonance, a mode may be found anywhere."""
    joint, found = sweep.joint, sweep.resonances["T2"]
    ratio = joint.block_amplitudes.drive_hz / found.frequency_hz
    line = 1 + 0.5 / (1 - ratio**2 + 1j * ratio / 20)
    own = joint.names.index("T2")
    hz = joint.modal.hz.copy()
    hz[own] *= 2 ** (150 / 1200)
    modal = replace(joint.modal, hz=hz, drive=joint.modal.drive * line)
    assert _absorbed(refit_of(joint, modal=modal)).keys() == {own}
    assert _absorbed(refit_of(joint, modal=replace(modal, drive=joint.modal.drive))) == {}


def test_a_mode_whose_own_holograms_are_left_out_is_not_identified(sweep):
    """Its neighbours do not tell where it is; one outlier does no harm."""
    joint, found = sweep.joint, sweep.resonances["T2"]
    near = np.abs(np.log(joint.block_amplitudes.drive_hz / found.frequency_hz)) < found.loss_factor
    one = np.zeros_like(near)
    one[np.flatnonzero(near)[0]] = True
    for off, refused in ((near, True), (one, False)):
        changed = refit_of(joint, modal=replace(joint.modal, off=joint.modal.off | off))
        assert ("T2" in changed.not_identified) == refused
        assert {*changed.resonances, "T2"} == set(sweep.resonances)


def test_a_mode_that_loses_far_more_than_others_is_not_identified(sweep):
    joint = sweep.joint
    own, loss = joint.names.index("T2"), joint.modal.loss_factor
    usual = joint.modal.loss_over_others(own)
    for factor, refused in ((1.9, False), (2.1, True)):
        changed_loss = np.where(np.arange(len(loss)) == own, factor / usual * loss, loss)
        modal = replace(joint.modal, loss_factor=changed_loss)
        assert modal.loss_over_others(own) == pytest.approx(factor)
        changed = refit_of(joint, modal=modal)
        assert ("T2" in changed.not_identified) == refused
        assert {*changed.resonances, "T2"} == set(sweep.resonances)


def test_a_mode_next_to_a_run_of_outliers_is_not_identified(sweep):
    """Its resonance may be hidden there, also by holograms that no displacement explains."""
    joint, mode_hz = sweep.joint, sweep.resonances["T2"].frequency_hz
    cents = 1200 * np.log2(mode_hz / joint.block_amplitudes.drive_hz)
    for first_cents, lost, refused in ((50, False, True), (100, False, False), (50, True, True)):
        run = (cents > first_cents) & (cents < 165)
        information = joint.displacements.information * np.where(run & lost, 0, 1)[:, None, None]
        displacements = replace(joint.displacements, information=information)
        modal = replace(joint.modal, off=joint.modal.off | run)
        changed = refit_of(joint, modal=modal, displacements=displacements)
        assert ("T2" in changed.not_identified) == refused
        assert {*changed.resonances, "T2"} == set(sweep.resonances)


@pytest.mark.parametrize(("away_cents", "hides"), [(250, True), (350, False)])
def test_a_run_of_outliers_far_from_all_modes_hides_none(away_cents, hides):
    """Two neighbours of a coarse sweep, as far apart as a resonance is wide."""
    drive_hz = 1000.0 * 2 ** (60 * np.arange(60) / 1200)
    off = np.isin(np.arange(60), [30, 31])
    # The second mode is next to the upper one of both.
    mode_hz = np.array([drive_hz[2], drive_hz[31] * 2 ** (away_cents / 1200)])
    coarse = SimpleNamespace(
        block_amplitudes=SimpleNamespace(drive_hz=drive_hz),
        modal=SimpleNamespace(off=off, hz=mode_hz),
    )
    assert list(_hidden(coarse)) == ([1] if hides else [])


def test_where_the_response_is_largest_no_outlier_says(sweep):
    """A hologram in a wrong fringe has the drive that fits it, whatever it is."""
    joint, mode = sweep.joint, sweep.resonances["T2"]
    own = joint.names.index("T2")
    cents = 1200 * np.log2(joint.block_amplitudes.drive_hz / mode.frequency_hz)
    wrong = int(np.argmin(np.abs(cents - 60)))
    outlier = np.arange(len(cents)) == wrong
    modal_rad = joint.modal.modal_rad.copy()
    modal_rad[wrong, own] *= 4
    for off, moved in ((joint.modal.off | outlier, False), (joint.modal.off, True)):
        changed = refit_of(joint, modal=replace(joint.modal, modal_rad=modal_rad, off=off))
        found = changed.resonances["T2"]
        away = 1200 * np.log2(found.response_hz / mode.response_hz)
        assert (abs(away) > 20) == moved


def test_a_mode_above_the_last_step_is_not_identified(sweep):
    """F4 of this reed is 60 cents above it; the fit finds something at 17.1 kHz."""
    last_hz = sweep.joint.block_amplitudes.drive_hz[-1]
    beyond = [name for name, hz in found_of_fit(sweep) if hz > last_hz]
    assert beyond
    assert set(beyond) <= set(sweep.not_identified)


def found_of_fit(sweep):
    return zip(sweep.joint.names, sweep.joint.modal.hz.tolist(), strict=True)


def test_a_sweep_that_begins_above_f1_states_no_wrong_mode(changed, reed, model, true_hz):
    """Its displacements have no hologram of small amplitude to start from."""
    law = CaneLaw(reed.cane, viscoelastic_cane(cane_of(REED), Series.A))
    # Lateral modes are no modes of the forward model.
    lateral_hz = {
        mode.name: mode.frequency_hz
        for mode in named_vibrations(vibrations(reed, State(law, air=reed.air), HIGHEST_HZ))
        if mode.klass is ModeClass.LATERAL
    }
    first = int(np.ceil(cents_of(true_hz["F1"]) + 350) // 25) + 1
    with Run.open(changed(only=(first, 173))) as run:
        found = fit_jointly(run, reed, model)
    assert "F1" not in found.resonances
    for name, mode in found.resonances.items():
        away = abs(float(cents_of(mode.frequency_hz) - cents_of((true_hz | lateral_hz)[name])))
        assert away < max(5 * mode.error_cents, 8), name


def test_labels_that_are_exchanged_are_put_right(sweep, reed):
    """Names come from frequencies and shapes, not from the shapes that the fit started from."""
    joint, exchanged = sweep.joint, {"X1": "L1", "L1": "X1", "T3": "F3", "F3": "T3"}
    labels = tuple(exchanged.get(name, name) for name in joint.modal.names)
    blocks, modal = joint.block_amplitudes, replace(joint.modal, names=labels)
    index = [m for m, name in enumerate(joint.names) if name in sweep.resonances]
    places_m = blocks.x_m, blocks.y_m
    reeds = PlausibleReeds.of(reed, Series.A)
    asked = joint.basis, places_m, blocks.drive_hz, np.array(index)
    naming = name_modes(reeds_behind(modal, *asked, reeds), labels, reeds)
    found = refit_of(joint, modal=modal, naming=naming)
    assert {name: each.frequency_hz for name, each in found.resonances.items()} == found_hz(sweep)


def test_a_mode_whose_name_is_not_sure_is_shown_but_used_by_no_name(jointly, sweep):
    label = sweep.joint.modal.names[sweep.joint.names.index("X1")]
    unsure = ModeNaming("X1", 0.6, (("X1", 0.6), ("L1", 0.4)), 0.0, 0.0)
    joint = refit_of(sweep.joint, naming={**sweep.joint.naming, label: unsure})
    assert set(sweep.resonances) - set(joint.resonances) == {"X1"}
    assert list(joint.not_sure) == ["X1?"]
    found = replace(sweep, resonances=joint.resonances, not_sure=joint.not_sure, joint=joint)
    assert list(found.measured).index("X1?") == list(sweep.resonances).index("X1")
    run = replace(jointly, sweeps=(found,)).to_json()["runs"][0]
    assert "X1" not in run["modes"]
    entry = json.loads(json.dumps(run["not_sure"]["X1?"]))
    assert entry["candidates"] == {"X1": 0.6, "L1": 0.4}
    assert (entry["identified"], entry["name_probability"]) == (False, 0.6)
    assert entry["hz"] == sweep.resonances["X1"].frequency_hz
    rows = {row["mode"]: row for row in short_resonances_table(found).records()}
    assert rows["X1?"]["name"] == "X1 60%, L1 40%"
    assert rows["F1"]["name"] == ""
    assert "name" not in short_resonances_table(sweep).records()[0]
    assert len(mode_sheet(joint, found.measured).axes) == 4 * len(sweep.resonances) + 2


def test_a_mode_outweighs_others_at_its_peak_response():
    weight = np.array([[1, 0, 2], [3, 1, 2], [1, 2, 1], [1, 4, 5], [0, 1, 6.0]])
    assert _outweighing(weight, ("F1", "T1", "F2")) == {"F1": [1], "T1": [], "F2": []}


def test_a_mode_may_move_up_to_the_next_of_its_symmetry():
    cents = {"F1": 600.0, "F2": 2100.0, "T2": 2400.0, "T1": 1550.0}
    assert _room_cents("F1", cents) == 300
    assert _room_cents("F2", cents) == pytest.approx(120)
    assert _room_cents("T1", cents) == 300
    assert _room_cents("F2", {"F2": 2100.0, "T2": 2150.0}) == 80


def test_a_sweep_between_modes_says_that_there_is_none(sweep, reed, model):
    joint = sweep.joint
    below = replace(joint.block_amplitudes, drive_hz=joint.block_amplitudes.drive_hz / 40)
    with pytest.raises(FitError, match="no mode of this kind of reed"):
        start_frequencies(below, joint.basis, joint.displacements, reed, model, Series.A)


def test_picks_that_speak_for_no_possible_cane_do_no_harm(sweep_a, sweep, true_hz, monkeypatch):
    """Of a shear modulus below zero: modes are sought where the mean cane has them."""
    monkeypatch.setattr(
        "fitting.fringes.start_frequencies.likely_components", lambda *_: Components(e1=-8.0)
    )
    other = fit_runs([sweep_a], method="joint").sweeps[0]
    apart = cents_apart(found_hz(other), true_hz)
    assert all(abs(cents) < 5 for cents in apart.values()), apart
    same = cents_apart(found_hz(other), found_hz(sweep))
    # Half the steps leave two frequencies of F2, near an acoustic resonance
    # (docs/explanation/fit.md).
    del same["F2"]
    assert all(abs(cents) < 1 for cents in same.values()), same


def test_another_sweep_adds_nothing_to_what_is_known_of_the_drive(sweep_a, sweep, true_hz):
    """Fits go back and forth between sweeps: what one knows of the drive must not count twice."""
    with Run.open(sweep_a) as run:
        again = fit_same_reed(run, sweep.joint, basis_of(run.reed_file()))
    known = [form.log_probability for form in sweep.joint.modal.drive_forms]
    assert [form.log_probability for form in again.modal.drive_forms] == known
    found = {name: mode.frequency_hz for name, mode in again.resonances.items()}
    apart = cents_apart(found, true_hz)
    assert all(abs(cents) < 5 for cents in apart.values()), apart


def test_a_sweep_is_fitted_from_another_in_which_the_reed_lay_elsewhere(
    sweep_a, sweep, true_hz, monkeypatch
):
    """Each run measures where its reed lies, so that it has other blocks, and not as many."""

    def elsewhere(run, steps):
        found = reed_place(run, steps)
        return replace(found, along_m=found.along_m + 0.2e-3, across_m=found.across_m - 0.1e-3)

    monkeypatch.setattr("fitting.holograms.block_amplitudes.reed_place", elsewhere)
    with Run.open(sweep_a) as run:
        again = fit_same_reed(run, sweep.joint, basis_of(run.reed_file()))
    before, now = (each.block_amplitudes.x_m for each in (sweep.joint, again))
    assert before.shape != now.shape
    assert again.basis.functions.shape == (len(now), sweep.joint.basis.functions.shape[1])
    found = {name: mode.frequency_hz for name, mode in again.resonances.items()}
    apart = cents_apart(found, true_hz)
    assert all(abs(cents) < 5 for cents in apart.values()), apart


def test_equal_shapes_have_a_mac_of_1():
    shape = np.array([1.0, -2.0, 3.0])
    assert mac(shape, -3 * shape) == pytest.approx(1)
    assert mac(shape, np.array([2.0, 1.0, 0.0])) == pytest.approx(0)


def test_there_are_two_methods():
    assert method_name("joint") == "joint"
    with pytest.raises(FitInputError, match="choose one of picture, joint"):
        method_name("eye")


def test_holograms_that_are_off_are_expected_with_the_drive_of_the_others():
    hz = np.geomspace(1000, 4000, 21)
    drive = np.exp(0.3 * np.log(hz)) * np.exp(1j * np.arange(21))
    amplitude = drive[:, None] * np.array([1.0, 2j])
    off = np.isin(np.arange(21), np.arange(8, 15))
    # The drive follows displacements in a wrong fringe, and the model follows the drive.
    drive[off] *= 0.1
    modal = SimpleNamespace(
        drive=drive, amplitude_rad=drive[:, None] * np.array([1.0, 2j]), off=off
    )
    assert with_smooth_drive(modal, hz) == pytest.approx(amplitude)
