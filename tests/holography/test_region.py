"""Regions: crop and paste as adjoints, and the way from metres to pixels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holography.fresnel import FresnelTransform
from holography.region import Region, region_from_metres

SHAPE = (12, 17)


@st.composite
def regions(draw):
    row = draw(st.integers(0, SHAPE[0] - 1))
    column = draw(st.integers(0, SHAPE[1] - 1))
    height = draw(st.integers(1, SHAPE[0] - row))
    width = draw(st.integers(1, SHAPE[1] - column))
    return Region(row, column, height, width)


@given(regions())
def test_paste_is_the_adjoint_of_crop(region):
    rng = np.random.default_rng(0)
    image = rng.standard_normal((2, *SHAPE))
    field = rng.standard_normal((2, region.height, region.width))
    assert np.vdot(region.crop(image), field) == pytest.approx(
        np.vdot(image, region.paste(field, SHAPE))
    )
    np.testing.assert_array_equal(region.crop(region.paste(field, SHAPE)), field)
    assert np.count_nonzero(region.paste(np.ones_like(field), SHAPE)) == field.size


def test_crop_takes_rows_then_columns_and_shares_memory():
    image = np.arange(12 * 17).reshape(SHAPE)
    region = Region(row=2, column=5, height=3, width=4)
    part = region.crop(image)
    assert part.shape == (3, 4)
    assert part[0, 0] == image[2, 5]
    assert np.shares_memory(part, image)
    np.testing.assert_array_equal(image[region.slices], part)


def test_paste_keeps_the_type():
    assert Region(0, 0, 2, 2).paste(np.ones((2, 2), np.complex64), (4, 4)).dtype == np.complex64


@pytest.mark.parametrize("numbers", [(-1, 0, 2, 2), (0, -1, 2, 2), (0, 0, 0, 2), (0, 0, 2, 0)])
def test_impossible_regions_are_refused(numbers):
    with pytest.raises(ValueError, match="origin of at least 0"):
        Region(*numbers)


@pytest.mark.parametrize("region", [Region(10, 0, 3, 1), Region(0, 16, 1, 2)])
def test_a_region_must_lie_inside_the_image(region):
    with pytest.raises(ValueError, match="leaves the image of 12x17"):
        region.crop(np.zeros(SHAPE))
    with pytest.raises(ValueError, match="leaves the image of 12x17"):
        region.paste(np.zeros((region.height, region.width)), SHAPE)


def test_the_pasted_field_must_fit():
    with pytest.raises(ValueError, match=r"\(4, 3\)"):
        Region(0, 0, 3, 4).paste(np.zeros((4, 3)), SHAPE)


@given(
    st.sampled_from([(96, 128), (97, 129)]),
    st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)),
    st.tuples(st.floats(1e-5, 0.02), st.floats(1e-5, 0.02)),
)
def test_region_from_metres_is_the_smallest_that_covers(shape, centre_m, size_m):
    transform = FresnelTransform(shape, 6.7e-6, 650e-9, 1.0)
    region = region_from_metres(centre_m, size_m, transform)
    origin, extent = (region.row, region.column), (region.height, region.width)
    for axis in (0, 1):
        pitch = transform.object_pitch_m[axis]
        first_m = (origin[axis] - shape[axis] // 2 - 0.5) * pitch
        last_m = first_m + extent[axis] * pitch
        low_m, high_m = (centre_m[axis] + side * size_m[axis] / 2 for side in (-1, 1))
        rounding_m = 1e-9 * pitch
        assert first_m <= low_m + rounding_m
        assert high_m - rounding_m <= last_m
        assert first_m + pitch > low_m - rounding_m
        assert last_m - pitch < high_m + rounding_m


def test_a_point_source_is_found_in_the_region_around_it():
    transform = FresnelTransform((96, 128), 6.7e-6, 650e-9, 0.1)
    dy, dx = transform.object_pitch_m
    point = np.zeros(transform.shape, dtype=np.complex64)
    point[96 // 2 + 11, 128 // 2 - 25] = 1
    region = region_from_metres((11 * dy, -25 * dx), (0.9 * dy, 0.9 * dx), transform)
    assert (region.height, region.width) == (1, 1)
    assert region.crop(transform.intensity(transform.to_sensor(point))) == pytest.approx(1)


@pytest.mark.parametrize(
    ("centre_m", "size_m"),
    [((0.2, 0.0), (1e-3, 1e-3)), ((0.0, -0.2), (1e-3, 1e-3)), ((0.0, 0.0), (0.0, 1e-3))],
)
def test_rectangles_off_the_object_plane_are_refused(centre_m, size_m):
    transform = FresnelTransform((96, 128), 6.7e-6, 650e-9, 0.1)
    with pytest.raises(ValueError, match="leaves the object plane"):
        region_from_metres(centre_m, size_m, transform)
