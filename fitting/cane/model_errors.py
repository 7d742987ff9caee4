"""What a forward model does not know of a reed, as errors that its modes share.

A reed differs from its drawing in thickness, its cane from hypothesis H4, its clamp yields and is
put on by hand, the moduli that are not fitted have handbook values, the air is that of a free
plate, and that in the mouthpiece is a spring. Each such cause moves all modes together, by a
pattern that the reduced reed computes. Their ranges are those from which disorder is drawn
(`physics.parameters.disorder`), and the priors of the diagnosis (`physics.effects`).

Effects that the bench is known to have move all modes, too: by a known amount, and by causes of the
standard errors of their sizes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from holography.arrays import Array, Mask
from physics.air import pressure_on_reed
from physics.alterations import BED_SHEAR_SPREAD, RandomLayer
from physics.effects.catalogue import BY_ID
from physics.effects.effect import Effect
from physics.mechanics import HIGHEST_HZ, CaneShift, Mechanics, ReedSolver
from physics.parameters.disorder import BY_NAME, Disorder
from physics.parameters.tree import BenchParameters, more, with_cane, with_part
from physics.plausible.reeds import BEYOND_H4
from physics.plausible.surfaces import ThicknessFunctions
from physics.reed.radiation import AIR_DENSITY_KG_M3
from physics.reed.reduced.derivatives import local_shifts
from physics.reed.reduced.response import pressure_forces
from physics.reed.reduced.vibrations import vibrations
from physics.sized_effect import SizedEffect

_MAP = "thickness_map"
# Shifts below this are none. Chosen: far below any standard error.
_LEAST_CENTS = 0.1
# Relative standard deviation of the density of the air, from 960 to 1030 hPa (2.0 %) and from 15 to
# 30 °C (1.5 %), both equally distributed.
_AIR_DENSITY = 0.025
# Standard deviation of the flow's shape, from a free plate (0) to a reed in a wide wall (1).
# Chosen: a mouthpiece guides the air more than a free plate does and less than a wall.
_WALL = 0.5
# Air that a mouthpiece holds, closed by a tweeter: a bore 15 mm wide and 70 mm long. Chosen: about
# the bore of a clarinet's mouthpiece. Its spring is one standard deviation, and may be negative:
# above a quarter of a wavelength, at 1.2 kHz, air in a tube is a spring or a mass by turns.
_MOUTHPIECE_M3 = 0.25 * np.pi * 15e-3**2 * 70e-3
_DENSITY = "density"
# Numbers of a `CaneShift` by which cane differs from H4's cane of the drawing's density.
CANE = (_DENSITY, "E_L", "G_LT", "growth_E_L", "growth_G_LT")
# Ordinary disorder of each reed, and of each time that it is clamped.
_OF_REED = (_DENSITY, "thickness_slope", "E_T", "E_R", "G_LR", "G_TR", "nu_LT", "nu_LR", "nu_TR")
_OF_CLAMPING = ("clamp_shift", "clamp_tilt")


@dataclass(frozen=True)
class ModelErrors:
    """Shifts of m modes by q causes, each by one standard deviation.

    Attributes
    ----------
    modes : tuple of str
    causes : tuple of str
        Several of one name are patterns of one cause.
    cents : (q, m) float
    positive : (q,) bool
        Whether a cause is never negative: its prior is half of a normal distribution.
    of_clamping : (q,) bool
        Whether a cause is another one each time that the reed is clamped.
    own_cents : (m,) float
        Error of each mode by itself: what its shifts are not proportional to their causes.
    cane : (q, 5) float
        By which each cause changes the numbers `CANE` of a `CaneShift`.
    known_cents : (m,) float
        Shift of each mode by what is known of the bench.
    """

    modes: tuple[str, ...]
    causes: tuple[str, ...]
    cents: Array
    positive: Mask
    of_clamping: Mask
    own_cents: Array
    cane: Array
    known_cents: Array


@dataclass(frozen=True)
class _Cause:
    """A change of the bench by a number of standard deviations, which may be positive only."""

    name: str
    change: Callable[[float], BenchParameters]
    positive: bool = False
    of_clamping: bool = False


def model_errors(
    solver: ReedSolver,
    nominal: BenchParameters,
    modes: Sequence[str],
    known: Sequence[SizedEffect] = (),
) -> ModelErrors:
    """Compute how modes depend on what is not known of a reed.

    Parameters
    ----------
    solver : ReedSolver
        Of the kind of reed.
    nominal : BenchParameters
        The reed as far as it is known, but for the effects below.
    modes : sequence of str
    known : sequence of SizedEffect, optional
        Effects that the bench is known to have.

    Raises
    ------
    ImpossibleReedError
        If the known effects, or a change by one standard deviation, leave no reed.
    """
    without, nominal = nominal, _with_known(nominal, known)
    at_rest = _cents(solver, nominal.reed, modes)
    known_cents = at_rest - _cents(solver, without.reed, modes)
    causes = [*_causes(nominal), *_uncertain(without, known)]
    shifts, squares = [], np.zeros(len(modes))
    for cause in causes:
        linear, bend = _shift(solver, cause, at_rest, modes)
        shifts.append(linear)
        # What goes along with the shift is a matter of its size, which is fitted.
        bend = bend - linear * (bend @ linear) / max(float(linear @ linear), _LEAST_CENTS**2)
        squares += bend**2
    shifts.append(_by_bed_shear(solver, nominal, modes))
    shifts.append(_WALL * _by_wall(solver, nominal.reed, modes))
    shifts.append(_by_mouthpiece(solver, nominal, modes))
    maps = _by_maps(solver, nominal.reed, modes)
    others = ("bed_shear", "wall", "mouthpiece", *[_MAP] * len(maps))
    names = (*(cause.name for cause in causes), *others)
    none = [False] * len(others)
    return ModelErrors(
        modes=tuple(modes),
        causes=names,
        cents=np.concatenate([np.stack(shifts), maps]),
        positive=np.array([cause.positive for cause in causes] + none),
        of_clamping=np.array([cause.of_clamping for cause in causes] + none),
        own_cents=np.sqrt(squares),
        cane=np.array([[_of_cane(name) * (name == field) for field in CANE] for name in names]),
        known_cents=known_cents,
    )


def _with_known(
    nominal: BenchParameters,
    known: Sequence[SizedEffect],
    number: int = -1,
    size: int = 0,
    deviations: float = 0.0,
) -> BenchParameters:
    """Return a bench with known effects, one of which has one size off by standard errors."""
    for place, effect in enumerate(known):
        off = [0.0] * len(effect.uncertain)
        if place == number:
            off[size] = deviations
        nominal = effect.change(nominal, tuple(off))
    return nominal


def _uncertain(nominal: BenchParameters, known: Sequence[SizedEffect]) -> Iterator[_Cause]:
    """Yield the standard errors of the sizes of known effects."""
    for number, effect in enumerate(known):
        for size in range(len(effect.uncertain)):
            yield _Cause(effect.effect.id, partial(_with_known, nominal, known, number, size))


def _causes(nominal: BenchParameters) -> Iterator[_Cause]:
    """Yield everything but the shape of the flow and maps of thickness."""
    for name in ("thickness_offset", "clamp_compliance"):
        effect = BY_ID[name]
        played = partial(_with_effect, nominal, effect)
        clamped = name == "clamp_compliance"
        yield _Cause(name, played, positive=effect.parameters[0].positive, of_clamping=clamped)
    for name in (*_OF_REED, *_OF_CLAMPING):
        kind = BY_NAME[name]
        drawn = partial(_with_disorder, nominal, kind, kind.ordinary.deviation, 0)
        yield _Cause(name, drawn, of_clamping=name in _OF_CLAMPING)
    for name in CANE:
        if name != _DENSITY:
            yield _Cause(name, partial(_with_cane, nominal, name))
    yield _Cause("air", partial(_with_air, nominal, _AIR_DENSITY))


def _with_effect(nominal: BenchParameters, effect: Effect, deviations: float) -> BenchParameters:
    (size,) = effect.parameters
    return effect.change(nominal, {size.name: deviations * size.spread})


def _with_disorder(
    nominal: BenchParameters, kind: Disorder, sd: float, seed: int, deviations: float
) -> BenchParameters:
    return kind.change(nominal, deviations * sd, seed)


def cane_shift(amounts: Array, cane: Array) -> CaneShift:
    """Return how causes of given amounts (q,) change the cane; for `cane` see `ModelErrors`."""
    return CaneShift(**dict(zip(CANE, (amounts @ cane).tolist(), strict=True)))


def _of_cane(name: str) -> float:
    """Return one standard deviation of a number of `CANE`; 0 for any other cause."""
    if name == _DENSITY:
        return BY_NAME[name].ordinary.deviation
    return BEYOND_H4.get(name, 0.0)


def _with_cane(nominal: BenchParameters, name: str, deviations: float) -> BenchParameters:
    return with_cane(nominal, **{name: deviations * _of_cane(name)})


def _with_air(nominal: BenchParameters, sd: float, deviations: float) -> BenchParameters:
    share = nominal.reed.air_share * (1 + deviations * sd)
    return with_part(nominal, "reed", air_share=share)


def _cents(solver: ReedSolver, reed: Mechanics, modes: Sequence[str]) -> Array:
    found = solver.modes(reed)
    return np.array([1200 * np.log2(found[name].hz) for name in modes])


def _shift(
    solver: ReedSolver, cause: _Cause, at_rest: Array, modes: Sequence[str]
) -> tuple[Array, Array]:
    """Shift (m,) by one standard deviation, and by how much it is not proportional (m,)."""
    ahead = _cents(solver, cause.change(1.0).reed, modes) - at_rest
    if cause.positive:
        halfway = _cents(solver, cause.change(0.5).reed, modes) - at_rest
        return ahead, 2 * halfway - ahead
    behind = _cents(solver, cause.change(-1.0).reed, modes) - at_rest
    return 0.5 * (ahead - behind), 0.5 * (ahead + behind)


def _by_maps(solver: ReedSolver, reed: Mechanics, modes: Sequence[str]) -> Array:
    """Shifts (m, m) that have the covariance of those by random maps of thickness, to first order.

    A mode follows the thickness at a place by Hadamard's formula: by the energy of its strains
    there less that of its motion.
    """
    named, found = solver.modes(reed), vibrations(solver.reed, solver.state(reed), HIGHEST_HZ)
    rows = [int(np.abs(found.hz - named[name].hz).argmin()) for name in modes]
    local = local_shifts(found)[:, rows]
    x, y = solver.reed.bark_m.T
    local = local * (solver.reed.area_m2 * (x < solver.reed.geometry.vamp_x_m[-1]))[:, None]
    functions = ThicknessFunctions.of(
        solver.reed.geometry, RandomLayer.correlation_x_m, RandomLayer.correlation_y_m
    )
    thickness = functions.at(x, y)
    if None not in solver.reed.loose:
        # Half a reed: what is odd across it moves no mode.
        thickness = 0.5 * (thickness + functions.at(x, -y))
    by_function = thickness @ local
    # As many patterns as modes have the same covariance.
    values, vectors = np.linalg.eigh(by_function.T @ by_function)
    rms_m = BY_NAME[_MAP].ordinary.root_mean_square
    cents = 1200 / np.log(2) * rms_m * np.sqrt(np.maximum(values, 0.0))
    return np.asarray((vectors * cents).T)


def _by_bed_shear(solver: ReedSolver, nominal: BenchParameters, modes: Sequence[str]) -> Array:
    """Shift (m,) by what a clamp that yields as usual yields along the reed."""
    yields = _with_effect(nominal, BY_ID["clamp_compliance"], 1.0)
    ahead, behind = (
        _cents(solver, more(yields, "reed", bed_shear_log=log).reed, modes)
        for log in (BED_SHEAR_SPREAD, -BED_SHEAR_SPREAD)
    )
    return 0.5 * (ahead - behind)


def _by_wall(solver: ReedSolver, reed: Mechanics, modes: Sequence[str]) -> Array:
    """Shift (m,) if the reed lay in a wide wall: that by all air, by their masses."""
    air, found = solver.reed.air, solver.modes(reed)
    if air is None:
        return np.zeros(len(modes))
    by_air = _cents(solver, reed, modes) - _cents(solver, replace(reed, air_share=0.0), modes)
    ratios = []
    for name in modes:
        x = found[name].coordinates
        each = zip(np.split(x, solver.reed.starts[1:]), air.wall_kg, strict=True)
        walled = sum(float(own @ mass @ own) for own, mass in each)
        ratios.append(walled / float(x @ air.products(found[name].hz, x)))
    return np.asarray(by_air * ratios)


def _by_mouthpiece(solver: ReedSolver, nominal: BenchParameters, modes: Sequence[str]) -> Array:
    """Shift (m,) by the air that a reed compresses in the mouthpiece, to first order.

    Air of volume V resists a displaced volume by the pressure ρc²/V per volume.
    """
    found, chamber = solver.modes(nominal.reed), nominal.chamber
    even = partial(pressure_on_reed, chamber)
    displaced = np.concatenate(list(pressure_forces(solver.reed, 0.0, even, loose=True).values()))
    # Modes have unit mass over half a reed, and half a reed displaces half of the volume.
    halves = 1 if None in solver.reed.loose else 2
    spring = AIR_DENSITY_KG_M3 * chamber.sound_speed_m_s**2 / _MOUTHPIECE_M3
    squares = [
        halves * (found[name].coordinates @ displaced / (2 * np.pi * found[name].hz)) ** 2
        for name in modes
    ]
    return np.asarray(600 / np.log(2) * spring * np.real(squares))
