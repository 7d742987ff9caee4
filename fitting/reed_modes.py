"""Modes of the reed that a reed file describes, by finite elements or from a basis."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np

from physics.errors import ImpossibleReedError
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import (
    is_even,
)
from physics.reed.material_range.basis import MaterialBasis, ReedModes, modes
from physics.reed.material_range.cache import material_basis
from physics.reed.material_range.constants import constants_of
from physics.reed.material_range.snapshots import TrainingSettings, heaviest_kg_m3
from physics.reed.material_range.viscoelastic import settled_modes
from physics.reed.modes import (
    HIGHEST_HZ,
    NamedMode,
    reed_modes,
    viscoelastic_modes,
)
from physics.reed.reduction.cache import (
    FAST,
    FINE,
    STANDARD,
)
from physics.reed.reduction.metamodel import REFERENCE_HZ
from protocols.errors import ProtocolError
from protocols.reed import ReedFile

# How finely a reed is computed, by the name of the level.
MESHES: Final = {"fine": FINE, "standard": STANDARD, "fast": FAST}

# In place of a level: not computed but read off a basis over materials, built once for a reed.
BASIS: Final = "basis"

# A name that bears out less than this fraction of a motion is in doubt.
_CLEAR: Final = 0.5


def changed(reed: ReedFile, changes: Mapping[str, Any]) -> ReedFile:
    """Reed with some settings changed; E_L and G_LT fixed together end viscoelasticity.

    Parameters
    ----------
    reed : ReedFile
    changes : mapping
        As for `Description.replace`; what is None stays as it is.

    Raises
    ------
    ProtocolError
        As `Description.replace`.
    """
    wanted = {key: value for key, value in changes.items() if value is not None}
    if not wanted:
        return reed
    if {"cane.E_L", "cane.G_LT"} <= set(wanted):
        wanted = {"cane.viscoelastic": None, "conditions": {}} | wanted
    return reed.replace(wanted)


def mesh_level(name: str) -> MeshLevel:
    """Mesh of a name in `MESHES`.

    Raises
    ------
    ProtocolError
        If there is none of that name.
    """
    if name not in MESHES:
        known = ", ".join((*MESHES, BASIS))
        raise ProtocolError(f"there is no mesh {name!r}; known are {known}")
    return MESHES[name]


def modes_of(reed: ReedFile, level: MeshLevel) -> list[NamedMode]:
    """Every mode below 20 kHz, ascending; of viscoelastic cane, with the moduli of its frequency.

    Raises
    ------
    ProtocolError
        If only this mesh finds the reed impossible, or cane so soft that modes are without number.
    """
    geometry, viscoelastic = reed.geometry(), reed.viscoelastic()
    try:
        if viscoelastic is None:
            return reed_modes(geometry, reed.cane(), level)
        return viscoelastic_modes(geometry, reed.cane(), viscoelastic, level)
    except ImpossibleReedError as error:
        raise ProtocolError(f"{reed.source}: {error}") from None


def modes_by_basis(
    reed: ReedFile,
    reference: ReedFile,
    announce: Callable[[str], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[NamedMode]:
    """Modes below 20 kHz off a basis over materials at the level "standard", ascending.

    They are those that the reference's cane has below 20 kHz: of softer or heavier cane the
    highest are missing. Names are followed by shape from there.

    Parameters
    ----------
    reed : ReedFile
    reference : ReedFile
        The reed before its settings were changed. The basis is of its cane, and of the shape
        without thickness offset, so that one serves whatever cane and offset are asked for.
    announce, progress : callable, optional
        As for `material_basis`.

    Returns
    -------
    list of NamedMode
        `shape` has no nodes; `similarity` is that to the reference's mode of the name.

    Raises
    ------
    ProtocolError
        If the basis does not answer for the reed or the reference.
    """
    settings = TrainingSettings(cane=reference.cane())
    for described in (reference, reed):
        _require_in_box(described, settings)
    geometry = reed.geometry()
    if not is_even(geometry):
        raise reed.error(
            "geometry.thickness_map", "is not even in y, and a basis is; use --mesh fine"
        )
    try:
        drawn = replace(geometry, thickness_offset_m=0.0)
        basis = material_basis(drawn, STANDARD, settings, announce, progress)
        found = _modes_off(basis, reed)
    except ImpossibleReedError as error:
        raise ProtocolError(f"{reed.source}: {error}") from None
    answer = _named_modes(basis, found)
    if reed.viscoelastic() is not None:
        for mode in answer:
            _require_in_box(reed, settings, mode.frequency_hz)
    return answer


def _modes_off(basis: MaterialBasis, reed: ReedFile) -> ReedModes:
    cane, viscoelastic = reed.cane(), reed.viscoelastic()
    offset_m = float(reed.shape.thickness_offset_m)
    if viscoelastic is not None:
        return settled_modes(basis, cane, viscoelastic, offset_m)
    return modes(basis, constants_of([cane]), cane.density_kg_m3, offset_m, slopes=False)


def _named_modes(basis: MaterialBasis, found: ReedModes) -> list[NamedMode]:
    symmetries = {name: symmetry for symmetry, half in basis.halves.items() for name in half.names}
    named = [
        NamedMode(name, hz, klass, symmetries[name], similarity, np.empty((0, 3)))
        for name, klass, hz, similarity in zip(
            basis.names,
            basis.classes,
            found.hz[0].tolist(),
            found.similarity[0].tolist(),
            strict=True,
        )
        if hz <= HIGHEST_HZ
    ]
    return sorted(named, key=lambda mode: mode.frequency_hz)


def _require_in_box(reed: ReedFile, settings: TrainingSettings, hz: float = REFERENCE_HZ) -> None:
    """Refuse what a basis does not answer for; viscoelastic cane has the moduli of a frequency.

    Raises
    ------
    ProtocolError
    """
    inputs = asdict(reed.cane(hz)) | {"thickness_offset_m": float(reed.shape.thickness_offset_m)}
    ranges = asdict(settings.box) | {"density_kg_m3": (0.0, heaviest_kg_m3(settings))}
    for name, (low, high) in ranges.items():
        value, slack = inputs[name], 1e-9 * (high - low)
        if low - slack <= value <= high + slack:
            continue
        key, factor, unit = _key_and_unit(name)
        shown = f"{factor * value:g}{unit}"
        if reed.viscoelastic() is not None and key in ("cane.E_L", "cane.G_LT"):
            shown = f"{key.removeprefix('cane.')} of {shown} at {hz:.0f} Hz"
            key = "cane.viscoelastic"
        raise reed.error(
            key,
            f"{shown} lies outside the basis, which answers for {factor * low:g} to "
            f"{factor * high:g}{unit}; use --mesh fine",
        )


def _key_and_unit(name: str) -> tuple[str, float, str]:
    """Key of an input of a basis in a reed's file, and the unit that people read it in."""
    if name == "thickness_offset_m":
        return "geometry.thickness_offset", 1e6, " µm"
    if name == "density_kg_m3":
        return "cane.density", 1.0, " kg/m^3"
    if name.endswith("_pa"):
        return f"cane.{name.removesuffix('_pa')}", 1e-6, " MPa"
    return f"cane.{name}", 1.0, ""


def doubts_marked(modes: Sequence[NamedMode]) -> list[NamedMode]:
    """The same modes with "?" after names that bear out less than half of the motion."""
    return [
        mode if mode.similarity >= _CLEAR else replace(mode, name=f"{mode.name}?") for mode in modes
    ]


def modes_to_json(reed: ReedFile, modes: Sequence[NamedMode]) -> dict[str, Any]:
    """What `acquire modes --json` prints."""
    material: dict[str, Any] = asdict(reed.cane())
    viscoelastic = reed.viscoelastic()
    if viscoelastic is not None:
        material |= {"E_L_pa": None, "G_LT_pa": None}
    material["viscoelastic"] = viscoelastic and asdict(viscoelastic)
    return {
        "reed": reed.name,
        "material": material,
        "modes": [
            {
                "name": mode.name,
                "hz": mode.frequency_hz,
                "class": str(mode.klass),
                "symmetry": str(mode.symmetry),
                "similarity": mode.similarity,
            }
            for mode in modes
        ],
    }
