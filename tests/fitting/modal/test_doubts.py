"""Reasons why a mode is not identified, by its own numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from fitting.modal.identify import _doubt
from fitting.modal.modal_fit import ModalFit
from fitting.modal.posterior import ResonantDisplacements

FIELDS = dict.fromkeys(ModalFit.__dataclass_fields__)


def modal_fit(hz, loss_factor, off=()):
    count = len(hz)
    given = {
        "hz": np.array(hz, float), "loss_factor": np.array(loss_factor, float),
        "off": np.array(off, bool), "participation": np.ones(count),
        "participation_error": 0.01 * np.ones(count), "error_cents": np.ones(count),
    }  # fmt: skip
    return ModalFit(**{**FIELDS, **given})


@pytest.mark.parametrize(
    ("outliers", "refused"),
    [([], False), ([10], False), ([9, 11], False), ([10, 11], True), ([8, 10, 12], True)],
)
def test_two_neighbours_at_a_resonance_that_are_left_out_were_its_peak(outliers, refused):
    drive_hz = 3000 * 2 ** (np.arange(-10, 11) * 25 / 1200)
    off = np.isin(np.arange(21), outliers)
    modal = modal_fit([3000.0], [0.036], off)
    assert bool(_doubt(modal, 0, SimpleNamespace(drive_hz=drive_hz))) == refused
    downwards = modal_fit([3000.0], [0.036], off[::-1])
    assert downwards.is_left_out(0, drive_hz[::-1]) == refused
    elsewhere = modal_fit([3000.0], [0.036], np.roll(off, 7))
    assert not _doubt(elsewhere, 0, SimpleNamespace(drive_hz=drive_hz))


@pytest.mark.parametrize(("outliers", "refused"), [(2, False), (3, False), (5, True)])
def test_in_small_steps_more_neighbours_are_the_peak(outliers, refused):
    """A quarter of the width, 15.6 cents, is four steps of 5 cents at most."""
    drive_hz = 3000 * 2 ** (np.arange(-50, 51) * 5 / 1200)
    off = np.isin(np.arange(101), 48 + np.arange(outliers))
    modal = modal_fit([3000.0], [0.036], off)
    assert bool(_doubt(modal, 0, SimpleNamespace(drive_hz=drive_hz))) == refused


def test_a_mode_alone_loses_as_much_as_it_does() -> None:
    assert modal_fit([3000.0], [0.2]).loss_over_others(0) == 1


def test_losses_may_grow_with_frequency_as_those_of_a_dashpot_do() -> None:
    hz = np.array([2e3, 3e3, 4.5e3, 6e3, 9e3, 13e3])
    growing = modal_fit(hz, 0.02 * hz / 2e3)
    ratios = [growing.loss_over_others(mode) for mode in range(6)]
    assert ratios == pytest.approx([1] * 6)
    # Beyond that, and of few modes, it is their median.
    steep = modal_fit(hz, 0.02 * (hz / 2e3) ** 3)
    assert steep.loss_over_others(5) > 2
    few = modal_fit(hz[:4], 0.02 * hz[:4] / 2e3)
    assert few.loss_over_others(3) == pytest.approx(2.0)


def test_two_resonances_as_one_stand_out_among_others():
    hz, loss = [2e3, 3e3, 4.5e3, 6e3, 9e3], [0.025, 0.03, 0.026, 0.031, 0.064]
    assert modal_fit(hz, loss).loss_over_others(4) > 2
    assert modal_fit(hz, loss).loss_over_others(2) < 1.1


def test_further_errors_add_to_the_variance_of_logs():
    shapes, none = np.array([[3.0, 0.0], [0.0, 2.0]]), np.zeros((2, 0))
    covariance = np.diag([9.0, 16.0, 25.0, 36.0]) * 1e-8
    resonant = ResonantDisplacements(shapes, np.tile(1e-8 * np.eye(2), (2, 1, 1)), none, none)
    modal = ModalFit(**{**FIELDS, "covariance": covariance, "resonant": resonant})
    found = modal.with_errors(np.diag([16.0, 0.0, 144.0, 28.0, 5.0, 7.0]) * 1e-8)
    cents = 1200 / np.log(2)
    assert found.error_cents == pytest.approx([5e-4 * cents, 4e-4 * cents])
    assert found.loss_error == pytest.approx([13e-4, 8e-4])
    assert np.diag(found.covariance) == pytest.approx([25e-8, 16e-8, 169e-8, 64e-8])
    # Those of displacements are along their shapes.
    assert found.resonant.covariance[0] == pytest.approx(np.diag([46e-8, 1e-8]))
    assert found.resonant.covariance[1] == pytest.approx(np.diag([1e-8, 29e-8]))
