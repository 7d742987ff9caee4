"""Runs of reeds that are not those that plan and fit know, with the truth of each.

Every reed has a vamp of its own, not its own mirror image, and cane of its own; it is driven by a
pressure that is not the model's, under light that changes from hologram to hologram, on a bench
with ordinary disorder. `wrong_bench` says how all this is drawn. The truth is that of the reduced
reed that the bench plays: its vamp and its nine constants are other than those of the fit, its code
is not. `studies.second_laboratory` shares no code with the fit.

    python -m studies.wrong_reeds FOLDER [--count N] [--first K] [--series A B] [--jobs N]
"""

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legval2d
from scipy.optimize import least_squares

from acquire.runner.runner import run
from drivers.registry import open_bench
from drivers.simulated.settings import (
    CaneFactors,
    bench_constants,
    bench_geometry,
    bench_parameters,
    cane_of,
    read_simulation,
)
from fitting.cane.over_density import QUOTED_HZ
from holography.arrays import Array
from physics.parameters.disorder import BY_NAME, ordinary_amounts
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.geometry import (
    Outline,
    ReedGeometry,
    half_width_m,
    thickness_m,
)
from physics.reed.modes import HIGHEST_HZ
from physics.reed.reduced.dynamics import CaneLaw, LossFactors, State
from physics.reed.reduced.elastic import named_vibrations
from physics.reed.reduced.losses import loss_factors
from physics.reed.reduced.stored import reduced_reed
from physics.reed.reduced.vibrations import vibrations
from physics.reed.surface import on_reed
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol

PROTOCOLS = {Series.A: "seriesA", Series.B: "seriesB"}
# Length and half width of the vamp, and the points of the thickness map on it.
VAMP_M = (35e-3, 6.5e-3)
MAP_X_MM, MAP_Y_MM = np.linspace(0.0, 35.0, 36), np.linspace(-6.5, 6.5, 27)
# Degrees along the vamp and across it of the random polynomials.
DEGREES = (4, 4)
# Frequencies from F1 to F4, from which moduli are heard.
HEARD_HZ = (1900.0, 16_800.0)
# No constant is farther off than this many standard deviations.
MOST_DEVIATIONS = 2.0
# Disorder that the bench's own light has otherwise: see `wrong_bench`.
_OF_LIGHT = ("gain_scatter", "path_step")
# Disorder of cane that no factor on its constants is.
_OF_CANE = "shear_loss"


def wrong_bench(
    reed: str,
    seed: int,
    *,
    thickness_um: float = 10.0,
    asymmetry: float = 0.03,
    constants: float = 0.10,
    pressure: float = 0.2,
    gain: float = 0.03,
    phase: bool = True,
) -> BenchFile:
    """Simulated bench on which stands another reed than its name says.

    The thickness of the vamp is that of the drawing plus a map, the sum of

    * an even random polynomial of degree 4 in x and y (normal weights that fall with the degree),
      whose largest value on the reed is `thickness_um`, and
    * an odd one, of degree 4 in x and 3 in y, times the local thickness, such that left and right
      differ by `asymmetry` of the thickness where they differ most, and by some two fifths of that
      in the rms. (On the thick end of the vamp that alone is up to tens of µm.)

    All nine elastic constants and the density are multiplied by 1 + `constants`·N(0, 1), drawn
    again beyond 2 standard deviations. Pressure and light are as `drivers.simulated.settings` says.
    Shear loses more than bending, and clocks, camera, sound and light have disorder, each within
    its ordinary range (`physics.parameters.disorder`).

    Parameters
    ----------
    reed : str
        Decides the components of the cane too (`cane_of`).
    seed : int
        Another wrong reed for each, with the same components.
    """
    rng = np.random.default_rng([seed, *hashlib.sha256(reed.encode()).digest()])
    deviation_um = _thickness_map_um(rng, thickness_um, asymmetry)
    factors = {name: _factor(rng, constants) for name in CaneFactors.model_fields}
    settings = {
        "shape": {
            "thickness_map": {
                "x_mm": MAP_X_MM.tolist(),
                "y_mm": MAP_Y_MM.tolist(),
                "deviation_um": np.round(deviation_um, 3).tolist(),
            }
        },
        "cane_factors": factors,
        "pressure": {"distortion": pressure, "seed": int(rng.integers(2**31))},
        "light": {"gain_scatter": gain, "phase_scatter": phase},
        "disorder": _disorder(reed, seed),
    }
    return BenchFile.from_file().replace({"twin": settings})


def _disorder(reed: str, seed: int) -> dict[str, Any]:
    """Return the section of a bench file with all disorder that the reed does not have already."""
    amounts: dict[str, Any] = {"seed": seed}
    for name, amount in ordinary_amounts(seed, reed).items():
        kind = BY_NAME[name]
        if name == _OF_CANE or not (kind.of_reed or name in _OF_LIGHT):
            amounts[name] = f"{amount:.6g} {kind.ordinary.unit}" if kind.ordinary.unit else amount
    return amounts


def _thickness_map_um(rng: np.random.Generator, thickness_um: float, asymmetry: float) -> Array:
    """Deviations (x, y) of the vamp from the drawing."""
    x_m, y_m = 1e-3 * np.array(np.meshgrid(MAP_X_MM, MAP_Y_MM, indexing="ij"))
    away_m = np.minimum(np.abs(y_m), half_width_m(Outline(), x_m))
    # Outside the reed the drawing's polynomial across means nothing: as at its sides.
    drawn_um = 1e6 * thickness_m(ReedGeometry(), x_m, away_m)
    even, odd = (_polynomial(rng, parity)(x_m, y_m) for parity in (0, 1))
    deviation: Array = thickness_um * even + 0.5 * asymmetry * drawn_um * odd
    return deviation


def _polynomial(rng: np.random.Generator, parity: int) -> Callable[[Array, Array], Array]:
    """Smooth random function of x and y, of a parity in y; its largest value on the vamp is ±1."""
    weights = rng.standard_normal([degree + 1 for degree in DEGREES])
    weights /= 1 + np.add.outer(*(np.arange(degree + 1) for degree in DEGREES))
    weights[:, 1 - parity :: 2] = 0.0
    length_m, side_m = VAMP_M

    def value(x_m: Array, y_m: Array) -> Array:
        return np.asarray(legval2d(2 * x_m / length_m - 1, y_m / side_m, weights))

    x_m, y_m = np.meshgrid(np.linspace(0, length_m, 141), np.linspace(-side_m, side_m, 131))
    on_vamp = on_reed(Outline(), x_m, y_m)
    largest = np.abs(value(x_m[on_vamp], y_m[on_vamp])).max()
    return lambda x_m, y_m: value(x_m, y_m) / largest


def _factor(rng: np.random.Generator, deviation: float) -> float:
    while True:
        deviate = float(rng.standard_normal())
        if abs(deviate) <= MOST_DEVIATIONS:
            return 1 + deviation * deviate


def truth_of(bench: BenchFile, reed: str, series: Series) -> dict[str, Any]:
    """Modes and cane of the reed that stands on a bench.

    Modes are those below 20 kHz of the reduced reed that the bench plays, each with the moduli and
    the air of its own frequency. Frequencies are without loss, losses to first order.

    Returns
    -------
    dict
        ``modes``: name → ``hz``, ``loss_factor``, ``symmetry`` (of the part with more energy) and
        ``similarity`` (low where modes exchange shapes, so that the name says little), ascending in
        frequency. ``moduli`` in MPa, ``density_kg_m3`` and ``components_over_rho``
        (`likest_components`).
    """
    plan = make_plan(Protocol.from_file(PROTOCOLS[series]), bench)
    preparation, simulation = plan.preparation(reed), read_simulation(bench.twin, bench.name)
    geometry = bench_geometry(simulation, preparation) or ReedGeometry()
    constants = bench_constants(simulation, preparation)
    parameters = bench_parameters(simulation, bench, preparation)
    cane = parameters.reed.cane
    level, basis = simulation.finite_elements
    settings = replace(basis, box=replace(basis.box, cane=constants))
    played = reduced_reed(geometry, level, settings)
    found = vibrations(played, State(CaneLaw(constants, cane), air=played.air), HIGHEST_HZ)
    loss = parameters.reed.loss_factor
    shear_loss = loss * float(np.exp(parameters.reed.shear_loss_log))
    losses = loss_factors(found, LossFactors(loss, shear_loss))
    modes = {
        mode.name: {
            "hz": mode.frequency_hz,
            "loss_factor": float(own),
            "symmetry": str(mode.symmetry),
            "similarity": mode.similarity,
        }
        for mode, own in zip(named_vibrations(found), losses, strict=True)
    }
    moduli = {"E1_mpa": cane.young_L.spring_mpa, "E2_mpa": cane.young_L.arm_spring_mpa}
    moduli |= {"G1_mpa": cane.shear_LT.spring_mpa, "G2_mpa": cane.shear_LT.arm_spring_mpa}
    for key, zener in (("E_4kHz_mpa", cane.young_L), ("G_4kHz_mpa", cane.shear_LT)):
        moduli[key] = 1e-6 * float(storage_modulus_pa(zener, QUOTED_HZ))
    return {
        "modes": modes,
        "moduli": moduli,
        "density_kg_m3": constants.density_kg_m3,
        "components_over_rho": likest_components(
            cane, constants.density_kg_m3, cane_of(reed), series
        ),
    }


def likest_components(
    cane: ViscoelasticCane, density_kg_m3: float, given: Components, series: Series
) -> dict[str, float]:
    """Return e1 … e3 of cane of the drawing's density that sounds most like another one.

    Frequencies show moduli over density only; e4 keeps its value. The fit that assumes the density
    of the drawing should find these.
    """
    hz = np.geomspace(*HEARD_HZ, 30)

    def logs(one: ViscoelasticCane) -> Array:
        return np.log([storage_modulus_pa(zener, hz) for zener in (one.young_L, one.shear_LT)])

    target = logs(cane) + np.log(Cane().density_kg_m3 / density_kg_m3)

    def misfit(e: Array) -> Array:
        tried = replace(given, e1=float(e[0]), e2=float(e[1]), e3=float(e[2]))
        return np.asarray((logs(viscoelastic_cane(tried, series)) - target).ravel())

    best = least_squares(misfit, (given.e1, given.e2, given.e3)).x
    return {f"e{number + 1}": float(value) for number, value in enumerate(best)}


@dataclass(frozen=True)
class WrongRun:
    """One run to be made: a reed in a series, and where to put it."""

    folder: Path
    number: int
    series: Series

    @property
    def reed(self) -> str:
        """Name of the reed."""
        return f"wrong-{self.number:02d}"

    @property
    def path(self) -> Path:
        """Run file."""
        return self.folder / f"{self.reed}-{self.series}.h5"


def make_run(wanted: WrongRun) -> str:
    """Measure one wrong reed and write its truth, as ``<run>.truth.json``."""
    start_s = time.perf_counter()
    bench_file = wrong_bench(wanted.reed, wanted.number)
    plan = make_plan(Protocol.from_file(PROTOCOLS[wanted.series]), bench_file)
    truth = {
        "reed": wanted.reed,
        "series": str(wanted.series),
        "components": asdict(cane_of(wanted.reed)),
        "twin": bench_file.twin,
        **truth_of(bench_file, wanted.reed, wanted.series),
    }
    with open_bench(bench_file, plan.preparation(wanted.reed), wanted.number) as bench:
        summary = run(plan, bench, wanted.path)
    wanted.path.with_suffix(".truth.json").write_text(json.dumps(truth, indent=1))
    taken_s = time.perf_counter() - start_s
    counts = ", ".join(f"{count} {verdict}" for verdict, count in summary.counts.items())
    return f"{wanted.path.name}: {summary.status}, {counts} ({taken_s:.0f} s)"


def make_runs(
    folder: Path, count: int, series: Sequence[Series], jobs: int = 2, first: int = 0
) -> None:
    """Measure reeds number `first` and on, each in every series, several at a time."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [WrongRun(folder, first + k, one) for k in range(count) for one in series]
    with ProcessPoolExecutor(jobs) as pool:
        for line in pool.map(make_run, wanted):
            print(line, file=sys.stderr, flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Runs of wrong reeds, with the truth.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=20, help="how many reeds")
    parser.add_argument("--first", type=int, default=0, help="number of the first reed")
    parser.add_argument("--series", nargs="+", type=Series, default=[Series.A])
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    arguments = parser.parse_args()
    make_runs(arguments.folder, arguments.count, arguments.series, arguments.jobs, arguments.first)


if __name__ == "__main__":
    main()
