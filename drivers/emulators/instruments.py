"""The real drivers, each in front of a simulated instrument in the simulated laboratory.

What a real driver says goes over a real pseudo-terminal or socket to a device that knows nothing of
it; what the device then plays is what the laboratory's light and air follow.
"""

import importlib.util
from fractions import Fraction
from functools import partial

from drivers.context import BenchContext
from drivers.emulators.novatech import NovatechDevice, Output
from drivers.emulators.serving import PtyServer, SocketServer
from drivers.emulators.siglent import SiglentDevice
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


class NovatechFarEnd:
    """A simulated Novatech at the far end of a pseudo-terminal; ``context.share(NovatechFarEnd)``.

    It outlives the driver: closing the driver hangs up, and opening another finds the same box.

    Parameters
    ----------
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
        The room that the simulated box stands in.
    device : NovatechDevice
    server : PtyServer
    """

    def __init__(self, context: BenchContext) -> None:
        self.lab = context.share(SimulatedLab)
        faults = self.lab.faults
        self.device = NovatechDevice(partial(_follow_pair, self.lab), faults.synthesizers_device)
        self.server = PtyServer(self.device, faults.synthesizers_wire)

    def close(self) -> None:
        """Take the box away. May be called twice."""
        self.server.close()


# Functions of the laboratory, not methods: an instrument that its own far end holds would stay in
# memory, and its laboratory with it, until Python looks for circles.
def _follow_pair(lab: SimulatedLab, outputs: tuple[Output, ...]) -> None:
    aom1, aom2 = outputs[:2]
    lab.change(
        difference_hz=aom1.frequency_hz - aom2.frequency_hz,
        rf_on=min(aom1.amplitude, aom2.amplitude) > 0,
    )


def _follow_sine(
    lab: SimulatedLab, volts_per_volt: float, frequency_hz: Fraction, socket_v: float, is_on: bool
) -> None:
    lab.change(drive_hz=frequency_hz, drive_v=socket_v * volts_per_volt if is_on else 0.0)


class SiglentFarEnd:
    """A simulated Siglent at the far end of a socket; ``context.share(SiglentFarEnd)``.

    It outlives the driver: closing the driver hangs up, and opening another finds the same
    generator.

    Parameters
    ----------
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
        The room that the simulated generator stands in.
    device : SiglentDevice
    server : SocketServer
    """

    def __init__(self, context: BenchContext) -> None:
        self.lab = context.share(SimulatedLab)
        output, faults = context.description.instruments.generator.output, self.lab.faults
        follow = partial(_follow_sine, self.lab, float(output.amplifier_gain) if output else 1.0)
        self.device = SiglentDevice(follow, self.lab.clock, faults=faults.generator_device)
        self.server = SocketServer(self.device, faults.generator_wire)

    def close(self) -> None:
        """Take the generator away. May be called twice."""
        self.server.close()


class WireNovatech(Novatech409B):
    """The driver of the Novatech 409B, with a simulated one at the far end of a pseudo-terminal.

    Parameters
    ----------
    entry : Synthesizers
        Its options are those of the real driver, but for `port`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
    device : NovatechDevice
        See `NovatechFarEnd`.
    """

    def __init__(self, entry: Synthesizers, context: BenchContext) -> None:
        far_end = context.share(NovatechFarEnd)
        self.lab, self.device = far_end.lab, far_end.device
        super().__init__(
            entry.with_options({**entry.options, "port": far_end.server.port}), context
        )


class WireSiglent(SiglentGenerator):
    """The driver of the SDG2042X, with a simulated one at the far end of a socket.

    Parameters
    ----------
    entry : Generator
        Its options are those of the real driver, but for `resource`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
    device : SiglentDevice
        See `SiglentFarEnd`.
    """

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        far_end = context.share(SiglentFarEnd)
        self.lab, self.device = far_end.lab, far_end.device
        resource = f"TCPIP::127.0.0.1::{far_end.server.port}::SOCKET"
        super().__init__(entry.with_options({**entry.options, "resource": resource}), context)


def wire_camera(entry: CameraSensor, context: BenchContext) -> Camera:
    """Open the simulated camera behind pylon's emulator, if pypylon is installed.

    Without it, frames come from the simulated camera straight. (Frames through Aravis need real
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
