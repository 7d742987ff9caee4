"""Reasons why a mode is not identified, by its own numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from fitting.modal.identify import _doubt


@pytest.mark.parametrize(
    ("outliers", "refused"),
    [([], False), ([10], False), ([9, 11], False), ([10, 11], True), ([8, 10, 12], True)],
)
def test_two_neighbours_at_a_resonance_that_are_left_out_were_its_peak(outliers, refused):
    drive_hz = 3000 * 2 ** (np.arange(-10, 11) * 25 / 1200)
    off = np.isin(np.arange(21), outliers)
    modal = SimpleNamespace(
        hz=[3000.0], loss_factor=[0.036], loss_over_others=lambda _mode: 1.0, off=off,
        participation=[1.0], participation_error=[0.01], error_cents=[1.0],
    )  # fmt: skip
    assert bool(_doubt(modal, 0, SimpleNamespace(drive_hz=drive_hz))) == refused
    elsewhere = np.roll(off, 7)
    modal.off = elsewhere
    assert not _doubt(modal, 0, SimpleNamespace(drive_hz=drive_hz))
