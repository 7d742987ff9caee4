"""Measure where a reed lies in the image: by the edges of its light.

A hand sets a reed into its clamp, and a tilt of the reference beam moves the image. A distance or a
wavelength that is not quite that of the bench file makes it larger. The coordinates of the image
are therefore not those of the reed: a shift of 0.1 mm changes the displacements of some modes at
the tip by per cents.

The image of a rough surface is speckle: the power of a pixel has an exponential distribution (J. W.
Goodman, Speckle Phenomena in Optics, 2007, section 3.2.1). Its mean is the brightness, which
changes little from pixel to pixel, times the fraction of the pixel's light that comes from the
reed. This fraction falls from 1 to 0 across the edge. Place, size, brightness and darkness are
found together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.signal
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from fitting.levenberg_marquardt import Damping, NormalEquations, minimise_all
from holography.arrays import Array, IndexArray
from physics.reed.geometry import ReedGeometry, half_width_m
from runs.reader import Run
from runs.records import StepRecord

# Standard deviations before the light is looked at. Chosen: a hand sets reeds on to some tenths of
# a millimetre; 10 mrad are 0.35 mm at the end of the vamp.
_SHIFT_M, _TURN_RAD = 0.5e-3, 10e-3
# ... of the size of the image: a tape measures a metre to a centimetre, and laser diodes of one
# type differ by 10 nm (data sheets).
_SIZE = 0.018
# ... and of the width of reeds of one kind, of which edges show no more than the product with the
# size. Chosen: tips of 13 mm are cut within 0.1 mm, equally distributed.
_WIDTH = 0.1 / 13 / np.sqrt(3)
# Light this far on both sides of the edge is looked at, but none near the clamp, where the reed
# hardly moves. Chosen: four standard deviations of the place, and as many speckles as the edge
# needs to know how bright it is.
_NEAR_EDGE_M = 2e-3
_NOT_AT_CLAMP_M = 5e-3
# Degrees of the logarithm of the brightness along and across the reed. Chosen: the mean of many
# holograms has no fringes, and is brighter towards the tip and the sides.
_DEGREE_ALONG, _DEGREE_ACROSS = 6, 2
# Holograms whose mean is taken, from the brighter half of all. Their speckle is the same: more of
# them only even out the fringes.
_HOLOGRAMS = 24
# Points of a pixel, along each axis, at which the fraction of light from the reed is computed.
_WITHIN_PIXEL = 6
# Pixels on either side from which a pixel has light: all but 0.3 % along an axis, the side lobes
# (sin πx/πx)² of a sensor without a window.
_REACH = 30
# Most steps of a search, and the decrease of the cost below which it ends. Chosen: an unknown that
# is off by its standard error costs 1.
_ITERATIONS, _LEAST_GAIN = 60, 1e-3
# Largest logarithm of a brightness, against overflow far from the solution.
_MOST_LOG = 50.0
# Precision with which place and size are held where they are: to a thousandth of their priors.
_HELD = 1e6
# Unknowns that are no coefficients of the brightness: along, across, turn, size, darkness.
_PLACE, _DARKNESS = slice(0, 4), 4
_UNKNOWNS = 5
# Chosen: they decide how long the search takes, and not where it ends.
_DAMPING = Damping(first=1e-3, after_gain=0.3, after_loss=4.0, constant=1e-9)


@dataclass(frozen=True)
class ReedPlace:
    """Where a reed lies in the image.

    Attributes
    ----------
    along_m, across_m : float
        Coordinates of the middle of its tip in the image.
    turn_rad : float
        Its turn, from x towards y.
    larger : float
        Size of the image over that of the reed, less 1.
    covariance : (4, 4) float
        Of these four numbers.
    """

    along_m: float
    across_m: float
    turn_rad: float
    larger: float
    covariance: Array

    @property
    def error(self) -> Array:
        """Standard errors (4,) of the two coordinates, of the turn and of the size."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def on_reed(self, x_m: Array, y_m: Array) -> Array:
        """Return the coordinates (2, ...) on the reed of points of the image."""
        right, up = x_m - self.along_m, y_m - self.across_m
        turned = np.stack([right + self.turn_rad * up, up - self.turn_rad * right])
        return np.asarray(turned / (1 + self.larger))


def nominal_place() -> ReedPlace:
    """Return the place at which coordinates of the image are those of the reed, surely."""
    return ReedPlace(0.0, 0.0, 0.0, 0.0, np.zeros((4, 4)))


def moves(x_m: Array, y_m: Array) -> Array:
    """Return derivatives (2, ..., 4) of coordinates on the reed by the place of the reed.

    They are those of a point of the image that lies at x_m and y_m on the reed, for an image of the
    size of the reed.
    """
    one, none = np.ones_like(x_m), np.zeros_like(x_m)
    along, across = [-one, none, y_m, -x_m], [none, -one, -x_m, -y_m]
    return np.stack([np.stack(along, -1), np.stack(across, -1)])


def reed_place(run: Run, steps: Sequence[StepRecord]) -> ReedPlace:
    """Measure where the reed of a run lies in its image.

    Parameters
    ----------
    run : Run
    steps : sequence of StepRecord
        Steps with good holograms.

    Raises
    ------
    RunFileError
        If a step cannot be read.
    """
    geometry = run.reed_file().geometry()
    Y, X = np.meshgrid(run.y_m, run.x_m, indexing="ij")
    chosen = _near_edge(geometry, X, Y)
    light = _ReedLight.of(geometry, run.x_m, run.y_m)
    return _likeliest(_Pixels(X[chosen], Y[chosen], _mean_power(run, steps)[chosen], light))


def _near_edge(geometry: ReedGeometry, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
    """Return which points of the image lie near the edge of a reed at the nominal place."""
    outline = geometry.outline
    # Around the tip the edge is a part of a circle, and no distance along y is near it.
    beyond_tip = np.maximum(x_m, outline.corner_x_m)
    outside = half_width_m(outline, beyond_tip) + _NEAR_EDGE_M < np.abs(y_m)
    inner = half_width_m(outline, np.maximum(x_m - _NEAR_EDGE_M, 0.0)) - _NEAR_EDGE_M
    deep = (x_m > _NEAR_EDGE_M) & (np.abs(y_m) < inner)
    at_ends = (x_m < -_NEAR_EDGE_M) | (x_m > geometry.vamp_x_m[-1] - _NOT_AT_CLAMP_M)
    return np.asarray(~(outside | deep | at_ends))


def _mean_power(run: Run, steps: Sequence[StepRecord]) -> Array:
    """Return the mean power (height, width) of holograms, each over its own mean.

    Without a window of the sensor the speckles of its pixels are independent.
    """
    middling = np.median([step.signal_to_noise for step in steps])
    bright = [step for step in steps if not step.signal_to_noise < middling]
    some = np.unique(np.linspace(0, len(bright) - 1, _HOLOGRAMS).round().astype(int))
    total = np.zeros((len(run.y_m), len(run.x_m)))
    for k in some:
        field = run.field(bright[k].position)
        power = field.real**2 + field.imag**2
        total += power / power.mean(dtype=float)
    return total / len(some)


@dataclass(frozen=True)
class _ReedLight:
    """Fraction of the light of a pixel that comes from the reed, on a grid of the reed.

    Attributes
    ----------
    first_m, spacing_m : (2,) float
        Coordinates x and y of the first point of the grid, and distances of its points.
    layers : (3, i, j) float
        The fraction, and its derivatives by x and y, in 1/m.
    """

    first_m: Array
    spacing_m: Array
    layers: Array

    @classmethod
    def of(cls, geometry: ReedGeometry, x_m: Array, y_m: Array) -> "_ReedLight":
        """Compute it for pixels with coordinates (width,) and (height,)."""
        outline, margin_m = geometry.outline, 2 * _NEAR_EDGE_M
        spacing_m = np.abs([x_m[1] - x_m[0], y_m[1] - y_m[0]]) / _WITHIN_PIXEL
        widest_m = outline.side_half_width_m + margin_m
        x = np.arange(-margin_m, geometry.vamp_x_m[-1], spacing_m[0])
        y = np.arange(-widest_m, widest_m, spacing_m[1])
        half_m = half_width_m(outline, np.maximum(x, 0.0))[:, None]
        inside = np.clip((half_m - np.abs(y)) / spacing_m[1] + 0.5, 0.0, 1.0)
        inside[x < 0] = 0.0
        kernel = _light_of_pixel()
        beyond = len(kernel) // 2
        for axis in (0, 1):
            wider = np.pad(inside, [(beyond,) * 2 if a == axis else (0, 0) for a in (0, 1)], "edge")
            along = kernel[:, None] if axis == 0 else kernel[None]
            inside = scipy.signal.oaconvolve(wider, along, mode="valid", axes=axis)
        slopes = np.gradient(inside, *spacing_m)
        return cls(np.array([x[0], y[0]]), spacing_m, np.stack([inside, *slopes]))

    def at(self, x_m: Array, y_m: Array) -> Array:
        """Return the layers (3, p) at points (p,) of the reed."""
        place = (np.stack([x_m, y_m]) - self.first_m[:, None]) / self.spacing_m[:, None]
        return np.stack(
            [scipy.ndimage.map_coordinates(a, place, order=1, mode="nearest") for a in self.layers]
        )


def _light_of_pixel() -> Array:
    """Return where the light of a pixel comes from, at the distances of the grid."""
    steps = _WITHIN_PIXEL * _REACH
    light = np.sinc(np.arange(-steps, steps + 1) / _WITHIN_PIXEL) ** 2
    found: Array = light / light.sum()
    return found


@dataclass(frozen=True)
class _Pixels:
    """Pixels near the edge.

    Attributes
    ----------
    x_m, y_m : (p,) float
        Coordinates in the image.
    power : (p,) float
    light : _ReedLight
    """

    x_m: Array
    y_m: Array
    power: Array
    light: _ReedLight

    @property
    def deviations(self) -> Array:
        """Standard deviations (4,) of the place, and of the size of what is seen."""
        return np.array([_SHIFT_M, _SHIFT_M, _TURN_RAD, np.hypot(_SIZE, _WIDTH)])

    def brightness_terms(self) -> Array:
        """Return the terms (p, c) of the logarithm of the brightness, at the nominal place."""
        x = 2 * (self.x_m - self.x_m.min()) / np.ptp(self.x_m) - 1
        y = self.y_m / np.abs(self.y_m).max()
        return chebyshev.chebvander2d(x, y, [_DEGREE_ALONG, _DEGREE_ACROSS])

    def mean(self, unknowns: Array, terms: Array) -> tuple[Array, Array]:
        """Return the expected power (p,), and derivatives (p, u) of its logarithm.

        Unknowns are the place and the size, in their standard deviations, the logarithm of the
        darkness, and the coefficients of `terms`.
        """
        along, across, turn, larger = (self.deviations * unknowns[_PLACE]).tolist()
        found = ReedPlace(along, across, turn, larger, np.zeros((4, 4)))
        x_m, y_m = found.on_reed(self.x_m, self.y_m)
        share, by_x, by_y = self.light.at(x_m, y_m)
        bright = np.exp(np.clip(terms @ unknowns[_UNKNOWNS:], -_MOST_LOG, _MOST_LOG))
        reed, dark = bright * share, np.exp(unknowns[_DARKNESS])
        moved_x, moved_y = moves(x_m, y_m)
        by_place = by_x[:, None] * moved_x + by_y[:, None] * moved_y
        mean = reed + dark
        derivatives = np.concatenate(
            [
                bright[:, None] * by_place * self.deviations,
                np.full((len(mean), 1), dark),
                reed[:, None] * terms,
            ],
            axis=1,
        )
        return mean, derivatives / mean[:, None]


def _likeliest(pixels: _Pixels) -> ReedPlace:
    """Return the likeliest place of the reed."""
    terms = pixels.brightness_terms()
    start = np.zeros(_UNKNOWNS + terms.shape[1])
    start[_DARKNESS], start[_UNKNOWNS] = np.log(np.quantile(pixels.power, (0.05, 0.5)))
    # The brightness is found first: else a reed far away may explain a tip that is still too dark.
    found = _minimum(pixels, terms, start, _HELD)
    found = _minimum(pixels, terms, found, 1.0)
    mean, by = pixels.mean(found, terms)
    matrix = by.T @ by
    matrix[np.arange(_DARKNESS), np.arange(_DARKNESS)] += 1.0
    # Light that the model does not describe scatters by more than speckle does.
    scatter = max(1.0, float(np.mean((pixels.power / mean - 1) ** 2)))
    unit = pixels.deviations
    covariance = scatter * np.linalg.inv(matrix)[_PLACE, _PLACE] * np.outer(unit, unit)
    along_m, across_m, turn_rad, seen = (found[_PLACE] * unit).tolist()
    # A reed that looks larger is so a little, and its image mostly.
    of_image = _SIZE**2 / (_SIZE**2 + _WIDTH**2)
    covariance[3] *= of_image
    covariance[:, 3] *= of_image
    covariance[3, 3] += of_image * _WIDTH**2
    return ReedPlace(along_m, across_m, turn_rad, of_image * seen, covariance)


def _minimum(pixels: _Pixels, terms: Array, start: Array, held: float) -> Array:
    """Return the likeliest unknowns (u,), where place and size have this precision."""
    precision = np.zeros(len(start))
    precision[:_DARKNESS] = held

    def costs(unknowns: Array, mean: Array) -> Array:
        light = 2 * np.sum(np.log(mean) + pixels.power / mean)
        return np.array([[light], [np.sum(precision * unknowns**2)]])

    def equations(unknowns: Array, _: IndexArray) -> NormalEquations:
        mean, by = pixels.mean(unknowns[0], terms)
        matrix = by.T @ by + np.diag(precision)
        uphill = by.T @ (pixels.power / mean - 1) - precision * unknowns[0]
        return NormalEquations(
            costs(unknowns[0], mean), uphill[None], matrix[None], np.array([np.trace(matrix)])
        )

    def cost_terms(unknowns: Array, _: IndexArray) -> Array:
        return costs(unknowns[0], pixels.mean(unknowns[0], terms)[0])

    found, _ = minimise_all(
        equations, cost_terms, start[None], _ITERATIONS, _DAMPING, least_gain=_LEAST_GAIN
    )
    return np.asarray(found[0])
