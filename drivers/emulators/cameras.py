"""Frames of the simulated laboratory, sent through software of others to the real drivers.

Two other people's cameras without glass take our pixels: the emulator within pylon, and the GigE
camera within Aravis, which speaks the real protocol on this computer's loopback. Both drivers of
this module fill the camera's role, so a bench file may name them, as
``drivers.emulators.cameras:EmulatedBaslerCamera`` and ``…:LoopbackGigeCamera``.
"""

import ctypes
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.aravis import AravisCamera, load_aravis
from drivers.cameras.basler import BaslerCamera, load_pylon
from drivers.context import BenchContext
from drivers.errors import BenchSetupError
from drivers.roles import Frame
from drivers.simulated.instruments import SimulatedCamera
from drivers.simulated.lab import SimulatedLab, VirtualClock
from protocols.bench import CameraSensor

_EMULATED_SERIAL: Final = "0815-0000"
_LOOPBACK: Final = "127.0.0.1"

Render = Callable[[float], NDArray[np.uint16]]

# void fill (ArvBuffer*, void *data, guint32 exposure_us, guint32 gain, ArvPixelFormat)
_Fill: Final = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class EmulatedBaslerCamera:
    """The simulated camera, whose pixels pass through pylon's emulator and the Basler driver.

    The emulator plays the files of a folder from the first one on whenever it is started. So every
    `grab` renders its frames, writes them into the folder, and starts and stops the real driver.
    This shows settings, pixels and broken frames of the real driver. It cannot show free running,
    waiting for fresh frames, or time stamps: those stay the simulated camera's.

    Parameters
    ----------
    entry : CameraSensor
        Its options are those of `drivers.cameras.basler.BaslerOptions`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
        Laboratory that it belongs to.
    basler : BaslerCamera
        The real driver.

    Raises
    ------
    BenchSetupError
        If pypylon is missing, or was loaded before without ``PYLON_CAMEMU``.
    """

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        # Read by pylon when it is loaded.
        os.environ.setdefault("PYLON_CAMEMU", "1")
        self._simulated = SimulatedCamera(entry.with_options({}), context)
        self.lab = self._simulated.lab
        options = {"serial": _EMULATED_SERIAL, **entry.options}
        self.basler = BaslerCamera(entry.with_options(options), context)
        self._bits = entry.bits
        self._folder = tempfile.TemporaryDirectory(prefix="reedbench-frames-")

    @property
    def identity(self) -> str:
        """Identity of the emulator, and of the simulation behind it."""
        return f"{self.basler.link.identity}; frames and times of a {self._simulated.identity}"

    @property
    def saturation_dn(self) -> int:
        """Number at which a pixel is saturated."""
        return self._simulated.saturation_dn

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Set both cameras up; see `Camera.configure`."""
        self._simulated.configure(frame_rate_hz, exposure_s, shape)
        self.basler.configure(frame_rate_hz, exposure_s, shape)
        features = self.basler.link.features
        features.set_text("TestImageSelector", "Off")
        features.set_text("ImageFilename", self._folder.name)
        features.set_text("ImageFileMode", "On")

    def start(self) -> None:
        """Begin to take frames."""
        self._simulated.start()

    def stop(self) -> None:
        """Take no more frames."""
        self._simulated.stop()

    def grab(self, count: int, not_before_s: float) -> list[Frame]:
        """Return the next frames as the real driver got them; see `Camera.grab`."""
        frames = self._simulated.grab(count, not_before_s)
        write_images([frame.image for frame in frames], Path(self._folder.name), self._bits)
        self.basler.start()
        try:
            carried = self.basler.grab(count, -np.inf)
        finally:
            self.basler.stop()
        # Once the folder has been played it is played again: those frames are old.
        return [replace(frames[got.id], image=got.image) for got in carried if got.id < count]

    def now_s(self) -> float:
        """Return the laboratory's time."""
        return self._simulated.now_s()

    def close(self) -> None:
        """Let go of the emulator. May be called twice."""
        self._simulated.close()
        self.basler.close()
        self._folder.cleanup()


def write_images(images: Sequence[NDArray[np.uint16]], folder: Path, bits: int) -> None:
    """Fill a folder with images for pylon's emulator, to be played in this order.

    Parameters
    ----------
    images : sequence of (ny, nx) uint16
    folder : Path
        Its other TIFF files are removed.
    bits : int
        Of the pixels; the emulator takes the upper ones of 16.
    """
    pylon = load_pylon()
    for old in folder.glob("*.tiff"):
        old.unlink()
    for number, pixels in enumerate(images):
        image = pylon.PylonImage()
        image.AttachArray(pixels << (16 - bits), pylon.PixelType_Mono16)
        path = str(folder / f"{number:06d}.tiff")
        pylon.ImagePersistence.Save(pylon.ImageFileFormat_Tiff, path, image)
        image.Release()


class LoopbackGigeCamera(AravisCamera):
    """A GigE camera on this computer's loopback that sees the simulated laboratory.

    Frames run freely in real time: each shows the exposure that ends when it is stamped, and is
    sent packet by packet to the real driver, which waits, orders and dates them. The laboratory
    must run in real time (``twin: {pace: realtime}``) and rendering must take less than a
    frame period.

    Parameters
    ----------
    entry : CameraSensor
        Its options are those of `drivers.cameras.aravis.AravisOptions`, but for `device`.
    context : BenchContext

    Attributes
    ----------
    lab : SimulatedLab
        Laboratory that it belongs to.
    far_end : FakeGigeCamera
        The camera on the other side of the network.

    Raises
    ------
    BenchSetupError
        If Aravis is missing, the laboratory's time is not real, or another such camera runs.
    """

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        self.lab = context.share(SimulatedLab)
        if isinstance(self.lab.clock, VirtualClock):
            raise BenchSetupError(
                f"bench {context.description.name!r}: twin.pace is fast, but a camera on the "
                "network needs real time; write pace: realtime"
            )
        self.far_end = FakeGigeCamera(self._exposed)
        # Aravis' camera knows no Mono12: 12 bits travel in 16.
        options = {"pixel_format": "Mono16", **entry.options, "device": _LOOPBACK}
        try:
            super().__init__(entry.with_options(options), context)
        except BaseException:
            self.far_end.close()
            raise

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Set the camera up, and build the light on its sensor; see `Camera.configure`."""
        super().configure(frame_rate_hz, exposure_s, shape)
        self.lab.prepare_sensor(shape)

    def close(self) -> None:
        """Let go of the camera, and switch it off. May be called twice."""
        super().close()
        self.far_end.close()

    def _exposed(self, exposure_s: float) -> NDArray[np.uint16]:
        end_s = self.lab.clock.now_s()
        return self.lab.expose([(end_s - exposure_s, end_s)])[0]


class FakeGigeCamera:
    """Aravis' fake GigE camera at 127.0.0.1, on a thread of its own, with pixels from us.

    Parameters
    ----------
    render : callable
        Given the exposure in s, returns the pixels of the frame that is about to be sent, of the
        size that the camera was set to. Called on the camera's thread.
    lost_share : float
        Share of the packets that get lost on their way.

    Raises
    ------
    BenchSetupError
        If Aravis is missing, or another such camera runs on this computer.
    """

    def __init__(self, render: Render, lost_share: float = 0.0) -> None:
        aravis = load_aravis()
        self._library = _library()
        self._render = render
        # Aravis keeps a bare pointer to it.
        self._fill = _Fill(self._fill_buffer)
        self._camera: Any = aravis.GvFakeCamera(
            interface_name=_LOOPBACK, serial_number="reedbench", gvsp_lost_ratio=lost_share
        )
        if not self._camera.is_running():
            raise BenchSetupError(
                f"camera (fake GigE at {_LOOPBACK}): cannot be reached, for another one has its "
                "port; close that program first"
            )
        self._set_fill(self._fill)

    def lose_packets(self, share: float) -> None:
        """Lose this share of the packets from now on."""
        self._camera.set_property("gvsp-lost-ratio", share)

    def write_register(self, address: int, value: int) -> None:
        """Change a register behind the back of whoever controls the camera."""
        self._camera.get_fake_camera().write_register(address, value)

    def close(self) -> None:
        """Switch the camera off. May be called twice."""
        if self._camera is not None:
            # The thread is joined when the last reference goes; it must not want Python then.
            self._set_fill(None)
            self._camera = None

    def _set_fill(self, fill: Any) -> None:
        self._library.arv_fake_camera_set_fill_pattern(
            _pointer(self._camera.get_fake_camera()), ctypes.cast(fill, ctypes.c_void_p), None
        )

    def _fill_buffer(self, buffer: int, _data: int, exposure_us: int, *_: int) -> None:
        library = self._library
        shape = (
            library.arv_buffer_get_image_height(buffer),
            library.arv_buffer_get_image_width(buffer),
        )
        size = ctypes.c_size_t()
        target = library.arv_buffer_get_data(buffer, ctypes.byref(size))
        # A frame that cannot be rendered must not pass for the one before it.
        pixels = np.zeros(shape, np.uint16)
        try:
            pixels[:] = self._render(1e-6 * exposure_us)
        finally:
            ctypes.memmove(target, pixels.ctypes.data, pixels.nbytes)


def _library() -> ctypes.CDLL:
    """The functions of Aravis whose arguments its Python binding cannot express."""
    library = ctypes.CDLL("libaravis-0.8.so.0")
    pointer = ctypes.c_void_p
    library.arv_fake_camera_set_fill_pattern.argtypes = [pointer, pointer, pointer]
    library.arv_fake_camera_set_fill_pattern.restype = None
    library.arv_buffer_get_data.argtypes = [pointer, pointer]
    library.arv_buffer_get_data.restype = pointer
    for name in ("arv_buffer_get_image_width", "arv_buffer_get_image_height"):
        getattr(library, name).argtypes = [pointer]
        getattr(library, name).restype = ctypes.c_int
    return library


def _pointer(instance: Any) -> int:
    """Address of a GObject."""
    get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    get_pointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    get_pointer.restype = ctypes.c_void_p
    return int(get_pointer(instance.__gpointer__, None))
