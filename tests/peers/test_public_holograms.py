"""Holograms that others recorded: the pyDHM samples (MIT) next to the repository in ``../shared``.

Set ``REEDBENCH_SHARED`` to the folder that holds ``data/holograms`` to read them from elsewhere.
"""

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import fft

from holography.demodulation import (
    PhaseSteps,
    closure,
    four_phase,
    measure_phase_steps,
    unequal_steps,
)
from holography.focus import best_distance, focus_scan
from holography.region import Region

REPOSITORY = Path(__file__).resolve().parents[2]


def read_hologram(name):
    shared = Path(os.environ.get("REEDBENCH_SHARED", REPOSITORY.parent / "shared"))
    path = shared / "data" / "holograms" / name
    if not path.is_file():
        pytest.skip(f"{path} is absent; set REEDBENCH_SHARED to the folder with data/holograms")
    with Image.open(path) as image:
        pixels = np.asarray(image)
    return pixels if pixels.ndim == 2 else pixels[..., 0]


# --- horse.bmp: one lensless off-axis frame, 633 nm, 5 µm pixels -------------------------------

HORSE_OPTICS = {"pixel_m": 5e-6, "wavelength_m": 633e-9}
# The image order: lower right of the zero order in the middle.
HORSE_REGION = Region(row=540, column=720, height=470, width=558)


def test_horse_is_in_focus_at_600_mm():
    horse = read_hologram("horse.bmp")
    assert horse.shape == (1024, 1280)
    distance_m = best_distance(
        horse, **HORSE_OPTICS, distances_m=np.arange(0.4, 0.81, 0.05), region=HORSE_REGION
    )
    assert distance_m == pytest.approx(0.600, abs=0.010)


def test_horse_focus_stands_out():
    curve = focus_scan(
        read_hologram("horse.bmp"),
        **HORSE_OPTICS,
        distances_m=[0.3, 0.45, 0.6, 0.75, 0.9],
        region=HORSE_REGION,
    )
    assert curve[2] > 1.8 * np.delete(curve, 2).max()


def test_horse_is_not_in_focus_in_the_twin_order():
    twin = Region(row=14, column=2, height=470, width=558)
    curve = focus_scan(
        read_hologram("horse.bmp"), **HORSE_OPTICS, distances_m=[0.5, 0.6, 0.7], region=twin
    )
    assert curve[1] < 1.1 * curve[[0, 2]].max()


# --- Fresnel lens: four frames in nominal quadrature, 632.8 nm, 6.9 µm -------------------------


@pytest.fixture(scope="module")
def lens_frames():
    return np.stack([read_hologram(f"I{m}_Fresnel_Lens.bmp") for m in range(4)])


def carrier_order(field, side):
    """Spectrum of a field in one order of its carrier, 45 periods per frame down the rows."""
    rows, columns = field.shape
    window = np.outer(np.hanning(rows), np.hanning(columns))
    cycles_y = side * fft.fftfreq(rows, 1 / rows)
    cycles_x = np.abs(fft.fftfreq(columns, 1 / columns))
    in_order = (cycles_y > 20) & (cycles_y < 70)
    return fft.fft2(field * window)[in_order][:, cycles_x < 60]


def image_order(field):
    return carrier_order(field, -1)


def twin_share(hologram):
    """Energy of the twin order over that of the image order."""
    twin, image = carrier_order(hologram, 1), image_order(hologram)
    return np.sum(np.abs(twin) ** 2) / np.sum(np.abs(image) ** 2)


def zero_order_share(hologram):
    """Energy around zero spatial frequency over that of the image order."""
    near = np.r_[-11:12]
    window = np.outer(*(np.hanning(n) for n in hologram.shape))
    zero = fft.fft2(hologram * window)[np.ix_(near, near)]
    return np.sum(np.abs(zero) ** 2) / np.sum(np.abs(image_order(hologram)) ** 2)


def carrier_steps_deg(frames):
    """Steps from the phase of the carrier, frame by frame: no model of steps, powers or noise."""
    orders = [image_order(frame / frame.mean()) for frame in frames]
    cross = [np.vdot(later, earlier) for earlier, later in pairwise(orders)]
    return np.rad2deg(np.angle(cross))


def test_lens_powers_are_the_mean_intensities(lens_frames):
    steps = measure_phase_steps(lens_frames)
    means = np.array([53.10, 63.56, 71.89, 71.01])
    np.testing.assert_allclose(steps.powers, means / means.mean(), rtol=1e-3)
    # The whole light drifted, not one beam: nothing in the fit demands this.
    np.testing.assert_allclose(steps.visibilities, 1, atol=0.01)


def test_lens_steps_agree_with_the_phase_of_the_carrier(lens_frames):
    measured_deg = np.diff(np.rad2deg(measure_phase_steps(lens_frames).steps_rad))
    np.testing.assert_allclose(measured_deg, carrier_steps_deg(lens_frames), atol=1.5)
    np.testing.assert_allclose(measured_deg, [48.9, 56.7, 67.9], atol=0.3)


def test_lens_correction_takes_twin_zero_order_and_closure_away(lens_frames):
    steps = measure_phase_steps(lens_frames)
    as_nominal, corrected = four_phase(lens_frames), unequal_steps(lens_frames, steps)
    assert steps.closure == pytest.approx(0.415, abs=0.005)
    assert closure(lens_frames, steps) < 0.055
    assert twin_share(as_nominal) > 0.065
    assert twin_share(corrected) < 0.005
    assert zero_order_share(as_nominal) > 0.04
    assert zero_order_share(corrected) < 0.0012


def test_lens_principal_component_steps_are_worse(lens_frames):
    """54, 96 and 79 degrees circulate for this series; they leave five times the twin image."""
    steps = measure_phase_steps(lens_frames)
    principal = PhaseSteps(np.deg2rad([0, 54, 150, 229]), steps.powers, np.ones(4))
    assert twin_share(unequal_steps(lens_frames, principal)) > 4 * twin_share(
        unequal_steps(lens_frames, steps)
    )
    assert closure(lens_frames, principal) > 5 * closure(lens_frames, steps)
