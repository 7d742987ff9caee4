"""Results of fits: resonances, cane, modes and populations."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.errors import UsageError
from acquire.results.base import Result, label_axes, new_axes
from fitting.acoustics.lines import AcousticLine, Verdict
from fitting.amplitudes.response import Peak
from fitting.cane.reed_fit import ReedParameters
from fitting.cane.sweep_fit import ReedFit, SweepFit
from fitting.populations.acoustic_lines import MeasuredLines
from fitting.populations.table import Measured, PopulationSummary
from fitting.reed_modes import BASIS, mesh_level, modes_to_json
from fitting.resonance import Resonance
from physics.reed.modes import NamedMode
from protocols.reed import ReedFile

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class FitResult(Result):
    """Resonances of one or two runs of a reed, and the material parameters that fit them.

    Attributes
    ----------
    fit : ReedFit
        With everything that the fit found.
    """

    fit: ReedFit

    @property
    def sweeps(self) -> tuple[SweepFit, ...]:
        """What was found in each run."""
        return self.fit.sweeps

    @property
    def resonances(self) -> Mapping[str, Resonance]:
        """Resonances of the first run, by the name of the mode."""
        return self.fit.sweeps[0].resonances

    @property
    def amplitude_nm(self) -> dict[str, float | None]:
        """Displacement of each mode of the first run at resonance, where it moves most, in nm.

        It is measured from rest to the largest deflection, half of peak to peak.
        """
        return {name: found.amplitude_nm for name, found in self.resonances.items()}

    @property
    def amplitude_error_nm(self) -> dict[str, float | None]:
        """Standard errors of `amplitude_nm`; None with the method of the paper."""
        return {name: found.amplitude_error_nm for name, found in self.resonances.items()}

    @property
    def peak(self) -> Peak | None:
        """Largest displacement of the reed in the first run, and where it is."""
        return self.fit.sweeps[0].response.largest

    @property
    def parameters(self) -> ReedParameters | None:
        """Material parameters with errors; None if the resonances do not determine them."""
        return self.fit.parameters

    @property
    def title(self) -> str:
        """One line that says what this is."""
        found = ", ".join(f"{len(sweep.resonances)} in {sweep.series}" for sweep in self.sweeps)
        state = "cane fitted" if self.parameters else f"no parameters: {self.fit.reason}"
        return f"reed {self.sweeps[0].reed}: resonances {found}; {state}"

    def rows(self) -> list[dict[str, Any]]:
        """Return frequency, loss factor and amplitude of every resonance of every run.

        A mode whose name is not sure has a question mark after its name.
        """
        return [
            {
                "series": sweep.series,
                "mode": name,
                "frequency_hz": found.frequency_hz,
                "error_cents": found.error_cents,
                "loss_factor": found.loss_factor,
                "amplitude_nm": found.amplitude_nm,
                "amplitude_error_nm": found.amplitude_error_nm,
                "step_index": found.step_index,
            }
            for sweep in self.sweeps
            for name, found in sweep.measured.items()
        ]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire fit --json`` prints."""
        return self.fit.to_json()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the response of each mode against frequency, with its resonance named."""
        from reports.figures.drawing import draw_response

        axes = new_axes(ax)
        sweep = self.sweeps[0]
        draw_response(axes, sweep, [seen.peak.hz for seen in sweep.excitation_peaks])
        return axes


@dataclass(frozen=True, repr=False)
class AcousticsResult(Result):
    """Acoustic resonances of a bench, from the runs of several reeds.

    Attributes
    ----------
    measured : MeasuredLines
    """

    measured: MeasuredLines

    @property
    def lines(self) -> tuple[AcousticLine, ...]:
        """All lines, in order of frequency, with what they belong to."""
        return self.measured.lines

    @property
    def title(self) -> str:
        """One line that says what this is."""
        of_bench = sum(line.verdict is Verdict.BENCH for line in self.lines)
        return (
            f"{self.measured.reeds} reeds, {len(self.lines)} lines, {of_bench} of them of the bench"
        )

    def rows(self) -> list[dict[str, Any]]:
        """Return frequency, quality factor, height and verdict of every line."""
        return [
            {key: value for key, value in line.to_json().items() if key != "seen"}
            for line in self.lines
        ]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire acoustics --json`` prints."""
        return self.measured.to_json()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the height of every line against its frequency."""
        axes = new_axes(ax)
        for verdict in Verdict:
            own = [line for line in self.lines if line.verdict is verdict]
            if own:
                hz, errors = ([getattr(line, key) for line in own] for key in ("hz", "error_hz"))
                heights = [line.height_db for line in own]
                axes.errorbar(hz, heights, xerr=errors, fmt="o", label=str(verdict))
        label_axes(axes, self.title, "frequency (Hz)", "height (dB)")
        if self.lines:
            axes.legend()
        return axes


@dataclass(frozen=True, repr=False)
class ModesResult(Result):
    """Modes of a reed below 20 kHz.

    Attributes
    ----------
    reed : ReedFile
        With the changes that were asked for.
    modes : tuple of NamedMode
        Ascending in frequency.
    mesh : str
        Mesh that they were computed with.
    """

    reed: ReedFile
    modes: tuple[NamedMode, ...]
    mesh: str

    @property
    def title(self) -> str:
        """One line that says what this is."""
        return f"{self.reed.name}: {len(self.modes)} modes, mesh {self.mesh}"

    def rows(self) -> list[dict[str, Any]]:
        """Return name, frequency, class and symmetry of every mode."""
        return [
            {
                "mode": mode.name,
                "frequency_hz": mode.frequency_hz,
                "class": str(mode.klass),
                "symmetry": str(mode.symmetry),
            }
            for mode in self.modes
        ]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire modes --json`` prints."""
        return modes_to_json(self.reed, self.modes)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the frequencies of the modes, one row for each class."""
        axes = new_axes(ax)
        for klass in sorted({str(mode.klass) for mode in self.modes}):
            own = [mode for mode in self.modes if str(mode.klass) == klass]
            axes.plot([mode.frequency_hz for mode in own], [klass] * len(own), "|", markersize=20)
            for mode in own:
                place = (mode.frequency_hz, klass)
                axes.annotate(mode.name, place, (0, 12), textcoords="offset points", ha="center")
        label_axes(axes, self.title, "frequency (Hz)", "class")
        axes.set_xscale("log")
        return axes

    def write_pictures(self, path: str | Path) -> None:
        """Write a PNG file with a picture of every mode.

        Raises
        ------
        UsageError
            If the modes come from a reduced basis, which has no shapes.
        OutputRefusedError, OutputFailedError
            If the file must not or cannot be written.
        """
        from reports.figures.mode_pictures import write_mode_sheet

        if self.mesh == BASIS:
            raise UsageError("pictures: a basis has no shapes to draw; use the mesh fine")
        write_mode_sheet(self.reed, mesh_level(self.mesh), self.modes, Path(path))


@dataclass(frozen=True, repr=False)
class PopulationResult(Result):
    """Material parameters of many reeds.

    Attributes
    ----------
    summary : PopulationSummary
    measured : Measured or None
        Resonances of the run files, if the source was a folder.
    components : Path
        CSV table of the parameters of every reed.
    resonances : Path or None
        CSV table of the resonances of a folder's runs.
    """

    summary: PopulationSummary
    measured: Measured | None
    components: Path
    resonances: Path | None

    @property
    def title(self) -> str:
        """One line that says what this is."""
        return f"{self.summary.reeds} reeds, {self.summary.resonances} resonances"

    @property
    def files(self) -> dict[str, Path]:
        """Tables that were written, by name."""
        written = {"resonances": self.resonances, "components": self.components}
        return {name: path for name, path in written.items() if path is not None}

    def rows(self) -> list[dict[str, Any]]:
        """Return components with errors (in standard deviations) and misfit of every reed."""
        with self.components.open(encoding="utf-8", newline="") as file:
            return [
                {key: _number(text) for key, text in row.items()} for row in csv.DictReader(file)
            ]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire population --json`` prints."""
        answer = self.summary.to_json() | {"files": {k: str(p) for k, p in self.files.items()}}
        return answer | ({"acoustic_lines": self.measured.to_json()} if self.measured else {})

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the first two components of every reed, with their errors."""
        axes = new_axes(ax)
        known = [row for row in self.rows() if isinstance(row["e1"], float)]
        axes.errorbar(
            [row["e1"] for row in known],
            [row["e2"] for row in known],
            xerr=[row["e1_error"] for row in known],
            yerr=[row["e2_error"] for row in known],
            fmt="o",
        )
        label_axes(axes, self.title, "e1 (population SD)", "e2 (population SD)")
        return axes


def _number(text: str) -> float | str | None:
    """Return a cell of a CSV table as a number where it is one, and None where it is empty."""
    if text == "":
        return None
    try:
        return float(text)
    except ValueError:
        return text
