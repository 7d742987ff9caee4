"""Modes of a reduced reed in a state: all of them, each once, or an error that says why."""

from dataclasses import replace

import numpy as np
import pytest

from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import ViscoelasticCane, Zener
from physics.reed.reduced.changes import combined, layer
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.vibrations import vibrations

HIGHEST_HZ = 24e3


@pytest.fixture(scope="module")
def tilted(coarse_reed):
    """Return a function that gives the state of a reed that couples all of its motions."""
    tilt = layer(coarse_reed, lambda _x, y: y / 6e-3)
    return lambda law, amount_m: State(law, combined([(amount_m, tilt)]))


def below(dynamics, hz):
    """Numbers of modes below frequencies (m,): of negative eigenvalues (Sylvester)."""
    Z = np.tensordot(dynamics.amounts(hz)[0], dynamics.matrices, axes=1)
    return np.count_nonzero(np.linalg.eigvalsh(Z) < 0, axis=1)


def test_no_mode_is_missed_or_found_twice(coarse_reed, tilted):
    """Moduli that grow let modes exchange their order between one frequency and their own."""
    rng = np.random.default_rng(3)
    for cane in coarse_reed.box.at(rng.random((80, 9))):
        growths = rng.uniform(-0.1, [0.1, 0.2])
        law = CaneLaw(cane, growth_E_L=growths[0], growth_G_LT=growths[1])
        found = vibrations(coarse_reed, tilted(law, rng.uniform(-7e-6, 7e-6)), HIGHEST_HZ)
        (group,) = found.groups
        assert below(group.dynamics, np.array([HIGHEST_HZ])) == len(found.hz)
        # 0.02 cents below each mode lie those before it, and no other.
        np.testing.assert_array_equal(
            below(group.dynamics, found.hz * (1 - 1e-5)), np.arange(len(found.hz))
        )


def test_a_reed_without_modes_has_none(coarse_reed):
    found = vibrations(coarse_reed, State(CaneLaw(Cane())), 100.0)
    assert found.hz.shape == (0,)
    assert found.coordinates.shape == (len(coarse_reed.mass), 0)


@pytest.mark.parametrize(
    "law",
    [
        CaneLaw(replace(Cane(), E_T_pa=-1e9)),
        CaneLaw(replace(Cane(), G_LR_pa=np.nan)),
        CaneLaw(replace(Cane(), nu_TR=1.2)),
        CaneLaw(replace(Cane(), density_kg_m3=-500.0)),
        CaneLaw(Cane(), log_E_L=-800.0),
        CaneLaw(Cane(), ViscoelasticCane(Zener(0.0, 0.0, 0.0), Zener(1100.0, 0.0, 0.0))),
        CaneLaw(Cane(), growth_E_L=3.0),
    ],
    ids=["E_T", "no number", "Poisson", "density", "no E_L", "no spring", "growth"],
)
def test_cane_that_cannot_be_is_refused(coarse_reed, law):
    with pytest.raises(ImpossibleReedError):
        vibrations(coarse_reed, State(law), HIGHEST_HZ)
