"""The laboratory of a campaign: scenes, hands, and what the camera sees."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.campaigns.case import Setup
from studies.second_laboratory.campaigns.climate import Climate, Wander
from studies.second_laboratory.campaigns.drawing import draw_clamping
from studies.second_laboratory.campaigns.effects.base import (
    Array,
    Cast,
    ComplexArray,
    Moment,
    Waves,
)
from studies.second_laboratory.campaigns.image import Beat, ReedImage, reference_beam
from studies.second_laboratory.campaigns.motion import Motion
from studies.second_laboratory.campaigns.sensor import CampaignSensor
from studies.second_laboratory.drive import Drive
from studies.second_laboratory.laboratory import Settings
from studies.second_laboratory.light import Geometry
from studies.second_laboratory.parameters import ReedParameters
from studies.second_laboratory.reed import Reed
from studies.second_laboratory.shape import Fineness

# Images of mean electrons, in single or double precision.
Floats = NDArray[np.floating[Any]]
# The level of the beams is for this exposure: a period of the paper's camera.
_LEVEL_S = 1 / 12.4
# Time that hands need for a scene, and to clamp the reed again, in s. Chosen, so that a campaign
# takes about 15 min; a scene that is there already needs a look and a key.
_HANDS_S = {"dark": 40.0, "flat": 130.0, "lo_only": 80.0, "object_only": 30.0, "holograms": 50.0}
_CLAMP_S, _LOOK_S = 210.0, 4.0
# Part of that time which differs each time, ln sd. Chosen.
_HANDS_SD = 0.2
_WANDER_GAIN_S = 600.0


@lru_cache(maxsize=4)
def reed_of(parameters: ReedParameters, fineness: Fineness) -> Reed:
    """Return the reduced model of a reed; the last four are kept."""
    p = parameters
    return Reed(p.cane, p.thickness, p.clamp, fineness, p.air, p.flaws)


class World:
    """One bench with one reed, from the start of a campaign to its end.

    Parameters
    ----------
    setup : Setup
    geometry : Geometry
        As the bench file states it, with the whole sensor.
    centre_m : (float, float)
        (y, x) of the middle of the vamp from the optical axis, as the bench file states it.
    settings : Settings
        Shared with the instruments, which change it.
    fineness : Fineness, optional
        Of the finite elements.
    """

    def __init__(
        self,
        setup: Setup,
        geometry: Geometry,
        centre_m: tuple[float, float],
        settings: Settings,
        fineness: Fineness | None = None,
    ) -> None:
        self.cast = Cast(setup.case.effects, setup.effects())
        self._setup, self.settings, self._centre_m = setup, settings, centre_m
        self._fineness = fineness or Fineness()
        self._clay = setup.case.series == "A"
        bench, self._rng, self._hands = setup.bench, setup.noise(), setup.hands()
        self._beams = self.cast.through("beams", bench.beams)
        self._sensor_parameters = self.cast.through("sensor", bench.sensor)
        self._scene, self._geometry = "holograms", geometry
        self._path_rad, self._clamped_s = 0.0, 0.0
        air, beams = bench.air, bench.beams
        slow = np.random.default_rng(self._rng.integers(2**63))
        self._temperature = Wander(slow, air.temperature_sd_k, air.temperature_time_s)
        self._moisture = Wander(slow, air.moisture_sd, air.temperature_time_s)
        self._gain = Wander(slow, bench.gain_wander, _WANDER_GAIN_S)
        self._laser = Wander(slow, beams.power_wander, beams.power_time_s)
        self._split = Wander(slow, beams.split_wander, beams.power_time_s)
        self._offset = Wander(slow, bench.sensor.offset_wander_dn, air.temperature_time_s)
        self._number = 0
        self._clamp()
        self._read(geometry.shape)

    # --- Hands ----------------------------------------------------------------------------------

    def arrange(self, scene: str) -> float:
        """Change the light on the sensor; return how long that takes, in s."""
        asked_s = _LOOK_S if scene == self._scene else _HANDS_S[scene]
        self._scene = scene
        return self._takes_s(asked_s)

    def clamp_again(self, time_s: float) -> float:
        """Take the reed out, and put it back; return how long that takes, in s."""
        takes_s = self._takes_s(_CLAMP_S)
        self._number += 1
        self._clamp()
        self._clamped_s = time_s + takes_s
        return takes_s

    def _clamp(self) -> None:
        self._clamping_rng = self._setup.clamping(self._number)
        self.clamping = draw_clamping(self._setup.bench.hands, self._clamping_rng)
        self._image: ReedImage | None = None
        self._motion: Motion | None = None

    def _takes_s(self, seconds: float) -> float:
        spread = float(np.exp(_HANDS_SD * self._hands.standard_normal()))
        return seconds * self._setup.bench.hands.pace * spread

    # --- What there is --------------------------------------------------------------------------

    def read(self, shape: tuple[int, int]) -> None:
        """Read out another part of the sensor."""
        if shape != self._geometry.shape:
            self._read(shape)

    def _read(self, shape: tuple[int, int]) -> None:
        """Make the patterns of the part of the sensor that is read out."""
        self._geometry = replace(self._geometry, shape=shape)
        body = self._setup.body()
        self._sensor = CampaignSensor(self._sensor_parameters, shape, body, self._rng)
        reference = reference_beam(self._beams, self._geometry, body)
        self._reference = reference.astype(np.complex64)
        self._power = np.abs(self._reference) ** 2
        v, u = (np.linspace(-1, 1, n) for n in shape)
        # Relative to the corners, where the square of the distance is 1.
        square = (v[:, None] ** 2 + u**2) / 2
        self._passes = (1 - self._beams.vignetting * square).astype(np.float32)
        lamp = self._setup.bench.lamp
        uneven = 1 + lamp.slope[0] * v[:, None] + lamp.slope[1] * u
        # A lamp in front of a sensor falls off towards its corners, by half of what it leans.
        self._lamp = lamp.rate_e_s * (uneven - 0.5 * np.hypot(*lamp.slope) * square)
        self._image = None

    def reed_parameters(self) -> ReedParameters:
        """Return the reed in its present clamping, with what effects change."""
        reed = replace(self._setup.reed, air=self._setup.day.air)
        return self.cast.through("reed", self.clamping.on(reed))

    def reed(self) -> Reed:
        """Return the reduced model of the reed in its present clamping."""
        return reed_of(self.reed_parameters(), self._fineness)

    def motion(self) -> Motion:
        """Return how the reed in its present clamping answers."""
        if self._motion is None:
            base = self._setup.bench.drive
            lateral_mm = base.lateral_mm + self.clamping.lateral_mm
            drive = self.cast.through("drive", replace(base, lateral_mm=lateral_mm))
            self._motion = Motion(self.reed(), Drive(drive, self._clay), self.cast)
        return self._motion

    def image(self) -> ReedImage:
        """Return the light of the reed in its present clamping."""
        if self._image is None:
            self._image = ReedImage(
                self.reed(),
                self._beams,
                self._geometry,
                self._centre_m,
                self.clamping,
                self.cast,
                self._clamping_rng,
            )
        return self._image

    def climate(self, time_s: float) -> Climate:
        """Return temperature and moisture at a time."""
        now = Climate(
            self._setup.day.temperature_c + float(self._temperature(time_s)),
            float(self._moisture(time_s)),
        )
        return self.cast.through("climate", now, time_s)

    # --- What the camera sees -------------------------------------------------------------------

    def expose(self, starts_s: Sequence[float], exposure_s: float) -> list[NDArray[np.uint16]]:
        """Return the frames of consecutive exposures, of which there are several."""
        now = self.moment(starts_s[0], np.asarray(starts_s) + exposure_s / 2)
        order = self.cast.through("sequence", list(range(len(starts_s))), now)
        taken = sorted(set(order))
        period_s = starts_s[1] - starts_s[0]
        jitter_s = self._sensor_parameters.jitter_s * self._rng.standard_normal(len(taken))
        starts = starts_s[0] + period_s * np.array(taken) + jitter_s
        now.middles_s = starts + exposure_s / 2
        images = {}
        light = self._light(exposure_s, now)
        for number, electrons, middle_s in zip(taken, light, now.middles_s, strict=True):
            warm_c = self.climate(float(middle_s)).temperature_c
            offset_dn = float(self._offset(middle_s))
            image = self._sensor(electrons, exposure_s, warm_c, offset_dn)
            images[number] = np.minimum(self.cast.through("numbers", image), 4095)
        return [images[number] for number in order]

    def moment(self, time_s: float, middles_s: Array) -> Moment:
        """Return what is played at a time."""
        now = self.settings
        volts = now.volts if now.sounding else 0.0
        hz = float(now.drive_hz)
        return Moment(time_s, middles_s, self._clamped_s, hz, volts, self._clay)

    def _light(self, exposure_s: float, now: Moment) -> list[Floats]:
        """Return the mean electrons of each frame."""
        count, part = len(now.middles_s), exposure_s / _LEVEL_S
        flicker = self._setup.bench.lamp.flicker * self._rng.standard_normal(count)
        noise = self._beams.laser_sd * self._rng.standard_normal(count)
        power = 1 + noise + self._laser(now.middles_s)
        power = self.settings.rf * self.cast.through("power", power, now)
        if self._scene == "dark":
            return [np.zeros(self._geometry.shape)] * count
        if self._scene == "flat":
            return [exposure_s * (1 + each) * self._passes * self._lamp for each in flicker]
        stray = part * self._beams.stray_e
        bright = [float(part * each) * self._passes for each in power]
        if self._scene == "lo_only":
            return [each * self._power + stray for each in bright]
        waves, own = self._object(exposure_s, now)
        split = 1 + self._split(now.middles_s)
        if self._scene == "object_only":
            return [each * float(s) * own + stray for each, s in zip(bright, split, strict=True)]
        frames = []
        for wave, each, share in zip(waves, bright, split, strict=True):
            cross = 2 * float(np.sqrt(share)) * np.real(wave * self._reference.conj())
            frames.append(each * (self._power + float(share) * own + cross) + stray)
        return frames

    def _object(self, exposure_s: float, now: Moment) -> tuple[Waves, Floats]:
        """Return the object's waves, with phase and contrast of each frame, and its light."""
        image, beams = self.image(), self._beams
        image.age(now.time_s, driven=now.volts > 0)
        count, rng = len(now.middles_s), self._rng
        walk = beams.path_frames_rad / 2 * rng.standard_normal(count)
        path = self._path_rad + np.concatenate([[0.0], np.cumsum(walk[1:])])
        self._path_rad = float(path[-1] + beams.path_sd_rad * rng.standard_normal())
        path = self.cast.through("path", path, now)
        contrast = self.cast.through("contrast", np.full(count, 1 - beams.contrast_lost), now)
        gain = (1 + float(self._gain(now.time_s))) * (
            1 + self._setup.bench.drive.gain_sd * float(rng.standard_normal())
        )
        motion = dict[int, ComplexArray]()
        if now.volts:
            motion = self.motion().coordinates(self.climate(now.time_s), gain, now)
        waves, own = image.light(motion, self.beat(exposure_s, now), now)
        delay_s = self.cast.through("row_delay_s", 0.0)
        if delay_s:
            later = replace(now, middles_s=now.middles_s + delay_s)
            waves[:, 1::2] = image.light(motion, self.beat(exposure_s, later), now)[0][:, 1::2]
        seen = (contrast * np.exp(1j * path)).astype(np.complex64)
        return waves * seen[:, None, None], own

    def beat(self, exposure_s: float, now: Moment) -> Beat:
        """Return how light beats with the reference in the frames of a moment."""
        settings, middles_s = self.settings, now.middles_s
        edges = [middles_s - exposure_s / 2, middles_s, middles_s + exposure_s / 2]
        before, turns, after = (
            self.cast.through("turns", np.zeros(len(each)), each, now) for each in edges
        )
        return Beat(
            self.cast.through("drive_hz", now.drive_hz),
            float(settings.aom1_hz - settings.aom2_hz),
            middles_s,
            exposure_s,
            turns,
            (after - before) / exposure_s,
            self.cast.through("lines", [(0, 1 + 0j)]),
        )
