"""What a reed is: shape, clamp and cane of one reed, read as strictly as protocols."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from physics.reed.cache import (
    FAST,
)
from physics.reed.conditions import at_temperature, cane_at_dryness
from physics.reed.geometry import (
    Clamp,
    ClampSide,
    Outline,
    ReedGeometry,
    ThicknessMap,
)
from physics.reed.material import Cane, stiffness_matrix_pa
from physics.reed.mesh import build_least_mesh
from physics.reed.metamodel import REFERENCE_HZ
from physics.reed.modes import (
    at_frequency,
)
from physics.reed.viscoelastic import (
    Components,
    ViscoelasticCane,
    require_physical,
)
from protocols.strict_yaml import (
    Description,
    Section,
    shipped_files,
)
from protocols.units import (
    Density,
    Length,
    Modulus,
    Temperature,
)

DEFAULT_REED = "clarinet"

_Lengths = Annotated[tuple[Length, ...], Field(strict=False)]
_Thicknesses = Annotated[tuple[Annotated[Length, Field(gt=0)], ...], Field(strict=False)]
_PoissonRatio = Annotated[float, Field(allow_inf_nan=False)]
_Component = Annotated[float, Field(ge=-6, le=6)]


class OutlineSection(Section):
    """The reed seen from above; the widths are those of the side's line at tip and butt."""

    tip_radius_m: Annotated[Length, Field(alias="tip_radius", gt=0)]
    corner_radius_m: Annotated[Length, Field(alias="corner_radius", gt=0)]
    corner_centre_m: Annotated[Length, Field(alias="corner_centre", gt=0)]
    half_width_at_tip_m: Annotated[Length, Field(alias="half_width_at_tip", gt=0)]
    half_width_at_butt_m: Annotated[Length, Field(alias="half_width_at_butt", gt=0)]
    length_m: Annotated[Length, Field(alias="length", gt=0)]

    def outline(self) -> Outline:
        """Outline as physics knows it."""
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
    """Thicknesses on lines at three distances y from the axis, at the abscissae x on each."""

    x_m: Annotated[tuple[Length, ...], Field(alias="x", strict=False, min_length=4)]
    y_m: Annotated[tuple[Length, Length, Length], Field(alias="y", strict=False)]
    thickness_m: Annotated[
        tuple[_Thicknesses, _Thicknesses, _Thicknesses], Field(alias="thickness", strict=False)
    ]

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
    """A cylinder whose axis lies `sagitta` below the flat side."""

    radius_m: Annotated[Length, Field(alias="radius", gt=0)]
    sagitta_m: Annotated[Length, Field(alias="sagitta")]


class ClampSection(Section):
    """Two strips along the reed, mirror images in its median plane, on which nothing moves."""

    from_m: Annotated[Length, Field(alias="from", gt=0)]
    to_m: Annotated[Length, Field(alias="to", gt=0)]
    inner_m: Annotated[Length, Field(alias="inner", ge=0)]
    outer_m: Annotated[Length, Field(alias="outer", gt=0)]
    side: Literal["bark", "flat", "both"] = "bark"

    def clamp(self) -> Clamp:
        """Clamp as physics knows it."""
        along = float(self.from_m), float(self.to_m)
        return Clamp(along, (float(self.inner_m), float(self.outer_m)), ClampSide(self.side))


class ThicknessMapSection(Section):
    """Measured deviations from the drawing: a row for each x, in it a value for each y.

    Even in y or not; each side of the axis has values of its own.
    """

    x_m: Annotated[_Lengths, Field(alias="x")]
    y_m: Annotated[_Lengths, Field(alias="y")]
    deviation_m: Annotated[tuple[_Lengths, ...], Field(alias="deviation", strict=False)]

    @field_validator("y_m")
    @classmethod
    def _on_either_side(cls, y_m: tuple[Fraction, ...]) -> tuple[Fraction, ...]:
        # What was measured on one side might be meant for both, or for one.
        if y_m and not min(y_m) < 0 < max(y_m):
            raise ValueError(
                "lies on one side of the axis only; give values of either sign, and for an even "
                "reed the same deviations at y and -y"
            )
        return y_m

    def thickness_map(self) -> ThicknessMap:
        """Map as physics knows it."""
        rows = tuple(_floats(row) for row in self.deviation_m)
        return ThicknessMap(_floats(self.x_m), _floats(self.y_m), rows)


class GeometrySection(Section):
    """Shape and clamp of a reed."""

    outline: OutlineSection
    vamp: Vamp
    heel: Heel
    clamp: ClampSection
    thickness_offset_m: Annotated[Length, Field(alias="thickness_offset")] = Fraction(0)
    thickness_map: ThicknessMapSection | None = None

    def geometry(self) -> ReedGeometry:
        """Geometry as physics knows it."""
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
    """E_L and G_LT that follow frequency: components of hypothesis H4, in population SD."""

    e1: _Component = 0.0
    e2: _Component = 0.0
    e3: _Component = 0.0
    e4: _Component = 0.0


class CaneSection(Section):
    """Elastic constants and density; E_L and G_LT are fixed, or `viscoelastic` gives them."""

    E_L_pa: Annotated[Modulus | None, Field(alias="E_L", gt=0)] = None
    E_T_pa: Annotated[Modulus, Field(alias="E_T", gt=0)]
    E_R_pa: Annotated[Modulus, Field(alias="E_R", gt=0)]
    G_LT_pa: Annotated[Modulus | None, Field(alias="G_LT", gt=0)] = None
    G_LR_pa: Annotated[Modulus, Field(alias="G_LR", gt=0)]
    G_TR_pa: Annotated[Modulus, Field(alias="G_TR", gt=0)]
    nu_LT: _PoissonRatio
    nu_LR: _PoissonRatio
    nu_TR: _PoissonRatio
    density_kg_m3: Annotated[Density, Field(alias="density", gt=0, le=20_000)]
    viscoelastic: ViscoelasticSection | None = None


class Conditions(Section):
    """Temperature, and dryness from 0 (series A, ambient) to 1 (series B, dried)."""

    temperature_c: Annotated[Temperature | None, Field(alias="temperature", ge=-20, le=100)] = None
    dryness: Annotated[float | None, Field(ge=0, le=1)] = None


class ReedFile(Description):
    """One reed: shape, clamp and cane.

    Attributes
    ----------
    name : str
        For people.
    shape : GeometrySection
        Key ``geometry`` of the file.
    material : CaneSection
        Key ``cane`` of the file.
    conditions : Conditions
        Of a viscoelastic cane only.
    """

    kind: ClassVar[str] = "reed"
    folder: ClassVar[str] = "reeds"

    name: Annotated[str, Field(min_length=1, max_length=80)]
    shape: Annotated[GeometrySection, Field(alias="geometry")]
    material: Annotated[CaneSection, Field(alias="cane")]
    conditions: Conditions = Conditions()

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
        except ValueError as error:
            raise self.error(_key_at_fault(geometry), str(error)) from None
        return self

    def geometry(self) -> ReedGeometry:
        """Shape and clamp as physics knows them."""
        return self.shape.geometry()

    def cane(self, frequency_hz: float = REFERENCE_HZ) -> Cane:
        """Elastic constants; those of viscoelastic cane have the storage moduli of a frequency."""
        written = {field.name: getattr(self.material, field.name) for field in fields(Cane)}
        constants = Cane(**{key: float(v) for key, v in written.items() if v is not None})
        viscoelastic = self.viscoelastic()
        if viscoelastic is None:
            return constants
        return at_frequency(constants, viscoelastic, frequency_hz)

    def constants(self) -> Cane:
        """Elastic constants and density without E_L and G_LT, which are the reference's."""
        reference = Cane()
        return replace(self.cane(), E_L_pa=reference.E_L_pa, G_LT_pa=reference.G_LT_pa)

    def viscoelastic(self) -> ViscoelasticCane | None:
        """Zener moduli under the reed's conditions; None if its moduli are fixed."""
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
    """Refuse cane whose moduli are not said, or said twice, or make no material.

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
    except ValueError:
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
            "temperature and dryness mean something for viscoelastic cane only, and the moduli of "
            "this one are fixed; leave them out, or write the cane as alto-saxophone.yaml does",
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
    except ValueError as error:
        raise reed.error("cane.viscoelastic", f"{error}; bring e1 … e4 nearer to 0") from None


def _key_at_fault(geometry: ReedGeometry) -> str:
    """Key of the part without which the rest makes a reed; of all of it if there is none."""
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
        with suppress(ValueError):
            build_least_mesh(rest, FAST)
            return f"geometry.{key}"
    return "geometry"


def shipped_reeds() -> tuple[str, ...]:
    """Names of the reeds that come with the software, sorted."""
    return tuple(sorted(shipped_files(ReedFile.folder)))
