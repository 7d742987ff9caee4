"""Parameters of a bench that a campaign needs, and how they are drawn."""

from dataclasses import dataclass, replace

import numpy as np

from studies.second_laboratory.campaigns.disorder import CampaignDisorder, disorder_at
from studies.second_laboratory.parameters import (
    CameraParameters,
    Disorder,
    DriveParameters,
    LightParameters,
    ReedParameters,
    draw_bench,
    draw_reed,
)

# What the data sheet of the camera states: the nominal values of `CameraParameters`, and the middle
# of the range of read noise.
SHEET = CameraParameters(read_noise_e=8.0)


@dataclass(frozen=True)
class BeamParameters(LightParameters):
    """Beams of a campaign; see `CampaignDisorder` for what the fields mean."""

    power_wander: float = 0.0
    split_wander: float = 0.0
    power_time_s: float = 300.0
    contrast_lost: float = 0.0
    dust: float = 0.0
    stray_e: float = 0.0
    vignetting: float = 0.0
    """Light that is lost in the corners of the part of the sensor that is read."""


@dataclass(frozen=True)
class SensorParameters(CameraParameters):
    """Camera of a campaign."""

    offset_wander_dn: float = 0.0
    dark_pattern_e: float = 0.0
    dark_current_e_s: float = 0.0
    hot_share: float = 0.0


@dataclass(frozen=True)
class LampParameters:
    """Lamp of the flat frames: electrons in a second, its gradients, its flicker."""

    rate_e_s: float = 0.6 * 20_000 / 0.08
    slope: tuple[float, float] = (0.0, 0.0)
    flicker: float = 0.0


@dataclass(frozen=True)
class HandParameters:
    """What people do: how fast, and how well they repeat it; standard deviations in mm and ln."""

    pace: float = 1.0
    place_mm: float = 0.0
    turn_rad: float = 0.0
    front_mm: float = 0.0
    tilt_mm_per_mm: float = 0.0
    bed: float = 0.0
    lateral_mm: float = 0.0


@dataclass(frozen=True)
class AirParameters:
    """Air and what it does to the reed: standard deviations, and the time over which it varies."""

    temperature_sd_k: float = 0.0
    temperature_time_s: float = 1200.0
    moisture_sd: float = 0.0


@dataclass(frozen=True)
class CampaignBench:
    """One bench, as it is in all campaigns."""

    drive: DriveParameters = DriveParameters()
    gain_wander: float = 0.0
    beams: BeamParameters = BeamParameters()
    sensor: SensorParameters = SensorParameters()
    lamp: LampParameters = LampParameters()
    hands: HandParameters = HandParameters()
    air: AirParameters = AirParameters()


@dataclass(frozen=True)
class Day:
    """What differs from one campaign of a reed to the next."""

    temperature_c: float = 20.0
    air: float = 1.0


@dataclass(frozen=True)
class Clamping:
    """How a reed was put in place.

    Attributes
    ----------
    front_mm, tilt_mm_per_mm, bed : float
        Strips of the ligature against the habit of this bench; the bed in ln.
    lateral_mm : float
        Reed on the mouthpiece.
    place_mm : (float, float)
        x and y of the reed in the image, against the bench file.
    turn_rad : float
        Of the reed about the line of sight.
    """

    front_mm: float = 0.0
    tilt_mm_per_mm: float = 0.0
    bed: float = 0.0
    lateral_mm: float = 0.0
    place_mm: tuple[float, float] = (0.0, 0.0)
    turn_rad: float = 0.0

    def on(self, reed: ReedParameters) -> ReedParameters:
        """Return a reed in this clamping."""
        clamp = replace(
            reed.clamp,
            front_mm=reed.clamp.front_mm + self.front_mm,
            tilt_mm_per_mm=reed.clamp.tilt_mm_per_mm + self.tilt_mm_per_mm,
            bed_n_per_mm3=reed.clamp.bed_n_per_mm3 * float(np.exp(self.bed)),
        )
        return replace(reed, clamp=clamp)


def draw_campaign_bench(amount: float, seed: int) -> CampaignBench:
    """Draw a bench; `draw_bench` draws what sweeps have, further draws what they lack."""
    disorder, further = disorder_at(amount)
    base, rng = draw_bench(disorder, seed), np.random.default_rng([seed, 4])
    pole_hz, quality, height = base.drive.cavity
    cavity = (
        pole_hz,
        quality * float(np.exp(further.cavity.draw(rng))),
        height * float(np.exp(further.cavity.draw(rng))),
    )
    beams, hands = _draw_beams(base.light, further, rng), _draw_hands(further, rng)
    sensor = _draw_sensor(base.camera, further, rng)
    return CampaignBench(
        replace(base.drive, cavity=cavity),
        further.gain_wander.draw(rng),
        beams,
        sensor,
        _draw_lamp(further, sensor.full_well_e, rng),
        hands,
        AirParameters(
            disorder.temperature.draw(rng),
            further.temperature_time.draw(rng),
            further.moisture.draw(rng),
        ),
    )


def _draw_beams(
    light: LightParameters, further: CampaignDisorder, rng: np.random.Generator
) -> BeamParameters:
    f = further
    beams = BeamParameters(
        **vars(light),
        power_wander=f.power_wander.draw(rng),
        split_wander=f.split_wander.draw(rng),
        power_time_s=f.power_time.draw(rng),
        contrast_lost=f.contrast.draw(rng),
        dust=f.dust.draw(rng),
        stray_e=f.stray.draw(rng),
    )
    level, objects = (float(np.exp(each.draw(rng))) for each in (f.level, f.object_level))
    return replace(
        beams,
        reference_e=beams.reference_e * level,
        object_share=beams.object_share * objects,
    )


def _draw_lamp(
    further: CampaignDisorder, full_well_e: float, rng: np.random.Generator
) -> LampParameters:
    angle, slope = rng.uniform(0, 2 * np.pi), further.lamp_slope.draw(rng)
    return LampParameters(
        further.lamp.draw(rng) * full_well_e / 0.08,
        (slope * float(np.cos(angle)), slope * float(np.sin(angle))),
        further.lamp_flicker.draw(rng),
    )


def _draw_hands(further: CampaignDisorder, rng: np.random.Generator) -> HandParameters:
    f = further
    return HandParameters(
        float(np.exp(f.haste.draw(rng))),
        f.place.high,
        f.turn.high,
        f.again_front.draw(rng),
        f.again_tilt.draw(rng),
        f.again_bed.draw(rng),
        f.again_lateral.draw(rng),
    )


def _draw_sensor(
    camera: CameraParameters, further: CampaignDisorder, rng: np.random.Generator
) -> SensorParameters:
    f = further
    return SensorParameters(
        **{
            **vars(camera),
            "offset_dn": SHEET.offset_dn + f.offset.draw(rng),
            "electrons_per_dn": SHEET.electrons_per_dn * float(np.exp(f.conversion.draw(rng))),
            "full_well_e": SHEET.full_well_e * float(np.exp(f.full_well.draw(rng))),
        },
        offset_wander_dn=f.offset_wander.draw(rng),
        dark_pattern_e=f.dark_pattern.draw(rng),
        dark_current_e_s=f.dark_current.draw(rng),
        hot_share=f.hot.draw(rng),
    )


def draw_campaign_reed(amount: float, series: str, seed: int) -> ReedParameters:
    """Draw a reed, at 20 °C; its clamp is the habit of this bench, from which clampings differ."""
    disorder: Disorder = disorder_at(amount)[0]
    reed = draw_reed(disorder, series, seed)
    return replace(reed, cane=replace(reed.cane, temperature_c=20.0), air=1.0)


def draw_day(amount: float, rng: np.random.Generator) -> Day:
    """Draw what one campaign differs in."""
    disorder, further = disorder_at(amount)
    return Day(20.0 + further.day.draw(rng), 1 + disorder.air.draw(rng))


def draw_clamping(hands: HandParameters, rng: np.random.Generator) -> Clamping:
    """Draw how the reed is put in place."""
    front, tilt, bed, lateral = (float(value) for value in rng.standard_normal(4))
    x, y, turn = (float(value) for value in rng.uniform(-1, 1, 3))
    return Clamping(
        hands.front_mm * front,
        hands.tilt_mm_per_mm * tilt,
        hands.bed * bed,
        hands.lateral_mm * lateral,
        (hands.place_mm * x, hands.place_mm * y),
        hands.turn_rad * turn,
    )
