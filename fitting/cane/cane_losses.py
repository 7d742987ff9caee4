"""Loss factors of the cane from those of its modes.

A mode loses energy by normal strains, E_L above all, by shear, G_LT above all, in its clamp and to
the air. Its loss factor is the mean of theirs, weighted by the energies that they store, plus that
of the radiated sound. The finite elements know these energies. F1 stores a tenth of its energy in
shear, T1 two thirds: that separates both loss factors of the cane.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fitting.cane.excess_scatter import added_cents, is_misfit
from fitting.cane.reed_fit import ValueWithError
from fitting.errors import FitError
from fitting.resonance import Resonance
from holography.arrays import Array
from physics.effects.catalogue import BY_ID
from physics.mechanics import HIGHEST_HZ, Mechanics, ReedMode, ReedSolver
from physics.parameters.tree import BenchParameters
from physics.reed.cane.viscoelastic import ViscoelasticCane
from physics.reed.reduced.dynamics import PIVOT_HZ, LossFactors
from physics.reed.reduced.losses import loss_factors, radiated, spring_energies
from physics.reed.reduced.vibrations import Vibrations, vibrations

# Two loss factors, and two modes more that can contradict them.
_LEAST_MODES = 4
# Standard deviation of the radiated sound relative to that of a free plate. Chosen: a mouthpiece
# guides the air more than a free plate does and less than a wall (decision 0026).
_RADIATION = 0.5
# Standard deviation of the loss factor of what holds the strips. Chosen: cork and rubber have 0.1
# to 0.3, metal next to none.
_CLAMP_LOSS = 0.1
# Gauss-Newton steps; only the growth with frequency is not linear. For growths of two standard
# deviations the loss factors then change by less than 1e-9.
_STEPS = 6
# Least relative error that a mode's loss factor has by itself. Chosen: far below that of any fit.
_LEAST_OWN = 1e-4


@dataclass(frozen=True)
class CaneLosses:
    """Loss factors of the cane of one sweep.

    Attributes
    ----------
    normal, shear : ValueWithError
        Ratios of dissipated to stored energy per radian, at 4 kHz: of the stiffness against normal
        strains, and against shear.
    correlation : float
        Correlation of both errors.
    residual : dict
        Loss factors of the modes less what is fitted, by name.
    reduced_chi2 : float
        Weighted squares per degree of freedom with the stated errors of the modes.
    excess_scatter : float
        Standard deviation of the modes' loss factors around the model, in addition to their errors;
        0 if `reduced_chi2` passes a χ² test at 5 %.
    """

    normal: ValueWithError
    shear: ValueWithError
    correlation: float
    residual: dict[str, float]
    reduced_chi2: float
    excess_scatter: float


def fit_losses(
    resonances: Mapping[str, Resonance], cane: ViscoelasticCane, solver: ReedSolver
) -> CaneLosses:
    """Fit the loss factors of normal and of shear stiffness to those of modes.

    Fitted together with them, each with a prior: how much sound is radiated, how much the clamp
    loses, and by which power of the frequency losses grow.

    Parameters
    ----------
    resonances : mapping
        Identified modes of one sweep by name.
    cane : ViscoelasticCane
        Fitted cane of the sweep.
    solver : ReedSolver
        Of the kind of reed.

    Raises
    ------
    FitError
        If fewer than four modes have a loss factor.
    ImpossibleReedError
        If there is no reed of such cane.
    """
    names, parts = _parts(Mechanics(cane=cane), solver)
    used = {
        name: (mode.loss_factor, mode.loss_error, mode.loss_error_shared)
        for name, mode in resonances.items()
        if mode.loss_factor is not None and mode.loss_error is not None and name in names
    }
    if len(used) < _LEAST_MODES:
        raise FitError(
            f"{len(used)} modes with a loss factor cannot separate two loss factors of the cane; "
            f"{_LEAST_MODES} are needed"
        )
    measured, errors, shared = np.array(list(used.values())).T
    own = np.sqrt(np.maximum(errors**2 - shared**2, _LEAST_OWN**2))
    there = parts.some([names.index(n) for n in used]).with_unknown(measured * shared)
    return _fitted(list(used), there, measured, measured * own)


@dataclass(frozen=True)
class _Parts:
    """Parts of the loss factors of n modes.

    Attributes
    ----------
    cane : (n, 2) float
        Fractions of the energy in normal strains and in shear.
    sound : (n,) float
        Loss factor by radiated sound.
    unknown : (n, u) float
        Changes by one standard deviation of that sound, of the loss of the clamp, and of what
        errors of modes have in common.
    log_hz : (n,) float
        Log frequency over 4 kHz.
    """

    cane: Array
    sound: Array
    unknown: Array
    log_hz: Array

    def some(self, rows: list[int]) -> "_Parts":
        """Return the parts of some modes."""
        return _Parts(self.cane[rows], self.sound[rows], self.unknown[rows], self.log_hz[rows])

    def with_unknown(self, change: Array) -> "_Parts":
        """Return the same with the changes (n,) by one more unknown."""
        return replace(self, unknown=np.column_stack([self.unknown, change]))

    def losses(self, values: Array) -> tuple[Array, Array]:
        """Return loss factors (n,) and their derivatives (n, u + 3) for the values of `_solved`."""
        (growth,) = BY_ID["frequency_dependent_damping"].parameters
        grown = np.exp(growth.spread * values[-1] * self.log_hz)
        by_cane = self.cane * grown[:, None]
        cane = by_cane @ values[:2]
        by_growth = growth.spread * self.log_hz * cane
        slopes = np.column_stack([by_cane, self.unknown, by_growth])
        return cane + self.sound + self.unknown @ values[2:-1], slopes


def _solved(parts: _Parts, measured: Array, errors: Array) -> tuple[Array, Array]:
    """Fit both loss factors of the cane, and all unknowns and growth in standard deviations.

    Returns
    -------
    values : (u + 3,) float
    covariance : (u + 3, u + 3) float
    """
    # The loss factors of the cane have no prior.
    unknowns = parts.unknown.shape[1] + 1
    prior = np.diag([0.0, 0.0, *np.ones(unknowns)])
    values = np.array([measured.mean(), measured.mean(), *np.zeros(unknowns)])
    for _ in range(_STEPS):
        expected, slopes = parts.losses(values)
        weighted = slopes / errors[:, None] ** 2
        covariance = np.linalg.inv(slopes.T @ weighted + prior)
        values = values + covariance @ (weighted.T @ (measured - expected) - prior @ values)
    return values, covariance


def _fitted(names: list[str], parts: _Parts, measured: Array, errors: Array) -> CaneLosses:
    values, covariance = _solved(parts, measured, errors)
    freedom, residual = len(names) - 2, measured - parts.losses(values)[0]
    squares = float(np.sum((residual / errors) ** 2) + np.sum(values[2:] ** 2))
    scatter = 0.0
    if is_misfit(squares / freedom, freedom):
        scatter = float(added_cents(residual[None], errors, np.array([float(freedom)]))[0])
        values, covariance = _solved(parts, measured, np.hypot(errors, scatter))
        residual = measured - parts.losses(values)[0]
    normal, shear = (
        ValueWithError(float(values[k]), float(np.sqrt(covariance[k, k]))) for k in (0, 1)
    )
    return CaneLosses(
        normal=normal,
        shear=shear,
        correlation=float(covariance[0, 1] / (normal.error * shear.error)),
        residual={name: float(r) for name, r in zip(names, residual, strict=True)},
        reduced_chi2=squares / freedom,
        excess_scatter=scatter,
    )


def _parts(reed: Mechanics, solver: ReedSolver) -> tuple[list[str], _Parts]:
    """Return the names of the modes of a reed, and the parts of their loss factors."""
    found = vibrations(solver.reed, solver.state(reed), HIGHEST_HZ)
    sound = radiated(found)
    cane = np.column_stack(
        [loss_factors(found, LossFactors(*own)) - sound for own in ((1.0, 0.0), (0.0, 1.0))]
    )
    modes, springs = solver.modes(reed), _spring_fractions(reed, solver)
    rows = [_row(found, mode) for mode in modes.values()]
    in_clamp = _CLAMP_LOSS * np.array([springs.get(name, 0.0) for name in modes])
    unknown = np.column_stack([_RADIATION * sound[rows], in_clamp])
    log_hz = np.log(found.hz[rows] / PIVOT_HZ)
    return list(modes), _Parts(cane[rows], sound[rows], unknown, log_hz)


def _spring_fractions(reed: Mechanics, solver: ReedSolver) -> dict[str, float]:
    """Fraction of each mode's energy in a clamp that yields by one standard deviation, by name."""
    effect = BY_ID["clamp_compliance"]
    (size,) = effect.parameters
    yielding = effect.change(BenchParameters(reed=reed), {size.name: size.spread}).reed
    found = vibrations(solver.reed, solver.state(yielding), HIGHEST_HZ)
    fractions = spring_energies(found) / np.square(2 * np.pi * found.hz)
    return {
        name: float(fractions[_row(found, mode)]) for name, mode in solver.modes(yielding).items()
    }


def _row(found: Vibrations, mode: ReedMode) -> int:
    return int(np.abs(found.hz - mode.hz).argmin())
