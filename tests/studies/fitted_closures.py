"""Closures of effects that only fits of whole sweeps show: each takes a minute of a processor."""

from pathlib import Path
from typing import Any

import pytest

from physics.effects.catalogue import CATALOGUE
from physics.effects.effect import Stage
from studies.closure import __main__ as command
from studies.closure.__main__ import WITHOUT_FITS, campaign_of

# What does not close, and why; `python -m studies.closure NAME` prints the numbers.
OPEN = {
    "hardening_nonlinearity": "fits give part of a shift by amplitude to the drive: T1 at 51 rad",
    "defocus": "no observable expects that the image moves by 1.2 mm",
    "laser_mode_hop": "fits give a sixteenth of a step of the light to the vibration",
    "coarse_mesh": "the loss of F3 is found 2 % too high, 3.3 standard errors",
    "viscoelastic_stiffening": "losses of F3, X2, X3 grow by 1.5 % more than predicted, 3.1 errors",
    "density": "fits exchange drive and participations below 4 kHz: 3.3 errors given the others",
    "tip_mass": "fits exchange drive and participations near T3: 3.7 errors given the others",
    "acoustic_resonance": "fits share the step at the line with participations: 3.0 errors",
    "sideband_crosstalk": "fits know no next sideband, whose light they take for drive: 9.2 errors",
}


def effects_at(*stages: Stage) -> list[Any]:
    """Return the effects of these stages that need fits, as parameters of a test."""
    return [
        pytest.param(
            effect.id,
            marks=[pytest.mark.xfail(reason=OPEN[effect.id])] if effect.id in OPEN else [],
        )
        for effect in CATALOGUE
        if effect.stage in stages and effect.id not in WITHOUT_FITS
    ]


def worst_of_open_groups(name: str, folder: Path) -> dict[str, float]:
    """Return the farthest pull of each group of observables that does not close."""
    (closure,) = command.closures([(campaign_of(name), name)], 1.0, folder, lambda _: None)
    return {group.name: group.worst for group in closure.groups if not group.closes}
