"""Camera."""

import math
from dataclasses import dataclass, replace

from studies.second_laboratory.campaigns.drawing import SensorParameters
from studies.second_laboratory.campaigns.effects.base import Effect, Moment, place, size


@dataclass(frozen=True)
class LostFrames(Effect):
    """The camera loses frames, or delivers one twice, and counts on as if nothing had happened."""

    id = "lost_frames"
    probability: float = size(
        5e-4, 0.05, "per frame", "how often", "overloaded buses and frame grabbers (chosen)"
    )
    twice: float = place(0.0, 0.5, "", "part of them that is delivered twice")

    def sequence(self, order: list[int], now: Moment) -> list[int]:
        """Leave out or repeat exposures."""
        found, following = list[int](), order[0]
        for _ in order:
            fails, repeats = now.rng.uniform(size=2)
            if fails < self.probability and found and repeats < self.twice:
                found.append(found[-1])
                continue
            following += fails < self.probability and repeats >= self.twice
            found.append(int(following))
            following += 1
        return found


@dataclass(frozen=True)
class FixedPatternNoise(Effect):
    """Pixels differ much in their sensitivity."""

    id = "fixed_pattern_noise"
    more: float = size(
        0.008,
        0.12,
        "relative sd",
        "sensitivity from pixel to pixel, in addition",
        "PRNU 0.5–1 % of scientific, up to 10 % of defective or uncoated sensors (EMVA 1288)",
    )

    def sensor(self, sensor: SensorParameters) -> SensorParameters:
        """Raise the non-uniformity."""
        return replace(sensor, uniformity=math.hypot(sensor.uniformity, self.more))


@dataclass(frozen=True)
class HotPixels(Effect):
    """Many pixels have a large dark current."""

    id = "hot_pixels"
    share: float = size(
        2e-4,
        0.02,
        "of all pixels",
        "how many, in addition",
        "CCD sensors after years of cosmic rays (Theuwissen 2007, IEEE Trans. Electron Devices 54)",
    )

    def sensor(self, sensor: SensorParameters) -> SensorParameters:
        """Raise the number."""
        return replace(sensor, hot_share=sensor.hot_share + self.share)


@dataclass(frozen=True)
class ReadNoise(Effect):
    """Read noise is larger than the data sheet says."""

    id = "read_noise"
    e: float = size(
        4.0, 60.0, "e", "read noise in addition", "pick-up in cables and supplies (chosen)"
    )

    def sensor(self, sensor: SensorParameters) -> SensorParameters:
        """Raise the read noise."""
        return replace(sensor, read_noise_e=math.hypot(sensor.read_noise_e, self.e))


@dataclass(frozen=True)
class SensorNonlinearity(Effect):
    """The camera answers less than in proportion to bright light."""

    id = "sensor_nonlinearity"
    bend: float = size(
        0.003,
        0.1,
        "of full well",
        "what is missing at full well, in addition",
        "0.2–1 % of scientific cameras, up to 10 % near saturation (EMVA 1288 data sheets)",
    )

    def sensor(self, sensor: SensorParameters) -> SensorParameters:
        """Bend the answer more."""
        return replace(sensor, bend=sensor.bend + self.bend)
