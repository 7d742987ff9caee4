"""What the fit of one or two runs of a reed found."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from fitting.acoustics.lines import SeenPeak, SweepPeaks, nearest_mode
from fitting.amplitudes.response import Response
from fitting.cane.cane_losses import CaneLosses
from fitting.cane.reed_fit import ReedParameters
from fitting.cane.residual_map import residual_map
from fitting.modal.identify import JointFit
from fitting.resonance import Resonance
from protocols.reed import ReedFile


@dataclass(frozen=True)
class SweepFit:
    """Resonances of one run.

    Attributes
    ----------
    path : Path
    reed, series : str
    reed_file : ReedFile
        Kind of reed.
    resonances : dict
        Found modes by name, in order of frequency.
    not_sure : dict
        Measured modes whose name is not sure, by the most probable name with a question mark. They
        are results of the measurement, but nothing that depends on a name may use them.
    response : Response
    not_identified : dict
        Reasons why other modes within the sweep were not found, by name.
    joint : JointFit, optional
        The joint fit, if the holograms were fitted jointly.
    """

    path: Path
    reed: str
    series: str
    reed_file: ReedFile
    resonances: dict[str, Resonance]
    response: Response
    not_identified: Mapping[str, str]
    joint: JointFit | None = None
    not_sure: Mapping[str, Resonance] = field(default_factory=dict)

    @property
    def measured(self) -> dict[str, Resonance]:
        """All measured modes, in order of frequency: also those whose name is not sure."""
        both = {**self.resonances, **self.not_sure}
        return dict(sorted(both.items(), key=lambda item: item[1].frequency_hz))

    @cached_property
    def excitation_peaks(self) -> tuple[SeenPeak, ...]:
        """Peaks of the fitted drive: acoustic resonances, or vibration that no mode explains."""
        if self.joint is None:
            return ()
        mode_hz = self.joint.visible_hz
        return tuple(
            SeenPeak(self.reed, self.path.name, peak, nearest_mode(peak.hz, mode_hz))
            for peak in self.joint.drive_peaks
        )

    @property
    def drive_peaks(self) -> SweepPeaks:
        """The same with the range of the sweep, to be compared with those of other reeds."""
        hz = self.response.drive_hz
        return SweepPeaks(self.reed, float(hz[0]), float(hz[-1]), self.excitation_peaks)


@dataclass(frozen=True)
class ReedFit:
    """Fit of one or two runs of a reed.

    Attributes
    ----------
    sweeps : tuple of SweepFit
    parameters : ReedParameters or None
    reason : str
        Reason if there are no parameters.
    losses : mapping
        Loss factors of the cane by series, where a joint fit has enough modes.
    """

    sweeps: tuple[SweepFit, ...]
    parameters: ReedParameters | None
    reason: str = ""
    losses: Mapping[str, CaneLosses] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the fit with stable keys (documented in ``docs/reference/json.md``)."""
        runs = [
            {
                "path": str(sweep.path),
                "reed": sweep.reed,
                "series": sweep.series,
                "place": _place_of(sweep),
                "modes": {name: _to_json(sweep, name) for name in sweep.resonances},
                "not_sure": {name: _to_json(sweep, name) for name in sweep.not_sure},
                "not_identified": dict(sweep.not_identified),
                "peak": asdict(largest) if (largest := sweep.response.largest) else None,
                "response": sweep.response.to_json(),
                "excitation_peaks": [seen.to_json() for seen in sweep.excitation_peaks],
            }
            for sweep in self.sweeps
        ]
        fitted = asdict(self.parameters) if self.parameters else {}
        keys = (
            "components",
            "moduli",
            "rms_cents",
            "reduced_chi2",
            "excess_scatter_cents",
            "residual_cents",
            "left_out",
            "at_limit",
            "physical",
            "model",
        )
        parameters = {key: fitted.get(key) for key in keys}
        losses = {series: asdict(found) for series, found in self.losses.items()}
        return {
            "modes": runs[0]["modes"],
            **parameters,
            "losses": losses,
            "reason": self.reason,
            "runs": runs,
        }


def _place_of(sweep: SweepFit) -> dict[str, float] | None:
    """Return where the reed lies in the image, with stable keys; None without a joint fit."""
    if sweep.joint is None:
        return None
    place = sweep.joint.block_amplitudes.place
    along, across, turn, larger = (1e3 * place.error).tolist()
    return {
        "along_mm": 1e3 * place.along_m,
        "along_error_mm": along,
        "across_mm": 1e3 * place.across_m,
        "across_error_mm": across,
        "turn_mrad": 1e3 * place.turn_rad,
        "turn_error_mrad": turn,
        "larger_percent": 100 * place.larger,
        "larger_error_percent": 0.1 * larger,
    }


def _to_json(sweep: SweepFit, name: str) -> dict[str, Any]:
    """Return one found mode with stable keys; some exist only after a joint fit."""
    found = sweep.measured[name]
    entry: dict[str, Any] = {
        "hz": found.frequency_hz,
        "error_cents": found.error_cents,
        "step_index": found.step_index,
        "method": found.method,
        "identified": name in sweep.resonances,
        "amplitude_nm": found.amplitude_nm,
        "amplitude_error_nm": found.amplitude_error_nm,
        "nm_per_v": found.nm_per_v,
        "nm_per_v_error": found.nm_per_v_error,
    }
    if sweep.joint is not None:
        keys = ("response_hz", "loss_factor", "loss_error", "participation", "similarity")
        entry |= {key: getattr(found, key) for key in (*keys, "name_probability")}
        if name in sweep.not_sure:
            entry["candidates"] = dict(found.candidates)
        if found.largest_m is not None:
            entry |= {"x_mm": 1e3 * found.largest_m[0], "y_mm": 1e3 * found.largest_m[1]}
        entry["residual"] = residual_map(sweep.joint, name).to_json()
    return entry
