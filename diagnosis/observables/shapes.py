"""Mode shapes, as fractions of the elastic reed's modes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from diagnosis.inference.nuisances import layers
from diagnosis.observable_groups import (
    DISORDER,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    ObservableGroup,
    band_of,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.observables.carrier import Leaks
from diagnosis.observables.light import leaks_of
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import SweepReading, reference_of
from fitting.fringes.start_frequencies import SHAPES_HZ
from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.mechanics import (
    Mechanics,
    ReedMode,
    ReedSolver,
)
from physics.parameters.disorder import BY_NAME
from physics.parameters.tree import BenchParameters
from physics.reed.cane.viscoelastic import (
    ViscoelasticCane,
    Zener,
    storage_modulus_pa,
)
from physics.reed.elements.fem import Symmetry

# Shapes of higher modes are poorly determined.
_HIGHEST_HZ = 14e3
# Of a mode's share in another this much may be seen, as an amplitude, and counts.
_SEEN = 0.02
# What shares are off by: at least, of modes of one symmetry, of what a share is, and of what leaks
# into sweeps.
_LEAST, _SAME_KIND, _SHARE, _LEAK = 2e-3, 6e-3, 0.15, 0.1


@dataclass(frozen=True)
class _Share:
    """What mode `of` has of mode `has`, mean of all sweeps.

    Attributes
    ----------
    of, has : str
    amplitude, error : float
    """

    of: str
    has: str
    amplitude: float
    error: float


def shapes_group(
    sweeps: Sequence[SweepReading], reed_solver: ReedSolver, leaks: Leaks, nominal: BenchParameters
) -> ObservableGroup | None:
    """Compare mode shapes with the model's; None if none is well determined."""
    known = reed_solver.modes(nominal.reed)
    reference = reference_of(sweeps)
    names = [n for n in reference.names if n in known and known[n].hz < _HIGHEST_HZ]
    shares = _seen_shares(sweeps, names)
    if not shares:
        return None
    elastic = _Elastic.of(reed_solver, reference, nominal)

    def predict(parameters: BenchParameters) -> Array:
        modes = reed_solver.modes(parameters.reed)
        missing = [share.of for share in shares if share.of not in modes]
        if missing:
            raise ImpossibleReedError(f"a reed of this kind has no mode {missing[0]}")
        return np.array([elastic.share(modes[share.of], share.has) for share in shares])

    values = np.array([share.amplitude for share in shares])
    same = np.array([elastic.same_symmetry(share.of, share.has) for share in shares])
    errors = np.sqrt(
        np.square([share.error for share in shares])
        + np.where(same, _SAME_KIND, _LEAST) ** 2
        + (_SHARE * values) ** 2
        + (_LEAK * np.hypot(leaks.mixing, max(leaks.carrier.values(), default=0.0))) ** 2
    )
    places = [
        Coordinates(f"share of {share.has}", mode=share.of, band=band_of(known[share.of].hz))
        for share in shares
    ]
    columns = np.stack([predict(each) for each in _uneven(nominal)], axis=1)
    uneven = GroupNuisances(
        "thickness that is fine, or uneven across",
        columns - predict(nominal)[:, None],
        DISORDER,
        BY_NAME["thickness_map"].ordinary.source,
    )
    # How much finer maps of thickness mix modes is not known before: its scale is fitted.
    return observable_group(
        "shapes", Observable.MODES, values, Errors(errors, (uneven,), DISORDER), places, ("reed",),
        predict,
    )  # fmt: skip


def _uneven(nominal: BenchParameters) -> list[BenchParameters]:
    """Return ordinary reeds whose maps of thickness are odd across, or finer than nuisances."""
    maps = *layers(odd=True), *layers(odd=True, fine=True), *layers(odd=False, fine=True)
    layered = [each.change(nominal, each.spread) for each in maps]
    tilted = BY_NAME["clamp_tilt"]
    return [*layered, tilted.change(nominal, tilted.ordinary.deviation, 0)]


def _seen_shares(sweeps: Sequence[SweepReading], names: Sequence[str]) -> list[_Share]:
    """Return the fractions that are seen; of every two modes the better determined one."""
    best: dict[frozenset[str], _Share] = {}
    for of in names:
        for has in names:
            found = [_amplitude(sweep, of, has) for sweep in sweeps]
            measured = np.array([pair for pair in found if pair is not None])
            if of == has or len(measured) < max(1, len(sweeps) - 1):
                continue
            scatter = float(measured[:, 0].std(ddof=1)) if len(measured) > 1 else 0.0
            error = float(np.hypot(scatter, np.mean(measured[:, 1])))
            both = frozenset((of, has))
            if error < _SEEN and (both not in best or error < best[both].error):
                best[both] = _Share(of, has, float(np.mean(measured[:, 0])), error)
    return list(best.values())


def _amplitude(sweep: SweepReading, of: str, has: str) -> tuple[float, float] | None:
    """Share and standard error in one sweep; None where the fit allowed none."""
    if of not in sweep.names or has not in sweep.shape_names:
        return None
    at = sweep.shape_names.index(has), sweep.names.index(of)
    if not sweep.mixing_spread[at]:
        return None
    return float(sweep.mixing[at]), float(sweep.mixing_error[at])


def elastic_reed(nominal: BenchParameters) -> Mechanics:
    """Return the elastic reed whose modes are the shapes that sweeps of this cane are fitted by."""
    cane = nominal.reed.cane
    springs = (
        Zener(1e-6 * float(storage_modulus_pa(zener, SHAPES_HZ)), 0.0, 0.0)
        for zener in (cane.young_L, cane.shear_LT)
    )
    return Mechanics(cane=ViscoelasticCane(*springs))


@dataclass(frozen=True)
class _Elastic:
    """Modes of the elastic reed, which shares are shares of.

    Attributes
    ----------
    modes : mapping
        By name.
    mass : (s, s) float
    deflection : dict of float
        Of each mode where it moves most in holograms, of the sign that it has there.
    symmetry : dict of Symmetry
    """

    modes: Mapping[str, ReedMode]
    mass: Array
    deflection: dict[str, float]
    symmetry: dict[str, Symmetry]

    @classmethod
    def of(
        cls, reed_solver: ReedSolver, sweep: SweepReading, nominal: BenchParameters
    ) -> "_Elastic":
        """Settle the elastic reed, with signs as a sweep's fit has them."""
        modes = reed_solver.modes(elastic_reed(nominal))
        deflection, symmetry = {}, {}
        for name, at_m, value in zip(
            sweep.shape_names, sweep.shape_peak_m, sweep.shape_peak, strict=True
        ):
            if name in modes:
                here, symmetry[name] = _deflection(reed_solver, modes[name], at_m)
                deflection[name] = here / float(value)
        return cls(modes, reed_solver.mass_kg, deflection, symmetry)

    def share(self, mode: ReedMode, has: str) -> float:
        """What a mode has of another, both in units of their largest deflections."""
        own, other = (
            float(self.modes[name].coordinates @ self.mass @ mode.coordinates)
            for name in (mode.name, has)
        )
        return other * self.deflection[has] / (own * self.deflection[mode.name])

    def same_symmetry(self, one: str, other: str) -> bool:
        """Whether both are of one symmetry."""
        return self.symmetry[one] is self.symmetry[other]


def _deflection(reed_solver: ReedSolver, mode: ReedMode, at_m: Array) -> tuple[float, Symmetry]:
    """Deflection at a place (2,), and the symmetry of the mode."""
    reed = reed_solver.reed
    node = int(np.argmin(np.hypot(reed.plan_m[:, 0] - at_m[0], reed.plan_m[:, 1] - abs(at_m[1]))))
    parts = []
    for start, half in zip(reed.starts, reed.loose.values(), strict=True):
        own = mode.coordinates[start : start + half.size]
        (symmetry,) = half.measures
        sign = -1.0 if symmetry is Symmetry.ANTISYMMETRIC and at_m[1] < 0 else 1.0
        parts.append(
            (float(own @ half.mass @ own), sign * float(half.surface_z[node] @ own), symmetry)
        )
    return sum(part[1] for part in parts), max(parts, key=lambda part: part[0])[2]


def _shapes(readings: Readings, reed_solver: ReedSolver) -> ObservableGroup | None:
    sweeps = readings.sweeps
    if not sweeps:
        return None
    return shapes_group(sweeps, reed_solver, leaks_of(readings), readings.nominal)


SOURCES: Final = (GroupSource(17, _shapes),)
