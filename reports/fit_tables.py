"""Tables of what a fit found: resonances, and parameters of the cane."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from fitting.acoustics.lines import LEAST_REEDS, SeenPeak
from fitting.amplitudes.response import Peak
from fitting.cane.sweep_fit import ReedFit, SweepFit
from fitting.populations.acoustic_lines import MeasuredLines
from reports.tables import Column, Table

# Columns of the terminal, where 80 characters must suffice.
SHORT_JOINT: Final = ("mode", "hz", "error_cents", "loss_factor", "amplitude_nm", "mac", "step")
SHORT_PICTURE: Final = ("mode", "hz", "error_cents", "amplitude_nm", "step")
_NEEDS_JOINT_FIT: Final = ("loss_factor", "response_hz", "participation", "mac", "name")
# Column that only a table with a name that is not sure has.
_NAME: Final = "name"
# Names less probable than this are not printed: JSON lists them.
_LEAST_PROBABILITY: Final = 0.05


def _with_error(value: tuple[float, float | None]) -> str:
    """Loss factor, with its standard error if that is known."""
    loss, relative_error = value
    if relative_error is None:
        return f"{loss:.4f}"
    return f"{loss:.4f} ± {loss * relative_error:.4f}"


def nm_text(nm: float, error_nm: float | None) -> str:
    """Return an amplitude with its standard error, if that is known, to 0.1 nm."""
    return f"{nm:.1f}" if error_nm is None else f"{nm:.1f} ± {error_nm:.1f}"


def candidates_text(candidates: Sequence[tuple[str, float]]) -> str:
    """Return the names that a mode may have, with their probabilities in per cent."""
    likely = [(name, p) for name, p in candidates if p >= _LEAST_PROBABILITY]
    return ", ".join(f"{name} {p:.0%}" for name, p in likely or candidates[:1])


def _per_volt(value: tuple[float, float | None]) -> str:
    """Displacement per volt, with its error to two digits: small modes have errors of 0.03 nm/V."""
    nm, error_nm = value
    if not error_nm:
        return f"{nm:.1f}"
    digits = max(1, 1 - math.floor(math.log10(error_nm)))
    return f"{nm:.{digits}f} ± {error_nm:.{digits}f}"


def _amplitude(value: tuple[float, float | None]) -> str:
    return nm_text(*value)


_RESONANCE_COLUMNS: Final = (
    Column("mode", "mode", meaning="F flexural, T transverse, X generic, L lateral, H heel; "
           "numbered by frequency", wraps=False),
    Column("name", "name", meaning="where it is not sure: probabilities of the names that the mode "
           "may have"),
    Column("hz", "frequency", "Hz", ".1f", "resonance frequency"),
    Column("error_cents", "±", "cents", ".1f",
           "standard error of the frequency; 100 cents are a semitone"),
    Column("loss_factor", "loss factor", "", _with_error,
           "imaginary part of the mode's stiffness divided by its real part, ± standard error"),
    Column("response_hz", "peak response", "Hz", ".1f",
           "drive frequency at which the mode moves most"),
    Column("participation", "participation", "", ".3f",
           "how strongly the drive excites the mode; 1 for the mode that it excites most"),
    Column("mac", "MAC", "", ".2f",
           "squared correlation of measured and calculated shape; 1 if they are equal"),
    Column("step", "step", "", "d", "step of the sweep that is nearest to the resonance"),
    Column("amplitude_nm", "amplitude", "nm", _amplitude,
           "displacement at resonance where the mode moves most, from rest to the largest "
           "deflection (half of peak to peak), ± standard error"),
    Column("nm_per_v", "per volt", "nm/V", _per_volt,
           "that displacement, divided by the peak volts of the drive, ± standard error, with the "
           "scatter of the drive from step to step"),
    Column("residual_cents", "residual", "cents",
           lambda value: value if isinstance(value, str) else f"{value:+.1f}",
           "measured less fitted frequency"),
)  # fmt: skip


def resonances_table(sweep: SweepFit, residual_cents: Mapping[str, float] | None = None) -> Table:
    """Return the resonances of one run.

    Parameters
    ----------
    sweep : SweepFit
    residual_cents : mapping, optional
        Measured less fitted frequency of each mode that was fitted, by name.
    """
    residuals = residual_cents or {}
    rows = tuple(
        (
            name,
            candidates_text(found.candidates) if name in sweep.not_sure else "",
            found.frequency_hz,
            found.error_cents,
            None if found.loss_factor is None else (found.loss_factor, found.loss_error),
            found.response_hz,
            found.participation,
            found.similarity,
            found.step_index,
            None if found.amplitude_nm is None else (found.amplitude_nm, found.amplitude_error_nm),
            None if found.nm_per_v is None else (found.nm_per_v, found.nm_per_v_error),
            residuals.get(name, "not fitted"),
        )
        for name, found in sweep.measured.items()
    )
    title = f"Reed {sweep.reed}, series {sweep.series}: resonances"
    table = Table(_RESONANCE_COLUMNS, rows, title)
    without = {_NAME} if not sweep.not_sure else set()
    if sweep.joint is None:
        without |= set(_NEEDS_JOINT_FIT)
    return table.select(*[column.key for column in table.columns if column.key not in without])


def short_resonances_table(sweep: SweepFit) -> Table:
    """Return the resonances of one run, narrow enough for a terminal."""
    keys = SHORT_PICTURE if sweep.joint is None else SHORT_JOINT
    named = (keys[0], _NAME, *keys[1:]) if sweep.not_sure else keys
    return resonances_table(sweep).select(*named)


def remarks(sweep: SweepFit) -> list[str]:
    """Return the largest displacement, modes that are not identified, and excitation peaks.

    Each has a line. Modes that are missing for the same reason share a line.
    """
    by_reason: dict[str, list[str]] = {}
    for name, reason in sweep.not_identified.items():
        by_reason.setdefault(reason, []).append(name)
    lines = [] if (peak := sweep.response.largest) is None else [_largest(peak)]
    lines += [f"{', '.join(names)} not identified: {reason}" for reason, names in by_reason.items()]
    return lines + [_excitation(seen) for seen in sweep.excitation_peaks]


def _excitation(seen: SeenPeak) -> str:
    peak = seen.peak
    said = (
        f"excitation peak: resonance at {peak.hz:.1f} ± {peak.error_hz:.1f} Hz, quality factor "
        f"{peak.quality:.0f} ± {peak.quality_error:.0f}, {peak.height_db:+.0f} dB. "
    )
    if seen.suspect and seen.mode is not None:
        return said + (
            f"Suspect: it is next to {seen.mode.name} and too high for the air or the "
            f"loudspeaker; it is probably vibration of {seen.mode.name}."
        )
    if seen.next_to_mode and seen.mode is not None:
        said += (
            f"It is {seen.mode.cents:+.0f} cents from {seen.mode.name} and may be of that mode. "
        )
    return said + (
        "If other reeds show it too (`acquire acoustics`), it belongs to the air or the "
        "loudspeaker, not to the reed."
    )


def _largest(peak: Peak) -> str:
    return (
        f"largest displacement of the reed: {nm_text(peak.nm, peak.error_nm)} nm "
        f"({2 * peak.nm:.0f} nm peak to peak) at {peak.hz:.1f} Hz and {peak.volts:.3g} V "
        f"(step {peak.step_index}), {peak.x_mm:.1f} mm from the tip, y = {peak.y_mm:+.1f} mm"
    )


_LINE_COLUMNS: Final = (
    Column("hz", "resonance", "Hz", ".1f", "frequency of the pole"),
    Column("error_hz", "±", "Hz", ".1f", "standard error of that frequency"),
    Column("quality", "Q", "", ".0f", "quality factor"),
    Column("quality_error", "±", "", ".0f", "standard error of the quality factor"),
    Column("height_db", "height", "dB", "+.1f", "largest gain by the resonance"),
    Column("reeds", "reeds", meaning="reeds that show the line, of those whose sweeps cover it",
           wraps=False),
    Column("verdict", "belongs to", meaning="bench: loudspeaker, chamber or air"),
)  # fmt: skip


def acoustics_table(measured: MeasuredLines) -> Table:
    """Return the acoustic lines of several runs, narrow enough for a terminal."""
    rows = tuple(
        (
            line.hz,
            line.error_hz,
            line.quality,
            line.quality_error,
            line.height_db,
            f"{line.reeds} of {line.of}",
            str(line.verdict) + (f": {line.reason}" if line.reason else ""),
        )
        for line in measured.lines
    )
    note = (
        f"{measured.reeds} reeds. Fewer than {LEAST_REEDS} decide nothing: measure more reeds."
        if measured.reeds < LEAST_REEDS
        else f"{measured.reeds} reeds."
    )
    if measured.passed_over:
        note += f" {len(measured.passed_over)} runs could not be fitted."
    return Table(_LINE_COLUMNS, rows, "Resonances of the drive" if rows else "No resonance", note)


_PARAMETER_COLUMNS: Final = (
    Column("parameter", "parameter", meaning="e1 … e4 are the components in which the cane of "
           "reeds varies; E1, E2, G1, G2 are the springs of the viscoelastic model (E along the "
           "grain, G shear), E′ and G′ its storage moduli; loss factors are those of the cane at "
           "4 kHz"),
    Column("value", "value", "", str),
    Column("error", "± s.e.", "", str, "standard error"),
    Column("unit", "unit", meaning="population SD is a standard deviation of the paper's reeds"),
)  # fmt: skip


def parameters_table(fit: ReedFit) -> Table | None:
    """Return components and moduli with standard errors; None if the fit has none."""
    parameters = fit.parameters
    if parameters is None:
        return None
    rows = [
        (name, f"{estimate.value:+.2f}", f"{estimate.error:.2f}", "population SD")
        for name, estimate in parameters.components.items()
    ]
    rows += [
        (f"{_quantity(name)}, series {series}", f"{one.value:.0f}", f"{one.error:.0f}", "MPa")
        for series, moduli in parameters.moduli.items()
        for name, one in moduli.items()
    ]
    rows += [
        (f"loss factor, {of}, series {series}", f"{one.value:.4f}", f"{one.error:.4f}", "")
        for series, losses in fit.losses.items()
        for of, one in (("normal strains", losses.normal), ("shear", losses.shear))
    ]
    # A standard deviation, like the errors that it was added to.
    scatter = parameters.excess_scatter_cents
    added = f", with {scatter:.1f} cents added to every error" if scatter else ""
    note = (
        f"Residual rms {parameters.rms_cents:.1f} cents, χ² per degree of freedom "
        f"{parameters.reduced_chi2:.2f}{added}; forward model: {parameters.model}."
    )
    if parameters.at_limit:
        note += f" Not known, because at the limit of the search: {', '.join(parameters.at_limit)}."
    return Table(_PARAMETER_COLUMNS, tuple(rows), f"Reed {fit.sweeps[0].reed}: the cane", note)


def _quantity(name: str) -> str:
    return name.removesuffix("_mpa").replace("_4kHz", "′ at 4 kHz")
