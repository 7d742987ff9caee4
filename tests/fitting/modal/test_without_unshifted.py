"""What is taken off as unshifted light, without fitting a sweep."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import j0

from fitting.modal import refit
from fitting.modal.refit import fit_without_unshifted
from physics.reed.cane.viscoelastic import Series


@dataclass(frozen=True)
class Blocks:
    value: np.ndarray
    recorded: np.ndarray
    subtracted: np.ndarray
    drive_hz: np.ndarray


def test_light_taken_off_an_outlier_moves_as_the_modes_say_and_not_as_it_does(monkeypatch):
    """The drive of an outlier has followed it into its wrong fringe."""
    drive = np.array([2.0, 2.0, 0.3, 2.0])
    unit = np.array([[1.0, 0.5j]])
    modal = SimpleNamespace(
        amplitude_rad=drive[:, None] * unit,
        drive=drive.astype(complex),
        off=np.array([False, False, True, False]),
        common_mode_shift=np.ones((4, 3)),
    )
    light = np.full((5, 4), 3.0 + 1.0j, np.complex64)
    functions = np.linspace(0, 1, 10).reshape(5, 2)
    hz = np.array([1000.0, 1010.0, 1020.0, 1030.0])
    before = SimpleNamespace(
        modal=modal,
        block_amplitudes=Blocks(np.zeros((5, 4)), np.full((5, 4), 7.0), light, hz),
        basis=SimpleNamespace(functions=functions),
        displacements=None,
    )
    seen = {}

    def noted(less, _basis, _start, expected_rad, off, shift):
        seen.update(less=less, expected=expected_rad, off=off, shift=shift)
        raise StopIteration

    monkeypatch.setattr(refit, "refit_displacements", noted)
    with pytest.raises(StopIteration):
        fit_without_unshifted(before, None, Series.A)
    moved = np.abs(functions @ (2.0 * unit[0]))
    np.testing.assert_allclose(seen["less"].subtracted, light * j0(moved)[:, None], rtol=1e-6)
    np.testing.assert_allclose(seen["less"].value, 7.0 - seen["less"].subtracted, rtol=1e-6)
    assert seen["off"].tolist() == [False, False, True, False]
    assert not seen["shift"].any()
    np.testing.assert_allclose(seen["expected"][-1], np.full((4, 1), 2.0) * unit)
