"""Lines of text over sockets, serial lines, VXI-11 and USBTMC: the same for those who use them."""

import errno
import gc
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from contextlib import contextmanager

import pytest
import usb.core
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pyvisa_py.tcpip import TCPIPSocketSession
from usb.backend import libusb0, libusb1, openusb

from drivers.emulators.serving import (
    FaultyWire,
    PtyServer,
    SocketServer,
    WireFaults,
)
from drivers.errors import BenchSetupError, InstrumentError
from drivers.transport.visa import LateError, open_visa
from tests.drivers.usbtmc_bus import UsbtmcInstrument, plugged_in
from tests.drivers.vxi11_server import Vxi11Server

DEVICE = "generator (a talker)"
IDENTITY = "A maker,a talker,s/n 1,1.0"
TIMEOUT_S = 0.2


class Talker:
    """Knows what it is, remembers what it receives, and says what it is asked to say."""

    def __init__(self, identity=IDENTITY, end="\r\n"):
        self.identity, self.end = identity, end
        self.received = []
        self.rest = b""

    def receive(self, data):
        *lines, self.rest = (self.rest + data).split(b"\n")
        return b"".join(map(self.answer, lines))

    def answer(self, line):
        if line == b"*IDN?":
            return f"{self.identity}{self.end}".encode("latin-1")
        if line.startswith(b"SAY? "):
            return line.removeprefix(b"SAY? ") + self.end.encode()
        self.received.append(line)
        return b""


@contextmanager
def on_socket(device, faults):
    server = SocketServer(device, faults)
    try:
        yield f"TCPIP::127.0.0.1::{server.port}::SOCKET"
    finally:
        server.close()


@contextmanager
def on_serial(device, faults):
    server = PtyServer(device, faults)
    try:
        yield f"ASRL{server.port}::INSTR"
    finally:
        server.close()


@contextmanager
def on_vxi11(device, faults):
    server = Vxi11Server(FaultyWire(device, faults))
    try:
        yield f"TCPIP::127.0.0.1,{server.port}::inst0::INSTR"
    finally:
        server.close()


@contextmanager
def on_usb(device, faults):
    instrument = UsbtmcInstrument(FaultyWire(device, faults), 0xF4EC, 0x1102, "SDG2XTALKER")
    with plugged_in(instrument):
        yield instrument.resource


KINDS = {"socket": on_socket, "serial": on_serial, "vxi11": on_vxi11, "usb": on_usb}
STREAMS = ("socket", "serial")


@pytest.fixture(params=list(KINDS))
def kind(request):
    return request.param


@contextmanager
def talking(kind, faults=None, device=None, timeout_s=TIMEOUT_S):
    """An open line to a device."""
    with KINDS[kind](device or Talker(), faults or WireFaults()) as resource:
        line = open_visa(resource, timeout_s, DEVICE)
        try:
            yield line
        finally:
            line.close()


# --- What it does ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", STREAMS)
def test_each_of_several_threads_has_the_answers_to_its_own_questions(kind):
    wrong = []

    def ask(name):
        for number in range(20):
            if line.ask(f"SAY? {name}{number}") != f"{name}{number}":
                wrong.append((name, number))

    with talking(kind, WireFaults(slow_s=0.005), timeout_s=2.0) as line:
        threads = [threading.Thread(target=ask, args=(name,)) for name in "AB"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []


def test_questions_are_answered_and_commands_arrive(kind):
    device = Talker()
    with talking(kind, device=device, timeout_s=2.0) as line:
        assert line.identity == IDENTITY
        assert line.ask("SAY? 80002036.1") == "80002036.1"
        line.send("FREQ 80002036.125")
        line.send("ENBR 1")
        assert line.ask("SAY? two") == "two"
        line.drain()
        assert line.ask("SAY? three") == "three"
    assert device.received == [b"FREQ 80002036.125", b"ENBR 1"]


@pytest.mark.parametrize(
    ("kind", "end"),
    [*((kind, "\n") for kind in KINDS), ("vxi11", ""), ("usb", "")],
)
def test_the_end_of_an_answer_is_no_part_of_it(kind, end):
    with talking(kind, device=Talker(end=end), timeout_s=2.0) as line:
        assert line.ask("SAY? C1:BSWV WVTP,SINE") == "C1:BSWV WVTP,SINE"


def test_a_question_does_not_wait_for_the_command_before_it():
    with talking("socket", timeout_s=2.0) as line:
        line.send("SET 0")
        times_s = []
        for number in range(10):
            started_s = time.monotonic()
            line.send(f"SET {number}")
            line.ask("SAY? done")
            times_s.append(time.monotonic() - started_s)
    # Waiting for an acknowledgement takes 40 ms.
    assert min(times_s[1:]) < 0.02


def test_a_line_may_be_opened_again_after_it_was_closed(kind):
    with KINDS[kind](Talker(), WireFaults()) as resource:
        for _ in range(2):
            line = open_visa(resource, 2.0, DEVICE, baud=9600)
            assert line.ask("SAY? hello") == "hello"
            line.close()
            line.close()


# --- Faults ------------------------------------------------------------------------------------


def test_a_late_answer_is_never_taken_for_that_of_a_later_question(kind):
    faults = WireFaults(late_answer_at=(4,), late_s=1.4 * TIMEOUT_S)
    with talking(kind, faults) as line:
        assert [line.ask(f"SAY? {number}") for number in range(4)] == ["0", "1", "2", "3"]


@pytest.mark.parametrize("at", [2, 4])
def test_a_lost_answer_is_asked_for_again(kind, at):
    with talking(kind, WireFaults(lose_answer_at=(at,))) as line:
        assert [line.ask(f"SAY? {number}") for number in range(4)] == ["0", "1", "2", "3"]


def test_a_garbled_identity_is_not_believed(kind):
    for at in (1, 2):
        with talking(kind, WireFaults(garble_answer_at=(at,))) as line:
            assert line.identity == IDENTITY
            assert line.ask("SAY? 1") == "1"


def test_a_late_and_garbled_identity_is_not_taken_for_another_answer():
    faults = WireFaults(late_answer_at=(1,), late_s=1.4 * TIMEOUT_S, garble_answer_at=(3,))
    with talking("socket", faults) as line:
        assert line.identity == IDENTITY
        assert line.ask("SAY? 1") == "1"


def test_who_is_interrupted_between_question_and_answer_leaves_the_line_out_of_step(monkeypatch):
    with talking("socket") as line:
        with monkeypatch.context() as patch:
            patch.setattr(TCPIPSocketSession, "read", _interrupted)
            with pytest.raises(KeyboardInterrupt):
                line.ask("SAY? one")
        assert line.ask("SAY? two") == "two"


def _interrupted(*_):
    raise KeyboardInterrupt


def test_bytes_beyond_ascii_are_no_answer():
    class Noisy(Talker):
        is_noisy = True

        def answer(self, line):
            if line[:3] == b"SAY" and self.is_noisy:
                self.is_noisy = False
                return b"\xb5\xff\n"
            return super().answer(line)

    with talking("socket", device=Noisy()) as line:
        assert line.ask("SAY? 1") == "1"


STARVED_S = 2.5 * TIMEOUT_S


def test_an_answer_that_came_while_this_process_was_stopped_is_no_missing_one(monkeypatch):
    """A select that found nothing, and then no time until the timeout was over."""

    def starved(*arguments):
        # Only once: the answer arrives while this process stands still.
        monkeypatch.setattr("pyvisa_py.tcpip.select.select", right)
        time.sleep(STARVED_S)
        return [], [], []

    right, device = select.select, Talker()
    with talking("socket", device=device) as line:
        heard = []
        monkeypatch.setattr(device, "answer", lambda text: heard.append(text) or b"1\n")
        monkeypatch.setattr(line, "send", _then(line.send, monkeypatch, starved))
        assert line.ask("SAY? 1") == "1"
    assert heard == [b"SAY? 1"], "asked once, without a drain"


def _then(send, monkeypatch, starved):
    """Let the next wait for an answer be a starved one."""

    def sent(text):
        send(text)
        monkeypatch.setattr("pyvisa_py.tcpip.select.select", starved)

    return sent


SLOWLY_ASKED = """
import sys
from drivers.transport.visa import open_visa
line = open_visa(sys.argv[1], float(sys.argv[2]), "a talker")
print("ready", flush=True)
print(line.ask("SAY? whole"), flush=True)
"""


def test_a_process_that_is_stopped_amid_an_answer_hears_all_of_it():
    class Halting(Talker):
        """Stops who asks in the middle of an answer, for longer than the timeout."""

        def answer(self, line):
            if line != b"SAY? whole":
                return super().answer(line)
            self.received.append(line)
            threading.Thread(target=self.halve).start()
            return b"who"

        def halve(self):
            time.sleep(0.1)
            asking.send_signal(signal.SIGSTOP)
            os.write(server._master, b"le\n")  # noqa: SLF001  # the rest of a line, while no command runs
            time.sleep(0.8)
            asking.send_signal(signal.SIGCONT)

    device = Halting()
    server = PtyServer(device)
    command = [sys.executable, "-c", SLOWLY_ASKED, f"ASRL{server.port}::INSTR", "0.5"]
    asking = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    said, _ = asking.communicate(timeout=20)
    server.close()
    assert said.split() == ["ready", "whole"]
    assert device.received == [b"SAY? whole"]


def test_within_a_time_no_answer_is_waited_for_any_longer(awake_s):
    with talking("socket", WireFaults(lose_answer_at=range(3, 100)), timeout_s=2.0) as line:
        started_s = time.monotonic()
        with pytest.raises(LateError, match=r"raise options\.timeout_s"), line.within(0.2):
            line.ask("SAY? 1")
        assert time.monotonic() - started_s > 0.15
        assert awake_s(started_s) < 0.6
        with pytest.raises(LateError), line.within(0.0):
            line.ask("SAY? 1")


def test_what_is_late_within_a_time_is_not_taken_for_another_answer():
    with talking("socket", WireFaults(late_answer_at=(3,), late_s=0.2), timeout_s=2.0) as line:
        with pytest.raises(LateError), line.within(0.05):
            line.ask("SAY? 1")
        assert line.ask("SAY? 2") == "2"


def test_a_missing_answer_names_the_timeout_and_the_cable(kind):
    faults = WireFaults(lose_answer_at=range(3, 100))
    with (
        talking(kind, faults) as line,
        pytest.raises(InstrumentError, match=r"cable.*options\.timeout_s"),
    ):
        line.ask("SAY? 1")


def test_who_does_not_say_what_it_is_is_made_safe_all_the_same(kind):
    device = Talker()
    with KINDS[kind](device, WireFaults(lose_answer_at=range(1, 100))) as resource:
        with pytest.raises(InstrumentError, match="did not answer"):
            open_visa(resource, TIMEOUT_S, DEVICE, make_safe=("OUTP OFF", "RF OFF"))
        until_s = time.monotonic() + 2
        while len(device.received) < 2 and time.monotonic() < until_s:
            time.sleep(0.01)
    assert device.received == [b"OUTP OFF", b"RF OFF"]


def test_what_was_said_unasked_is_thrown_away():
    class Greeting(Talker):
        def receive(self, data):
            greeting, self.greeting = self.greeting, b""
            return greeting + super().receive(data)

        greeting = b"Welcome\r\n"

    with talking("socket", device=Greeting()) as line:
        assert line.identity == IDENTITY
        assert line.ask("SAY? 1") == "1"


def test_two_lost_answers_are_an_error_and_the_line_recovers(kind):
    faults = WireFaults(lose_answer_at=(3, 5))
    with talking(kind, faults) as line:
        with pytest.raises(InstrumentError, match=r"did not answer 'SAY\? 0' within 0\.2 s; check"):
            line.ask("SAY? 0")
        assert line.ask("SAY? 1") == "1"


@given(
    lost=st.lists(st.integers(3, 20), max_size=3).map(tuple),
    late=st.lists(st.integers(3, 20), max_size=3).map(tuple),
    timeouts=st.sampled_from([0.5, 1.3, 2.4]),
)
@example(lost=(), late=(3, 4), timeouts=2.4)
@settings(max_examples=8, deadline=None)
def test_no_answer_is_ever_that_of_another_question(lost, late, timeouts):
    short_s = 0.05
    faults = WireFaults(lose_answer_at=lost, late_answer_at=late, late_s=timeouts * short_s)
    with talking("socket", faults, timeout_s=short_s) as line:
        for number in range(6):
            try:
                answer = line.ask(f"SAY? {number}")
            except InstrumentError:
                continue
            assert answer == str(number)


def test_a_pulled_plug_is_an_error_that_says_what_to_check(kind, awake_s):
    with talking(kind, WireFaults(unplug_at=4)) as line:
        assert line.ask("SAY? 0") == "0"
        with pytest.raises(InstrumentError) as caught:
            line.ask("SAY? 1")
        message = str(caught.value)
        assert message.startswith(f"{DEVICE} at ")
        assert "; check " in message
        assert "\n" not in message
        started_s = time.monotonic()
        line.close()
        line.close()
    # pyvisa-py would wait 5 s for an instrument that is gone to say goodbye.
    assert awake_s(started_s) < 1


def test_a_command_to_an_instrument_that_left_the_bus_is_an_error():
    instrument = UsbtmcInstrument(Talker(), 0xF4EC, 0x1102, "SDG2XTALKER")
    with plugged_in(instrument):
        line = open_visa(instrument.resource, TIMEOUT_S, DEVICE)
        instrument.present = False
        with pytest.raises(InstrumentError, match=r"'ENBR 1' failed \(.*No such device.*USB cable"):
            line.send("ENBR 1")
        line.close()


@pytest.mark.parametrize("kind", STREAMS)
def test_an_echo_is_refused(kind):
    with (
        pytest.raises(InstrumentError, match="said just that; turn off its echo"),
        talking(kind, WireFaults(echo=True)),
    ):
        pass


def test_a_wrong_baud_rate_is_named():
    with (
        pytest.raises(InstrumentError, match=r"did not answer .* and the baud rate"),
        talking("serial", WireFaults(wrong_baud=True)),
    ):
        pass


def test_who_never_says_the_same_of_itself_is_refused():
    class Forgetful(Talker):
        count = 0

        def answer(self, line):
            self.count += 1
            return f"thing {self.count}\n".encode()

    device = Forgetful()
    with on_socket(device, WireFaults()) as resource:
        with pytest.raises(InstrumentError, match=r"answered 'thing 1' .* 'thing 4'; ch") as caught:
            open_visa(resource, 2.0, DEVICE)
        # One caller at a time is served here, so the first has to have hung up.
        device.answer = Talker().answer
        open_visa(resource, 2.0, DEVICE).close()
        del caught


# --- Names and libraries -----------------------------------------------------------------------


UNKNOWN = "no host of the name 'no-such-host'"
NOT_THERE = [
    ("ASRL/dev/nowhere::INSTR", None, "the name of the port"),
    ("TCPIP::no-such-host::5025::SOCKET", socket.EAI_NONAME, UNKNOWN),
    ("TCPIP::no-such-host::INSTR", socket.EAI_NONAME, UNKNOWN),
    ("TCPIP::no-such-host,7::inst0::INSTR", socket.EAI_NONAME, UNKNOWN),
    ("TCPIP::a..b::5025::SOCKET", None, r"no host of the name 'a\.\.b'"),
    ("TCPIP::a-host::5025::SOCKET", socket.EAI_AGAIN, "name service does not answer"),
]


@pytest.mark.parametrize(("resource", "number", "said"), NOT_THERE)
def test_an_instrument_that_is_not_there_is_named_with_what_to_check(
    monkeypatch, resource, number, said
):
    if number is not None:
        monkeypatch.setattr(socket, "getaddrinfo", _unanswered(number))
    with pytest.raises(InstrumentError, match=said) as caught:
        open_visa(resource, TIMEOUT_S, DEVICE)
    assert str(caught.value).startswith(f"{DEVICE} at {resource}: ")
    assert "\n" not in str(caught.value)
    assert not isinstance(caught.value, BenchSetupError)
    assert ("cable" in str(caught.value)) == resource.startswith("ASRL")


def _unanswered(number):
    def look_up(*_):
        raise socket.gaierror(number, "what the name service says")

    return look_up


@pytest.mark.parametrize("kind", ["socket", "vxi11"])
def test_a_port_without_a_listener_is_said_to_refuse(kind):
    with KINDS[kind](Talker(), WireFaults()) as resource:
        pass
    # pyvisa-py leaves the socket of a failed VXI-11 connection to the garbage collector.
    with warnings.catch_warnings(action="ignore", category=ResourceWarning):
        with pytest.raises(InstrumentError, match="host refuses the connection") as caught:
            open_visa(resource, TIMEOUT_S, DEVICE)
        assert "cable" not in str(caught.value)
        del caught
        gc.collect()


def test_an_empty_bus_is_named():
    with (
        plugged_in(),
        pytest.raises(InstrumentError, match="check that it is on, the USB cable"),
    ):
        open_visa("USB0::0xF4EC::0x1102::SDG2XTALKER::0::INSTR", TIMEOUT_S, DEVICE)


def test_a_name_that_is_none_shows_how_names_look():
    with pytest.raises(BenchSetupError, match=r"'192\.168\.0\.7' is no VISA resource; write TCPIP"):
        open_visa("192.168.0.7", TIMEOUT_S, DEVICE)


def test_missing_libusb_is_named_with_the_package(monkeypatch):
    for backend in (libusb0, libusb1, openusb):
        monkeypatch.setattr(backend, "get_backend", lambda: None)
    with pytest.raises(BenchSetupError, match=r"install libusb-1\.0"):
        open_visa("USB0::0xF4EC::0x1102::SDG2XTALKER::0::INSTR", TIMEOUT_S, DEVICE)


def test_a_bus_that_may_not_be_used_is_no_missing_library(monkeypatch):
    def refuse(*_, **__):
        raise usb.core.USBError("Access denied", -3, errno.EACCES)

    instrument = UsbtmcInstrument(Talker(), 0xF4EC, 0x1102, "SDG2XTALKER")
    with plugged_in(instrument) as bus:
        monkeypatch.setattr(bus, "ctrl_transfer", refuse)
        with pytest.raises(InstrumentError, match="udev rule"):
            open_visa(instrument.resource, TIMEOUT_S, DEVICE)


def test_missing_pyvisa_is_named_with_the_packages(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvisa", None)
    with pytest.raises(BenchSetupError, match="pip install pyvisa pyvisa-py"):
        open_visa("TCPIP::192.0.2.1::INSTR", TIMEOUT_S, DEVICE)


def test_importing_the_drivers_loads_no_library_of_instruments():
    code = (
        "import sys, drivers.transport.visa, drivers.transport.serial_line;"
        "import drivers.synthesizers.novatech, drivers.synthesizers.srs;"
        "sys.exit(any(name in sys.modules for name in ('pyvisa', 'serial', 'usb')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
