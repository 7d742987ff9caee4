"""Which modes a fit has put elsewhere than the reed has them."""

import numpy as np
import pytest

from fitting.names.places import Place, misplaced_hz

DRIVE_HZ = np.array([1500.0, 3000.0, 16000.0])


@pytest.mark.parametrize(("fitted_hz", "error", "elsewhere"), [
    (3300.0, 0.001, True),
    # Within the width of a resonance, 3 %.
    (3080.0, 0.001, False),
    # Within three standard errors of the place.
    (3300.0, 0.04, False),
    (2700.0, 0.03, True),
])  # fmt: skip
def test_a_mode_is_elsewhere_beyond_its_width_and_three_errors(fitted_hz, error, elsewhere):
    found = misplaced_hz({"T1": Place(3000.0, error)}, {"T1": fitted_hz}, DRIVE_HZ)
    assert found == ({"T1": 3000.0} if elsewhere else {})


def test_modes_outside_the_sweep_or_not_fitted_are_not_misplaced():
    places = {"F1": Place(1400.0, 0.001), "F4": Place(16500.0, 0.001), "X9": Place(9000.0, 0.001)}
    assert misplaced_hz(places, {"F1": 2000.0, "F4": 12000.0}, DRIVE_HZ) == {}
