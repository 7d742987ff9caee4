"""Check a bench before the first sweep: every instrument, its limits, and one locked shot."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final

from acquire.bench.findings import (
    Finding,
    all_confirmed_off,
    confirmed_off,
    failed,
    unreached,
)
from acquire.bench.shot import Shot, take_shot
from acquire.runner.orders import Orders
from drivers.bench_lock import BenchInUseError
from drivers.errors import LimitError
from drivers.reference_clock import reference_clock
from drivers.registry import OUTPUTS, Opened, open_each
from drivers.roles import Instrument, RoleName, SignalGenerator, SynthesizerPair
from drivers.safe_off import RAMP_S
from protocols.bench import BenchFile
from protocols.plan import Plan

# Name of the reed in the preparation: a check needs no real one.
_REED: Final = "bench check"
# Text for other programs that find the bench in use.
_PURPOSE: Final = "checks the bench"
# Name of the last check, on which `CheckReport.unconfirmed` depends.
_OFF: Final = "off at the end"

_ROLES: Final[tuple[RoleName, ...]] = ("synthesizers", "generator", "camera")
# How far the check goes beyond a limit: relative volts, and Hz. Chosen: so little that a driver
# that does not refuse it harms nothing, and more than the four digits of volts of a generator.
_VOLTS_BEYOND: Final = 1e-3
_HZ_BEYOND: Final = Fraction(1)


@dataclass(frozen=True, slots=True)
class CheckReport:
    """Result of a check of a bench.

    Attributes
    ----------
    bench : str
        Name of the bench.
    findings : tuple of Finding
        Findings in the order of the checks.
    shot : Shot or None
        The locked shot; None if none was taken.
    interrupted : bool
        Whether the check was stopped before its end.
    """

    bench: str
    findings: tuple[Finding, ...]
    shot: Shot | None = None
    interrupted: bool = False

    @property
    def passed(self) -> bool:
        """Return whether the bench is ready to measure."""
        return not self.interrupted and all(
            finding.result in ("pass", "note") for finding in self.findings
        )

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Return the outputs that were not confirmed off at the end, each with its remedy."""
        return tuple(
            f"{finding.about}: {finding.found}; {finding.remedy}"
            for finding in self.findings
            if finding.check == _OFF and finding.result == "fail"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON values with stable keys."""
        return {
            "bench": self.bench,
            "passed": self.passed,
            "interrupted": self.interrupted,
            "findings": [finding.to_json() for finding in self.findings],
            "shot": None if self.shot is None else self.shot.to_json(),
            "unconfirmed": list(self.unconfirmed),
        }


@dataclass(frozen=True, slots=True)
class _Stage:
    """An open bench that is being checked."""

    bench: BenchFile
    plan: Plan
    opened: Opened

    def instrument(self, role: RoleName) -> Instrument | None:
        """Return an open instrument by its role; None if it could not be opened."""
        # An instrument that had to be opened twice is in `opened.bench` only.
        if self.opened.bench is not None:
            return getattr(self.opened.bench, role)  # type: ignore[no-any-return]  # by its name
        return self.opened.instruments.get(role)


def check_bench(
    bench: BenchFile, plan: Plan, orders: Orders, announce: Callable[[str], None]
) -> CheckReport:
    """Check a bench, and leave all its outputs off.

    Parameters
    ----------
    bench : BenchFile
    plan : Plan
        Plan of the shot, see `acquire.bench.shot.shot_plan`.
    orders : Orders
        The first order to stop ends the check after the present part, a second one at once.
    announce : callable
        Called with a text while the check waits for something.

    Returns
    -------
    CheckReport

    Raises
    ------
    OpeningStoppedError, KeyboardInterrupt
        If the check was stopped while the bench was opened. Outputs that are not confirmed off are
        in the notes of the exception.
    """
    findings = [Finding("bench file", "bench", "pass", f"{bench.name} ({bench.source})")]
    shot = None
    with ExitStack() as held:
        try:
            opened = _opened(held, bench, plan, orders, announce)
        except BenchInUseError as busy:
            return CheckReport(bench.name, (*findings, failed("bench free", "bench", busy)))
        findings.append(Finding("bench free", "bench", "pass", "no other program uses it"))
        stage = _Stage(bench, plan, opened)
        try:
            with orders.given_up_at(2):
                for step in _STEPS:
                    if not orders.stopped:
                        findings += step(stage)
                if not orders.stopped:
                    taken, shot = _shot(stage, findings, orders, announce)
                    findings.append(taken)
        except KeyboardInterrupt:
            announce("the check was stopped; switching off")
        finally:
            off = _all_off(stage)
        return CheckReport(bench.name, (*findings, *off), shot, orders.stopped)


def _opened(
    held: ExitStack,
    bench: BenchFile,
    plan: Plan,
    orders: Orders,
    announce: Callable[[str], None],
) -> Opened:
    with orders.given_up_at(2):
        return held.enter_context(
            open_each(
                bench,
                plan.preparation(_REED),
                announce=announce,
                does=_PURPOSE,
                stopped=lambda: orders.stopped,
            )
        )


# --- The checks --------------------------------------------------------------------------------


def _opened_each(stage: _Stage) -> list[Finding]:
    """Check that each instrument could be opened, and report its identity."""
    failures = stage.opened.failures
    findings = _each(stage, "opened", _ROLES, _identity)
    return [
        failed("opened", finding.about, failures[role]) if role in failures else finding
        for role, finding in zip(_ROLES, findings, strict=True)
    ]


def _off_after_opening(stage: _Stage) -> list[Finding]:
    """Check that outputs are off that an earlier program may have left on."""
    return _each(stage, "off after opening", tuple(OUTPUTS), _off_now)


def _reference_clocks(stage: _Stage) -> list[Finding]:
    """Check that the instruments use a common reference clock."""
    return _each(stage, "reference clock", _ROLES, _clock)


def _limits(stage: _Stage) -> list[Finding]:
    """Check that drivers refuse settings beyond the limits, and change nothing then."""
    return [
        *_each(stage, "limits", ("synthesizers",), _window),
        *_each(stage, "limits", ("generator",), _drive_limits),
    ]


def _smallest_volts(stage: _Stage) -> list[Finding]:
    """Check that the generator plays the smallest allowed volts, and switches off again."""
    return _each(stage, "smallest volts", ("generator",), _play_smallest_volts)


_STEPS: Final[Sequence[Callable[[_Stage], list[Finding]]]] = (
    _opened_each,
    _off_after_opening,
    _reference_clocks,
    _limits,
    _smallest_volts,
)


def _each(
    stage: _Stage,
    check: str,
    roles: Iterable[RoleName],
    look: Callable[[_Stage, RoleName, Any], Finding],
) -> list[Finding]:
    """Apply a check to instruments; an exception of a driver becomes a finding."""
    findings = []
    for role in roles:
        instrument = stage.instrument(role)
        if instrument is None:
            findings.append(Finding(check, role, "skipped", "it could not be opened"))
            continue
        try:
            findings.append(look(stage, role, instrument))
        except Exception as error:  # noqa: BLE001  # whatever a driver raises, check the others
            findings.append(failed(check, role, error))
    return findings


def _identity(_stage: _Stage, role: RoleName, instrument: Instrument) -> Finding:
    return Finding("opened", role, "pass", instrument.identity)


def _off_now(_stage: _Stage, role: RoleName, instrument: Instrument) -> Finding:
    return confirmed_off("off after opening", role, instrument)


def _clock(stage: _Stage, role: RoleName, instrument: Instrument) -> Finding:
    clock = reference_clock(getattr(stage.bench.instruments, role), instrument)
    if clock.source == "external":
        return Finding("reference clock", role, "pass", clock.words)
    remedy = (
        "check at its front panel that it uses the external 10 MHz reference"
        if clock.source == "unknown"
        else "connect it to the 10 MHz clock that all instruments share, because phase maps are "
        "wrong without it; docs/reference/drivers.md describes cable and option"
    )
    return Finding("reference clock", role, "note", clock.words, remedy)


def _window(stage: _Stage, role: RoleName, synthesizers: SynthesizerPair) -> Finding:
    entry = stage.bench.instruments.synthesizers
    centre_hz, beyond_hz = entry.centre_hz, entry.window_hz + max(_HZ_BEYOND, entry.step_hz)
    outside = (centre_hz - beyond_hz, centre_hz + beyond_hz)
    attempts = {
        f"{name} at {float(hz):.10g} Hz": (
            [lambda hz=hz: synthesizers.set_pair(hz, centre_hz)]
            if name == "AOM1"
            else [lambda hz=hz: synthesizers.set_pair(centre_hz, hz)]
        )
        for name in ("AOM1", "AOM2")
        for hz in outside
    }
    return _all_refused(role, synthesizers, attempts, synthesizers.read_pair)


def _drive_limits(stage: _Stage, role: RoleName, generator: SignalGenerator) -> Finding:
    limits, hz = stage.bench.limits, stage.plan.steps[0].drive_hz
    least_v, most_v = float(limits.volts_min_v), float(limits.volts_max_v)
    low_hz, high_hz = limits.drive_min_hz, limits.drive_max_hz
    volts = [most_v * (1 + _VOLTS_BEYOND)]
    volts += [least_v * (1 - _VOLTS_BEYOND)] if least_v > 0 else []
    drives_hz = [high_hz + _HZ_BEYOND, low_hz - min(_HZ_BEYOND, low_hz / 2)]
    # The ramp first: the output is off, so nothing is played even if the driver does not refuse.
    attempts = {
        f"{v:.6g} V": [
            lambda v=v: generator.ramp_to(v, RAMP_S),
            lambda v=v: generator.set_sine(hz, v),
        ]
        for v in volts
    }
    attempts |= {
        f"{float(drive_hz):.10g} Hz": [lambda drive_hz=drive_hz: generator.set_sine(drive_hz, 0.0)]
        for drive_hz in drives_hz
    }
    return _all_refused(role, generator, attempts, generator.read)


def _all_refused(
    role: RoleName,
    instrument: Instrument,
    attempts: dict[str, list[Any]],
    read: Callable[[], object],
) -> Finding:
    """Try settings beyond limits: each must raise a `LimitError` and change nothing."""
    before = read()
    for what, tries in attempts.items():
        for attempt in tries:
            outcome = _outcome(attempt)
            if outcome or read() != before:
                confirmed_off("limits", role, instrument)
                return Finding(
                    "limits",
                    role,
                    "fail",
                    f"{what} is beyond the limits of the bench file, and "
                    f"{outcome or 'was refused, but changed what it plays'}",
                    "do not measure with this driver, because it ignores limits; report this",
                )
    return Finding("limits", role, "pass", f"refused, nothing changed: {', '.join(attempts)}")


def _outcome(attempt: Callable[[], None]) -> str:
    """Return what happened to an attempt; empty if it was refused correctly."""
    try:
        attempt()
    except LimitError:
        return ""
    except Exception as error:  # noqa: BLE001  # a driver may raise anything
        return f"failed with another error than a limit ({error})"
    return "was accepted"


def _play_smallest_volts(stage: _Stage, role: RoleName, generator: SignalGenerator) -> Finding:
    least_v = float(stage.bench.limits.volts_min_v)
    generator.set_sine(stage.plan.steps[0].drive_hz, 0.0)
    if least_v:
        generator.ramp_to(least_v, RAMP_S)
    hz, volts, is_on = generator.read()
    off = confirmed_off("smallest volts", role, generator)
    if off.result == "fail":
        return off
    if not is_on:
        return failed("smallest volts", role, "its output did not switch on; check for an overload")
    found = f"asked for {least_v:g} V, plays {volts:.4g} V at {float(hz):.10g} Hz; then off"
    return Finding("smallest volts", role, "pass", found)


def _shot(
    stage: _Stage,
    findings: Sequence[Finding],
    orders: Orders,
    announce: Callable[[str], None],
) -> tuple[Finding, Shot | None]:
    """Take the shot, unless a check before it has failed."""
    bench = stage.opened.bench
    if bench is None or any(finding.result == "fail" for finding in findings):
        reason, remedy = "an earlier check failed", "fix that first, then check again"
        return Finding("shot", "bench", "skipped", reason, remedy), None
    return take_shot(stage.plan, bench, orders, announce)


def _all_off(stage: _Stage) -> list[Finding]:
    """Switch everything off, and return for each instrument whether it confirmed that."""
    found = {role: stage.instrument(role) for role in _ROLES}
    off = all_confirmed_off(
        _OFF, {role: instrument for role, instrument in found.items() if instrument is not None}
    )
    closed = "it could not be opened, see above; fix it and check again"
    return [off.get(role) or unreached(_OFF, role, closed) for role in _ROLES]
