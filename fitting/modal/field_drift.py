"""Let the smooth factor of the object field drift from hologram to hologram.

Temperature, humidity and the air in the beam change the object field smoothly over the reed. At
small amplitudes such a change cannot be distinguished from a change of the vibration (see
`fitting.holograms.object_field`). The common-mode error of the displacements is therefore not the
same in all holograms: its parts of low degree are a random walk in the order of recording, given at
nodes and linear in between. The step of the walk is found from the sweep itself.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from fitting.holograms.object_field import CommonModeError, of_low_degree
from holography.arrays import Array, IndexArray

# Air and temperature tilt and bend a beam. Speckle that is renewed changes all degrees equally:
# the higher ones are left to the noise, for time (decision 0047). A uniform change of the magnitude
# is left out (decision 0031): laser power is a gain of the hologram.
_DEGREE = 5
# Holograms between two nodes, at least, and most nodes. Chosen: three times the width of a
# resonance in steps of 25 cents, so that the drift cannot follow one; the walk within is noise.
_SPACING, _MOST_NODES = 12, 17
# What the magnitude of an object field may be off by if no hologram tells it, in nepers. Chosen: a
# number so large that one hologram with fringes is worth more.
_UNKNOWN = 1.0
# Step of the walk of each coefficient from hologram to hologram, in nepers and rad: start, and
# limits. Below the least, 10,000 holograms are needed for a change of 1 %; above the most, two
# successive sweeps have nothing in common.
FIRST_WALK = 2e-3
_LEAST, _MOST = 1e-4, 0.05


@dataclass(frozen=True)
class FieldDrift:
    """How the common-mode error of every hologram follows from parameters.

    The parameters are the q values that all holograms have in common, then r values at each of b
    nodes.

    Attributes
    ----------
    share : (k, b) float
        Weights of the nodes in every hologram.
    drifting : (r,) int
        Which of the q values drift.
    constant : int
        Number q.
    spacing : float
        Holograms between two nodes.
    """

    share: Array
    drifting: IndexArray
    constant: int
    spacing: float

    def shift(self, parameters: Array) -> Array:
        """Return the common-mode error (k, q) of every hologram."""
        shift = np.tile(parameters[: self.constant], (len(self.share), 1))
        nodes = parameters[self.constant :].reshape(self.share.shape[1], len(self.drifting))
        shift[:, self.drifting] += self.share @ nodes
        return shift

    @property
    def parameters(self) -> int:
        """Number p of parameters."""
        return self.constant + int(self.share.shape[1]) * len(self.drifting)

    def columns(self, values: Array) -> Array:
        """Return for each parameter (p, c, k) what it multiplies, of values (q, c, k)."""
        nodes = self.share.T[:, None, None] * values[self.drifting]
        return np.concatenate([values, nodes.reshape(-1, *values.shape[1:])])

    def gathered(self, values: Array) -> Array:
        """Sum values (..., q, k) over holograms for each parameter (..., p): adjoint of `shift`."""
        share = self.share.astype(values.dtype)
        nodes = np.swapaxes(values[..., self.drifting, :] @ share, -1, -2)
        return np.concatenate([values.sum(axis=-1), _flat(nodes)], axis=-1)

    def products(self, values: Array) -> Array:
        """Sum products (q, q, k) over holograms for each pair of parameters (p, p)."""
        which, share = self.drifting, self.share.astype(values.dtype)
        both = self.gathered(values)
        pairs = (share[:, :, None] * share[:, None]).reshape(len(share), -1)
        among = values[which][:, which] @ pairs
        among = among.reshape(len(which), len(which), share.shape[1], share.shape[1])
        size = self.parameters - self.constant
        among = among.transpose(2, 0, 3, 1).reshape(size, size)
        cross = both[:, self.constant :]
        return np.block([[both[:, : self.constant], cross], [cross.T, among]])

    def covariance(self, parameters: Array) -> Array:
        """Return the covariance (k, q, q) of `shift` from that of the parameters (p, p)."""
        constant, which, nodes = self.constant, self.drifting, self.share.shape[1]
        found = np.tile(parameters[:constant, :constant], (len(self.share), 1, 1))
        cross = parameters[:constant, constant:].reshape(constant, nodes, len(which))
        own = parameters[constant:, constant:].reshape(nodes, len(which), nodes, len(which))
        across = np.einsum("qbr,kb->kqr", cross, self.share)
        found[:, :, which] += across
        found[:, which] += across.swapaxes(1, 2)
        among = np.einsum("brcs,kb,kc->krs", own, self.share, self.share, optimize=True)
        found[np.ix_(np.arange(len(found)), which, which)] += among
        return found


@dataclass(frozen=True)
class SharedError:
    """Error that displacements share, as linear parameters of a fit.

    Attributes
    ----------
    response : (k, 2j, q) float
        Derivatives of the amplitudes (real, then imaginary parts) by the error of each hologram.
    drift : FieldDrift
        How the errors of holograms follow from the parameters.
    precision : (p, p) float
        Inverse covariance of the parameters.
    pull : (p,) float
        This times their expectation, before modes are known.
    """

    response: Array
    drift: FieldDrift
    precision: Array
    pull: Array


def field_drift(common_mode: CommonModeError, recording_rank: IndexArray) -> FieldDrift:
    """Set up nodes for holograms that were recorded in a given order (k,)."""
    constant = common_mode.response.shape[2]
    holograms = int(recording_rank.max()) + 1
    intervals = int(np.clip((holograms - 1) // _SPACING, 1, _MOST_NODES - 1))
    spacing = max((holograms - 1) / intervals, 1.0)
    apart = np.abs(recording_rank[:, None] / spacing - np.arange(intervals + 1))
    drifting = of_low_degree(_DEGREE) if constant else np.zeros(0, np.intp)
    return FieldDrift(np.maximum(0, 1 - apart), drifting, constant, spacing)


def steady(drift: FieldDrift) -> FieldDrift:
    """Return the same without any drift: parameters are those that all holograms share."""
    return replace(drift, drifting=np.zeros(0, np.intp))


def shared_error(common_mode: CommonModeError, drift: FieldDrift, walk: float) -> SharedError:
    """Return the error that displacements share if the object field drifts.

    `walk` is the standard deviation of a coefficient's change from one hologram to the next.
    """
    which, share, own = drift.drifting, drift.share, common_mode.precision
    nodes = share.shape[1]
    size = nodes * len(which)
    cross = np.einsum("kqr,kb->qbr", own[:, :, which], share).reshape(drift.constant, size)
    among = np.einsum(
        "krs,kb,kc->brcs", own[:, which][:, :, which], share, share, optimize=True
    ).reshape(size, size)
    held = np.kron(_held(drift), np.eye(len(which))) / walk**2
    precision = np.block([[common_mode.whole, cross], [cross.T, among + held]])
    return SharedError(common_mode.response, drift, precision, drift.gathered(common_mode.pull.T))


def _held(drift: FieldDrift) -> Array:
    """Return the precision (b, b) of a value at the nodes of a walk of steps of 1."""
    nodes = drift.share.shape[1]
    steps = np.diff(np.eye(nodes), axis=0)
    # The mean of the walk belongs to the constant.
    return np.asarray(steps.T @ steps / drift.spacing + np.full((nodes, nodes), 1 / nodes**2))


def _flat(nodes: Array) -> Array:
    """Join the last two axes."""
    return nodes.reshape(*nodes.shape[:-2], nodes.shape[-2] * nodes.shape[-1])


def covariance_by_other_changes(
    drift: FieldDrift, ranks: IndexArray, renewal: Array, walk: float, following: Array
) -> Array:
    """Return the covariance (r, r) of numbers by changes of light that nodes do not follow.

    Between two nodes, what drifts walks as it does from node to node. All else drifts as speckle is
    renewed, around the mean that is fitted.

    Parameters
    ----------
    drift : FieldDrift
    ranks : (k,) int
        Order of recording.
    renewal : (q, q) float
        See `fitting.holograms.changing_field.renewal_of`.
    walk : float
        See `shared_error`.
    following : (r, k, q) float
        How the numbers follow the common-mode error of each hologram.
    """
    count, other = len(ranks), np.ones(renewal.shape[0], bool)
    # Other parameters that holograms share come first.
    which = drift.drifting - (drift.constant - len(other))
    # Laser power, a uniform magnitude, is a gain of the hologram.
    other[which] = other[:1] = False
    walks = np.minimum.outer(ranks, ranks) + 1.0
    among, around = (
        np.eye(count) - columns @ np.linalg.pinv(columns)
        for columns in (drift.share, np.ones((count, 1)))
    )
    between = among @ walks @ among
    own, rest = following[:, :, which], following[:, :, other]
    found = walk**2 * np.einsum("akq,kl,blq->ab", own, between, own, optimize=True)
    steps = renewal[np.ix_(other, other)]
    found += np.einsum(
        "akq,kl,blr,qr->ab", rest, around @ walks @ around, rest, steps, optimize=True
    )
    return np.asarray(0.5 * (found + found.T))


def found_walk(drift: FieldDrift, parameters: Array, covariance: Array, walk: float) -> float:
    """Find the step of the walk from fitted parameters (p,) and their covariance (p, p).

    It is the value for which the squares of the changes are as expected for those that the data
    determine (D. J. C. MacKay 1992, Neural Computation 4:415, equation 4.9).
    """
    count = len(drift.drifting)
    if not count:
        return walk
    nodes = parameters[drift.constant :].reshape(-1, count)
    own = covariance[drift.constant :, drift.constant :].reshape(len(nodes), count, -1, count)
    same = np.einsum("brcr->bc", own)
    steps = np.diff(np.eye(len(nodes)), axis=0)
    unknown = np.trace(steps @ same @ steps.T) / drift.spacing / walk**2
    squares = float(np.sum(np.diff(nodes, axis=0) ** 2)) / drift.spacing
    determined = max(count * len(steps) - float(unknown), 1.0)
    return float(np.clip(np.sqrt(squares / determined), _LEAST, _MOST))


def likeliest_step(
    drift: FieldDrift, parameters: Array, covariance: Array, walk: float, some: IndexArray
) -> float:
    """Find the step for which some of the values (s,) that drift have the largest evidence.

    The arguments are those of `found_walk`. These values may walk farther than the others, with
    which they were fitted: what was expected of them is taken out of their covariance.
    """
    count, nodes = len(drift.drifting), drift.share.shape[1]
    among = (drift.constant + np.arange(nodes)[:, None] * count + some).ravel()
    known = np.linalg.inv(covariance[np.ix_(among, among)])
    pull = known @ parameters[among]
    held = np.kron(_held(drift), np.eye(len(some)))
    known = known - held / walk**2

    def unlikelihood(log_step: float) -> float:
        expected = held / np.exp(2 * log_step)
        whole = known + expected
        volumes = np.linalg.slogdet(whole)[1] - np.linalg.slogdet(expected)[1]
        return float(volumes - pull @ np.linalg.solve(whole, pull))

    limits = float(np.log(_LEAST)), float(np.log(_MOST))
    return float(np.exp(minimize_scalar(unlikelihood, bounds=limits, method="bounded").x))


def magnitude_error(
    drift: FieldDrift,
    common_mode: CommonModeError,
    recording_rank: IndexArray,
    parameters: Array,
    covariance: Array,
    walk: float,
) -> Array:
    """Return how well (k,) the magnitude of the object field is known in each hologram, in nepers.

    Large vibrations tell it by their fringes. From there it walks to the holograms without fringes,
    uniformly over the reed, as far in a step as the parts do that change along one axis: beams that
    wander do both. No frequency depends on it, but all small displacements do.

    Parameters
    ----------
    drift : FieldDrift
    common_mode : CommonModeError
        Of displacements before modes are known.
    recording_rank : (k,) int
    parameters, covariance : (p,) and (p, p) float
        Of the fitted drift.
    walk : float
        See `shared_error`.
    """
    holograms = len(recording_rank)
    if not len(drift.drifting):
        return np.zeros(holograms)
    # Other parameters that holograms share come first.
    first = drift.constant - common_mode.response.shape[2]
    along_an_axis = np.flatnonzero(np.isin(drift.drifting - first, of_low_degree(1)))
    step = likeliest_step(drift, parameters, covariance, walk, along_an_axis)
    order = np.argsort(recording_rank)
    gaps = np.diff(recording_rank[order])
    steps = np.diff(np.eye(holograms), axis=0) / np.sqrt(np.maximum(gaps, 1))[:, None] / step
    known = np.diag(common_mode.precision[order, 0, 0] + _UNKNOWN**-2 / holograms)
    found = np.empty(holograms)
    found[order] = np.sqrt(np.diag(np.linalg.inv(known + steps.T @ steps)))
    return found
