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
    "coarse_mesh": "the loss of X1 is found 1 % too low, 3.2 standard errors",
    "second_acoustic_resonance": "misfit looks like lost contrast, 12 times its stated error",
    "tweeter_compression": "fits give half of the step of the drive at 4 kHz to participations",
    "density": "fits exchange 10 % between drive and participations: 5 errors given the others",
    "transverse_shear": "the share of X2 in F3 changes twice as much as predicted, 3.6 errors",
    "sideband_crosstalk": "fits know no next sideband: the loss of F1 doubles in a quiet sweep",
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
