"""Populations with known truth, and every structure at a point where nothing is zero."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from fitting.paper.constants import H4_ADJUSTMENT_CENTS
from fitting.statistics.factors import orthonormal
from fitting.statistics.hypotheses import paper_structures
from fitting.statistics.hypotheses.population import (
    Population,
    Priors,
    Unknowns,
)
from fitting.statistics.hypotheses.prediction import (
    full_adjustment,
    intercept_adjustment,
    paper_resonances,
    predict,
)
from physics.reed.mode_classification import PAPER_MODES

H4 = paper_structures.h4()
ADJUSTMENTS = np.array([[H4_ADJUSTMENT_CENTS[name]] for name in PAPER_MODES])
# Table 1: on how many of 55 reeds some modes were not identified, in series A and B.
MISSING = {"X1": (0, 10), "T3": (0, 1), "X2": (0, 1), "X3": (0, 44), "T4": (2, 1), "F4": (10, 1)}
STRUCTURES = {
    structure.name: structure
    for structure in (
        paper_structures.h1(),
        paper_structures.h2(),
        paper_structures.h3(),
        H4,
        paper_structures.h5(),
        paper_structures.h6(),
        paper_structures.h6_constant_dashpots(),
        paper_structures.h7(),
        paper_structures.h8(),
        paper_structures.h9(H4.matrices(H4.start)[:, :, 0]),
    )
}


@dataclass(frozen=True)
class KnownPopulation:
    """Reeds of hypothesis H4 with the paper's coefficients and adjustments."""

    observed_cents: np.ndarray
    exact_cents: np.ndarray
    components: np.ndarray


@pytest.fixture(scope="session")
def draw():
    """Return a function that draws reeds, as many modes missing of each as in Table 1."""

    def from_h4(seed, *, reeds=55, noise_cents=0.0, grid_cents=0.0):
        rng = np.random.default_rng(seed)
        parameters = np.zeros(1)
        # A cane that cannot exist, 1.7 % of all, is no reed.
        while np.min(parameters) <= 0:
            components = orthonormal(rng.standard_normal((reeds, 4)))
            parameters = H4.parameters(H4.start, components)
        adjusted = (intercept_adjustment(), ADJUSTMENTS)
        exact = predict(paper_resonances(), *adjusted, parameters).cents
        observed = exact + noise_cents * rng.standard_normal(exact.shape)
        if grid_cents:
            observed = grid_cents * np.round(observed / grid_cents)
        for name, counts in MISSING.items():
            for series, count in enumerate(counts):
                gone = rng.permutation(reeds)[: round(count * reeds / 55)]
                observed[gone, series, PAPER_MODES.index(name)] = np.nan
        return KnownPopulation(observed, exact, components)

    return from_h4


@pytest.fixture(scope="session")
def clean(draw):
    return draw(20100)


@pytest.fixture(scope="session")
def noisy(draw):
    """As the paper's reeds: 27 cents of misfit, in steps of 25 cents."""
    return draw(20101, noise_cents=27, grid_cents=25)


@pytest.fixture(scope="session")
def structures():
    return STRUCTURES


@pytest.fixture(params=STRUCTURES)
def structure(request):
    return STRUCTURES[request.param]


@pytest.fixture
def off_start():
    """Return a function that gives coefficients a few per cent off a structure's start."""

    def coefficients(structure, fraction=0.05, seed=5):
        off = np.random.default_rng(seed).standard_normal(len(structure.start))
        return structure.start * (1 + fraction * off)

    return coefficients


@pytest.fixture
def posed(draw, off_start):
    """Return a function that poses a structure on 14 noisy reeds, with a point near its start."""

    def pose(structure, *, converged=False):
        rng = np.random.default_rng(12)
        adjustment = full_adjustment() if structure.all_of_equation_1 else intercept_adjustment()
        model = paper_resonances(converged=converged)
        population = Population.posed(
            draw(11, reeds=14, noise_cents=30).observed_cents,
            structure,
            model,
            Priors(),
            adjustment,
            structure.start,
        )
        own = rng.standard_normal((14, structure.components))
        own = orthonormal(own) if structure.orthonormal and own.size else 0.1 * own
        adjustments = 20 * rng.standard_normal((11, adjustment.to_equation_1.shape[1]))
        unknowns = Unknowns(off_start(structure), adjustments, own)
        return population, population.point(unknowns)

    return pose


@pytest.fixture
def rough_h4(off_start):
    """H4 that starts some 15 % off its coefficients."""
    return replace(H4, start=off_start(H4, fraction=0.15, seed=3))
