"""Fresnel propagation between sensor and object with one FFT.

The single-FFT transform is valid from the distance ``N dx²/λ`` on (0.09 m for 1280 pixels of 6.7 µm
at 650 nm). Beyond this distance, and so on this bench, the angular spectrum method aliases.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.fft

Complex64Array = npt.NDArray[np.complex64]
CyclesArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FresnelTransform:
    """Unitary single-FFT Fresnel transform between a sensor and a plane parallel to it.

    A positive distance means that light travels from the object to the sensor. Amplitudes are
    those of ``exp(+2πiνt)``, as in all of this software: a wave that diverges from the object has
    the phase factor ``exp(-ikr)``, and its curvature on the sensor is ``exp(-iπr²/(λz))``.
    `four_phase` returns this wave for frames at ``n·f + f_CCD/4``. Its conjugate, the twin image,
    is out of focus after `to_object`.

    Both planes have centred grids: pixel ``(ny//2, nx//2)`` is on the optical axis. The transform
    preserves ``Σ|field|²``; a field per unit of length follows from
    ``U_sensor = to_sensor(U_object) * sqrt(dy_o dx_o) / pixel_m``. The constant phase
    ``i·exp(-ikz)`` is included, so absolute phases agree with the Fresnel integral.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns of both planes, ``(ny, nx)``.
    pixel_m : float
        Pitch of the (square) sensor pixels.
    wavelength_m : float
        Wavelength of the light.
    distance_m : float
        Distance from object to sensor, at least ``max(ny, nx) * pixel_m² / wavelength_m``: below
        that, the phase of the sensor's chirp changes by more than π from one pixel to the next.
    workers : int
        Number of threads of the FFT.

    Raises
    ------
    ValueError
        If the shape, a length or the number of workers is not positive, or the distance is too
        short.

    Notes
    -----
    If the distance exceeds the limit above, the object chirp is undersampled towards the edges of
    the object plane. This affects neither intensities nor the round trip. It only affects
    `to_sensor` for fields that scatter beyond the sensor: such light is folded back onto it.

    The chirps are computed in double precision at the first use, and kept in memory as complex64
    (8 bytes per pixel and chirp).
    """

    shape: tuple[int, int]
    pixel_m: float
    wavelength_m: float
    distance_m: float
    workers: int = 1

    def __post_init__(self) -> None:
        if len(self.shape) != 2 or min(self.shape) < 1:
            raise ValueError(
                f"FresnelTransform: shape is {self.shape}; give positive (rows, columns)"
            )
        for name in ("pixel_m", "wavelength_m", "distance_m", "workers"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"FresnelTransform: {name} is {value}; give a positive number")
        shortest_m = max(self.shape) * self.pixel_m**2 / self.wavelength_m
        if self.distance_m < shortest_m:
            raise ValueError(
                f"FresnelTransform: distance_m is {self.distance_m:g}, below {shortest_m:.4g}, "
                f"where the chirp of {max(self.shape)} pixels of {self.pixel_m:g} m aliases at "
                f"{self.wavelength_m:g} m; move the object away or crop the hologram"
            )

    @property
    def object_pitch_m(self) -> tuple[float, float]:
        """Return the pitch ``(dy, dx)`` of object images in m.

        It is ``wavelength * distance / (N * pixel)`` along each axis.
        """
        rows, columns = self.shape
        width_m = self.wavelength_m * self.distance_m / self.pixel_m
        return width_m / rows, width_m / columns

    def to_object(self, hologram: npt.ArrayLike) -> Complex64Array:
        """Propagate a field from the sensor to the object; inverse and adjoint of `to_sensor`.

        Parameters
        ----------
        hologram : array_like, shape (..., ny, nx)
            Field on the sensor, real or complex; computed in complex64.

        Returns
        -------
        ndarray of complex64, shape (..., ny, nx)
            Field on the object.

        Raises
        ------
        ValueError
            If the last two axes are not ``shape``.
        """
        sensor_chirp, object_chirp = self._backward_chirps
        field = self._transform(hologram, sensor_chirp, forward=False)
        np.multiply(field, object_chirp, out=field)
        return field

    def to_sensor(self, field: npt.ArrayLike) -> Complex64Array:
        """Propagate a field from the object to the sensor; inverse and adjoint of `to_object`.

        Parameters
        ----------
        field : array_like, shape (..., ny, nx)
            Field on the object, real or complex; computed in complex64.

        Returns
        -------
        ndarray of complex64, shape (..., ny, nx)
            Field on the sensor.

        Raises
        ------
        ValueError
            If the last two axes are not ``shape``.
        """
        sensor_chirp, object_chirp = self._forward_chirps
        hologram = self._transform(field, object_chirp, forward=True)
        np.multiply(hologram, sensor_chirp, out=hologram)
        return hologram

    @property
    def object_chirp(self) -> Complex64Array:
        """Return the phase factors (ny, nx) complex64 that `to_object` multiplies images by."""
        return self._backward_chirps[1]

    def intensity(self, hologram: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Return ``|to_object(hologram)|²``, faster, because the object chirp is not needed.

        Parameters
        ----------
        hologram : array_like, shape (..., ny, nx)
            Field on the sensor.

        Returns
        -------
        ndarray of float32, shape (..., ny, nx)

        Raises
        ------
        ValueError
            If the last two axes are not ``shape``.
        """
        field = self._transform(hologram, self._backward_chirps[0], forward=False)
        power: npt.NDArray[np.float32] = np.abs(field)
        np.square(power, out=power)
        return power

    def of_windowed(
        self, image: Complex64Array, start: int, count: int, axis: int
    ) -> Complex64Array:
        """Return what `to_object` would give for a hologram under a Hann window along one axis.

        Light ends at the edges of a sensor, so that its image has side lobes all over the object
        plane; those under a Hann window fall by 18 dB per octave in place of 6 (Harris, Proc. IEEE
        66, 51 (1978)). The window ``sin²(πn/N)`` on N pixels is a sum over neighbours in the image.

        Parameters
        ----------
        image : ndarray of complex64, shape (..., ny, nx)
            Result of `to_object`.
        start, count : int
            The rows (axis 0) or columns (axis 1) of the image that are wanted.
        axis : int
            Axis of the window, 0 or 1.

        Returns
        -------
        ndarray of complex64, shape (..., count, nx) or (..., ny, count)
        """
        # Neighbours of the first row of an image are its second and its last.
        at, along = np.arange(start - 1, start + count + 1) % self.shape[axis], axis - 2
        chirp = np.take(self._backward_chirps[1], at, along)
        spectrum = np.moveaxis(np.take(image, at, along) * chirp.conj(), along, 0)
        windowed = np.float32(0.5) * spectrum[1:-1]
        windowed -= np.float32(0.25) * (spectrum[:-2] + spectrum[2:])
        inner = np.take(chirp, np.arange(1, count + 1), along)
        field: Complex64Array = np.moveaxis(windowed, 0, along) * inner
        return field

    def _transform(
        self, field: npt.ArrayLike, chirp: Complex64Array, *, forward: bool
    ) -> Complex64Array:
        field = np.asarray(field)
        if field.shape[-2:] != self.shape:
            raise ValueError(
                f"FresnelTransform: field has shape {field.shape}, the transform is for "
                f"{self.shape}; crop or pad the field, or build a transform for its shape"
            )
        product = np.multiply(field, chirp, dtype=np.complex64, casting="same_kind")
        # The cross term of -iπ(x - x')²/(λz) is +2πi·xx'/(λz), which is an inverse FFT.
        fft2 = scipy.fft.ifft2 if forward else scipy.fft.fft2
        spectrum: Complex64Array = fft2(
            product, norm="ortho", overwrite_x=True, workers=self.workers
        )
        return spectrum

    @cached_property
    def _forward_chirps(self) -> tuple[Complex64Array, Complex64Array]:
        """Return the sensor and object chirps of `to_sensor`."""
        return self._chirps(sign=-1)

    @cached_property
    def _backward_chirps(self) -> tuple[Complex64Array, Complex64Array]:
        """Return the sensor and object chirps of `to_object`: those of `to_sensor`, conjugated."""
        return self._chirps(sign=1)

    def _chirps(self, sign: int) -> tuple[Complex64Array, Complex64Array]:
        """Return the sensor chirp, which includes all constant factors, and the object chirp."""
        sensor, image = self.cycles()
        return _outer_phasor(sensor, sign), _outer_phasor(image, sign)

    def cycles(self) -> tuple[list[CyclesArray], list[CyclesArray]]:
        """Return the phases of the chirps of `to_object`, in cycles.

        A chirp is a product of one along its rows and one along its columns. Those of `to_sensor`
        have the opposite sign.

        Returns
        -------
        sensor, image : list of [(ny,), (nx,)] float64
            The constant factors are in the first of the sensor.
        """
        # Phase in cycles of exp(ikz)/i, the conjugate of the Fresnel integral's factor.
        constant = self.distance_m / self.wavelength_m - 0.25
        sensor = self._cycles((self.pixel_m, self.pixel_m))
        sensor[0] += constant % 1.0
        return sensor, self._cycles(self.object_pitch_m)

    def _cycles(self, pitch_m: tuple[float, float]) -> list[CyclesArray]:
        """Return the phase of a plane's chirp along its rows and along its columns, in cycles.

        A centred FFT has the kernel ``exp(±2πi (m - c)(n - c)/N)`` with ``c = N // 2``. Each plane
        includes half of the additional phase (for even N it is the sign ``(-1)^(m + n)``), so that
        no array has to be shifted.
        """
        cycles = []
        for count, pitch in zip(self.shape, pitch_m, strict=True):
            index = np.arange(count)
            centre = count // 2
            position_m = (index - centre) * pitch
            curvature = position_m**2 / (2 * self.wavelength_m * self.distance_m)
            cycles.append(curvature + (centre * (index - centre / 2) / count) % 1.0)
        return cycles


def _outer_phasor(cycles: list[CyclesArray], sign: int) -> Complex64Array:
    along_rows, along_columns = (np.exp(2j * np.pi * sign * cycle) for cycle in cycles)
    phasor: Complex64Array = np.multiply.outer(along_rows, along_columns).astype(np.complex64)
    phasor.flags.writeable = False
    return phasor
