"""What the pictures show, and where."""

from dataclasses import dataclass, replace
from fractions import Fraction
from io import BytesIO
from itertools import combinations

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text

from fitting.resonance import Resonance
from reports.figures.drawing import (
    PER_ROW,
    contact_sheet,
    label_heights,
    line_steps,
    png_of,
    response_plot,
)
from runs.reader import Run
from runs.verdict import Verdict

NOISE = 10.0


@dataclass(frozen=True)
class DrawnStep:
    position: int
    index: int
    drive_hz: Fraction
    verdict: Verdict = Verdict.OK
    order: int = 1
    noise_level: float = NOISE


LINES_HZ = (4308.6,)


class DrawnRun:
    """Replaces a run file: every picture is bright where `bright(x, y)` says."""

    sideband_order = 1

    def __init__(self, bright, indices=range(1, 61), verdicts=None, white=1e4):
        self.x_m, self.y_m = np.linspace(0, 38e-3, 60), np.linspace(-7e-3, 7e-3, 36)
        self._field = np.zeros((36, 60), np.complex64)
        self._field[bright(*np.meshgrid(self.x_m, self.y_m))] = np.sqrt(white)
        said = verdicts or {}
        self.steps = tuple(
            DrawnStep(n, k, Fraction(13969, 10) * Fraction(2 ** (k / 48)), said.get(k, Verdict.OK))
            for n, k in enumerate(indices)
        )

    def field(self, position):
        assert self.steps[position].verdict.measured
        return self._field

    def __len__(self):
        return len(self.steps)


def resonance(name, k, amplitude_rad=3.0):
    return Resonance(name, 1396.9 * 2 ** (k / 48), 7.2, k, amplitude_rad)


def canvas_of(figure):
    (image,) = figure.axes[0].images
    return np.asarray(image.get_array())


def cells(figure, count):
    """Pixels (from the left, from the top) at which each number stands, and its text."""
    texts = [t for t in figure.axes[0].texts if t.get_text()[0].isdigit()]
    assert len(texts) == count
    return [(*t.get_position(), t.get_text()) for t in texts]


def boxes(figure):
    """Left, right, top and bottom of every frame drawn around a picture."""
    return [
        (min(x), max(x), min(y), max(y))
        for x, y in (line.get_data() for line in figure.axes[0].lines)
    ]


def half_means(picture):
    rows, columns = picture.shape
    return {
        "top": picture[: rows // 2].mean(),
        "bottom": picture[rows // 2 :].mean(),
        "left": picture[:, : columns // 2].mean(),
        "right": picture[:, columns // 2 :].mean(),
    }


# --- Contact sheet -----------------------------------------------------------------------------


def test_pictures_are_in_rows_of_26_numbered_by_the_protocol():
    sheet = contact_sheet(DrawnRun(lambda x, y: x > 0), {}, LINES_HZ)
    places = cells(sheet, 60)
    assert [int(text) for *_, text in places] == list(range(1, 61))
    lefts, tops = ([place[axis] for place in places] for axis in (0, 1))
    assert PER_ROW == 26
    assert len(set(lefts)) == 26
    assert [tops.count(top) for top in dict.fromkeys(tops)] == [26, 26, 8]
    assert lefts[:26] == sorted(lefts[:26])
    assert lefts[26] == lefts[0]
    assert tops == sorted(tops)


def test_other_sidebands_are_distinguished_and_are_no_resonances():
    run = DrawnRun(lambda x, y: x > 0, indices=[7, 7, 8, 8])
    run.steps = tuple(replace(step, order=(1, 0)[n % 2]) for n, step in enumerate(run.steps))
    sheet = contact_sheet(run, {"F1": Resonance("F1", 1838.0, 7.2, 7, 9.0)}, LINES_HZ)
    assert [text for *_, text in cells(sheet, 4)] == ["7 F1", "7/0", "8", "8/0"]


def test_the_displacement_of_a_mode_stands_in_its_picture():
    run = DrawnRun(lambda x, y: x > 0, indices=[7, 8])
    found = {"F1": replace(resonance("F1", 7), amplitude_nm=973.6), "T1": resonance("T1", 8)}
    words = [t.get_text() for t in contact_sheet(run, found, ()).axes[0].texts]
    assert words == ["974 nm", "7 F1", "8 T1"]


def test_a_short_run_is_in_one_row():
    sheet = contact_sheet(DrawnRun(lambda x, y: x > 0, indices=range(44, 77, 2)), {}, LINES_HZ)
    places = cells(sheet, 17)
    assert len({top for _, top, _ in places}) == 1
    assert [int(text) for *_, text in places] == list(range(44, 77, 2))


@pytest.mark.parametrize(
    ("bright", "where", "dark"),
    [
        (lambda x, y: x < 10e-3, "bottom", "top"),
        (lambda x, y: x > 28e-3, "top", "bottom"),
        (lambda x, y: y > 2e-3, "left", "right"),
        (lambda x, y: y < -2e-3, "right", "left"),
    ],
)
def test_the_tip_is_down_and_positive_y_on_the_left(bright, where, dark):
    """As the paper prints its pictures."""
    sheet = contact_sheet(DrawnRun(bright, indices=[1]), {"F1": resonance("F1", 1)}, LINES_HZ)
    (box,) = boxes(sheet)
    left, right, top, bottom = (int(edge) for edge in box)
    halves = half_means(canvas_of(sheet)[top:bottom, left:right])
    assert halves[where] > 0.4
    assert halves[dark] < 0.05


def test_the_picture_of_a_mode_is_marked_and_named_at_its_place():
    found = {"F1": resonance("F1", 19), "T3": resonance("T3", 40), "F3": resonance("F3", 40)}
    sheet = contact_sheet(DrawnRun(lambda x, y: x > 0), found, LINES_HZ)
    named = [place for place in cells(sheet, 60) if " " in place[2]]
    assert [text for *_, text in named] == ["19 F1", "40 T3/F3"]
    plain = {int(text.split()[0]): (x, y) for x, y, text in cells(sheet, 60)}
    for (x, y, _), (left, right, top, bottom), k in zip(named, boxes(sheet), (19, 40), strict=True):
        assert left < x < right
        # The number stands above its picture.
        assert y < top < bottom
        # Picture 40 is the 14th of the second row.
        assert (x, y) == (plain[(k - 1) % 26 + 1][0], plain[1 + 26 * ((k - 1) // 26)][1])


def test_classes_of_modes_have_colours_of_their_own():
    found = {name: resonance(name, k) for name, k in (("F1", 5), ("T1", 9), ("X1", 12))}
    sheet = contact_sheet(DrawnRun(lambda x, y: x > 0), found, LINES_HZ)
    colours = [line.get_color() for line in sheet.axes[0].lines]
    assert len(set(colours)) == 3


def test_an_acoustic_line_is_marked_as_one():
    run = DrawnRun(lambda x, y: x > 0, indices=range(70, 90))
    assert line_steps(run, LINES_HZ) == {78}
    sheet = contact_sheet(run, {"F2": resonance("F2", 85)}, LINES_HZ)
    marked = [text for *_, text in cells(sheet, 20) if " " in text]
    assert marked == ["78 peak", "85 F2"]
    line, mode = (line.get_color() for line in sheet.axes[0].lines)
    assert line != mode


@pytest.mark.parametrize("indices", [range(1, 70), range(85, 180)])
def test_a_line_outside_the_sweep_marks_nothing(indices):
    assert line_steps(DrawnRun(lambda x, y: x > 0, indices=indices), LINES_HZ) == set()


def test_names_of_peaks_do_not_stand_on_each_other():
    rng = np.random.default_rng(2)
    peaks = np.sort(rng.uniform(0, 600, 14))[:, None] * [1, 0] + rng.uniform(0, 80, (14, 1)) * [
        0,
        1,
    ]
    heights = np.array(label_heights(peaks))
    assert (heights >= 8).all()
    assert heights[0] == 8
    x, y = peaks[:, 0], peaks[:, 1] + heights
    apart = (np.abs(np.subtract.outer(x, x)) >= 50) | (np.abs(np.subtract.outer(y, y)) >= 24)
    assert (apart | np.eye(14, dtype=bool)).all()


def test_lines_that_were_found_outweigh_those_of_the_bench():
    run = DrawnRun(lambda x, y: x > 0, indices=range(70, 90))
    for lines_hz, expected in (((4250.0,), ["77 peak"]), ((), [])):
        sheet = contact_sheet(run, {}, lines_hz)
        assert [text for *_, text in cells(sheet, 20) if " " in text] == expected


def test_bad_steps_say_why_and_steps_without_data_are_dark():
    verdicts = {3: Verdict.SATURATED, 4: Verdict.NO_SIGNAL, 5: Verdict.PENDING}
    run = DrawnRun(lambda x, y: x > 0, indices=range(1, 7), verdicts=verdicts)
    sheet = contact_sheet(run, {}, LINES_HZ)
    words = [t.get_text() for t in sheet.axes[0].texts if not t.get_text()[0].isdigit()]
    assert words == ["saturated", "no signal", "pending"]
    canvas = canvas_of(sheet)
    width = canvas.shape[1] // 6
    means = [canvas[:, n * width : (n + 1) * width].mean() for n in range(6)]
    assert means[4] < 0.1
    assert min(means[:4] + means[5:]) > 0.4


def test_a_picture_of_noise_is_not_stretched_to_white():
    noise = contact_sheet(DrawnRun(lambda x, y: x >= 0, indices=[1], white=NOISE), {}, LINES_HZ)
    signal = contact_sheet(
        DrawnRun(lambda x, y: x >= 0, indices=[1], white=1e3 * NOISE), {}, LINES_HZ
    )
    assert canvas_of(noise).max() < 0.35
    assert canvas_of(signal).max() == pytest.approx(1)


# --- Response ----------------------------------------------------------------------------------


def test_peaks_of_the_response_are_named_where_they_are(fitted, sweep_a):
    sweep = fitted.sweeps[0]
    figure = response_plot(sweep, (4308.6,))
    (axes,) = figure.axes
    labels = {t.get_text().split("\n")[0]: t.xy for t in axes.texts if "\n" in t.get_text()}
    assert set(labels) == set(sweep.resonances)
    for name, found in sweep.resonances.items():
        assert labels[name] == (found.frequency_hz, found.amplitude_nm)
    assert "Hz" in axes.get_xlabel()
    assert "nm" in axes.get_ylabel()
    fringes = [t.xy[1] for t in axes.texts if "bright fringe" in t.get_text()]
    assert fringes == pytest.approx([95.2, 768.8, 1583], abs=0.5)
    assert any("acoustic resonance 4309 Hz" in t.get_text() for t in axes.texts)
    assert any(list(line.get_xdata()) == [4308.6, 4308.6] for line in axes.lines)
    for found in sweep.resonances.values():
        low, high = axes.get_ylim()
        assert low < found.amplitude_nm < high


@pytest.mark.parametrize("largest_nm", [30.0, 300.0, 2500.0, 30e3])
def test_names_of_fringes_and_legend_can_be_read(fitted, largest_nm):
    sweep = fitted.sweeps[0]
    response = sweep.response
    factor = largest_nm / float(np.nanmax(response.peak.nm))
    peak = replace(response.peak, nm=factor * response.peak.nm)
    louder = replace(response, peak=peak, amplitude_nm=factor * response.amplitude_nm)
    figure = response_plot(replace(sweep, response=louder), (4308.6,))
    figure.draw_without_rendering()
    (axes,) = figure.axes
    shown = [t for t in axes.texts if "bright fringe" in t.get_text()]
    boxes = [t.get_window_extent() for t in shown]
    legend = axes.get_legend().get_window_extent()
    assert not any(box.overlaps(legend) for box in boxes)
    assert all(axes.get_ylim()[0] < t.xy[1] < axes.get_ylim()[1] for t in shown)
    assert len(shown) == {30.0: 1, 300.0: 2}.get(largest_nm, 3)


def test_names_of_close_modes_can_be_read(fitted):
    sweep = fitted.sweeps[0]
    hz = sweep.response.drive_hz
    middle, nm = np.sqrt(hz[0] * hz[-1]), (300.0, 6.0, 40.0, 10.0, 80.0, 5.0)
    # Six modes within a third of an octave: the upper names stand above the lower ones.
    close = {
        name: replace(found, frequency_hz=middle * 2 ** (n / 18), amplitude_nm=nm[n])
        for n, (name, found) in enumerate(list(sweep.resonances.items())[:6])
    }
    assert len(close) >= 4
    figure = response_plot(replace(sweep, resonances=close), ())
    figure.draw_without_rendering()
    # Without their lines to the peaks.
    boxes = [Text.get_window_extent(t) for t in figure.axes[0].texts if "\n" in t.get_text()]
    assert len(boxes) == len(close)
    legend = figure.axes[0].get_legend().get_window_extent()
    assert not any(a.overlaps(b) for a, b in combinations([*boxes, legend], 2))


def test_a_line_outside_the_sweep_is_not_drawn(fitted):
    figure = response_plot(fitted.sweeps[0], (25_000.0,))
    assert not any("acoustic" in t.get_text() for t in figure.axes[0].texts)


# --- Files -------------------------------------------------------------------------------------


def test_a_real_sheet_becomes_a_legible_png(fitted, sweep_a):
    with Run.open(sweep_a) as run:
        png = png_of(contact_sheet(run, fitted.sweeps[0].resonances, LINES_HZ))
    assert png.startswith(b"\x89PNG")
    image = imread(BytesIO(png))
    # 26 pictures side by side, four rows of them, and something to see.
    assert image.shape[1] > 600
    assert image[..., :3].std() > 0.05
