"""What is true of a case."""

from dataclasses import asdict
from fractions import Fraction
from typing import Any

import numpy as np
from scipy import linalg

from studies.second_laboratory.campaigns.case import Case, Setup, setup_of
from studies.second_laboratory.campaigns.climate import Climate
from studies.second_laboratory.campaigns.disorder import LEVELS
from studies.second_laboratory.campaigns.effects.base import (
    Array,
    Body,
    Cast,
    ComplexArray,
    Moment,
)
from studies.second_laboratory.campaigns.motion import Motion, dynamic_stiffness, inertia
from studies.second_laboratory.campaigns.world import World
from studies.second_laboratory.laboratory import Settings
from studies.second_laboratory.light import Geometry
from studies.second_laboratory.reed import HIGHEST_HZ, Reed
from studies.second_laboratory.shape import Fineness

# Any frequency of the modulators: mechanics does not ask for it.
_CENTRE_HZ = Fraction(80_000_000)
# Steps from the modes at this frequency to each mode at its own; moduli change by a few per cent.
_START_HZ, _STEPS = 6000.0, 4


def truth_of(
    case: Case, repeat: int = 0, world: World | None = None, fineness: Fineness | None = None
) -> dict[str, Any]:
    """Return what is true of a campaign of a case, as plain values.

    Parameters
    ----------
    case : Case
    repeat : int
    world : World, optional
        Of this campaign at its start, where there is one; else one is made.
    fineness : Fineness, optional
        Of the finite elements.

    Returns
    -------
    dict
        ``kind``, ``amount``, ``level`` (its name, or null), ``series``, ``seed``, ``number``,
        ``repeat``;
        ``effects``: identifier and `Effect.sizes` of each;
        ``disorder``: parameters of bench, reed, day and first clamping, without the effects;
        ``modes``: frequency in Hz and loss factor of each mode below 20 kHz by name, in the first
        clamping, at the start, with the effects.
    """
    setup = setup_of(case, repeat)
    made = world or world_without_instruments(setup, fineness)
    return {
        "kind": case.kind,
        "amount": case.amount,
        "level": next((name for name, each in LEVELS.items() if each == case.amount), None),
        "series": case.series,
        "seed": case.seed,
        "number": case.number,
        "repeat": repeat,
        "effects": [{"id": each.id, "sizes": each.sizes()} for each in case.effects],
        "disorder": {
            "bench": _plain(asdict(setup.bench)),
            "reed": _plain(asdict(setup.reed)),
            "day": asdict(setup.day),
            "clamping": asdict(made.clamping),
        },
        "modes": modes_of(made.motion(), made.climate(0.0), made.cast),
    }


def world_without_instruments(setup: Setup, fineness: Fineness | None = None) -> World:
    """Return the world of a campaign, that only mechanics is asked of."""
    geometry = Geometry((16, 16), 6.7e-6, 650e-9, 1.0)
    settings = Settings(_CENTRE_HZ, _CENTRE_HZ)
    return World(setup, geometry, (0.022, 0.0), settings, fineness)


def modes_of(motion: Motion, climate: Climate, cast: Cast) -> dict[str, dict[str, float]]:
    """Return frequency and loss factor of each mode by its name, at small amplitude."""
    reed = motion.reed_in(climate)
    stiffness, mass = _matrices(reed, climate, cast, _START_HZ)
    values, vectors = linalg.eigh(stiffness.real, mass)
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        if 0 < value < (1.15 * 2 * np.pi * HIGHEST_HZ) ** 2:
            hz, loss, shape = _followed(reed, climate, cast, float(np.sqrt(value)), vector)
            if hz < HIGHEST_HZ:
                found.append((hz, loss, shape))
    found.sort(key=lambda each: each[0])
    names = reed.names(np.array([shape for _, _, shape in found]).T)
    return {
        name: {"hz": hz, "loss_factor": loss}
        for name, (hz, loss, _) in zip(names, found, strict=True)
    }


def _matrices(reed: Reed, climate: Climate, cast: Cast, hz: float) -> tuple[ComplexArray, Array]:
    """Return stiffness with all losses, and mass, at rest; what effects add is stiffness."""
    omega, mass = 2 * np.pi * hz, inertia(reed, climate, hz).real
    now = Moment(0.0, np.zeros(1), 0.0, hz, 0.0, clay=False)
    body = Body(reed, hz, np.zeros(len(mass), complex))
    dynamic = cast.through("dynamic", dynamic_stiffness(reed, climate, hz), body, now)
    return np.asarray(dynamic + omega**2 * mass), mass


def _followed(
    reed: Reed, climate: Climate, cast: Cast, omega: float, vector: Array
) -> tuple[float, float, Array]:
    """Follow one mode to the moduli of its own frequency; return Hz, loss factor and shape."""
    loss = 0.0
    for _ in range(_STEPS):
        stiffness, mass = _matrices(reed, climate, cast, omega / (2 * np.pi))
        values, vectors = linalg.eigh(stiffness.real, mass)
        best = int(np.argmax(np.abs(vectors.T @ mass @ vector)))
        omega, vector = float(np.sqrt(max(values[best], 0.0))), vectors[:, best]
        loss = float(vector @ stiffness.imag @ vector) / omega**2
    return omega / (2 * np.pi), loss, vector


def _plain(value: Any) -> Any:
    """Return plain values; complex numbers as pairs."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    return [value.real, value.imag] if isinstance(value, complex) else value
