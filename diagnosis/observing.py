"""From runs to the blocks of numbers that a twin is compared with; less with less data."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from diagnosis.block import Block
from diagnosis.campaign import Campaign
from diagnosis.known_bench import sensor_of
from diagnosis.observables.beat import (
    Beat,
    lock_block,
    lock_scatter_hz,
    log_block,
    read_beat,
)
from diagnosis.observables.carrier import (
    Carrier,
    carrier_block,
    leaks_in,
    read_carriers,
    unshifted_light,
)
from diagnosis.observables.drive import (
    Device,
    force_block,
    level_block,
    line_block,
)
from diagnosis.observables.light import (
    brightness_block,
    fringe_block,
    mixing_in,
    noise_block,
)
from diagnosis.observables.modes import modes_block
from diagnosis.observables.sensor import (
    Beam,
    Dark,
    Flat,
    Sheet,
    dark_block,
    flat_block,
    lo_block,
    read_beam,
    read_dark,
    read_flat,
)
from diagnosis.observables.shapes import shapes_block
from diagnosis.observables.still import (
    Still,
    read_stills,
    scatter_block,
    stability_block,
    turn_block,
    usual_scatter_hz,
)
from diagnosis.observables.vibration import (
    SweepReading,
    common_modes,
    read_sweeps,
    understood_block,
)
from physics.air import (
    CavityLine,
    Filling,
    chamber_of,
)
from physics.mechanics import ReedSolver
from physics.twin import Twin
from protocols.bench import BenchFile
from runs.layout import Kind

# Share of the time that fitting sweeps takes.
_SWEEPS = 0.95


@dataclass(frozen=True)
class Readings:
    """What the runs of a campaign say.

    Attributes
    ----------
    dark, flat, lo : Dark, Flat, Beam or None
    stills : tuple of Still
    carriers : tuple of Carrier
    beat : Beat
    sweeps : tuple of SweepReading
    refused : tuple of str
        Why sweeps could not be fitted.
    missing : tuple of str
        What would have told more.
    rate_hz : float
        Frames per second.
    sheet : Sheet
    device : Device
    """

    dark: Dark | None
    flat: Flat | None
    lo: Beam | None
    stills: tuple[Still, ...]
    carriers: tuple[Carrier, ...]
    beat: Beat
    sweeps: tuple[SweepReading, ...]
    refused: tuple[str, ...]
    missing: tuple[str, ...]
    rate_hz: float
    sheet: Sheet
    device: Device


def read(
    campaign: Campaign,
    bench: BenchFile | None = None,
    progress: Callable[[float], None] | None = None,
) -> Readings:
    """Read all runs.

    Parameters
    ----------
    campaign : Campaign
    bench : BenchFile, optional
        What is known of the bench.
    progress : callable, optional
        Told the share that is done.

    Raises
    ------
    RunFileError
        If a run cannot be read.
    """
    # As in `verdict.judged`.
    with threadpool_limits(limits=1, user_api="blas"):
        return _read(campaign, bench, progress or (lambda _share: None))


def _read(campaign: Campaign, bench: BenchFile | None, report: Callable[[float], None]) -> Readings:
    first = campaign.sweeps[0].run
    dark_parts, flat_parts = campaign.of_kind(Kind.DARK), campaign.of_kind(Kind.FLAT)
    lo_parts, still_parts = campaign.of_kind(Kind.LO_ONLY), campaign.of_kind(Kind.ORDER0)
    sensor = sensor_of(bench, first)
    sheet = Sheet(sensor)
    dark = read_dark(dark_parts) if dark_parts else None
    offset_dn = dark.offset_dn if dark else sensor.offset_dn
    carriers = read_carriers(campaign.sweeps, still_parts)
    leaking = unshifted_light(campaign.sweeps, still_parts, carriers)
    sweeps, refused = read_sweeps(campaign.sweeps, lambda share: report(_SWEEPS * share), leaking)
    flat = read_flat(flat_parts, offset_dn) if flat_parts else None
    lines = [CavityLine(frequency_hz=hz) for hz in first.acoustic_resonances_hz[:1]]
    report(1.0)
    return Readings(
        dark=dark,
        flat=flat,
        lo=read_beam(lo_parts, offset_dn) if lo_parts else None,
        stills=tuple(read_stills(still_parts)),
        carriers=tuple(carriers),
        beat=read_beat(campaign.sweeps),
        sweeps=tuple(sweeps),
        refused=tuple(refused),
        missing=tuple(_missing(campaign, sweeps, saturated=bool(flat_parts) and flat is None)),
        rate_hz=float(first.frame_rate_hz),
        sheet=sheet,
        device=Device(
            chamber=chamber_of(first.reed_file().geometry(), Filling(first.chamber)),
            line=lines[0] if lines else CavityLine(),
            wavelength_m=first.reconstruction.transform.wavelength_m,
        ),
    )


def _missing(campaign: Campaign, sweeps: Sequence[SweepReading], *, saturated: bool) -> list[str]:
    """What would have told more: runs that are not there, and what those that are do not tell."""
    missing = campaign.missing
    if saturated:
        missing.append("flat frames that are not saturated (linearity, pattern, vignetting)")
    for sweep in sweeps:
        compared = {*sweep.names} & {*common_modes(sweeps)}
        if 2 * len(compared) < len(sweep.names):
            missing.append(f"modes of {sweep.name} that the first sweep tells (few are compared)")
    return missing


def blocks(readings: Readings, reed_solver: ReedSolver) -> list[Block]:
    """Put readings beside the twin.

    Parameters
    ----------
    readings : Readings
    reed_solver : ReedSolver
        Of the kind of reed.
    """
    sheet, beat, stills, sweeps = readings.sheet, readings.beat, readings.stills, readings.sweeps
    scatter_hz = lock_scatter_hz(beat)
    usual_hz = usual_scatter_hz(Twin().optics, readings.rate_hz)
    found: list[Block | None] = [log_block(beat)]
    if readings.dark:
        found.append(dark_block(readings.dark, sheet))
    if readings.flat:
        found.append(flat_block(readings.flat, readings.dark, sheet))
    if readings.lo:
        found.append(lo_block(readings.lo, sheet))
    found.append(lock_block(beat, readings.rate_hz))
    if stills:
        found.append(turn_block(stills, scatter_hz or usual_hz, readings.rate_hz))
        found.append(stability_block(stills))
    if stills and scatter_hz is not None:
        found.append(scatter_block(stills, scatter_hz, readings.rate_hz))
    if readings.carriers:
        found.append(carrier_block(readings.carriers))
    if sweeps or readings.refused:
        found.append(understood_block(len(sweeps), len(readings.refused)))
    if sweeps:
        leaks = leaks_in(readings.carriers, sweeps, mixing_in(sweeps))
        found += [
            brightness_block(sweeps, stills),
            noise_block(sweeps),
            fringe_block(sweeps),
            line_block(sweeps, readings.device.line, leaks),
            level_block(sweeps, leaks),
            force_block(sweeps, reed_solver, readings.device),
            modes_block(sweeps, reed_solver, leaks),
            shapes_block(sweeps, reed_solver, leaks),
        ]
    return [block for block in found if block is not None]
