"""Bench and protocol descriptions of the second laboratory, and the truth about its reeds."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from protocols.bench import BenchFile
from protocols.protocol import Protocol
from studies.second_laboratory.drive import Drive
from studies.second_laboratory.laboratory import solved
from studies.second_laboratory.parameters import (
    BenchParameters,
    CameraParameters,
    ReedParameters,
)
from studies.second_laboratory.reed import Pole, Reed

# Rows and columns: a quarter of the paper's sensor in each direction, half, all of it.
SENSORS: dict[str, tuple[int, int]] = {
    "small": (256, 320),
    "quarter": (512, 640),
    "full": (1024, 1280),
}
# Length of the vamp (paper, section II.A.2) and its half width at the tip (drawing of the reed);
# points outside the contour count as on it.
_VAMP_MM = 38.0, 6.5
_MODULE = "studies.second_laboratory.instruments"


def bench_file(
    series: str, reed_seed: int, bench_seed: int, disorder: Mapping[str, float]
) -> BenchFile:
    """Return the shipped simulated bench with the instruments of this laboratory."""
    nominal = CameraParameters()
    return BenchFile.from_file("simulated").replace(
        {
            "name": "second laboratory",
            "instruments.synthesizers.driver": f"{_MODULE}:SecondSynthesizers",
            "instruments.generator.driver": f"{_MODULE}:SecondGenerator",
            "instruments.camera.driver": f"{_MODULE}:SecondCamera",
            "instruments.camera.options": {
                "reed_seed": reed_seed,
                "bench_seed": bench_seed,
                "series": series,
                "disorder": dict(disorder),
            },
            "instruments.camera.data_sheet": {
                "offset_dn": nominal.offset_dn,
                "gain_e_dn": nominal.electrons_per_dn,
                "read_noise_e": nominal.read_noise_e,
                "full_well_e": nominal.full_well_e,
            },
        }
    )


def protocol(series: str, sensor: str) -> Protocol:
    """Return the paper's sweep of a series on a part of the sensor."""
    rows, columns = SENSORS[sensor]
    return Protocol.from_file(f"series{series}").replace(
        {"camera.width": columns, "camera.height": rows}
    )


def reed_truth(reed: ReedParameters, bench: BenchParameters | None = None) -> dict[str, Any]:
    """Return what is true of a reed on its bench.

    Parameters
    ----------
    reed : ReedParameters
    bench : BenchParameters, optional
        With it, each mode also has ``nm_per_volt``: its largest displacement on the bark side of
        the vamp, for a peak volt at its frequency, without the other modes.

    Returns
    -------
    dict
        ``modes.NAME``: `Pole` less its vector, and E_L and G_LT in MPa at the frequency.
        ``components``: e1 … e4; ``components_over_rho``: see `Cane.components_over_density`.
        ``density_kg_m3``, ``loss_E``, ``loss_G``, ``temperature_c``, ``E_T`` … ``G_TR`` (MPa).
        ``moduli``: Zener parameters of the sweep under the names of a fit.
    """
    model, cane = solved(reed), reed.cane
    young, shear = cane.zener()
    warm = cane.warmth()
    modes: dict[str, Any] = {}
    for pole in model.poles:
        omega = 2 * np.pi * pole.frequency_hz
        modes[pole.name] = {
            "hz": pole.frequency_hz,
            "loss_factor": pole.loss_factor,
            "pole_hz": pole.pole_hz,
            "pole_loss": pole.pole_loss,
            "E_L_mpa": warm * young(omega).real,
            "G_LT_mpa": warm * shear(omega).real,
        }
        if bench is not None:
            drive = Drive(bench.drive, clay=cane.dryness == 0.0)
            modes[pole.name]["nm_per_volt"] = 1e6 * mode_mm(model, drive, pole)
    at_4khz = 2 * np.pi * 4000.0
    return {
        "modes": modes,
        "components": list(cane.components),
        "components_over_rho": cane.components_over_density(),
        "moduli": {
            "E1_mpa": warm * young.relaxed,
            "E2_mpa": warm * young.arm,
            "G1_mpa": warm * shear.relaxed,
            "G2_mpa": warm * shear.arm,
            "E_4kHz_mpa": warm * young(at_4khz).real,
            "G_4kHz_mpa": warm * shear(at_4khz).real,
        },
        "density_kg_m3": cane.density,
        "loss_E": cane.loss_E,
        "loss_G": cane.loss_G,
        "temperature_c": cane.temperature_c,
        **{name: getattr(cane, name) for name in ("E_T", "E_R", "G_LR", "G_TR")},
    }


def mode_mm(model: Reed, drive: Drive, pole: Pole) -> float:
    """Return the largest displacement of a mode alone at its frequency, per volt."""
    # Between nodes too, as the nodes of the vamp's inside are far apart.
    x, y = np.meshgrid(np.linspace(0, _VAMP_MM[0], 153), np.linspace(-1, 1, 53) * _VAMP_MM[1])
    hz, vector = pole.frequency_hz, pole.vector
    force = vector @ model.load(drive.pressure_mpa(hz, model.load_x, model.load_y))
    lost = pole.loss_factor * (2 * np.pi * hz) ** 2
    shapes = [model.deflection(x.ravel(), y.ravel()), model.deflection_of_nodes(_VAMP_MM[0])]
    largest = np.abs(np.concatenate(shapes) @ vector).max()
    return float(largest * abs(force) / lost)
