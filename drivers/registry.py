"""Finds the drivers that a bench file names, and opens them as one bench."""

import importlib
from collections.abc import Callable
from contextlib import ExitStack
from importlib.metadata import entry_points
from typing import Any, Final, TypeVar, cast

import numpy as np

from drivers.context import BenchContext
from drivers.description import BenchDescription, InstrumentDescription
from drivers.errors import BenchSetupError
from drivers.roles import Bench, Camera, Instrument, Preparation, SignalGenerator, SynthesizerPair

R = TypeVar("R", bound=Instrument)

Driver = Callable[[Any, BenchContext], Instrument]

_GROUPS: Final = {
    "synthesizers": "reedbench.synthesizers",
    "generator": "reedbench.generator",
    "camera": "reedbench.camera",
}
# The drivers of this package, so that a checkout that was never installed finds them too.
_BUILT_IN: Final = {
    "synthesizers": {
        "simulated": "drivers.simulated:SimulatedSynthesizers",
        "novatech-409b": "drivers.novatech:Novatech409B",
        "srs-sg380": "drivers.srs:SRSPair",
        "wire-novatech": "drivers.simulated.wire.instruments:WireNovatech",
    },
    "generator": {
        "simulated": "drivers.simulated:SimulatedGenerator",
        "siglent-sdg2042x": "drivers.siglent:SiglentGenerator",
        "keysight-33500b": "drivers.keysight:KeysightGenerator",
        "sound-card": "drivers.soundcard:SoundCardGenerator",
        "wire-siglent": "drivers.simulated.wire.instruments:WireSiglent",
    },
    "camera": {
        "simulated": "drivers.simulated:SimulatedCamera",
        "basler": "drivers.basler:BaslerCamera",
        "aravis": "drivers.aravis:AravisCamera",
        "wire-camera": "drivers.simulated.wire.instruments:wire_camera",
    },
}


def open_bench(
    bench_file: BenchDescription,
    preparation: Preparation,
    seed: int = 0,
    announce: Callable[[str], None] | None = None,
) -> Bench:
    """Open the instruments of a bench.

    A driver is a callable, usually a class, that takes the instrument's entry of the bench file
    and the `BenchContext`, and returns the open instrument.

    Parameters
    ----------
    bench_file : BenchDescription
        Usually an `acquire.bench_file.BenchFile`.
    preparation : Preparation
        What stands on the bench.
    seed : int
        Everything random on a simulated bench follows from it.
    announce : callable, optional
        Told, in a few words, what is being waited for.

    Returns
    -------
    Bench
        A context manager that releases the instruments.

    Raises
    ------
    BenchSetupError
        If a driver is unknown, cannot be imported or does not fill its role, or its options or
        those of the twin are wrong. No instrument stays open.
    InstrumentError
        If an instrument does not answer. None stays open.
    """
    context = BenchContext(
        bench_file, preparation, np.random.default_rng(seed), announce or (lambda _: None)
    )
    entries = bench_file.instruments
    with ExitStack() as opened:

        def opened_as(role: type[R], name: str, entry: InstrumentDescription) -> R:
            instrument = find_driver(name, entry.driver)(entry, context)
            opened.callback(instrument.close)
            return _filling(role, name, entry.driver, instrument)

        bench = Bench(
            name=bench_file.name,
            fingerprint=bench_file.fingerprint,
            preparation=preparation,
            seed=seed,
            synthesizers=opened_as(SynthesizerPair, "synthesizers", entries.synthesizers),  # type: ignore[type-abstract]  # a role, not instantiated
            generator=opened_as(SignalGenerator, "generator", entries.generator),  # type: ignore[type-abstract]  # a role, not instantiated
            camera=opened_as(Camera, "camera", entries.camera),  # type: ignore[type-abstract]  # a role, not instantiated
            clock=context.clock,
            surroundings=context.surroundings,
        )
        opened.pop_all()
    return bench


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


def known_drivers(role: str) -> dict[str, str]:
    """Short names of the drivers of a role, each with its ``package.module:Class``."""
    found = {point.name: point.value for point in entry_points(group=_GROUPS[role])}
    return _BUILT_IN[role] | found


def _filling(role: type[R], name: str, driver: str, instrument: Instrument) -> R:
    if isinstance(instrument, role):
        return instrument
    lacking = sorted(m for m in dir(role) if not m.startswith("_") and not hasattr(instrument, m))
    raise BenchSetupError(
        f"instruments.{name}.driver: {driver!r} is no {role.__name__}, it lacks "
        f"{', '.join(lacking)}; name another driver or complete it"
    )
