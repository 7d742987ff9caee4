"""Analytic derivatives of frequencies, and of modes that are nearly degenerate.

The dynamic stiffness Z(ω) is singular at a mode x, so ``x·∂Z/∂p·x + x·∂Z/∂ln f·x · ∂ln f/∂p = 0``:
the formula of Hellmann and Feynman, with cane and air that depend on frequency. Two modes that are
close exchange shapes before a parameter has moved them far. They move as the eigenvalues of a 2×2
matrix, with their own derivatives on its diagonal and their coupling off it, and their shapes mix
as its eigenvectors do: see `predicted_hz`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holography.arrays import Array
from physics.reed.cane.material import STIFFNESS_TERMS, terms_and_slopes
from physics.reed.reduced.changes import Blocks, Change
from physics.reed.reduced.dynamics import E_L, G_LT, PIVOT_HZ
from physics.reed.reduced.reed import CONSTANTS, MODULI
from physics.reed.reduced.vibrations import Vibrations

# Parameters of every reed, in order: logarithms of moduli and density, Poisson ratios, exponents
# of growth, and the density of the air as a fraction of normal air.
PARAMETERS = (
    *(f"ln {name}" for name in MODULI),
    *CONSTANTS[len(MODULI) :],
    "ln density_kg_m3",
    "growth_E_L",
    "growth_G_LT",
    "air_fraction",
)
DENSITY, AIR_FRACTION = PARAMETERS.index("ln density_kg_m3"), PARAMETERS.index("air_fraction")
GROWTH_E_L, GROWTH_G_LT = PARAMETERS.index("growth_E_L"), PARAMETERS.index("growth_G_LT")


@dataclass(frozen=True)
class Derivatives:
    """How the m modes of a reed follow p parameters: `PARAMETERS`, then amounts of changes.

    Attributes
    ----------
    ln_hz : (m, p) float
        Of the logarithm of each frequency.
    couplings : (m, m, p) float
        Of a matrix whose eigenvalues are the logarithms of the frequencies; symmetric in the modes,
        with `ln_hz` on the diagonal.
    loads : (s, m, p) float
        Derivative of the dynamic stiffness times each mode, in the coordinates of all parts.
    masses : (m, p) float
        Of the mass of each mode, its shape unchanged.
    reactions : (c, m) float
        Forces of the strips on the reed in their coordinates.
    """

    ln_hz: Array
    couplings: Array
    loads: Array
    masses: Array
    reactions: Array


def derivatives(found: Vibrations, changes: Sequence[Change] = ()) -> Derivatives:
    """Derivatives of all modes of a reed.

    Parameters
    ----------
    found : Vibrations
    changes : sequence of Change
        Of unit amounts, such as a layer of 1 m; the parameters are their amounts.
    """
    stiffnesses, slopes = terms_and_slopes(found.state.law.constants_at(found.hz))
    products = cane_products(found)
    loads = np.zeros((*found.coordinates.shape, len(PARAMETERS) + len(changes)))
    _by_constants(found, products, slopes, loads)
    reactions = _reactions(found, products, stiffnesses)
    masses, x = np.zeros(loads.shape[1:]), found.coordinates
    squares = (2 * np.pi * found.hz) ** 2
    for number in (DENSITY, AIR_FRACTION):
        masses[:, number] = -np.sum(x * loads[..., number], axis=0) / squares
    for number, change in enumerate(changes, len(PARAMETERS)):
        if change.stiffness_terms:
            grown = changed_products(found, change)
            loads[..., number] = np.einsum("tsm,mt->sm", grown, stiffnesses)
        inert = _changed_mass(found, change)
        loads[..., number] -= squares * inert
        masses[:, number] = np.sum(x * inert, axis=0)
    forms = np.einsum("sm,snp->mnp", found.coordinates, loads, optimize=True)
    for number, change in enumerate(changes, len(PARAMETERS)):
        if change.compliance_m_n is not None:
            forms[..., number] -= reactions.T @ change.compliance_m_n @ reactions
    scale = np.sqrt(-form_by_ln_hz(found))
    couplings = forms / scale[:, None, None] / scale[None, :, None]
    couplings = 0.5 * (couplings + couplings.transpose(1, 0, 2))
    own = np.arange(len(scale))
    return Derivatives(couplings[own, own], couplings, loads, masses, reactions)


def local_shifts(found: Vibrations) -> Array:
    """Derivatives (b, m) of ln f of all modes by cane that grows on the bark side.

    Per metre of thickness and square metre of the plan, at the points of the bark side; of half a
    reed, on both halves.
    """
    reed, x = found.reed, found.coordinates
    stiffnesses = terms_and_slopes(found.state.law.constants_at(found.hz))[0]
    density = found.state.law.constants.density_kg_m3
    squares = density * (2 * np.pi * found.hz) ** 2
    grown = np.zeros((len(reed.bark_m), len(found.hz)))
    for start, part in zip(reed.starts, reed.loose.values(), strict=True):
        own = x[start : start + part.size]
        strains, moved = part.strain @ own, part.motion @ own
        for number, term in enumerate(STIFFNESS_TERMS):
            i, j = int(term[0]) - 1, int(term[1]) - 1
            twice = 1.0 if i == j else 2.0
            grown += twice * strains[i] * strains[j] * stiffnesses[:, number]
        grown -= squares * np.sum(moved**2, axis=0)
    return np.asarray(-grown / form_by_ln_hz(found))


def form_by_ln_hz(found: Vibrations) -> Array:
    """``x·∂Z/∂ln f·x`` (m,) of every mode, -2ω² if nothing but inertia depends on frequency."""
    answer = np.zeros(len(found.hz))
    for group, rank in zip(found.groups, found.order, strict=True):
        _, slopes = group.dynamics.amounts(group.hz)
        products = np.matmul(group.dynamics.matrices, group.vectors)
        answer[rank] = np.einsum("mi,lm,ilm->m", slopes, group.vectors, products, optimize=True)
    return answer


def predicted_hz(found: Vibrations, slopes: Derivatives, step: Array) -> Array:
    """Frequencies (m,), ascending, after a step (p,) of the parameters.

    Modes that are close are taken together, to all orders of what they exchange: across an avoided
    crossing this holds where single derivatives are off by all of the distance.
    """
    matrix = np.diag(np.log(found.hz)) + slopes.couplings @ step
    return np.asarray(np.exp(np.linalg.eigvalsh(matrix)))


def cane_products(found: Vibrations) -> Array:
    """Stiffness per unit of each term of the cane times each mode (9, s, m)."""
    reed, x = found.reed, found.coordinates
    answer = np.zeros((9, *x.shape))
    for group, rank in zip(found.groups, found.order, strict=True):
        for number in group.coordinates.parts:
            part = list(reed.loose.values())[number]
            rows = slice(reed.starts[number], reed.starts[number] + part.size)
            answer[:, rows, rank] = np.matmul(part.stiffness_terms, x[rows][:, rank])
    _add_products(found, found.state.change.stiffness_terms, answer)
    return answer


def _add_products(found: Vibrations, blocks: Blocks, into: Array) -> None:
    """Add blocks (…, s, t) of parts times the modes."""
    reed, x = found.reed, found.coordinates
    parts = list(reed.loose.values())
    rows = [slice(start, start + p.size) for start, p in zip(reed.starts, parts, strict=True)]
    for (a, b), block in blocks.items():
        into[..., rows[a], :] += block @ x[rows[b]]
        if a != b:
            into[..., rows[b], :] += np.swapaxes(block, -1, -2) @ x[rows[a]]


def _mass_products(found: Vibrations) -> Array:
    """Mass per unit density times each mode (s, m)."""
    reed, x = found.reed, found.coordinates
    answer = np.zeros_like(x)
    for start, part in zip(reed.starts, reed.loose.values(), strict=True):
        rows = slice(start, start + part.size)
        answer[rows] = part.mass @ x[rows]
    _add_products(found, found.state.change.mass, answer)
    return answer


def _air_products(found: Vibrations) -> Array:
    """Mass of normal air times each mode (s, m), at its frequency."""
    reed, x, air = found.reed, found.coordinates, found.state.air
    answer = np.zeros_like(x)
    if air is not None:
        amounts = air.amounts(np.log(found.hz))
        for start, own in zip(reed.starts, air.mass_kg, strict=True):
            rows = slice(start, start + own.shape[-1])
            answer[rows] = np.einsum("mk,ksm->sm", amounts, own @ x[rows], optimize=True)
    return answer


def _by_constants(found: Vibrations, products: Array, slopes: Array, loads: Array) -> None:
    """Fill the loads of `PARAMETERS`; slopes (m, 9, 9) are of stiffnesses by constants."""
    squares = (2 * np.pi * found.hz) ** 2
    loads[..., : len(CONSTANTS)] = np.einsum("tsm,mtc->smc", products, slopes, optimize=True)
    density = found.state.law.constants.density_kg_m3
    loads[..., DENSITY] = -squares * density * _mass_products(found)
    log_ratio = np.log(found.hz / PIVOT_HZ)
    loads[..., GROWTH_E_L] = log_ratio * loads[..., E_L]
    loads[..., GROWTH_G_LT] = log_ratio * loads[..., G_LT]
    loads[..., AIR_FRACTION] = -squares * _air_products(found)


def changed_products(found: Vibrations, change: Change) -> Array:
    """What a change adds to the stiffness per unit of each term, times each mode (9, s, m)."""
    answer = np.zeros((9, *found.coordinates.shape))
    _add_products(found, change.stiffness_terms, answer)
    return answer


def _changed_mass(found: Vibrations, change: Change) -> Array:
    """What a change adds to the mass, times each mode (s, m)."""
    cane, other = np.zeros_like(found.coordinates), np.zeros_like(found.coordinates)
    _add_products(found, change.mass, cane)
    _add_products(found, change.mass_kg, other)
    return np.asarray(found.state.law.constants.density_kg_m3 * cane + other)


def _reactions(found: Vibrations, products: Array, stiffnesses: Array) -> Array:
    """Forces (c, m) that hold the strips, in their coordinates."""
    state, strip = found.state, found.reed.strip
    squares = (2 * np.pi * found.hz) ** 2
    inert = state.law.constants.density_kg_m3 * _mass_products(found)
    inert += state.air_fraction * _air_products(found)
    if state.change.mass_kg:
        _add_products(found, state.change.mass_kg, inert)
    elastic = np.einsum("tsm,mt->sm", products[:, strip], stiffnesses)
    return np.asarray(squares * inert[strip] - elastic)
