"""Cameras of any maker that speak GigE Vision or USB3 Vision, through Aravis.

Needs Debian's ``gir1.2-aravis-0.8`` and ``python3-gi``, and a virtual environment made with
``--system-site-packages`` by the system's Python.
"""

import importlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.cameras.frames import Delivery
from drivers.cameras.genicam import timestamp_latch
from drivers.cameras.genicam_camera import GenicamCamera
from drivers.cameras.genicam_options import CameraOptions, pulses_for
from drivers.context import BenchContext
from drivers.errors import BenchSetupError, InstrumentError
from drivers.options import read_options
from protocols.bench import CameraSensor

# Registers that every GigE Vision camera has: latch the time, and its upper and lower half.
_TIME_CONTROL: Final = 0x0944
_TIME_HIGH: Final = 0x0948
_TIME_LOW: Final = 0x094C
_LATCH: Final = 2
_RECEIVE_LIMIT: Final = Path("/proc/sys/net/core/rmem_max")


class AravisOptions(CameraOptions):
    """Options of a camera through Aravis."""

    device: str | None = None
    """Name of the camera in Aravis, or its address, needed if there are several."""
    stamped_at: Literal["exposure_start", "exposure_end"] = "exposure_end"
    """What the time stamps of the camera mean. A wrong `exposure_end` costs time; a wrong
    `exposure_start` takes frames for newer than they are."""
    socket_buffer_bytes: Annotated[int, Field(ge=100_000, le=2**30)] = 4_000_000
    """Buffer of the system for packets of a GigE camera, in bytes. The system gives less if
    `sysctl net.core.rmem_max` is lower."""
    packet_socket: bool = True
    """Whether to read packets past the UDP layer of the system if that is permitted (to root)."""


class AravisCamera(GenicamCamera):
    """A camera through Aravis; see `GenicamCamera`.

    Raises
    ------
    BenchSetupError
        If Aravis is missing, an option is wrong, or there is no such camera.
    InstrumentError
        If the camera cannot be opened, or another program has it.
    """

    OPTIONS = AravisOptions

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        options = read_options(
            self.OPTIONS, entry.options, context.description.name, "instruments.camera.options"
        )
        link = AravisLink(options)
        try:
            super().__init__(link, entry, options, pulses_for(options, context))
        except BenchSetupError:
            link.close()
            raise


class AravisFeatures:
    """A camera's features through Aravis; see `drivers.cameras.genicam.Features`."""

    def __init__(self, aravis: Any, device: Any, camera: str) -> None:
        self._aravis, self._device, self._camera = aravis, device, camera

    def has(self, name: str) -> bool:
        """Return whether the feature is there."""
        with asking(self._camera, f"for {name}"):
            return bool(self._device.is_feature_available(name))

    def writable(self, name: str) -> bool:
        """Return whether the feature may be changed."""
        if not self.has(name):
            return False
        read_only = self._aravis.GcAccessMode.RO
        return bool(self._device.get_feature_access_mode(name) != read_only)

    def integer(self, name: str) -> int:
        """Read an integer."""
        with asking(self._camera, f"for {name}"):
            return int(self._device.get_integer_feature_value(name))

    def set_integer(self, name: str, value: int) -> None:
        """Write an integer."""
        with asking(self._camera, f"for {name} {value}"):
            self._device.set_integer_feature_value(name, value)

    def integer_range(self, name: str) -> tuple[int, int, int]:
        """Return least, most and increment."""
        with asking(self._camera, f"for the range of {name}"):
            least, most = self._device.get_integer_feature_bounds(name)
            return least, most, self._device.get_integer_feature_increment(name)

    def real(self, name: str) -> float:
        """Read a float."""
        with asking(self._camera, f"for {name}"):
            return float(self._device.get_float_feature_value(name))

    def set_real(self, name: str, value: float) -> None:
        """Write a float."""
        with asking(self._camera, f"for {name} {value}"):
            self._device.set_float_feature_value(name, value)

    def real_range(self, name: str) -> tuple[float, float]:
        """Return least and most."""
        with asking(self._camera, f"for the range of {name}"):
            least, most = self._device.get_float_feature_bounds(name)
            return least, most

    def text(self, name: str) -> str:
        """Read an enumeration or a string."""
        with asking(self._camera, f"for {name}"):
            return str(self._device.get_string_feature_value(name))

    def set_text(self, name: str, value: str) -> None:
        """Write an enumeration or a string."""
        with asking(self._camera, f"for {name} {value}"):
            self._device.set_string_feature_value(name, value)

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values that may be set at present."""
        with asking(self._camera, f"for the values of {name}"):
            return tuple(self._device.dup_available_enumeration_feature_values_as_strings(name))

    def set_switch(self, name: str, on: bool) -> None:
        """Write a Boolean."""
        with asking(self._camera, f"for {name} {on}"):
            self._device.set_boolean_feature_value(name, on)

    def execute(self, name: str) -> None:
        """Carry out a command."""
        with asking(self._camera, f"to carry out {name}"):
            self._device.execute_command(name)


class AravisLink:
    """An open camera of Aravis; see `drivers.cameras.genicam_options.CameraLink`.

    Parameters
    ----------
    options : AravisOptions
    """

    stamps_frames = True
    # Some cameras begin again at the first number, others count on.
    first_number = None

    def __init__(self, options: AravisOptions) -> None:
        self._aravis = load_aravis()
        self._options = options
        self.stamped_at_end = options.stamped_at == "exposure_end"
        name = options.device or _only_camera(self._aravis)
        self.camera = name
        with asking(name, "to open; check its name, cable and power"):
            self._camera = self._aravis.Camera.new(name)
        self._device = self._camera.get_device()
        self._gige = bool(self._camera.is_gv_device())
        self._require_control()
        self._lost = threading.Event()
        lost = self._lost
        # A closure over the event alone: one over self would keep the camera open for ever.
        self._device.connect("control-lost", lambda _device: lost.set())
        self.features = AravisFeatures(self._aravis, self._device, name)
        self.latch: Callable[[], float] | None = timestamp_latch(self.features) or self._registers()
        self.identity = self._identity()
        self._stream: Any = None

    @property
    def loss_remedy(self) -> str:
        """Remedy for frames that arrive incomplete."""
        asked = self._options.socket_buffer_bytes
        granted = int(_RECEIVE_LIMIT.read_text()) if _RECEIVE_LIMIT.exists() else asked
        if self._gige and granted < asked:
            return (
                f"the system grants sockets {granted} bytes, so as root: "
                f"sysctl -w net.core.rmem_max={asked}"
            )
        return "use jumbo packets (MTU 9000), raise options.socket_buffer_bytes or lower the rate"

    def open_stream(self, buffers: int) -> None:
        """Prepare buffers for `buffers` frames."""
        aravis, options = self._aravis, self._options
        with asking(self.camera, f"to keep {buffers} frames"):
            if self._gige and not options.packet_socket:
                self._camera.gv_set_stream_options(aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
            self._stream = self._camera.create_stream(None, None)
            if self._gige:
                self._stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.FIXED)
                self._stream.set_property("socket-buffer-size", options.socket_buffer_bytes)
            payload_bytes = self._camera.get_payload()
            for _ in range(buffers):
                self._stream.push_buffer(aravis.Buffer.new_allocate(payload_bytes))

    def start(self) -> None:
        """Begin to take frames, all of them, in order."""
        with asking(self.camera, "to start"):
            self._camera.start_acquisition()

    def stop(self) -> None:
        """Take no more frames. One that is gone is not asked, for it would not answer."""
        try:
            if not self._lost.is_set():
                with asking(self.camera, "to stop"):
                    self._camera.stop_acquisition()
        finally:
            self._stream = None

    def receive(self, timeout_s: float) -> Delivery | None:
        """Return the next frame of the stream, None if there is none after `timeout_s`."""
        buffer = self._stream.timeout_pop_buffer(round(1e6 * timeout_s))
        if buffer is None:
            if self._lost.is_set():
                raise InstrumentError(
                    f"camera ({self.camera}): is gone, or another program has taken it, while it "
                    "was asked for frames; check its cable and power, and open the bench again"
                )
            return None
        try:
            if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
                return Delivery(0, 0.0, None)
            stamp_s = 1e-9 * buffer.get_timestamp()
            return Delivery(buffer.get_frame_id(), stamp_s, _pixels(buffer))
        finally:
            self._stream.push_buffer(buffer)

    def trigger(self) -> None:
        """Start one exposure."""
        with asking(self.camera, "to trigger"):
            self._camera.software_trigger()

    def close(self) -> None:
        """Let go of the camera; raises nothing."""
        # Aravis releases a camera when its last reference goes.
        self._stream = self._camera = self._device = self.latch = None
        self.features = AravisFeatures(self._aravis, None, self.camera)

    def _require_control(self) -> None:
        if self._gige and not self._device.is_controller():
            raise InstrumentError(
                f"camera ({self.camera}): another program controls it; close that one first"
            )

    def _registers(self) -> Callable[[], float] | None:
        """Return a latch through the registers of GigE Vision, if the camera has one."""
        if not self._gige:
            return None
        per_s = self._device.get_timestamp_tick_frequency()
        try:
            times = [_latched_ticks(self._device, self.camera) for _ in range(2)]
        except InstrumentError:
            return None
        # Registers without an effect here stay as they are.
        if per_s <= 0 or not 0 < times[0] < times[1]:
            return None
        return lambda: _latched_ticks(self._device, self.camera) / per_s

    def _identity(self) -> str:
        names = ("DeviceFirmwareVersion", "DeviceVersion")
        features = self.features
        firmware = next((features.text(name) for name in names if features.has(name)), "unknown")
        with asking(self.camera, "who it is"):
            return (
                f"{self._camera.get_vendor_name()} {self._camera.get_model_name()}, serial "
                f"{self._camera.get_device_serial_number()}, firmware {firmware}"
            )


@contextmanager
def asking(camera: str, what: str) -> Iterator[None]:
    """Turn an error of Aravis into an `InstrumentError` that says what was asked."""
    error_type = importlib.import_module("gi.repository.GLib").Error
    try:
        yield
    except error_type as error:
        raise InstrumentError(
            f"camera ({camera}): was asked {what}, and refused ({error.message}); check its cable "
            "and power, and that it can do this"
        ) from error


def load_aravis() -> Any:
    """Return Aravis.

    Raises
    ------
    BenchSetupError
        If it, or its binding, is not installed.
    """
    try:
        importlib.import_module("gi").require_version("Aravis", "0.8")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError) as error:
        raise BenchSetupError(
            f"instruments.camera.driver: Aravis cannot be loaded ({error}); install Debian's "
            "gir1.2-aravis-0.8 and python3-gi, and use an environment made by "
            "/usr/bin/python3 -m venv --system-site-packages"
        ) from error


def _only_camera(aravis: Any) -> str:
    aravis.update_device_list()
    found = [aravis.get_device_id(number) for number in range(aravis.get_n_devices())]
    if len(found) == 1:
        return str(found[0])
    raise BenchSetupError(
        f"instruments.camera.options.device: is not given, and there are {len(found)} cameras "
        f"({', '.join(found) or 'none'}); name one, or check its cable and power"
    )


def _latched_ticks(device: Any, camera: str) -> int:
    with asking(camera, "for its time"):
        device.write_register(_TIME_CONTROL, _LATCH)
        return int(device.read_register(_TIME_HIGH) << 32 | device.read_register(_TIME_LOW))


def _pixels(buffer: Any) -> NDArray[Any]:
    """Return a copy of a buffer's unpacked pixels."""
    shape = buffer.get_image_height(), buffer.get_image_width()
    data = buffer.get_data()
    bytes_per_pixel = len(data) // (shape[0] * shape[1])
    dtype = np.uint8 if bytes_per_pixel == 1 else np.dtype("<u2")
    return np.frombuffer(data, dtype, count=shape[0] * shape[1]).reshape(shape).copy()
