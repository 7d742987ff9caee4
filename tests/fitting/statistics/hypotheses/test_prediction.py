"""Frequencies of populations against the forward model of single reeds, and their derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.forward import PaperModel, viscoelastic_cents
from fitting.paper.constants import TABLE_9
from fitting.statistics.hypotheses.prediction import (
    full_adjustment,
    intercept_adjustment,
    no_adjustment,
    paper_resonances,
    predict,
)
from fitting.statistics.hypotheses.structure import PARAMETER_SIZES
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduction.metamodel import Equation1, paper_network_pa


@pytest.fixture(scope="module")
def parameters(structures, clean):
    return structures["H4"].parameters(structures["H4"].start, clean.components[:8])


@pytest.mark.parametrize(
    ("single", "converged"), [(PaperModel(), False), (PaperModel(iterations=40), True)]
)
def test_frequencies_are_those_of_single_reeds(clean, parameters, single, converged):
    adjustments = np.array(
        [
            [with_h4 - TABLE_9[name][0]]
            for name, with_h4 in zip(PAPER_MODES, _intercepts_of(single), strict=True)
        ]
    )
    model = paper_resonances(converged=converged)
    cents = predict(model, intercept_adjustment(), adjustments, parameters).cents
    for components, reed in zip(clean.components, cents, strict=False):
        for series, row in zip(Series, reed, strict=True):
            cane = viscoelastic_cane(Components(*map(float, components)), series)
            np.testing.assert_allclose(row, viscoelastic_cents(single, cane, series), atol=1e-6)


def _intercepts_of(single):
    """a_m0 that the forward model adds: what is left where both powers vanish."""
    infinite, nothing = np.full(11, 1e300), np.zeros(11)
    return single.elastic_cents(infinite, nothing)


@pytest.mark.parametrize("converged", [False, True])
@pytest.mark.parametrize("adjust", [no_adjustment, intercept_adjustment, full_adjustment])
def test_derivatives_are_those_of_central_differences(parameters, converged, adjust):
    model, adjustment = paper_resonances(converged=converged), adjust()
    rng = np.random.default_rng(1)
    amounts = 30 * rng.standard_normal((11, adjustment.to_equation_1.shape[1]))
    step = 1e-4 * PARAMETER_SIZES * rng.standard_normal(parameters.shape)
    change = 0.1 * rng.standard_normal(amounts.shape)

    def cents(factor):
        moved = (amounts + factor * change, parameters + factor * step)
        return predict(model, adjustment, *moved).cents

    here = predict(model, adjustment, amounts, parameters)
    by_parameters = np.einsum("nsmj,nsj->nsm", here.by_parameter, step)
    by_adjustments = np.einsum("nsmr,mr->nsm", here.by_adjustment, change)
    differences = (cents(1) - cents(-1)) / 2
    np.testing.assert_allclose(by_parameters + by_adjustments, differences, atol=1e-6)


def test_full_adjustments_are_of_one_cent_rms_and_have_nothing_in_common():
    E, G = (np.repeat(modulus[:, None], 1, axis=1) for modulus in paper_network_pa())
    values = full_adjustment().evaluate(("F1",), E, G)[0][:, 0]
    np.testing.assert_allclose(values.T @ values / len(E), np.eye(6), atol=1e-6)
    np.testing.assert_allclose(values[:, 0], 1)


def test_full_adjustments_are_changes_of_equation_1(parameters):
    model, adjustment = paper_resonances(), full_adjustment()
    amounts = 30 * np.random.default_rng(2).standard_normal((11, 6))
    changed = np.array([TABLE_9[name] for name in PAPER_MODES])
    changed += amounts @ adjustment.to_equation_1.T
    other = replace(model, metamodel=Equation1(PAPER_MODES, changed))
    np.testing.assert_allclose(
        predict(model, adjustment, amounts, parameters).cents,
        predict(other, no_adjustment(), np.empty((11, 0)), parameters).cents,
        atol=1e-6,
    )


def test_without_a_maxwell_arm_the_start_does_not_matter():
    elastic = np.array([[[13500.0, 0, 0, 1000, 0, 0]] * 2])
    model = paper_resonances()
    elsewhere = replace(model, start_hz=2 * model.start_hz)
    cents, other = (
        predict(m, no_adjustment(), np.empty((11, 0)), elastic).cents for m in (model, elsewhere)
    )
    assert np.array_equal(cents, other)
    direct = model.metamodel.evaluate(np.full(11, 13.5e9), np.full(11, 1e9))[0]
    np.testing.assert_allclose(cents, np.broadcast_to(direct, (1, 2, 11)))


@pytest.mark.parametrize("converged", [False, True])
def test_impossible_moduli_have_no_frequency_and_spoil_no_other(parameters, converged):
    model = paper_resonances(converged=converged)
    spoilt = parameters.copy()
    spoilt[3, 1, 3:5] = -500, 300
    arguments = (no_adjustment(), np.empty((11, 0)))
    fine, cents = (predict(model, *arguments, p).cents for p in (parameters, spoilt))
    assert np.isnan(cents[3, 1]).any()
    cents[3, 1] = fine[3, 1]
    np.testing.assert_allclose(cents, fine, atol=1e-6)


@pytest.mark.parametrize("converged", [False, True])
@pytest.mark.parametrize("parameter", range(6))
def test_parameters_of_a_search_gone_wild_have_no_frequency(parameters, converged, parameter):
    wild = parameters.copy()
    wild[2, 0, parameter] = 1e80
    arguments = (no_adjustment(), np.empty((11, 0)))
    cents = predict(paper_resonances(converged=converged), *arguments, wild).cents
    assert np.isnan(cents[2, 0]).all()
    assert np.isfinite(np.delete(cents.reshape(-1, 11), 4, axis=0)).all()
