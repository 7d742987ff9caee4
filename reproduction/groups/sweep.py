"""The sweep and the light: grid of frequencies, pictures, fringes, sidebands."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.special import jv

from fitting.forward import cents_of, hz_of
from fitting.paper.constants import H4_MISFIT_CENTS
from fitting.paper.printed import Printed
from fitting.statistics.synthetic import GRID_CENTS, modal_cents
from holography.arrays import Array
from holography.demodulation import sideband_gain
from holography.fringes import first_sideband_maxima_m
from physics.reed.reduction.metamodel import Equation1
from protocols.bench import BenchFile
from protocols.plan import Plan, make_plan
from protocols.protocol import Protocol
from reports.figures.drawing import PER_ROW
from reproduction.rows import (
    Group,
    Row,
    from_text,
    interval_from_text,
    not_printed,
)

_FIG2: Final = "Fig. 2"
# A few fringes, and sidebands that are still lit then.
_PHASE_RAD, _ORDERS = 1.0, np.arange(-12, 13)
# Twice the misfit of hypothesis H4, in steps of the sweep.
_TWO_MISFITS = 2 * H4_MISFIT_CENTS / GRID_CENTS
# So well the printed extremes agree on the zero of the grid.
_GRID_CENTS_TOLERATED = 0.25
_A4_HZ = 440.0


def compare_sweep(numbers: Printed, adjusted: Equation1) -> Group:
    """Compare the sweep and the light.

    Parameters
    ----------
    numbers : Printed
    adjusted : Equation1
        Forward model of one reed of Fig. 2.
    """
    plan = make_plan(Protocol.from_file("seriesA"), BenchFile.from_file())
    return Group(
        "sweep",
        "Sweep and light",
        "Frequencies, volts and pictures are those of the shipped protocol of series A; fringes "
        "and sidebands are computed from Bessel functions and from the gain of the four-phase "
        "demodulation. Tolerated: half a unit of the last printed digit, at least a quarter of a "
        "cent for extremes of Table 1; for the pictures of one reed twice the misfit of "
        "hypothesis H4, 2 × 30.4 cents or 2.4 pictures.",
        (
            *_plan_rows(numbers, plan),
            *_picture_rows(numbers, adjusted),
            *_grid_rows(numbers, plan),
            *_note_rows(numbers),
            *_fringe_rows(numbers),
            *_sideband_rows(plan),
            *_count_rows(numbers),
        ),
    )


def _plan_rows(numbers: Printed, plan: Plan) -> Iterator[Row]:
    text, sweep, steps = numbers.text, numbers.sweep, {step.index: step for step in plan.steps}
    first, last, ramp_end = (
        steps[k] for k in (sweep.first_index, sweep.last_index, sweep.ramp_last_index)
    )
    where = "Experimental protocol"
    yield from_text(
        _FIG2, "pictures, by the caption", text["holograms_in_caption"], len(steps), 0,
        remark="the text has 184, and the largest frequency of Table 1, 19911 Hz, is picture 184",
        refuted=True,
    )  # fmt: skip
    for name, key, step in (
        ("first", "first_khz", first),
        ("end of the crescendo", "ramp_end_khz", ramp_end),
        ("last", "last_khz", last),
    ):
        tolerance = 0.05 if key == "first_khz" else 0.5
        yield from_text(
            where, f"frequency, {name}", text[key], float(step.drive_hz) / 1e3, tolerance, "kHz"
        )
    ratio = (ramp_end.volts / first.volts) ** (1 / (ramp_end.index - first.index))
    yield not_printed(where, "excitation, ratio of neighbours", ratio)
    reference_hz = _A4_HZ * 2 ** (20 / 12)
    yield from_text("Eq. 1", "F6", sweep.reference_hz, reference_hz, 0.05, "Hz")


def _index(place: tuple[int, int]) -> int:
    row, column = place
    return PER_ROW * (row - 1) + column


def _picture_rows(numbers: Printed, adjusted: Equation1) -> Iterator[Row]:
    """Pictures of one reed: whether any reed of H4 has all of its resonances there."""
    pictures = {name: _index(place) for name, place in numbers.figure_2.items()}
    sweep = numbers.sweep
    yield from_text(
        _FIG2, "picture of the acoustic resonance", pictures["acoustic"],
        sweep.cavity_resonance_index, 0,
    )  # fmt: skip
    yield from_text(
        _FIG2, "frequency of the acoustic resonance", sweep.cavity_resonance_hz,
        float(hz_of(sweep.step_cents * pictures["acoustic"])), 0.5, "Hz",
    )  # fmt: skip
    yield from_text(
        _FIG2, "last picture of the crescendo", pictures["ramp_end"], sweep.ramp_last_index, 0
    )
    modes = [name for name in pictures if name in adjusted.modes]
    seen = np.array([pictures[name] for name in modes], dtype=float)
    fitted = _nearest_reed(adjusted, modes, sweep.step_cents * seen) / sweep.step_cents
    for name, k, ours in zip(modes, seen, fitted, strict=True):
        yield from_text(
            _FIG2, f"picture of {name}", k, ours, _TWO_MISFITS,
            remark=f"{hz_of(sweep.step_cents * k):.0f} Hz; ours is the reed of H4, series A, "
            "nearest to all seven",
        )  # fmt: skip


def _nearest_reed(adjusted: Equation1, modes: list[str], observed_cents: Array) -> Array:
    """Resonances in cents of the reed of H4 in series A that is nearest to those given."""
    columns = [adjusted.modes.index(name) for name in modes]

    def computed(e: Array) -> Array:
        cents = modal_cents(np.append(e, 0.0)[None], adjusted, passes=1)
        return np.asarray(cents[0, 0, columns])

    def misfit(e: Array) -> Array:
        return np.asarray(computed(e) - observed_cents)

    return computed(least_squares(misfit, np.zeros(3)).x)


def _grid_rows(numbers: Printed, plan: Plan) -> Iterator[Row]:
    """Extremes of Table 1 are pictures of the sweep."""
    grid_hz = np.array([float(step.drive_hz) for step in plan.steps])
    for mode, by_series in numbers.observed_resonances.items():
        for series, seen in by_series.items():
            for what, hz in (("minimum", seen.min_hz), ("maximum", seen.max_hz)):
                if hz is not None:
                    k = int(np.argmin(np.abs(grid_hz - hz)))
                    remark = f"picture {plan.steps[k].index}"
                    rounding_cents = 1200 * float(np.log2(1 + 0.5 / hz))
                    yield interval_from_text(
                        "Table 1", f"{what} of {series}{mode}, nearest picture", hz,
                        float(grid_hz[k]), max(rounding_cents, _GRID_CENTS_TOLERATED), remark,
                    )  # fmt: skip


def _note_rows(numbers: Printed) -> Iterator[Row]:
    for hz in numbers.notes_hz:
        semitones = round(12 * float(np.log2(hz / _A4_HZ)))
        note_hz = _A4_HZ * 2 ** (semitones / 12)
        yield interval_from_text("figure of Table 1", f"note of {hz:g} Hz", hz, note_hz, 0.5)


def _fringe_rows(numbers: Printed) -> Iterator[Row]:
    optics = numbers.optics
    maxima_m = first_sideband_maxima_m(max(optics.bright_fringe_nm), optics.wavelength_m)
    # Printed with two digits.
    for (order, nm), tolerance in zip(optics.bright_fringe_nm.items(), (0.5, 5, 50), strict=True):
        yield from_text(
            "Holographic setup", f"amplitude at bright fringe {order}", nm,
            1e9 * float(maxima_m[order - 1]), tolerance, "nm",
        )  # fmt: skip


def relative_signal(drive_hz: Array, difference_hz: Array, frame_rate_hz: float) -> Array:
    """Amplitude of a hologram relative to that of the first sideband alone, (k,).

    Light of a point that vibrates with an amplitude of 1 rad beats in all its sidebands with the
    local oscillator, and its twin with it; frames are exposed all the time.

    Parameters
    ----------
    drive_hz, difference_hz : (k,) float
        Frequency of the vibration, and f_AOM1 - f_AOM2.
    frame_rate_hz : float
    """
    exposure_s = 1 / frame_rate_hz
    light = 1j**_ORDERS * jv(_ORDERS, _PHASE_RAD)
    offset_hz = _ORDERS * drive_hz[:, None] - difference_hz[:, None]
    hologram = sideband_gain(offset_hz, frame_rate_hz, exposure_s) @ light
    hologram += sideband_gain(-offset_hz, frame_rate_hz, exposure_s) @ light.conj()
    alone = abs(sideband_gain(-frame_rate_hz / 4, frame_rate_hz, exposure_s)) * jv(1, _PHASE_RAD)
    return np.asarray(np.abs(hologram) / alone)


def _sideband_rows(plan: Plan) -> Iterator[Row]:
    rate_hz = float(plan.protocol.camera.frame_rate_hz)
    drive_hz = np.array([float(step.drive_hz) for step in plan.steps])
    forms = {
        "f + f_CCD/4": drive_hz + rate_hz / 4,
        "(f + f_CCD)/4, as printed": (drive_hz + rate_hz) / 4,
    }
    for words, difference_hz in forms.items():
        signal = relative_signal(drive_hz, difference_hz, rate_hz)
        wrong = "printed" in words
        yield from_text(
            "Holographic setup", f"signal of the first sideband with {words}", 1,
            float(np.sqrt(np.mean(signal**2))), 0.01,
            remark="relative amplitude, rms over the sweep"
            + ("; a misprint, see decision 0001" if wrong else ""),
            refuted=wrong,
        )  # fmt: skip


def _count_rows(numbers: Printed) -> Iterator[Row]:
    text, sample = numbers.text, numbers.reed_sample
    seen = numbers.observed_resonances
    yield from_text(
        "Experimental protocol", "reeds, by strength", sample.reeds,
        sum(sample.by_strength.values()), 0,
    )  # fmt: skip
    yield from_text(
        "Experimental protocol", "reeds, played and new", sample.reeds,
        text["played_reeds"] + text["new_reeds"], 0,
    )  # fmt: skip
    yield from_text("Statistics", "modes identified", text["modes"], len(seen), 0)
    for series in ("A", "B"):
        found = [by_series[series].identified for by_series in seen.values()]
        yield from_text(
            "Table 1", f"patterns identified, series {series}", text[f"identified_{series}"],
            sum(found), 0,
        )  # fmt: skip
    complete = [s.identified == sample.reeds for m in seen.values() for s in m.values()]
    yield from_text("Table 1", "variables with all reeds", numbers.pca.variables, sum(complete), 0)
    known = [s for by_series in seen.values() for s in by_series.values() if s.sd_hz and s.mean_hz]
    fraction = [100 * (s.sd_hz or 0.0) / (s.mean_hz or 1.0) for s in known]
    for word, ours in (("least", min(fraction)), ("most", max(fraction))):
        yield from_text(
            "Statistics", f"relative SD of a mode, {word}",
            text[f"relative_sd_{word}_percent"], ours, 0.5, "%",
            "the most is that of AX6, whose identification the text calls uncertain"
            if word == "most" else "",
        )  # fmt: skip
    three_sd = [float(cents_of((s.mean_hz or 0) + 3 * (s.sd_hz or 0))) for s in known]
    middle = [a - float(cents_of(s.mean_hz or 1.0)) for a, s in zip(three_sd, known, strict=True)]
    yield from_text(
        "Statistics", "three SD of a mode", text["three_sd_cents"], float(np.median(middle)), 50,
        "cents", "median over the modes",
    )  # fmt: skip
    pairs = [text[f"pairs_{where}"] for where in ("above_0_9", "above_0_8", "above_0_7")]
    variables = len(known)
    yield from_text(
        "Appendix statistic", "pairs of variables", sum(pairs) + text["pairs_below_0_7"],
        variables * (variables - 1) / 2, 0,
    )  # fmt: skip
