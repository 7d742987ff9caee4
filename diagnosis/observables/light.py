"""Noise next to the image, and what else is in the fringes."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from diagnosis.observable_groups import (
    DISORDER,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    ObservableGroup,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.observables.brightness import PIECES, columns_of, scatter_of, walk_columns
from diagnosis.observables.carrier import Leaks, leaks_in
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import SweepReading, at_highest_level
from diagnosis.readings.templates import TEMPLATES
from holography.arrays import Array, ComplexArray
from physics.mechanics import ReedSolver
from physics.optics import log_laser_power
from physics.parameters.tree import BenchParameters

# Log of the noise next to the image: its level (gain and read noise within the tolerances of data
# sheets), and from sweep to sweep.
_NOISE, _NOISE_SWEEP = 0.1, 2e-3
# Power of regulated lasers: standard deviation of its log after an hour, as of a random walk. Data
# sheets of diode lasers: 0.5 to 2 % over hours.
_POWER_H = 0.01
# ... and of a mean, for programs that record one noise for all.
_LEAST_NOISE = 1e-5
# Share of a carrier that looks like the next sideband once it has been taken off, and what doubt
# that leaves of either.
_LEFT_OF_CARRIER, _OF_TAKEN_OFF = 0.2, (0.15, 3e-3)
# Amplitudes below which templates are not compared: what digitising leaves. Chosen.
_LEAST_TEMPLATE = (1e-3, 1e-5)


def noise_group(sweeps: Sequence[SweepReading], dark_dn: float) -> ObservableGroup:
    """Compare noise next to the image, mostly shot noise of the local oscillator, over time.

    Fixed-pattern noise spreads fringes all over the image.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    dark_dn : float
        Noise of a dark pixel in one frame.
    """
    values, variance, places, times, fringes = [], [], [], [], []
    columns: list[dict[str, float]] = []
    for sweep in sweeps:
        order = np.argsort(sweep.time_s)
        log = np.log(sweep.noise_dn2)
        spread = scatter_of(log[order])
        for number, piece in enumerate(np.array_split(order, PIECES // 2)):
            values.append(float(np.mean(log[piece])))
            variance.append(max(1.2 * spread**2 / len(piece), _LEAST_NOISE**2))
            times.append(float(np.mean(sweep.time_s[piece])))
            fringes.append(float(np.mean(sweep.fringe_dn2[piece])))
            places.append(Coordinates("noise next to the image", time=f"{sweep.name} {number + 1}"))
            columns.append({f"sweep {sweep.name}": _NOISE_SWEEP})
    usual, time_s = float(np.mean(values)), np.array(times)
    beside = np.array(fringes) / np.exp(min(values))
    # A hologram has the noise of four frames.
    shot_share = float(np.clip(1 - 4 * dark_dn**2 / np.exp(usual), 0.0, 1.0))

    def predict(parameters: BenchParameters) -> Array:
        shot = usual + shot_share * log_laser_power(parameters.optics.interference, time_s)
        noise: Array = shot + np.log1p(parameters.sensor.pattern**2 * beside)
        return noise

    power = shot_share * _POWER_H * walk_columns(time_s / 3600)
    errors = Errors(
        np.diag(variance) + _NOISE**2,
        (
            GroupNuisances("noise of sweeps", columns_of(columns), DISORDER, "chosen"),
            GroupNuisances("laser power", power, DISORDER, "data sheets of diode lasers"),
        ),
    )
    return observable_group(
        "noise", Observable.SENSOR, values, errors, places, ("optics", "sensor"), predict
    )


def fringe_group(sweeps: Sequence[SweepReading]) -> ObservableGroup | None:
    """Compare other light in the fringes, by templates, in all loud sweeps together.

    What no other light looks like, but holograms may be off by in the same way, shows how much of a
    template misfit alone makes. None if no hologram has any fringes.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    """
    loud = _with_fringes(at_highest_level(sweeps))
    if not loud:
        return None
    each = np.array([[_mixed(sweep), _decorrelated(sweep).real] for sweep in loud])
    floors = np.median([[_decoy(sweep), abs(_decorrelated(sweep).imag)] for sweep in loud], axis=0)
    floors = np.maximum(floors, _LEAST_TEMPLATE)
    off = max(sweep.taken_off for sweep in loud)
    # A carrier goes as J0, the next sideband as J2: apart from a constant they are similar.
    alike = _LEFT_OF_CARRIER if off else 1.0

    def predict(parameters: BenchParameters) -> Array:
        beams = parameters.optics.interference
        mixed = np.sqrt(beams.crosstalk**2 + (alike * beams.leak) ** 2 + floors[0] ** 2)
        return np.array([mixed, beams.decorrelation_per_rad2])

    scatter = each.std(axis=0, ddof=1) if len(each) > 1 else np.zeros(2)
    errors = np.sqrt(floors**2 + scatter**2 + (off * np.array(_OF_TAKEN_OFF)) ** 2)
    places = [Coordinates("sideband crosstalk"), Coordinates("decorrelation")]
    return observable_group(
        "fringes", Observable.MAPS, np.median(each, axis=0), Errors(errors, (), DISORDER), places,
        ("optics",), predict,
    )  # fmt: skip


def mixing_in(sweeps: Sequence[SweepReading]) -> float:
    """Amplitude of the next sideband in the loud sweeps, beyond what misfit looks like anyway."""
    loud = _with_fringes(at_highest_level(sweeps))
    if not loud:
        return 0.0
    return max(float(np.median([_mixed(s) - 2 * _decoy(s) for s in loud])), 0.0)


def _with_fringes(sweeps: Sequence[SweepReading]) -> list[SweepReading]:
    """Sweeps of which at least one driven hologram has fringes."""
    told = [np.isfinite(sweep.template_variance).all(axis=0) & ~sweep.off for sweep in sweeps]
    return [sweep for sweep, there in zip(sweeps, told, strict=True) if there.any()]


def _mixed(sweep: SweepReading) -> float:
    """Root mean square amplitude of the next sideband."""
    return _root_mean_square(sweep, "sideband_crosstalk")


def _decoy(sweep: SweepReading) -> float:
    """The same of a template that no light makes."""
    return _root_mean_square(sweep, "decoy")


def _root_mean_square(sweep: SweepReading, name: str) -> float:
    amplitude, variance = _template(sweep, name)
    square = np.sum((np.abs(amplitude) ** 2 - variance) / variance**2) / np.sum(1 / variance**2)
    return float(np.sqrt(max(square, 0.0)))


def _decorrelated(sweep: SweepReading) -> complex:
    """Mean amplitude of lost contrast; light that is lost is in phase, and misfit in any phase."""
    amplitude, variance = _template(sweep, "decorrelation")
    return complex(np.sum(amplitude / variance) / np.sum(1 / variance))


def _template(sweep: SweepReading, name: str) -> tuple[ComplexArray, Array]:
    t = TEMPLATES.index(name)
    told = np.isfinite(sweep.template_variance[t]) & ~sweep.off
    return sweep.template[t, told], sweep.template_variance[t, told]


def leaks_of(readings: Readings) -> Leaks:
    """Return what leaks into the sweeps of a campaign."""
    return leaks_in(readings.carriers, readings.sweeps, mixing_in(readings.sweeps))


def _noise(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    if not readings.sweeps:
        return None
    sensor = readings.nominal.sensor
    dark = readings.dark.noise_dn if readings.dark else sensor.read_noise_e / sensor.gain_e_dn
    return noise_group(readings.sweeps, dark)


def _fringes(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return fringe_group(readings.sweeps) if readings.sweeps else None


SOURCES: Final = (GroupSource(11, _noise), GroupSource(12, _fringes))
