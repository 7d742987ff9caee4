"""Thickness of the vamp, and a drop on its tip."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from studies.second_laboratory.campaigns.effects.base import Array, Effect, place, size
from studies.second_laboratory.parameters import Patch, ReedParameters

# Grid of `Thickness.map_um`, and the half width and the length of the vamp that sizes refer to, mm.
_X, _Y = np.linspace(0.0, 36.0, 37), np.linspace(-7.0, 7.0, 29)
_HALF_MM, _VAMP_MM = 6.5, 34.0
_CUT = "cutting machines ±10 µm; hand-finished and worn reeds up to ±50 µm (chosen)"


def _thicker(reed: ReedParameters, by: Callable[[Array, Array], Array]) -> ReedParameters:
    """Return a reed that is thicker by a function of x and y, in µm."""
    more = by(_X[:, None], _Y[None, :]) * np.ones((len(_X), len(_Y)))
    if not more.any():
        return reed
    old = reed.thickness.map_um
    rows = more if old is None else np.array(old) + more
    thickness = replace(reed.thickness, map_um=tuple(map(tuple, rows.tolist())))
    return replace(reed, thickness=thickness)


@dataclass(frozen=True)
class ThicknessOffset(Effect):
    """The vamp is thicker or thinner everywhere."""

    id = "thickness_offset"
    um: float = size(1.0, 50.0, "µm", "change of the thickness", _CUT, signed=True)

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Change the offset, and with it where vamp and heel meet."""
        offset = reed.thickness.offset_um + self.um
        return replace(reed, thickness=replace(reed.thickness, offset_um=offset))


@dataclass(frozen=True)
class ThicknessWedge(Effect):
    """The vamp is thicker towards the heel, in proportion to the distance from the tip."""

    id = "thickness_wedge"
    um: float = size(2.0, 80.0, "µm", "what is added at the heel", _CUT)

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add a wedge."""
        return _thicker(reed, lambda x, y: self.um * x / _VAMP_MM)


@dataclass(frozen=True)
class ThicknessCrown(Effect):
    """The vamp is thicker at its sides than in its middle."""

    id = "thickness_crown"
    um: float = size(2.0, 50.0, "µm", "what is added 6.5 mm from the middle", _CUT)

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add a parabola across the reed."""
        return _thicker(reed, lambda x, y: self.um * (y / _HALF_MM) ** 2)


@dataclass(frozen=True)
class ThicknessTilt(Effect):
    """The vamp is thicker on its left side, y > 0, and thinner on its right side."""

    id = "thickness_tilt"
    um: float = size(1.5, 40.0, "µm", "what is added 6.5 mm to the left", _CUT)

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add a slope across the reed."""
        slope = reed.thickness.slope_um_per_mm + self.um / _HALF_MM
        return replace(reed, thickness=replace(reed.thickness, slope_um_per_mm=slope))


@dataclass(frozen=True)
class TipMass(Effect):
    """A drop or a speck sits on the tip."""

    id = "tip_mass"
    ug: float = size(5.0, 1000.0, "µg", "its mass", "a drop of 1 µl weighs 1 mg (chosen)")
    x_mm: float = place(0.4, 2.0, "mm", "its distance from the tip")
    y_mm: float = place(-5.0, 5.0, "mm", "its place across the reed")

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add a mass at a spot."""
        if not self.ug:
            return reed
        drop = Patch(self.x_mm, self.y_mm, 0.5, mass_t=1e-12 * self.ug)
        flaws = replace(reed.flaws, patches=(*reed.flaws.patches, drop))
        return replace(reed, flaws=flaws)
