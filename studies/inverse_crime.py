"""The inverse crime on purpose: how a diagnosis scores on data of its own parameters.

    python -m studies.inverse_crime [CAMPAIGN] [--count N] [--jobs J]

CAMPAIGN is a folder of run files of a bench with nothing wrong, such as one of tier 0 of `acquire
blind make`; one is recorded if none is named. Its numbers are replaced by what the model itself
predicts, with nuisances drawn from their priors, noise from its own covariance, and effects in the
catalogue's own form and of the sizes that blind cases have. Prints the scores of `acquire blind
score`: they are what a diagnosis would be worth if nature were its model, and are to be read next
to those of sealed cases.
"""

import argparse
import sys
from dataclasses import replace
from functools import lru_cache, partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np

from blind.cases import (
    Label,
    drawn_label,
    true_sizes,
)
from blind.classes import CLASSES
from blind.report import report, sentences
from blind.scoring import Case, Classes
from diagnosis.campaign_diagnosis import (
    CampaignSummary,
    condition_of,
    diagnose_problem,
    inference_problem,
)
from diagnosis.inference.problem import InferenceProblem
from physics.effects.catalogue import BY_ID
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters
from reports.diagnosis_json import to_json
from studies.campaigns import campaigns, readings_of

_SEED = 260_613
# Of ten cases, how many have nothing, one effect, and two effects wrong.
_TIERS = (0, 0, 0, 1, 1, 1, 1, 1, 3, 3)
_TRIES = 50


@lru_cache(maxsize=1)
def campaign_of(folder: Path) -> tuple[InferenceProblem, str]:
    """Return the inference problem of a campaign, and the condition to leave out."""
    readings, reed_solver = readings_of(folder)
    return inference_problem(readings, reed_solver, BenchParameters()), condition_of(readings)


def with_effects(
    parameters: BenchParameters, label: Label, rng: np.random.Generator
) -> BenchParameters:
    """The model with effects as the catalogue has them, of a label's sizes."""
    sizes = true_sizes(label)
    for name, multiple in label.effects:
        effect = BY_ID[name]
        values = {p.name: float(rng.choice(p.grid)) for p in effect.gridded}
        for p in effect.sizes:
            # An unknown size is a fraction of what is usual.
            values[p.name] = sizes.get(name, {}).get(p.name, 0.3 * multiple * p.spread)
        parameters = effect.change(parameters, values)
    return parameters


def imagined(problem: InferenceProblem, label: Label, rng: np.random.Generator) -> InferenceProblem:
    """The same numbers as the parameters would have them."""
    for _ in range(_TRIES):
        z = rng.standard_normal(len(problem.nuisances))
        try:
            parameters = with_effects(problem.parameters(z), label, rng)
            predicted = [block.predict(parameters) for block in problem.groups]
        except ImpossibleReedError:
            continue
        blocks = [
            replace(block, values=numbers + np.linalg.cholesky(block.covariance) @ noise)
            for block, numbers in zip(problem.groups, predicted, strict=True)
            for noise in [rng.standard_normal(len(numbers))]
        ]
        return InferenceProblem(blocks, problem.base, problem.nuisances)
    raise SystemExit(f"inverse_crime: no reed is possible with {label.effects}")


def answered(folder: Path, number: int) -> tuple[Label, dict[str, Any]]:
    """Draw a case, and diagnose it."""
    problem, condition = campaign_of(folder)
    label = drawn_label(_TIERS[number % len(_TIERS)], number, _SEED)
    own = imagined(problem, label, np.random.default_rng([_SEED, number]))
    return label, to_json(diagnose_problem(own, CampaignSummary(condition)))


def main() -> None:
    """Score cases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("campaign", nargs="?", type=Path)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    named = [asked.campaign] if asked.campaign else []
    # Processes of a pool split off none themselves: each case has one.
    with campaigns(named) as (folder,), Pool(asked.jobs) as pool:
        cases = []
        answers = pool.imap(partial(answered, folder), range(asked.count))
        for number, answer in enumerate(answers):
            cases.append(Case(str(number), *answer))
            print(f"{number + 1} of {asked.count}", end="\r", file=sys.stderr, flush=True)
    for sentence in sentences(report(cases, Classes(CLASSES))):
        print(sentence)


if __name__ == "__main__":
    main()
