"""A mode at another frequency with the drive bent to match gives equal motion."""

import numpy as np
import pytest

from diagnosis.inference.nuisances import of_fits
from diagnosis.observables.drive import exchanged
from physics.parameters.tree import BenchParameters, FitBias

HZ = np.geomspace(2.5e3, 4.5e3, 40)


def response(f: float, eta: float) -> np.ndarray:
    return 1 / np.abs(complex(1, eta) - (HZ / f) ** 2)


@pytest.mark.parametrize(("cents", "log"), [(0.0, 0.0), (17.0, 0.0), (-40.0, 0.1), (5.0, -0.2)])
def test_drive_and_mode_together_are_what_was_measured(cents: float, log: float) -> None:
    true_hz, true_loss = 3300.0, 0.03
    told_hz, told_loss = true_hz * 2 ** (cents / 1200), true_loss * np.exp(log)
    # The drive is flat; what a fit with another mode makes of it is bent.
    bent = np.log(response(true_hz, true_loss) / response(told_hz, told_loss))
    found = exchanged(FitBias((("T1", cents, log),)), "T1", told_hz, told_loss, HZ)
    np.testing.assert_allclose(found, bent, atol=1e-9)


def test_exchanges_add_up_and_belong_to_their_mode() -> None:
    parameters = BenchParameters()
    for nuisance in of_fits(["T1", "F2"]):
        assert nuisance.of_fits
        parameters = nuisance.change(parameters, 2.0 if nuisance.unit else 0.5)
    assert parameters.fit_bias.of("T1") == parameters.fit_bias.of("F2") == (2.0, 0.5)
    assert parameters.fit_bias.of("X1") == (0.0, 0.0)
