"""Milliseconds from four camera frames to an object image, on one thread.

Ours (complex64, scipy.fft, cached chirps without shifts) compared with plain numpy (complex128, its
chirps cached too) and pyDHM's `fresnel`. All run in this process, one after the other in every
round, so that a slow moment of the machine falls on all of them; ratios are paired by round.

    python -m benchmarks.holography [--json] [--rounds N]

pyDHM (`pip install "reedbench[bench]"`) is timed only: its 1.0.5 has exp2 where exp is meant, so
its image is in focus at another distance.
"""

import argparse
import importlib
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from holography.demodulation import four_phase
from holography.fresnel import FresnelTransform

SHAPE = (1024, 1280)
PIXEL_M, WAVELENGTH_M, DISTANCE_M = 6.7e-6, 650e-9, 1.0
TARGET_MS = 10.0
FEWEST_ROUNDS = 15
WARM_UP_ROUNDS = 3
TASKS = ("complex image", "intensity")

Frames = npt.NDArray[np.uint16]
Image = npt.NDArray[np.inexact]


def camera_frames(rng: np.random.Generator) -> Frames:
    """Four 12-bit frames of an object under speckle, shape (4, ny, nx)."""
    transform = FresnelTransform(SHAPE, PIXEL_M, WAVELENGTH_M, DISTANCE_M)
    field = np.zeros(SHAPE, dtype=np.complex64)
    surface = rng.standard_normal((2, 300, 400))
    field[600:900, 700:1100] = surface[0] + 1j * surface[1]
    beat = 200 * transform.to_sensor(field)
    frames = [2000 + 2 * np.real(beat * 1j**-m) for m in range(4)]
    counts = np.clip(rng.poisson(np.clip(frames, 0, None)), 0, 4095)
    return np.asarray(counts, dtype=np.uint16)


def ours() -> dict[str, Callable[[Frames], Image]]:
    """The way of this package."""
    transform = FresnelTransform(SHAPE, PIXEL_M, WAVELENGTH_M, DISTANCE_M)
    return {
        "complex image": lambda frames: transform.to_object(four_phase(frames)),
        "intensity": lambda frames: transform.intensity(four_phase(frames)),
    }


def plain_numpy() -> dict[str, Callable[[Frames], Image]]:
    """The straightforward way in complex128, given the advantage of cached chirps."""
    rows, columns = SHAPE
    y, x = np.arange(rows)[:, None] - rows // 2, np.arange(columns) - columns // 2
    reach = WAVELENGTH_M * DISTANCE_M
    sensor_chirp = np.exp(1j * np.pi * PIXEL_M**2 * (y**2 + x**2) / reach)
    dy, dx = reach / (rows * PIXEL_M), reach / (columns * PIXEL_M)
    object_chirp = np.exp(1j * np.pi * ((y * dy) ** 2 + (x * dx) ** 2) / reach)
    object_chirp *= -1j * np.exp(2j * np.pi * ((DISTANCE_M / WAVELENGTH_M) % 1))

    def image(frames: Frames) -> npt.NDArray[np.complex128]:
        i0, i1, i2, i3 = frames.astype(np.float64)
        hologram = (i0 - i2) + 1j * (i1 - i3)
        spectrum = np.fft.fft2(np.fft.ifftshift(hologram * sensor_chirp), norm="ortho")
        return np.fft.fftshift(spectrum) * object_chirp

    return {"complex image": image, "intensity": lambda frames: np.abs(image(frames)) ** 2}


def pydhm() -> dict[str, Callable[[Frames], Image]] | None:
    """The peer from PyPI, or None where it is not installed."""
    try:
        fresnel = importlib.import_module("pyDHM.numericalPropagation").fresnel
    except ImportError:
        return None

    def image(frames: Frames) -> Image:
        i0, i1, i2, i3 = frames.astype(np.float64)
        hologram = (i0 - i2) + 1j * (i1 - i3)
        field: Image = fresnel(hologram, -DISTANCE_M, WAVELENGTH_M, PIXEL_M, PIXEL_M)
        return field

    return {"complex image": image, "intensity": lambda frames: np.abs(image(frames)) ** 2}


def time_rounds(
    contestants: dict[str, dict[str, Callable[[Frames], Image]]], frames: Frames, rounds: int
) -> dict[str, dict[str, list[float]]]:
    """Milliseconds per round, by task and contestant; the contestants take turns."""
    times_ms: dict[str, dict[str, list[float]]] = {
        task: {name: [] for name in contestants} for task in TASKS
    }
    for round_number in range(-WARM_UP_ROUNDS, rounds):
        for task in TASKS:
            for name, functions in contestants.items():
                start_s = time.perf_counter()
                functions[task](frames)
                taken_ms = 1e3 * (time.perf_counter() - start_s)
                if round_number >= 0:
                    times_ms[task][name].append(taken_ms)
    return times_ms


def summary(times_ms: dict[str, dict[str, list[float]]]) -> dict[str, dict[str, dict[str, float]]]:
    """Median, fastest, and median paired ratio to ours, by task and contestant."""
    return {
        task: {
            name: {
                "median_ms": statistics.median(taken),
                "fastest_ms": min(taken),
                "times_ours": statistics.median(
                    other / own for other, own in zip(taken, by_name["ours"], strict=True)
                ),
            }
            for name, taken in by_name.items()
        }
        for task, by_name in times_ms.items()
    }


def benchmark(rounds: int) -> dict[str, Any]:
    """Run all contestants; the result is what ``--json`` prints."""
    load_before = os.getloadavg()[0]
    frames = camera_frames(np.random.default_rng(0))
    contestants = {"ours": ours(), "numpy c128": plain_numpy()}
    peer = pydhm()
    if peer is None:
        print("pyDHM is not installed: skipped", file=sys.stderr)
    else:
        contestants["pyDHM 1.0.5"] = peer
    expected = contestants["numpy c128"]["complex image"](frames)
    difference = contestants["ours"]["complex image"](frames) - expected
    tasks = summary(time_rounds(contestants, frames, rounds))
    slowest_ms = max(tasks[task]["ours"]["median_ms"] for task in TASKS)
    return {
        "shape": SHAPE,
        "rounds": rounds,
        "threads": 1,
        "load_before": load_before,
        "tasks": tasks,
        "relative_error_to_numpy": float(np.linalg.norm(difference) / np.linalg.norm(expected)),
        "slowest_ms": slowest_ms,
        "target_ms": TARGET_MS,
        "target_met": slowest_ms <= TARGET_MS,
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    rows, columns = report["shape"]
    print(
        f"4 uint16 frames {rows}x{columns} -> image, one thread, {report['rounds']} rounds, "
        f"load average before {report['load_before']:.1f}"
    )
    print(f"{'task':14} {'contestant':12} {'median ms':>10} {'fastest ms':>11} {'times ours':>11}")
    for task, by_name in report["tasks"].items():
        for name, row in by_name.items():
            print(
                f"{task:14} {name:12} {row['median_ms']:10.2f} {row['fastest_ms']:11.2f} "
                f"{row['times_ours']:11.2f}"
            )
    print(f"ours differs from numpy complex128 by {report['relative_error_to_numpy']:.1e}")
    verdict = "met" if report["target_met"] else "missed"
    print(f"target of {TARGET_MS:g} ms per hologram: {verdict} ({report['slowest_ms']:.2f} ms)")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Four camera frames to an object image, timed.")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    parser.add_argument("--rounds", type=int, default=21, help="rounds that count, at least 15")
    arguments = parser.parse_args()
    report = benchmark(max(arguments.rounds, FEWEST_ROUNDS))
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
