"""Sensor of a campaign: as that of sweeps, with a dark pattern, dark current and hot pixels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.campaigns.drawing import SensorParameters

Floats = NDArray[np.floating[Any]]
# Dark currents of hot pixels, e/s: log-uniform, so that none of them saturates in 80 ms.
_HOT_E_S = (300.0, 20_000.0)
# Kelvin by which dark current doubles (EMVA 1288, release 4, section 7).
_DOUBLES_K = 7.0
# Standard deviation of the logarithm of other pixels' dark current. Chosen.
_DARK_SPREAD = 0.3


class CampaignSensor:
    """Electrons and digital numbers of a 12-bit camera.

    Parameters
    ----------
    parameters : SensorParameters
    shape : (int, int)
    body : numpy.random.Generator
        From which the patterns of this camera are drawn, the same in all its campaigns.
    noise : numpy.random.Generator
    """

    def __init__(
        self,
        parameters: SensorParameters,
        shape: tuple[int, int],
        body: np.random.Generator,
        noise: np.random.Generator,
    ) -> None:
        p = self._p = parameters
        self._rng = noise
        self._response = (1 + p.uniformity * body.standard_normal(shape)).astype(np.float32)
        self._pattern_e = (p.dark_pattern_e * body.standard_normal(shape)).astype(np.float32)
        current = p.dark_current_e_s * np.exp(_DARK_SPREAD * body.standard_normal(shape))
        # The same numbers whatever the share, so that more hot pixels contain the fewer.
        rank, rate = body.uniform(size=(2, *shape))
        hot = _HOT_E_S[0] * (_HOT_E_S[1] / _HOT_E_S[0]) ** rate
        self._dark_e_s = np.where(rank < p.hot_share, hot, current).astype(np.float32)
        self._before: Floats | None = None

    def __call__(
        self, light_e: Floats, exposure_s: float, temperature_c: float, offset_dn: float
    ) -> NDArray[np.uint16]:
        """Return the frame of a mean number of electrons in each pixel.

        Parameters
        ----------
        light_e : (ny, nx) floats
        exposure_s, temperature_c : float
        offset_dn : float
            Difference of the offset to its mean.
        """
        p, rng = self._p, self._rng
        dark = self._dark_e_s * np.float32(exposure_s * 2 ** ((temperature_c - 20) / _DOUBLES_K))
        mean = np.maximum(light_e, 0).astype(np.float32) * self._response + dark
        # One number for shot and read noise: of both the variances add up.
        noise = rng.standard_normal(mean.shape, np.float32)
        electrons = mean + np.sqrt(mean + np.float32(p.read_noise_e**2)) * noise
        before = electrons if self._before is None else self._before
        self._before = electrons
        electrons = electrons + np.float32(p.lag) * (before - electrons)
        electrons = electrons * (1 - np.float32(p.bend / p.full_well_e) * electrons)
        rows = p.row_noise_e * rng.standard_normal((mean.shape[0], 1), np.float32)
        electrons = electrons + rows + self._pattern_e
        offset = np.float32(p.offset_dn + offset_dn)
        numbers = offset + np.minimum(electrons, p.full_well_e) / np.float32(p.electrons_per_dn)
        return np.asarray(np.clip(np.rint(numbers), 0, 4095).astype(np.uint16))
