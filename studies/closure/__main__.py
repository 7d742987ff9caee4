"""Closure of every effect: measured on the simulated bench, compared with the diagnosis's model.

Each effect is played at its typical size, one standard deviation of the prior of each of its sizes.
A small campaign with it, and the same campaign without it, are read by the readings of the
diagnosis. The change of every number is compared with the change that its observable's `predict`
expects from the parameters that the bench played.

Effects that touch no fit of a sweep come first, and take some seconds each; the others take some
minutes each. With ``--folder`` readings are kept, and a later call goes on where this one ended;
predictions are always computed again. After a change of the bench or of the readings, choose
another folder or delete the effect's file.

    python -m studies.closure [EFFECT …] [--folder PATH] [--campaign NAME] [--every] [--json]
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from physics.effects.catalogue import BY_ID, CATALOGUE
from physics.mechanics import ReedSolver
from physics.reed.reduced.stored import reduced_reed
from studies.closure.comparison import EffectClosure, compare
from studies.closure.measuring import (
    FITTED,
    REPEATED,
    UNFITTED,
    SmallCampaign,
    bench_with,
    measured,
    sizes_of,
)
from studies.closure.table import as_json, rows, summary

# Effects that change nothing of a vibration or of what a fit makes of it.
WITHOUT_FITS: Final = (
    "lost_frames",
    "synthesizer_detuning",
    "generator_clock",
    "synthesizer_drift",
    "carrier_leak",
    "phase_step_error",
    "lo_misalignment",
    "vignetting",
    "fixed_pattern_noise",
    "hot_pixels",
    "read_noise",
    "sensor_nonlinearity",
    "bench_vibration",
)
# Effects that change light or reed while time passes, and show in sweeps that repeat each other.
WITH_TIME: Final = ("laser_power_drift", "laser_mode_hop", "temperature_drift", "drying")
_CAMPAIGNS: Final = {small.name: small for small in (UNFITTED, FITTED, REPEATED)}


def campaign_of(name: str) -> SmallCampaign:
    """Return the campaign that an effect needs."""
    if name in WITHOUT_FITS:
        return UNFITTED
    return REPEATED if name in WITH_TIME else FITTED


def jobs(names: Sequence[str], campaign: str | None) -> list[tuple[SmallCampaign, str]]:
    """Return the campaigns to measure, with the names of their effects, the fast ones first.

    Parameters
    ----------
    names : sequence of str
        Effects; all if empty.
    campaign : str or None
        Name of the campaign; None is the one that each effect needs.
    """
    chosen = [effect.id for effect in CATALOGUE if not names or effect.id in names]
    if campaign is not None:
        return [(_CAMPAIGNS[campaign], name) for name in chosen]
    order = list(_CAMPAIGNS)
    return sorted(
        [(campaign_of(name), name) for name in chosen], key=lambda job: order.index(job[0].name)
    )


def closures(
    asked: Sequence[tuple[SmallCampaign, str]],
    multiple: float,
    folder: Path | None,
    say: Callable[[str], None],
) -> Iterator[EffectClosure]:
    """Yield the closure of each effect when it is known.

    Parameters
    ----------
    asked : sequence of (SmallCampaign, str)
    multiple : float
        Of the typical size.
    folder : Path or None
        Keeps readings.
    say : callable
        Called with the progress.
    """
    solver = ReedSolver(reduced_reed(announce=say), say)
    for number, (small, name) in enumerate(asked, 1):
        say(f"{number} of {len(asked)}: {name}, {small.name}")
        size = "" if multiple == 1 else f"-{multiple:g}"
        kept = [
            folder / small.name / f"{what}.pickle" if folder else None
            for what in ("none", f"{name}{size}")
        ]
        without = measured(small, bench_with(small, None), kept[0])
        effect = BY_ID[name]
        with_it = measured(small, bench_with(small, effect, multiple), kept[1])
        yield compare(name, sizes_of(effect, multiple), with_it, without, solver)


def main() -> int:
    """Command line; returns the exit status: 1 if an effect does not close."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("effects", nargs="*", metavar="EFFECT", help="all if none is named")
    parser.add_argument("--folder", type=Path, help="keep readings here, and go on from them")
    parser.add_argument(
        "--campaign", choices=tuple(_CAMPAIGNS), help="by default that which each effect needs"
    )
    parser.add_argument("--size", type=float, default=1.0, help="multiple of the typical size")
    parser.add_argument("--every", action="store_true", help="print every number")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    asked = parser.parse_args()
    if unknown := sorted(set(asked.effects) - BY_ID.keys()):
        parser.error(f"no effect is called {unknown[0]}; `acquire effects` lists them")
    found: list[EffectClosure] = []
    todo, interrupted = jobs(asked.effects, asked.campaign), False
    try:
        for closure in closures(todo, asked.size, asked.folder, _say):
            found.append(closure)
            _say(f"  {closure.verdict}")
    except KeyboardInterrupt:
        interrupted = True
        _say(f"interrupted: {len(found)} of {len(todo)} effects are known")
    if asked.json:
        print(json.dumps({"interrupted": interrupted, "effects": as_json(found)}, indent=2))
    elif found:
        print("\n".join([*rows(found, every=asked.every), "", *summary(found)]))
    if interrupted:
        return 130
    return int(any(closure.verdict == "open" for closure in found))


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
