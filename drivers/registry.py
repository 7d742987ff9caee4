"""Finds the drivers that a bench file names, and opens them as one bench."""

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from itertools import chain
from typing import Any, Final, cast

import numpy as np

from drivers.bench_lock import bench_locked
from drivers.context import BenchContext
from drivers.errors import (
    BenchSetupError,
    OpeningStoppedError,
    note_unconfirmed,
)
from drivers.roles import (
    Bench,
    Camera,
    Instrument,
    RoleName,
    SignalGenerator,
    SynthesizerPair,
)
from drivers.safe_off import instruments_off
from protocols.bench import BenchFile, InstrumentEntry
from protocols.preparation import Preparation

Driver = Callable[[Any, BenchContext], Instrument]

# The drivers of this package that play their instrument themselves.
_SIMULATED: Final = ("drivers.simulated", "drivers.emulators")
_ROLES: Final[Mapping[RoleName, type]] = {
    "synthesizers": SynthesizerPair,
    "generator": SignalGenerator,
    "camera": Camera,
}
# What an instrument of each role could leave on.
OUTPUTS: Final[Mapping[RoleName, str]] = {
    "synthesizers": "RF of the modulators",
    "generator": "tweeter output",
}
_GROUPS: Final = {
    "synthesizers": "reedbench.synthesizers",
    "generator": "reedbench.generator",
    "camera": "reedbench.camera",
}
# The drivers of this package, so that a checkout that was never installed finds them too.
_BUILT_IN: Final = {
    "synthesizers": {
        "simulated": "drivers.simulated:SimulatedSynthesizers",
        "novatech-409b": "drivers.synthesizers.novatech:Novatech409B",
        "srs-sg380": "drivers.synthesizers.srs:SRSPair",
        "emulated-novatech": "drivers.emulators.instruments:EmulatedNovatech",
    },
    "generator": {
        "simulated": "drivers.simulated:SimulatedGenerator",
        "siglent-sdg2042x": "drivers.generators.siglent:SiglentGenerator",
        "keysight-33500b": "drivers.generators.keysight:KeysightGenerator",
        "sound-card": "drivers.generators.soundcard:SoundCardGenerator",
        "emulated-siglent": "drivers.emulators.instruments:EmulatedSiglent",
    },
    "camera": {
        "simulated": "drivers.simulated:SimulatedCamera",
        "basler": "drivers.cameras.basler:BaslerCamera",
        "aravis": "drivers.cameras.aravis:AravisCamera",
        "emulated-camera": "drivers.emulators.instruments:emulated_camera",
    },
}


def open_bench(
    bench_file: BenchFile,
    preparation: Preparation,
    seed: int = 0,
    announce: Callable[[str], None] | None = None,
    *,
    does: str = "a script",
    stopped: Callable[[], bool] | None = None,
) -> Bench:
    """Open the instruments of a bench, which no other program can use then.

    A driver is a callable, usually a class, that takes the instrument's entry of the bench file
    and the `BenchContext`, and returns the open instrument with its outputs off.

    Every instrument is opened even if others fail, because an earlier program that was
    killed may have left any of them on. If one cannot be opened, the others are switched off and
    closed.

    Parameters
    ----------
    bench_file : BenchFile
        Usually an `protocols.bench.BenchFile`.
    preparation : Preparation
        Reed and chamber.
    seed : int
        Everything random on a simulated bench follows from it.
    announce : callable, optional
        Called with a few words about what is being waited for.
    does : str
        What this program does, for the messages of others that want the same bench.
    stopped : callable, optional
        Called before each instrument; returns whether the program has to stop.

    Returns
    -------
    Bench
        A context manager that releases the instruments. Call `drivers.safe_off.safe_off` before
        it is left: only that returns which outputs are not confirmed off.

    Raises
    ------
    BenchInUseError
        If another program uses an instrument of this bench.
    BenchSetupError
        If a driver is unknown, cannot be imported or does not fill its role, or its options or
        those of the simulation are wrong. No instrument stays open.
    InstrumentError
        If an instrument does not answer. None stays open. The notes of the exception name what
        else failed and which outputs may still be on.
    OpeningStoppedError
        If `stopped` says so.
    """
    with ExitStack() as held:
        held.enter_context(bench_locked(bench_file.instruments, does))
        opening = _Opening(bench_file, preparation, seed, announce, stopped)
        held.callback(opening.close_all)
        opening.open_all()
        bench = opening.handed_over()
        bench.release = held.pop_all().close
    return bench


@dataclass(frozen=True, slots=True)
class Opened:
    """Instruments of a bench that could be opened.

    Attributes
    ----------
    instruments : mapping of RoleName to Instrument
        The open ones, with their outputs off.
    failures : mapping of RoleName to Exception
        Why the others could not be opened.
    bench : Bench or None
        All instruments as one bench; None if one is missing.
    """

    instruments: Mapping[RoleName, Instrument]
    failures: Mapping[RoleName, Exception]
    bench: Bench | None


@contextmanager
def open_each(
    bench_file: BenchFile,
    preparation: Preparation,
    seed: int = 0,
    announce: Callable[[str], None] | None = None,
    *,
    roles: Sequence[RoleName] = tuple(_ROLES),
    does: str = "a script",
    stopped: Callable[[], bool] | None = None,
) -> Iterator[Opened]:
    """Open the instruments of a bench each by itself: one that fails does not close the others.

    No other program can use the bench meanwhile. On the way out the instruments are closed, but
    not switched off: whoever switches an output on has to switch it off.

    Parameters
    ----------
    bench_file, preparation, seed, announce, does, stopped
        As for `open_bench`.
    roles : sequence of RoleName
        Which instruments to open, in this order.

    Yields
    ------
    Opened

    Raises
    ------
    BenchInUseError
        If another program uses an instrument of this bench.
    OpeningStoppedError
        If `stopped` says so; what was open is switched off.
    """
    with ExitStack() as held:
        held.enter_context(bench_locked(bench_file.instruments, does))
        opening = _Opening(bench_file, preparation, seed, announce, stopped)
        held.callback(opening.close_all)
        failures = opening.open_each(roles)
        instruments, bench = dict(opening.instruments), None
        if set(instruments) == set(_ROLES):
            bench = held.enter_context(opening.handed_over())
        yield Opened(instruments, failures, bench)


class _Opening:
    """The instruments of a bench while they are opened."""

    def __init__(
        self,
        bench_file: BenchFile,
        preparation: Preparation,
        seed: int,
        announce: Callable[[str], None] | None,
        stopped: Callable[[], bool] | None,
    ) -> None:
        self._seed, self._stopped = seed, stopped or (lambda: False)
        rng = np.random.default_rng(seed)
        self._context = BenchContext(bench_file, preparation, rng, announce or (lambda _: None))
        self.instruments: dict[RoleName, Instrument] = {}

    def open_all(self) -> None:
        """Open every instrument; if one fails, switch the others off and raise its error."""
        failures = self.open_each(tuple(_ROLES))
        if failures:
            first, *others = failures.values()
            for other in others:
                first.add_note(str(other))
            note_unconfirmed(first, self._made_safe(failures))
            raise first

    def open_each(self, roles: Sequence[RoleName]) -> dict[RoleName, Exception]:
        """Open some instruments; return why those could not be opened that failed.

        If this is given up, what was opened is switched off.
        """
        failures: dict[RoleName, Exception] = {}
        try:
            for role in roles:
                if self._stopped():
                    raise OpeningStoppedError("the bench was stopped while it was opened")
                try:
                    self.instruments[role] = self.open_one(role)
                except Exception as error:  # noqa: BLE001  # whatever a driver raises, try the others
                    failures[role] = error
        except BaseException as error:
            note_unconfirmed(error, self._made_safe(failures))
            raise
        return failures

    def handed_over(self) -> Bench:
        """Return all instruments as one bench, which closes them."""
        description, context = self._context.description, self._context
        bench = Bench(
            name=description.name,
            fingerprint=description.fingerprint,
            preparation=context.preparation,
            seed=self._seed,
            synthesizers=cast(SynthesizerPair, self.instruments["synthesizers"]),
            generator=cast(SignalGenerator, self.instruments["generator"]),
            camera=cast(Camera, self.instruments["camera"]),
            clock=context.clock,
            surroundings=context.surroundings,
            simulated_disorder=context.simulated_disorder,
            reopen=self.open_one,
        )
        self.instruments.clear()
        return bench

    def open_one(self, role: RoleName) -> Instrument:
        """Open the instrument of a role."""
        entry: InstrumentEntry = getattr(self._context.description.instruments, role)
        instrument = find_driver(role, entry.driver)(entry, self._context)
        try:
            return _filling(_ROLES[role], role, entry.driver, instrument)
        except BenchSetupError:
            instrument.close()
            raise

    def close_all(self) -> None:
        """Close what is open and belongs to no bench yet, and what the drivers share."""
        with ExitStack() as closing:
            closing.callback(self._context.close)
            for instrument in self.instruments.values():
                closing.callback(instrument.close)

    def _made_safe(self, failures: Mapping[RoleName, Exception]) -> tuple[str, ...]:
        """Switch off what could be opened; return which outputs may still be on."""
        unconfirmed = chain.from_iterable(instruments_off(self.instruments).values())
        unreached = [
            f"{output}: may be on, if an earlier program left it on; the instrument was not opened"
            for role, output in OUTPUTS.items()
            # Of a wrong bench file nothing follows for the instruments.
            if role in failures and not isinstance(failures[role], BenchSetupError)
        ]
        return (*unconfirmed, *unreached)


def find_driver(role: str, name: str) -> Driver:
    """Return the driver of a short name or of ``package.module:Class``.

    Parameters
    ----------
    role : {'synthesizers', 'generator', 'camera'}
    name : str

    Raises
    ------
    BenchSetupError
        If there is none; the message lists the short names that are known.
    """
    known = known_drivers(role)
    place = name if ":" in name else known.get(name)
    if place is None:
        raise BenchSetupError(
            f"instruments.{role}.driver: there is no driver {name!r}; known are "
            f"{', '.join(sorted(known))}, or write package.module:Class"
        )
    module_name, _, attribute = place.partition(":")
    try:
        driver = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise BenchSetupError(
            f"instruments.{role}.driver: {place!r} cannot be loaded ({error}); check the name, and "
            "that the package is installed"
        ) from error
    return cast(Driver, driver)


def is_simulated(role: str, name: str) -> bool:
    """Return whether a driver plays its instrument itself, so that no real output depends on it.

    Parameters
    ----------
    role, name : str
        As for `find_driver`.

    Raises
    ------
    BenchSetupError
        If there is no such driver.
    """
    module = find_driver(role, name).__module__
    return any(module == package or module.startswith(f"{package}.") for package in _SIMULATED)


def known_drivers(role: str) -> dict[str, str]:
    """Short names of the drivers of a role, each with its ``package.module:Class``."""
    found = {point.name: point.value for point in entry_points(group=_GROUPS[role])}
    return _BUILT_IN[role] | found


def _filling(role: type, name: str, driver: str, instrument: Instrument) -> Instrument:
    if isinstance(instrument, role):
        return instrument
    lacking = sorted(m for m in dir(role) if not m.startswith("_") and not hasattr(instrument, m))
    raise BenchSetupError(
        f"instruments.{name}.driver: {driver!r} is no {role.__name__}, it lacks "
        f"{', '.join(lacking)}; name another driver or complete it"
    )
