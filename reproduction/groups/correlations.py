"""Correlations between modes and between the series (TableCorr, appendix on statistics)."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from fitting.paper.printed import Printed
from fitting.statistics.synthetic import (
    flexural_correlations,
    mode_correlations,
    series_correlations,
)
from holography.arrays import Array
from physics.reed.mode_classification import PAPER_MODES
from reproduction.models import (
    NOISE_CENTS,
    Models,
    Populations,
)
from reproduction.rows import (
    Group,
    Row,
    from_populations,
    not_reproducible,
)

_TOLERANCE: Final = 0.05
_STRENGTH = "the nominal strengths of the reeds are not printed one by one"


def compare_correlations(numbers: Printed, models: Models) -> Group:
    """Compare correlations."""
    populations = models.populations
    return Group(
        "correlations",
        "Correlations of modes",
        f"{len(populations.components)} synthetic populations of {populations.components.shape[1]} "
        "reeds after hypothesis H4: without noise next to the paper's computed modes and between "
        f"the series, with {NOISE_CENTS:g} cents of noise next to observations within a series. "
        f"Tolerated: {_TOLERANCE:g} and two standard deviations from one population to the next.",
        (
            *_flexural_rows(numbers, populations.exact_cents, "H4"),
            *_flexural_rows(numbers, populations.observed_cents, "observed"),
            *_series_rows(numbers, populations),
            *_within_rows(numbers, populations.observed_cents),
            *_strength_rows(numbers),
        ),
    )


def _flexural_rows(numbers: Printed, populations: Array, kind: str) -> Iterator[Row]:
    each = [flexural_correlations(cents, PAPER_MODES) for cents in populations]
    for pair, printed in numbers.flexural_correlations[kind].items():
        yield from_populations(
            "TableCorr", f"{pair}, {kind}", printed, [found[pair] for found in each], _TOLERANCE
        )


def _series_rows(numbers: Printed, populations: Populations) -> Iterator[Row]:
    each, noisy = (
        np.array([series_correlations(cents) for cents in many])
        for many in (populations.exact_cents, populations.observed_cents)
    )
    for mode, printed in numbers.correlations_A_vs_B.items():
        quantity = f"A{mode}/B{mode}"
        if mode in PAPER_MODES:
            m = PAPER_MODES.index(mode)
            yield from_populations(
                "appendix on statistics", quantity, printed, each[:, m], _TOLERANCE,
                remark=f"{noisy[:, m].mean():.2f} with noise of its own in each series",
            )  # fmt: skip
        else:
            yield not_reproducible(
                "appendix on statistics", quantity, printed, "", f"Eq. 1 has no {mode}"
            )


def _within_rows(numbers: Printed, populations: Array) -> Iterator[Row]:
    each = np.array([mode_correlations(cents) for cents in populations])
    for pair, printed in numbers.correlations_with_F1.items():
        one, other = pair.split("/")
        places = "AB".index(one[0]), PAPER_MODES.index(one[1:]), PAPER_MODES.index(other[1:])
        yield from_populations(
            "appendix on statistics", pair, printed, each[:, *places], _TOLERANCE
        )


def _strength_rows(numbers: Printed) -> Iterator[Row]:
    for words, key, unit in (
        ("AT1 and AX4 with nominal strength", "strength_AT1", ""),
        ("AF1 with nominal strength", "strength_AF1", ""),
        ("E1 G1 of series A with nominal strength", "strength_E1_G1_percent", "%"),
        ("E1 with nominal strength", "strength_E1_percent", "%"),
        ("G1 with nominal strength", "strength_G1_percent", "%"),
    ):
        yield not_reproducible("Nominal strength", words, numbers.text[key], unit, _STRENGTH)
