"""From a vibrating surface to the numbers of a camera, and from those back to an image.

A lensless camera far from the reed: the field on the sensor is one Fourier transform of the
object's field times a quadratic phase. Points of the object are finer than the image resolves, each
with a speckle of its own, so fringes that are too fine blur, and none lies in the middle of a pixel
of the image: the sensor's edges spread their light over all of it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator
from scipy.special import jv

from blind.reed import ModalReed
from blind.shape import half_width_m
from blind.world import Chip, World

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]
Frames = NDArray[np.uint16]

WAVELENGTH_M, DISTANCE_M = 650e-9, 0.8
# Middle of the visible reed from the axis, and what is kept of the image (y, x).
CENTRE_M = (22e-3, 0.0)
SIZE_M = (14e-3, 38e-3)
# Points of the surface per pixel of the image, along each axis.
_FINER = 2
# Sidebands of the light that are followed.
_ORDERS = (-1, 0, 1, 2, 3)
# Bessel functions on this grid in rad; between its points lines, good to a millionth.
_AT_RAD = np.arange(0.0, 200.0, 2e-3)
_TABLE = [jv(order, _AT_RAD) for order in range(4)]


@dataclass(frozen=True)
class Stage:
    """The lit surface, in places per pixel of the object's image.

    Attributes
    ----------
    rows, columns : slice
        Of the image.
    inside : (h·f, w·f) bool
        Points of the surface that belong to the reed.
    rough : (n,) complex
        Light of each point.
    shapes : (n, m) float
        Deflection of each point per modal coordinate.
    y_m, x_m : (h,), (w,) float
        Reed coordinates of the pixels kept.
    """

    rows: slice
    columns: slice
    inside: NDArray[np.bool_]
    rough: Complex
    shapes: Array
    y_m: Array
    x_m: Array


def pitch_m(chip: Chip) -> float:
    """Pitch of the image on the object."""
    return WAVELENGTH_M * DISTANCE_M / (chip.rows * chip.pixel_m)


def make_stage(world: World, reed: ModalReed) -> Stage:
    """Light the reed."""
    pitch, n = pitch_m(world.chip), world.chip.rows
    height, width = (int(np.ceil(size / pitch)) for size in SIZE_M)
    row = round(n / 2 + (CENTRE_M[0] - 0.5 * SIZE_M[0]) / pitch)
    column = round(n / 2 + (CENTRE_M[1] - 0.5 * SIZE_M[1]) / pitch)
    y_m = (np.arange(height) + row - n // 2) * pitch - CENTRE_M[0]
    x_m = (np.arange(width) + column - n // 2) * pitch - CENTRE_M[1] + 0.5 * SIZE_M[1]
    fine = (np.arange(_FINER) + 0.5) / _FINER - 0.5
    y = (y_m[:, None] + pitch * fine).ravel()
    x = (x_m[:, None] + pitch * fine).ravel()
    Y, X = np.meshgrid(y, x, indexing="ij")
    inside = (X > 0) & (np.abs(Y) < half_width_m(X))
    at = np.stack([X[inside], Y[inside]], axis=1)
    shapes = CloughTocher2DInterpolator(reed.top_m, reed.top)(at)
    outside = np.isnan(shapes[:, 0])
    shapes[outside] = NearestNDInterpolator(reed.top_m, reed.top)(at[outside])
    rng = np.random.default_rng([world.seed, 11])
    parts = rng.standard_normal((2, len(at)))
    r2 = (at[:, 0] - 0.5 * SIZE_M[1]) ** 2 + at[:, 1] ** 2
    rough = (parts[0] + 1j * parts[1]) * np.exp(-r2 / world.light.object_waist_m**2)
    rough *= np.sqrt(world.light.object_e_s * n**2 / np.sum(np.abs(rough) ** 2))
    return Stage(
        slice(row, row + height), slice(column, column + width), inside, rough, shapes, y_m, x_m
    )


class Camera:
    """One camera before one stage.

    Parameters
    ----------
    world : World
    stage : Stage
    """

    def __init__(self, world: World, stage: Stage) -> None:
        self.world, self.stage = world, stage
        chip, light, n = world.chip, world.light, world.chip.rows
        rng = np.random.default_rng([world.seed, 12])
        at = chip.pixel_m * (np.arange(n) - n // 2)
        Y, X = np.meshgrid(at, at, indexing="ij")
        shift_y, shift_x = light.lo_shift_m
        r2 = (X - shift_x) ** 2 + (Y - shift_y) ** 2
        self.lo = np.sqrt(light.lo_e_s) * np.exp(-r2 / light.lo_waist_m**2)
        corner = (X**2 + Y**2) / (2 * at[0] ** 2)
        self._passed = (1 - light.vignette * corner) * (
            1 + chip.pattern * rng.standard_normal((n, n))
        )
        self._dark_e_s = chip.hot_e_s * (rng.random((n, n)) < chip.hot)
        self._points_chirp = self._chirp_of_points()
        self._object_chirp = _chirp(n, pitch_m(chip), DISTANCE_M)
        # The reed stands where it stands; images are focused where the laboratory believes it.
        self._sensor_chirp = _chirp(n, chip.pixel_m, DISTANCE_M + light.defocus_m)
        self._focus_chirp = _chirp(n, chip.pixel_m, DISTANCE_M)
        hann = np.sin(np.pi * np.arange(n) / n) ** 2
        self._window = np.multiply.outer(hann, hann)
        self.chip, self.light = chip, light

    def sidebands(
        self, modal: Complex | None, moved_m: float = 0.0, base_m: complex = 0.0
    ) -> dict[int, Complex]:
        """Light of each sideband at the points of the stage (h·f, w·f).

        It is √(electrons/s) after `on_sensor`.

        Parameters
        ----------
        modal : (m,) complex, optional
            Vibration; none if not given.
        moved_m : float
            By which the image has moved along the reed.
        base_m : complex
            Motion of the clamp.
        """
        stage = self.stage
        rough = stage.rough
        if moved_m:
            # The image moves along the reed: half of each point's light goes to its neighbour's.
            share = moved_m * _FINER / pitch_m(self.chip)
            rough = rough * (1 - share) + share * np.roll(rough, 1)
        if modal is None:
            return {0: self._image(rough)}
        u = 4 * np.pi / WAVELENGTH_M * (stage.shapes @ modal + base_m)
        size = np.abs(u)
        unit = u / np.maximum(size, 1e-30)
        kept = np.exp(-self.light.blur * size**2)
        images = {}
        for order in _ORDERS:
            bessel = np.interp(size, _AT_RAD, _TABLE[abs(order)])
            turn = unit if order >= 0 else unit.conj()
            images[order] = self._image(
                rough * kept * (1j ** abs(order)) * bessel * turn ** abs(order)
            )
        return images

    def on_sensor(self, points: Complex) -> Complex:
        """Field (n, n) on the sensor of the light of points (h·f, w·f).

        A sensor as many times as large would tell points from each other; this one is its middle.
        """
        stage, n = self.stage, self.world.chip.rows
        field = points * self._points_chirp
        for axis, first in ((1, stage.columns.start), (0, stage.rows.start)):
            at = np.arange(n) - n // 2
            field = scipy.fft.ifft(field, _FINER * n, axis=axis, norm="forward")
            field = np.take(field, at % (_FINER * n), axis)
            # Of the first point, in pixels from the axis.
            place = first - n // 2 + 0.5 / _FINER - 0.5
            turn = np.exp(2j * np.pi * place * at / n)
            field = field * (turn[:, None] if axis == 0 else turn)
        spread: Complex = field * self._sensor_chirp / n
        return spread

    def expose(
        self,
        sensor_field: Complex | None,
        at_rest: Array,
        lo: float,
        exposure_s: float,
        rng: np.random.Generator,
    ) -> Frames:
        """One frame.

        Parameters
        ----------
        sensor_field : (n, n) complex, optional
            ∫ E dt of the object's light in the local oscillator's frame, √(e/s)·s.
        at_rest : (n, n) float
            Of the object's light alone, e/s; zeros if it is off.
        lo : float
            Amplitude of the local oscillator, 1 as a rule.
        exposure_s : float
        rng : numpy.random.Generator
        """
        chip = self.chip
        mean = at_rest * exposure_s
        if lo:
            mean = mean + (lo * self.lo) ** 2 * exposure_s
            if sensor_field is not None:
                mean = mean + 2 * lo * self.lo * sensor_field.real
        mean = np.maximum(mean * self._passed, 0) + self._dark_e_s * exposure_s
        noisy = rng.poisson(mean) + chip.read_e * rng.standard_normal(mean.shape)
        if chip.banding_e:
            noisy = noisy + chip.banding_e * rng.standard_normal((len(mean), 1))
        noisy = np.minimum(noisy, chip.full_e)
        noisy = noisy * (1 - chip.bend * np.clip(noisy, 0, None) / chip.full_e)
        numbers = np.rint(noisy / chip.gain_e_dn + chip.offset_dn)
        read: Frames = np.clip(numbers, 0, 2**chip.bits - 1).astype(np.uint16)
        return read

    def reconstructed(self, frames: Frames) -> tuple[NDArray[np.complex64], float]:
        """Image of the reed (h, w) of four frames, and the noise outside it, dn²."""
        one, two, three, four = frames.astype(np.float64)
        hologram, n = (one - three) + 1j * (two - four), self.chip.rows
        image = self.focused(hologram)
        # Without a window a part of the reed's own light would be there.
        empty = np.abs(self.focused(self._window * hologram)[: n // 5, : n // 5]) ** 2
        noise = float(empty.mean() / np.mean(self._window**2))
        return image[self.stage.rows, self.stage.columns].astype(np.complex64), noise

    def focused(self, hologram: Array | Complex) -> Complex:
        """Image (n, n) of a hologram at the distance that is believed in."""
        flat = hologram * self._focus_chirp.conj()
        spectrum = scipy.fft.fftshift(scipy.fft.fft2(scipy.fft.ifftshift(flat), norm="ortho"))
        image: Complex = spectrum * self._object_chirp.conj()
        return image

    def _image(self, points: Complex) -> Complex:
        """Put the light of points (p,) of the reed where they are on the stage (h·f, w·f)."""
        image = np.zeros(self.stage.inside.shape, complex)
        image[self.stage.inside] = points
        return image

    def _chirp_of_points(self) -> Complex:
        """Phase factors of the stage's points (h·f, w·f)."""
        stage, pitch = self.stage, pitch_m(self.world.chip)
        fine = pitch * ((np.arange(_FINER) + 0.5) / _FINER - 0.5)
        turns = [
            np.pi / (WAVELENGTH_M * DISTANCE_M) * ((at_m[:, None] + fine).ravel() + centre_m) ** 2
            for at_m, centre_m in (
                (stage.y_m, CENTRE_M[0]), (stage.x_m, CENTRE_M[1] - 0.5 * SIZE_M[1])
            )
        ]  # fmt: skip
        chirp: Complex = np.exp(-1j * np.add.outer(*turns))
        return chirp


def _chirp(n: int, pitch: float, distance_m: float) -> Complex:
    at = pitch * (np.arange(n) - n // 2)
    # A wave that spreads lags the more, the farther out: time goes as exp(+iωt).
    turn = np.pi / (WAVELENGTH_M * distance_m) * at**2
    chirp: Complex = np.exp(-1j * (turn[:, None] + turn))
    return chirp
