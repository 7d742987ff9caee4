"""All effects are in one form, and none of any is the nominal parameters, bit for bit."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import physics.effects
from physics.alterations import Alteration, Layer, SoftSpot, TipMass, YieldingClamp
from physics.effects.catalogue import BY_ID, CATALOGUE, discovered
from physics.effects.effect import Effect, Stage
from physics.parameters.tree import BenchParameters, part_at, with_part

FOLDER = Path(physics.effects.__file__).parent
NOT_EFFECTS = {"__init__", "effect", "changes", "catalogue"}
each = pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.id)

# What an effect of a size has more of, field by field.
MORE: Mapping[str, Mapping[str, str]] = {
    "tweeter_compression": {"fraction": "drive.compression"},
    "amplifier_rolloff": {"inverse_corner": "drive.roll_off"},
    "chamber_leakage": {"fraction": "chamber.leak"},
    "synthesizer_detuning": {"offset": "clocks.detuning_hz"},
    "synthesizer_drift": {"rate": "clocks.detuning_hz_h"},
    "generator_clock": {"ratio": "clocks.generator_ppm"},
    "lost_frames": {"fraction": "clocks.lost_fraction"},
    "bench_vibration": {"jitter": "optics.interference.jitter_rad"},
    "phase_step_error": {"error": "optics.interference.quarter_error_rad"},
    "laser_power_drift": {"loss_rate": "optics.interference.fade_per_h"},
    "speckle_decorrelation": {"contrast_loss": "optics.interference.decorrelation_per_rad2"},
    "carrier_leak": {"fraction": "optics.interference.leak"},
    "sideband_crosstalk": {"fraction": "optics.interference.crosstalk"},
    "lo_misalignment": {
        "down": "optics.illumination.local_oscillator_shift_m.0",
        "right": "optics.illumination.local_oscillator_shift_m.1",
    },
    "vignetting": {"fraction": "optics.illumination.vignette"},
    "defocus": {"distance": "optics.layout.defocus_m"},
    "fixed_pattern_noise": {"rms": "sensor.pattern"},
    "hot_pixels": {"fraction": "sensor.hot"},
    "sensor_nonlinearity": {"fraction": "sensor.nonlinearity"},
    "temperature_drift": {
        "rate": "environment.warming_c_h",
        "E_L": "environment.warm_E_L",
        "G_LT": "environment.warm_G_LT",
        "as_wood": "environment.warm_as_wood",
        "others": "environment.warm_others",
    },
    "drying": {
        "fraction": "environment.drying",
        "E_L": "environment.dry_E_L",
        "G_LT": "environment.dry_G_LT",
        "as_wood": "environment.dry_as_wood",
        "others": "environment.dry_others",
        "loss": "environment.dry_loss",
    },
    "hardening_nonlinearity": {"fraction": "environment.hardening"},
    "viscoelastic_stiffening": {"E_L": "reed.shift.growth_E_L", "G_LT": "reed.shift.growth_G_LT"},
    "transverse_modulus": {"E_T": "reed.shift.E_T"},
    "transverse_shear": {"G_LR": "reed.shift.G_LR", "G_TR": "reed.shift.G_TR"},
    "density": {"density": "reed.shift.density"},
    "frequency_dependent_damping": {"exponent": "reed.loss_growth"},
    "air_load": {"fraction": "reed.air_share"},
    "coarse_mesh": {"fraction": "reed.coarse_share"},
}
# Sizes that are logarithms of what a field is multiplied by.
TIMES: Mapping[str, Mapping[str, str]] = {
    "tweeter_compression": {"log_corner": "drive.compression_hz"},
    "temperature_drift": {"log_loss": "environment.warm_loss"},
    "drying": {"log_time": "environment.drying_s"},
    "read_noise": {"log_factor": "sensor.read_noise_e"},
}
# Sizes by which a field grows in relation to itself.
GROWN: Mapping[str, Mapping[str, str]] = {
    "acoustic_resonance": {"excess": "drive.acoustic_resonance.strength"},
}
# What reeds are altered by, with a size and the other way round.
ALTERED: Mapping[str, tuple[str, Alteration, Alteration]] = {
    "thickness_offset": ("thickness", Layer(0, 0), Layer(0, 0)),
    "thickness_wedge": ("thickness", Layer(1, 0), Layer(1, 0)),
    "thickness_crown": ("thickness", Layer(0, 2), Layer(0, 2)),
    "thickness_tilt": ("thickness", Layer(0, 1), Layer(0, 1)),
    "tip_mass": ("mass", TipMass(), TipMass()),
    "clamp_compliance": ("compliance", YieldingClamp(), YieldingClamp()),
    "clamp_asymmetry": ("compliance", YieldingClamp(1), YieldingClamp(-1)),
    "crack": ("depth", SoftSpot(12e-3, -2e-3), SoftSpot(12e-3, -2e-3)),
}


def values(effect: Effect, size: float) -> dict[str, float]:
    return {p.name: p.grid[0] if p.grid else size * p.spread for p in effect.parameters}


def test_every_file_is_in_the_catalogue_in_the_order_of_the_chain() -> None:
    files = {path.stem for path in FOLDER.glob("*.py")} - NOT_EFFECTS
    assert files == set(BY_ID)
    assert len(CATALOGUE) >= 30
    stages = [list(Stage).index(effect.stage) for effect in CATALOGUE]
    assert stages == sorted(stages)
    # What a pair costs is summed in this order: it may not depend on the file system.
    assert discovered() == CATALOGUE


@each
def test_none_of_an_effect_is_the_nominal_bench(effect: Effect) -> None:
    assert effect.change(BenchParameters(), values(effect, 0.0)) == BenchParameters()


@each
def test_an_effect_changes_the_bench(effect: Effect) -> None:
    changed = effect.change(BenchParameters(), values(effect, 1.0))
    assert changed != BenchParameters()
    assert hash(changed) is not None


_PARTS = (
    "drive", "drive.acoustic_resonance", "chamber", "clocks", "optics.layout",
    "optics.illumination", "optics.interference", "sensor", "environment",
)  # fmt: skip


def _busy() -> BenchParameters:
    """Parameters of a bench that has something of everything already."""
    reed = replace(BenchParameters().reed, air_share=0.2, coarse_share=0.1, loss_growth=0.05,
                   alterations=((TipMass(), 1e-7),))  # fmt: skip
    shifts = {field.name: 0.01 * (k + 1) for k, field in enumerate(fields(reed.shift))}
    parameters = BenchParameters(reed=replace(reed, shift=replace(reed.shift, **shifts)))
    for path in _PARTS:
        there = part_at(parameters, path)
        more: dict[str, Any] = {
            field.name: 1.1 * value + 0.01 * (k + 1)
            for k, field in enumerate(fields(there))
            if isinstance(value := getattr(there, field.name), float)
        }
        parameters = with_part(parameters, path, **more)
    return with_part(parameters, "optics.illumination", local_oscillator_shift_m=(1e-4, 2e-4))


def _flat(value: Any, path: str = "") -> dict[str, Any]:
    """All fields of parameters by their paths; alterations as they are."""
    if is_dataclass(value) and not path.endswith("alterations"):
        inside = {field.name: getattr(value, field.name) for field in fields(value)}
    elif isinstance(value, tuple) and value and all(isinstance(v, float) for v in value):
        inside = {str(k): v for k, v in enumerate(value)}
    else:
        return {path: value}
    found: dict[str, Any] = {}
    for name, own in inside.items():
        found |= _flat(own, f"{path}.{name}" if path else name)
    return found


def test_the_tables_name_every_effect() -> None:
    others = "laser_mode_hop", "second_acoustic_resonance", "third_acoustic_resonance"
    assert {*MORE, *TIMES, *GROWN, *ALTERED, *others} == set(BY_ID)
    for effect in CATALOGUE:
        expected = {*MORE.get(effect.id, ()), *TIMES.get(effect.id, ()), *GROWN.get(effect.id, ())}
        if expected:
            assert expected == {parameter.name for parameter in effect.parameters}


@pytest.mark.parametrize("name", sorted({*MORE, *TIMES, *GROWN}))
def test_an_effect_changes_its_own_fields_by_its_sizes_and_nothing_else(name: str) -> None:
    base, more, times, grown = (
        _busy(), MORE.get(name, {}), TIMES.get(name, {}), GROWN.get(name, {})
    )  # fmt: skip
    sizes = {size: 0.03 * (k + 1) for k, size in enumerate((*more, *times, *grown))}
    before, after = _flat(base), _flat(BY_ID[name].change(base, sizes))
    own = {path: before[path] + sizes[size] for size, path in more.items()}
    own |= {path: before[path] * np.exp(sizes[size]) for size, path in times.items()}
    own |= {path: before[path] * (1 + sizes[size]) for size, path in grown.items()}
    assert set(after) == set(before)
    assert {p for p in after if after[p] != before[p]} == set(own)
    assert {path: after[path] for path in own} == pytest.approx(own, rel=1e-12)


@pytest.mark.parametrize("name", ALTERED)
@pytest.mark.parametrize("sign", [1, -1])
def test_an_altered_reed_keeps_its_own_alterations(name: str, sign: int) -> None:
    size, one, other = ALTERED[name]
    effect, base = BY_ID[name], _busy()
    amount = 2e-6 * sign
    changed = effect.change(base, {size: amount, "x": 12e-3, "y": -2e-3})
    kind = one if sign > 0 else other
    # A bed that yields on the other side yields no less.
    expected = (kind, abs(amount) if one != other else amount)
    assert changed.reed.alterations == (*base.reed.alterations, expected)
    assert replace(changed, reed=replace(changed.reed, alterations=base.reed.alterations)) == base


def test_a_hop_and_a_resonance_are_where_they_are_said_to_be() -> None:
    nominal = BenchParameters()
    hopped = BY_ID["laser_mode_hop"].change(nominal, {"contrast_loss": 0.3, "after": 0.6})
    assert hopped == with_part(nominal, "optics.interference", hop=0.3, hop_after_h=0.6)
    sizes = {"strength": 0.2, "log_hz": 0.01, "log_quality": -0.2, "hz": 5e3, "quality": 18.0}
    sizes |= {"phase": 1.5, "turn": -0.1}
    for number in ("second", "third"):
        changed = BY_ID[f"{number}_acoustic_resonance"].change(nominal, sizes)
        resonance = getattr(changed.drive, f"{number}_resonance")
        assert resonance.strength == 0.2
        assert resonance.frequency_hz == pytest.approx(5e3 * np.exp(0.01))
        assert resonance.quality == pytest.approx(18 * np.exp(-0.2))
        assert resonance.phase_rad == pytest.approx(1.4)
        turned = BY_ID[f"{number}_acoustic_resonance"].change(nominal, sizes | {"turn": 2.0})
        resonance = getattr(turned.drive, f"{number}_resonance")
        assert resonance.phase_rad == pytest.approx(3.5 - 2 * np.pi)
        usual = getattr(nominal.drive, f"{number}_resonance")
        assert with_part(changed, "drive", **{f"{number}_resonance": usual}) == nominal


@each
def test_none_of_an_effect_is_what_a_bench_has_already(effect: Effect) -> None:
    base = effect.change(_busy(), values(effect, 1.0))
    assert effect.change(base, values(effect, 0.0)) == base


@each
def test_a_little_more_is_little_more_below_the_limit(effect: Effect) -> None:
    base = effect.change(_busy(), values(effect, 1.0))
    before, after = _flat(base), _flat(effect.change(base, values(effect, 1e-9)))
    moved = [
        path
        for path, value in before.items()
        if isinstance(value, float) and abs(after[path] - value) > 1e-6 * max(abs(value), 1e-6)
    ]
    assert bool(moved) == effect.unique


@each
def test_effects_say_what_they_must(effect: Effect) -> None:
    assert effect.reference
    for parameter in effect.parameters:
        assert parameter.source
        assert parameter.grid or parameter.spread > 0
    assert effect.sizes, "an effect has a size"
