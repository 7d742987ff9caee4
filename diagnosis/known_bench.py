"""What is known of a bench before its diagnosis: what its files say, and effects it surely has."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fitting.known_bench import bench_of
from physics.parameters.optics import Layout
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters
from physics.sized_effect import SizedEffect
from protocols.bench import BenchFile
from protocols.bench_parameters import (
    known_effects,
    nominal_parameters,
    sensor_of_camera,
    sized_effects,
)
from runs.reader import Run


def sensor_of(bench: BenchFile | None, run: Run) -> Sensor:
    """Sensor of a run, nominal in what nothing says of it."""
    transform = run.reconstruction.transform
    sensor = sensor_of_camera(bench.instruments.camera) if bench else Sensor()
    return replace(sensor, shape=transform.shape, pixel_m=transform.pixel_m)


def parameters_of(run: Run, bench: BenchFile | None) -> BenchParameters:
    """Return the nominal parameters of the bench of a run, without effects."""
    transform = run.reconstruction.transform
    return nominal_parameters(
        Layout(wavelength_m=transform.wavelength_m, distance_m=transform.distance_m),
        sensor_of(bench, run),
        geometry=run.reed_file().geometry(),
        chamber=run.chamber,
        series=run.series,
        resonances_hz=tuple(float(hz) for hz in run.acoustic_resonances_hz),
    )


@dataclass(frozen=True)
class KnownEffects:
    """Effects that a bench is known to have.

    Attributes
    ----------
    effects : tuple of SizedEffect
    foreseen : bool
        Whether they were known before the runs were measured: the bench file in the runs has them.
    """

    effects: tuple[SizedEffect, ...] = ()
    foreseen: bool = False


def known_effects_of(run: Run, bench: BenchFile | None = None) -> KnownEffects:
    """Return the effects that a bench file lists under ``known:``.

    Parameters
    ----------
    run : Run
        First sweep of a campaign.
    bench : BenchFile, optional
        By default, the one that the run carries.

    Raises
    ------
    ProtocolError
        If there is no such effect or size, or a size has another unit.
    """
    own = bench_of(run)
    described = bench or own
    listed = known_effects(described)
    source = described.source if described else ""
    return KnownEffects(
        sized_effects(listed, f"{source}: known"), foreseen=listed == known_effects(own)
    )


def only_once(known: Sequence[SizedEffect]) -> tuple[str, ...]:
    """Return those of the known effects that a model cannot have twice."""
    return tuple(sized.effect.id for sized in known if sized.effect.unique)
