"""Sealed cases: laboratories drawn at random, recorded, and what is wrong with them locked away.

Of each case the folder holds the recordings and the hash of its salted label; labels and salts
are in a key of their own. Nothing in a recording depends on its label but the physics: names are
random, times are equal, and so is what cases draw at random, but for effects that are random
themselves.
"""

import hashlib
import json
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from blind.effects import BY_NAME, KINDS
from blind.laboratory import Laboratory
from blind.reed import Build, Wood
from blind.run_files import bench_text, write_recording
from blind.world import (
    Air,
    Cane,
    Chip,
    Light,
    World,
)

Tier = Literal[0, 1, 2, 3, 4, 6]
TIERS: Final = (0, 1, 2, 3, 4, 6)
# Added to the name of a case that is not whole.
CUT: Final = ".cut"
# Sizes of effects are equally likely on a scale of logarithms between these multiples of the usual.
_SIZES: Final = (0.5, 8.0)
# How many effects a laboratory states, and of which sizes.
TELLABLE: Final = (
    "carrier_leak", "laser_power_drift", "synthesizer_detuning", "phase_step_error", "vignetting",
    "chamber_leakage", "air_load", "tip_mass", "read_noise", "tweeter_compression",
)  # fmt: skip
_STATED, _STATED_SIZES = 3, (0.5, 2.0)
# Pairs that are known to be confusable.
_ALIKE: Final = (
    ("viscoelastic_stiffening", "air_load"),
    ("viscoelastic_stiffening", "thickness_wedge"),
    ("thickness_tilt", "clamp_asymmetry"),
    ("temperature_drift", "drying"),
    ("thickness_offset", "thickness_wedge"),
    ("transverse_modulus", "thickness_crown"),
    ("read_noise", "fixed_pattern_noise"),
    ("lo_misalignment", "vignetting"),
)


@dataclass(frozen=True)
class Label:
    """What is wrong with a case.

    Attributes
    ----------
    tier : int
    effects : tuple of (str, float)
        Names and sizes, in multiples of the usual.
    known : bool
        Whether all of them are in the catalogue of the diagnosis.
    seed : int
        Draws the same laboratory again.
    told : tuple of (str, float)
        Effects that the laboratory knows of and states in a bench file.
    """

    tier: int
    effects: tuple[tuple[str, float], ...]
    known: bool
    seed: int
    told: tuple[tuple[str, float], ...] = ()


def healthy_world(seed: int) -> World:
    """A laboratory with nothing wrong but what no laboratory is without."""
    rng = np.random.default_rng([seed, 1])

    def near(value: float, spread: float) -> float:
        return float(value * np.exp(spread * np.clip(rng.standard_normal(), -2.5, 2.5)))

    E, G = near(1.0, 0.07), near(1.0, 0.08)
    wood = Wood(
        E_L=13.845e9 * E, E_T=near(480e6, 0.08), E_R=near(480e6, 0.08), G_LT=0.939e9 * G,
        G_LR=near(1.2e9, 0.1), G_TR=near(1.2e9, 0.1), density=near(520.0, 0.02),
    )  # fmt: skip
    bumps = tuple(
        (float(2.5e-6 * rng.standard_normal()), int(a), int(b), float(rng.uniform(0, 2 * np.pi)))
        for a, b in rng.integers(0, 4, size=(6, 2))
    )
    return World(
        build=Build(wood=wood, bumps=bumps),
        cane=Cane(loss=near(0.03, 0.12), loss_power=float(0.03 * rng.standard_normal())),
        air=Air(
            pa_v=near(0.45, 0.1), resonance_hz=near(1100.0, 0.03), corner_hz=near(14e3, 0.05),
            ripple_seed=int(rng.integers(2**31)), field_seed=int(rng.integers(2**31)),
            line_q=near(25.0, 0.05), line=near(0.12, 0.05),
        ),
        light=Light(
            lo_e_s=near(80e3, 0.02), object_e_s=near(6000.0, 0.1), gain_scatter=near(0.02, 0.2),
            walk_rad_s=near(0.05, 0.3), object_waist_m=near(35e-3, 0.05),
        ),
        chip=Chip(
            gain_e_dn=near(4.0, 0.01), read_e=near(12.0, 0.02),
            offset_dn=50.0 + float(0.3 * rng.standard_normal()), pattern=near(0.003, 0.2),
        ),
        seed=int(rng.integers(2**31)),
    )  # fmt: skip


def drawn_label(tier: int, number: int, seed: int, only: Sequence[str] = ()) -> Label:
    """Draw what is wrong with a case.

    Parameters
    ----------
    tier : int
        0: nothing; 1: one known effect; 2: one of a confusable pair; 3: two known effects;
        4: one that no catalogue has; 6: each known effect in turn, with others that
        the bench file states.
    number : int
        Of the case.
    seed : int
        Of the set.
    only : sequence of str
        Kinds to draw from; all if empty.
    """
    rng = np.random.default_rng([seed, tier, number])
    known = [kind.name for kind in KINDS if kind.known and (not only or kind.name in only)]
    others = [kind.name for kind in KINDS if not kind.known and (not only or kind.name in only)]

    def size() -> float:
        return float(np.exp(rng.uniform(*np.log(_SIZES))))

    if tier == 0:
        chosen: list[str] = []
    elif tier == 2:
        pair = _ALIKE[int(rng.integers(len(_ALIKE)))]
        chosen = [pair[int(rng.integers(2))]]
    elif tier == 3:
        chosen = [str(name) for name in rng.choice(known, 2, replace=False)]
    elif tier == 4:
        chosen = [others[int(rng.integers(len(others)))]]
    elif tier == 6:
        chosen = [known[number % len(known)]]
    else:
        chosen = [known[int(rng.integers(len(known)))]]
    sizes = [size() * (-1 if BY_NAME[name].signed and rng.random() < 0.5 else 1) for name in chosen]
    effects = tuple(zip(chosen, sizes, strict=True))
    laboratory = int(rng.integers(2**31))
    others = [name for name in TELLABLE if name not in chosen]
    some = [str(name) for name in rng.choice(others, _STATED, replace=False)] if tier == 6 else []
    known_sizes = tuple((name, float(rng.uniform(*_STATED_SIZES))) for name in some)
    return Label(tier, effects, tier != 4, laboratory, known_sizes)


def sick_world(label: Label) -> World:
    """The laboratory of a label."""
    world = healthy_world(label.seed)
    rng = np.random.default_rng([label.seed, 2])
    for name, size in (*label.told, *label.effects):
        world = BY_NAME[name].change(world, size, rng)
    return world


def true_sizes(label: Label) -> dict[str, dict[str, float]]:
    """Sizes of the effects of a label in the terms of the catalogue, where there are any."""
    return _sizes(label, label.effects)


def stated_sizes(label: Label) -> dict[str, dict[str, float]]:
    """Return the same of the effects that a laboratory states."""
    return _sizes(label, label.told)


def _sizes(label: Label, effects: Sequence[tuple[str, float]]) -> dict[str, dict[str, float]]:
    well, found = healthy_world(label.seed), {}
    rng = np.random.default_rng([label.seed, 2])
    world = well
    for name, size in (*label.told, *label.effects):
        before, world = world, BY_NAME[name].change(world, size, rng)
        sizes_of = BY_NAME[name].sizes
        if sizes_of is not None and (name, size) in effects:
            found[name] = dict(sizes_of(before, world))
    return found


def commitment(label: Label, salt: str) -> str:
    """Return a hash that fits one label only and reveals nothing of it without the salt."""
    text = json.dumps(asdict(label), sort_keys=True) + salt
    return hashlib.sha256(text.encode()).hexdigest()


def record_case(folder: Path, name: str, label: Label) -> None:
    """Record the campaign of a case into a folder of its name, which is there once it is whole."""
    laboratory = Laboratory(sick_world(label))
    into = folder / f"{name}{CUT}"
    into.mkdir(parents=True)
    stated = stated_sizes(label)
    for recording in laboratory.campaign():
        write_recording(into / f"{recording.name}.h5", name, laboratory, recording, stated)
    if stated:
        (into / "bench.yaml").write_text(bench_text(name, laboratory, stated), encoding="utf-8")
    into.rename(folder / name)


def hidden_seed(seed: int, nonce: str) -> int:
    """Return a seed that cannot be derived from a set's own without its nonce."""
    return int.from_bytes(hashlib.sha256(f"{seed} {nonce}".encode()).digest()[:8], "big")


def seal(labels: Sequence[Label]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what is published of the cases, and the key.

    Names and salts cannot be predicted, and cases are in the order of their names.

    Returns
    -------
    sealed : dict
        Commitments by the cases' names.
    key : dict
        Labels and salts by the cases' names.
    """
    named: dict[str, Label] = {}
    for label in labels:
        while (name := secrets.token_hex(4)) in named:
            pass
        named[name] = label
    salts = {name: secrets.token_hex(16) for name in sorted(named)}
    sealed = {name: commitment(named[name], salt) for name, salt in salts.items()}
    kept = {name: {"label": asdict(named[name]), "salt": salt} for name, salt in salts.items()}
    return {"cases": sealed}, {"cases": kept}
