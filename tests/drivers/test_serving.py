"""Bytes go to a simulated device and back over real serial lines and sockets, spoilt as asked."""

import itertools
import os
import socket
import time
from contextlib import suppress

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators.serving import (
    FaultyWire,
    PtyServer,
    SocketServer,
    UnpluggedError,
    WireFaults,
)


class Shouting:
    """Answers every whole line in capitals."""

    def __init__(self):
        self.heard = b""
        self.rest = b""

    def receive(self, data):
        self.heard += data
        *lines, self.rest = (self.rest + data).split(b"\n")
        return b"".join(line.upper() + b"\n" for line in lines)


@pytest.fixture
def serve():
    """Return a function that serves a device, and hangs up at the end."""
    servers = []

    def make(kind, faults=None):
        servers.append(kind(Shouting(), faults))
        servers[-1].device = servers[-1]._device  # noqa: SLF001  # what it has heard
        return servers[-1]

    yield make
    for server in servers:
        server.close()
        server.close()


def ask_serial(server, *lines):
    with serial.Serial(server.port, 19200, timeout=0.3) as line:
        answers = []
        for text in lines:
            line.write(text)
            answers.append(line.readline())
        return answers


def ask_socket(server, *lines):
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.settimeout(0.3)
        answers = []
        for text in lines:
            line.sendall(text)
            try:
                answers.append(line.recv(100))
            except TimeoutError:
                answers.append(b"")
        return answers


WIRES = pytest.mark.parametrize(
    ("kind", "ask"), [(PtyServer, ask_serial), (SocketServer, ask_socket)], ids=["pty", "socket"]
)


@WIRES
def test_answers_come_back(serve, kind, ask):
    server = serve(kind)
    assert ask(server, b"one\n", b"two\n") == [b"ONE\n", b"TWO\n"]
    # Another client may call after the first has hung up.
    assert ask(server, b"three\n") == [b"THREE\n"]


@WIRES
def test_each_fault_strikes_where_it_is_asked_for(serve, kind, ask):
    lost = serve(kind, WireFaults(lose_answer_at=(2,)))
    assert ask(lost, b"a\n", b"b\n", b"c\n") == [b"A\n", b"", b"C\n"]
    deaf = serve(kind, WireFaults(lose_command_at=(2,)))
    assert ask(deaf, b"a\n", b"b\n", b"c\n") == [b"A\n", b"", b"C\n"]
    garbled = serve(kind, WireFaults(garble_answer_at=(1,)))
    first, second = ask(garbled, b"abc\n", b"abc\n")
    assert (len(first), first != b"ABC\n", second) == (4, True, b"ABC\n")
    echoing = serve(kind, WireFaults(echo=True))
    assert ask(echoing, b"a\n")[0].startswith(b"a\n")


@WIRES
def test_a_late_answer_comes_when_no_one_waits(serve, kind, ask, awake_s):
    server = serve(kind, WireFaults(late_answer_at=(1,), late_s=0.45))
    started_s = time.monotonic()
    # On a busy machine it comes later still, but never while the first question waits.
    first, *later = ask(server, b"a\n", b"", b"", b"")
    assert (first, b"".join(later)) == (b"", b"A\n")
    assert time.monotonic() - started_s > 0.44
    assert awake_s(started_s) < 2


@WIRES
def test_slow_answers_keep_their_order_and_do_not_keep_the_device_from_hearing(
    serve, kind, ask, awake_s
):
    server = serve(kind, WireFaults(slow_s=0.25, slow_from=2))
    started_s = time.monotonic()
    assert ask(server, b"a\n", b"b\n", b"c\n") == [b"A\n", b"B\n", b"C\n"]
    assert time.monotonic() - started_s > 0.5
    assert awake_s(started_s) < 1.0
    server.spoil(WireFaults(slow_s=5.0))
    assert ask(server, b"d\n", b"e\n") == [b"", b""]
    assert server.device.heard.endswith(b"d\ne\n")


class Forgetting(Shouting):
    """Throws an answer away that was not read before the next question."""

    interrupted = 0

    def interrupt(self):
        self.interrupted += 1


def test_a_device_that_heeds_ieee_488_2_loses_an_answer_that_was_not_read():
    device = Forgetting()
    server = SocketServer(device, WireFaults(late_answer_at=(1,), late_s=0.3))
    assert ask_socket(server, b"") == [b""]
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.settimeout(0.5)
        line.sendall(b"one\n")
        time.sleep(0.1)
        line.sendall(b"two\n")
        assert line.recv(100) == b"TWO\n"
        line.sendall(b"three\n")
        assert line.recv(100) == b"THREE\n"
    server.close()
    assert device.interrupted == 1


def read_until_it_is_gone(line):
    for _ in range(20):
        line.readline()


def test_an_unplugged_port_is_gone(serve):
    server = serve(PtyServer, WireFaults(unplug_at=2))
    with serial.Serial(server.port, 19200, timeout=0.3) as line:
        line.write(b"a\n")
        assert line.readline() == b"A\n"
        line.write(b"b\n")
        with pytest.raises(serial.SerialException):
            read_until_it_is_gone(line)
    with pytest.raises(serial.SerialException):
        serial.Serial(server.port)


def connect_until_nobody_listens(port):
    for _ in range(100):
        socket.create_connection(("127.0.0.1", port)).close()
        time.sleep(0.02)


def test_an_unplugged_socket_hangs_up_and_listens_no_more(serve):
    server = serve(SocketServer, WireFaults(unplug_at=1))
    assert ask_socket(server, b"a\n") == [b""]
    with pytest.raises(ConnectionError):
        connect_until_nobody_listens(server.port)


@WIRES
def test_a_wire_that_is_plugged_in_again_leads_to_the_same_device(serve, kind, ask):
    server = serve(kind, WireFaults(unplug_at=2, replug_after_s=0.2))
    with suppress(OSError):
        ask(server, b"a\n", b"b\n")
    time.sleep(0.4)
    assert ask(server, b"c\n", b"d\n") == [b"C\n", b"D\n"]
    assert server.device.heard == b"a\nb\nc\nd\n"


@WIRES
def test_a_wire_that_is_never_plugged_in_again_stays_dead(serve, kind, ask):
    server = serve(kind, WireFaults(unplug_at=1))
    with suppress(OSError):
        ask(server, b"a\n")
    time.sleep(0.1)
    with pytest.raises(OSError, match=r"."):
        ask(server, b"c\n")


def test_the_name_of_a_pulled_port_is_given_to_nobody_else(serve):
    server = serve(PtyServer, WireFaults(unplug_at=1))
    with suppress(OSError):
        ask_serial(server, b"a\n")
    wait_until(lambda: not os.path.exists(server.port))
    pairs = [os.openpty() for _ in range(3)]
    names = [os.ttyname(slave) for _, slave in pairs]
    for end in itertools.chain(*pairs):
        os.close(end)
    assert server.port not in names


def wait_until(is_true):
    for _ in range(100):
        if is_true():
            return
        time.sleep(0.02)
    raise AssertionError(is_true)


@given(st.binary(min_size=1, max_size=40))
def test_a_wrong_baud_rate_makes_noise_of_everything_but_silence(data):
    device = Shouting()
    FaultyWire(device, WireFaults(wrong_baud=True)).receive(data)
    assert len(device.heard) == 2 * len(data)
    # Zeros and ones stay zeros and ones at any rate.
    if set(data) - {0x00, 0xFF}:
        assert device.heard[::2] != data


def test_a_pulled_wire_says_so():
    wire = FaultyWire(Shouting(), WireFaults(unplug_at=1))
    assert wire.receive(b"no line") == b""
    with pytest.raises(UnpluggedError):
        wire.receive(b"\n")
