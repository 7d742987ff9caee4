"""Fit the components of thousands of reeds at once by weighted least squares.

Every reed is its own small problem, hypothesis H4 → Zener storage moduli → metamodel, solved by
damped Gauss-Newton steps with exact derivatives (see `fitting.populations.gauss_newton`).
"""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import fields
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray

from fitting.cane.excess_scatter import added_cents, is_misfit
from fitting.errors import FitInputError
from fitting.populations.flags import (
    SPRING_FLAGS,
    BoundedMetamodel,
    Flag,
    FollowingMetamodel,
    PopulationFit,
)
from fitting.populations.gauss_newton import (
    SERIES_COMPONENTS,
    Best,
    PopulationProblem,
    gauss_newton,
    problem_of,
    regularised,
    storage_moduli,
    zener_mpa,
)
from holography.arrays import Array, Mask
from physics.reed.reduction.metamodel import Metamodel

# Reeds in a block: few enough that its arrays stay in the processor's cache.
_BLOCK = 512
# Evaluations after which four reeds of five have converged; the others are collected and restarted.
_FEW_EVALUATIONS, _MOST_EVALUATIONS = 4, 40
# A component is undetermined if its variance is this many times that of the best known one.
_UNKNOWN = 1e8
# Most iterations of the excess scatter, and relative change at which they end.
_MISFIT_TURNS, _MISFIT_SETTLED = 8, 1e-3


def fit_population(
    observed_cents: Array, error_cents: Array | float, metamodel: Metamodel
) -> PopulationFit:
    """Fit the components of many reeds by weighted least squares.

    A reed's result does not depend on the other reeds, to the last bit. Modes that the metamodel
    does not follow at the fitted moduli (see `FollowingMetamodel`) are left out, and the reed is
    fitted again. A reed whose χ² is too large is fitted again with an excess scatter added to the
    error of every resonance (see `fitting.cane.excess_scatter.added_cents`).

    Parameters
    ----------
    observed_cents : (n, s, m) float
        Resonances in cents above F6, NaN where missing: series A (s = 1), or A and B (s = 2), of
        the metamodel's m modes.
    error_cents : float or array that broadcasts to (n, s, m)
        Standard errors.
    metamodel : Metamodel

    Raises
    ------
    FitInputError
        For another shape, for infinite resonances, and for errors that are not positive.
    """
    observed = np.asarray(observed_cents, dtype=float)
    errors = _checked_errors(observed, error_cents, metamodel)
    # Steps that overflow are undone because of their χ².
    with np.errstate(all="ignore"):
        problem = problem_of(metamodel, observed.shape[1])
        fit = _fit_all(problem, observed, errors)
        changed = np.flatnonzero(fit.left_out.any(axis=(1, 2)))
        if changed.size:
            left_out = fit.left_out[changed]
            again = _fit_all(
                problem, np.where(left_out, np.nan, observed[changed]), errors[changed]
            )
            # Modes are left out once, by the moduli of the first fit.
            again.left_out[...], again.flags[...] = left_out, again.flags | Flag.MODES_LEFT_OUT
            _put(again, fit, changed)
        _add_misfits(problem, fit, observed, errors)
    return fit


def fit_stream(
    chunks: Iterable[Array],
    error_cents: Array | float,
    metamodel: Metamodel,
    workers: int = 2,
) -> Iterator[PopulationFit]:
    """Fit a population too large for memory, some thousands of reeds at a time.

    Worker processes divide the work (threads would wait for each other between the short array
    operations). At most two chunks per worker are in memory. The fits come in the order of the
    chunks; they depend neither on the size of the chunks nor on the number of workers.

    Parameters
    ----------
    chunks : iterable of (n, s, m) float
        See `fit_population`; n may differ from chunk to chunk.
    error_cents : float or array that broadcasts to every chunk
    metamodel : Metamodel
        Must be picklable with more than one worker.
    workers : int
        Number of processes; 1 means this process only. With more, a script must be guarded by
        ``if __name__ == "__main__"``, because the workers import it.

    Raises
    ------
    FitInputError
        For fewer workers than one, and as `fit_population`.
    """
    if workers < 1:
        raise FitInputError(f"{workers} workers fit nothing; give at least 1")
    if workers == 1:
        for chunk in chunks:
            yield fit_population(chunk, error_cents, metamodel)
        return
    pending: deque[Future[PopulationFit]] = deque()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        try:
            for chunk in chunks:
                pending.append(pool.submit(fit_population, chunk, error_cents, metamodel))
                if len(pending) == 2 * workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


def _checked_errors(observed: Array, error_cents: Array | float, metamodel: Metamodel) -> Array:
    """Broadcast the errors to the observations."""
    modes = len(metamodel.modes)
    if (
        observed.ndim != 3
        or observed.shape[1] not in SERIES_COMPONENTS
        or observed.shape[2] != modes
    ):
        raise FitInputError(
            f"resonances of shape {observed.shape} are no population; give (reeds, series, modes) "
            f"with series A, or A and B, and the metamodel's {modes} modes"
        )
    if np.isinf(observed).any():
        raise FitInputError("resonances at infinite cents; mark what is missing by NaN")
    try:
        errors = np.broadcast_to(np.asarray(error_cents, dtype=float), observed.shape)
    except ValueError:
        raise FitInputError(
            f"errors of shape {np.shape(error_cents)} do not broadcast to resonances of shape "
            f"{observed.shape}; give one for all, or one per series and mode"
        ) from None
    if not (np.isnan(observed) | ((errors > 0) & np.isfinite(errors))).all():
        raise FitInputError(
            "some resonance has an error that is not positive and finite; "
            "mark the resonance as missing by NaN, or state its error in cents"
        )
    return errors


def _in_blocks(reeds: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Divide the numbers of reeds into blocks; the last may be short."""
    for start in range(0, len(reeds), _BLOCK):
        yield reeds[start : start + _BLOCK]


def _fit_all(problem: PopulationProblem, observed: Array, errors: Array) -> PopulationFit:
    """Fit all reeds in few evaluations, then those that have not converged in more."""
    fit = _unknown(observed, problem.count)
    enough = np.flatnonzero(fit.used > problem.count)
    slow = [
        reeds[~_fit_reeds(problem, observed, errors, reeds, _FEW_EVALUATIONS, fit)]
        for reeds in _in_blocks(enough)
    ]
    for reeds in _in_blocks(np.concatenate([*slow, enough[:0]])):
        _fit_reeds(problem, observed, errors, reeds, _MOST_EVALUATIONS, fit)
    return fit


def _put(some: PopulationFit, all_of_them: PopulationFit, reeds: NDArray[np.int64]) -> None:
    """Copy the fits of some reeds into the fits of all."""
    for field in fields(PopulationFit):
        getattr(all_of_them, field.name)[reeds] = getattr(some, field.name)[: len(reeds)]


def _fit_reeds(
    problem: PopulationProblem,
    observed: Array,
    errors: Array,
    reeds: NDArray[np.int64],
    evaluations: int,
    fit: PopulationFit,
) -> Mask:
    """Fit up to a block of reeds, write the results into `fit`, and return which have converged."""
    # Always a full block: the order of summation, and so the last bit, depends on the shape.
    padded = np.pad(reeds, (0, _BLOCK - len(reeds)), mode="edge")
    cents = np.ascontiguousarray(observed[padded].transpose(2, 1, 0))
    weights = np.ascontiguousarray(errors[padded].transpose(2, 1, 0))
    missing = np.isnan(cents)
    cents[missing], weights[missing] = 0.0, np.inf
    np.reciprocal(weights, out=weights)
    best = gauss_newton(problem, cents, weights, evaluations)
    _put(_conclude(problem, best, cents, weights), fit, reeds)
    return best.settled[: len(reeds)]


def _conclude(
    problem: PopulationProblem, best: Best, observed: Array, weights: Array
) -> PopulationFit:
    """Compute components, errors and flags of a block of reeds."""
    used = weights > 0
    # The last step of converged reeds is taken without another evaluation.
    components = best.components + np.where(best.settled, best.step, 0.0)
    cents = best.cents + np.where(best.settled, best.shift, 0.0)
    variance = np.einsum("nkk->kn", np.linalg.inv(regularised(best.normal)))
    scale = np.einsum("kkn->kn", best.normal).max(axis=0)
    known = variance * scale < _UNKNOWN
    number = np.count_nonzero(used, axis=(0, 1))
    freedom = number - np.count_nonzero(known, axis=0)
    residual = np.where(used, observed - cents, 0.0)
    reduced_chi2 = np.einsum("msn->n", (weights * residual) ** 2) / freedom
    zener = zener_mpa(problem.matrices, components)
    storage_pa = tuple(1e6 * modulus.value_mpa for modulus in storage_moduli(zener, cents))
    flags = _moduli_flags(problem.metamodel, zener, storage_pa, used)
    flags |= np.where(known.all(axis=0), 0, Flag.UNDETERMINED)
    flags |= np.where(best.settled, 0, Flag.NOT_CONVERGED)
    return PopulationFit(
        components=np.where(known, components, np.nan).T,
        errors=np.where(known, np.sqrt(variance), np.inf).T,
        reduced_chi2=reduced_chi2,
        excess_scatter_cents=np.zeros(len(number)),
        residual_cents=np.where(used, residual, np.nan).T,
        rms_cents=np.sqrt(np.einsum("msn->n", residual**2) / number),
        used=number,
        left_out=(used & ~_followed(problem.metamodel, storage_pa)).T,
        flags=flags,
    )


def _followed(metamodel: Metamodel, storage_pa: tuple[Array, ...]) -> Mask:
    """Return whether the metamodel follows the modes at moduli E', G' of shape (m, s, n)."""
    if not isinstance(metamodel, FollowingMetamodel):
        return np.ones(storage_pa[0].shape, dtype=bool)
    E_pa, G_pa = (np.moveaxis(modulus, 0, -1) for modulus in storage_pa)
    return np.moveaxis(metamodel.follows(E_pa, G_pa), -1, 0)


def _moduli_flags(
    metamodel: Metamodel, zener: Array, storage_pa: tuple[Array, ...], used: Mask
) -> NDArray[np.int64]:
    """Return flags (n,) for springs (6, s, n), storage moduli (m, s, n) and metamodel limits."""
    flags = np.zeros(zener.shape[-1], dtype=np.int64)
    measured = used.any(axis=0)
    for row, flag in SPRING_FLAGS:
        flags |= np.where(((zener[row] <= 0) & measured).any(axis=0), flag, 0)
    E, G = storage_pa
    impossible = ~((E > 0) & (G > 0)) & measured
    flags |= np.where(impossible.any(axis=(0, 1)), Flag.STORAGE_MODULUS_NOT_POSITIVE, 0)
    if isinstance(metamodel, BoundedMetamodel):
        outside = ~metamodel.within(E, G) & used
        flags |= np.where(outside.any(axis=(0, 1)), Flag.OUTSIDE_METAMODEL, 0)
    return flags


def _add_misfits(
    problem: PopulationProblem, fit: PopulationFit, observed: Array, errors: Array
) -> None:
    """Fit reeds whose χ² is too large again, with an excess scatter added to their errors."""
    freedom = fit.used - np.count_nonzero(np.isfinite(fit.components), axis=1)
    reduced_chi2 = fit.reduced_chi2.copy()
    reeds = np.flatnonzero(is_misfit(reduced_chi2, freedom))
    for _ in range(_MISFIT_TURNS):
        if not reeds.size:
            break
        residual = fit.residual_cents[reeds]
        before = fit.excess_scatter_cents[reeds]
        misfit = added_cents(
            residual.reshape(len(reeds), -1), errors[reeds].reshape(len(reeds), -1), freedom[reeds]
        )
        whole = np.hypot(errors[reeds], misfit[:, None, None])
        again = _fit_all(problem, np.where(np.isnan(residual), np.nan, observed[reeds]), whole)
        left_out = fit.left_out[reeds]
        again.flags[...] |= np.where(left_out.any(axis=(1, 2)), Flag.MODES_LEFT_OUT, 0)
        again.left_out[...], again.excess_scatter_cents[...] = left_out, misfit
        again.reduced_chi2[...] = reduced_chi2[reeds]
        _put(again, fit, reeds)
        reeds = reeds[np.abs(misfit - before) > _MISFIT_SETTLED * misfit]


def _unknown(observed: Array, count: int) -> PopulationFit:
    """Return the results of reeds that were not fitted."""
    n = len(observed)
    return PopulationFit(
        components=np.full((n, count), np.nan),
        errors=np.full((n, count), np.inf),
        reduced_chi2=np.full(n, np.nan),
        excess_scatter_cents=np.full(n, np.nan),
        residual_cents=np.full(observed.shape, np.nan),
        rms_cents=np.full(n, np.nan),
        used=np.count_nonzero(~np.isnan(observed), axis=(1, 2)),
        left_out=np.zeros(observed.shape, dtype=bool),
        flags=np.full(n, int(Flag.TOO_FEW_RESONANCES)),
    )
