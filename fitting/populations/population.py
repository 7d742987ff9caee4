"""Components of whole populations of reeds: the least squares of thousands of reeds at once.

Every reed is its own small problem, hypothesis H4 → Zener storage moduli → metamodel, solved by
Gauss-Newton steps with exact derivatives. Reeds lie side by side in the last axis of all arrays,
so that each operation serves a block of them.

A mode has the moduli of its own frequency: its cents c solve ``c = f(ln E'(p, c), ln G'(p, c))``.
With ``κ = ∂f/∂c`` the solution follows the components p as ``dc/dp = (∂f/∂p) / (1 - κ)`` (implicit
function theorem), and Newton's correction of a c that does not solve it is ``(f - c) / (1 - κ)``.
A look at a reed makes one such correction: c comes with the step predicted by dc/dp, so that its
error is of fourth order in the step.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, fields
from functools import reduce
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitInputError
from fitting.modal.excess_scatter import added_cents, is_misfit
from fitting.populations.flags import (
    SPRING_FLAGS,
    BoundedMetamodel,
    Flag,
    FollowingMetamodel,
    PopulationFit,
)
from physics.reed.metamodel import REFERENCE_HZ, Metamodel
from physics.reed.viscoelastic import (
    Series,
    StorageModulus,
    h4_matrix,
    storage_modulus,
)

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

# Components that one series, or both, can tell apart (see `fitting.cane.reed_fit`).
_COMPONENTS = {1: 3, 2: 4}
# Reeds worked on at once: few enough that a block's arrays stay in the processor's cache.
_BLOCK = 512
# Looks after which four reeds of five are settled; the others are collected and begun again.
_FEW_LOOKS, _MOST_LOOKS = 4, 40
# A step this short, in standard errors, is the last: what it leaves is a hundredth of it.
_SHORT_STEP = 0.01
# No step moves an observed mode farther than this: what one correction leaves of the error of the
# prediction is then far below a cent.
_FARTHEST_STEP_CENTS = 150.0
# A step that leads astray is cut to this part of itself.
_CUT = 0.25
_ROUNDING = 1e-9
# Frequencies of the mean reed start here and settle in as many corrections.
_START_CENTS, _START_LOOKS = 2400.0, 10
# At moduli that no mode can have, the metamodel is asked for these; the answer is not used.
_HARMLESS_PA = (1e10, 1e9)
# Keeps the normal matrix regular where it is not; a component whose variance is this many times
# that of the best known one is not known at all.
_RIDGE, _UNKNOWN = 1e-12, 1e8
# Turns in which a misfit settles, to this share.
_MISFIT_TURNS, _MISFIT_SETTLED = 8, 1e-3
_CENT = np.log(2) / 1200


def fit_population(
    observed_cents: Array, error_cents: Array | float, metamodel: Metamodel
) -> PopulationFit:
    """Fit the components of many reeds by weighted least squares.

    A reed's result does not depend on the others, to the last bit. Modes that the metamodel does
    not follow at the moduli found (see `FollowingMetamodel`) are left out, and the reed is fitted
    anew. So are reeds that the errors do not explain, with a misfit added to the error of every
    resonance (see `misfit.added_cents`).

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
    # Trials that overflow are refused by their χ².
    with np.errstate(all="ignore"):
        problem = _problem(metamodel, observed.shape[1])
        fit = _fit_all(problem, observed, errors)
        changed = np.flatnonzero(fit.left_out.any(axis=(1, 2)))
        if changed.size:
            left_out = fit.left_out[changed]
            again = _fit_all(
                problem, np.where(left_out, np.nan, observed[changed]), errors[changed]
            )
            # What is left out is said once: at the moduli found without it.
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

    Worker processes share the work (threads would wait for each other between the short array
    operations). At most two chunks a worker are held; the fits come in the order of the chunks
    and do not depend on how the reeds are cut into chunks, nor on the number of workers.

    Parameters
    ----------
    chunks : iterable of (n, s, m) float
        See `fit_population`; n may differ from chunk to chunk.
    error_cents : float or array that broadcasts to every chunk
    metamodel : Metamodel
        Must be picklable with more than one worker.
    workers : int
        Processes; with 1 the work is done in this one. With more, a script must keep what it does
        behind ``if __name__ == "__main__"``: its workers import it.

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
    """Errors broadcast to the observations."""
    modes = len(metamodel.modes)
    if observed.ndim != 3 or observed.shape[1] not in _COMPONENTS or observed.shape[2] != modes:
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


@dataclass(frozen=True)
class _Look:
    """Frequencies of n reeds at given components, and how they follow them.

    Attributes
    ----------
    cents : (m, s, n) float
    slopes : K arrays of (m, s, n) float
        Derivatives with respect to the components.
    possible : (m, s, n) bool
        Whether the mode has moduli that a mode can have.
    """

    cents: Array
    slopes: tuple[Array, ...]
    possible: Mask


@dataclass(frozen=True)
class _Problem:
    """What all reeds share.

    Attributes
    ----------
    metamodel : Metamodel
    matrices : (6, s, 1 + K) float
        From (1, e1 … eK) to (E1, E2, E3, G1, G2, G3), see `h4_matrix`.
    start : _Look
        At the mean reed, with n = 1.
    """

    metamodel: Metamodel
    matrices: Array
    start: _Look

    @property
    def count(self) -> int:
        """Components K."""
        return len(self.start.slopes)


def _problem(metamodel: Metamodel, series: int) -> _Problem:
    count = _COMPONENTS[series]
    matrices = np.stack([h4_matrix(s)[:, : 1 + count] for s in list(Series)[:series]], axis=1)
    cents = np.full((len(metamodel.modes), series, 1), _START_CENTS)
    for _ in range(_START_LOOKS):
        look = _look(metamodel, matrices, np.zeros((count, 1)), cents)
        cents = look.cents
    return _Problem(metamodel, matrices, look)


def _zener(matrices: Array, components: Array) -> Array:
    """E1, E2, E3, G1, G2, G3 in MPa and MPa·s, (6, s, n), of components (K, n)."""
    # Added one by one: a matrix product's last bit may depend on the place of a reed in its block.
    zener = matrices[..., :1]
    for k, component in enumerate(components, start=1):
        zener = zener + matrices[..., k, None] * component
    return zener


def _storage_moduli(zener: Array, cents: Array) -> tuple[StorageModulus, StorageModulus]:
    """E' and G' in MPa at frequencies (m, s, n)."""
    hz = REFERENCE_HZ * np.exp2(cents / 1200)
    E1, E2, E3, G1, G2, G3 = zener
    return storage_modulus(E1, E2, E3, hz), storage_modulus(G1, G2, G3, hz)


def _look(metamodel: Metamodel, matrices: Array, components: Array, cents: Array) -> _Look:
    """Look at reeds with components (K, n) whose frequencies are about `cents`, (m, s, n)."""
    E, G = _storage_moduli(_zener(matrices, components), cents)
    E_pa, G_pa = 1e6 * E.value_mpa, 1e6 * G.value_mpa
    possible = (E_pa > 0) & (G_pa > 0)
    if not possible.all():
        E_pa[~possible], G_pa[~possible] = _HARMLESS_PA
    f, by_E, by_G = _evaluate(metamodel, E_pa, G_pa)
    by_E, by_G = 1e6 * by_E / E_pa, 1e6 * by_G / G_pa
    by_itself = _CENT * (by_E * E.by_ln_frequency_mpa + by_G * G.by_ln_frequency_mpa)
    corrected = cents + (f - cents) / (1 - by_itself)
    by_E, by_G = by_E / (1 - by_itself), by_G / (1 - by_itself)
    by_parameters = (
        *(by_E, by_E * E.by_arm_spring, by_E * E.by_arm_dashpot_per_s),
        *(by_G, by_G * G.by_arm_spring, by_G * G.by_arm_dashpot_per_s),
    )
    if not possible.all():
        # What is not possible is not used, but must not make NaN of what is.
        corrected[~possible] = f[~possible]
        for slope in by_parameters:
            slope[~possible] = 0.0
    return _Look(corrected, _by_components(matrices, by_parameters), possible)


def _evaluate(metamodel: Metamodel, E_pa: Array, G_pa: Array) -> tuple[Array, ...]:
    """Metamodel at moduli (m, s, n): cents and slopes of that shape."""
    results = metamodel.evaluate(np.moveaxis(E_pa, 0, -1), np.moveaxis(G_pa, 0, -1))
    return tuple(np.moveaxis(result, -1, 0) for result in results)


def _by_components(matrices: Array, by_parameters: tuple[Array, ...]) -> tuple[Array, ...]:
    """Slopes with respect to each component from those with respect to E1 … G3."""
    slopes = []
    for column in np.moveaxis(matrices, -1, 0)[1:]:
        moved = (row for row in range(len(by_parameters)) if column[row].any())
        slopes.append(reduce(np.add, (column[row][:, None] * by_parameters[row] for row in moved)))
    return tuple(slopes)


@dataclass(frozen=True)
class _Best:
    """The best that was seen of each of the n reeds of a block, and the step that it suggests.

    Attributes
    ----------
    components, step : (K, n) float
    cents, shift : (m, s, n) float
        Frequencies, and their change with the step.
    normal : (K, K, n) float
    chi2 : (n,) float
    settled : (n,) bool
        Whether the step is too short to be worth another look.
    """

    components: Array
    step: Array
    cents: Array
    shift: Array
    normal: Array
    chi2: Array
    settled: Mask


def _least_squares(problem: _Problem, observed: Array, weights: Array, looks: int) -> _Best:
    """Damped Gauss-Newton steps for a block of reeds, (m, s, n) each.

    A step is cut short until the fit improves and every observed mode has possible moduli.
    """
    size, used = observed.shape[-1], weights > 0
    mean = np.zeros((problem.count, size))
    best, reach = _step_from(mean, _spread(problem.start, size), observed, weights), np.ones(size)
    for _ in range(looks - 1):
        if best.settled.all():
            break
        farthest = np.where(used, np.abs(best.shift), 0.0).max(axis=(0, 1))
        part = reach * np.minimum(1.0, _FARTHEST_STEP_CENTS / farthest)
        trial = best.components + part * best.step
        cents = best.cents + part * best.shift
        look = _look(problem.metamodel, problem.matrices, trial, cents)
        found = _step_from(trial, look, observed, weights)
        # Comparisons with NaN are false: what overflowed is no improvement.
        better = found.chi2 <= best.chi2 * (1 + _ROUNDING) + _ROUNDING
        better &= (look.possible | ~used).all(axis=(0, 1)) & ~best.settled
        for field in fields(_Best):
            np.copyto(getattr(best, field.name), getattr(found, field.name), where=better)
        reach = np.where(better, 1.0, _CUT * reach)
    return best


def _spread(look: _Look, size: int) -> _Look:
    """One reed's look as that of many."""
    return _Look(
        np.repeat(look.cents, size, axis=-1),
        tuple(np.repeat(slope, size, axis=-1) for slope in look.slopes),
        np.repeat(look.possible, size, axis=-1),
    )


def _step_from(components: Array, look: _Look, observed: Array, weights: Array) -> _Best:
    """χ², normal equations and their solution at given components."""
    residual = weights * (observed - look.cents)
    weighted = [weights * slope for slope in look.slopes]
    count, size = components.shape
    normal, gradient = np.empty((count, count, size)), np.empty((count, size))
    for k in range(count):
        gradient[k] = np.einsum("msn,msn->n", weighted[k], residual)
        for j in range(k + 1):
            normal[k, j] = normal[j, k] = np.einsum("msn,msn->n", weighted[k], weighted[j])
    step = np.linalg.solve(_regular(normal), gradient.T[..., None])[..., 0].T
    chi2 = np.einsum("msn,msn->n", residual, residual)
    # In standard errors as a misfit makes them.
    misfit = np.maximum(1.0, chi2 / (np.count_nonzero(weights, axis=(0, 1)) - count))
    squared_length = np.einsum("kn,kn->n", step, gradient)
    return _Best(
        components=components,
        step=step,
        cents=look.cents,
        shift=reduce(np.add, (slope * s for slope, s in zip(look.slopes, step, strict=True))),
        normal=normal,
        chi2=chi2,
        settled=squared_length <= _SHORT_STEP**2 * misfit,
    )


def _regular(normal: Array) -> Array:
    """Normal matrices (K, K, n) as (n, K, K) that can be inverted."""
    count = len(normal)
    scale = np.einsum("kkn->kn", normal).max(axis=0)
    usable = np.isfinite(normal).all(axis=(0, 1)) & (scale > 0)
    ridge = np.where(usable, _RIDGE * scale, 1.0)
    matrices = np.moveaxis(np.where(usable, normal, 0.0), -1, 0)
    return np.asarray(matrices + ridge[:, None, None] * np.eye(count))


def _in_blocks(reeds: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Cut the numbers of reeds into blocks, the last of which may be short."""
    for start in range(0, len(reeds), _BLOCK):
        yield reeds[start : start + _BLOCK]


def _fit_all(problem: _Problem, observed: Array, errors: Array) -> PopulationFit:
    """Fit reeds, most of them in a few looks and the others from the beginning again."""
    fit = _unknown(observed, problem.count)
    enough = np.flatnonzero(fit.used > problem.count)
    slow = [
        reeds[~_fit_reeds(problem, observed, errors, reeds, _FEW_LOOKS, fit)]
        for reeds in _in_blocks(enough)
    ]
    for reeds in _in_blocks(np.concatenate([*slow, enough[:0]])):
        _fit_reeds(problem, observed, errors, reeds, _MOST_LOOKS, fit)
    return fit


def _put(some: PopulationFit, all_of_them: PopulationFit, reeds: NDArray[np.int64]) -> None:
    """Write the fits of some reeds into their places among all."""
    for field in fields(PopulationFit):
        getattr(all_of_them, field.name)[reeds] = getattr(some, field.name)[: len(reeds)]


def _fit_reeds(
    problem: _Problem,
    observed: Array,
    errors: Array,
    reeds: NDArray[np.int64],
    looks: int,
    fit: PopulationFit,
) -> Mask:
    """Fit up to a block of reeds into their places in `fit`, and say which of them are settled."""
    # Always a full block: how an array is summed, and so its last bit, depends on its shape.
    padded = np.pad(reeds, (0, _BLOCK - len(reeds)), mode="edge")
    cents = np.ascontiguousarray(observed[padded].transpose(2, 1, 0))
    weights = np.ascontiguousarray(errors[padded].transpose(2, 1, 0))
    missing = np.isnan(cents)
    cents[missing], weights[missing] = 0.0, np.inf
    np.reciprocal(weights, out=weights)
    best = _least_squares(problem, cents, weights, looks)
    _put(_conclude(problem, best, cents, weights), fit, reeds)
    return best.settled[: len(reeds)]


def _conclude(problem: _Problem, best: _Best, observed: Array, weights: Array) -> PopulationFit:
    """Components with errors and flags of a block of reeds."""
    used = weights > 0
    # The last step of those that are settled was not worth a look, but it is worth taking.
    components = best.components + np.where(best.settled, best.step, 0.0)
    cents = best.cents + np.where(best.settled, best.shift, 0.0)
    variance = np.einsum("nkk->kn", np.linalg.inv(_regular(best.normal)))
    scale = np.einsum("kkn->kn", best.normal).max(axis=0)
    known = variance * scale < _UNKNOWN
    number = np.count_nonzero(used, axis=(0, 1))
    freedom = number - np.count_nonzero(known, axis=0)
    residual = np.where(used, observed - cents, 0.0)
    reduced_chi2 = np.einsum("msn->n", (weights * residual) ** 2) / freedom
    zener = _zener(problem.matrices, components)
    storage_pa = tuple(1e6 * modulus.value_mpa for modulus in _storage_moduli(zener, cents))
    flags = _moduli_flags(problem.metamodel, zener, storage_pa, used)
    flags |= np.where(known.all(axis=0), 0, Flag.UNDETERMINED)
    flags |= np.where(best.settled, 0, Flag.NOT_CONVERGED)
    return PopulationFit(
        components=np.where(known, components, np.nan).T,
        errors=np.where(known, np.sqrt(variance), np.inf).T,
        reduced_chi2=reduced_chi2,
        misfit_cents=np.zeros(len(number)),
        residual_cents=np.where(used, residual, np.nan).T,
        rms_cents=np.sqrt(np.einsum("msn->n", residual**2) / number),
        used=number,
        left_out=(used & ~_followed(problem.metamodel, storage_pa)).T,
        flags=flags,
    )


def _followed(metamodel: Metamodel, storage_pa: tuple[Array, ...]) -> Mask:
    """Whether the metamodel follows modes at moduli E', G' of shape (m, s, n), of that shape."""
    if not isinstance(metamodel, FollowingMetamodel):
        return np.ones(storage_pa[0].shape, dtype=bool)
    E_pa, G_pa = (np.moveaxis(modulus, 0, -1) for modulus in storage_pa)
    return np.moveaxis(metamodel.follows(E_pa, G_pa), -1, 0)


def _moduli_flags(
    metamodel: Metamodel, zener: Array, storage_pa: tuple[Array, ...], used: Mask
) -> NDArray[np.int64]:
    """Flags (n,) of springs (6, s, n), storage moduli (m, s, n) and the metamodel's limits."""
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


def _add_misfits(problem: _Problem, fit: PopulationFit, observed: Array, errors: Array) -> None:
    """Fit reeds that the errors do not explain with a misfit added to them."""
    freedom = fit.used - np.count_nonzero(np.isfinite(fit.components), axis=1)
    reduced_chi2 = fit.reduced_chi2.copy()
    reeds = np.flatnonzero(is_misfit(reduced_chi2, freedom))
    for _ in range(_MISFIT_TURNS):
        if not reeds.size:
            break
        residual = fit.residual_cents[reeds]
        before = fit.misfit_cents[reeds]
        misfit = added_cents(
            residual.reshape(len(reeds), -1), errors[reeds].reshape(len(reeds), -1), freedom[reeds]
        )
        whole = np.hypot(errors[reeds], misfit[:, None, None])
        again = _fit_all(problem, np.where(np.isnan(residual), np.nan, observed[reeds]), whole)
        left_out = fit.left_out[reeds]
        again.flags[...] |= np.where(left_out.any(axis=(1, 2)), Flag.MODES_LEFT_OUT, 0)
        again.left_out[...], again.misfit_cents[...] = left_out, misfit
        again.reduced_chi2[...] = reduced_chi2[reeds]
        _put(again, fit, reeds)
        reeds = reeds[np.abs(misfit - before) > _MISFIT_SETTLED * misfit]


def _unknown(observed: Array, count: int) -> PopulationFit:
    """Fits of reeds of which nothing is known yet."""
    n = len(observed)
    return PopulationFit(
        components=np.full((n, count), np.nan),
        errors=np.full((n, count), np.inf),
        reduced_chi2=np.full(n, np.nan),
        misfit_cents=np.full(n, np.nan),
        residual_cents=np.full(observed.shape, np.nan),
        rms_cents=np.full(n, np.nan),
        used=np.count_nonzero(~np.isnan(observed), axis=(1, 2)),
        left_out=np.zeros(observed.shape, dtype=bool),
        flags=np.full(n, int(Flag.TOO_FEW_RESONANCES)),
    )
