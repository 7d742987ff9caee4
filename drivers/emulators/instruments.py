"""The real drivers, each connected to an emulated instrument in the simulated laboratory.

The driver speaks over a real pseudo-terminal or socket to an emulator, and light and air of the
laboratory follow what the emulator plays.
"""

import importlib.util
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Generic, TypeVar

from drivers.context import BenchContext
from drivers.emulators.novatech import NovatechEmulator, OutputState
from drivers.emulators.serving import PtyServer, SocketServer
from drivers.emulators.siglent import SiglentEmulator
from drivers.generators.siglent import SiglentGenerator
from drivers.roles import Camera
from drivers.simulated.instruments import SimulatedCamera
from drivers.simulated.lab import SimulatedLab
from drivers.synthesizers.novatech import Novatech409B
from protocols.bench import (
    CameraSensor,
    Generator,
    Synthesizers,
)

Device = TypeVar("Device")
Server = TypeVar("Server", PtyServer, SocketServer)


@dataclass(frozen=True)
class Served(Generic[Device, Server]):
    """An emulator and the server that carries its bytes.

    It outlives the driver: closing the driver closes the connection, and opening another one finds
    the same instrument. Drivers get it by ``context.share(serve_novatech)``.

    Attributes
    ----------
    lab : SimulatedLab
        Laboratory that follows the instrument.
    device : NovatechEmulator or SiglentEmulator
    server : PtyServer or SocketServer
    """

    lab: SimulatedLab
    device: Device
    server: Server

    def close(self) -> None:
        """Stop the server. May be called twice."""
        self.server.close()


def serve_novatech(context: BenchContext) -> Served[NovatechEmulator, PtyServer]:
    """Connect an emulated Novatech to a pseudo-terminal."""
    lab = context.share(SimulatedLab)
    device = NovatechEmulator(partial(_follow_pair, lab), lab.faults.synthesizers_device)
    return Served(lab, device, PtyServer(device, lab.faults.synthesizers_wire))


def serve_siglent(context: BenchContext) -> Served[SiglentEmulator, SocketServer]:
    """Connect an emulated Siglent to a network socket."""
    lab, output = context.share(SimulatedLab), context.description.instruments.generator.output
    follow = partial(_follow_sine, lab, float(output.amplifier_gain) if output else 1.0)
    device = SiglentEmulator(follow, lab.clock, faults=lab.faults.generator_device)
    return Served(lab, device, SocketServer(device, lab.faults.generator_wire))


# Functions of the laboratory, not methods: an instrument that its own server holds would stay in
# memory, and its laboratory with it, until Python looks for circles.
def _follow_pair(lab: SimulatedLab, outputs: tuple[OutputState, ...]) -> None:
    aom1, aom2 = outputs[:2]
    lab.change(
        difference_hz=aom1.frequency_hz - aom2.frequency_hz,
        rf_on=min(aom1.amplitude, aom2.amplitude) > 0,
    )


def _follow_sine(
    lab: SimulatedLab, volts_per_volt: float, frequency_hz: Fraction, socket_v: float, is_on: bool
) -> None:
    lab.change(drive_hz=frequency_hz, drive_v=socket_v * volts_per_volt if is_on else 0.0)


class EmulatedNovatech(Novatech409B):
    """The driver of the Novatech 409B, connected to an emulator by a pseudo-terminal.

    Parameters
    ----------
    entry : Synthesizers
        Its options are those of the real driver, except `port`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
    device : NovatechEmulator
    """

    def __init__(self, entry: Synthesizers, context: BenchContext) -> None:
        served = context.share(serve_novatech)
        self.lab, self.device = served.lab, served.device
        super().__init__(entry.with_options({**entry.options, "port": served.server.port}), context)


class EmulatedSiglent(SiglentGenerator):
    """The driver of the SDG2042X, connected to an emulator by a network socket.

    Parameters
    ----------
    entry : Generator
        Its options are those of the real driver, except `resource`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
    device : SiglentEmulator
    """

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        served = context.share(serve_siglent)
        self.lab, self.device = served.lab, served.device
        resource = f"TCPIP::127.0.0.1::{served.server.port}::SOCKET"
        super().__init__(entry.with_options({**entry.options, "resource": resource}), context)


def emulated_camera(entry: CameraSensor, context: BenchContext) -> Camera:
    """Open the simulated camera behind pylon's emulator, if pypylon is installed.

    Without it, frames come directly from the simulated camera. (Frames through Aravis need real
    time: name ``drivers.emulators.cameras:LoopbackGigeCamera`` as the driver.)

    Parameters
    ----------
    entry : CameraSensor
    context : BenchContext
    """
    if importlib.util.find_spec("pypylon") is None:
        context.announce("pypylon is not installed: frames do not pass through a camera's software")
        return SimulatedCamera(entry, context)
    from drivers.emulators.cameras import EmulatedBaslerCamera

    return EmulatedBaslerCamera(entry, context)
