"""Frames without fringes: dark frames, even light, one beam alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from diagnosis.campaign import CampaignRun
from fitting.errors import FitInputError
from holography.arrays import Array
from physics.parameters.sensor import Sensor

# A pixel is hot if it exceeds the median by this many times the noise.
_HOT = 8.0
# Frames are saturated if more than a small share of their pixels reach this share of what a pixel
# can show. Chosen: a thousandth of the pixels that is some per cent too dark changes the mean by
# some 1e-5, and shot noise alone takes hardly a pixel that far unless the mean is near.
_SATURATED, _FEW_PIXELS = 0.98, 1e-3
# Side of the square of pixels that a pixel is compared with. Chosen: a hundred of them add half a
# per cent to its own noise, and light is even over a tenth of a millimetre.
_AROUND = 11
# Pixels of a beam count whose light is more than this share of its brightest thousandth. Chosen:
# dark ones have more noise than light in their logs.
_DARK, _BRIGHTEST = 0.1, 0.999
# Frames of a beam are dark below this mean. Chosen: a camera cannot show less.
_LEAST_BEAM_DN = 1.0


@dataclass(frozen=True)
class DarkFrames:
    """Frames without light.

    Attributes
    ----------
    offset_dn : float
    noise_dn : float
        Standard deviation of a pixel in time.
    hot : float
        Share of the pixels.
    pixels, frames : int
    row_excess, column_excess : float
        Log of the variance of means of rows, and of columns, in time, over what single pixels make
        of it.
    hot_pixels : (ny, nx) bool
        Which pixels these are.
    """

    offset_dn: float
    noise_dn: float
    hot: float
    pixels: int
    frames: int
    row_excess: float
    column_excess: float
    hot_pixels: NDArray[np.bool_]


@dataclass(frozen=True)
class FlatFrames:
    """Frames of even light, at several exposures.

    Attributes
    ----------
    exposure_s : (e,) float
    signal_dn : (e,) float
        Mean above the offset.
    variance_dn : (e,) float
        Of a pixel in time.
    flicker : float
        Relative standard deviation of the light from frame to frame within an exposure.
    frames : int
        In each exposure.
    pattern : float
        Rms by which pixels differ from their surroundings, a share.
    corner : float
        What the corners are brighter by, a share, by a paraboloid.
    tilt : (2,) float
        What the last row, and column, is brighter by than the middle.
    """

    exposure_s: Array
    signal_dn: Array
    variance_dn: Array
    flicker: float
    frames: int
    pattern: float
    corner: float
    tilt: Array


@dataclass(frozen=True)
class LocalOscillatorFrames:
    """Frames of one beam alone.

    Attributes
    ----------
    tilt : (2,) float
        What the last row, and column, is brighter by than the middle, in nepers, by a paraboloid.
    bend : float
        What the corners are.
    signal_dn : float
        Mean above the offset.
    """

    tilt: Array
    bend: float
    signal_dn: float


def stacked(parts: Sequence[CampaignRun]) -> tuple[Array, Array]:
    """Frames (e, 4, ny, nx) and exposures (e,) of all acquisitions of runs that kept frames."""
    frames, exposures = [], []
    for part in parts:
        for step in part.run.steps:
            if step.verdict.measured:
                frames.append(part.run.frames(step.position).astype(np.float32))
                exposures.append(part.run.exposure_of(step))
    return np.stack(frames), np.array(exposures)


def read_dark(parts: Sequence[CampaignRun]) -> DarkFrames:
    """Read dark frames.

    Raises
    ------
    FitInputError
        If they have no noise.
    """
    frames = np.concatenate(list(stacked(parts)[0]))
    level = frames.mean(axis=0)
    offset = float(np.median(level))
    noise = float(np.sqrt(np.median(frames.var(axis=0, ddof=1)) / _median_of_chi2(len(frames))))
    hot = level - offset > _HOT * max(noise / np.sqrt(len(frames)), 0.3)
    usual = frames[:, ~hot]
    noise = float(np.sqrt(np.mean(usual.var(axis=0, ddof=1))))
    if not noise:
        names = ", ".join(part.run.path.name for part in parts)
        raise FitInputError(
            f"{names}: no pixel of the dark frames ever changes, as a camera's do; leave them "
            "out, or measure them again"
        )
    moving = np.where(hot, 0.0, frames - level)
    rows, columns = (
        float(np.log(np.mean(moving.mean(axis=axis) ** 2) * moving.shape[axis] / noise**2)
              + np.log(len(frames) / (len(frames) - 1)) - np.log(1 - hot.mean()))
        for axis in (2, 1)
    )  # fmt: skip
    return DarkFrames(offset, noise, float(hot.mean()), hot.size, len(frames), rows, columns, hot)


def read_flat(
    parts: Sequence[CampaignRun], offset_dn: float, hot_pixels: NDArray[np.bool_] | None = None
) -> FlatFrames | None:
    """Read flat frames; None if there are saturated pixels at all exposures.

    Parameters
    ----------
    parts : sequence of CampaignRun
    offset_dn : float
        Digital number of a dark pixel.
    hot_pixels : (ny, nx) bool, optional
        Pixels that do not count for the mean signal and its variance: their dark signal is the
        larger part of a short exposure, and looks like a camera that is not linear.
    """
    frames, exposure_s = stacked(parts)
    counts = _counting(frames, hot_pixels)
    below = _not_saturated(parts, frames, counts)
    if not below.any():
        return None
    frames, exposure_s = frames[below], exposure_s[below]
    mean = frames.mean(axis=1) - np.float32(offset_dn)
    signal = mean[:, counts].mean(axis=1)
    variance = frames.var(axis=1, ddof=1)[:, counts].mean(axis=1)
    whole = np.einsum("eyx,e->yx", mean, exposure_s) / np.sum(exposure_s**2)
    surface, coefficients = paraboloid(whole)
    # Lamps are uneven, too, but not from pixel to pixel.
    rough = whole / uniform_filter(whole, _AROUND)
    noise = np.sqrt(np.sum(exposure_s**2 * variance) / 4) / np.sum(exposure_s**2)
    pattern2 = (
        float(np.median(np.abs(rough - 1)) * 1.4826) ** 2 - float(noise / np.mean(surface)) ** 2
    )
    # Light that flickers adds to the variance of every pixel, but not as the noise of one.
    light = frames[..., counts].mean(axis=-1, dtype=float) - offset_dn
    flicker2 = float(np.mean((light / light.mean(axis=1, keepdims=True)).var(axis=1, ddof=1)))
    return FlatFrames(
        exposure_s, signal, variance - flicker2 * signal**2, float(np.sqrt(flicker2)),
        frames.shape[1], float(np.sqrt(max(pattern2, 0.0))), coefficients[0], coefficients[1:],
    )  # fmt: skip


def read_local_oscillator(
    parts: Sequence[CampaignRun], offset_dn: float, hot_pixels: NDArray[np.bool_] | None = None
) -> LocalOscillatorFrames | None:
    """Read frames of one beam; None if they are dark, or have saturated pixels at all exposures.

    Where a beam is saturated, it seems wider than it is, and its middle somewhere else. For
    parameters see `read_flat`.
    """
    frames, exposure_s = stacked(parts)
    below = _not_saturated(parts, frames, _counting(frames, hot_pixels))
    if not below.any():
        return None
    frames, exposure_s = frames[below], exposure_s[below]
    mean = frames.mean(axis=1) - np.float32(offset_dn)
    whole = np.einsum("eyx,e->yx", mean, exposure_s) / np.sum(exposure_s**2)
    if (signal_dn := float(np.mean(mean))) < _LEAST_BEAM_DN:
        return None
    coefficients = log_paraboloid(whole)
    return LocalOscillatorFrames(coefficients[1:], coefficients[0], signal_dn)


def _counting(frames: Array, hot_pixels: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return which pixels (ny, nx) of frames (e, 4, ny, nx) are not known to be hot."""
    if hot_pixels is not None and hot_pixels.shape == frames.shape[2:]:
        return ~hot_pixels
    return np.ones(frames.shape[2:], dtype=bool)


def _not_saturated(
    parts: Sequence[CampaignRun], frames: Array, counts: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return at which exposures (e,) hardly any of the pixels that count is saturated."""
    full_dn = min(part.run.saturation_dn for part in parts)
    high = [np.mean(each[:, counts] >= _SATURATED * full_dn) for each in frames]
    return np.array(high) < _FEW_PIXELS


def paraboloid(image: Array) -> tuple[Array, Array]:
    """Paraboloid (ny, nx) nearest to an image, and its coefficients over the middle.

    Returns
    -------
    surface : (ny, nx) float
    coefficients : (3,) float
        What corners are brighter by, and what the last row and column are.
    """
    found = _nearest(image, np.ones(image.shape, dtype=bool))
    return np.tensordot(_terms(image.shape), found, axes=1), found[1:] / found[0]


def log_paraboloid(image: Array) -> Array:
    """Return the coefficients (3,), in nepers, of the paraboloid nearest to the log of an image.

    The log of a Gaussian beam is one, wherever its middle is. Dark pixels are left out.
    """
    bright = image > _DARK * np.quantile(image, _BRIGHTEST)
    log = np.log(np.where(bright, image, 1.0))
    coefficients: Array = _nearest(log, bright)[1:]
    return coefficients


def _terms(shape: tuple[int, ...]) -> Array:
    y, x = (np.linspace(-1, 1, count) for count in shape)
    Y, X = np.meshgrid(y, x, indexing="ij")
    return np.stack([np.ones_like(Y), 0.5 * (Y**2 + X**2), Y, X], axis=-1)


def _nearest(image: Array, counts: NDArray[np.bool_]) -> Array:
    """Return the constant and the coefficients (4,) of the paraboloid nearest to some pixels."""
    terms, values = _terms(image.shape)[counts], image[counts]
    found = np.linalg.lstsq(terms, values, rcond=None)[0]
    for _ in range(3):
        left = values - terms @ found
        kept = np.abs(left) <= 5 * 1.4826 * np.median(np.abs(left))
        found = np.linalg.lstsq(terms[kept], values[kept], rcond=None)[0]
    return np.asarray(found)


def _median_of_chi2(frames: int) -> float:
    """Return the median of a variance over its mean, for a number of frames."""
    freedoms = frames - 1
    return float((1 - 2 / (9 * freedoms)) ** 3)


def half_m(sensor: Sensor) -> tuple[float, float]:
    """Return half the size of a sensor, along rows and columns."""
    rows, columns = sensor.shape
    return 0.5 * rows * sensor.pixel_m, 0.5 * columns * sensor.pixel_m
