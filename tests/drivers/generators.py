"""Benches with a simulated generator behind a real transport, for tests of its driver."""

import socket
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from unittest import mock

import numpy as np
from pyvisa_py.tcpip import TCPIPSocketSession

from drivers.context import BenchContext
from drivers.emulators.keysight import KeysightEmulator
from drivers.emulators.serving import (
    FaultyWire,
    SocketServer,
    interrupt,
    unterminated,
)
from drivers.emulators.siglent import SiglentEmulator
from drivers.generators.keysight import KeysightGenerator
from drivers.generators.siglent import SiglentGenerator
from drivers.simulated.lab import VirtualClock
from protocols.bench import BenchFile
from protocols.preparation import Preparation
from tests.drivers.usbtmc_bus import UsbtmcInstrument, plugged_in
from tests.drivers.vxi11_server import Vxi11Server

BENCH = BenchFile.from_file()
GAIN = 2.0
MOST_V = 16.0
DRIVERS = {SiglentEmulator: SiglentGenerator, KeysightEmulator: KeysightGenerator}
DEVICES = {"siglent": SiglentEmulator, "keysight": KeysightEmulator}


class Wire:
    """Carries bytes to a device and keeps them; spoils what it carries from a moment on."""

    def __init__(self, device):
        self.device = self._carrier = device
        self.heard = []

    def receive(self, data):
        self.heard += data.decode("ascii").splitlines()
        return self._carrier.receive(data)

    def interrupt(self):
        return interrupt(self.device)

    def unterminated(self):
        unterminated(self.device)

    def spoil(self, faults):
        """Count commands and answers from now on."""
        self._carrier = FaultyWire(self.device, faults)


@dataclass
class Stand:
    """A simulated generator on a wire, and the benches that its driver is opened on.

    Attributes
    ----------
    device, wire, resource
    server : SocketServer or Vxi11Server or None
    clock : VirtualClock or WallClock
        Of the benches, and of the device unless that is on another thread.
    changes : list of (Fraction, float, bool)
        What was at the socket of channel 1, in order.
    contexts : list of BenchContext
    """

    device: object
    wire: Wire
    resource: str
    server: object
    clock: object
    changes: list
    contexts: list = field(default_factory=list)
    generators: list = field(default_factory=list)

    def open(self, options=None, **changes):
        """Open the driver on a bench with some keys of the bench file changed."""
        bench_file = BENCH.replace(
            {
                "instruments.generator.options": {
                    "resource": self.resource,
                    "timeout_s": 1.0,
                    **(options or {}),
                },
                "instruments.generator.output": {"amplifier_gain": GAIN, "load": "8 ohm"},
                **changes,
            }
        )
        preparation = Preparation("R07", "A", "asymmetric")
        context = BenchContext(bench_file, preparation, np.random.default_rng(1), print, self.clock)
        self.contexts.append(context)
        driver = DRIVERS[type(self.device)]
        self.generators.append(driver(bench_file.instruments.generator, context))
        return self.generators[-1]


class Stands:
    """Sets up stands, and takes them down."""

    def __init__(self):
        self._taken_down = ExitStack()

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self._taken_down.close()

    def __call__(self, maker, wire="usb", clock=None, **settings):
        """Put a new device of a maker on ``usb``, a ``socket`` or ``vxi11``."""
        changes, clock = [], clock or VirtualClock()

        def changed(*socket):
            changes.append(socket)

        clock_of_device = clock if wire == "usb" else None
        device = DEVICES[maker](changed, clock_of_device, **settings)
        carrier = Wire(device)
        resource, server = self._connected(carrier, wire)
        stand = Stand(device, carrier, resource, server, clock, changes)
        self._taken_down.callback(lambda: [generator.close() for generator in stand.generators])
        return stand

    def _connected(self, device, wire):
        if wire == "usb":
            instrument = UsbtmcInstrument(device, 0xF4EC, 0x1101, "SIM000001")
            self._taken_down.enter_context(plugged_in(instrument))
            return instrument.resource, None
        self._taken_down.enter_context(_without_delay())
        server = (SocketServer if wire == "socket" else Vxi11Server)(device)
        self._taken_down.callback(server.close)
        if wire == "socket":
            return f"TCPIP0::127.0.0.1::{server.port}::SOCKET", server
        return f"TCPIP0::127.0.0.1,{server.port}::inst0::INSTR", server


@contextmanager
def _without_delay():
    """Let pyvisa-py send small messages at once, which saves tests 40 ms each (Nagle)."""
    connect = TCPIPSocketSession._connect  # noqa: SLF001  # its own option for this has no effect

    def connected(session):
        status = connect(session)
        session.interface.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return status

    with mock.patch.object(TCPIPSocketSession, "_connect", connected):
        yield


def answer(device, line):
    """Return what a device answers to a line."""
    return device.receive(f"{line}\n".encode("ascii")).decode("ascii").rstrip("\n")
