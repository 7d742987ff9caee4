"""Table 2 and the principal components: factors behind the frequencies of a population."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import linear_sum_assignment

from fitting.paper.printed import Printed, Shares
from fitting.statistics.factors import (
    Factors,
    correlations,
    principal_factors,
    reconstruct,
    varimax,
    varimax_factors,
)
from fitting.statistics.hypotheses.joint import fit_hypothesis
from fitting.statistics.hypotheses.paper_structures import h4
from fitting.statistics.synthetic import (
    IDENTIFIED,
    REEDS,
    backward_validation,
    variable_names,
)
from holography.arrays import Array
from physics.reed.mode_classification import PAPER_MODES
from reproduction.models import (
    NOISE_CENTS,
    Models,
    Populations,
    as_eq_5d,
)
from reproduction.rows import (
    Drawing,
    Group,
    Row,
    from_populations,
    from_text,
)

_FACTORS: Final = 4
_LOADING: Final = 0.1
_PERCENT: Final = 1.0
_VALIDATIONS: Final = 40
_COMPONENTS: Final = ("e1", "e2", "e3", "e4")


@dataclass(frozen=True, eq=False)
class PopulationFactors:
    """Principal components of synthetic populations.

    Attributes
    ----------
    both, A, B : (p, k) float
        Shares of variance in %, largest first.
    loadings : (p, v + 4, 4) float
        Rotated loadings of the variables of Table 2 and of e1…e4 as fitted, factors in the order
        of the components that they are like.
    rmsd_cents : (p,) float
        Of all frequencies reconstructed from four factors.
    """

    both: Array
    A: Array
    B: Array
    loadings: Array
    rmsd_cents: Array


def compute_factors(populations: Populations, variables: tuple[str, ...]) -> PopulationFactors:
    """Analyse every population as the paper did its own.

    Parameters
    ----------
    populations : Populations
    variables : tuple of str
        In the order of the loadings.
    """
    names = variable_names(PAPER_MODES)
    columns = [names.index(name) for name in variables]
    complete = np.array([IDENTIFIED[name] for name in PAPER_MODES]).T == REEDS
    fractions: dict[str, list[Array]] = {"both": [], "A": [], "B": []}
    loadings, rmsd = [], []
    for cents in populations.observed_cents:
        components = fit_hypothesis(cents, h4()).unknowns.components
        parts = {"both": cents[:, complete], "A": cents[:, 0, complete[0]]}
        parts["B"] = cents[:, 1, complete[1]]
        for name, values in parts.items():
            fractions[name].append(100 * principal_factors(values, 1).spectrum[: _FACTORS + 1])
        flat = cents.reshape(len(cents), -1)
        found = varimax_factors(principal_factors(parts["both"], _FACTORS), components)
        scores = _in_order_of_components(found, components)
        loadings.append(correlations(np.hstack([flat[:, columns], components]), scores))
        rmsd.append(reconstruct(flat, found.scores).rmsd_cents)
    both, A, B = (np.array(fractions[name]) for name in ("both", "A", "B"))
    return PopulationFactors(both, A, B, np.array(loadings), np.array(rmsd))


def _in_order_of_components(found: Factors, components: Array) -> Array:
    """Scores (n, 4) of the factors like e1…e4, in that order and with their signs."""
    similarity = correlations(components, found.scores)
    _, order = linear_sum_assignment(np.abs(similarity), maximize=True)
    signs = np.sign(similarity[range(_FACTORS), order])
    return np.asarray(found.scores[:, order] * signs)


def compare_factors(numbers: Printed, models: Models) -> Group:
    """Compare Table 2 and the principal components."""
    variables = tuple(name for name in numbers.rotated_loadings if name not in _COMPONENTS)
    found = compute_factors(models.populations, variables)
    return Group(
        "factors",
        "Table 2: principal components",
        "Principal components of the correlation matrix of the 14 variables found on all reeds, "
        "rotated by VARIMAX together with fitted e1…e4, of "
        f"{len(found.both)} synthetic populations of {REEDS} reeds with {NOISE_CENTS:g} cents of "
        "noise (so chosen that four factors explain 91.2 %). What follows from the printed table "
        "itself is distinguished from it. Tolerated: "
        f"{_LOADING:g} for loadings, {_PERCENT:g} % point for fractions, two standard deviations "
        "from one population to the next.",
        (
            *_printed_rows(numbers),
            *_fraction_rows(numbers, found),
            *_validation_rows(numbers, models),
            *_reconstruction_rows(numbers, found),
            *_loading_rows(numbers, found),
        ),
        (
            Drawing(
                "Loadings of Table 2: the paper's, and the means over synthetic populations.",
                lambda: draw_loadings(numbers, found),
            ),
        ),
    )


def _printed_rows(numbers: Printed) -> Iterator[Row]:
    """What Table 2 says of itself."""
    table = np.array(list(numbers.rotated_loadings.values()))
    moved = float(np.abs(table @ varimax(table) - table).max())
    yield from_text(
        "Table 2", "farthest that VARIMAX moves a loading", 0, moved, 5e-4,
        remark="rows of length 1 (Kaiser), components among them: so the paper rotated",
    )  # fmt: skip
    count = numbers.pca.variables
    variables = table[:count]
    fractions = 100 * np.linalg.eigvalsh(variables.T @ variables)[::-1] / count
    for n, (printed, ours) in enumerate(
        zip(numbers.pca.both.variance_percent, fractions, strict=True), 1
    ):
        yield from_text(
            "Table 2", f"fraction of factor {n}, from the loadings", printed, ours, 0.5, "%",
            "eigenvalues of a correlation matrix" if n == 1 else "",
        )  # fmt: skip
    yield from_text(
        "Table 2", "sum of the fractions, from the loadings", numbers.pca.both.sum,
        float(fractions.sum()), 0.5, "%", "Table 2 has less variance than the text; unexplained",
    )  # fmt: skip


def _fraction_rows(numbers: Printed, found: PopulationFactors) -> Iterator[Row]:
    parts: tuple[tuple[str, Shares, Array], ...] = (
        ("both series", numbers.pca.both, found.both),
        ("series A", numbers.pca.A, found.A),
        ("series B", numbers.pca.B, found.B),
    )
    for words, printed, fractions in parts:
        kept = len(printed.variance_percent)
        for n, value in enumerate(printed.variance_percent):
            yield from_populations(
                "Principal components", f"{words}: fraction of factor {n + 1}", value,
                fractions[:, n], _PERCENT, "%",
            )  # fmt: skip
        yield from_populations(
            "Principal components", f"{words}: sum of {kept} fractions", printed.sum,
            fractions[:, :kept].sum(axis=1), _PERCENT, "%",
        )  # fmt: skip
        following = printed.fifth if printed.fourth is None else printed.fourth
        yield from_populations(
            "Principal components", f"{words}: fraction of factor {kept + 1}", following or np.nan,
            fractions[:, kept], _PERCENT, "%",
        )  # fmt: skip


def _validation_rows(numbers: Printed, models: Models) -> Iterator[Row]:
    where, printed = "Backward random validation", numbers.pca.backward_validation
    rng = np.random.default_rng(10)
    exact, noisy = (
        backward_validation(
            models.adjusted, rng, noise_cents=noise, grid_cents=grid, populations=_VALIDATIONS,
            passes=1,
        )
        for noise, grid in ((0.0, None), (NOISE_CENTS, 25.0))
    )  # fmt: skip
    yield from_text(
        where, "sum of four fractions, as described", printed.sum, 100 * exact.principal.sum_mean,
        2 * printed.sd, "%", "four components and no noise leave next to nothing to a fifth factor",
        refuted=True,
    )  # fmt: skip
    yield from_text(
        where, "sum of four fractions, with noise", printed.sum, 100 * noisy.principal.sum_mean,
        printed.sd, "%", f"{NOISE_CENTS:g} cents",
    )  # fmt: skip
    yield from_text(
        where, "SD of the sum, with noise", printed.sd, 100 * noisy.principal.sum_sd, 0.5, "%"
    )
    for n, value in enumerate(printed.variance_percent):
        principal, turned = 100 * noisy.principal.mean[n], 100 * noisy.rotated.mean[n]
        yield from_text(
            where, f"fraction of factor {n + 1}, with noise, after rotation", value, turned,
            2 * 100 * float(noisy.rotated.sd[n]), "%",
            f"{principal:.1f} % before rotation; H4 for H5, whose coefficients are not printed",
        )  # fmt: skip


def _reconstruction_rows(numbers: Printed, found: PopulationFactors) -> Iterator[Row]:
    yield from_populations(
        "Conclusions from the statistical analysis", "RMSD of reconstruction from four factors",
        numbers.pca.reconstruction_rmsd_cents_4_factors, as_eq_5d(found.rmsd_cents), 1.0, "cents",
        "with the divisor of Eq. eq5d",
    )  # fmt: skip
    similarity = np.abs(found.loadings[:, -len(_COMPONENTS) :])
    own = similarity[:, range(_FACTORS), range(_FACTORS)]
    for word, values in (("least", own.min(axis=1)), ("most", own.max(axis=1))):
        yield from_populations(
            "Conclusion", f"correlation of a component with its factor, {word}",
            numbers.text[f"component_factor_{word}"], values, 0.02,
        )  # fmt: skip


def _loading_rows(numbers: Printed, found: PopulationFactors) -> Iterator[Row]:
    for row, (name, loadings) in enumerate(numbers.rotated_loadings.items()):
        for k, printed in enumerate(loadings):
            yield from_populations(
                "Table 2", f"loading of {name} on factor {k + 1}", printed,
                found.loadings[:, row, k], _LOADING,
            )  # fmt: skip


def draw_loadings(numbers: Printed, found: PopulationFactors) -> Figure:
    """Loadings as shades, printed and ours side by side."""
    figure = Figure(figsize=(8, 6.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    tables = {
        "the paper": np.array(list(numbers.rotated_loadings.values())),
        "synthetic populations": found.loadings.mean(axis=0),
    }
    for axes, (words, table) in zip(panels, tables.items(), strict=True):
        axes.imshow(table, cmap="RdBu", vmin=-1, vmax=1, aspect="auto")
        for (i, k), value in np.ndenumerate(table):
            strong = abs(value) > 0.6
            axes.text(
                k, i, f"{value:.2f}", ha="center", va="center", fontsize=8,
                color="white" if strong else "black",
            )  # fmt: skip
        axes.set_xticks(range(_FACTORS), [f"factor {k + 1}" for k in range(_FACTORS)])
        axes.set_title(words, fontsize=11)
        axes.axhline(len(table) - _FACTORS - 0.5, color="black", linewidth=0.8)
    panels[0].set_yticks(range(len(numbers.rotated_loadings)), list(numbers.rotated_loadings))
    return figure
