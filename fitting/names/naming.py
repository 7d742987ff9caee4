"""Names of fitted modes, with their probabilities.

The reed that has the measured modes (`fitting.names.reed_posterior`) is drawn many times from its
posterior. Each draw has names by the nomenclature of `physics.reed.mode_classification`, from nodal
lines of its shapes; a measured mode has the name of the draw's mode that it is. What is seen of
that mode is what was measured, within its errors: a reed with its own thickness everywhere has
shapes that no draw has. At an avoided crossing a mode has the characters of two names. Each name
then has the share of the motion that bears it out as its weight, and a name belongs to one mode
only. Half of the weight belongs to lines across the reed that follow its tip, half to straight
ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import softmax

from fitting.holograms.shape_basis import ShapeBasis
from fitting.modal.modal_fit import ModalFit
from fitting.names.measured import measured_modes
from fitting.names.reed_posterior import ReedPosterior, reed_posterior
from fitting.names.stiffening import Stiffening, averaged, stiffening_of
from fitting.names.straight_lines import with_straight_lines
from holography.arrays import Array
from physics.plausible.reeds import PlausibleReeds
from physics.reed.elements.fem import Symmetry
from physics.reed.mode_classification import ModeDescriptor, names_of, similarities
from physics.reed.reduced.reed import ReducedReed
from physics.reed.surface import surface_shapes

# A name is sure from this probability on.
SURE = 0.95
# Draws of the reed. Chosen: a probability of 0.95 is then known to 0.015.
_DRAWS, _SEED = 200, 0
# Names that are less probable are not listed.
_LISTED = 0.01
# A motion without a name bears out this much of one: as in `mode_classification`.
_LEAST_CLAIM = 0.1
# Probabilities of names below this are left out.
_NEGLIGIBLE = 1e-3
# Lateral modes and modes of the heel.
_NUMBERED = "LH"
# Scale of differences between a measured mode and one of a draw: of 1 - MAC, and in cents. Chosen:
# draws follow measured frequencies to their errors, but for modes that cross.
_UNLIKE, _AWAY_CENTS = 0.02, 20.0
# Functions of which the reed shows less than this, for the same mass, are left as they are. Chosen:
# the basis has no function below 3e-3 of the first, whose square this is about.
_LEAST_SEEN = 1e-5
# Weight of a name that a mode cannot have, in the choice of the most probable names of all.
_IMPOSSIBLE = 1e-9


@dataclass(frozen=True)
class ModeNaming:
    """Name of a fitted mode.

    Attributes
    ----------
    name : str
        In the most probable assignment of names to all modes: no two modes have the same.
    probability : float
        That the mode is a mode of the reed, and has this name.
    candidates : tuple of (str, float)
        All names with a probability of at least 0.01, the most probable first.
    spurious : float
        Probability that no mode of a plausible reed is there.
    outside : float
        Probability that its resonance is outside the sweep, by all other modes.
    stiffening : Stiffening, optional
        How fast its stiffness grows with frequency, if it is a mode of the reed.
    """

    name: str
    probability: float
    candidates: tuple[tuple[str, float], ...]
    spurious: float = 0.0
    outside: float = 0.0
    stiffening: Stiffening | None = None


def reeds_behind(
    modal: ModalFit,
    basis: ShapeBasis,
    points_m: tuple[Array, Array],
    drive_hz: Array,
    index: NDArray[np.intp],
    reeds: PlausibleReeds,
) -> tuple[ReedPosterior, ...]:
    """Return the reeds that have the modes of a fit.

    There are none if no mode is measured, or if no reed of this kind has such modes.

    Parameters
    ----------
    modal : ModalFit
    basis : ShapeBasis
    points_m : ((n,) float, (n,) float)
        Points x and y of the functions of the basis.
    drive_hz : (k,) float
        Drive frequencies of the sweep.
    index : (a,) int
        Modes that are measured well enough.
    reeds : PlausibleReeds

    Raises
    ------
    ImpossibleReedError
        If no possible reed has such modes.
    """
    if not len(index):
        return ()
    visible = visible_coordinates(reeds.reed, basis, *points_m)
    ends_hz = float(drive_hz[0]), float(drive_hz[-1])
    found = reed_posterior(reeds, visible, measured_modes(modal, index), ends_hz)
    likeliest = max(found, key=lambda each: each.log_evidence)
    return found if likeliest.is_plausible else ()


def name_modes(
    found: Sequence[ReedPosterior], names: Sequence[str], reeds: PlausibleReeds
) -> dict[str, ModeNaming]:
    """Name the modes of a fit.

    Parameters
    ----------
    found : sequence of ReedPosterior
        See `reeds_behind`.
    names : sequence of str
        Names of all modes in the fit.
    reeds : PlausibleReeds

    Returns
    -------
    dict of ModeNaming
        By the name that the mode has in the fit.
    """
    if not found:
        return {}
    weights = softmax([each.log_evidence for each in found])
    probabilities = _averaged_names(reeds, found, weights)
    labels = [names[m] for m in found[0].measured.index]
    choices = named(dict(zip(labels, probabilities, strict=True)))
    stiffenings = _stiffenings(found, weights, reeds.with_free_moduli())
    return {
        label: replace(
            naming,
            spurious=float(weights @ [each.spurious[a] for each in found]),
            outside=float(weights @ [each.outside[a] for each in found]),
            stiffening=stiffenings[a],
        )
        for a, (label, naming) in enumerate(choices.items())
    }


def _stiffenings(
    found: Sequence[ReedPosterior], weights: Array, free: PlausibleReeds
) -> Sequence[Stiffening | None]:
    """Return how each measured mode stiffens, by all reeds that are possible with free moduli."""
    grown = [(each.free_moduli, w) for each, w in zip(found, weights, strict=True)]
    each = [stiffening_of(free, one) for one, _ in grown if one is not None]
    if not each:
        return [None] * len(found[0].mode)
    own = np.array([w for one, w in grown if one is not None])
    return [averaged(own / own.sum(), of_mode) for of_mode in zip(*each, strict=True)]


def _averaged_names(
    reeds: PlausibleReeds, found: Sequence[ReedPosterior], weights: Array
) -> list[dict[str, float]]:
    """Return the probability of each name of each measured mode, over all reeds found (n,)."""
    drawings = reeds.reed, with_straight_lines(reeds.reed)
    answer: list[dict[str, float]] = [{} for _ in found[0].mode]
    for weight, each in zip(weights.tolist(), found, strict=True):
        names = name_probabilities(each, drawings, weight)
        for total, own in zip(answer, names, strict=True):
            for name, probability in own.items():
                total[name] = total.get(name, 0.0) + weight * probability
    return answer


def visible_coordinates(reed: ReducedReed, basis: ShapeBasis, x_m: Array, y_m: Array) -> Array:
    """Return the coordinates (j, s) in a basis of what is seen of each coordinate of a reed."""
    surface = surface_shapes(reed, x_m, y_m)
    size = sum(part.size for part in reed.loose.values())
    answer = np.zeros((basis.functions.shape[1], size))
    for start, (key, part) in zip(reed.starts, reed.loose.items(), strict=True):
        answer[:, start : start + part.held] = basis.functions.T @ surface[key] / len(x_m)
    return answer


def name_probabilities(
    posterior: ReedPosterior, drawings: Sequence[ReducedReed], fraction: float = 1.0
) -> list[dict[str, float]]:
    """Return the probability of each name of each measured mode.

    Parameters
    ----------
    posterior : ReedPosterior
    drawings : sequence of ReducedReed
        The reed, with the lines across along which modes have their order drawn in one way or
        another. Each has the same weight.
    fraction : float
        Fraction of the draws that this posterior is worth.

    Returns
    -------
    list of dict
        For each measured mode, name → probability. What is missing to 1 is the probability that it
        is no mode of the reed.
    """
    draws = max(1, round(fraction * _DRAWS))
    rng = np.random.default_rng(_SEED)
    root = np.linalg.cholesky(posterior.covariance)
    steps = rng.standard_normal((draws, len(root))) @ root.T
    drawn_hz, mixings = posterior.nearby.modes(posterior.mean + steps)
    extension = _extension(posterior)
    nearby = posterior.nearby
    drawn = [replace(nearby, found=replace(nearby.found, reed=reed)) for reed in drawings]
    answer: list[dict[str, float]] = [{} for _ in posterior.mode]
    for unordered_hz, mixture in zip(drawn_hz, mixings, strict=True):
        # Names count modes in order of frequency.
        ascending = np.argsort(unordered_hz)
        hz, mixing = unordered_hz[ascending], mixture[:, ascending]
        same = _same_modes(posterior, hz, mixing)
        besides = extension @ _unseen_by_reeds(posterior, mixing, same, rng)
        for reeds in drawn:
            own = exchanged_names(reeds.descriptors(mixing, besides))
            for a, m in same:
                real = (1 - float(posterior.spurious[a])) / (draws * len(drawn))
                for name, probability in own[m].items():
                    answer[a][name] = answer[a].get(name, 0.0) + probability * real
    return answer


def _same_modes(posterior: ReedPosterior, hz: Array, mixing: Array) -> list[tuple[int, int]]:
    """Return which mode of a draw each measured mode is.

    Modes that hardly influence each other cross from draw to draw: then their shapes say which is
    which, and not their order.
    """
    found, measured = np.flatnonzero(posterior.mode >= 0), posterior.measured
    shape = posterior.seen @ mixing
    shape = shape / np.maximum(np.linalg.norm(shape, axis=0), 1e-30)
    unlike = 1 - (measured.shape[found] @ shape) ** 2
    away = (measured.ln_hz[found, None] - np.log(hz)) / (_AWAY_CENTS * np.log(2) / 1200)
    rows, columns = linear_sum_assignment(unlike / _UNLIKE + away**2)
    return list(zip(found[rows].tolist(), columns.tolist(), strict=True))


def _extension(posterior: ReedPosterior) -> Array:
    """Return the motion (s, j) of the whole reed with the least mass for each function seen."""
    visible = posterior.visible
    light = np.linalg.solve(posterior.nearby.found.reed.mass, visible.T)
    return np.asarray(light @ np.linalg.pinv(visible @ light, rcond=_LEAST_SEEN, hermitian=True))


def _unseen_by_reeds(
    posterior: ReedPosterior,
    mixing: Array,
    same: Sequence[tuple[int, int]],
    rng: np.random.Generator,
) -> Array:
    """Return what measured shapes, drawn from their errors, have besides those of a reed (j, m)."""
    measured = posterior.measured
    answer = np.zeros((len(posterior.seen), mixing.shape[1]))
    for a, m in same:
        noise = rng.standard_normal(measured.variance.shape[1]) * np.sqrt(measured.variance[a])
        shape = measured.shape[a] + noise @ measured.directions[a]
        expected = posterior.seen @ mixing[:, m]
        answer[:, m] = shape * (shape @ expected) / (shape @ shape) - expected
    return answer


def exchanged_names(descriptors: Sequence[ModeDescriptor]) -> list[dict[str, float]]:
    """Return the probability of each name of each of m motions of one reed.

    Every motion has its own name, or one that no motion has, or that of another motion which then
    has its. The odds are those of the fractions of these motions that bear the names out. Two
    motions that one name describes best may exchange theirs whatever else there is in them: which
    of both has the name is a matter of convention.

    Parameters
    ----------
    descriptors : sequence of ModeDescriptor
        As for `physics.reed.mode_classification.names_of`.
    """
    names = [naming.name for naming in names_of(descriptors)]
    vamp = _vamp_claims(descriptors)
    free = sorted({name for part in vamp for own in part for name in own} - set(names))
    # Squared, as in the choice of these names.
    weight = _claims(descriptors, vamp, names + free) ** 2
    own = np.maximum(np.diag(weight), _LEAST_CLAIM**2)
    taken = weight[:, : len(names)]
    odds = np.hstack(
        [taken * taken.T / np.multiply.outer(own, own), weight[:, len(names) :] / own[:, None]]
    )
    # A rival has that name rather than its own, also if the owner has no fraction of the rival's.
    rival = weight.argmax(axis=1)[:, None] == np.arange(len(names))
    either = np.where(rival, taken / own, 0.0)
    odds[:, : len(names)] = np.maximum(odds[:, : len(names)], np.maximum(either, either.T))
    # Lateral modes and those of the heel are numbered by frequency: no other order is possible.
    kind = np.array([name[0] if name[0] in _NUMBERED else name for name in names])
    odds[:, : len(names)][kind[:, None] == kind] = 0.0
    np.fill_diagonal(odds, 1.0)
    probability = odds / odds.sum(axis=1, keepdims=True)
    return [
        {name: p for name, p in zip(names + free, row, strict=True) if p > _NEGLIGIBLE}
        for row in probability.tolist()
    ]


def _vamp_claims(descriptors: Sequence[ModeDescriptor]) -> list[list[dict[str, float]]]:
    """Return, per part and motion, the names on the vamp and the fraction of the part of each."""
    return [
        similarities(each.profiles, each.square, symmetric=each.symmetry is Symmetry.SYMMETRIC)
        for each in descriptors
    ]


def _claims(
    descriptors: Sequence[ModeDescriptor],
    vamp: Sequence[Sequence[Mapping[str, float]]],
    names: Sequence[str],
) -> Array:
    """Return the fraction (m, n) of each motion that bears out each of n names."""
    outside = np.sum([each.sideways + each.behind for each in descriptors], axis=0)
    claims = np.zeros((len(outside), len(names)))
    for each, own in zip(descriptors, vamp, strict=True):
        symmetric = each.symmetry is Symmetry.SYMMETRIC
        foreign = {"L": "s" * symmetric, "H": "a" * (not symmetric)}
        seen = each.share * (1 - outside)
        for column, name in enumerate(names):
            if name[0] not in _NUMBERED:
                claims[:, column] += seen * [claim.get(name, 0.0) for claim in own]
            elif name.lstrip("LH0123456789") == foreign[name[0]]:
                claims[:, column] += each.sideways if name[0] == "L" else each.behind
    return claims


def named(probabilities: Mapping[str, Mapping[str, float]]) -> dict[str, ModeNaming]:
    """Choose the most probable names of all modes together.

    Parameters
    ----------
    probabilities : mapping
        For each mode, by the name that it had, name → probability.

    Returns
    -------
    dict of ModeNaming
    """
    names = sorted({name for own in probabilities.values() for name in own})
    # A mode that no name is left for keeps none.
    names += [f"?{number + 1}" for number in range(len(probabilities))]
    table = np.array([[own.get(name, 0.0) for name in names] for own in probabilities.values()])
    table = table.reshape(len(probabilities), len(names))
    # Every mode has a column of its own at least, so that each row is assigned, in order.
    _, columns = linear_sum_assignment(np.log(np.maximum(table, _IMPOSSIBLE)), maximize=True)
    answer = {}
    for row, (label, own) in enumerate(probabilities.items()):
        column = int(columns[row])
        listed = sorted(own.items(), key=lambda item: -item[1])
        answer[label] = ModeNaming(
            name=names[column],
            probability=float(table[row, column]),
            candidates=tuple((name, p) for name, p in listed if p >= _LISTED),
        )
    return answer
