"""What all runs of a campaign say; less with fewer runs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from diagnosis.campaign import Campaign
from diagnosis.known_bench import parameters_of
from diagnosis.readings.camera import (
    DarkFrames,
    FlatFrames,
    LocalOscillatorFrames,
    read_dark,
    read_flat,
    read_local_oscillator,
)
from diagnosis.readings.carrier import CarrierReading, read_carriers, unshifted_light
from diagnosis.readings.reed_at_rest import RestHolograms, read_rest_holograms
from diagnosis.readings.step_log import StepLog, read_step_log
from diagnosis.readings.sweeps import SweepReading, common_modes, read_sweeps
from physics.parameters.tree import BenchParameters
from protocols.bench import BenchFile
from runs.layout import RunKind

# Moments at which something may happen, and a gap between two holograms that is a pause, in usual
# ones. Chosen: in a campaign of five sweeps of 184 steps, every sixth hologram is one.
_MOMENTS, _PAUSE = 150, 5.0
# Share of the time that fitting sweeps takes.
_SWEEPS = 0.95


@dataclass(frozen=True)
class Readings:
    """What the runs of a campaign say.

    Attributes
    ----------
    dark, flat, lo : DarkFrames, FlatFrames, LocalOscillatorFrames or None
    stills : tuple of RestHolograms
    carriers : tuple of CarrierReading
    beat : StepLog
    sweeps : tuple of SweepReading
    refused : tuple of str
        Why sweeps could not be fitted.
    missing : tuple of str
        Runs and properties that would improve the diagnosis.
    rate_hz : float
        Frames per second.
    nominal : BenchParameters
        Of this bench and this kind of reed, without effects.
    data_sheet : bool
        Whether the bench file has the data sheet of the camera.
    extra : mapping
        What modules of `diagnosis.observables` read by themselves, by the names of their sources.
    """

    dark: DarkFrames | None
    flat: FlatFrames | None
    lo: LocalOscillatorFrames | None
    stills: tuple[RestHolograms, ...]
    carriers: tuple[CarrierReading, ...]
    beat: StepLog
    sweeps: tuple[SweepReading, ...]
    refused: tuple[str, ...]
    missing: tuple[str, ...]
    rate_hz: float
    nominal: BenchParameters
    data_sheet: bool = True
    extra: Mapping[str, object] = field(default_factory=dict)

    @property
    def moments_h(self) -> tuple[float, ...]:
        """Hours after which something may happen at once, since the campaign began.

        They lie between holograms, with every pause and at most `_MOMENTS` others, which are evenly
        spaced among the holograms.
        """
        times_s = [sweep.time_s for sweep in self.sweeps] + [each.time_s for each in self.stills]
        at_s = np.sort(np.concatenate(times_s)) if times_s else np.zeros(0)
        if at_s.size < 2:
            return ()
        gaps_s = np.diff(at_s)
        chosen = np.unique(np.linspace(0, len(gaps_s) - 1, _MOMENTS).round().astype(int))
        pauses = np.flatnonzero(gaps_s > _PAUSE * np.median(gaps_s))
        before = np.union1d(chosen, pauses)
        return tuple((at_s[before] + 0.5 * gaps_s[before]) / 3600)


def read_runs(
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
        Called with the fraction that is done.

    Raises
    ------
    RunFileError
        If a run cannot be read.
    """
    # Matrices are small: threads of linear algebra would wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        return _read(campaign, bench, progress or (lambda _share: None))


def read_unfitted(campaign: Campaign, bench: BenchFile | None = None) -> Readings:
    """Read what needs no fit of a sweep: calibrations, light at rest, logs of steps, the carrier.

    Parameters
    ----------
    campaign : Campaign
    bench : BenchFile, optional
        What is known of the bench.

    Returns
    -------
    Readings
        Without sweeps.

    Raises
    ------
    RunFileError
        If a run cannot be read.
    """
    first = campaign.sweeps[0].run
    dark_parts, flat_parts = campaign.of_kind(RunKind.DARK), campaign.of_kind(RunKind.FLAT)
    lo_parts, still_parts = campaign.of_kind(RunKind.LO_ONLY), campaign.of_kind(RunKind.ORDER0)
    nominal = parameters_of(first, bench)
    dark = read_dark(dark_parts) if dark_parts else None
    offset_dn = dark.offset_dn if dark else nominal.sensor.offset_dn
    hot_pixels = dark.hot_pixels if dark else None
    flat = read_flat(flat_parts, offset_dn, hot_pixels) if flat_parts else None
    lo = read_local_oscillator(lo_parts, offset_dn, hot_pixels) if lo_parts else None
    return Readings(
        dark=dark,
        flat=flat,
        lo=lo,
        stills=tuple(read_rest_holograms(still_parts)),
        carriers=tuple(read_carriers(campaign.sweeps, still_parts)),
        beat=read_step_log(campaign.sweeps),
        sweeps=(),
        refused=(),
        missing=tuple(_missing(campaign, bench, (), _unread(campaign, flat, lo))),
        rate_hz=float(first.frame_rate_hz),
        nominal=nominal,
        data_sheet=_has_data_sheet(bench),
    )


def _read(campaign: Campaign, bench: BenchFile | None, report: Callable[[float], None]) -> Readings:
    readings = read_unfitted(campaign, bench)
    still_parts = campaign.of_kind(RunKind.ORDER0)
    leaking = unshifted_light(campaign.sweeps, still_parts, readings.carriers)
    sweeps, refused = read_sweeps(campaign.sweeps, lambda share: report(_SWEEPS * share), leaking)
    report(1.0)
    unread = _unread(campaign, readings.flat, readings.lo)
    return replace(
        readings,
        sweeps=tuple(sweeps),
        refused=tuple(refused),
        missing=tuple(_missing(campaign, bench, sweeps, unread)),
    )


def _has_data_sheet(bench: BenchFile | None) -> bool:
    return bench is not None and bench.instruments.camera.data_sheet is not None


def _unread(
    campaign: Campaign, flat: FlatFrames | None, lo: LocalOscillatorFrames | None
) -> list[str]:
    """Return which frames are there, but cannot be used."""
    unread = []
    if campaign.of_kind(RunKind.FLAT) and flat is None:
        unread.append("flat frames without saturated pixels (linearity, pattern, vignetting)")
    if campaign.of_kind(RunKind.LO_ONLY) and lo is None:
        unread.append(
            "frames of the local oscillator that are neither dark nor saturated (where its beam is)"
        )
    return unread


def _missing(
    campaign: Campaign,
    bench: BenchFile | None,
    sweeps: Sequence[SweepReading],
    unread: Sequence[str],
) -> list[str]:
    """Return what would improve the diagnosis: missing runs, and what the others do not show."""
    missing = campaign.missing
    if not _has_data_sheet(bench):
        missing.append("instruments.camera.data_sheet of the bench file (gain, read noise, offset)")
    missing += unread
    for sweep in sweeps:
        compared = {*sweep.names} & {*common_modes(sweeps)}
        if 2 * len(compared) < len(sweep.names):
            missing.append(f"more than half of the modes of {sweep.name} in other sweeps")
    return missing
