"""Holograms of the reed at rest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnosis.campaign import CampaignRun
from holography.arrays import Array


@dataclass(frozen=True)
class RestHolograms:
    """Holograms of the reed at rest, of one clamping, in the order of time.

    Attributes
    ----------
    clamping : int
    time_s : (s,) float
        Since the campaign began.
    advance_rad, advance_error : (s,) float
        By which the light turned from frame to frame more than a quarter, and standard errors.
    turn_rad : (s - 1,) float
        By which it turned from one acquisition to the next more than the settings say; NaN between
        runs.
    gap_s : (s - 1,) float
        Time between these.
    brightness : (s,) float
        Log of the light's amplitude, dn.
    frame_ratio : (s,) float
        Log of the brightness of the second and fourth frame over that of the first and third.
    frame_scatter : float
        Standard error of it, from the light's noise.
    likeness : (r, r) float
        Of the speckle of r runs, 1 is the same; noise taken out.
    likeness_error : float
        Standard error of it, from the noise.
    run : (s,) int
        Which of them an acquisition is of.
    run_time_s : (r,) float
    noise_dn2 : (s,) float
        Next to the image.
    """

    clamping: int
    time_s: Array
    advance_rad: Array
    advance_error: Array
    turn_rad: Array
    gap_s: Array
    brightness: Array
    frame_ratio: Array
    frame_scatter: float
    likeness: Array
    likeness_error: float
    run: NDArray[np.intp]
    run_time_s: Array
    noise_dn2: Array


def read_rest_holograms(parts: Sequence[CampaignRun]) -> list[RestHolograms]:
    """Read order 0 of the reed at rest, one record per clamping."""
    parts = [part for part in parts if part.good_steps]
    clampings = sorted({part.clamping for part in parts})
    return [_still([p for p in parts if p.clamping == c], c) for c in clampings]


def _still(parts: Sequence[CampaignRun], clamping: int) -> RestHolograms:
    rows: list[tuple[float, ...]] = []
    turns, gaps, means = [], [], []
    scatter = []
    for number, part in enumerate(parts):
        run, before = part.run, None
        fields = []
        # A step that was measured again, or out of turn, comes later than its number says.
        for step in sorted(part.good_steps, key=lambda step: step.timestamps_s[0]):
            frames = run.frames(step.position)
            halves = run.reconstruction.quadratures(frames)
            field, phase = halves.field, run.reconstruction.steady_turn(frames, halves)
            brightness = frames.reshape(4, -1).mean(axis=1, dtype=float)
            begun_s = step.timestamps_s[0] - part.clock_s
            signal = float(np.mean(np.abs(field) ** 2)) - halves.noise
            ratio = np.log(brightness[1] + brightness[3]) - np.log(brightness[0] + brightness[2])
            scatter.append(1 / np.sqrt(2 * frames[0].size * brightness.mean()))
            rows.append(
                (begun_s, phase.error_rad, phase.standard_error_rad, 0.5 * np.log(signal),
                 float(ratio), halves.noise)
            )  # fmt: skip
            turned = field * np.exp(2j * np.pi * float(step.difference_hz) * begun_s)
            if before is not None:
                turns.append(float(np.angle(np.vdot(before[1], turned))))
                gaps.append(begun_s - before[0])
            elif number:
                turns.append(np.nan)
                gaps.append(np.nan)
            before = begun_s, turned
            fields.append(turned)
        means.append((np.array(fields), rows[-1][-1]))
    time_s, advance, error, bright, ratio_, noise = np.array(rows).T
    likeness, likeness_error = _likeness(means)
    return RestHolograms(
        clamping=clamping,
        time_s=time_s,
        advance_rad=advance,
        advance_error=error,
        turn_rad=np.array(turns),
        gap_s=np.array(gaps),
        brightness=bright,
        frame_ratio=ratio_,
        frame_scatter=float(np.mean(scatter)),
        likeness=likeness,
        likeness_error=likeness_error,
        run=np.repeat(np.arange(len(parts)), [len(part.good_steps) for part in parts]),
        run_time_s=np.array(
            [np.mean([s.timestamps_s[0] for s in part.good_steps]) - part.clock_s for part in parts]
        ),
        noise_dn2=noise,
    )


def _likeness(runs: Sequence[tuple[Array, float]]) -> tuple[Array, float]:
    """Correlation (r, r) of the mean fields of runs, without their noise."""
    means, powers, errors = [], [], []
    for fields, noise in runs:
        phases = np.array([np.vdot(fields[0], field) for field in fields])
        aligned = fields * np.exp(-1j * np.angle(phases))[:, None, None]
        mean = aligned.mean(axis=0)
        power = float(np.mean(np.abs(mean) ** 2)) - noise / len(fields)
        means.append(mean)
        powers.append(power)
        errors.append(noise / len(fields) / power)
    n = len(means)
    table = np.eye(n)
    for a in range(n):
        for b in range(a):
            product = abs(np.vdot(means[a], means[b])) / means[a].size
            table[a, b] = table[b, a] = product / np.sqrt(powers[a] * powers[b])
    return table, float(np.mean(errors) / np.sqrt(means[0].size))
