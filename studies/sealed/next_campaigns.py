"""What the proposed next measurement is worth, against as many minutes of more of the same.

    python -m studies.sealed.next_campaigns CASES KEY ANSWERS FOLDER [--set SET]
        [--count N] [--jobs N]

CASES, KEY, ANSWERS and SET are those of a scored set, see `studies.sealed.second_scores`. Of its
cases with known effects to whose true class an answer gives between 5 and 90 %, N are taken, in the
order of their names: there more data can help. `acquire diagnose --next` writes the campaign that
separates the likeliest causes best; it is measured on another day, and diagnosed together with the
first one. In its place, so are as many sweeps of the shipped kinds as take the same time. FOLDER
keeps everything; a later call goes on from it. This laboratory has no hands for wax, a vacuum, or
an hour of waiting.
"""

from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from acquire.campaigns import load_campaign
from blind.classes import CLASSES
from blind.scoring import Case, Classes
from diagnosis.experiment_design import EXPERIMENTS, Experiment, RankedExperiment
from reports.next_campaign import write_next
from runs.reader import Run
from studies.sealed.answer_cases import diagnosed
from studies.sealed.second_laboratory import SealedCase, recorded
from studies.sealed.second_scores import asked_set, label_of

# Experiments that hands of this laboratory can do.
PLAYABLE: Final = ("repeat", "long_rest", "more_frames", "without_clay")
_UNSURE: Final = (0.05, 0.9)
_REPEAT: Final = next(each for each in EXPERIMENTS if each.id == "repeat")


@dataclass(frozen=True)
class Worth:
    """Probability of the true class.

    Attributes
    ----------
    experiment : str
        Which was proposed.
    minutes : float
    before : float
    after, repeated : float or None
        With the proposed measurement, and with as many minutes of more of the same; None if the
        proposed one cannot be played here.
    """

    experiment: str
    minutes: float
    before: float
    after: float | None
    repeated: float | None


def probability_of_truth(sealed: SealedCase, answer: Mapping[str, Any]) -> float:
    """Return the probability that an answer gives to the true class."""
    classes, case = Classes(CLASSES), Case("", label_of(sealed), answer)
    return float(classes.mass(case.probability).get(classes.of(case.truth), 0.0))


def unsure(
    cases: Mapping[str, SealedCase], answers: Mapping[str, Mapping[str, Any]]
) -> Iterator[str]:
    """Names of cases with known effects, of which more data could tell more."""
    least, most = _UNSURE
    for name, each in cases.items():
        known = each.case.kind in ("single", "pair") and name in answers
        if known and least < probability_of_truth(each, answers[name]) < most:
            yield name


def sweeps_of(minutes: float) -> Experiment:
    """Return sweeps of the shipped kinds that take some minutes; one at least."""
    share = minutes / _REPEAT.minutes
    count = max(1, round(share * len(_REPEAT.campaign_parts)))
    return Experiment(
        _REPEAT.id,
        _REPEAT.description,
        minutes,
        _REPEAT.groups,
        _REPEAT.change,
        campaign_parts=_REPEAT.campaign_parts[:count],
    )


def worth_of(sealed: SealedCase, first: Path, folder: Path) -> Worth:
    """Measure what is proposed, and more of the same, and diagnose both with the first campaign.

    Parameters
    ----------
    sealed : SealedCase
    first : Path
        Its campaign.
    folder : Path
        For what is made here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    proposed, same = folder / "next.yaml", folder / "same.yaml"
    answer = diagnosed(folder / "before.json", [first], "--next", str(proposed))
    best = next(
        each for each in answer["next"]["experiments"] if _experiment(each["id"]).campaign_parts
    )
    before = probability_of_truth(sealed, answer)
    if best["id"] not in PLAYABLE:
        return Worth(best["id"], best["minutes"], before, None, None)
    with Run.open(first / "up.h5") as run:
        more = RankedExperiment(sweeps_of(best["minutes"]), float("nan"), float("nan"))
        write_next([more], ("more", "the same"), run.protocol_text, run.reed, same)
    after, repeated = (
        probability_of_truth(sealed, _with_more(sealed, first, campaign, folder))
        for campaign in (proposed, same)
    )
    return Worth(best["id"], best["minutes"], before, after, repeated)


def _experiment(name: str) -> Experiment:
    return next(each for each in EXPERIMENTS if each.id == name)


def _with_more(sealed: SealedCase, first: Path, campaign: Path, folder: Path) -> dict[str, Any]:
    """Return the answer with a further campaign."""
    runs = folder / campaign.stem
    if not runs.exists():
        recorded(runs, sealed.case, repeat=1, campaign=load_campaign(campaign))
    return diagnosed(folder / f"{campaign.stem}.json", [first, runs])


def main() -> None:
    """Print what each case gained, and the means."""
    asked, cases, answers = asked_set(__doc__.splitlines()[0], 10)
    names = list(unsure(cases, answers))[: asked.count]
    campaigns, folders = ([place / name for name in names] for place in (asked.cases, asked.folder))
    found = []
    with ProcessPoolExecutor(asked.jobs) as pool:
        worths = pool.map(worth_of, [cases[name] for name in names], campaigns, folders)
        for name, worth in zip(names, worths, strict=True):
            true = "+".join(each.id for each in cases[name].case.effects)
            print(f"{name}  {cases[name].level:9s}{true:40s} {_said(worth)}", flush=True)
            if worth.after is not None and worth.repeated is not None:
                found.append((worth.before, worth.after, worth.repeated))
    if found:
        before, after, repeated = np.mean(found, axis=0)
        print(
            f"mean probability of the truth in {len(found)} cases: before {before:.2f}, with what "
            f"was proposed {after:.2f}, with more of the same {repeated:.2f}"
        )


def _said(worth: Worth) -> str:
    begun = f"{worth.experiment} ({worth.minutes:g} min): truth {worth.before:.2f}"
    if worth.after is None or worth.repeated is None:
        return f"{begun}; this laboratory has no hands for it"
    return f"{begun} → {worth.after:.2f}; with more of the same {worth.repeated:.2f}"


if __name__ == "__main__":
    main()
