"""Causes on no list: drive, people, and what the reed touches."""

import math
from dataclasses import dataclass, replace

import numpy as np

from studies.second_laboratory.campaigns.effects.base import (
    LASTS_S,
    Array,
    Body,
    ComplexArray,
    Effect,
    Moment,
    Places,
    Waves,
    place,
    size,
)
from studies.second_laboratory.light import Geometry
from studies.second_laboratory.parameters import Patch, ReedParameters

# Seconds after a setting in which a tweeter warms towards its new temperature: one step.
_STEP_S = 0.4
_FULL_V = 16.0
# Time over which a reed creeps in its clamp: logarithmic from a minute on. Chosen.
_CREEP_S = 60.0


@dataclass(frozen=True)
class GeneratorHarmonics(Effect):
    """The generator or its amplifier distorts: the reed is driven at 2f and 3f too."""

    id = "generator_harmonics"
    second: float = size(
        0.01, 0.3, "of the fundamental", "volts at 2f", "amplifiers that clip on one side (chosen)"
    )
    third: float = size(
        0.006, 0.2, "of the fundamental", "volts at 3f", "a square wave has a third (chosen)"
    )

    def tones(self, tones: dict[int, complex], now: Moment) -> dict[int, complex]:
        """Add harmonics."""
        added = {2: self.second * tones[1], 3: self.third * tones[1]}
        more = {h: tones.get(h, 0.0) + tone for h, tone in added.items() if tone}
        return {**tones, **more}


@dataclass(frozen=True)
class TweeterWarming(Effect):
    """The voice coil warms with the power of the last minutes, and gives less."""

    id = "tweeter_warming"
    lost: float = size(
        0.01,
        0.25,
        "relative",
        "sound that is lost at a steady 16 V",
        "copper 0.39 %/K, coils 20–100 K warmer at full power (Button 1992)",
    )
    seconds: float = place(10.0, 120.0, "s", "time in which the coil warms")

    def tones(self, tones: dict[int, complex], now: Moment) -> dict[int, complex]:
        """Warm up, or cool down, to this moment."""
        warm, since_s = now.memory.get("warm", (0.0, 0.0))
        passed_s = now.time_s - since_s
        # Between acquisitions the output is off or as it was; the last step's power counts.
        heats_s = min(passed_s, _STEP_S) if now.volts else 0.0
        warm *= math.exp(-(passed_s - heats_s) / self.seconds)
        target, kept = (now.volts / _FULL_V) ** 2, math.exp(-heats_s / self.seconds)
        warm = target + (warm - target) * kept if now.volts else warm
        now.memory["warm"] = warm, now.time_s
        return {h: tone * (1 - self.lost * warm) for h, tone in tones.items()}


@dataclass(frozen=True)
class AmplifierKnob(Effect):
    """A person turns the knob of the amplifier during the campaign."""

    id = "amplifier_knob"
    ln: float = size(
        0.02, 0.5, "ln", "change of the volts", "a touch to a turn (chosen)", signed=True
    )
    at: float = place(0.35, 0.85, "of 15 min", "when it happens")

    def tones(self, tones: dict[int, complex], now: Moment) -> dict[int, complex]:
        """Change all volts after that time."""
        factor = math.exp(self.ln * (now.time_s > self.at * LASTS_S))
        return {h: tone * factor for h, tone in tones.items()}


@dataclass(frozen=True)
class ReedAskew(Effect):
    """The reed lies askew on the mouthpiece, and in the image."""

    id = "reed_askew"
    degrees: float = size(
        0.3,
        5.0,
        "°",
        "turn about the line of sight",
        "put down without a look (chosen)",
        signed=True,
    )

    def across(self, y_mm: Array, x_mm: Array) -> Array:
        """Shift the chamber behind the reed, in proportion to the distance from the strips."""
        return y_mm + math.tan(math.radians(self.degrees)) * (38.2 - x_mm)

    def places(self, places: Places) -> Places:
        """Turn the image about its middle."""
        angle = math.radians(self.degrees)
        u0, v0 = places.u_m.mean(), places.v_m.mean()
        u, v = places.u_m - u0, places.v_m - v0
        cos, sin = math.cos(angle), math.sin(angle)
        return replace(places, u_m=u0 + (u * cos - v * sin), v_m=v0 + (u * sin + v * cos))


@dataclass(frozen=True)
class ReedContact(Effect):
    """The reed touches something at one spot: a splinter of the rail, a cable, dried clay."""

    id = "reed_contact"
    n_per_mm: float = size(
        0.001, 1.0, "N/mm", "stiffness of the contact", "a hair to a splinter of wood (chosen)"
    )
    x_mm: float = place(0.5, 20.0, "mm", "its distance from the tip")
    y_mm: float = place(-5.5, 5.5, "mm", "its place across the reed")

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add a lossy spring at a spot."""
        if not self.n_per_mm:
            return reed
        spot = Patch(self.x_mm, self.y_mm, 0.4, spring_n_per_mm=self.n_per_mm, loss=0.1)
        return replace(reed, flaws=replace(reed.flaws, patches=(*reed.flaws.patches, spot)))


@dataclass(frozen=True)
class LigatureRattle(Effect):
    """Above some amplitude a loose ligature rattles, and takes energy from the reed."""

    id = "ligature_rattle"
    nonlinear = True
    loss: float = size(
        0.002, 0.06, "", "loss factor far above the threshold", "dry friction (chosen)"
    )
    from_um: float = place(0.05, 0.5, "µm", "peak amplitude from which it rattles")

    def dynamic(self, matrix: ComplexArray, body: Body, now: Moment) -> ComplexArray:
        """Add losses above the threshold."""
        over = max(0.0, 1 - self.from_um / max(body.peak_um(), 1e-9))
        stiffness = body.reed.stiffness(2 * np.pi * body.hz, lossy=False).real
        return matrix + 1j * (self.loss * over) * stiffness


@dataclass(frozen=True)
class WaterFilm(Effect):
    """Breath has condensed on the front of the vamp; the film evaporates, and its speckle boils."""

    id = "water_film"
    um: float = size(
        0.05, 10.0, "µm", "thickness of the film at first", "a breath to a wet finger (chosen)"
    )
    minutes: float = place(1.0, 8.0, "min", "time in which it falls to 1/e")
    reach_mm: float = place(5.0, 20.0, "mm", "distance from the tip up to which it reaches")

    def _left_um(self, time_s: float) -> float:
        return self.um * math.exp(-time_s / (60 * self.minutes))

    def dynamic(self, matrix: ComplexArray, body: Body, now: Moment) -> ComplexArray:
        """Add the mass of the film."""
        key = f"gram {now.clamped_s}"
        if key not in now.memory:
            near = np.asarray(body.reed.load_x < self.reach_mm, float)
            now.memory[key] = body.reed.surface_gram(near)
        # 1 µm of water is 1e-12 t/mm².
        mass = 1e-12 * self._left_um(now.time_s) * now.memory[key]
        return np.asarray(matrix - (2 * np.pi * body.hz) ** 2 * mass)

    def renewal(self, renewal: float, time_s: float) -> float:
        """Let the speckle boil: a film of 1 µm renews 5 % of the field in a step."""
        return math.hypot(renewal, 0.05 * min(self._left_um(time_s), 6.0))


@dataclass(frozen=True)
class ClampCreep(Effect):
    """The reed creeps in its clamp: it moves in the image, and its bed yields."""

    id = "clamp_creep"
    um: float = size(
        3.0, 200.0, "µm", "motion along the grain in 15 min", "creep of plastics (chosen)"
    )
    yields: float = size(0.02, 0.7, "relative", "stiffness of the bed lost in 15 min", "as before")

    def _part(self, now: Moment, time_s: float | Array) -> Array:
        """Return how much of the motion of 15 min has happened since the reed was clamped."""
        since = np.maximum(np.asarray(time_s) - now.clamped_s, 0.0)
        return np.asarray(np.log1p(since / _CREEP_S) / math.log1p(LASTS_S / _CREEP_S))

    def dynamic(self, matrix: ComplexArray, body: Body, now: Moment) -> ComplexArray:
        """Soften the bed."""
        return matrix - self.yields * float(self._part(now, now.time_s)) * body.reed.bed

    def waves(self, waves: Waves, geometry: Geometry, now: Moment) -> Waves:
        """Shift the image, which tilts its waves on the sensor."""
        u = geometry.axis(waves.shape[2])
        shift_m = 1e-6 * self.um * self._part(now, now.middles_s)
        turns = shift_m[:, None] * u / (geometry.wavelength_m * geometry.distance_m)
        return np.asarray(waves * np.exp(2j * np.pi * turns)[:, None, :], np.complex64)
