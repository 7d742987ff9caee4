"""Displacement from the brightness of a sideband image (Bessel fringes)."""

import numpy as np
import numpy.typing as npt
import scipy.special


def phase_amplitude(displacement_m: npt.ArrayLike, wavelength_m: float) -> npt.NDArray[np.float64]:
    """Return the amplitude of the phase modulation, ``φ = 4πz/λ``.

    Parameters
    ----------
    displacement_m : array_like
        Peak displacement z in m along the common direction of illumination and observation
        (reflection at normal incidence).
    wavelength_m : float
        Wavelength of the light.

    Returns
    -------
    ndarray of float64
        Phase amplitude in rad, of the shape of `displacement_m`. Sideband n has the amplitude
        ``J_n(φ)``.
    """
    return 4 * np.pi / wavelength_m * np.asarray(displacement_m, dtype=np.float64)


def displacement_m(phase_rad: npt.ArrayLike, wavelength_m: float) -> npt.NDArray[np.float64]:
    """Return the displacement of a phase amplitude, ``z = φλ/4π``; see `phase_amplitude`.

    Parameters
    ----------
    phase_rad : array_like
        Phase amplitude φ in rad.
    wavelength_m : float
        Wavelength of the light.

    Returns
    -------
    ndarray of float64
        Peak displacement in m (from rest to the largest deflection, half of peak to peak), of the
        shape of `phase_rad`.
    """
    return wavelength_m / (4 * np.pi) * np.asarray(phase_rad, dtype=np.float64)


def first_sideband_maxima_m(count: int, wavelength_m: float) -> npt.NDArray[np.float64]:
    """Return the peak displacements at which the image of sideband 1 is brightest.

    Parameters
    ----------
    count : int
        Number of bright fringes, counted from the nodal line.
    wavelength_m : float
        Wavelength of the light.

    Returns
    -------
    ndarray of float64, shape (count,)
        Displacements in m at the maxima of ``|J_1(4πz/λ)|``, increasing. At 650 nm the first is
        95.2 nm, the fifth 768.8 nm, the tenth 1583 nm.

    Raises
    ------
    ValueError
        If `count` is not positive.
    """
    if count < 1:
        raise ValueError(f"first_sideband_maxima_m: count is {count}; give at least 1")
    maxima_rad = scipy.special.jnp_zeros(1, count)
    return wavelength_m / (4 * np.pi) * np.asarray(maxima_rad, dtype=np.float64)


def block_mean(image: npt.ArrayLike, factor_y: int, factor_x: int) -> npt.NDArray[np.float32]:
    """Return the mean of each rectangular block of pixels.

    Parameters
    ----------
    image : array_like, shape (..., ny, nx)
        Real image.
    factor_y, factor_x : int
        Rows and columns of a block. Rows and columns at the end that do not fill a block are
        dropped.

    Returns
    -------
    ndarray of float32, shape (..., ny//factor_y, nx//factor_x)
        Means, computed in double precision.

    Raises
    ------
    ValueError
        If the image is not real, or a block is empty or larger than the image.
    """
    image = np.asarray(image)
    rows, columns = image.shape[-2:]
    if image.dtype.kind not in "uif":
        raise ValueError(f"block_mean: the image is {image.dtype}; give intensities or amplitudes")
    if not (1 <= factor_y <= rows and 1 <= factor_x <= columns):
        raise ValueError(
            f"block_mean: a block of {factor_y}x{factor_x} does not fit an image of "
            f"{rows}x{columns} pixels; give factors from 1 to the image's size"
        )
    blocks_y, blocks_x = rows // factor_y, columns // factor_x
    blocks = image[..., : blocks_y * factor_y, : blocks_x * factor_x].reshape(
        *image.shape[:-2], blocks_y, factor_y, blocks_x, factor_x
    )
    means: npt.NDArray[np.float64] = blocks.mean(axis=(-3, -1), dtype=np.float64)
    return means.astype(np.float32)
