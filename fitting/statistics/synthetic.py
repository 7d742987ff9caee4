"""Populations of reeds whose truth is known, and the statistics that the paper computes.

The paper's 55 reeds are not printed one by one. What it did with them is done here with reeds drawn
from its hypothesis H4, seen as its sweep saw reeds: in steps of 25 cents, some modes not found.
Observations are arrays (n, 2, m) in cents above F6: reeds, series A and B, modes; NaN where a
resonance was not found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import fixed_point

from fitting.forward import cents_of, hz_of
from fitting.paper import constants as paper
from fitting.statistics import factors
from holography.arrays import Array
from physics.reed.cane.viscoelastic import (
    Series,
    h4_matrix,
    storage_modulus,
)
from physics.reed.reduction.metamodel import Metamodel

# Table 1: on how many of the 55 reeds each mode was identified, in series A and B.
REEDS: Final = 55
IDENTIFIED: Final[dict[str, tuple[int, int]]] = {
    "F1": (55, 55),
    "T1": (55, 55),
    "F2": (55, 55),
    "T2": (55, 55),
    "X1": (55, 45),
    "T3": (55, 54),
    "F3": (55, 55),
    "X2": (55, 54),
    "X3": (55, 11),
    "T4": (53, 54),
    "F4": (45, 54),
    "X6": (41, 30),
    "X4": (24, 23),
    "X5": (0, 54),
    "T5": (0, 14),
}
# Step of the sweep.
GRID_CENTS: Final = 25.0
# Springs among the six parameters: E1, E2, G1, G2.
_SPRINGS: Final = (0, 1, 3, 4)
# Where the iteration over frequency starts if it is to run until nothing changes.
_START_HZ: Final = 4000.0


def zener_parameters(components: Array) -> Array:
    """E1, E2, E3, G1, G2, G3 of reeds after hypothesis H4, in MPa and MPa·s.

    Parameters
    ----------
    components : (n, 4) float
        e1…e4.

    Returns
    -------
    (n, 2, 6) float
        In series A and B.
    """
    matrices = np.stack([h4_matrix(series) for series in Series])
    extended = np.column_stack([np.ones(len(components)), components])
    return np.asarray(np.einsum("sij,nj->nsi", matrices, extended))


def physical(components: Array) -> NDArray[np.bool_]:
    """Whether all springs of each reed are positive in both series, (n,)."""
    return np.asarray((zener_parameters(components)[..., _SPRINGS] > 0).all(axis=(1, 2)))


def draw_components(n: int, rng: np.random.Generator, *, orthonormal: bool = False) -> Array:
    """Components e1…e4 of n reeds from N(0, 1), (n, 4); reeds outside physics are drawn again.

    Parameters
    ----------
    orthonormal : bool
        Whether they are made to satisfy the paper's Eq. eq.ortho as its own sample does: mean 0,
        standard deviation 1, uncorrelated.

    Raises
    ------
    ValueError
        For orthonormal components of fewer than five reeds.
    """
    drawn = rng.standard_normal((n, 4))
    while True:
        components: Array = factors.orthonormal(drawn) if orthonormal else drawn
        outside = ~physical(components)
        if not outside.any():
            return components
        drawn[outside] = rng.standard_normal((np.count_nonzero(outside), 4))


def modal_cents(components: Array, metamodel: Metamodel, *, passes: int | None = None) -> Array:
    """Frequencies of reeds after hypothesis H4, moduli taken at each mode's own frequency.

    Parameters
    ----------
    components : (n, 4) float
    metamodel : Metamodel
        Of m modes.
    passes : int, optional
        How often the moduli are computed again at the resulting frequencies; the paper did it once.
        Without, until nothing changes.

    Returns
    -------
    (n, 2, m) float
        Cents above F6 in series A and B.

    Raises
    ------
    ValueError
        For a reed outside physics, and for passes where Table 1 has no mean of a mode.
    RuntimeError
        Without convergence.
    """
    outside = np.flatnonzero(~physical(components))
    if outside.size:
        raise ValueError(
            f"reed {outside[0]} has a spring that is not positive: no material is like that; "
            "take components from draw_components"
        )
    parameters = zener_parameters(components)[:, :, None]

    def computed_hz(hz: Array) -> Array:
        E, G = _storage_pa(parameters[..., :3], hz), _storage_pa(parameters[..., 3:], hz)
        return hz_of(metamodel.evaluate(E, G)[0])

    shape = len(components), 2, len(metamodel.modes)
    if passes is None:
        start = np.full(shape, _START_HZ)
        return cents_of(fixed_point(computed_hz, start, xtol=1e-9, maxiter=50))
    hz = np.broadcast_to(_means_hz(metamodel.modes), shape)
    for _ in range(passes):
        hz = computed_hz(hz)
    return cents_of(hz)


def _storage_pa(zener: Array, hz: Array) -> Array:
    value_mpa = storage_modulus(zener[..., 0], zener[..., 1], zener[..., 2], hz).value_mpa
    return 1e6 * value_mpa


def _means_hz(modes: Sequence[str]) -> Array:
    unknown = [name for name in modes if name not in paper.MEAN_HZ]
    if unknown:
        raise ValueError(
            f"Table 1 has no mean of {', '.join(unknown)} to start passes from; iterate until "
            "nothing changes (passes=None)"
        )
    return np.array([paper.MEAN_HZ[name] for name in modes], dtype=float).T


def observe(
    components: Array,
    metamodel: Metamodel,
    rng: np.random.Generator,
    *,
    noise_cents: float | Array = 0.0,
    grid_cents: float | None = GRID_CENTS,
    identified: Mapping[str, tuple[int, int]] | None = None,
    passes: int | None = None,
) -> Array:
    """Resonances of reeds as the paper's sweep finds them.

    Parameters
    ----------
    components : (n, 4) float
    metamodel : Metamodel
        Of m modes.
    noise_cents : float or array that broadcasts to (2, m)
        Standard deviation of what the model does not know, independent for each resonance.
    grid_cents : float, optional
        Step of the sweep, to which resonances are rounded; None for a sweep without steps. The
        grid has no ends.
    identified : mapping of mode to (int, int), optional
        On how many of 55 reeds each mode is found in series A and B, see `IDENTIFIED`; of n reeds
        it is the same fraction. Which reeds those are is left to chance. Without, all are found.
    passes : int, optional
        See `modal_cents`.

    Returns
    -------
    (n, 2, m) float
        Cents above F6, NaN where not found.

    Raises
    ------
    ValueError
        As `modal_cents`; for a step that is not positive; for a mode that `identified` lacks.
    """
    cents = modal_cents(components, metamodel, passes=passes)
    cents = cents + noise_cents * rng.standard_normal(cents.shape)
    if grid_cents is not None:
        if not grid_cents > 0:
            raise ValueError(f"a sweep of {grid_cents} cents a step; give a positive step or None")
        cents = grid_cents * np.round(cents / grid_cents)
    if identified is None:
        return cents
    return np.where(_found(cents.shape, metamodel.modes, identified, rng), cents, np.nan)


def _found(
    shape: tuple[int, ...],
    modes: Sequence[str],
    identified: Mapping[str, tuple[int, int]],
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    unknown = [name for name in modes if name not in identified]
    if unknown:
        raise ValueError(f"identified lacks {', '.join(unknown)}; say how often they are found")
    counts = np.array([identified[name] for name in modes]).T
    places = np.broadcast_to(np.arange(shape[0])[:, None, None], shape)
    return np.asarray(rng.permuted(places, axis=0) < np.round(counts * shape[0] / REEDS))


def variable_names(modes: Sequence[str]) -> tuple[str, ...]:
    """Names of the columns of observations reshaped to (n, 2m): AF1, AT1, … BF1, BT1, and so on."""
    return tuple(f"{series}{name}" for series in Series for name in modes)


@dataclass(frozen=True)
class FractionStatistics:
    """Shares of variance of k factors over several populations.

    Attributes
    ----------
    mean, sd : (k,) float
        Of each factor's fraction.
    sum_mean, sum_sd : float
        Of what all together explain.
    """

    mean: Array
    sd: Array
    sum_mean: float
    sum_sd: float


@dataclass(frozen=True)
class BackwardValidation:
    """Factors of random populations (paper, "Backward random validation").

    Attributes
    ----------
    principal : FractionStatistics
        Of principal components.
    rotated : FractionStatistics
        After VARIMAX rotation of variables and components, as in the paper's Table 2.
    """

    principal: FractionStatistics
    rotated: FractionStatistics


def backward_validation(
    metamodel: Metamodel,
    rng: np.random.Generator,
    *,
    noise_cents: float | Array,
    grid_cents: float | None = GRID_CENTS,
    populations: int = 10,
    reeds: int = REEDS,
    count: int = 4,
    passes: int | None = None,
) -> BackwardValidation:
    """Principal components of populations drawn from N(0, 1), with the paper's variables.

    The variables are those that Table 1 has on all 55 reeds, as far as the metamodel has the mode.
    Without noise four factors explain all but a percent. The printed fractions are similar to those
    after rotation here, and different from those of principal components.

    Parameters
    ----------
    noise_cents, grid_cents, passes
        See `observe`.
    populations, reeds, count : int
        Ten populations of 55 reeds and four factors in the paper.

    Raises
    ------
    ValueError
        For fewer than two populations, and as `modal_cents` and `factors.principal_factors`.
    """
    if populations < 2:
        raise ValueError(f"{populations} populations have no spread; ask for 2 or more")
    complete = np.array([IDENTIFIED.get(name, (0, 0)) for name in metamodel.modes]).T == REEDS
    principal, rotated = [], []
    for _ in range(populations):
        components = draw_components(reeds, rng)
        cents = observe(
            components,
            metamodel,
            rng,
            noise_cents=noise_cents,
            grid_cents=grid_cents,
            passes=passes,
        )
        found = factors.principal_factors(cents[:, complete], count)
        principal.append(found.fractions)
        rotated.append(factors.varimax_factors(found, components).fractions)
    return BackwardValidation(_fraction_statistics(principal), _fraction_statistics(rotated))


def _fraction_statistics(fractions: Sequence[Array]) -> FractionStatistics:
    each, total = np.array(fractions), np.sum(fractions, axis=1)
    return FractionStatistics(
        mean=each.mean(axis=0),
        sd=each.std(axis=0, ddof=1),
        sum_mean=float(total.mean()),
        sum_sd=float(total.std(ddof=1)),
    )


@dataclass(frozen=True)
class SyntheticModeStatistics:
    """Statistics of each mode in each series (paper, Table 1); arrays (2, m), NaN if not found.

    Attributes
    ----------
    identified : (2, m) int
    mean, sd, minimum, maximum : (2, m) float
        In the unit of the observations; sd with N - 1.
    """

    identified: NDArray[np.intp]
    mean: Array
    sd: Array
    minimum: Array
    maximum: Array


def mode_statistics(observed: Array) -> SyntheticModeStatistics:
    """Statistics of observations (n, 2, m) of any unit; Table 1 has them in Hz."""
    known = np.ma.masked_invalid(observed)
    identified = np.isfinite(observed).sum(axis=0)
    deviations = (known - known.mean(axis=0)) ** 2
    spread = np.ma.sqrt(deviations.sum(axis=0) / np.ma.masked_less(identified - 1, 1))
    return SyntheticModeStatistics(
        identified=identified,
        mean=_filled(known.mean(axis=0)),
        sd=_filled(spread),
        minimum=_filled(known.min(axis=0)),
        maximum=_filled(known.max(axis=0)),
    )


def _filled(masked: Any) -> Array:
    return np.asarray(np.ma.filled(masked, np.nan), dtype=float)


def series_correlations(observed: Array) -> Array:
    """Correlation of each mode's series A with its series B, (m,); NaN with fewer than 3 reeds."""
    return np.diagonal(factors.correlations(observed[:, 0], observed[:, 1])).copy()


def mode_correlations(observed: Array) -> Array:
    """Correlations between modes within series A and within series B, (2, m, m)."""
    return np.stack([factors.correlations(one, one) for one in np.moveaxis(observed, 1, 0)])


def flexural_correlations(observed: Array, modes: Sequence[str]) -> dict[str, float]:
    """Correlations between flexural modes within a series, by pair: ``{"AF2/AF1": 0.73, …}``."""
    flexural = [name for name in modes if name.startswith("F")]
    tables = zip(Series, mode_correlations(observed), strict=True)
    return {
        f"{series}{high}/{series}{low}": float(table[modes.index(high), modes.index(low)])
        for series, table in tables
        for low, high in combinations(flexural, 2)
    }
