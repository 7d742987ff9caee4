"""Table 1: resonance frequencies of the reeds, after hypothesis H4."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from fitting.forward import cents_of, hz_of
from fitting.paper.printed import Printed, PrintedModeStatistics
from fitting.statistics.synthetic import (
    GRID_CENTS,
    REEDS,
    modal_cents,
    mode_statistics,
)
from holography.arrays import Array
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import elastic_modes, viscoelastic_mode
from physics.reed.reduced.reed import ReducedReed
from physics.reed.reduction.metamodel import Metamodel
from reproduction.models import NOISE_CENTS, Models
from reproduction.rows import (
    Group,
    Row,
    from_populations,
    interval_from_populations,
    interval_from_text,
    not_printed,
    not_reproducible,
)

_WHERE: Final = "Table 1"
# One step of the sweep.
_STEP_CENTS: Final = GRID_CENTS
# Two modes that mix their shapes. The paper holds its X6 for uncertain.
_MIXED: Final = {"X6": "T5", "T5": "X6"}
# Of a standard deviation.
_SHARE: Final = 0.1


def compare_frequencies(numbers: Printed, models: Models) -> Group:
    """Compare Table 1."""
    return Group(
        "frequencies",
        "Table 1: resonance frequencies",
        "The mean reed (e = 0) of hypothesis H4 through the paper's chain: storage moduli at the "
        "means of Table 1, Eq. 1 with Table 9 and the adjustments, one pass; then the same moduli "
        "through converged finite elements without any adjustment. Standard deviations and "
        f"extremes are those of {len(models.populations.components)} synthetic populations of "
        f"{REEDS} reeds with {NOISE_CENTS:g} cents of noise, in steps of {GRID_CENTS:g} cents. "
        f"Tolerated: one step of the sweep (two for modes beyond Eq. 1), {100 * _SHARE:g} % of a "
        "standard deviation, and two standard deviations from one population to the next.",
        (
            *_mean_rows(numbers, models),
            *_rms_rows(numbers, models),
            *_adjustment_rows(numbers, models),
            *_population_rows(numbers, models),
            *_other_mode_rows(numbers, models),
        ),
    )


def _statistics(numbers: Printed) -> Iterator[tuple[int, int, str, PrintedModeStatistics]]:
    """Series and mode by place, name of the variable, and what is printed of it."""
    for s, series in enumerate(Series):
        for m, mode in enumerate(PAPER_MODES):
            yield s, m, f"{series}{mode}", numbers.observed_resonances[mode][series]


def _mean_reed(metamodel: Metamodel, passes: int | None) -> Array:
    """Cents above F6 of the mean reed, (2, m)."""
    return np.asarray(modal_cents(np.zeros((1, 4)), metamodel, passes=passes)[0])


def _observed(numbers: Printed) -> Array:
    """Means of Table 1 in cents above F6, (2, m)."""
    means = [seen.mean_hz or np.nan for _, _, _, seen in _statistics(numbers)]
    return cents_of(np.reshape(means, (len(Series), -1)))


def _mean_rows(numbers: Printed, models: Models) -> Iterator[Row]:
    one_pass, settled = (_mean_reed(models.adjusted, passes) for passes in (1, None))
    elements = _mean_reed(models.finite_elements, None)
    for s, m, name, seen in _statistics(numbers):
        yield interval_from_text(
            _WHERE, f"{name}: mean, by the paper's chain", seen.mean_hz or np.nan,
            float(hz_of(one_pass[s, m])), _STEP_CENTS,
            f"{settled[s, m] - one_pass[s, m]:+.1f} cents if iterated until nothing changes",
        )  # fmt: skip
    for s, m, name, seen in _statistics(numbers):
        yield interval_from_text(
            _WHERE, f"{name}: mean, by converged finite elements", seen.mean_hz or np.nan,
            float(hz_of(elements[s, m])), _STEP_CENTS, "no adjustments",
        )  # fmt: skip


def _elements_adjustment(numbers: Printed, models: Models) -> Array:
    """Cents (m,) by which finite elements miss the means of Table 1, mean of both series."""
    counts = np.reshape([seen.identified for *_, seen in _statistics(numbers)], (len(Series), -1))
    off = _observed(numbers) - _mean_reed(models.finite_elements, None)
    return np.asarray(np.average(off, axis=0, weights=counts))


def _rms_rows(numbers: Printed, models: Models) -> Iterator[Row]:
    observed = _observed(numbers)
    elements = _mean_reed(models.finite_elements, None)
    computed = {
        "the paper's chain": _mean_reed(models.adjusted, 1),
        "the paper's chain, iterated": _mean_reed(models.adjusted, None),
        "converged finite elements": elements,
        "converged finite elements, adjusted": elements + _elements_adjustment(numbers, models),
    }
    for words, cents in computed.items():
        rms = np.sqrt(np.mean((cents - observed) ** 2, axis=1))
        for series, value in zip(Series, rms, strict=True):
            yield not_printed(
                _WHERE, f"series {series}: rms over the modes, {words}", value, "cents"
            )


def _adjustment_rows(numbers: Printed, models: Models) -> Iterator[Row]:
    printed, ours = numbers.h4.a_m0_adjustment_cents, _elements_adjustment(numbers, models)
    for name, value in zip(PAPER_MODES, ours, strict=True):
        yield not_printed(
            "Robust estimation (H4)", f"{name}: adjustment that finite elements need", value,
            "cents", f"that of Table 9: {printed[name]:+.2f} cents",
        )  # fmt: skip
    for words, values in (
        ("Table 9", np.array([printed[name] for name in PAPER_MODES])),
        ("finite elements", ours),
    ):
        yield not_printed(
            "Robust estimation (H4)", f"rms of the adjustments of {words}",
            float(np.sqrt(np.mean(values**2))), "cents",
        )  # fmt: skip


def _population_rows(numbers: Printed, models: Models) -> Iterator[Row]:
    each = [mode_statistics(hz_of(cents)) for cents in models.populations.observed_cents]
    mean, sd, least, most = (
        np.array([getattr(found, field) for found in each])
        for field in ("mean", "sd", "minimum", "maximum")
    )
    for s, m, name, seen in _statistics(numbers):
        printed = {"mean": seen.mean_hz, "minimum": seen.min_hz, "maximum": seen.max_hz}
        for (words, hz), values in zip(printed.items(), (mean, least, most), strict=True):
            yield interval_from_populations(
                _WHERE, f"{name}: {words} of a population", hz or np.nan, values[:, s, m],
                _STEP_CENTS,
            )  # fmt: skip
        sd_hz = seen.sd_hz or np.nan
        yield from_populations(
            _WHERE, f"{name}: SD of a population", sd_hz, sd[:, s, m], _SHARE * sd_hz, "Hz"
        )


def _other_mode_rows(numbers: Printed, models: Models) -> Iterator[Row]:
    """Modes that Eq. 1 does not have: names, and what our finite elements have instead."""
    for mode, by_series in numbers.observed_resonances.items():
        if mode in PAPER_MODES:
            continue
        for series in Series:
            seen = by_series[series]
            if seen.mean_hz is None or seen.sd_hz is None:
                continue
            ours, remark = _computed(models.reed, mode, series, seen.mean_hz)
            yield interval_from_text(
                _WHERE, f"{series}{mode}: mean, by converged finite elements", seen.mean_hz,
                ours, 2 * _STEP_CENTS, remark,
            )  # fmt: skip
            yield not_reproducible(
                _WHERE, f"{series}{mode}: SD", seen.sd_hz, "Hz", f"Eq. 1 has no {mode}"
            )


def _computed(reed: ReducedReed, mode: str, series: Series, printed_hz: float) -> tuple[float, str]:
    """Frequency in Hz of a mode of the mean reed; of two that share shapes, the nearer one.

    In a vacuum, as the paper's finite elements.
    """
    cane = viscoelastic_cane(Components(), series)
    E_L_pa = float(storage_modulus_pa(cane.young_L, printed_hz))
    G_LT_pa = float(storage_modulus_pa(cane.shear_LT, printed_hz))
    nearby = elastic_modes(reed, E_L_pa, G_LT_pa, air_fraction=0.0)
    names = (mode, _MIXED[mode]) if mode in _MIXED else (mode,)
    # Begun at our own mode: where two share shapes a name settles near the start.
    found = [viscoelastic_mode(reed, cane, n, nearby[n].frequency_hz, 0.0) for n in names]
    best = min(found, key=lambda m: abs(np.log2(m.frequency_hz / printed_hz)))
    if len(found) == 1:
        return best.frequency_hz, "no adjustments"
    mixed = " and ".join(f"{m.name} {m.frequency_hz:.0f} Hz ({m.similarity:.2f})" for m in found)
    return best.frequency_hz, (
        f"no adjustments; our {mixed} mix the shapes of both names, so that either name fits "
        "either: the nearer one is compared"
    )
