"""The runs of a campaign in the order in which they were measured, and which are missing."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from fitting.errors import FitInputError
from runs.layout import RunKind
from runs.reader import Run
from runs.records import StepRecord
from runs.verdict import Verdict

# What only this kind of run shows.
_SHOWS = {
    RunKind.DARK: "dark frames (offset, read noise, hot pixels)",
    RunKind.FLAT: "flat frames (linearity, pattern, vignetting)",
    RunKind.LO_ONLY: "frames of the local oscillator alone (its profile)",
    RunKind.ORDER0: "the reed at rest, sideband 0 (phase steps, speckle, stability)",
}


@dataclass(frozen=True)
class CampaignRun:
    """One run of a campaign.

    Attributes
    ----------
    run : Run
    began_s : float
        Since the first run of the campaign began.
    clock_s : float
        What the camera's clock shows when the campaign's shows 0.
    name : str
        Of the part, or of the file where there is none; with a number if it is another's too.
    clamping : int
        How often the reed had been clamped again before; another campaign counts as once more.
    """

    run: Run
    began_s: float
    clock_s: float
    name: str
    clamping: int

    @property
    def good_steps(self) -> list[StepRecord]:
        """Acquisitions with nothing wrong."""
        return [step for step in self.run.steps if step.verdict is Verdict.OK]


@dataclass(frozen=True)
class Campaign:
    """Runs of one reed on one bench.

    Attributes
    ----------
    parts : tuple of CampaignRun
        In the order of time.
    """

    parts: tuple[CampaignRun, ...]

    @classmethod
    def of(cls, runs: Sequence[Run]) -> "Campaign":
        """Put runs in order.

        Raises
        ------
        FitInputError
            If none is a sweep, one is named twice, they are not of one reed on one bench, or the
            start of one is unknown.
        """
        sweeps = [run for run in runs if run.acquisition.kind is RunKind.SWEEP]
        if not sweeps:
            names = ", ".join(sorted(run.path.name for run in runs))
            raise FitInputError(f"{names}: no run is a sweep of a driven reed; name at least one")
        _require_one(runs)
        runs = sorted(runs, key=_began)
        first = _began(runs[0])
        before = _clampings_before(runs)
        parts = [
            CampaignRun(
                run,
                (_began(run) - first).total_seconds(),
                _clock_s(run, first),
                _name(run),
                before[run.acquisition.campaign] + run.acquisition.clamping,
            )
            for run in runs
        ]
        return cls(_each_once(parts))

    def of_kind(self, kind: RunKind) -> tuple[CampaignRun, ...]:
        """All runs of a kind; of those of the reed at rest or of no reed, with anything in them."""
        return tuple(
            part
            for part in self.parts
            if part.run.acquisition.kind is kind
            and (kind is RunKind.SWEEP or any(step.verdict.measured for step in part.run.steps))
        )

    @property
    def sweeps(self) -> tuple[CampaignRun, ...]:
        """Sweeps of the driven reed."""
        return self.of_kind(RunKind.SWEEP)

    @property
    def missing(self) -> list[str]:
        """Runs that are missing, and what they would show."""
        lacks = [shows for kind, shows in _SHOWS.items() if not self.of_kind(kind)]
        sweeps = self.sweeps
        if len(sweeps) < 2:
            lacks.append("a second sweep (what repeats and what drifts)")
        loudest = [max((step.volts for step in part.run.steps), default=0.0) for part in sweeps]
        if max(loudest) < 1.2 * min(loudest):
            lacks.append("a sweep at another drive level (what depends on amplitude)")
        if not any(part.clamping for part in sweeps):
            lacks.append("a sweep after a new clamping (what the clamp does)")
        errors = [step.lock_error_se_hz for part in sweeps for step in part.good_steps]
        if not np.isfinite(errors).any():
            lacks.append(
                "lock errors of the steps (frequency errors, phase drift): no run file has any"
            )
        return lacks


def _require_one(runs: Sequence[Run]) -> None:
    """Require runs that belong together."""
    uids = Counter(run.uid for run in runs if run.uid)
    if twice := [run.path.name for run in runs if uids[run.uid] > 1]:
        raise FitInputError(f"{', '.join(twice)}: are the same run; name it once")
    of: dict[str, Callable[[Run], str]] = {
        "reeds or series": lambda run: f"{run.reed} ({run.series})",
        "kinds of reed": lambda run: run.reed_sha256[:8],
        "fillings of the chamber": lambda run: run.chamber,
        "wavelengths and distances": _optics,
        "sizes of frames": lambda run: " x ".join(f"{n}" for n in run.frame_shape),
        # Brightness and noise of light from the reed are compared between runs.
        "exposures or frame rates": _exposure,
    }
    for what, label in of.items():
        labels = sorted({label(run) for run in runs} - {""})
        if len(labels) > 1:
            raise FitInputError(
                f"runs are of several {what}: {', '.join(labels)}; diagnose them one by one"
            )
    parts = Counter((run.acquisition.campaign, run.acquisition.part) for run in runs)
    if again := [which for which, count in parts.items() if all(which) and count > 1]:
        campaign, part = again[0]
        raise FitInputError(
            f"part {part} of campaign {campaign} is there {parts[again[0]]} times; name the runs "
            "of one recording"
        )


def _clampings_before(runs: Sequence[Run]) -> dict[str, int]:
    """How often the reed had been clamped when each campaign began, of runs in order of time."""
    before: dict[str, int] = {}
    after = 0
    for campaign in dict.fromkeys(run.acquisition.campaign for run in runs):
        before[campaign] = after
        own = [r.acquisition.clamping for r in runs if r.acquisition.campaign == campaign]
        after += max(own) + 1
    return before


def _optics(run: Run) -> str:
    transform = run.reconstruction.transform
    return f"{1e9 * transform.wavelength_m:.6g} nm at {transform.distance_m:.6g} m"


def _exposure(run: Run) -> str:
    """Return exposure and frame rate of a run with light from the reed; else an empty text."""
    if run.acquisition.kind not in (RunKind.SWEEP, RunKind.ORDER0):
        return ""
    measured = [step for step in run.steps if step.verdict.measured]
    # Cameras keep an exposure to half a per cent.
    each = sorted({f"{1e3 * run.exposure_of(step):.3g} ms" for step in measured})
    if not each:
        return ""
    return f"{' and '.join(each)} at {float(run.frame_rate_hz):.6g} Hz"


def _name(run: Run) -> str:
    return run.acquisition.part or run.path.stem


def _each_once(parts: Sequence[CampaignRun]) -> tuple[CampaignRun, ...]:
    """Parts with names of their own: the second of a name gets -2, and so on."""
    named: dict[str, CampaignRun] = {}
    for part in parts:
        name, number = part.name, 1
        while name in named:
            number += 1
            name = f"{part.name}-{number}"
        named[name] = replace(part, name=name)
    return tuple(named.values())


def _began(run: Run) -> datetime:
    """When a run began; without a zone it is taken for UTC."""
    try:
        began = datetime.fromisoformat(run.start_time)
    except ValueError:
        raise FitInputError(
            f"{run.path}: start_time is {run.start_time!r}, which is no time; write one as in "
            "2026-01-01T10:00:00+00:00"
        ) from None
    return began if began.tzinfo else began.replace(tzinfo=UTC)


def _clock_s(run: Run, first: datetime) -> float:
    """Return the offset of the camera's clock, whose zero is arbitrary."""
    times = [t for step in run.steps for t in step.timestamps_s[:1] if np.isfinite(t)]
    return min(times, default=0.0) - (_began(run) - first).total_seconds()
