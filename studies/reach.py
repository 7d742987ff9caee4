"""What campaigns can detect: minimum detectable sizes of all effects, and confusable effects.

    python -m studies.reach [CAMPAIGN …]

Folders of run files of benches with nothing wrong, such as tier 0 of `acquire blind make`; five are
recorded if none is named. Prints, of each effect, the median over campaigns of the least size that
stands out by five deviations; the same in multiples of what is usual in blind cases, which draw 0.5
to 8; the share of its signature that nuisances take up; and with which effects it has a cosine of
0.8 or more in most campaigns; then the classes that follow.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blind.cases import Label, true_sizes
from blind.effects import BY_NAME
from diagnosis.campaign_diagnosis import inference_problem
from diagnosis.inference.candidates import without_effects
from diagnosis.inference.model_selection import each_alone, signatures_of, tried_alone
from diagnosis.inference.similarity import (
    CONFUSABLE,
    DETECTION_SIGMA,
    Detectability,
    confusable_classes,
    detectability_of,
)
from diagnosis.readings.campaign_readings import Readings
from physics.effects.catalogue import BY_ID, CATALOGUE
from physics.effects.effect import Stage
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters
from studies.campaigns import campaigns, readings_of

EFFECTS = tuple(effect for effect in tried_alone(CATALOGUE) if effect.stage is not Stage.NUMERICS)


def reach_in(readings: Readings, reed_solver: ReedSolver) -> tuple[Detectability, ...]:
    """Reach of one campaign."""
    problem = inference_problem(readings, reed_solver, BenchParameters())
    null = without_effects(problem, [np.zeros(len(problem.nuisances))])
    alone = each_alone(problem, null, EFFECTS)
    return detectability_of(EFFECTS, signatures_of(null, alone))


def together(reaches: Sequence[Sequence[Detectability]]) -> list[Detectability]:
    """Medians over campaigns; effects are confusable if they are in most campaigns."""
    found = []
    for own in zip(*reaches, strict=True):
        least = {
            name: float(np.median([reach.detectable[name] for reach in own]))
            for name in own[0].detectable
        }
        cosines = {
            other: float(np.median([reach.confusable.get(other, 0.0) for reach in own]))
            for other in sorted({name for reach in own for name in reach.confusable})
        }
        absorbed = float(np.median([reach.absorbed for reach in own]))
        similar = {name: value for name, value in cosines.items() if value >= CONFUSABLE}
        found.append(Detectability(own[0].effect, absorbed, least, similar))
    return found


def as_drawn(reach: Detectability, largest: float = 8.0) -> float:
    """Multiple of a blind case's usual size from which on an effect stands out; NaN if unknown."""
    multiples = []
    for sign in (1, -1) if BY_NAME[reach.effect].signed else (1,):
        label = Label(1, ((reach.effect, sign * largest),), True, 0)
        sizes = true_sizes(label).get(reach.effect, {})
        out = [DETECTION_SIGMA * v / reach.detectable[name] for name, v in sizes.items()]
        multiples.append(
            largest * DETECTION_SIGMA / float(np.linalg.norm(out)) if any(out) else np.nan
        )
    return float(np.min(multiples))


def row_of(reach: Detectability) -> str:
    """One line of the table."""
    least = [(p, reach.detectable[p.name]) for p in BY_ID[reach.effect].sizes]
    seen = [f"{p.name} {size:.2g} {p.unit}".strip() for p, size in least if np.isfinite(size)]
    sizes = "; ".join(seen) or "no size"
    similar = ", ".join(f"{name} {value:.2f}" for name, value in reach.confusable.items())
    absorbed = "-" if np.isnan(reach.absorbed) else f"{reach.absorbed:.0%}"
    return f"{reach.effect:<24}{sizes:<44}{as_drawn(reach):>6.2f}{absorbed:>6}  {similar}"


def main() -> None:
    """Read campaigns, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("campaigns", nargs="*", type=Path, metavar="CAMPAIGN")
    with campaigns(parser.parse_args().campaigns, count=5) as folders:
        reaches = [reach_in(*readings_of(folder)) for folder in folders]
    found = together(reaches)
    least = "least size that stands out by 5 deviations"
    print(f"{'effect':<24}{least:<44}{'drawn':>6}{'taken':>6}  confusable with")
    for reach in found:
        print(row_of(reach))
    print("classes:", *("|".join(group) for group in confusable_classes(found) if len(group) > 1))


if __name__ == "__main__":
    main()
