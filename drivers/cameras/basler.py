"""Basler's cameras, GigE and USB, through pylon (the extra ``basler``)."""

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from drivers.cameras.frames import Delivery
from drivers.cameras.genicam import timestamp_latch
from drivers.cameras.genicam_camera import GenicamCamera
from drivers.cameras.genicam_options import CameraOptions, pulses_for
from drivers.context import BenchContext
from drivers.errors import BenchSetupError, InstrumentError
from drivers.options import read_options
from protocols.bench import CameraSensor

# What pylon says instead of a block id that it does not know.
_NO_NUMBER: Final = 2**64 - 1
_TRIGGER_READY_MS: Final = 1000


class BaslerOptions(CameraOptions):
    """Options of a Basler camera."""

    serial: str | None = None
    """Serial number of the camera, needed if there are several."""


class BaslerCamera(GenicamCamera):
    """A Basler camera; see `GenicamCamera`.

    pylon's time stamps tell the start of an exposure. The emulated cameras that pylon offers if
    ``PYLON_CAMEMU`` is set stamp nothing, see `drivers.cameras.clock.ArrivalClock`.

    Raises
    ------
    BenchSetupError
        If pypylon is missing, an option is wrong, or there is no such camera.
    InstrumentError
        If the camera cannot be opened.
    """

    OPTIONS = BaslerOptions

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        options = read_options(
            self.OPTIONS, entry.options, context.description.name, "instruments.camera.options"
        )
        link = PylonLink(options.serial)
        try:
            super().__init__(link, entry, options, pulses_for(options, context))
        except BenchSetupError:
            link.close()
            raise


class PylonFeatures:
    """A camera's features through pylon; see `drivers.cameras.genicam.Features`."""

    def __init__(self, pylon: Any, nodes: Any, camera: str) -> None:
        self._pylon, self._genicam = pylon, importlib.import_module("pypylon.genicam")
        self._nodes, self._camera = nodes, camera

    def has(self, name: str) -> bool:
        """Return whether the feature is there."""
        with self._asking(f"for {name}"):
            return bool(self._genicam.IsAvailable(self._nodes.GetNode(name)))

    def writable(self, name: str) -> bool:
        """Return whether the feature may be changed."""
        with self._asking(f"for {name}"):
            return bool(self._genicam.IsWritable(self._nodes.GetNode(name)))

    def integer(self, name: str) -> int:
        """Read an integer."""
        return int(self._value(name))

    def set_integer(self, name: str, value: int) -> None:
        """Write an integer."""
        self._set(name, value)

    def integer_range(self, name: str) -> tuple[int, int, int]:
        """Return least, most and increment."""
        with self._asking(f"for the range of {name}"):
            node = self._nodes.GetNode(name)
            return int(node.GetMin()), int(node.GetMax()), int(node.GetInc())

    def real(self, name: str) -> float:
        """Read a float."""
        return float(self._value(name))

    def set_real(self, name: str, value: float) -> None:
        """Write a float."""
        self._set(name, value)

    def real_range(self, name: str) -> tuple[float, float]:
        """Return least and most."""
        with self._asking(f"for the range of {name}"):
            node = self._nodes.GetNode(name)
            return float(node.GetMin()), float(node.GetMax())

    def text(self, name: str) -> str:
        """Read an enumeration or a string."""
        return str(self._value(name))

    def set_text(self, name: str, value: str) -> None:
        """Write an enumeration or a string."""
        self._set(name, value)

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values that may be set at present."""
        with self._asking(f"for the values of {name}"):
            entries = self._nodes.GetNode(name).GetEntries()
            return tuple(
                str(entry.GetSymbolic()) for entry in entries if self._genicam.IsAvailable(entry)
            )

    def set_switch(self, name: str, on: bool) -> None:
        """Write a Boolean."""
        self._set(name, on)

    def execute(self, name: str) -> None:
        """Carry out a command."""
        with self._asking(f"to carry out {name}"):
            self._nodes.GetNode(name).Execute()

    def _value(self, name: str) -> Any:
        with self._asking(f"for {name}"):
            return self._nodes.GetNode(name).GetValue()

    def _set(self, name: str, value: Any) -> None:
        with self._asking(f"for {name} {value}"):
            self._nodes.GetNode(name).SetValue(value)

    @contextmanager
    def _asking(self, what: str) -> Iterator[None]:
        with asking(self._pylon, self._camera, what):
            yield


class PylonLink:
    """An open camera of pylon; see `drivers.cameras.genicam_options.CameraLink`.

    Parameters
    ----------
    serial : str or None
        Not needed if there is only one camera.
    """

    loss_remedy = (
        "use jumbo packets (MTU 9000) or another USB socket, raise the packet delay "
        "(GevSCPD), or lower the frame rate"
    )
    stamped_at_end = False

    def __init__(self, serial: str | None) -> None:
        self._pylon = load_pylon()
        factory = self._pylon.TlFactory.GetInstance()
        with asking(self._pylon, serial or "Basler", "to be listed"):
            chosen = _choose(factory.EnumerateDevices(), serial)
        self.camera = f"{chosen.GetModelName()} {chosen.GetSerialNumber()}"
        with asking(self._pylon, self.camera, "to open; let go of it in other programs"):
            self.device = self._pylon.InstantCamera(factory.CreateDevice(chosen))
            self.device.Open()
        self.features = PylonFeatures(self._pylon, self.device.GetNodeMap(), self.camera)
        self.latch: Callable[[], float] | None = timestamp_latch(self.features)
        self.stamps_frames = self.latch is not None
        self.first_number = 1 if "GigE" in chosen.GetDeviceClass() else 0
        self._per_s = (
            self.features.integer("GevTimestampTickFrequency")
            if self.features.has("GevTimestampTickFrequency")
            else 1_000_000_000
        )
        self.identity = _identity(chosen, self.features)

    def open_stream(self, buffers: int) -> None:
        """Prepare buffers for `buffers` frames."""
        with asking(self._pylon, self.camera, f"to keep {buffers} frames"):
            self.device.MaxNumBuffer.SetValue(buffers)

    def start(self) -> None:
        """Begin to take frames, all of them, in order."""
        with asking(self._pylon, self.camera, "to start"):
            self.device.StartGrabbing(self._pylon.GrabStrategy_OneByOne)

    def stop(self) -> None:
        """Take no more frames."""
        with asking(self._pylon, self.camera, "to stop"):
            self.device.StopGrabbing()

    def receive(self, timeout_s: float) -> Delivery | None:
        """Return the next frame of the stream, None if there is none after `timeout_s`."""
        with asking(self._pylon, self.camera, "for a frame"):
            result = self.device.RetrieveResult(
                round(1e3 * timeout_s), self._pylon.TimeoutHandling_Return
            )
            if not result.IsValid():
                self._require_there()
                return None
            try:
                # The error code may be 0 even so.
                if not result.GrabSucceeded():
                    return Delivery(0, 0.0, None)
                number, stamp_s = int(result.GetBlockID()), result.GetTimeStamp() / self._per_s
                self._require_number(number)
                return Delivery(number, stamp_s, result.GetArray())
            finally:
                result.Release()

    def trigger(self) -> None:
        """Start one exposure, as soon as the camera is ready for it."""
        with asking(self._pylon, self.camera, "to trigger"):
            ready = self.device.WaitForFrameTriggerReady(
                _TRIGGER_READY_MS, self._pylon.TimeoutHandling_Return
            )
            # A camera that is not ready passes over the trigger without a word.
            if ready:
                self.device.ExecuteSoftwareTrigger()
        if not ready:
            raise InstrumentError(
                f"camera ({self.camera}): is not ready for a trigger within "
                f"{1e-3 * _TRIGGER_READY_MS:g} s; shorten the exposure or lower the frame rate"
            )

    def close(self) -> None:
        """Let go of the camera; raises nothing."""
        # A camera that is gone cannot be closed.
        with suppress(self._pylon.GenericException):
            self.device.Close()
            self.device.DestroyDevice()

    def _require_number(self, number: int) -> None:
        if number == _NO_NUMBER:
            raise InstrumentError(
                f"camera ({self.camera}): does not number its frames, so that lost frames would "
                "not be noticed; update its firmware, or use another camera"
            )

    def _require_there(self) -> None:
        if self.device.IsCameraDeviceRemoved():
            raise InstrumentError(
                f"camera ({self.camera}): is gone while it was asked for frames; check its cable "
                "and power, and open the bench again"
            )


@contextmanager
def asking(pylon: Any, camera: str, what: str) -> Iterator[None]:
    """Turn an error of pylon into an `InstrumentError` that says what was asked."""
    try:
        yield
    except pylon.GenericException as error:
        reason = str(error).split(" : ")[0].strip().rstrip(".")
        raise InstrumentError(
            f"camera ({camera}): was asked {what}, and refused ({reason}); check its cable and "
            "power, and that it can do this"
        ) from error


def load_pylon() -> Any:
    """Return the module pypylon.pylon.

    Raises
    ------
    BenchSetupError
        If it is not installed.
    """
    try:
        return importlib.import_module("pypylon.pylon")
    except ImportError as error:
        raise BenchSetupError(
            f"instruments.camera.driver: Basler's cameras need pypylon ({error}); install it: "
            "pip install 'reedbench[basler]'"
        ) from error


def _choose(found: Any, serial: str | None) -> Any:
    """Return the camera of a serial number, or the only one."""
    serials = [device.GetSerialNumber() for device in found]
    if serial in serials:
        return found[serials.index(serial)]
    if serial is None and len(serials) == 1:
        return found[0]
    listed = ", ".join(serials) or "none"
    raise BenchSetupError(
        f"instruments.camera.options.serial: was asked for camera {serial or 'of any number'}, "
        f"found {listed}; name one, or check its cable and power"
    )


def _identity(chosen: Any, features: PylonFeatures) -> str:
    names = ("DeviceFirmwareVersion", "DeviceVersion")
    firmware = next((features.text(name) for name in names if features.has(name)), "unknown")
    return (
        f"{chosen.GetVendorName()} {chosen.GetModelName()}, serial {chosen.GetSerialNumber()}, "
        f"firmware {firmware}"
    )
