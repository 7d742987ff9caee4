"""Locks: one process holds each, and what is said of it counts only while it is true."""

import json
import multiprocessing
import os
import signal
import socket
import time
from dataclasses import asdict, replace

import pytest

from drivers.bench_lock import (
    BenchInUseError,
    addresses,
    bench_locked,
    holders,
)
from drivers.exclusive import (
    Holder,
    LockedError,
    exclusive,
    holder_of,
)
from protocols.bench import BenchFile


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.lock"


@pytest.fixture(autouse=True)
def _locks_of_this_test(tmp_path, monkeypatch):
    monkeypatch.setenv("REEDBENCH_LOCKS", str(tmp_path / "locks"))


def _hold(path, begun):
    with exclusive(path, "holds it"):
        begun.set()
        time.sleep(60)


@pytest.fixture
def other(path):
    """A process that holds the lock."""
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    process = context.Process(target=_hold, args=(path, begun))
    process.start()
    assert begun.wait(30)
    yield process
    process.kill()
    process.join()


def test_one_process_holds_a_lock_and_the_file_goes_with_it(path, other):
    with pytest.raises(LockedError) as refused, exclusive(path, "wants it"):
        pass
    holder = refused.value.holder
    assert (holder.pid, holder.host, holder.does) == (other.pid, socket.gethostname(), "holds it")
    assert holder_of(path) == (True, holder)
    os.kill(other.pid, signal.SIGTERM)
    other.join()
    assert holder_of(path) == (False, None)
    with exclusive(path, "wants it"):
        assert holder_of(path)[1].pid == os.getpid()
    assert not path.exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"pid": 1},
        {"host": "elsewhere"},
        {"boot": "another start"},
        {"started": "12"},
        {"pid": 2**31 - 1},
        {"pid": "1"},
    ],
)
def test_a_number_found_in_a_file_is_no_holder(path, changes):
    with exclusive(path, "holds it"):
        lies = {**asdict(Holder.this_process("lies")), **changes}
        path.write_text(json.dumps(lies))
        assert holder_of(path) == (True, None)


@pytest.mark.parametrize("text", ["", "1234\n", "[]", "{}", "[" * 4000, "\x00" * 50, '{"pid": 1}'])
def test_a_file_of_something_else_describes_no_one(path, text):
    with exclusive(path, "holds it"):
        path.write_text(text)
        assert holder_of(path) == (True, None)
    path.write_text(text)
    assert holder_of(path) == (False, None)
    with exclusive(path, "takes over what a dead process left"):
        assert holder_of(path)[0]


def test_a_link_at_the_place_of_a_lock_is_not_followed(path, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("precious")
    path.symlink_to(precious)
    with pytest.raises(OSError, match="symbolic"), exclusive(path, "wants it"):
        pass
    assert precious.read_text() == "precious"


def test_a_process_that_ended_and_was_not_waited_for_is_gone(tmp_path):
    process = multiprocessing.get_context("fork").Process(target=os._exit, args=(0,))
    process.start()
    holder = replace(Holder.this_process("ended"), pid=process.pid)
    time.sleep(0.2)
    assert not holder.is_here
    process.join()


# --- Benches -----------------------------------------------------------------------------------


def bench(**instruments):
    changes = {}
    for role, options in instruments.items():
        changes[f"instruments.{role}.driver"] = f"{role}-of-others"
        changes[f"instruments.{role}.options"] = options
    return BenchFile.from_file().replace(changes).instruments


LABORATORY = {
    "synthesizers": {"port": "/dev/ttyUSB0", "amplitude": 0.5},
    "generator": {"resource": "TCPIP::192.168.0.7::INSTR"},
    "camera": {"serial": "40012345"},
}


def test_a_bench_is_its_addresses_whatever_its_settings(tmp_path):
    assert len(addresses(bench(**LABORATORY))) == 3
    louder = {**LABORATORY, "synthesizers": {"port": "/dev/ttyUSB0", "amplitude": 0.9}}
    assert addresses(bench(**louder)) == addresses(bench(**LABORATORY))
    lower = {**LABORATORY, "generator": {"resource": "tcpip::192.168.0.7::instr"}}
    assert addresses(bench(**lower)) == addresses(bench(**LABORATORY))
    assert addresses(BenchFile.from_file().instruments) == (), "everybody may simulate"
    device, link = tmp_path / "ttyUSB7", tmp_path / "by-id"
    device.touch()
    link.symlink_to(device)
    one, two = (bench(synthesizers={"port": str(port)}) for port in (device, link))
    assert addresses(one) == addresses(two)
    both = bench(synthesizers={"resources": ["GPIB::1", "GPIB::2"]})
    assert addresses(both) == ("GPIB::1", "GPIB::2")


def test_one_instrument_in_use_is_enough_to_refuse_a_bench():
    other = bench(generator=LABORATORY["generator"])
    with bench_locked(bench(**LABORATORY), "measures R07.h5"):
        (holder,) = holders(other)
        assert (holder.pid, holder.does) == (os.getpid(), "measures R07.h5")
        wanted = bench_locked(other, "wants it too")
        with pytest.raises(BenchInUseError, match=r"192\.168\.0\.7") as refused:
            wanted.__enter__()
        assert refused.value.exit_status == 2
        assert refused.value.holder == holder
    with bench_locked(other, "may have it now"):
        assert holders(bench(camera={"serial": "40012345"})) == ()
