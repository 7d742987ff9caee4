"""Every effect that is known, in the order of the chain from the drive to the number."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from physics.effects import (
    air_load,
    clamp_tilt,
    clamp_yield,
    coarse_mesh,
    damping_growth,
    density,
    stiffening,
    thickness_crown,
    thickness_offset,
    thickness_tilt,
    thickness_wedge,
    tip_mass,
    transverse_modulus,
    transverse_shear,
)
from physics.effects.form import Effect

CATALOGUE: Final[tuple[Effect, ...]] = (
    stiffening.EFFECT,
    damping_growth.EFFECT,
    density.EFFECT,
    transverse_modulus.EFFECT,
    transverse_shear.EFFECT,
    thickness_offset.EFFECT,
    thickness_wedge.EFFECT,
    thickness_crown.EFFECT,
    thickness_tilt.EFFECT,
    tip_mass.EFFECT,
    clamp_yield.EFFECT,
    clamp_tilt.EFFECT,
    air_load.EFFECT,
    coarse_mesh.EFFECT,
)
BY_ID: Final[Mapping[str, Effect]] = MappingProxyType({effect.id: effect for effect in CATALOGUE})
