"""Benches that cannot be opened although an earlier program left its outputs on."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import acquire
from drivers.bench_lock import bench_locked
from drivers.emulators.novatech import NovatechEmulator
from drivers.emulators.serving import PtyServer, SocketServer
from drivers.emulators.siglent import SiglentEmulator
from drivers.registry import open_bench
from holography.errors import BenchError
from protocols.bench import BenchFile
from protocols.plan import Plan

_ABSENT_PORT = "/dev/there-is-no-such-port"
# A port of this computer without a listener.
_REFUSED = "TCPIP::127.0.0.1::9::SOCKET"
_UNKNOWN = "TCPIP::no-such-host.invalid::INSTR"


@dataclass(frozen=True)
class Opening:
    """A bench that cannot be opened, and what is to become of it.

    Attributes
    ----------
    name : str
    changes : mapping
        Of the bench file, by key path.
    said : str
        Words of the message.
    tweeter_on, rf_on : bool
        Whether the output stays on, because its instrument cannot be reached.
    identity : str or None
        What the generator says that it is.
    """

    name: str
    changes: Mapping[str, Any]
    said: str
    tweeter_on: bool = False
    rf_on: bool = False
    identity: str | None = None


OPENINGS = (
    Opening(
        "opening: synthesizers absent, tweeter left on",
        {"instruments.synthesizers.options.port": _ABSENT_PORT},
        "port",
        rf_on=True,
    ),
    Opening(
        "opening: generator absent, RF left on",
        {"instruments.generator.options.resource": _REFUSED},
        "generator",
        tweeter_on=True,
    ),
    Opening(
        "opening: generator's host unknown",
        {"instruments.generator.options.resource": _UNKNOWN},
        "host",
        tweeter_on=True,
    ),
    Opening(
        "opening: both absent",
        {
            "instruments.synthesizers.options.port": _ABSENT_PORT,
            "instruments.generator.options.resource": _REFUSED,
        },
        "port",
        tweeter_on=True,
        rf_on=True,
    ),
    Opening(
        "opening: no such camera, both left on",
        {"instruments.camera.driver": "no-such-camera"},
        "no driver",
    ),
    Opening(
        "opening: another generator than expected",
        {},
        "which this driver does not know",
        identity="Siglent Technologies,SDG1032X,SDG1X0001,1.01",
    ),
)


@dataclass(frozen=True)
class Opened:
    """What became of an opening.

    Attributes
    ----------
    message : str
        Empty if the bench was opened.
    unconfirmed : tuple of str
        Outputs that it says may be on.
    tweeter_on, rf_on : bool
        Whether they are.
    """

    message: str
    unconfirmed: tuple[str, ...]
    tweeter_on: bool
    rf_on: bool


@contextmanager
def left_on(
    identity: str | None = None,
) -> Iterator[tuple[NovatechEmulator, SiglentEmulator, Plan]]:
    """Instruments as a killed program left them, and a plan on their bench."""
    box = NovatechEmulator(lambda _: None)
    generator = SiglentEmulator(identity=identity) if identity else SiglentEmulator()
    generator.turn_knob("C1:BSWV AMP,2")
    generator.turn_knob("C1:OUTP ON")
    line, socket = PtyServer(box), SocketServer(generator)
    try:
        bench = BenchFile.from_file("emulated").replace(
            {
                "instruments.synthesizers.driver": "novatech-409b",
                "instruments.synthesizers.options.port": line.port,
                "instruments.generator.driver": "siglent-sdg2042x",
                "instruments.generator.options": {
                    "resource": f"TCPIP::127.0.0.1::{socket.port}::SOCKET",
                    "timeout_s": 0.8,
                },
                "instruments.camera.driver": "simulated",
                "twin": {"mesh": "coarse"},
            }
        )
        yield box, generator, acquire.plan(acquire.load("quick"), bench).plan
    finally:
        line.close()
        socket.close()


def opened(opening: Opening) -> Opened:
    """Open a bench whose outputs are on."""
    with left_on(opening.identity) as (box, generator, plan):
        bench_file = plan.bench.replace(opening.changes)
        message = ""
        unconfirmed: tuple[str, ...] = ()
        try:
            open_bench(bench_file, plan.preparation("faults")).close()
        except BenchError as error:
            message, unconfirmed = str(error), error.unconfirmed
        rf_on = any(output.amplitude > 0 for output in box.outputs[:2])
        return Opened(message, unconfirmed, generator.socket[2], rf_on)


def in_use() -> Opened:
    """Open a bench that another program uses."""
    with left_on() as (box, generator, plan), bench_locked(plan.bench.instruments, "measures"):
        message = ""
        try:
            open_bench(plan.bench, plan.preparation("faults")).close()
        except BenchError as error:
            message = str(error)
        # What another program plays is left alone.
        return Opened(message, (), generator.socket[2], box.outputs[0].amplitude > 0)


def as_expected(opening: Opening, found: Opened) -> bool:
    """Whether everything is off that can be reached, and the rest is named."""
    named = " ".join(found.unconfirmed)
    return (
        opening.said in found.message
        and (found.tweeter_on, found.rf_on) == (opening.tweeter_on, opening.rf_on)
        and ("tweeter" in named or not found.tweeter_on)
        and ("RF" in named or not found.rf_on)
    )
