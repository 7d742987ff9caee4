"""What may be wrong with a laboratory, in this side's own forms, and how large it may be.

Kinds that the diagnosis knows bear its names; the others are for it to find unknown. Sizes are
drawn so that some can be seen and some cannot.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from blind.world import World

# The tip is 42 µm thin at its sides: no more than this may be taken off.
_THINNEST_M = -25e-6
Change = Callable[[World, float, np.random.Generator], World]
Sizes = Callable[[World, World], Mapping[str, float]]


@dataclass(frozen=True)
class Kind:
    """A kind of effect.

    Attributes
    ----------
    name : str
    change : callable
        ``change(world, size, rng)``; a size of 1 is usual.
    signed : bool
        Whether it may be negative.
    known : bool
        Whether the catalogue of the diagnosis has it.
    sizes : callable, optional
        ``sizes(well, sick)``: sizes of the effect in the terms of the catalogue, from a world
        without and with it; None where this side's form has no such sizes.
    """

    name: str
    change: Change
    signed: bool = False
    known: bool = True
    sizes: Sizes | None = None


def _in(part: str, **fields: Callable[[float], Any]) -> Change:
    """Change fields of a part of the world by functions of the size."""

    def change(world: World, size: float, _rng: np.random.Generator) -> World:
        values = {name: value(size) for name, value in fields.items()}
        return replace(world, **{part: replace(getattr(world, part), **values)})

    return change


def _wood(name: str, share: float) -> Change:
    def change(world: World, size: float, _rng: np.random.Generator) -> World:
        wood = world.build.wood
        changed = replace(wood, **{name: getattr(wood, name) * float(np.exp(share * size))})
        return replace(world, build=replace(world.build, wood=changed))

    return change


def _shear(world: World, size: float, rng: np.random.Generator) -> World:
    wood, turn = world.build.wood, rng.uniform(0, 2 * np.pi)
    changed = replace(
        wood,
        G_LR=wood.G_LR * float(np.exp(0.15 * size * np.cos(turn))),
        G_TR=wood.G_TR * float(np.exp(0.15 * size * np.sin(turn))),
    )
    return replace(world, build=replace(world.build, wood=changed))


def _stiffening(world: World, size: float, rng: np.random.Generator) -> World:
    share = rng.uniform(0.2, 0.8)
    powers = 0.04 * size * share, 0.06 * size * (1 - share)
    return replace(world, cane=replace(world.cane, powers=powers))


def _clamp_asymmetry(world: World, size: float, _rng: np.random.Generator) -> World:
    beds = (2e-13 * abs(size), 0.0) if size > 0 else (0.0, 2e-13 * abs(size))
    return replace(world, build=replace(world.build, yielding_m3_n=beds))


def _crack(world: World, size: float, rng: np.random.Generator) -> World:
    place = float(rng.uniform(8e-3, 28e-3)), float(rng.uniform(-4e-3, 4e-3))
    cane = replace(world.cane, crack_depth_m=25e-6 * size, crack_m=place)
    return replace(world, cane=cane)


def _second_acoustic_resonance(world: World, size: float, rng: np.random.Generator) -> World:
    hz = float(np.exp(rng.uniform(np.log(2500.0), np.log(15000.0))))
    q = float(rng.uniform(15, 60))
    air = replace(world.air, second=0.06 * size, second_hz=hz, second_q=q)
    return replace(world, air=air)


def _groove(world: World, size: float, rng: np.random.Generator) -> World:
    build = replace(world.build, groove_m=10e-6 * size, groove_x_m=float(rng.uniform(5e-3, 25e-3)))
    return replace(world, build=build)


def _stop(world: World, size: float, rng: np.random.Generator) -> World:
    place = float(rng.uniform(15e-3, 30e-3)), float(rng.uniform(-4e-3, 4e-3))
    return replace(world, cane=replace(world.cane, stop_n_m=800.0 * size, stop_m=place))


def _lo_shift(world: World, size: float, rng: np.random.Generator) -> World:
    turn = rng.uniform(0, 2 * np.pi)
    shift = 0.4e-3 * size * np.array([np.sin(turn), np.cos(turn)])
    light = replace(world.light, lo_shift_m=(float(shift[0]), float(shift[1])))
    return replace(world, light=light)


def _field(size: str, part: str, field: str, factor: float = 1.0) -> Sizes:
    """A size that is what a field of a part of the world has more, times a factor."""

    def sizes(well: World, sick: World) -> dict[str, float]:
        more = getattr(getattr(sick, part), field) - getattr(getattr(well, part), field)
        return {size: factor * float(more)}

    return sizes


def _log_wood(*names: str) -> Sizes:
    """Sizes that are logarithms of what constants of the cane have grown by."""

    def sizes(well: World, sick: World) -> dict[str, float]:
        return {
            name: float(np.log(getattr(sick.build.wood, name) / getattr(well.build.wood, name)))
            for name in names
        }

    return sizes


def _sizes_of_powers(_well: World, sick: World) -> dict[str, float]:
    return {"E_L": sick.cane.powers[0], "G_LT": sick.cane.powers[1]}


def _sizes_of_beds(_well: World, sick: World) -> dict[str, float]:
    left, right = sick.build.yielding_m3_n
    return {"compliance": left if left == right else left - right}


def _sizes_of_lo(_well: World, sick: World) -> dict[str, float]:
    down, right = sick.light.lo_shift_m
    return {"down": down, "right": right}


def _sizes_of_pattern(well: World, sick: World) -> dict[str, float]:
    more = sick.chip.pattern**2 - well.chip.pattern**2
    return {"rms": float(np.sqrt(max(more, 0.0)))}


def _sizes_of_noise(_well: World, sick: World) -> dict[str, float]:
    return {"log_factor": float(np.log(sick.chip.read_e / 12.0))}


def _sizes_of_air(well: World, sick: World) -> dict[str, float]:
    return {"fraction": sick.cane.air - well.cane.air}


def _sizes_of_rolloff(_well: World, sick: World) -> dict[str, float]:
    return {"inverse_corner": 1e4 / sick.air.roll_hz}


KINDS: Final[tuple[Kind, ...]] = (
    Kind(
        "tweeter_compression",
        _in("air", compression=lambda s: min(0.15 * s, 0.8)),
        sizes=_field("fraction", "air", "compression"),
    ),
    Kind(
        "amplifier_rolloff",
        _in("air", roll_hz=lambda s: 60e3 / max(s, 1e-3)),
        sizes=_sizes_of_rolloff,
    ),
    Kind(
        "acoustic_resonance",
        _in("air", line=lambda s: 0.12 * (1 + 0.5 * s)),
        signed=False,
        sizes=_field("excess", "air", "line", 1 / 0.12),
    ),
    Kind(
        "second_acoustic_resonance",
        _second_acoustic_resonance,
        sizes=_field("strength", "air", "second"),
    ),
    Kind(
        "chamber_leakage",
        _in("air", open_right=lambda s: min(0.15 * s, 1.0)),
        sizes=_field("fraction", "air", "open_right"),
    ),
    Kind("air_load", _in("cane", air=lambda s: 1 + 0.25 * s), sizes=_sizes_of_air),
    Kind("viscoelastic_stiffening", _stiffening, sizes=_sizes_of_powers),
    Kind(
        "frequency_dependent_damping",
        _in("cane", loss_power=lambda s: 0.1 * s),
        signed=True,
        sizes=_field("exponent", "cane", "loss_power"),
    ),
    Kind("density", _wood("density", 0.03), signed=True, sizes=_log_wood("density")),
    Kind("transverse_modulus", _wood("E_T", 0.1), signed=True, sizes=_log_wood("E_T")),
    Kind("transverse_shear", _shear, sizes=_log_wood("G_LR", "G_TR")),
    Kind(
        "thickness_offset",
        _in("build", offset_m=lambda s: max(6e-6 * s, _THINNEST_M)),
        signed=True,
        sizes=_field("thickness", "build", "offset_m"),
    ),
    Kind(
        "thickness_wedge",
        _in("build", wedge_m=lambda s: min(6e-6 * s, -_THINNEST_M)),
        signed=True,
        sizes=_field("thickness", "build", "wedge_m"),
    ),
    Kind(
        "thickness_crown",
        _in("build", crown_m=lambda s: max(6e-6 * s, _THINNEST_M)),
        signed=True,
        sizes=_field("thickness", "build", "crown_m"),
    ),
    Kind(
        "thickness_tilt",
        _in("build", tilt_m=lambda s: float(np.clip(5e-6 * s, _THINNEST_M, -_THINNEST_M))),
        signed=True,
        sizes=_field("thickness", "build", "tilt_m"),
    ),
    Kind(
        "tip_mass", _in("cane", tip_kg=lambda s: 0.4e-6 * s), sizes=_field("mass", "cane", "tip_kg")
    ),
    Kind(
        "clamp_compliance",
        _in("build", yielding_m3_n=lambda s: (2e-13 * s, 2e-13 * s)),
        sizes=_sizes_of_beds,
    ),
    Kind("clamp_asymmetry", _clamp_asymmetry, signed=True, sizes=_sizes_of_beds),
    Kind("crack", _crack),
    Kind(
        "hardening_nonlinearity",
        _in("cane", hardening=lambda s: 4e-4 * s),
        sizes=_field("fraction", "cane", "hardening"),
    ),
    Kind(
        "temperature_drift",
        _in("cane", warming_c_h=lambda s: 4.0 * s),
        signed=True,
        sizes=_field("rate", "cane", "warming_c_h"),
    ),
    Kind(
        "drying",
        _in("cane", drying=lambda s: min(0.1 * s, 1.0)),
        sizes=_field("fraction", "cane", "drying"),
    ),
    Kind(
        "bench_vibration",
        _in("light", jitter_rad=lambda s: 0.05 * s),
        sizes=_field("jitter", "light", "jitter_rad"),
    ),
    Kind(
        "synthesizer_detuning",
        _in("clockwork", detuning_hz=lambda s: 0.01 * s),
        signed=True,
        sizes=_field("offset", "clockwork", "detuning_hz"),
    ),
    Kind(
        "generator_clock",
        _in("clockwork", scale_ppm=lambda s: 2.0 * s),
        signed=True,
        sizes=_field("ratio", "clockwork", "scale_ppm"),
    ),
    Kind(
        "synthesizer_drift",
        _in("clockwork", drift_hz_h=lambda s: 0.05 * s),
        signed=True,
        sizes=_field("rate", "clockwork", "drift_hz_h"),
    ),
    Kind(
        "lost_frames",
        _in("clockwork", repeats=lambda s: min(0.01 * s, 0.3)),
        sizes=_field("fraction", "clockwork", "repeats"),
    ),
    Kind(
        "laser_power_drift",
        _in("light", fade_per_h=lambda s: 0.15 * s),
        signed=True,
        sizes=_field("loss_rate", "light", "fade_per_h"),
    ),
    Kind(
        "laser_mode_hop",
        _in("light", hop=lambda s: min(0.08 * s, 0.7), hop_at=lambda _s: 0.55),
        sizes=_field("contrast_loss", "light", "hop"),
    ),
    Kind(
        "speckle_decorrelation",
        _in("light", blur=lambda s: 3e-4 * s),
        sizes=_field("contrast_loss", "light", "blur"),
    ),
    Kind(
        "sideband_crosstalk",
        _in("light", mixing=lambda s: 0.03 * s),
        sizes=_field("fraction", "light", "mixing"),
    ),
    Kind(
        "carrier_leak",
        _in("light", leak=lambda s: 0.01 * s),
        sizes=_field("fraction", "light", "leak"),
    ),
    Kind(
        "phase_step_error",
        _in("light", quarter_error_rad=lambda s: 0.05 * s),
        signed=True,
        sizes=_field("error", "light", "quarter_error_rad"),
    ),
    Kind(
        "defocus",
        _in("light", defocus_m=lambda s: 0.02 * s),
        signed=True,
        sizes=_field("distance", "light", "defocus_m"),
    ),
    Kind("lo_misalignment", _lo_shift, sizes=_sizes_of_lo),
    Kind(
        "vignetting",
        _in("light", vignette=lambda s: 0.05 * s),
        sizes=_field("fraction", "light", "vignette"),
    ),
    Kind("fixed_pattern_noise", _in("chip", pattern=lambda s: 0.01 * s), sizes=_sizes_of_pattern),
    Kind(
        "hot_pixels",
        _in("chip", hot=lambda s: min(0.002 * s, 0.1)),
        sizes=_field("fraction", "chip", "hot"),
    ),
    Kind("read_noise", _in("chip", read_e=lambda s: 12.0 * (1 + 0.3 * s)), sizes=_sizes_of_noise),
    Kind(
        "sensor_nonlinearity",
        _in("chip", bend=lambda s: min(0.03 * s, 0.5)),
        sizes=_field("fraction", "chip", "bend"),
    ),
    # --- What no catalogue has -----------------------------------------------------------------
    Kind("side_mass", _in("cane", side_kg=lambda s: 1e-6 * s), known=False),
    Kind("touching_stop", _stop, known=False),
    Kind("grain_angle", _in("build", grain=lambda s: 0.03 * s), signed=True, known=False),
    Kind("groove", _groove, known=False),
    Kind("shaken_clamp", _in("air", shake=lambda s: 0.02 * s), known=False),
    Kind("lossier_when_lively", _in("cane", lossier=lambda s: 0.05 * s), known=False),
    Kind("warm_hands", _in("cane", step_c=lambda s: 2.0 * s), signed=True, known=False),
    Kind("flicker", _in("light", flicker=lambda s: 0.02 * s), known=False),
    Kind("creeping_image", _in("light", shift_m_h=lambda s: 1e-4 * s), known=False),
    Kind("banding", _in("chip", banding_e=lambda s: 15.0 * s), known=False),
)
BY_NAME: Final[Mapping[str, Kind]] = {kind.name: kind for kind in KINDS}
