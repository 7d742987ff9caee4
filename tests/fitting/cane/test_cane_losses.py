"""Loss factors of the cane from those of modes."""

import numpy as np
import pytest

from fitting.cane.cane_losses import fit_losses
from fitting.errors import FitError
from fitting.resonance import Resonance
from physics.alterations import YieldingClamp
from physics.effects.catalogue import BY_ID
from physics.mechanics import Mechanics, ReedSolver
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.mode_classification import PAPER_MODES

CANE = viscoelastic_cane(Components(0.5, -0.4, 0.3), Series.A)
ERROR = 0.02


@pytest.fixture(scope="module")
def solver(reed):
    return ReedSolver(reed)


def swept(solver, reed, rng=None, error=ERROR):
    """Resonances of a reed with relative errors of its loss factors."""
    modes = solver.modes(reed)
    noise = np.zeros(len(PAPER_MODES)) if rng is None else error * rng.normal(size=len(PAPER_MODES))
    return {
        name: Resonance(
            name, modes[name].hz, 1.0, 0, 5.0,
            loss_factor=modes[name].loss_factor * (1 + by), loss_error=error,
        )
        for name, by in zip(PAPER_MODES, noise, strict=True)
    }  # fmt: skip


@pytest.mark.parametrize("shear_over_normal", [0.7, 1.0, 1.5])
def test_both_loss_factors_are_recovered(solver, shear_over_normal):
    reed = Mechanics(CANE, loss_factor=0.025, shear_loss_log=float(np.log(shear_over_normal)))
    found = fit_losses(swept(solver, reed), CANE, solver)
    assert found.normal.value == pytest.approx(0.025, rel=1e-6)
    assert found.shear.value == pytest.approx(0.025 * shear_over_normal, rel=1e-6)
    assert found.excess_scatter == 0
    assert max(map(abs, found.residual.values())) < 1e-9


def test_errors_are_honest_of_losses_that_the_model_does_not_know(solver):
    """Losses grow with frequency, the clamp yields, and noise is added."""
    rng, pulls = np.random.default_rng(3), []
    (growth,) = BY_ID["frequency_dependent_damping"].parameters
    for _ in range(60):
        reed = Mechanics(
            CANE,
            loss_factor=0.03,
            shear_loss_log=0.3,
            loss_growth=float(growth.spread * rng.normal()),
            alterations=((YieldingClamp(), 1e-13 * abs(rng.normal())),),
        )
        found = fit_losses(swept(solver, reed, rng), CANE, solver)
        true = 0.03, 0.03 * np.exp(0.3)
        pulls.append(
            [
                (one.value - t) / one.error
                for one, t in zip((found.normal, found.shear), true, strict=True)
            ]
        )
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert (rms > 0.6).all()
    assert (rms < 1.3).all()


def test_what_all_modes_have_in_common_is_no_average(solver):
    """Own errors of 1 %, and one of 2 to 4 % that moves all modes together."""
    rng, pulls = np.random.default_rng(8), []
    reed = Mechanics(CANE, loss_factor=0.03, shear_loss_log=0.3)
    modes, shared = solver.modes(reed), np.linspace(0.02, 0.04, len(PAPER_MODES))
    for _ in range(80):
        own, common = 0.01 * rng.normal(size=len(PAPER_MODES)), rng.normal()
        found = {
            name: Resonance(
                name, modes[name].hz, 1.0, 0, 5.0,
                loss_factor=modes[name].loss_factor * (1 + o + s * common),
                loss_error=float(np.hypot(0.01, s)), loss_error_shared=float(s),
            )
            for name, o, s in zip(PAPER_MODES, own, shared, strict=True)
        }  # fmt: skip
        losses = fit_losses(found, CANE, solver)
        true = 0.03, 0.03 * np.exp(0.3)
        both = zip((losses.normal, losses.shear), true, strict=True)
        pulls.append([(one.value - t) / one.error for one, t in both])
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert (rms > 0.5).all()
    assert (rms < 1.2).all()


def test_scatter_of_modes_widens_the_errors(solver):
    reed, rng = Mechanics(CANE), np.random.default_rng(5)
    stated = swept(solver, reed, error=0.005)
    moved = {
        name: Resonance(
            name, mode.frequency_hz, 1.0, 0, 5.0,
            loss_factor=mode.loss_factor * (1 + 0.05 * rng.normal()), loss_error=0.005,
        )
        for name, mode in stated.items()
    }  # fmt: skip
    exact, found = (fit_losses(each, CANE, solver) for each in (stated, moved))
    assert found.reduced_chi2 > 10
    assert found.excess_scatter == pytest.approx(0.05 * 0.03, rel=0.6)
    assert found.normal.error > 3 * exact.normal.error


def test_few_modes_do_not_separate_them(solver):
    few = dict(list(swept(solver, Mechanics(CANE)).items())[:3])
    with pytest.raises(FitError, match="4 are needed"):
        fit_losses(few, CANE, solver)
    # The method of the paper has no loss factors.
    none = {name: Resonance(name, 2000.0, 1.0, 0, 5.0) for name in PAPER_MODES}
    with pytest.raises(FitError, match="0 modes"):
        fit_losses(none, CANE, solver)
