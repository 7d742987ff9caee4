"""What a diagnosis knows about an effect besides its physics.

A new effect needs no entry here: what holds for the part of the model that it changes holds for it.
An entry replaces the advice, or the observables that must not change, for one effect.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Final

from diagnosis.observable_groups import Observable
from physics.effects.effect import Effect
from physics.parameters.tree import BenchParameters


@dataclass(frozen=True)
class EffectNotes:
    """Notes on one effect.

    Attributes
    ----------
    check : str
        What to do at the bench to separate the effect from others.
    unaffected : frozenset of Observable
        Observables that the effect must leave unchanged.
    similar : tuple of str
        Identifiers of effects that it is easily mistaken for.
    """

    check: str
    unaffected: frozenset[Observable]
    similar: tuple[str, ...] = ()


# Which observables the laws of each part of the model leave alone, and a measurement that looks at
# the part directly. Parts are the fields of `physics.parameters.tree.BenchParameters`.
_LOG, _SENSOR = Observable.LOG, Observable.SENSOR
_FIELD, _MODES = Observable.FIELD, Observable.MODES
_UNAFFECTED: Final = MappingProxyType(
    {
        "drive": frozenset({_LOG, _SENSOR, _FIELD, _MODES}),
        "chamber": frozenset({_LOG, _SENSOR, _FIELD, _MODES}),
        "clocks": frozenset({_SENSOR, _MODES}),
        "optics": frozenset({_LOG, _SENSOR, _MODES}),
        "sensor": frozenset({_LOG, _MODES}),
        "environment": frozenset({_LOG, _SENSOR, _FIELD}),
        "reed": frozenset({_LOG, _SENSOR, Observable.HOLOGRAM, _FIELD}),
    }
)
_CHECK: Final = MappingProxyType(
    {
        "drive": "measure the sound pressure at the reed with a microphone",
        "chamber": "look into the chamber, and measure with its filling taken out",
        "clocks": "compare the frequencies and clocks of all instruments",
        "optics": "record holograms of the reed at rest",
        "sensor": "record dark frames and frames of even light",
        "environment": "sweep up and down, and again after an hour",
        "reed": "weigh the reed and measure its thickness",
    }
)
# Effects that do not keep to what holds for their part: a compressing tweeter changes the level on
# which modes depend, lost frames are in no hologram, and the last three change the brightness of
# frames.
_OTHER_UNAFFECTED: Final = MappingProxyType(
    {
        "tweeter_compression": frozenset({_LOG, _SENSOR, _FIELD}),
        "lost_frames": frozenset({_SENSOR, _MODES, _FIELD}),
        "laser_power_drift": frozenset({_LOG, _MODES}),
        "lo_misalignment": frozenset({_LOG, _MODES}),
        "vignetting": frozenset({_LOG, _MODES}),
    }
)
_THICKNESS: Final = "measure the thickness of the vamp"
# For each effect the best check, and the effects that it is easily mistaken for.
NOTES: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = MappingProxyType(
    {
        "tweeter_compression": (
            "sweep at another drive level, with a microphone next to the tweeter",
            ("hardening_nonlinearity",),
        ),
        "amplifier_rolloff": (
            "measure the voltage at the tweeter",
            ("frequency_dependent_damping",),
        ),
        "lost_frames": ("look at the frame counter of the camera", ()),
        "synthesizer_detuning": (
            "compare both tuning words; record the reed at rest (sideband 0) for some minutes",
            ("phase_step_error",),
        ),
        "generator_clock": ("use one clock for all instruments", ("synthesizer_detuning",)),
        "synthesizer_drift": (
            "wait until the synthesizers are warm",
            ("synthesizer_detuning",),
        ),
        "viscoelastic_stiffening": (
            "sweep to higher frequencies, or at low pressure",
            ("air_load", "thickness_wedge", "clamp_compliance"),
        ),
        "frequency_dependent_damping": ("let modes ring down", ("air_load",)),
        "density": ("weigh the reed", ("transverse_modulus",)),
        "transverse_modulus": ("measure a cross-cut strip", ("thickness_crown",)),
        "transverse_shear": ("measure a short, thick strip", ("clamp_compliance",)),
        "thickness_offset": (_THICKNESS, ("air_load",)),
        "thickness_wedge": (_THICKNESS, ("viscoelastic_stiffening",)),
        "thickness_crown": (_THICKNESS, ("transverse_modulus",)),
        "thickness_tilt": (_THICKNESS, ("clamp_asymmetry",)),
        "tip_mass": ("weigh the reed, or wipe its tip", ("air_load", "thickness_wedge")),
        "clamp_compliance": (
            "clamp the reed again, harder",
            ("viscoelastic_stiffening", "transverse_shear"),
        ),
        "clamp_asymmetry": ("turn the reed over in the clamp", ("thickness_tilt",)),
        "crack": (
            "look at the curvature of the mode shapes; use a microscope",
            ("thickness_tilt",),
        ),
        "hardening_nonlinearity": (
            "sweep at another drive level, in random order",
            ("temperature_drift",),
        ),
        "air_load": ("sweep at low pressure", ("viscoelastic_stiffening", "thickness_offset")),
        "acoustic_resonance": (
            "change the volume of the chamber",
            ("second_acoustic_resonance",),
        ),
        "second_acoustic_resonance": (
            "change the volume of the chamber; measure another reed",
            ("acoustic_resonance",),
        ),
        "third_acoustic_resonance": (
            "change the volume of the chamber; measure another reed",
            ("acoustic_resonance", "second_acoustic_resonance"),
        ),
        "chamber_leakage": ("take the filling out of the chamber", ("thickness_tilt",)),
        "laser_power_drift": ("put a photodiode next to the bench", ("laser_mode_hop",)),
        "laser_mode_hop": ("record a reference image at every step", ("laser_power_drift",)),
        "speckle_decorrelation": (
            "repeat the sweep at half the amplitude",
            ("sideband_crosstalk",),
        ),
        "sideband_crosstalk": (
            "record the second sideband",
            ("speckle_decorrelation", "carrier_leak"),
        ),
        "carrier_leak": ("sweep with the drive off", ("sideband_crosstalk",)),
        "phase_step_error": (
            "record the reed at rest (sideband 0): compare steps within an acquisition and between "
            "acquisitions",
            ("synthesizer_detuning",),
        ),
        "defocus": ("focus again on the edges of the reed", ()),
        "lo_misalignment": ("record frames of the local oscillator alone", ("vignetting",)),
        "vignetting": ("shift the camera", ("lo_misalignment",)),
        "fixed_pattern_noise": ("record frames of even light", ("read_noise",)),
        "hot_pixels": ("record dark frames", ("fixed_pattern_noise",)),
        "read_noise": ("record dark frames", ("fixed_pattern_noise",)),
        "sensor_nonlinearity": ("record flat frames at several exposures", ()),
        "temperature_drift": ("sweep up and down, and again after an hour", ("drying",)),
        "drying": ("wait for an hour and sweep again; weigh the reed", ("temperature_drift",)),
        "bench_vibration": (
            "record the reed at rest (sideband 0) with all machines off",
            ("phase_step_error",),
        ),
        "coarse_mesh": ("halve the mesh size", ("transverse_modulus",)),
    }
)


@lru_cache(maxsize=256)
def _parts_changed(effect: Effect) -> tuple[str, ...]:
    """Parts of the model that an effect changes, at the usual sizes."""
    values = {p.name: p.grid[0] if p.grid else p.spread for p in effect.parameters}
    nominal, changed = BenchParameters(), effect.change(BenchParameters(), values)
    names = list(_UNAFFECTED)
    return tuple(name for name in names if getattr(changed, name) != getattr(nominal, name))


def notes_of(effect: Effect) -> EffectNotes:
    """Return the notes on an effect: its own, and else those on the part that it changes."""
    parts = _parts_changed(effect)
    both = frozenset(Observable)
    for part in parts:
        both &= _UNAFFECTED[part]
    check, similar = NOTES.get(effect.id, ("; ".join(_CHECK[part] for part in parts), ()))
    return EffectNotes(check, _OTHER_UNAFFECTED.get(effect.id, both), similar)
