"""The chain of hypotheses H1 … H11 on one population, as in the paper's table of hypotheses."""

from dataclasses import dataclass

import numpy as np

from fitting.statistics.hypotheses import paper_structures
from fitting.statistics.hypotheses.joint import (
    HypothesisFit,
    continued,
    fit_hypothesis,
)
from fitting.statistics.hypotheses.population import Priors, Unknowns
from fitting.statistics.hypotheses.prediction import ResonanceModel
from fitting.statistics.hypotheses.regression import regress_on_factors, regress_with_drying
from fitting.statistics.hypotheses.structure import PARAMETER_SIZES
from holography.arrays import Array

_DEFAULT_PRIORS = Priors()


def fit_chain(
    observed_cents: Array,
    *,
    model: ResonanceModel | None = None,
    priors: Priors = _DEFAULT_PRIORS,
) -> dict[str, HypothesisFit]:
    """Fit H1 to H9, by name.

    H1 to H4 start by themselves, H5 to H9 where the one before ended. From H4 to H8 each contains
    the one before, so that the sum of squares, priors included, can only fall.

    Parameters
    ----------
    observed_cents, model, priors
        See `fit_hypothesis`.

    Raises
    ------
    FitInputError
        See `fit_hypothesis`.
    """
    paper = paper_structures
    fits = [
        fit_hypothesis(observed_cents, structure(), model=model, priors=priors)
        for structure in (paper.h1, paper.h2, paper.h3, paper.h4)
    ]
    for structure in (paper.h5(), paper.h6(), paper.h7(), paper.h8()):
        start = continued(fits[-1], structure)
        fits.append(
            fit_hypothesis(observed_cents, structure, start=start, model=model, priors=priors)
        )
    fits.append(_h9(observed_cents, fits[-1], model, priors))
    return {fit.structure.name: fit for fit in fits}


def _h9(
    observed_cents: Array, h8: HypothesisFit, model: ResonanceModel | None, priors: Priors
) -> HypothesisFit:
    mean = h8.parameters.mean(axis=0)
    own = ((h8.parameters - mean) / PARAMETER_SIZES).reshape(len(h8.parameters), -1)
    start = Unknowns(np.empty(0), h8.unknowns.adjustments_cents, own)
    structure = paper_structures.h9(mean)
    return fit_hypothesis(observed_cents, structure, start=start, model=model, priors=priors)


@dataclass(frozen=True)
class HypothesisRow:
    """A row of the paper's table of hypotheses.

    Attributes
    ----------
    name : str
    components : int
        K, numbers for each reed.
    active : int or None
        Coefficients in M̂ and M̌; None where the paper has none to count.
    other : int
        Adjustments of Eq. 1, or weights of a regression.
    rmsd_cents : float
    """

    name: str
    components: int
    active: int | None
    other: int
    rmsd_cents: float


def table_of_hypotheses(
    observed_cents: Array,
    factors: Array,
    *,
    model: ResonanceModel | None = None,
    priors: Priors = _DEFAULT_PRIORS,
) -> tuple[HypothesisRow, ...]:
    """Fit all eleven hypotheses, H1 to H11 in order.

    Parameters
    ----------
    observed_cents, model, priors
        See `fit_hypothesis`.
    factors : (n, 4) float
        Of a principal component analysis of the same population, for H10 and H11.

    Raises
    ------
    FitInputError
        See `fit_hypothesis` and `regress_on_factors`.
    """
    fits = fit_chain(observed_cents, model=model, priors=priors)
    joint = [
        HypothesisRow(
            name,
            fit.structure.components,
            len(fit.coefficients) or None,
            fit.unknowns.adjustments_cents.size,
            fit.rmsd_cents,
        )
        for name, fit in fits.items()
    ]
    regressions = [f(observed_cents, factors) for f in (regress_on_factors, regress_with_drying)]
    return (
        *joint,
        *(
            HypothesisRow(
                r.name, len(r.rotation), len(r.coefficients) or None, r.free_weights, r.rmsd_cents
            )
            for r in regressions
        ),
    )
