"""What the pictures of modes show, and where; what the table says."""

from io import BytesIO
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.contour import QuadContourSet
from matplotlib.image import imread

from fitting.errors import FitInputError
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.mesh import (
    MeshLevel,
    build_mesh,
    build_whole_mesh,
)
from physics.reed.geometry import ReedGeometry
from physics.reed.modes import ModeClass, NamedMode
from protocols.reed import ReedFile
from reports.errors import OutputRefusedError
from reports.figures import joint_drawing
from reports.figures.drawing import png_of
from reports.figures.joint_drawing import _values
from reports.figures.mode_pictures import (
    PER_ROW,
    bark_side,
    mode_sheet,
    modes_table,
    require_png,
    write_mode_sheet,
)

LEVEL = MeshLevel(orders=(2, 2, 2), edge_breaks_m=())
TITLES = ("F1 2184 Hz", "T1 3586 Hz")


@pytest.fixture(scope="module")
def mesh():
    return build_mesh(ReedGeometry(), LEVEL)


@pytest.fixture(scope="module")
def whole_mesh():
    return build_whole_mesh(ReedGeometry(), LEVEL)


def drawn(mesh, deflection, name="F1", hz=2184.0, symmetry=Symmetry.SYMMETRIC):
    """A mode whose deflection is a function of x and y in mm; of half a reed, y ≥ 0."""
    x, y, _ = 1e3 * mesh.nodes_m.T
    shape = np.zeros_like(mesh.nodes_m)
    shape[:, 2] = np.where(mesh.clamped, 0.0, deflection(x, y))
    return NamedMode(name, hz, ModeClass.FLEXURAL, symmetry, 1.0, shape)


def nodal_lines_mm(axes):
    """Points (x along the reed, y across) of the nodal lines, in mm."""
    lines = [part for part in axes.collections if isinstance(part, QuadContourSet)]
    black = [part for part in lines if list(part.levels) == [0.0]]
    assert len(black) == 1
    points = [path.vertices for path in black[0].get_paths()]
    return np.concatenate(points)[:, ::-1]


# --- Deflection of the whole reed --------------------------------------------------------------


@pytest.mark.parametrize("symmetry", list(Symmetry))
def test_the_other_half_is_a_mirror_image_of_the_right_sign(mesh, symmetry):
    mode = drawn(mesh, lambda x, y: (20 - x) * y, symmetry=symmetry)
    side = bark_side(mesh, mode)
    parity = 1 if symmetry is Symmetry.SYMMETRIC else -1
    np.testing.assert_array_equal(side.deflection, parity * side.deflection[:, ::-1])
    np.testing.assert_array_equal(side.x_m, side.x_m[:, ::-1])
    np.testing.assert_array_equal(side.y_m, -side.y_m[:, ::-1])
    assert np.all(np.diff(side.y_m, axis=1) > 0)
    assert side.deflection.max() == pytest.approx(1)
    assert np.abs(side.deflection).max() == pytest.approx(1)
    assert 1e3 * side.x_m[side.clamped].min() == pytest.approx(38.2)


@pytest.mark.parametrize("symmetry", list(Symmetry))
def test_a_whole_reed_is_shown_as_computed(whole_mesh, symmetry):
    """Whatever the larger part of its motion is."""
    mode = drawn(whole_mesh, lambda x, y: 20 - x + y, symmetry=symmetry)
    side = bark_side(whole_mesh, mode)
    free = ~side.clamped
    plane = 20 - 1e3 * (side.x_m - side.y_m)
    ratio = side.deflection[free] / plane[free]
    np.testing.assert_allclose(ratio, 1 / plane[free].flat[np.abs(plane[free]).argmax()], rtol=1e-9)
    assert np.all(np.diff(side.y_m, axis=1) > 0)
    np.testing.assert_array_equal(side.clamped, side.clamped[:, ::-1])
    assert 1e3 * side.y_m[side.clamped].min() == pytest.approx(-3.5)


# --- Sheet -------------------------------------------------------------------------------------


def test_modes_are_titled_in_rows(mesh):
    modes = [drawn(mesh, lambda x, y: 60 - x, f"F{k}", 1000 * k + 0.4) for k in range(1, 12)]
    figure = mode_sheet("clarinet", mesh, modes)
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in panels] == [f"F{k} {1000 * k} Hz" for k in range(1, 12)]
    boxes = [axes.get_position() for axes in panels]
    assert PER_ROW == 9
    assert len({round(box.y0, 6) for box in boxes}) == 2
    assert boxes[0].y0 > boxes[9].y0
    assert boxes[9].x0 == pytest.approx(boxes[0].x0)
    for left, right in pairwise(boxes[:9]):
        assert left.x1 < right.x0
    assert figure.get_suptitle() == "clarinet: bark side, tip down"


def test_the_tip_is_down_and_positive_y_on_the_left(mesh):
    figure = mode_sheet("clarinet", mesh, [drawn(mesh, lambda x, y: 60 - x)])
    axes = figure.axes[0]
    corners = axes.transData.transform([(0, 0), (0, 60), (5, 30), (-5, 30)])
    tip, heel, positive, negative = corners
    assert tip[1] < heel[1]
    assert positive[0] < negative[0]


def test_nodal_lines_are_where_nothing_moves(mesh):
    across = drawn(mesh, lambda x, y: 14.0 - x)
    along = drawn(mesh, lambda x, y: y * (70 - x), "T1", 3586.0, Symmetry.ANTISYMMETRIC)
    figure = mode_sheet("clarinet", mesh, [across, along])
    assert tuple(axes.get_title() for axes in figure.axes[:2]) == TITLES
    line = nodal_lines_mm(figure.axes[0])
    np.testing.assert_allclose(line[:, 0], 14.0, atol=0.2)
    assert np.ptp(line[:, 1]) == pytest.approx(2 * (6.575 - 11 / 900 * 14), abs=0.2)
    middle = nodal_lines_mm(figure.axes[1])
    np.testing.assert_allclose(middle[:, 1], 0.0, atol=1e-6)
    assert middle[:, 0].min() == pytest.approx(0, abs=0.1)


def test_nodal_lines_of_a_whole_reed_need_not_be_even(whole_mesh):
    figure = mode_sheet("clarinet", whole_mesh, [drawn(whole_mesh, lambda x, y: 14 - x + 0.5 * y)])
    line = nodal_lines_mm(figure.axes[0])
    np.testing.assert_allclose(line[:, 0], 14.0 + 0.5 * line[:, 1], atol=0.2)
    assert line[:, 1].min() < -6
    assert line[:, 1].max() > 6


def test_no_nodal_lines_where_the_reed_is_still_or_held(mesh):
    """A sign change of a thousandth of the motion at the tip is nothing to see."""
    mode = drawn(mesh, lambda x, y: np.where(x < 30, 30 - x, 0.01 * np.sin(x)))
    figure = mode_sheet("clarinet", mesh, [mode])
    axes = figure.axes[0]
    lines = [part for part in axes.collections if isinstance(part, QuadContourSet)]
    black = [part for part in lines if list(part.levels) == [0.0]]
    points = [path.vertices for part in black for path in part.get_paths() if len(path.vertices)]
    assert all(vertices[:, 1].max() < 38 for vertices in points)


def test_signs_have_colours_of_their_own(mesh):
    """Rendered: red where the mode moves up at the tip, blue where down behind, white at rest."""
    mode = drawn(mesh, lambda x, y: np.where(x < 15, 1.0, np.where(x < 35, -1.0, 0.0)))
    figure = mode_sheet("clarinet", mesh, [mode])
    image = imread(BytesIO(png_of(figure, 100)))[..., :3]
    axes = figure.axes[0]

    def colour(x_mm, y_mm):
        column, row = axes.transData.transform((y_mm, x_mm))
        # The renderer has another resolution than the figure had.
        scale = 100 / figure.dpi
        return image[len(image) - 1 - round(row * scale), round(column * scale)]

    up, down, still = colour(8, 1.0), colour(25, 1.0), colour(50, 1.0)
    assert up[0] > up[2] + 0.2
    assert down[2] > down[0] + 0.2
    assert still.min() > 0.9


def test_a_reed_without_modes_has_an_empty_sheet(mesh):
    assert png_of(mode_sheet("clarinet", mesh, [])).startswith(b"\x89PNG")


def test_a_name_is_neither_mathematics_nor_control_codes(mesh):
    figure = mode_sheet("R7 $\\frac$ \x1b[31m", mesh, [])
    assert png_of(figure).startswith(b"\x89PNG")
    assert figure.get_suptitle().startswith("R7 $\\frac$ \\x1b[31m: ")


# --- Files and words ---------------------------------------------------------------------------


def test_the_sheet_is_a_legible_png(mesh, tmp_path):
    reed, path = ReedFile.from_file(), tmp_path / "modes.png"
    write_mode_sheet(reed, LEVEL, [drawn(mesh, lambda x, y: 60 - x)] * 9, path)
    image = imread(BytesIO(path.read_bytes()))
    # Each panel is 1 inch wide, its title 8.5 points high.
    assert image.shape[1] > 9 * 120
    assert image[..., :3].std() > 0.05


def test_the_sheet_of_an_uneven_reed_is_that_of_its_whole(whole_mesh, tmp_path):
    uneven = ReedFile.from_file().replace(
        {
            "geometry.thickness_map": {
                "x": ["5 mm", "25 mm"],
                "y": ["-5 mm", "5 mm"],
                "deviation": [["1 um", "4 um"], ["0 um", "-3 um"]],
            }
        }
    )
    mode = drawn(whole_mesh, lambda x, y: 60 - x + y)
    write_mode_sheet(uneven, LEVEL, [mode], tmp_path / "modes.png")
    assert imread(tmp_path / "modes.png").std() > 0.05


def test_what_cannot_be_written_is_refused_in_one_line(mesh, tmp_path):
    with pytest.raises(FitInputError, match=r"modes\.jpg: pictures are written as PNG"):
        require_png(tmp_path / "modes.jpg")
    with pytest.raises(OutputRefusedError, match=r"nowhere/modes\.png: .*there is no folder"):
        require_png(Path(tmp_path, "nowhere", "modes.png"))
    (tmp_path / "folder.png").mkdir()
    require_png(tmp_path / "modes.png")
    with pytest.raises(OutputRefusedError, match="it is a folder"):
        write_mode_sheet(ReedFile.from_file(), LEVEL, [], tmp_path / "folder.png")


def test_the_table_counts_cents_from_f6(mesh):
    octave = drawn(mesh, lambda x, y: x, "X(4,1)", 2 * 1396.9)
    (row,) = modes_table(ReedFile.from_file(), [octave]).texts
    assert row == ["X(4,1)", "2793.8", "1200", "flexural", "symmetric"]


def test_the_table_says_which_cane():
    fixed = modes_table(ReedFile.from_file(), []).note
    assert "E_L 14000, E_T 480, E_R 480, G_LT 1100" in fixed
    assert "frequency: these" not in fixed
    following = modes_table(ReedFile.from_file("alto-saxophone"), []).note
    assert "of its own frequency: these at 1397 Hz" in following
    assert "E_L 11053" in following


def test_brightness_of_blocks_is_that_of_their_pixels_whatever_noise_they_have(monkeypatch):
    monkeypatch.setattr(joint_drawing, "squared_residual", lambda *_: np.zeros((1, 30)))
    rng = np.random.default_rng(3)
    noise, light = rng.uniform(0.7, 2.5, 30), rng.uniform(1, 9, 30)

    def brightness(block_noise):
        fit = SimpleNamespace(
            names=("F1",),
            block_amplitudes=SimpleNamespace(
                drive_hz=np.array([2000.0]),
                value=(light / np.sqrt(block_noise))[:, None],
                noise_variance=block_noise,
            ),
            modal=SimpleNamespace(hz=np.array([2000.0]), shapes=np.ones((1, 1))),
            basis=SimpleNamespace(functions=np.ones((30, 1))),
        )
        return _values(fit, "F1")[0]

    assert np.ptp(brightness(noise)) > 0.5
    assert brightness(noise) == pytest.approx(brightness(np.ones(30)))
