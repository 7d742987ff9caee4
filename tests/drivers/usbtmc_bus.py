"""A USB bus of pure Python for pyusb, with USBTMC instruments on it.

Hosts of others (pyvisa-py, python-usbtmc) find the instruments through ``usb.core`` and speak real
USBTMC to them: headers, tags, padding, aborts. What breaks the rules of USBTMC 1.0 or USB488 1.0 is
an `AssertionError` here, so hosts are tested as well.
"""

import array
import errno
import importlib
import struct
import sys
import time
from contextlib import contextmanager
from types import SimpleNamespace
from unittest import mock

import usb.backend
import usb.backend.libusb1
import usb.core
import usb.util

from drivers.emulators.serving import (
    UnpluggedError,
    interrupt,
    unterminated,
)

CONFIGURATION, INTERFACE = 1, 0
BULK_OUT, BULK_IN = 0x01, 0x82
PACKET_BYTES = 64
STRINGS = {1: "a maker", 2: "a generator"}
SERIAL_INDEX = 3

MESSAGE_OUT, REQUEST_IN = 1, 2
END_OF_MESSAGE = 1
SUCCESS, NOT_IN_PROGRESS = 0x01, 0x81
USBTMC_1_0 = b"\x00\x01"

STANDARD_GET_DESCRIPTOR, STRING_DESCRIPTOR = 6, 3
ABORT_OUT, ABORT_OUT_STATUS, ABORT_IN, ABORT_IN_STATUS = 1, 2, 3, 4
CLEAR, CLEAR_STATUS, CAPABILITIES, STATUS_BYTE, REMOTE = 5, 6, 7, 128, 160


class UsbtmcInstrument:
    """A `EmulatedDevice` behind USBTMC: its lines are messages.

    Parameters
    ----------
    device : EmulatedDevice
        May be a `FaultyWire`; where that is unplugged, this leaves the bus.
    vendor, product : int
    serial : str
    """

    def __init__(self, device, vendor, product, serial):
        self.device, self.vendor, self.product, self.serial = device, vendor, product, serial
        self.present = True
        self._command, self._answers = b"", b""
        self._request = None
        self._owes_short_packet = False

    @property
    def resource(self):
        """VISA's name."""
        return f"USB0::{self.vendor:#06x}::{self.product:#06x}::{self.serial}::0::INSTR"

    def write_bulk(self, data):
        """Take in one transfer of the Bulk-OUT endpoint."""
        kind, tag, inverse = struct.unpack_from("BBBx", data)
        assert 1 <= tag <= 255
        assert inverse == ~tag & 0xFF
        assert len(data) % 4 == 0, "transfers are padded to whole words"
        size, attributes = struct.unpack_from("<LB", data, 4)
        self._owes_short_packet = False
        if kind == REQUEST_IN:
            self._request = (tag, size)
            if not self._answers:
                unterminated(self.device)
            return
        assert kind == MESSAGE_OUT
        assert 0 <= len(data) - 12 - size < 4
        self._command += data[12 : 12 + size]
        if attributes & END_OF_MESSAGE:
            command, self._command = self._command.rstrip(b"\n") + b"\n", b""
            # A question that is asked before the last was read takes that answer's place (IEEE
            # 488.2, "interrupted").
            if self._answers:
                interrupt(self.device)
            self._answers = self.device.receive(command)

    def read_bulk(self):
        """Return a transfer of the Bulk-IN endpoint, or None if there is none yet."""
        if self._owes_short_packet:
            self._owes_short_packet = False
            return b""
        if self._request is None or not self._answers:
            return None
        (tag, size), self._request = self._request, None
        data, self._answers = self._answers[:size], self._answers[size:]
        is_last = not self._answers
        header = struct.pack("<BBBxLBxxx", REQUEST_IN, tag, ~tag & 0xFF, len(data), is_last)
        return header + data + bytes(-len(data) % 4)

    def control(self, kind, request, value):
        """Answer a control transfer from the device to the host."""
        if kind & usb.util.CTRL_TYPE_CLASS == 0:
            assert (request, value >> 8) == (STANDARD_GET_DESCRIPTOR, STRING_DESCRIPTOR)
            return self._string(value & 0xFF)
        if request == CAPABILITIES:
            usb488 = bytes([SUCCESS, 0]) + USBTMC_1_0 + bytes(8) + USBTMC_1_0
            return usb488 + b"\x06\x00" + bytes(8)
        if request == ABORT_OUT:
            self._command = b""
            return bytes([SUCCESS, value])
        if request == ABORT_IN:
            self._owes_short_packet = self._request is not None and self._request[0] == value
            self._request = None
            return bytes([SUCCESS if self._owes_short_packet else NOT_IN_PROGRESS, value])
        if request in (ABORT_OUT_STATUS, ABORT_IN_STATUS):
            return bytes([SUCCESS, 0, 0, 0, 0, 0, 0, 0])
        if request == CLEAR:
            self._command, self._answers, self._request = b"", b"", None
            return bytes([SUCCESS])
        if request == CLEAR_STATUS:
            return bytes([SUCCESS, 0])
        if request == STATUS_BYTE:
            return bytes([SUCCESS, value, 16 if self._answers else 0])
        assert request == REMOTE
        return bytes([SUCCESS])

    def _string(self, index):
        text = {**STRINGS, SERIAL_INDEX: self.serial}.get(index)
        content = struct.pack("<H", 0x0409) if text is None else text.encode("utf-16-le")
        return bytes([2 + len(content), STRING_DESCRIPTOR]) + content


class Bus(usb.backend.IBackend):
    """A backend of pyusb that finds the given instruments, and no others.

    Parameters
    ----------
    instruments : sequence of UsbtmcInstrument
    """

    def __init__(self, *instruments):
        self.instruments = instruments

    def enumerate_devices(self):
        return [instrument for instrument in self.instruments if instrument.present]

    def get_parent(self, dev):
        return None

    def get_device_descriptor(self, dev):
        place = self.instruments.index(dev) + 1
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=64, idVendor=dev.vendor, idProduct=dev.product,
            bcdDevice=0x100, iManufacturer=1, iProduct=2, iSerialNumber=SERIAL_INDEX,
            bNumConfigurations=1, address=place, bus=1, port_number=place, port_numbers=(place,),
            speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev, config):
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, iConfiguration=0,
            bConfigurationValue=CONFIGURATION, bmAttributes=0xC0, bMaxPower=0, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev, intf, alt, config):
        if intf or alt or config:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=INTERFACE, bAlternateSetting=0,
            bNumEndpoints=2, bInterfaceClass=0xFE, bInterfaceSubClass=3, bInterfaceProtocol=1,
            iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(BULK_OUT, BULK_IN)[ep],
            bmAttributes=usb.util.ENDPOINT_TYPE_BULK, wMaxPacketSize=PACKET_BYTES, bInterval=0,
            bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev):
        return dev

    def close_device(self, dev_handle):
        pass

    def set_configuration(self, dev_handle, config_value):
        pass

    def get_configuration(self, dev_handle):
        return CONFIGURATION

    def claim_interface(self, dev_handle, intf):
        pass

    def release_interface(self, dev_handle, intf):
        pass

    def clear_halt(self, dev_handle, ep):
        pass

    def is_kernel_driver_active(self, dev_handle, intf):
        return False

    def bulk_write(self, dev_handle, ep, intf, data, timeout):
        assert ep == BULK_OUT
        _on_the_bus(dev_handle, dev_handle.write_bulk, data.tobytes())
        return len(data)

    def bulk_read(self, dev_handle, ep, intf, buff, timeout):
        assert ep == BULK_IN
        transfer = _on_the_bus(dev_handle, dev_handle.read_bulk)
        if transfer is None:
            time.sleep(timeout / 1000)
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        buff[: len(transfer)] = array.array("B", transfer)
        return len(transfer)

    def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout):
        assert usb.util.ctrl_direction(bmRequestType) == usb.util.CTRL_IN
        answer = _on_the_bus(dev_handle, dev_handle.control, bmRequestType, bRequest, wValue)
        answer = answer[: len(data)]
        data[: len(answer)] = array.array("B", answer)
        return len(answer)


def _on_the_bus(instrument, transfer, *arguments):
    """Carry out a transfer with an instrument that is there, and may leave while it lasts."""
    try:
        if instrument.present:
            return transfer(*arguments)
    except UnpluggedError:
        instrument.present = False
    raise usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)


@contextmanager
def plugged_in(*instruments):
    """Let all hosts in this process find these instruments on USB."""
    bus = Bus(*instruments)
    with mock.patch.object(usb.backend.libusb1, "get_backend", return_value=bus):
        # Where pyvisa-py was first imported without libusb, it has no sessions for USB.
        if "pyvisa_py.usb" not in sys.modules:
            importlib.import_module("pyvisa_py.usb")
        yield bus
