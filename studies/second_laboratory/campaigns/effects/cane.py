"""Material of the reed, and what the air does to it."""

import math
from dataclasses import dataclass, replace

import numpy as np

from studies.second_laboratory.campaigns.climate import Climate
from studies.second_laboratory.campaigns.effects.base import Effect, place, size
from studies.second_laboratory.parameters import ReedParameters

_WOOD = "coefficients of variation of wood, 10–20 % (Wood Handbook, FPL-GTR-282, ch. 5)"


@dataclass(frozen=True)
class ViscoelasticStiffening(Effect):
    """E_L and G_LT grow more with frequency than hypothesis H4 says; nothing changes at 4 kHz.

    Losses are kept apart from stiffness, as everywhere in this laboratory: those that would follow
    from H4 itself are not seen (READING.md).
    """

    id = "viscoelastic_stiffening"
    young: float = size(
        0.002,
        0.08,
        "per octave",
        "growth of E_L beyond H4",
        "E of spruce is 6 % higher in resonance than in static tests, over ten octaves (Haines "
        "et al. 1996, Wood Sci. Technol. 30); plastics grow tenfold faster",
    )
    shear: float = size(
        0.002, 0.08, "per octave", "growth of G_LT beyond H4", "as for E_L; chosen alone"
    )

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add exponents of frequency."""
        cane = replace(
            reed.cane,
            growth_E=reed.cane.growth_E + math.log2(1 + self.young),
            growth_G=reed.cane.growth_G + math.log2(1 + self.shear),
        )
        return replace(reed, cane=cane)


@dataclass(frozen=True)
class FrequencyDependentDamping(Effect):
    """Loss factors grow or fall with frequency; nothing changes at 4 kHz."""

    id = "frequency_dependent_damping"
    exponent: float = size(
        0.04,
        0.8,
        "",
        "exponent of frequency",
        "tan δ of spruce about doubles from 1 to 10 kHz, 0.3 (Haines 1979, Catgut Acoust. Soc. "
        "Newsl. 31)",
        signed=True,
    )

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add an exponent of frequency."""
        growth = reed.cane.growth_loss + self.exponent
        return replace(reed, cane=replace(reed.cane, growth_loss=growth))


@dataclass(frozen=True)
class Density(Effect):
    """The cane is heavier or lighter than it is taken to be."""

    id = "density"
    relative: float = size(
        0.005,
        0.15,
        "relative",
        "change of the density",
        "cane of reeds, about 450 to 600 kg/m³ (chosen; the paper takes 520)",
        signed=True,
    )

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Change the density, not the moduli."""
        return replace(
            reed, cane=replace(reed.cane, density=reed.cane.density * (1 + self.relative))
        )


@dataclass(frozen=True)
class TransverseModulus(Effect):
    """Young's modulus across the grain, E_T, is another."""

    id = "transverse_modulus"
    ln: float = size(0.02, 0.6, "ln", "change of E_T", _WOOD, signed=True)

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Change E_T."""
        return replace(reed, cane=replace(reed.cane, E_T=reed.cane.E_T * math.exp(self.ln)))


@dataclass(frozen=True)
class TransverseShear(Effect):
    """The shear moduli across the thickness, G_LR and G_TR, are others."""

    id = "transverse_shear"
    ln_LR: float = size(0.03, 0.7, "ln", "change of G_LR", _WOOD, signed=True)
    ln_TR: float = size(0.03, 0.7, "ln", "change of G_TR", _WOOD, signed=True)

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Change both."""
        cane = replace(
            reed.cane,
            G_LR=reed.cane.G_LR * math.exp(self.ln_LR),
            G_TR=reed.cane.G_TR * math.exp(self.ln_TR),
        )
        return replace(reed, cane=cane)


@dataclass(frozen=True)
class TemperatureDrift(Effect):
    """The air becomes warmer or colder all the time; the moduli follow."""

    id = "temperature_drift"
    k_per_hour: float = size(
        0.5,
        12.0,
        "K/h",
        "change of temperature",
        "heating switched on, sun, instruments in a closed box (chosen)",
        signed=True,
    )

    def climate(self, climate: Climate, time_s: float) -> Climate:
        """Add a temperature in proportion to time."""
        warmer = self.k_per_hour * time_s / 3600
        return replace(climate, temperature_c=climate.temperature_c + warmer)


@dataclass(frozen=True)
class Drying(Effect):
    """A moist reed dries during the campaign: moduli grow, mass and losses fall."""

    id = "drying"
    water: float = size(
        0.05,
        3.0,
        "% of the mass",
        "water above equilibrium at the start",
        "a played reed takes up tens of per cent, and a breath some tenths (chosen)",
    )
    minutes: float = place(4.0, 20.0, "min", "time in which it falls to 1/e")

    def climate(self, climate: Climate, time_s: float) -> Climate:
        """Add water that evaporates."""
        left = self.water * float(np.exp(-time_s / (60 * self.minutes)))
        return replace(climate, moisture=climate.moisture + left)
