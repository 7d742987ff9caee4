"""Modes that a rough fit has put elsewhere are put where the reed has them."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.cane.fit_runs import fit_runs
from fitting.forward import cents_of
from fitting.modal.fit import fit_roughly
from fitting.modal.identify import _with_modes_in_place
from fitting.names.naming import reeds_behind
from fitting.names.places import places_of_modes
from physics.plausible.reeds import PlausibleReeds
from physics.reed.cane.viscoelastic import Series

# A whole sweep is fitted.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def joint(sweep_a):
    return fit_runs([sweep_a], method="joint").sweeps[0].joint


@pytest.fixture(scope="module")
def reeds(reed):
    return PlausibleReeds.of(reed, Series.A)


def rough_fit(joint, **start_hz):
    """The sweep with a rough fit that starts from other frequencies."""
    starts = dict(zip(joint.modal.names, joint.modal.hz.tolist(), strict=True)) | start_hz
    blocks = joint.block_amplitudes
    given = joint.displacements, joint.basis, blocks.drive_hz, blocks.volts
    modal = fit_roughly(*given, starts)
    return replace(joint, modal=modal, start_hz=starts)


def off_cents(sweep, true_hz, name):
    fitted = dict(zip(sweep.modal.names, sweep.modal.hz, strict=True))
    return abs(cents_of(fitted[name]) - cents_of(true_hz[name]))


@pytest.mark.parametrize("name", ["F2", "X2", "X3"])
def test_the_reed_has_a_mode_that_was_not_measured_where_it_is(joint, reeds, true_hz, name):
    index = [m for m, own in enumerate(joint.modal.names) if own != name]
    blocks = joint.block_amplitudes
    points_m = blocks.x_m, blocks.y_m
    asked = joint.basis, points_m, blocks.drive_hz, np.array(index)
    place = places_of_modes(reeds_behind(joint.modal, *asked, reeds))[name]
    # A reed of the population: its modes are where the model has them.
    assert abs(np.log(place.hz / true_hz[name])) < 4 * place.error
    assert place.error < 0.02


def with_x3_on_x2(joint, discrepancy):
    """The fit as if X3 was found on the resonance of X2, and something was left unexplained."""
    names = joint.modal.names
    hz = np.where(np.array(names) == "X3", joint.modal.hz[names.index("X2")], joint.modal.hz)
    return replace(joint, modal=replace(joint.modal, hz=hz, discrepancy=discrepancy))


def test_a_mode_that_sits_on_the_resonance_of_another_is_put_in_its_place(joint, reeds, true_hz):
    misplaced = with_x3_on_x2(joint, 3 * joint.modal.discrepancy)
    assert off_cents(misplaced, true_hz, "X3") > 60
    found = _with_modes_in_place(misplaced, reeds)
    assert found.modal.discrepancy < misplaced.modal.discrepancy
    # The start is where the reed has it.
    assert found.start_hz["X3"] == pytest.approx(true_hz["X3"], rel=0.02)
    for name in ("X2", "X3", "F3", "T3"):
        assert off_cents(found, true_hz, name) < 5


def test_a_fit_that_explains_more_is_kept(joint, reeds):
    misplaced = with_x3_on_x2(joint, 0.0)
    assert _with_modes_in_place(misplaced, reeds) is misplaced


def test_modes_that_are_in_their_places_are_left_there(joint, reeds):
    sweep = rough_fit(joint)
    assert _with_modes_in_place(sweep, reeds) is sweep
