"""A loss factor and a stiffening that trade: against a resonance of known width."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.cane.loss_errors import stiffening_error, with_stiffening_errors
from fitting.resonance import Resonance
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)

HZ = 4000.0


def stiffening(components, hz=HZ):
    """Exponent of E_L by its own differences."""
    zener = viscoelastic_cane(components, Series.A).young_L
    ratio = storage_modulus_pa(zener, 1.02 * hz) / storage_modulus_pa(zener, hz / 1.02)
    return float(np.log(ratio) / (2 * np.log(1.02)))


def half_width(loss, exponent):
    """Distance in ln f at which the response of a mode has fallen to 1/√2."""
    log = np.linspace(-0.05, 0.05, 200_001)
    response = np.abs(1 / (1 + 1j * loss - np.exp((2 - exponent) * log)))
    inside = log[response > response.max() / np.sqrt(2)]
    return 0.5 * (inside[-1] - inside[0])


def test_a_mode_of_another_stiffening_is_as_wide_with_another_loss():
    """A reed whose e3 is 1: with the loss that this error allows, mean cane has the same width."""
    mean, other = stiffening(Components()), stiffening(Components(e3=1.0))
    trade = (other - mean) / (2 - mean)
    assert half_width(0.02, mean) == pytest.approx(half_width(0.02 * (1 - trade), other), rel=2e-3)


def test_the_error_is_that_of_all_components_together():
    mean = stiffening(Components())
    each = [
        0.5 * (stiffening(Components(**{n: 1.0})) - stiffening(Components(**{n: -1.0})))
        for n in ("e1", "e2", "e3")
    ]
    expected = np.linalg.norm(each) / (2 - mean)
    error = stiffening_error(np.array([1.0, 0.0]), HZ, Series.A)
    assert error == pytest.approx(expected, rel=1e-3)
    assert error > 0.005


def test_errors_of_losses_grow_and_nothing_else_changes(reed):
    found = Resonance("F1", 1950.0, 1.0, 3, 5.0, loss_factor=0.03, loss_error=0.01)
    strange = replace(found, name="no mode")
    silent = replace(found, name="T1", loss_error=None)
    given = {each.name: each for each in (found, strange, silent)}
    answer = with_stiffening_errors(given, reed, Series.A)
    assert answer["no mode"] == strange
    assert answer["T1"] == silent
    assert answer["F1"].loss_error > 0.01
    assert replace(answer["F1"], loss_error=0.01) == found
