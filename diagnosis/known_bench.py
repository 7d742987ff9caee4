"""What is known of a bench before its diagnosis: what its files say, and effects it surely has."""

from dataclasses import replace

from physics.effects.catalogue import BY_ID
from physics.parameters.optics import Layout
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters
from protocols.bench import BenchFile
from protocols.bench_parameters import (
    known_effects,
    nominal_parameters,
    sensor_of_camera,
    with_effects,
)
from protocols.errors import ProtocolError
from runs.reader import Run


def bench_of(run: Run) -> BenchFile | None:
    """Bench file that a run carries; None if it carries none that can be read."""
    try:
        return BenchFile.from_text(run.bench_text, "bench of the run")
    except ProtocolError:
        return None


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


def with_known_effects(parameters: BenchParameters, bench: BenchFile | None) -> BenchParameters:
    """Return parameters with the effects that a bench file lists under ``known:``.

    Raises
    ------
    ProtocolError
        If there is no such effect or size, or a size has another unit.
    """
    source = bench.source if bench else ""
    return with_effects(parameters, known_effects(bench), f"{source}: known")


def only_once(bench: BenchFile | None) -> tuple[str, ...]:
    """Return the effects that a bench states and that a model cannot have twice.

    Parameters
    ----------
    bench : BenchFile or None
        Whose effects are all in the catalogue.
    """
    return tuple(name for name in known_effects(bench) if BY_ID[name].unique)
