"""Knowledge of the clock that an instrument runs on.

Holograms have a phase only if synthesizers, generator and camera share one clock. A driver may say
itself what its instrument runs on, by a method ``reference_clock() -> str`` that returns one of
`SOURCES`. For the drivers of this package it follows from what they checked when they were opened.
"""

from dataclasses import dataclass
from typing import Final, Literal, get_args

from drivers.cameras.genicam_camera import GenicamCamera
from drivers.generators.keysight import KeysightGenerator
from drivers.generators.siglent import SiglentGenerator
from drivers.generators.soundcard import SoundCardGenerator
from drivers.roles import Instrument
from drivers.synthesizers.novatech import Novatech409B
from drivers.synthesizers.srs import SRSPair
from protocols.bench import InstrumentEntry

Source = Literal["external", "own", "unknown"]

SOURCES: Final[tuple[Source, ...]] = get_args(Source)


@dataclass(frozen=True, slots=True)
class ReferenceClock:
    """The clock of an instrument.

    Attributes
    ----------
    source : {'external', 'own', 'unknown'}
        A reference that others can share, a crystal of its own, or not known.
    words : str
        How that is known.
    """

    source: Source
    words: str


def reference_clock(entry: InstrumentEntry, instrument: Instrument) -> ReferenceClock:
    """Return what is known of the clock of an open instrument; nothing is sent to it.

    Parameters
    ----------
    entry : Instrument
        Its entry of the bench file.
    instrument : Instrument
    """
    own_word = getattr(instrument, "reference_clock", None)
    if callable(own_word):
        return _said(str(own_word()))
    match instrument:
        case SiglentGenerator() | KeysightGenerator():
            return _of_generator(entry)
        case SRSPair():
            return _of_srs(entry)
        case Novatech409B():
            return _of_novatech(entry)
        case SoundCardGenerator():
            return ReferenceClock("own", "its crystal, up to 50 ppm off; it takes no reference")
        case GenicamCamera():
            return _of_camera(entry)
        case _ if type(instrument).__module__.startswith(
            ("drivers.simulated.", "drivers.emulators.")
        ):
            return ReferenceClock("external", "the simulated laboratory has one clock")
        case _:
            return ReferenceClock("unknown", "not known: its driver cannot tell")


def _said(word: str) -> ReferenceClock:
    return ReferenceClock(word if word in SOURCES else "unknown", f"its driver says: {word}")


def _of_generator(entry: InstrumentEntry) -> ReferenceClock:
    # The driver does not open before ROSC? has confirmed this option.
    if entry.options.get("reference", "external") == "external":
        return ReferenceClock("external", "external 10 MHz, confirmed by the instrument (ROSC)")
    return ReferenceClock("own", "its own crystal, as options.reference says")


def _of_srs(entry: InstrumentEntry) -> ReferenceClock:
    # The driver does not open if neither of the two has an external timebase.
    if entry.options.get("check_timebase", True):
        return ReferenceClock("external", "one of the two, or both, confirm an external timebase")
    return ReferenceClock("unknown", "not known: options.check_timebase is false")


def _of_novatech(entry: InstrumentEntry) -> ReferenceClock:
    if entry.options.get("external_reference", False):
        return ReferenceClock(
            "external", "external 10 MHz, as the bench file says; the box cannot be asked"
        )
    return ReferenceClock("own", "its own crystal, as options.external_reference says")


def _of_camera(entry: InstrumentEntry) -> ReferenceClock:
    trigger = entry.options.get("trigger", "free")
    if str(trigger).startswith("Line"):
        return ReferenceClock("external", f"every frame is triggered by a pulse at {trigger}")
    return ReferenceClock("own", f"options.trigger is {trigger}: no pulse starts its frames")
