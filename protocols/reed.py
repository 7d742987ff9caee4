"""Reed files: shape, clamp and cane of one reed."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from physics.errors import ImpossibleReedError
from physics.reed.cane.conditions import at_temperature, cane_at_dryness
from physics.reed.cane.material import Cane, stiffness_matrix_pa
from physics.reed.cane.viscoelastic import (
    Components,
    ViscoelasticCane,
    require_physical,
)
from physics.reed.elements.mesh import FAST, build_least_mesh
from physics.reed.geometry import (
    Clamp,
    ClampSide,
    Outline,
    ReedGeometry,
    ThicknessMap,
)
from physics.reed.modes import (
    at_frequency,
)
from physics.reed.reduction.metamodel import REFERENCE_HZ
from protocols.units import (
    Density,
    Length,
    Modulus,
    Temperature,
)
from protocols.yaml_files.strict_yaml import (
    Description,
    Section,
    shipped_files,
)

DEFAULT_REED = "clarinet"

_Lengths = Annotated[tuple[Length, ...], Field(strict=False)]
_Thicknesses = Annotated[tuple[Annotated[Length, Field(gt=0)], ...], Field(strict=False)]
_PoissonRatio = Annotated[float, Field(allow_inf_nan=False)]
_Component = Annotated[float, Field(ge=-6, le=6)]


class OutlineSection(Section):
    """The reed seen from above: an arc at the tip, rounded corners, straight sides."""

    tip_radius_m: Annotated[Length, Field(alias="tip_radius", gt=0)]
    """Radius of the arc at the tip, whose centre lies on the axis."""
    corner_radius_m: Annotated[Length, Field(alias="corner_radius", gt=0)]
    """Radius of the smaller arc that rounds each corner."""
    corner_centre_m: Annotated[Length, Field(alias="corner_centre", gt=0)]
    """Distance of the centre of the smaller arc from the tip."""
    half_width_at_tip_m: Annotated[Length, Field(alias="half_width_at_tip", gt=0)]
    """Distance of the side from the axis, where the line of the side meets the tip."""
    half_width_at_butt_m: Annotated[Length, Field(alias="half_width_at_butt", gt=0)]
    """Distance of the side from the axis at the butt."""
    length_m: Annotated[Length, Field(alias="length", gt=0)]
    """Length from tip to butt."""

    def outline(self) -> Outline:
        """Return the outline for `physics`."""
        return Outline(
            tip_radius_m=float(self.tip_radius_m),
            corner_radius_m=float(self.corner_radius_m),
            corner_x_m=float(self.corner_centre_m),
            side_half_width_m=float(self.half_width_at_tip_m),
            side_taper=float(
                (self.half_width_at_tip_m - self.half_width_at_butt_m) / self.length_m
            ),
            length_m=float(self.length_m),
        )


class Vamp(Section):
    """Thickness of the vamp along three lines parallel to the axis."""

    x_m: Annotated[tuple[Length, ...], Field(alias="x", strict=False, min_length=4)]
    """Distances from the tip, ascending."""
    y_m: Annotated[tuple[Length, Length, Length], Field(alias="y", strict=False)]
    """Distances of the three lines from the axis, ascending."""
    thickness_m: Annotated[
        tuple[_Thicknesses, _Thicknesses, _Thicknesses], Field(alias="thickness", strict=False)
    ]
    """Thicknesses: a row for each y, in it a value for each x."""

    @field_validator("thickness_m")
    @classmethod
    def _one_for_each_x(
        cls, rows: tuple[tuple[Fraction, ...], ...], info: ValidationInfo
    ) -> tuple[tuple[Fraction, ...], ...]:
        x_m = info.data.get("x_m")
        for number, row in enumerate(rows, 1):
            if x_m is not None and len(row) != len(x_m):
                raise ValueError(
                    f"row {number} has {len(row)} values for {len(x_m)} abscissae x; give one each"
                )
        return rows


class Heel(Section):
    """Bark side of the heel, a cylinder along the grain."""

    radius_m: Annotated[Length, Field(alias="radius", gt=0)]
    """Radius of the cylinder."""
    sagitta_m: Annotated[Length, Field(alias="sagitta")]
    """Distance of the axis of the cylinder below the flat side."""


class ClampSection(Section):
    """Two strips along the reed, mirror images of each other, on which nothing moves."""

    from_m: Annotated[Length, Field(alias="from", gt=0)]
    """Distance of the strips from the tip."""
    to_m: Annotated[Length, Field(alias="to", gt=0)]
    """Distance of the far end of the strips from the tip."""
    inner_m: Annotated[Length, Field(alias="inner", ge=0)]
    """Distance of the inner edge of each strip from the axis."""
    outer_m: Annotated[Length, Field(alias="outer", gt=0)]
    """Distance of the outer edge of each strip from the axis."""
    side: Literal["bark", "flat", "both"] = "bark"
    """Side of the reed that the strips are on."""

    def clamp(self) -> Clamp:
        """Return the clamp for `physics`."""
        along = float(self.from_m), float(self.to_m)
        return Clamp(along, (float(self.inner_m), float(self.outer_m)), ClampSide(self.side))


class ThicknessMapSection(Section):
    """Measured deviations of the thickness from the drawing, on both sides of the axis."""

    x_m: Annotated[_Lengths, Field(alias="x")]
    """Distances from the tip, ascending."""
    y_m: Annotated[_Lengths, Field(alias="y")]
    """Distances from the axis, ascending, with both signs."""
    deviation_m: Annotated[tuple[_Lengths, ...], Field(alias="deviation", strict=False)]
    """Deviations: a row for each x, in it a value for each y."""

    @field_validator("y_m")
    @classmethod
    def _on_either_side(cls, y_m: tuple[Fraction, ...]) -> tuple[Fraction, ...]:
        # Values of one side alone could be meant for that side or for both.
        if y_m and not min(y_m) < 0 < max(y_m):
            raise ValueError(
                "lies on one side of the axis only; give values of either sign, and for an even "
                "reed the same deviations at y and -y"
            )
        return y_m

    def thickness_map(self) -> ThicknessMap:
        """Return the thickness map for `physics`."""
        rows = tuple(_floats(row) for row in self.deviation_m)
        return ThicknessMap(_floats(self.x_m), _floats(self.y_m), rows)


class GeometrySection(Section):
    """Shape and clamp of a reed."""

    outline: OutlineSection
    """The reed seen from above."""
    vamp: Vamp
    """Thickness of the vamp."""
    heel: Heel
    """Bark side of the heel. Where vamp and heel meet, the heel takes over."""
    clamp: ClampSection
    """Where the reed is held."""
    thickness_offset_m: Annotated[Length, Field(alias="thickness_offset")] = Fraction(0)
    """Thickness added to the whole vamp; it may be negative."""
    thickness_map: ThicknessMapSection | None = None
    """Measured deviations of the thickness from the drawing."""

    def geometry(self) -> ReedGeometry:
        """Return shape and clamp for `physics`."""
        measured = self.thickness_map
        axis, middle, side = self.vamp.y_m
        return ReedGeometry(
            outline=self.outline.outline(),
            vamp_x_m=_floats(self.vamp.x_m),
            vamp_y_m=(float(axis), float(middle), float(side)),
            # Rounded as `ReedGeometry` rounds the millimetres of Table 8, to the last bit: reeds
            # that are equal share what is computed of them.
            vamp_z_m=tuple(
                tuple(1e-3 * float(1000 * value) for value in row) for row in self.vamp.thickness_m
            ),
            heel_radius_m=float(self.heel.radius_m),
            heel_sagitta_m=float(self.heel.sagitta_m),
            clamp=self.clamp.clamp(),
            thickness_offset_m=float(self.thickness_offset_m),
            thickness_map=measured.thickness_map() if measured else None,
        )


class ViscoelasticSection(Section):
    """Components e1 … e4 of viscoelastic cane, in standard deviations of the paper's population."""

    e1: _Component = 0.0
    """Component e1."""
    e2: _Component = 0.0
    """Component e2."""
    e3: _Component = 0.0
    """Component e3."""
    e4: _Component = 0.0
    """Component e4."""


class CaneSection(Section):
    """Elastic constants and density. L is along the grain, T across it, R through the thickness."""

    E_L_pa: Annotated[Modulus | None, Field(alias="E_L", gt=0)] = None
    """Young's modulus along the grain. Leave it out with `viscoelastic`."""
    E_T_pa: Annotated[Modulus, Field(alias="E_T", gt=0)]
    """Young's modulus across the grain."""
    E_R_pa: Annotated[Modulus, Field(alias="E_R", gt=0)]
    """Young's modulus through the thickness."""
    G_LT_pa: Annotated[Modulus | None, Field(alias="G_LT", gt=0)] = None
    """Shear modulus in the plane of the reed. Leave it out with `viscoelastic`."""
    G_LR_pa: Annotated[Modulus, Field(alias="G_LR", gt=0)]
    """Shear modulus of the plane L-R."""
    G_TR_pa: Annotated[Modulus, Field(alias="G_TR", gt=0)]
    """Shear modulus of the plane T-R."""
    nu_LT: _PoissonRatio
    """Poisson ratio: contraction along T under stress along L."""
    nu_LR: _PoissonRatio
    """Poisson ratio: contraction along R under stress along L."""
    nu_TR: _PoissonRatio
    """Poisson ratio: contraction along R under stress along T."""
    density_kg_m3: Annotated[Density, Field(alias="density", gt=0, le=20_000)]
    """Density."""
    viscoelastic: ViscoelasticSection | None = None
    """E_L and G_LT that depend on frequency, in place of fixed ones."""


class Conditions(Section):
    """Conditions of viscoelastic cane."""

    temperature_c: Annotated[Temperature | None, Field(alias="temperature", ge=-20, le=100)] = None
    """Temperature. Without this key, that of the paper's measurements."""
    dryness: Annotated[float | None, Field(ge=0, le=1)] = None
    """From 0 (ambient, series A) to 1 (dried, series B). Without this key, 0."""


class ReedFile(Description):
    """One reed: shape, clamp and cane."""

    kind: ClassVar[str] = "reed"
    folder: ClassVar[str] = "reeds"

    name: Annotated[str, Field(min_length=1, max_length=80)]
    """Title in tables and reports."""
    shape: Annotated[GeometrySection, Field(alias="geometry")]
    """Shape and clamp."""
    material: Annotated[CaneSection, Field(alias="cane")]
    """Elastic constants and density."""
    conditions: Conditions = Conditions()
    """Temperature and dryness, for viscoelastic cane only."""

    @classmethod
    def from_file(cls, name_or_path: str | Path = DEFAULT_REED) -> Self:
        """Read a reed's file; without a name, the clarinet's. See `Description.from_file`."""
        return super().from_file(name_or_path)

    @model_validator(mode="after")
    def _require_possible(self) -> Self:
        _require_cane(self)
        geometry = self.geometry()
        try:
            build_least_mesh(geometry, FAST)
        except ImpossibleReedError as error:
            raise self.error(_key_at_fault(geometry), str(error)) from None
        return self

    def geometry(self) -> ReedGeometry:
        """Return shape and clamp for `physics`."""
        return self.shape.geometry()

    def cane(self, frequency_hz: float = REFERENCE_HZ) -> Cane:
        """Return the elastic constants, for viscoelastic cane the storage moduli at a frequency."""
        written = {field.name: getattr(self.material, field.name) for field in fields(Cane)}
        constants = Cane(**{key: float(v) for key, v in written.items() if v is not None})
        viscoelastic = self.viscoelastic()
        if viscoelastic is None:
            return constants
        return at_frequency(constants, viscoelastic, frequency_hz)

    def constants(self) -> Cane:
        """Return elastic constants and density, with E_L and G_LT of the reference material."""
        reference = Cane()
        return replace(self.cane(), E_L_pa=reference.E_L_pa, G_LT_pa=reference.G_LT_pa)

    def viscoelastic(self) -> ViscoelasticCane | None:
        """Return the Zener moduli under the conditions of the reed; None for fixed moduli."""
        section = self.material.viscoelastic
        if section is None:
            return None
        components = Components(section.e1, section.e2, section.e3, section.e4)
        cane = cane_at_dryness(components, self.conditions.dryness or 0.0)
        temperature_c = self.conditions.temperature_c
        return cane if temperature_c is None else at_temperature(cane, float(temperature_c))


def _floats(values: Sequence[Fraction]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _require_cane(reed: ReedFile) -> None:
    """Refuse cane whose moduli are missing, given twice or physically impossible.

    Raises
    ------
    ProtocolError
    """
    if reed.material.viscoelastic is None:
        _require_fixed_moduli(reed)
    else:
        _require_following_moduli(reed)
    cane = reed.cane()
    try:
        stiffness_matrix_pa(cane)
    except ImpossibleReedError:
        raise reed.error(
            "cane",
            f"with nu_LT {cane.nu_LT:g}, nu_LR {cane.nu_LR:g} and nu_TR {cane.nu_TR:g} the "
            "stiffness is not positive definite; bring these Poisson ratios nearer to 0",
        ) from None


def _require_fixed_moduli(reed: ReedFile) -> None:
    for name in ("E_L", "G_LT"):
        if getattr(reed.material, f"{name}_pa") is None:
            message = "is missing; add it, or give cane.viscoelastic for both E_L and G_LT"
            raise reed.error(f"cane.{name}", message)
    if reed.conditions != Conditions():
        raise reed.error(
            "conditions",
            "temperature and dryness apply to viscoelastic cane only, and the moduli of this one "
            "are fixed; leave them out, or write the cane as alto-saxophone.yaml does",
        )


def _require_following_moduli(reed: ReedFile) -> None:
    for name in ("E_L", "G_LT"):
        if getattr(reed.material, f"{name}_pa") is not None:
            raise reed.error(
                f"cane.{name}",
                "is fixed, but cane.viscoelastic makes it follow frequency; fix both E_L and G_LT "
                "and leave out cane.viscoelastic, or fix neither",
            )
    viscoelastic = reed.viscoelastic()
    try:
        if viscoelastic is not None:
            require_physical(viscoelastic)
    except ImpossibleReedError as error:
        raise reed.error("cane.viscoelastic", f"{error}; bring e1 … e4 nearer to 0") from None


def _key_at_fault(geometry: ReedGeometry) -> str:
    """Return the key of the part that makes the geometry impossible, or that of all of it."""
    outline = geometry.outline
    length_m = outline.length_m
    width_m = outline.side_half_width_m - outline.side_taper * length_m
    narrow = Clamp((0.6 * length_m, 0.9 * length_m), (0.2 * width_m, 0.3 * width_m))
    without = {
        "thickness_map": replace(geometry, thickness_map=None),
        "thickness_offset": replace(geometry, thickness_offset_m=0.0),
        "clamp": replace(geometry, clamp=narrow),
    }
    for key, rest in without.items():
        with suppress(ImpossibleReedError):
            build_least_mesh(rest, FAST)
            return f"geometry.{key}"
    return "geometry"


def shipped_reeds() -> tuple[str, ...]:
    """Names of the reeds that come with the software, sorted."""
    return tuple(sorted(shipped_files(ReedFile.folder)))
