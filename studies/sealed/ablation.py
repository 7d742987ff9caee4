"""What each part of the errors is worth: benches with nothing wrong, diagnosed without it.

    python -m studies.sealed.ablation FOLDER [--amount 1] [--each N] [--jobs N]

Records N benches of the second laboratory with nothing wrong, with a multiple of the ordinary
disorder. Each is diagnosed as it is, and again without each part of what may differ between model
and bench although nothing is wrong. What then raises alarms is needed. FOLDER keeps the campaigns,
and may be that of `studies.sealed.disorder_curve`.
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from blind.scoring import NONE, share
from diagnosis.campaign import Campaign
from diagnosis.campaign_diagnosis import CampaignSummary, diagnose_problem, inference_problem
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import ObservableGroup, observable_group
from diagnosis.observe import read
from fitting.known_bench import bench_of
from holography.reconstruction import Reconstruction
from physics.mechanics import ReedSolver
from physics.reed.reduced.stored import reduced_reed
from runs.reader import Run
from studies.sealed.disorder_curve import CleanBench

# Standard deviation of the log of a factor on errors that count as known. Chosen: a per cent.
_CERTAIN = 0.01


@dataclass(frozen=True)
class Ablation:
    """A part of the errors that is left out.

    Attributes
    ----------
    name : str
        What is assumed without it.
    groups : frozenset of str
        Observables that are left out, by the name of their group.
    nuisances : frozenset of str
        Nuisances that are left out: of groups by name, of the bench by name or family.
    certain : bool
        Whether standard errors count as known.
    with_lobes : bool
        Whether noise is measured without a window, with side lobes of the reed's light.
    """

    name: str
    groups: frozenset[str] = frozenset()
    nuisances: frozenset[str] = frozenset()
    certain: bool = False
    with_lobes: bool = False

    def of(self, problem: InferenceProblem) -> InferenceProblem:
        """Return an inference problem without this part.

        Raises
        ------
        LookupError
            If the problem does not have all of it: nothing would be shown without it.
        """
        if missing := (self.groups | self.nuisances) - _names_in(problem):
            raise LookupError(f"{self.name}: the campaign has no {', '.join(sorted(missing))}")
        groups = [self._of_group(each) for each in problem.groups if each.name not in self.groups]
        count = len(problem.nuisances) - sum(len(each.uncertain) for each in problem.known)
        kept = [
            each
            for each in problem.nuisances[:count]
            if not {each.name, each.family} & self.nuisances
        ]
        return InferenceProblem(groups, problem.base, kept, problem.known)

    def _of_group(self, group: ObservableGroup) -> ObservableGroup:
        errors = group.errors
        kept = [each for each in errors.nuisances if each.name not in self.nuisances]
        if self.certain:
            kept = [replace(each, freedom=_CERTAIN) for each in kept]
            errors = replace(errors, noise_freedom=_CERTAIN)
        return observable_group(
            group.name,
            group.tap,
            group.values,
            replace(errors, nuisances=tuple(kept)),
            group.coordinates,
            group.parts,
            group.predict,
        )


def _names_in(problem: InferenceProblem) -> set[str]:
    """Names of all groups of observables, and names and families of all nuisances."""
    of_groups = {one.name for group in problem.groups for one in group.errors.nuisances}
    of_bench = {name for one in problem.nuisances for name in (one.name, one.family)}
    return {group.name for group in problem.groups} | of_groups | of_bench


WHOLE: Final = Ablation("as it is")
ABLATIONS: Final = (
    WHOLE,
    Ablation("noise is measured with side lobes of the reed's light", with_lobes=True),
    Ablation(
        "camera, lamp and beam are as in their data sheets",
        nuisances=frozenset(
            {
                "black level",
                "noise of the camera",
                "hot pixels of the camera",
                "noise in common",
                "drift of the lamp",
                "bend",
                "pattern of the camera",
                "gain of the camera",
                "evenness of the lamp",
                "placement of the beam",
            }
        ),
    ),
    Ablation(
        "light changes by nothing but what is seen at rest",
        nuisances=frozenset(
            {
                "light of sweeps",
                "changing field",
                "locally changing field",
                "noise of sweeps",
                "laser power",
            }
        ),
    ),
    Ablation(
        "fits have no error in common, and clampings none of their own",
        nuisances=frozenset({"fit", "temperature of sweeps", "clamping"}),
    ),
    Ablation(
        "pressure and air are as computed",
        nuisances=frozenset({"pressure on the reed", "bypass", "air"}),
    ),
    Ablation(
        "the drive responds smoothly",
        nuisances=frozenset({"response of the loudspeaker", "resonances of the loudspeaker"}),
    ),
    Ablation(
        "reed and clamp are those of the drawing",
        nuisances=frozenset(
            {
                "detail of the reed",
                "thickness that is fine, or uneven across",
                "motion near the clamp",
                "thickness",
                "constants of cane",
                "density",
                "clamp",
                "clamp_shift",
            }
        ),
    ),
    Ablation("standard errors are known exactly", certain=True),
    Ablation("flat frames are not used", groups=frozenset({"even light"})),
)


@dataclass(frozen=True)
class Verdict:
    """What is said of one campaign.

    Attributes
    ----------
    kind : str
    effects : tuple of str
    none : float
        Probability that nothing is wrong, where what would not show counts as nothing.
    """

    kind: str
    effects: tuple[str, ...]
    none: float

    def __str__(self) -> str:
        """Say it in a few words."""
        return "+".join(self.effects) or self.kind


def verdicts(
    bench: CleanBench, folder: Path, ablations: Sequence[Ablation] = ABLATIONS
) -> list[Verdict]:
    """Diagnose one bench without each part of the errors.

    Parameters
    ----------
    bench : CleanBench
    folder : Path
        Where its campaigns are, or are recorded.
    ablations : sequence of Ablation, optional
    """
    # The recorder measures the noise of holograms.
    problems = {False: _problem(bench.recorded_in(folder / "campaigns"))}
    if any(each.with_lobes for each in ablations):
        with _side_lobes():
            problems[True] = _problem(bench.recorded_in(folder / "with side lobes"))
    return [_verdict(each.of(problems[each.with_lobes])) for each in ablations]


def _problem(campaign: Path) -> InferenceProblem:
    with ExitStack() as opened:
        runs = [opened.enter_context(Run.open(file)) for file in sorted(campaign.glob("*.h5"))]
        parts = Campaign.of(runs)
        first = parts.sweeps[0].run
        solver = ReedSolver(reduced_reed(first.reed_file().geometry()))
        readings = read(parts, bench_of(first))
        return inference_problem(readings, solver, readings.nominal)


def _verdict(problem: InferenceProblem) -> Verdict:
    found = diagnose_problem(problem, CampaignSummary())
    none = found.probability_of_what_shows.get(NONE, 0.0)
    return Verdict(str(found.kind), found.effects, none)


@contextmanager
def _side_lobes() -> Iterator[None]:
    """Measure noise next to the reed without the window that removes side lobes of its light."""

    def only_noise(
        plan: Reconstruction, image: npt.NDArray[np.complex64]
    ) -> npt.NDArray[np.complex64]:
        empty = plan.empty
        rows = slice(empty.row, empty.row + empty.height)
        return image[..., rows, empty.column : empty.column + empty.width]

    pixels = property(lambda plan: float(plan.empty.height * plan.empty.width))
    with (
        patch.object(Reconstruction, "only_noise", only_noise),
        patch.object(Reconstruction, "independent_noise", pixels),
    ):
        yield


def line(ablation: Ablation, found: Sequence[Verdict]) -> str:
    """Return one line of the table."""
    alarms = share([str(each) != NONE for each in found])
    mean = sum(each.none for each in found) / len(found)
    said = ", ".join(map(str, found))
    return (
        f"{ablation.name}: {alarms.hits} of {alarms.cases} false alarms, "
        f"mean probability of none {mean:.2f} ({said})"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--amount", type=float, default=1.0)
    parser.add_argument("--each", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    benches = [CleanBench(asked.amount, number) for number in range(asked.each)]
    with ProcessPoolExecutor(asked.jobs) as pool:
        of_benches = list(pool.map(verdicts, benches, [asked.folder] * len(benches)))
    for ablation, found in zip(ABLATIONS, zip(*of_benches, strict=True), strict=True):
        print(line(ablation, found))


if __name__ == "__main__":
    main()
