"""Switches off what could harm: the tweeter, the RF of both modulators, and the camera.

Each instrument is switched off on a thread of its own, so that one that does not answer keeps none
of the others on.
"""

import itertools
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Final, cast

from drivers.errors import InstrumentError, note_unconfirmed
from drivers.roles import (
    Bench,
    Camera,
    Instrument,
    RoleName,
    SignalGenerator,
    SynthesizerPair,
)

# A tweeter clicks, and may be harmed, if its voltage jumps.
RAMP_S: Final = 0.1
# The tweeter is switched off first if it is quick; the RF does not wait longer than this for it.
# A ramp of RAMP_S, a relay of up to 0.26 s (SDG2042X, recorded) and its answers fit.
_HEAD_START_S: Final = 0.5
# After this an instrument counts as one that does not answer. Chosen: a driver's longest way to
# give up on a dead line is four timeouts and a reconnection, some 20 s at the default 2 s.
_PATIENCE_S: Final = 30.0
# A USB adapter that was plugged in again, or a switch that was reset, is back by then (chosen).
_BACK_S: Final = 1.0
_ORDER: Final[tuple[RoleName, ...]] = ("generator", "synthesizers", "camera")

_Switch = tuple[str, Callable[[], None]]


class _Switching:
    """The switching off of one instrument, on a thread of its own."""

    def __init__(self, role: RoleName, switch_off: Callable[[], Sequence[str]]) -> None:
        self._role, self._switch_off = role, switch_off
        self._unconfirmed: Sequence[str] | None = None
        # Not waited for when the program ends: a driver may hang for ever.
        self._thread = threading.Thread(target=self._work, name=f"{role} off", daemon=True)
        try:
            self._thread.start()
        except RuntimeError:
            # At a limit of threads, or without memory for one: here, though others then wait.
            self._work()

    def _work(self) -> None:
        self._unconfirmed = self._switch_off()

    def wait(self, seconds: float) -> None:
        """Wait for the end, at most so long."""
        if self._thread.ident is not None:
            self._thread.join(max(seconds, 0.0))

    @property
    def unconfirmed(self) -> Sequence[str]:
        """Outputs that are not confirmed off."""
        if self._unconfirmed is None:
            return [f"{self._role} off: no answer within {_PATIENCE_S:g} s; look at it"]
        return self._unconfirmed


def safe_off(bench: Bench) -> tuple[str, ...]:
    """Ramp the tweeter down, switch its output and the RF off, and stop the camera.

    Each is tried whatever becomes of the others. An instrument that fails is opened once more and
    switched off again; the bench then holds the newly opened one.

    Parameters
    ----------
    bench : Bench

    Returns
    -------
    tuple of str
        What was not confirmed, and why. Empty if all is off.
    """
    found = _all_off({role: partial(_off, bench, role) for role in _ORDER})
    return tuple(itertools.chain.from_iterable(found.values()))


def instruments_off(
    instruments: Mapping[RoleName, Instrument],
) -> dict[RoleName, tuple[str, ...]]:
    """Switch off some instruments at once, each by itself; see `safe_off`.

    Parameters
    ----------
    instruments : mapping
        Open instruments by role.

    Returns
    -------
    dict
        By role, what was not confirmed, and why; empty tuples if all is off.
    """
    return _all_off(
        {
            role: partial(_tried, _switches(role, instruments[role]))
            for role in _ORDER
            if role in instruments
        }
    )


def _all_off(
    switches: Mapping[RoleName, Callable[[], Sequence[str]]],
) -> dict[RoleName, tuple[str, ...]]:
    """Switch off, and let Ctrl-C wait until all is done."""
    with _interrupts_wait() as waiting:
        deadline_s = time.monotonic() + _PATIENCE_S
        begun = dict[RoleName, _Switching]()
        for role, switch_off in switches.items():
            begun[role] = _Switching(role, switch_off)
            begun[role].wait(_HEAD_START_S)
        for switching in begun.values():
            switching.wait(deadline_s - time.monotonic())
        unconfirmed = {role: tuple(each.unconfirmed) for role, each in begun.items()}
    try:
        for strike in waiting:
            strike()
    except KeyboardInterrupt as stop:
        note_unconfirmed(stop, tuple(itertools.chain.from_iterable(unconfirmed.values())))
        raise
    return unconfirmed


@contextmanager
def _interrupts_wait() -> Iterator[list[Callable[[], object]]]:
    """Put off what Ctrl-C does in this program; yield the list of what is put off."""
    put_off: list[Callable[[], object]] = []
    if threading.current_thread() is not threading.main_thread():
        yield put_off
        return
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):
        yield put_off
        return
    signal.signal(
        signal.SIGINT, lambda number, _frame: put_off.append(partial(handler, number, None))
    )
    try:
        yield put_off
    finally:
        signal.signal(signal.SIGINT, handler)


def _off(bench: Bench, role: RoleName) -> Sequence[str]:
    """Switch one instrument off; if that fails, once more over a new connection."""
    failed = _tried(_switches(role, getattr(bench, role)))
    if not failed:
        return []
    try:
        if not _reconnected(bench, role):
            return failed
    except BaseException as error:  # noqa: BLE001  # whatever a driver raises, say so
        return [*failed, f"{role} was opened again: {error}"]
    again = _tried(_switches(role, getattr(bench, role)))
    return [*failed, *again] if again else []


def _reconnected(bench: Bench, role: RoleName) -> bool:
    """Open an instrument again, at once or a little later; False where that is not possible."""
    try:
        return bench.reconnect(role)
    except Exception:  # noqa: BLE001  # whatever a driver raises, its cable may be back soon
        time.sleep(_BACK_S)
        return bench.reconnect(role)


def _tried(switches: Sequence[_Switch]) -> list[str]:
    unconfirmed = []
    for name, switch in switches:
        try:
            switch()
        except BaseException as error:  # noqa: BLE001  # whatever a driver raises, go on
            unconfirmed.append(f"{name}: {error}")
    return unconfirmed


def _switches(role: RoleName, instrument: Instrument) -> Sequence[_Switch]:
    match role:
        case "generator":
            generator = cast(SignalGenerator, instrument)
            return (
                ("tweeter ramp to 0 V", lambda: generator.ramp_to(0.0, RAMP_S)),
                ("tweeter output off", lambda: _output_off(generator)),
            )
        case "synthesizers":
            return (("RF off", cast(SynthesizerPair, instrument).rf_off),)
        case "camera":
            return (("camera stopped", cast(Camera, instrument).stop),)


def _output_off(generator: SignalGenerator) -> None:
    generator.output_off()
    if generator.read()[2]:
        raise InstrumentError("generator: its output is still on; pull the tweeter's cable")
