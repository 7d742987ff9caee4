"""Modes of the reed that a reed file describes, by finite elements or from a basis."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np

from physics.errors import ImpossibleReedError
from physics.reed.elements.mesh import FAST, FINE, STANDARD, MeshLevel
from physics.reed.modes import (
    HIGHEST_HZ,
    NamedMode,
    reed_modes,
    viscoelastic_modes,
)
from physics.reed.reduced.changes import LARGEST_OFFSET_M, Change, layer
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.elastic import named_vibrations
from physics.reed.reduced.reed import BasisSettings, ReedBox
from physics.reed.reduced.stored import reduced_reed
from physics.reed.reduced.vibrations import vibrations
from physics.reed.reduction.metamodel import REFERENCE_HZ
from protocols.errors import ProtocolError
from protocols.reed import ReedFile

# How finely a reed is computed, by the name of the level.
MESHES: Final = {"fine": FINE, "standard": STANDARD, "fast": FAST}

# In place of a level: the reduced reed, built once for a reed.
BASIS: Final = "basis"

# Modes just above 20 kHz are named too: a pair that exchanges shapes across that limit then shares
# its names as it would elsewhere.
_NAMED_UP_TO_HZ: Final = 1.1 * HIGHEST_HZ

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
    """Modes below 20 kHz of the reduced reed that fits and simulations use, ascending.

    Parameters
    ----------
    reed : ReedFile
    reference : ReedFile
        The reed before its settings were changed. The reduced reed is computed for the middle of
        its ranges of cane, and for its shape, so that one serves whatever cane is asked for, and
        a little more or less thickness.
    announce, progress : callable, optional
        As for `reduced_reed`.

    Returns
    -------
    list of NamedMode
        `shape` has no nodes.

    Raises
    ------
    ProtocolError
        If the reduced reed does not answer for the reed.
    """
    box = ReedBox(cane=reference.constants())
    _require_in_box(reed, box)
    geometry, drawn = reed.geometry(), reference.geometry()
    offset_m = geometry.thickness_offset_m - drawn.thickness_offset_m
    if replace(geometry, thickness_offset_m=drawn.thickness_offset_m) != drawn:
        drawn, offset_m = geometry, 0.0
    _require_thin(reed, offset_m)
    try:
        reduced = reduced_reed(drawn, STANDARD, BasisSettings(box), announce, progress)
        change = layer(reduced, lambda x, _y: np.full(x.shape, offset_m)) if offset_m else Change()
        state = State(CaneLaw(reed.cane(), reed.viscoelastic()), change)
        found = named_vibrations(vibrations(reduced, state, _NAMED_UP_TO_HZ))
    except ImpossibleReedError as error:
        raise ProtocolError(f"{reed.source}: {error}") from None
    answer = [mode for mode in found if mode.frequency_hz <= HIGHEST_HZ]
    if reed.viscoelastic() is not None:
        for mode in answer:
            _require_in_box(reed, box, mode.frequency_hz)
    return answer


def _require_thin(reed: ReedFile, offset_m: float) -> None:
    """Refuse a layer in which first order no longer holds.

    Raises
    ------
    ProtocolError
    """
    if abs(offset_m) > LARGEST_OFFSET_M:
        limit_um = 1e6 * LARGEST_OFFSET_M
        raise reed.error(
            "geometry.thickness_offset",
            f"{1e6 * offset_m:+.3g} µm from the reed's file lie outside the basis, which answers "
            f"for -{limit_um:g} to {limit_um:g} µm; use --mesh fine",
        )


def _require_in_box(reed: ReedFile, box: ReedBox, hz: float = REFERENCE_HZ) -> None:
    """Refuse what a reduced reed does not answer for; viscoelastic cane has moduli of a frequency.

    Raises
    ------
    ProtocolError
    """
    cane = reed.cane(hz)
    ranges = box.ranges | {"density_kg_m3": (0.0, box.heaviest_kg_m3)}
    outside = list(box.outside(cane))
    if cane.density_kg_m3 > box.heaviest_kg_m3:
        outside.append("density_kg_m3")
    for name in outside:
        value, (low, high) = getattr(cane, name), ranges[name]
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
    """Key of a constant in a reed's file, and the unit that people read it in."""
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
