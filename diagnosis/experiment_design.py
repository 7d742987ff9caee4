"""Experiments that separate two candidates, or show an effect that a campaign cannot show."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.effect_scan import locations_of
from diagnosis.inference.estimation import posterior_covariance
from diagnosis.inference.problem import InferenceProblem
from diagnosis.inference.similarity import DETECTION_SIGMA, Detectability
from diagnosis.observable_groups import ObservableGroup
from physics.alterations import TipMass
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError
from physics.parameters.chamber import Filling
from physics.parameters.tree import BenchParameters, more, with_alteration, with_part


@dataclass(frozen=True)
class Experiment:
    """One experiment: something to do, and groups of observables to measure again.

    Attributes
    ----------
    id, description : str
    minutes : float
        Bench time: 75 s for each sweep (`acquire plan campaign`), and handling.
    groups : tuple of str
        Names of the groups of observables that it measures again.
    change : callable
        ``change(parameters)`` returns the model of the bench during the experiment.
    sd_factor : float
        Factor on the standard deviations of the noise of these observables.
    campaign_parts : tuple of mapping
        Parts of a campaign file (see `protocols.campaign`); empty if software cannot run it.
    possible : callable
        ``possible(parameters)``: whether it can be done on a bench.
    """

    id: str
    description: str
    minutes: float
    groups: tuple[str, ...]
    change: Callable[[BenchParameters], BenchParameters]
    sd_factor: float = 1.0
    campaign_parts: tuple[Mapping[str, Any], ...] = ()
    possible: Callable[[BenchParameters], bool] = lambda _parameters: True


@dataclass(frozen=True)
class RankedExperiment:
    """An experiment and the information expected from it.

    Attributes
    ----------
    experiment : Experiment
    expected_nats : float
        Expected gain of log odds between the two candidates.
    nats_per_minute : float
    """

    experiment: Experiment
    expected_nats: float
    nats_per_minute: float


def _same(parameters: BenchParameters) -> BenchParameters:
    return parameters


def _in_vacuum(parameters: BenchParameters) -> BenchParameters:
    return with_part(parameters, "reed", air_share=0.0)


def _with_wax(parameters: BenchParameters) -> BenchParameters:
    return with_alteration(parameters, TipMass(), 1e-6)


def _after_an_hour(parameters: BenchParameters) -> BenchParameters:
    return more(parameters, "environment", begun_h=1.0)


def _without_clay(parameters: BenchParameters) -> BenchParameters:
    return with_part(parameters, "chamber", leak=1.0)


_SWEEP: Final = ("modes", "lines of the drive", "forces", "level", "brightness", "noise", "fringes")
_STILL: Final = ("light at rest", "still light", "scatter of phases")
_FRAMES: Final = ("dark frames", "even light", "local oscillator")
_LADDER: Final = ("20 ms", "40 ms", "60 ms", "80 ms")


def _frames(kind: str, count: int, exposures: Sequence[str] = ()) -> dict[str, Any]:
    """Return the changes of a sweep's protocol that record calibration frames."""
    calibration: dict[str, Any] = {"kind": kind, "count": count}
    if exposures:
        calibration["exposures"] = list(exposures)
    return {"keep": "frames", "calibration": calibration}


def _part(name: str, do: str = "", **more: Any) -> dict[str, Any]:
    return {"name": name, **({"do": do} if do else {}), **more}


EXPERIMENTS: Final[tuple[Experiment, ...]] = (
    Experiment(
        "repeat",
        "repeat the sweeps",
        10.0,
        (*_SWEEP, "lock", "frames"),
        _same,
        campaign_parts=(
            _part("up2"),
            _part("down2", change={"sweep.direction": "down"}),
            _part("shuffled2", change={"sweep.direction": "shuffled"}),
            _part(
                "again2",
                "take the reed out of its clamp, and put it back as it was",
                new_clamping=True,
            ),
        ),
    ),
    Experiment(
        "low_pressure",
        "sweep in a vacuum chamber",
        40.0,
        ("modes",),
        _in_vacuum,
        campaign_parts=(
            _part("vacuum", "put the mouthpiece into the vacuum chamber, and pump it out"),
        ),
    ),
    Experiment(
        "known_mass",
        "sweep with 1 mg of wax on the tip",
        10.0,
        ("modes",),
        _with_wax,
        campaign_parts=(_part("wax", "stick 1 mg of wax to the middle of the tip"),),
    ),
    Experiment(
        "wait",
        "repeat the sweeps after an hour",
        65.0,
        ("modes",),
        _after_an_hour,
        campaign_parts=(
            _part("later", "wait an hour, and touch nothing"),
            _part("later_down", change={"sweep.direction": "down"}),
        ),
    ),
    Experiment(
        "without_clay",
        "sweep with both halves of the chamber open",
        10.0,
        ("forces", "lines of the drive"),
        _without_clay,
        campaign_parts=(
            _part("open", "take the filling out of the chamber", change={"chamber": "symmetric"}),
        ),
        possible=lambda parameters: parameters.chamber.filling is Filling.ASYMMETRIC,
    ),
    Experiment(
        "long_rest",
        "record the reed at rest (sideband 0), 64 acquisitions",
        2.0,
        _STILL,
        _same,
        0.25,
        campaign_parts=(
            _part("long_rest", "let both beams through", change=_frames("order0", 64)),
        ),
    ),
    Experiment(
        "more_frames",
        "record dark, flat and local oscillator frames, 64 of each",
        3.0,
        _FRAMES,
        _same,
        0.5,
        campaign_parts=(
            _part("dark2", "cover the camera", change=_frames("dark", 64)),
            _part(
                "flat2",
                "uncover the camera, block both beams, and light it evenly with a lamp",
                change=_frames("flat", 16, _LADDER),
            ),
            _part(
                "lo2",
                "lamp off; let the local oscillator through, and block the object beam",
                change=_frames("lo_only", 16, _LADDER),
            ),
        ),
    ),
    Experiment(
        "microphone",
        "measure the sound at the tip with a microphone, with the reed held",
        15.0,
        ("lines of the drive", "level"),
        _same,
        0.3,
    ),
)


# Measurements that would change the log odds by less, in nats, decide nothing: 0.05 nats change
# even odds from 50 to 51 %.
LEAST_NATS: Final = 0.05


def rank_experiments(
    problem: InferenceProblem,
    one: Candidate,
    other: Candidate,
    experiments: Sequence[Experiment] = EXPERIMENTS,
) -> list[RankedExperiment]:
    """Rank experiments by the information per minute that they are expected to give.

    Parameters
    ----------
    problem : InferenceProblem
    one, other : Candidate
    """
    models = one.parameters(problem), other.parameters(problem)
    worths = _worths(problem, one, models, experiments)
    return sorted(worths, key=lambda worth: -worth.nats_per_minute)


def _worths(
    problem: InferenceProblem,
    candidate: Candidate,
    models: tuple[BenchParameters, BenchParameters],
    experiments: Sequence[Experiment],
) -> Iterator[RankedExperiment]:
    """Yield what experiments are worth that can be done, measure something and leave a reed."""
    by_name = {block.name: block for block in problem.groups}
    for action in experiments:
        chosen = [by_name[name] for name in action.groups if name in by_name]
        if not chosen or not action.possible(models[0]):
            continue
        with contextlib.suppress(ImpossibleReedError):
            nats = sum(
                _expected_nats(problem, block, candidate, models, action) for block in chosen
            )
            yield RankedExperiment(action, nats, nats / action.minutes)


@dataclass(frozen=True)
class Unseen:
    """An effect that a campaign could not show at any size, and what it would take to show it.

    Attributes
    ----------
    effect : str
    deviations : float
        By how many standard deviations it would show in the campaign, at its largest size.
    experiment : Experiment or None
        What shows it soonest; None if nothing that is known here does.
    times : int
        How often; 0 without an experiment.
    """

    effect: str
    deviations: float
    experiment: Experiment | None
    times: int

    @property
    def minutes(self) -> float:
        """Bench time; 0 without an experiment."""
        return self.times * self.experiment.minutes if self.experiment else 0.0


def unseen_effects(
    problem: InferenceProblem,
    null: Candidate,
    effects: Sequence[Effect],
    reach: Sequence[Detectability],
    experiments: Sequence[Experiment] = EXPERIMENTS,
) -> list[Unseen]:
    """Return effects that would not show at their largest sizes, and what would show them.

    Parameters
    ----------
    problem : InferenceProblem
    null : Candidate
        Without effects.
    effects : sequence of Effect
    reach : sequence of Detectability
        How well the campaign detects each of them.
    """
    found = []
    for effect, own in zip(effects, reach, strict=True):
        deviations = max(
            (DETECTION_SIGMA * size.most / own.detectable[size.name]
             for size in effect.sizes if size.most), default=0.0,
        )  # fmt: skip
        if deviations < DETECTION_SIGMA:
            experiment, times = _soonest(problem, null, effect, experiments)
            found.append(Unseen(effect.id, deviations, experiment, times))
    return found


def _soonest(
    problem: InferenceProblem, null: Candidate, effect: Effect, experiments: Sequence[Experiment]
) -> tuple[Experiment | None, int]:
    """Return the experiment that shows an effect of the largest size soonest, and how often."""
    bare, places = null.parameters(problem), list(locations_of(effect))
    located, best, times = places[len(places) // 2], None, 0
    for number, size in enumerate(effect.sizes):
        if not size.most:
            continue
        sizes = np.zeros(len(effect.sizes))
        sizes[number] = size.most / size.scale
        with contextlib.suppress(ImpossibleReedError):
            models = bare, located.change(bare, sizes)
            for worth in _worths(problem, null, models, experiments):
                if worth.expected_nats < LEAST_NATS:
                    continue
                often = math.ceil(DETECTION_SIGMA**2 / 2 / worth.expected_nats)
                minutes = often * worth.experiment.minutes
                if best is None or minutes < times * best.minutes:
                    best, times = worth.experiment, often
    return best, times


def _expected_nats(
    problem: InferenceProblem,
    block: ObservableGroup,
    candidate: Candidate,
    models: tuple[BenchParameters, BenchParameters],
    action: Experiment,
) -> float:
    """Return the expected log odds: half the squared distance of two predictions, whitened.

    What the numbers of a group have in common apart from noise, such as the gain of the camera, is
    the same in the experiment. It is known as well as the campaign shows it, by either model.
    """
    measured, apart = (
        block.predict(change(models[0])) - block.predict(change(models[1]))
        for change in (_same, action.change)
    )
    noise = block.errors.covariance()
    common = block.covariance - noise
    # Gain of a Kalman filter: what the campaign has shown of what is common.
    known = np.linalg.solve(block.covariance, common).T
    apart = apart - known @ measured
    piece = problem.slices[block.name]
    J = candidate.free_jacobian
    slope = np.linalg.inv(block.whitening) @ (candidate.deviation[piece][:, None] * J[piece])
    variance = action.sd_factor**2 * noise + common - known @ common
    variance += slope @ posterior_covariance(J) @ slope.T
    return 0.5 * float(apart @ np.linalg.solve(variance, apart))
