"""Lines of text on a serial port: a slow computer, and hosts that are not there."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from drivers.emulators.serving import PtyServer, WireFaults
from drivers.errors import BenchSetupError, InstrumentError
from drivers.transport.serial_line import SerialLine

TIMEOUT_S = 0.2


class Box:
    """Answers what it hears in capitals."""

    def receive(self, data):
        return data.upper()


@pytest.fixture
def opened():
    """Return a function that opens a line to a box."""
    ends = []

    def make(faults=None, timeout_s=TIMEOUT_S):
        server = PtyServer(Box(), faults)
        line = SerialLine(server.port, 19200, timeout_s, "a box")
        ends.extend((line, server))
        return line

    yield make
    for end in ends:
        end.close()


def test_lines_are_read_one_by_one(opened):
    line = opened(timeout_s=1.0)
    line.write("one")
    line.write("two", discard=False)
    assert [line.read("one"), line.read("two")] == ["ONE", "TWO"]


def test_what_came_before_is_thrown_away(opened):
    line = opened(timeout_s=1.0)
    line.write("one")
    time.sleep(0.1)
    line.write("two")
    assert line.read("two") == "TWO"


def test_a_patience_shortens_the_wait(opened, awake_s):
    line = opened(WireFaults(lose_answer_at=(1,)), timeout_s=5.0)
    line.write("one")
    started_s = time.monotonic()
    assert line.read("one", 0.05) is None
    assert awake_s(started_s) < 0.5


def test_half_a_line_is_kept_until_it_is_whole():
    master, slave = os.openpty()
    line = SerialLine(os.ttyname(slave), 19200, 0.05, "a box")
    os.write(master, b"hal")
    assert line.read("?") is None
    os.write(master, b"ves\r\n")
    assert line.read("?") == "halves"
    line.close()
    os.close(master)
    os.close(slave)


def test_noise_without_an_end_is_no_line(awake_s):
    master, slave = os.openpty()
    line = SerialLine(os.ttyname(slave), 19200, 0.5, "a box")
    os.write(master, b"\x55" * 300)
    started_s = time.monotonic()
    assert line.read("?") is None
    assert awake_s(started_s) < 0.4, "no end of a line is waited for"
    line.close()
    os.close(master)
    os.close(slave)


READ_ONCE = """
import sys
from drivers.transport.serial_line import SerialLine
line = SerialLine(sys.argv[1], 19200, 0.5, "a box")
print("ready", flush=True)
print(line.read("?"), flush=True)
"""


def test_a_process_that_is_stopped_for_longer_than_the_timeout_hears_the_whole_line():
    master, slave = os.openpty()
    command = [sys.executable, "-c", READ_ONCE, os.ttyname(slave)]
    reading = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert reading.stdout.readline() == "ready\n"
    os.write(master, b"wh")
    time.sleep(0.1)
    reading.send_signal(signal.SIGSTOP)
    os.write(master, b"ole\r\n")
    time.sleep(0.7)
    reading.send_signal(signal.SIGCONT)
    said, _ = reading.communicate(timeout=10)
    os.close(master)
    os.close(slave)
    assert said == "whole\n"


@pytest.mark.parametrize(
    ("number", "said"),
    [(socket.EAI_NONAME, "no host of the name 'no-such-host'"), (socket.EAI_AGAIN, "name service")],
)
def test_an_unknown_host_is_said_to_be_one(monkeypatch, number, said):
    def look_up(*_):
        raise socket.gaierror(number, "what the name service says")

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    with pytest.raises(
        InstrumentError, match=f"a box at socket://.*{said}.*options.port"
    ) as caught:
        SerialLine("socket://no-such-host:4001", 19200, TIMEOUT_S, "a box")
    assert not isinstance(caught.value, BenchSetupError)


def test_a_host_that_refuses_is_said_to_refuse():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(InstrumentError, match=r"the host refuses the connection.*options\.port"):
        SerialLine(f"socket://127.0.0.1:{port}", 19200, TIMEOUT_S, "a box")
