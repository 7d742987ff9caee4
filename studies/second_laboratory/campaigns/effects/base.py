"""What all effects have in common: how they are drawn, and where they act."""

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.campaigns.climate import Climate
from studies.second_laboratory.campaigns.drawing import BeamParameters, SensorParameters
from studies.second_laboratory.light import Geometry
from studies.second_laboratory.parameters import DriveParameters, ReedParameters
from studies.second_laboratory.reed import Reed

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Waves = NDArray[np.complex64]
T = TypeVar("T")

LASTS_S = 900.0
"""Length of a campaign, for effects that happen at some time within it (15 min)."""


def size(
    low: float, high: float, unit: str, words: str, source: str, *, signed: bool = False
) -> Any:
    """Return a field for the size of an effect; 0 is no effect.

    Parameters
    ----------
    low, high : float
        Barely there, and severe; drawn log-uniformly.
    unit, words, source : str
    signed : bool
        Whether either sign is possible.
    """
    described = {"range": (low, high), "unit": unit, "words": words, "source": source}
    return field(metadata={**described, "law": "signed" if signed else "log"})


def place(low: float, high: float, unit: str, words: str, source: str = "chosen") -> Any:
    """Return a field for where, when or how an effect acts; drawn uniformly."""
    described = {"range": (low, high), "unit": unit, "words": words, "source": source}
    return field(metadata={**described, "law": "even"})


@dataclass
class Moment:
    """What happens while the frames of one acquisition are exposed.

    Attributes
    ----------
    time_s : float
        Start of the first exposure, since the start of the campaign.
    middles_s : (m,) float64
        Middle of each exposure.
    clamped_s : float
        When the reed was put in place.
    drive_hz, volts : float
        What the generator plays; 0 V if it is off.
    clay : bool
        Whether half of the chamber is filled.
    rng, memory
        Of the effect that is asked; other effects have others.
    """

    time_s: float
    middles_s: Array
    clamped_s: float
    drive_hz: float
    volts: float
    clay: bool
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    memory: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Body:
    """The reed while it vibrates at one frequency.

    Attributes
    ----------
    reed : Reed
        With the moduli of this moment.
    hz : float
    coordinates : (m,) complex128
        Of its basis, in mm.
    """

    reed: Reed
    hz: float
    coordinates: ComplexArray

    def peak_um(self) -> float:
        """Return the largest displacement of the vamp, in µm."""
        return 1e3 * float(np.abs(self.reed.vamp @ self.coordinates).max())

    def along(self) -> ComplexArray:
        """Return the part of the stiffness that E_L gives."""
        elastic = self.reed.cane.elasticity(2 * np.pi * self.hz)
        return np.asarray(elastic[0, 0] * self.reed.parts[0])


@dataclass(frozen=True)
class Places:
    """Scatterers: where they are on the reed (mm), where the optics sees them (m), their light."""

    x_mm: Array
    y_mm: Array
    u_m: Array
    v_m: Array
    lit: Array


@dataclass(frozen=True)
class Effect:
    """One thing that is wrong, in addition to ordinary disorder.

    A subclass has fields made by `size` and `place`, and overrides the methods where it acts; all
    others leave what they get as it is. With sizes of 0 it changes nothing, to the last bit.
    """

    id: ClassVar[str] = ""
    series: ClassVar[str] = "AB"
    """Series in which the effect can be seen."""
    nonlinear: ClassVar[bool] = False
    """Whether `dynamic` depends on how far the reed moves."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """Draw sizes, log-uniformly, and the rest, evenly."""
        drawn = {}
        for each in fields(cls):
            low, high = each.metadata["range"]
            law, even, sign = each.metadata["law"], rng.uniform(), rng.choice([-1.0, 1.0])
            if law == "even":
                drawn[each.name] = float(low + (high - low) * even)
            else:
                value = float(low * (high / low) ** even)
                drawn[each.name] = value * float(sign) if law == "signed" else value
        return cls(**drawn)

    def absent(self) -> Self:
        """Return this effect with sizes of 0."""
        sizes = [each.name for each in fields(self) if each.metadata["law"] != "even"]
        return replace(self, **dict.fromkeys(sizes, 0.0))

    def sizes(self) -> dict[str, dict[str, Any]]:
        """Return each parameter with its value, unit, words, range and source."""
        return {
            each.name: {
                "value": getattr(self, each.name),
                "unit": each.metadata["unit"],
                "words": each.metadata["words"],
                "is_size": each.metadata["law"] != "even",
                "range": list(each.metadata["range"]),
                "source": each.metadata["source"],
            }
            for each in fields(self)
        }

    # --- Before the campaign ------------------------------------------------------------------

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Change the reed in its clamp."""
        return reed

    def drive(self, drive: DriveParameters) -> DriveParameters:
        """Change loudspeaker and chamber."""
        return drive

    def beams(self, beams: BeamParameters) -> BeamParameters:
        """Change the beams."""
        return beams

    def sensor(self, sensor: SensorParameters) -> SensorParameters:
        """Change the camera."""
        return sensor

    def geometry(self, geometry: Geometry) -> Geometry:
        """Change wavelength and distance from what the bench file states."""
        return geometry

    def places(self, places: Places) -> Places:
        """Change where the scatterers are seen, or their light."""
        return places

    def across(self, y_mm: Array, x_mm: Array) -> Array:
        """Change which y of the chamber lies behind points of the reed."""
        return y_mm

    # --- While frames are exposed -------------------------------------------------------------

    def climate(self, climate: Climate, time_s: float) -> Climate:
        """Change temperature and moisture at a time."""
        return climate

    def tones(self, tones: dict[int, complex], now: Moment) -> dict[int, complex]:
        """Change the volts of the drive and its harmonics, by the number of the harmonic."""
        return tones

    def transfer(self, factor: complex, hz: float) -> complex:
        """Change the pressure per volt at a frequency."""
        return factor

    def drive_hz(self, hz: float) -> float:
        """Change the frequency that the generator really plays."""
        return hz

    def turns(self, turns: Array, times_s: Array, now: Moment) -> Array:
        """Change the phase of f_AOM1 − f_AOM2 against what was set, in turns, at times."""
        return turns

    def dynamic(self, matrix: ComplexArray, body: Body, now: Moment) -> ComplexArray:
        """Change the dynamic stiffness K − ω²M of the reed."""
        return matrix

    def coherence(self, field: Waves, amplitude_um: Array) -> Waves:
        """Change the light of scatterers that beats with the reference."""
        return field

    def lines(self, lines: list[tuple[int, complex]]) -> list[tuple[int, complex]]:
        """Change the lines of the reference: offset in drive frequencies, and amplitude."""
        return lines

    def path(self, path_rad: Array, now: Moment) -> Array:
        """Change the phase of each frame."""
        return path_rad

    def contrast(self, contrast: Array, now: Moment) -> Array:
        """Change the contrast of each frame."""
        return contrast

    def power(self, power: Array, now: Moment) -> Array:
        """Change the power of the laser in each frame."""
        return power

    def renewal(self, renewal: float, time_s: float) -> float:
        """Change the part of the speckle that is renewed in a step."""
        return renewal

    def waves(self, waves: Waves, geometry: Geometry, now: Moment) -> Waves:
        """Change the object's waves (m, ny, nx) on the sensor."""
        return waves

    def sequence(self, order: list[int], now: Moment) -> list[int]:
        """Change which exposures are delivered, counted from the first."""
        return order

    def row_delay_s(self, delay_s: float) -> float:
        """Change by how much odd rows are exposed later than even rows."""
        return delay_s

    def numbers(self, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Change the digital numbers."""
        return image


class Cast:
    """All effects of a campaign, each with random numbers and a memory of its own."""

    def __init__(self, effects: tuple[Effect, ...], seed: tuple[int, ...]) -> None:
        self._acting = [
            (effect, np.random.default_rng([*seed, number]), dict[str, Any]())
            for number, effect in enumerate(effects)
        ]
        self.nonlinear = any(effect.nonlinear for effect in effects)

    def through(self, method: str, value: T, *context: Any) -> T:
        """Return a value after all effects have changed it by one of their methods."""
        for effect, rng, memory in self._acting:
            for each in context:
                if isinstance(each, Moment):
                    each.rng, each.memory = rng, memory
            value = cast(T, getattr(effect, method)(value, *context))
        return value
