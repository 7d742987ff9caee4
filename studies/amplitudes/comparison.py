"""Compare stated displacements with those of the renderer."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.context import BenchContext
from drivers.simulated.lab import SimulatedLab
from drivers.simulated.settings import cane_of
from fitting.amplitudes.vamp import vamp_points
from fitting.cane.sweep_fit import SweepFit
from fitting.forward import basis_of
from physics.bench import BenchModel
from physics.errors import ImpossibleReedError
from physics.reed.cane.viscoelastic import Series, viscoelastic_cane
from physics.reed.reduced.elastic import air_masses_kg, viscoelastic_mode
from physics.reed.surface import surface_shapes
from protocols.plan import Plan


@dataclass(frozen=True)
class Comparison:
    """One stated displacement and its truth.

    Attributes
    ----------
    reed, name : str
        Name of the mode; empty for the whole reed.
    hz : float
    true_nm, nm, error_nm : float
    """

    reed: str
    name: str
    hz: float
    true_nm: float
    nm: float
    error_nm: float

    @property
    def pull(self) -> float:
        """Deviation in standard errors."""
        return (self.nm - self.true_nm) / self.error_nm


def model_of(plan: Plan, reed: str) -> BenchModel:
    """Return the model that renders the frames of a reed, on a small sensor."""
    context = BenchContext(
        plan.bench, plan.preparation(reed), np.random.default_rng(0), lambda _: None
    )
    lab = SimulatedLab(context)
    lab.prepare_sensor((128, 160))
    return lab.model


def compare_peaks(sweep: SweepFit, plan: Plan, model: BenchModel) -> list[Comparison]:
    """Compare the largest displacement of every explained hologram with the renderer's."""
    joint = sweep.joint
    if joint is None:
        return []
    blocks = joint.block_amplitudes
    points = vamp_points(basis_of(sweep.reed_file), joint.basis, blocks.x_m, blocks.y_m)
    steps, response = {step.index: step for step in plan.steps}, sweep.response
    drives = [(steps[int(k)].drive_hz, float(steps[int(k)].volts)) for k in response.step_index]
    true_nm = 1e9 * np.abs(model.displacement_at_m(points.x_m, points.y_m, drives)).max(axis=1)
    return [
        Comparison(sweep.reed, "", *map(float, numbers))
        for numbers in zip(
            response.drive_hz, true_nm, response.peak.nm, response.peak.error_nm, strict=True
        )
        if np.isfinite(numbers[2])
    ]


def compare_modes(sweep: SweepFit, model: BenchModel) -> list[Comparison]:
    """Compare the amplitude of every identified mode at its resonance with the renderer's."""
    joint = sweep.joint
    if joint is None:
        return []
    reed = basis_of(sweep.reed_file)
    blocks = joint.block_amplitudes
    points = vamp_points(reed, joint.basis, blocks.x_m, blocks.y_m)
    surface = surface_shapes(reed, points.x_m, points.y_m)
    cane, found = viscoelastic_cane(cane_of(sweep.reed), Series(sweep.series)), []
    for name, stated in sweep.resonances.items():
        try:
            mode = viscoelastic_mode(reed, cane, name, stated.frequency_hz)
        except ImpossibleReedError:
            continue
        volts = float(np.interp(mode.frequency_hz, sweep.response.drive_hz, sweep.response.volts))
        moved = model.coordinates_m(mode.frequency_hz, volts)[mode.part]
        number = list(reed.parts).index(mode.part)
        mass = reed.cane.density_kg_m3 * reed.parts[mode.part].mass
        air_kg = air_masses_kg(reed, mode.frequency_hz, 1.0)[number]
        if air_kg is not None:
            mass = mass + air_kg
        # The shape has unit mass, with that of the air.
        along = abs(complex(mode.coordinates @ mass @ moved))
        true_nm = 1e9 * along * float(np.abs(surface[mode.part] @ mode.coordinates).max())
        numbers = mode.frequency_hz, true_nm, stated.amplitude_nm, stated.amplitude_error_nm
        found.append(Comparison(sweep.reed, name, *(float(n or np.nan) for n in numbers)))
    return found


def summary(rows: Sequence[Comparison]) -> dict[str, float]:
    """Errors, pulls and coverage of some comparisons."""
    if not rows:
        return {"count": 0}
    off_nm = np.array([row.nm - row.true_nm for row in rows])
    relative = off_nm / [row.true_nm for row in rows]
    pulls = np.array([row.pull for row in rows])
    return {
        "count": len(rows),
        "median_off_nm": float(np.median(np.abs(off_nm))),
        "largest_off_nm": float(np.abs(off_nm).max()),
        "median_error_nm": float(np.median([row.error_nm for row in rows])),
        "mean_relative": float(np.mean(relative)),
        "rms_pull": float(np.sqrt(np.mean(pulls**2))),
        "coverage_68": float(np.mean(np.abs(pulls) < 1)),
    }
