"""Cane: nine constants with losses, two of which follow frequency as the paper's hypothesis H4."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

# Hypothesis H4 of the paper, MPa and MPa·s (section on H4, and `h4` of tables.yaml).
_C10, _C20, _C30 = 1.011, -2.197, 0.8294
_D10, _D12, _D20, _D30, _D41, _D60 = 10300.0, 640.5, 7309.0, 0.2822, 115.7, 0.02038
DENSITY = 520.0
"""Density of the paper's reference material, kg/m³, which fits of the paper's kind assume."""
# The paper's temperature in series A ("about 20 °C").
_ROOM_C = 20.0
PIVOT_HZ = 4000.0
"""Where the paper compares moduli of reeds, and where exponents of frequency change nothing."""
# Relative change per 1 % of water, of E_L, of the other moduli and of loss factors: from 12 % to
# 6 % of water E along the grain grows by 9 %, E across it and G by 20 % (Gerhards 1982, Wood Fiber
# 14:4); tan δ of wood grows by some 5 % (Obataya et al. 1998, Polymer 39).
_PER_CENT_OF_WATER = (0.015, 0.033, 0.05)


@dataclass(frozen=True)
class Zener:
    """Storage modulus of a Zener solid, equation (4) of the paper, in MPa and MPa·s."""

    relaxed: float
    arm: float
    dashpot: float

    def __call__(self, omega: Any) -> Any:
        """Return the storage modulus, continued to complex ω; a number or an array."""
        return self.relaxed + self.arm - self.arm**3 / (self.arm**2 + (omega * self.dashpot) ** 2)


@dataclass(frozen=True)
class Cane:
    """Cane of one reed.

    Attributes
    ----------
    components : tuple of float
        e1 … e4 of H4, in standard deviations of the paper's population.
    dryness : float
        0 in series A, 1 in series B; between them the components change in proportion.
    E_T, E_R, G_LR, G_TR : float
        MPa.
    nu_LT, nu_LR, nu_TR : float
    density : float
        kg/m³.
    loss_E, loss_G : float
        Loss factors of the three Young's moduli, and of the three shear moduli.
    temperature_c, per_kelvin : float
        Temperature of the sweep, and relative change of all moduli per kelvin.
    growth_E, growth_G : float
        Exponents of frequency by which E_L and G_LT grow beyond H4, from `PIVOT_HZ`.
    growth_loss : float
        Exponent of frequency by which all loss factors grow, from `PIVOT_HZ`.
    moisture : float
        Water above that of the air's humidity, in per cent of the mass.
    """

    components: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    dryness: float = 0.0
    # Reference material of the paper.
    E_T: float = 480.0
    E_R: float = 480.0
    G_LR: float = 1200.0
    G_TR: float = 1200.0
    nu_LT: float = 0.22
    nu_LR: float = 0.22
    nu_TR: float = 0.22
    density: float = DENSITY
    loss_E: float = 0.02
    loss_G: float = 0.03
    temperature_c: float = _ROOM_C
    per_kelvin: float = 0.0
    growth_E: float = 0.0
    growth_G: float = 0.0
    growth_loss: float = 0.0
    moisture: float = 0.0
    fixed: tuple[float, float] | None = None
    """E_L and G_LT in MPa that do not follow frequency, for comparisons with the paper's FEM."""

    def zener(self) -> tuple[Zener, Zener]:
        """Return E_L and G_LT at the paper's temperature."""
        if self.fixed is not None:
            return Zener(self.fixed[0], 0.0, 1.0), Zener(self.fixed[1], 0.0, 1.0)
        e1, e2, e3, e4 = self.components
        dry = self.dryness
        e1 = e1 + dry * _C10
        e2 = (1 - dry) * e2 + dry * (_C20 + 0.5 * (e2 + e4))
        e3 = e3 + dry * _C30
        return (
            Zener(_D10 + _D12 * (e2 + e3), _D20 + _D12 * (2 * e2 - e3), _D30),
            Zener(_D41 * (6 + e1), 2 * _D41 * (3 + e1 - e3), _D60),
        )

    def storage(self, omega: Any) -> tuple[Any, Any]:
        """Return E_L and G_LT in MPa at ω in rad/s, at the cane's temperature and moisture."""
        young, shear = self.zener()
        warm, (along, across, _) = self.warmth(), self._wet()
        high = omega / (2 * np.pi * PIVOT_HZ)
        return (
            young(omega) * high**self.growth_E * (warm * along),
            shear(omega) * high**self.growth_G * (warm * across),
        )

    def elasticity(self, omega: complex, lossy: bool = True) -> NDArray[np.complex128]:
        """Return the complex matrix of elasticity (6, 6) in MPa at ω in rad/s."""
        E_L, G_LT = (complex(modulus) for modulus in self.storage(omega))
        _, across, loss = self._wet()
        others = self.warmth() * across
        lost = lossy * loss * (omega / (2 * np.pi * PIVOT_HZ)) ** self.growth_loss
        stretch, twist = 1 + 1j * self.loss_E * lost, 1 + 1j * self.loss_G * lost
        compliance = np.diag([1 / E_L, 1 / (others * self.E_T), 1 / (others * self.E_R)])
        compliance = compliance.astype(complex)
        compliance[0, 1] = compliance[1, 0] = -self.nu_LT / E_L
        compliance[0, 2] = compliance[2, 0] = -self.nu_LR / E_L
        compliance[1, 2] = compliance[2, 1] = -self.nu_TR / (others * self.E_T)
        matrix = np.zeros((6, 6), complex)
        matrix[:3, :3] = np.linalg.inv(compliance) * stretch
        shear = np.array([others * self.G_TR, others * self.G_LR, G_LT])
        matrix[range(3, 6), range(3, 6)] = shear * twist
        return matrix

    def _wet(self) -> tuple[float, float, float]:
        """Return by what factors moisture changes E_L, all other moduli, and loss factors."""
        along, across, loss = _PER_CENT_OF_WATER
        return 1 - along * self.moisture, 1 - across * self.moisture, 1 + loss * self.moisture

    def mass(self) -> float:
        """Return by what factor moisture changes the mass."""
        return 1 + 0.01 * self.moisture

    def warmth(self) -> float:
        """Return by what factor temperature changes all moduli."""
        return 1 + self.per_kelvin * (self.temperature_c - _ROOM_C)

    def components_over_density(self) -> dict[str, float]:
        """Return e1 … e3 of cane of the paper's density that sounds most like this cane.

        Frequencies know moduli over density only. With another density and temperature the moduli
        leave H4's family by a little; e1 … e3 that fit ln E' and ln G' best from F1 to F4 are what
        a fit that assumes the paper's density should find. e4 keeps its value.
        """
        omega = 2 * np.pi * np.geomspace(1900.0, 16_800.0, 30)
        scale = self.warmth() * DENSITY / self.density
        target = [np.log(scale * modulus(omega).real) for modulus in self.zener()]

        def misfit(e: NDArray[np.float64]) -> NDArray[np.float64]:
            tried = replace(
                self, components=(float(e[0]), float(e[1]), float(e[2]), self.components[3])
            )
            moduli = [np.log(modulus(omega).real) for modulus in tried.zener()]
            return np.asarray(np.concatenate(moduli) - np.concatenate(target))

        best = least_squares(misfit, self.components[:3]).x
        return {f"e{k + 1}": float(value) for k, value in enumerate(best)}
