"""Results of diagnoses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.results.base import Result, label_axes, new_axes
from diagnosis.campaign_diagnosis import Diagnosis
from diagnosis.resonance_diagnosis import ResonanceDiagnosis
from protocols.yaml_files.insertion import Entry
from reports.diagnosis_json import to_json as verdict_to_json
from reports.plain_text import visible
from reports.resonance_diagnosis import to_json as resonances_to_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class DiagnosisResult(Result):
    """Where the runs of a campaign differ from the simulation, and the probability of each cause.

    Attributes
    ----------
    verdict : Diagnosis
        With everything that the diagnosis found.
    runs : tuple of Path
        Run files that were used.
    reed : str
    adopted : dict
        What was written into the bench file: sizes by the identifier of each effect.
    """

    verdict: Diagnosis
    runs: tuple[Path, ...]
    reed: str
    adopted: dict[str, Entry] = field(default_factory=dict)

    @property
    def probability(self) -> dict[str, float]:
        """Probability of every cause, the likeliest first."""
        return dict(sorted(self.verdict.probability.items(), key=lambda item: -item[1]))

    @property
    def title(self) -> str:
        """One line that says what this is."""
        return f"Diagnosis of {self.reed}"

    def __repr__(self) -> str:
        name, likeliest = next(iter(self.probability.items()))
        said = f"{self.title}: {self.verdict.kind}; {name} {likeliest:.0%}"
        return f"<DiagnosisResult: {visible(said)}>"

    def rows(self) -> list[dict[str, Any]]:
        """Return the probability of every cause."""
        return [{"cause": name, "probability": p} for name, p in self.probability.items()]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire diagnose --json`` prints."""
        adopted = {name: dict(entry) for name, entry in self.adopted.items()}
        return {**verdict_to_json(self.verdict), "adopted": adopted}

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the probabilities of the eight likeliest causes."""
        axes, shown = new_axes(ax), list(self.probability.items())[:8]
        axes.barh([name for name, _ in shown], [p for _, p in shown])
        axes.invert_yaxis()
        label_axes(axes, self.title, "probability")
        axes.set_xlim(0, 1)
        return axes


@dataclass(frozen=True, repr=False)
class ResonanceDiagnosisResult(Result):
    """How resonances differ from the elastic model, and how much each cause explains.

    Attributes
    ----------
    diagnosis : ResonanceDiagnosis
    """

    diagnosis: ResonanceDiagnosis

    @property
    def title(self) -> str:
        """One line that says what this is."""
        rms = ", ".join(
            f"{series} {value:.0f} cents"
            for series, value in self.diagnosis.elastic.rms_cents.items()
        )
        return f"Diagnosis of resonances: gap to the elastic model, rms {rms}"

    def rows(self) -> list[dict[str, Any]]:
        """Return log odds and the rms gap that is left with each cause, in cents."""
        trials = (*self.diagnosis.single, *self.diagnosis.together)
        return [
            {"cause": "+".join(trial.effects), "log_odds_nats": trial.log_bayes}
            | {f"rms_{series}_cents": left for series, left in trial.rms_cents.items()}
            for trial in trials
        ]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire diagnose TABLE --json`` prints."""
        return resonances_to_json(self.diagnosis)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the log odds of every cause against the elastic model."""
        axes, rows = new_axes(ax), self.rows()
        axes.barh([row["cause"] for row in rows], [row["log_odds_nats"] for row in rows])
        axes.invert_yaxis()
        label_axes(axes, self.title, "log odds (nats)")
        return axes
