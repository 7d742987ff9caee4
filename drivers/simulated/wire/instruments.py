"""The real drivers, each in front of a simulated instrument in the simulated laboratory.

What a real driver says goes over a real pseudo-terminal or socket to a device that knows nothing of
it; what the device then plays is what the laboratory's light and air follow.
"""

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from drivers.context import BenchContext
from drivers.description import (
    CameraDescription,
    GeneratorDescription,
    OutputDescription,
    SynthesizersDescription,
)
from drivers.novatech import Novatech409B
from drivers.roles import Camera
from drivers.siglent import SiglentGenerator
from drivers.simulated.instruments import SimulatedCamera
from drivers.simulated.lab import SimulatedLab
from drivers.simulated.wire.novatech import NovatechDevice, Output
from drivers.simulated.wire.serving import PtyServer, SocketServer
from drivers.simulated.wire.siglent import SiglentDevice


@dataclass(frozen=True)
class _Synthesizers:
    """Entry of a pair of synthesizers, with other options."""

    driver: str
    options: Mapping[str, Any]
    step_hz: Fraction
    centre_hz: Fraction
    window_hz: Fraction


@dataclass(frozen=True)
class _Generator:
    """Entry of a generator, with other options."""

    driver: str
    options: Mapping[str, Any]
    step_hz: Fraction
    output: OutputDescription | None


class WireNovatech(Novatech409B):
    """The driver of the Novatech 409B, with a simulated one at the far end of a pseudo-terminal.

    Parameters
    ----------
    entry : SynthesizersDescription
        Its options are those of the real driver, but for `port`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
        The room that the simulated box stands in.
    device : NovatechDevice
    """

    def __init__(self, entry: SynthesizersDescription, context: BenchContext) -> None:
        self.lab = context.share(SimulatedLab)
        self.device = NovatechDevice(self._follow)
        self._server = PtyServer(self.device, self.lab.faults.synthesizers_wire)
        described = _Synthesizers(
            entry.driver,
            {**entry.options, "port": self._server.port},
            entry.step_hz,
            entry.centre_hz,
            entry.window_hz,
        )
        try:
            super().__init__(described, context)
        except BaseException:
            self._server.close()
            raise

    def close(self) -> None:
        """Close the port, and take the box away. May be called twice."""
        super().close()
        self._server.close()

    def _follow(self, outputs: tuple[Output, ...]) -> None:
        aom1, aom2 = outputs[:2]
        self.lab.change(
            difference_hz=aom1.frequency_hz - aom2.frequency_hz,
            rf_on=min(aom1.amplitude, aom2.amplitude) > 0,
        )


class WireSiglent(SiglentGenerator):
    """The driver of the SDG2042X, with a simulated one at the far end of a socket.

    Parameters
    ----------
    entry : GeneratorDescription
        Its options are those of the real driver, but for `resource`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
        The room that the simulated generator stands in.
    device : SiglentDevice
    """

    def __init__(self, entry: GeneratorDescription, context: BenchContext) -> None:
        self.lab = context.share(SimulatedLab)
        self._volts_per_volt = float(entry.output.amplifier_gain) if entry.output else 1.0
        self.device = SiglentDevice(self._follow, self.lab.clock)
        self._server = SocketServer(self.device, self.lab.faults.generator_wire)
        resource = f"TCPIP::127.0.0.1::{self._server.port}::SOCKET"
        described = _Generator(
            entry.driver, {**entry.options, "resource": resource}, entry.step_hz, entry.output
        )
        try:
            super().__init__(described, context)
        except BaseException:
            self._server.close()
            raise

    def close(self) -> None:
        """Hang up, and take the generator away. May be called twice."""
        super().close()
        self._server.close()

    def _follow(self, frequency_hz: Fraction, socket_v: float, is_on: bool) -> None:
        volts = socket_v * self._volts_per_volt if is_on else 0.0
        self.lab.change(drive_hz=frequency_hz, drive_v=volts)


def wire_camera(entry: CameraDescription, context: BenchContext) -> Camera:
    """Open the simulated camera behind pylon's emulator, if pypylon is installed.

    Without it, frames come from the simulated camera straight. (Frames through Aravis need real
    time: name ``drivers.simulated.wire.cameras:LoopbackGigeCamera`` as the driver.)

    Parameters
    ----------
    entry : CameraDescription
    context : BenchContext
    """
    if importlib.util.find_spec("pypylon") is None:
        context.announce("pypylon is not installed: frames do not pass through a camera's software")
        return SimulatedCamera(entry, context)
    from drivers.simulated.wire.cameras import EmulatedBaslerCamera

    return EmulatedBaslerCamera(entry, context)
