"""Find the distance at which a hologram is in focus, by the sharpness of its image."""

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.optimize

from holography.fresnel import FresnelTransform
from holography.region import Region

# Widths (σ) of two Gaussian filters, in image pixels. In images of the single-FFT transform a
# speckle is one pixel wide at every distance. Chosen: the first filter averages speckle, the second
# follows the illumination.
_SPECKLE_WIDTH_PX = 2.0
_DETAIL_WIDTH_PX = 8.0
# Added to the intensity, as a fraction of its mean. Chosen, so that the logarithm does not amplify
# noise in a dark background.
_FLOOR = 0.1


def sharpness(image: npt.ArrayLike) -> float:
    """Return the sharpness of an image: the variance of the logarithm of its details.

    Details are structures between the widths of speckle and of illumination.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Intensity of a reconstruction.

    Returns
    -------
    float
        Sharpness, which does not depend on brightness; 0 for a uniform image.

    Raises
    ------
    ValueError
        If the image is dark.

    Notes
    -----
    Speckle has full contrast in focus and out of focus, and it multiplies the image. Variance or
    gradients of the intensity therefore measure the brightest speckles. In the logarithm of an
    image that is averaged over a few speckles, speckle is additive and has the same variance
    everywhere. Dark lines (nodal lines, edges), which fill with light out of focus, then weigh as
    much as bright ones.
    """
    intensity = np.asarray(image, dtype=np.float32)
    mean = float(intensity.mean(dtype=np.float64))
    if not mean > 0:
        raise ValueError(
            f"sharpness: the image's mean is {mean}; give the intensity of a region with light"
        )
    averaged = scipy.ndimage.gaussian_filter(intensity, _SPECKLE_WIDTH_PX)
    logarithm = np.log(averaged / np.float32(mean) + np.float32(_FLOOR))
    detail = logarithm - scipy.ndimage.gaussian_filter(logarithm, _DETAIL_WIDTH_PX)
    return float(np.var(detail, dtype=np.float64))


def focus_scan(
    hologram: npt.ArrayLike,
    pixel_m: float,
    wavelength_m: float,
    distances_m: npt.ArrayLike,
    region: Region,
) -> npt.NDArray[np.float64]:
    """Return the sharpness of the image order at several distances.

    Parameters
    ----------
    hologram : array_like, shape (ny, nx)
        Complex hologram, or a single off-axis frame. Its mean, which is part of the zero order, is
        subtracted.
    pixel_m : float
        Pitch of the sensor pixels.
    wavelength_m : float
        Wavelength of the light.
    distances_m : array_like, shape (n,)
        Distances to try, each valid for `FresnelTransform`.
    region : Region
        Pixels of the reconstruction that hold the image order, but neither zero order nor twin
        image. In pixels, the order has the same position at all distances; its size is
        proportional to 1/distance.

    Returns
    -------
    ndarray of float64, shape (n,)
        Sharpness at each distance.

    Raises
    ------
    ValueError
        If a distance is outside the validity of the transform, the region leaves the image, or
        the region is dark.
    """
    field = np.asarray(hologram)
    field = (field - field.mean()).astype(np.complex64)
    rows, columns = field.shape
    return np.array(
        [
            sharpness(
                region.crop(
                    FresnelTransform(
                        (rows, columns), pixel_m, wavelength_m, float(distance_m)
                    ).intensity(field)
                )
            )
            for distance_m in np.atleast_1d(np.asarray(distances_m, dtype=np.float64))
        ]
    )


def best_distance(
    hologram: npt.ArrayLike,
    pixel_m: float,
    wavelength_m: float,
    distances_m: npt.ArrayLike,
    region: Region,
) -> float:
    """Return the distance of best focus: the sharpest one of a scan, refined.

    Parameters
    ----------
    hologram, pixel_m, wavelength_m, region
        See `focus_scan`.
    distances_m : array_like, shape (n,)
        Increasing distances. The steps should not exceed the depth of focus
        ``4 λ (z / sensor width)²``, 2 cm on this bench at 1 m.

    Returns
    -------
    float
        Distance in m.

    Raises
    ------
    ValueError
        See `focus_scan`; also if the sharpest distance is the first or last one.
    """
    distances = np.atleast_1d(np.asarray(distances_m, dtype=np.float64))
    curve = focus_scan(hologram, pixel_m, wavelength_m, distances, region)
    sharpest = int(np.argmax(curve))
    if sharpest in (0, len(distances) - 1):
        raise ValueError(
            f"best_distance: the sharpest of {len(distances)} distances is the end of the scan, "
            f"{distances[sharpest]:g} m; scan further, or check region and wavelength"
        )
    refined = scipy.optimize.minimize_scalar(
        lambda z: -float(focus_scan(hologram, pixel_m, wavelength_m, z, region)[0]),
        bounds=(distances[sharpest - 1], distances[sharpest + 1]),
        method="bounded",
        options={"xatol": 0.02 * (distances[sharpest + 1] - distances[sharpest - 1])},
    )
    return float(refined.x)
