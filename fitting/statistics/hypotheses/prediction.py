"""Resonance frequencies of a population from its Zener parameters, with exact derivatives.

Storage moduli at each mode's own frequency (paper, Eq. 4), then a metamodel (Eq. 1) with
adjustments that take away its systematic errors.
"""

from dataclasses import dataclass

import numpy as np

from fitting.forward import hz_of
from fitting.paper.constants import MEAN_HZ, TABLE_9
from fitting.statistics.hypotheses.structure import PARAMETER_SIZES
from holography.arrays import Array
from physics.reed.cane.viscoelastic import StorageModulus, storage_modulus
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduction.metamodel import (
    Equation1,
    Metamodel,
    paper_network_pa,
)

_LN_HZ_PER_CENT = np.log(2) / 1200
# Farther from F6 the formula stands for nothing: the cane has lost its stiffness.
_FARTHEST_CENTS = 12000.0
# Limit of parameters, as a multiple of their size: beyond, powers would overflow.
_GREATEST = 1e6
# Each pass gains a factor of about 5.
_SETTLED_CENTS = 1e-9
_MOST_PASSES = 60


@dataclass(frozen=True, eq=False)
class ResonanceModel:
    """How the cane's parameters become resonance frequencies.

    Attributes
    ----------
    metamodel : Metamodel
        Of m modes, without adjustments.
    start_hz : (2, m) float
        Frequencies of series A and B at which the storage moduli are taken first.
    converged : bool
        Whether the moduli are measured again at the frequencies just found until these stay. The
        paper takes them once.
    """

    metamodel: Metamodel
    start_hz: Array
    converged: bool = False


def paper_resonances(
    modes: tuple[str, ...] = PAPER_MODES, *, converged: bool = False
) -> ResonanceModel:
    """Eq. 1 with Table 9, storage moduli at the means of Table 1."""
    return ResonanceModel(
        Equation1(modes, np.array([TABLE_9[name] for name in modes])),
        np.array([MEAN_HZ[name] for name in modes], dtype=float).T,
        converged,
    )


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Combinations of the terms of Eq. 1 that are added to a metamodel, r for each mode.

    Each has an effect of 1 cent rms over the paper's network of 92 materials, and no two have
    anything in common there: all adjustments are in cents, and comparable.

    Attributes
    ----------
    to_equation_1 : (6, r) float
        Coefficients a_0 … a_5 of each combination.
    """

    to_equation_1: Array

    def evaluate(
        self, modes: tuple[str, ...], E_L_pa: Array, G_LT_pa: Array
    ) -> tuple[Array, Array, Array]:
        """Combinations, and derivatives with respect to ln E_L and ln G_LT, (..., m, r)."""
        if not self.to_equation_1.size:
            return (np.empty((*np.shape(E_L_pa), 0)),) * 3
        parts = [
            Equation1(modes, np.tile(column, (len(modes), 1))).evaluate(E_L_pa, G_LT_pa)
            for column in self.to_equation_1.T
        ]
        cents, by_ln_E, by_ln_G = (np.stack(part, axis=-1) for part in zip(*parts, strict=True))
        return cents, by_ln_E, by_ln_G


def no_adjustment() -> Adjustment:
    """The metamodel as it is: r = 0."""
    return Adjustment(np.empty((6, 0)))


def intercept_adjustment() -> Adjustment:
    """Of Eq. 1, only a_m0."""
    return Adjustment(np.eye(6)[:, :1])


def full_adjustment() -> Adjustment:
    """All six a_mq; the first combination is a_m0 alone."""
    E, G = (modulus[:, None] for modulus in paper_network_pa())
    columns = [Equation1(("",), unit[None]).evaluate(E, G)[0] for unit in np.eye(6)]
    terms = np.concatenate(columns, axis=1)
    upper = np.linalg.qr(terms / np.sqrt(len(terms)))[1]
    return Adjustment(np.linalg.inv(np.sign(np.diag(upper))[:, None] * upper))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Computed resonance frequencies.

    Attributes
    ----------
    cents : (n, 2, m) float
        Above F6; NaN where a storage modulus is not positive, or so small that the metamodel
        goes ten octaves astray, and for parameters a million times too large.
    by_parameter : (n, 2, m, 6) float
        Derivatives with respect to E1, E2, E3, G1, G2, G3 of the reed in the series.
    by_adjustment : (n, 2, m, r) float
        Derivatives with respect to the mode's own adjustments.
    """

    cents: Array
    by_parameter: Array
    by_adjustment: Array


def predict(
    model: ResonanceModel, adjustment: Adjustment, adjustments_cents: Array, parameters: Array
) -> Prediction:
    """Compute the frequencies of reeds.

    Parameters
    ----------
    model : ResonanceModel
    adjustment : Adjustment
    adjustments_cents : (m, r) float
        How much of each combination is added, per mode.
    parameters : (n, 2, 6) float
        Zener parameters of both series, MPa and MPa·s.
    """
    wild = (np.abs(parameters) > _GREATEST * PARAMETER_SIZES).any(axis=-1, keepdims=True)
    parameters = np.where(wild, np.nan, parameters)
    hz = np.broadcast_to(model.start_hz, (len(parameters), *model.start_hz.shape))
    for _ in range(_MOST_PASSES if model.converged else 1):
        young, shear = (_storage(parameters[..., i : i + 3], hz) for i in (0, 3))
        cents, by_ln_E, by_ln_G, terms = _adjusted(
            model.metamodel, adjustment, adjustments_cents, young, shear
        )
        before, hz = hz, hz_of(cents)
        moved = np.abs(np.log(hz / before)) / _LN_HZ_PER_CENT
        if not np.any(moved > _SETTLED_CENTS):
            break
    by_E, by_G = by_ln_E / young.value_mpa, by_ln_G / shear.value_mpa
    by_parameter = np.concatenate([_by_zener(by_E, young), _by_zener(by_G, shear)], axis=-1)
    if model.converged:
        # Implicit function theorem: the moduli move with the frequency that they make.
        by_ln_hz = by_E * young.by_ln_frequency_mpa + by_G * shear.by_ln_frequency_mpa
        gain = 1 / (1 - _LN_HZ_PER_CENT * by_ln_hz)
        by_parameter, terms = gain[..., None] * by_parameter, gain[..., None] * terms
    return Prediction(cents, by_parameter, terms)


def _storage(zener: Array, hz: Array) -> StorageModulus:
    """Storage moduli (n, 2, m) of solids (n, 2, 3)."""
    spring, arm_spring, arm_dashpot = (zener[..., i, None] for i in range(3))
    return storage_modulus(spring, arm_spring, arm_dashpot, hz)


def _adjusted(
    metamodel: Metamodel,
    adjustment: Adjustment,
    adjustments_cents: Array,
    young: StorageModulus,
    shear: StorageModulus,
) -> tuple[Array, Array, Array, Array]:
    """Cents, derivatives with respect to ln E_L and ln G_LT (n, 2, m), and terms (n, 2, m, r)."""
    possible = (young.value_mpa > 0) & (shear.value_mpa > 0)
    E, G = (1e6 * np.where(possible, modulus.value_mpa, np.nan) for modulus in (young, shear))
    plain = metamodel.evaluate(E, G)
    terms = adjustment.evaluate(metamodel.modes, E, G)
    cents, by_ln_E, by_ln_G = (
        of + np.einsum("nsmr,mr->nsm", added, adjustments_cents)
        for of, added in zip(plain, terms, strict=True)
    )
    cents = np.where(np.abs(cents) < _FARTHEST_CENTS, cents, np.nan)
    return cents, by_ln_E, by_ln_G, terms[0]


def _by_zener(by_modulus: Array, modulus: StorageModulus) -> Array:
    """Derivatives with respect to spring, arm's spring and dashpot, (n, 2, m, 3)."""
    by_arm = (modulus.by_arm_spring, modulus.by_arm_dashpot_per_s)
    return np.stack([by_modulus, *(by_modulus * slope for slope in by_arm)], axis=-1)
