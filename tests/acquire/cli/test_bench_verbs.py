"""`acquire bench`: a bench is found, checked and switched off, whatever else is wrong with it."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from acquire.bench.check import check_bench
from acquire.bench.off import switch_off
from acquire.bench.shot import shot_plan
from acquire.runner.orders import Orders
from drivers.discovery import Found, Search
from drivers.emulators.novatech import NovatechEmulator
from drivers.emulators.serving import PtyServer, SocketServer
from drivers.emulators.siglent import SiglentEmulator
from drivers.registry import open_bench
from protocols.bench import BenchFile, find_bench
from protocols.errors import ProtocolError
from protocols.preparation import Preparation

ROOT = Path(__file__).parents[3]
ABSENT_PORT = "/dev/no-such-port"


@dataclass
class Laboratory:
    """Two simulated instruments that go on when no program talks to them, and where they are."""

    synthesizers: NovatechEmulator
    generator: SiglentEmulator
    port: str
    resource: str

    def switch_on(self):
        """Leave both outputs on, as a killed program does."""
        self.generator.receive(b"C1:BSWV FRQ,2000,AMP,3\nC1:OUTP ON\n")
        self.synthesizers.receive(b"V0 600\r\nV1 600\r\nI p\r\n")
        assert self.outputs == (True, True)

    @property
    def outputs(self):
        """Whether the tweeter's output is on, and whether RF is."""
        rf = [output.amplitude > 0 for output in self.synthesizers.outputs[:2]]
        return self.generator.socket[2], any(rf)


@pytest.fixture
def laboratory():
    with ExitStack() as taken_down:
        synthesizers, generator = NovatechEmulator(lambda _: None), SiglentEmulator()
        line, network = PtyServer(synthesizers), SocketServer(generator)
        taken_down.callback(line.close)
        taken_down.callback(network.close)
        resource = f"TCPIP::127.0.0.1::{network.port}::SOCKET"
        yield Laboratory(synthesizers, generator, line.port, resource)


@pytest.fixture
def real_bench(tmp_path, laboratory):
    """Return a function that writes a bench of the real drivers in that laboratory."""

    def write(port=None, changes=None, **twin):
        content = yaml.safe_load(find_bench("emulated").read_text(encoding="utf-8"))
        content["twin"] = {"mesh": "coarse", **twin}
        instruments = content["instruments"]
        instruments["synthesizers"]["driver"] = "novatech-409b"
        instruments["synthesizers"]["options"] |= {
            "port": port or laboratory.port,
            "timeout_s": 0.2,
        }
        instruments["generator"]["driver"] = "siglent-sdg2042x"
        instruments["generator"]["options"] = {"resource": laboratory.resource, "timeout_s": 0.5}
        instruments["camera"]["driver"] = "simulated"
        for key, value in (changes or {}).items():
            role, option = key.split(".")
            instruments[role][option] = value
        path = tmp_path / "real.yaml"
        path.write_text(yaml.safe_dump(content))
        return path

    return write


@pytest.fixture
def emulated_bench(tmp_path):
    content = yaml.safe_load(find_bench("emulated").read_text(encoding="utf-8"))
    content["twin"] = {"mesh": "coarse"}
    path = tmp_path / "wire.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def results(said, check):
    """Result by instrument of one check."""
    return {f["about"]: f["result"] for f in said.json["findings"] if f["check"] == check}


def finding(said, check, about):
    (found,) = (f for f in said.json["findings"] if (f["check"], f["about"]) == (check, about))
    return found


# --- check -------------------------------------------------------------------------------------


def test_a_good_bench_passes_and_leaves_no_file(cli, folder, emulated_bench):
    before = sorted(folder.rglob("*"))
    said = cli("bench", "check", emulated_bench, "--json")
    assert said.status == 0, said.out
    assert sorted(folder.rglob("*")) == before
    answer = said.json
    assert set(answer) == {"bench", "passed", "interrupted", "findings", "shot", "unconfirmed"}
    assert (answer["passed"], answer["interrupted"], answer["unconfirmed"]) == (True, False, [])
    assert {f["result"] for f in answer["findings"]} == {"pass"}
    checks = [f["check"] for f in answer["findings"]]
    assert list(dict.fromkeys(checks)) == [
        "bench file", "bench free", "opened", "off after opening", "reference clock", "limits",
        "smallest volts", "shot", "off at the end",
    ]  # fmt: skip
    assert "SDG2042X" in finding(said, "opened", "generator")["found"]
    shot = answer["shot"]
    assert (shot["verdict"], shot["volts"]) == ("ok", 0.5)
    assert abs(shot["lock_error_hz"]) < 0.1
    assert shot["signal_to_noise"] > 10


def test_the_table_is_read_by_people_too(cli, folder, emulated_bench):
    said = cli("bench", "check", emulated_bench, "--hz", "1976", "--volts", "1")
    assert said.status == 0
    assert "1976" in said.out
    assert "the bench is ready" in said.out
    assert "fail" not in said.out


def test_instruments_that_are_there_are_checked_and_left_off_without_the_others(
    cli, folder, laboratory, real_bench
):
    laboratory.switch_on()
    said = cli("bench", "check", real_bench(port=ABSENT_PORT), "--json")
    assert said.status == 1
    assert laboratory.outputs[0] is False
    assert results(said, "opened") == {
        "synthesizers": "fail",
        "generator": "pass",
        "camera": "pass",
    }
    assert "adapter" in finding(said, "opened", "synthesizers")["remedy"]
    assert results(said, "limits") == {"synthesizers": "skipped", "generator": "pass"}
    assert results(said, "smallest volts") == {"generator": "pass"}
    assert results(said, "shot") == {"bench": "skipped"}
    off = {"synthesizers": "fail", "generator": "pass", "camera": "pass"}
    assert results(said, "off at the end") == off
    assert "may still be on" in said.json["unconfirmed"][0]
    assert all(f["remedy"] for f in said.json["findings"] if f["result"] == "fail")


def test_a_bad_shot_fails_and_says_what_to_try(cli, folder, laboratory, real_bench):
    """The real drivers play, but the simulated camera sees a laboratory without them: no light."""
    laboratory.switch_on()
    said = cli("bench", "check", real_bench(), "--json")
    assert said.status == 1
    assert said.json["shot"]["verdict"] == "no_signal"
    assert "--volts" in finding(said, "shot", "bench")["remedy"]
    assert set(results(said, "off at the end").values()) == {"pass"}
    assert laboratory.outputs == (False, False)
    assert laboratory.generator.socket[1] < 0.01


def test_a_clock_of_its_own_is_a_note(cli, folder, laboratory, real_bench):
    options = {"port": laboratory.port, "amplitude": 0.6, "amplitude_max": 0.7}
    said = cli("bench", "check", real_bench(changes={"synthesizers.options": options}), "--json")
    clocks = {"synthesizers": "note", "generator": "pass", "camera": "pass"}
    assert results(said, "reference clock") == clocks
    assert "docs/reference/drivers.md" in finding(said, "reference clock", "synthesizers")["remedy"]


def test_an_unknown_driver_does_not_keep_the_others_from_being_checked(
    cli, folder, laboratory, real_bench
):
    laboratory.switch_on()
    said = cli("bench", "check", real_bench(changes={"synthesizers.driver": "novatek"}), "--json")
    assert said.status == 1
    assert "novatech-409b" in finding(said, "opened", "synthesizers")["remedy"]
    assert results(said, "limits")["generator"] == "pass"
    assert laboratory.outputs[0] is False


CARELESS = """
from drivers.simulated import SimulatedGenerator

class Generator(SimulatedGenerator):
    def _require_volts(self, volts): ...
"""


def test_a_driver_that_does_not_keep_to_the_limits_plays_nothing_more(
    cli, folder, bench_file, monkeypatch
):
    (folder / "careless_driver.py").write_text(CARELESS)
    monkeypatch.syspath_prepend(str(folder))
    bench = bench_file(drivers={"generator": "careless_driver:Generator"})
    said = cli("bench", "check", bench, "--json")
    assert said.status == 1
    assert results(said, "limits") == {"synthesizers": "pass", "generator": "fail"}
    assert "16.016 V" in finding(said, "limits", "generator")["found"]
    assert results(said, "shot") == {"bench": "skipped"}
    assert results(said, "off at the end")["generator"] == "pass"
    sys.modules.pop("careless_driver")


def test_a_bench_that_is_in_use_is_not_disturbed(cli, folder, laboratory, real_bench):
    path = real_bench()
    bench = open_bench(BenchFile.from_file(path), Preparation("R07", "A", "asymmetric"))
    with bench:
        laboratory.switch_on()
        said = cli("bench", "check", path, "--json")
        assert laboratory.outputs == (True, True)
    assert said.status == 1
    assert [f["check"] for f in said.json["findings"]] == ["bench file", "bench free"]
    assert "acquire bench off" in finding(said, "bench free", "bench")["remedy"]


@pytest.mark.parametrize("orders_given", [1, 2])
def test_a_check_that_is_stopped_leaves_everything_off(laboratory, real_bench, orders_given):
    bench, orders = BenchFile.from_file(real_bench()), Orders()
    laboratory.switch_on()

    def stop_at_the_shot(words):
        if "shot" in words:
            for _ in range(orders_given):
                orders.interrupt()

    report = check_bench(bench, shot_plan(bench), orders, stop_at_the_shot)
    assert (report.interrupted, report.passed, report.unconfirmed) == (True, False, ())
    assert laboratory.outputs == (False, False)
    assert report.shot is None


SIGNALLING = """
import os
from pathlib import Path
from drivers.simulated import SimulatedGenerator

class Generator(SimulatedGenerator):
    def ramp_to(self, volts, duration_s):
        super().ramp_to(volts, duration_s)
        if volts:
            for number in map(int, Path(__file__).with_suffix(".txt").read_text().split()):
                os.kill(os.getpid(), number)

    def close(self):
        Path(__file__).with_name("left.txt").write_text(f"{self.lab.state.drive_v}")
"""


@pytest.mark.parametrize(
    "signals",
    [[signal.SIGINT], [signal.SIGTERM], [signal.SIGHUP], [signal.SIGTERM, signal.SIGINT]],
)
def test_signals_end_a_check_with_everything_off(cli, folder, bench_file, monkeypatch, signals):
    (folder / "signalling_driver.py").write_text(SIGNALLING)
    (folder / "signalling_driver.txt").write_text(" ".join(str(int(each)) for each in signals))
    monkeypatch.syspath_prepend(str(folder))
    bench = bench_file(drivers={"generator": "signalling_driver:Generator"})
    said = cli("bench", "check", bench, "--json")
    sys.modules.pop("signalling_driver")
    assert said.status == 130
    assert (said.json["interrupted"], said.json["passed"]) == (True, False)
    assert set(results(said, "off at the end").values()) == {"pass"}
    assert float((folder / "left.txt").read_text()) == 0.0


def test_a_check_that_is_stopped_while_it_opens_has_an_exit_status_of_its_own(
    cli, folder, real_bench, monkeypatch
):
    monkeypatch.setattr(Orders, "stopped", property(lambda _: True))
    said = cli("bench", "check", real_bench())
    assert (said.status, said.out) == (130, "")
    assert "stopped" in said.err


def test_the_shot_fits_slow_and_small_cameras():
    slow = {"instruments.camera.max_frame_rate": "7 Hz", "instruments.camera.width": 512}
    plan = shot_plan(BenchFile.from_file().replace(slow))
    assert plan.violations == ()
    assert float(plan.protocol.camera.frame_rate_hz) == pytest.approx(6.8)
    assert plan.frame_shape == (512, 512)
    assert len(plan.steps) == 1
    loud = BenchFile.from_file().replace({"limits.volts_min": "2 V", "limits.drive_min": "3 kHz"})
    step = shot_plan(loud).steps[0]
    assert (step.volts, float(step.drive_hz)) == (2.0, pytest.approx(3000, abs=0.1))


@pytest.mark.parametrize("asked", [{"volts": 16.1}, {"volts": 0.0}, {"hz": float("nan")}])
def test_a_shot_beyond_the_limits_is_refused(asked):
    with pytest.raises(ProtocolError, match=f"--{next(iter(asked))}: .*limits"):
        shot_plan(BenchFile.from_file(), **asked)


# --- off ---------------------------------------------------------------------------------------


def test_what_an_earlier_program_left_on_is_switched_off(cli, folder, laboratory, real_bench):
    laboratory.switch_on()
    said = cli("bench", "off", real_bench(), "--json")
    assert said.status == 0, said.out
    assert laboratory.outputs == (False, False)
    assert set(said.json) == {"bench", "off", "stopped", "findings"}
    assert (said.json["off"], said.json["stopped"]) == (True, [])
    off = {"generator": "pass", "synthesizers": "pass", "camera": "note"}
    assert results(said, "off") == off


@pytest.mark.parametrize("wrong", ["absent", "unknown driver", "wrong options"])
def test_what_cannot_be_reached_does_not_keep_the_rest_on(
    cli, folder, laboratory, real_bench, wrong
):
    laboratory.switch_on()
    bench = {
        "absent": lambda: real_bench(port=ABSENT_PORT),
        "unknown driver": lambda: real_bench(changes={"synthesizers.driver": "novatek"}),
        "wrong options": lambda: real_bench(changes={"synthesizers.options": {}}),
    }[wrong]()
    said = cli("bench", "off", bench, "--json")
    assert said.status == 1
    assert laboratory.outputs[0] is False
    assert results(said, "off")["generator"] == "pass"
    found = finding(said, "off", "synthesizers")
    assert (found["result"], said.json["off"]) == ("fail", False)
    assert "may still be on" in found["found"]
    assert "amplifiers" in found["remedy"]
    assert "NOT everything" in cli("bench", "off", bench).out


def test_a_camera_that_is_missing_is_a_remark(cli, folder, laboratory, real_bench):
    laboratory.switch_on()
    said = cli("bench", "off", real_bench(changes={"camera.driver": "no_such:Camera"}), "--json")
    assert said.status == 0
    assert results(said, "off")["camera"] == "note"
    assert laboratory.outputs == (False, False)


@pytest.mark.parametrize("bench", ["simulated", "emulated"])
def test_on_a_simulated_bench_there_is_nothing_to_switch_off(cli, folder, bench):
    said = cli("bench", "off", bench)
    assert said.status == 0
    assert "nothing to switch off" in said.out


def test_a_run_in_work_is_stopped_and_its_bench_switched_off(
    cli, folder, laboratory, real_bench, protocol_file
):
    bench = real_bench(pace="realtime")
    # Without light every step is bad; the run must not give up by itself.
    patient = {"sweep.last": 140, "policy": {"give_up_after": 1000}}
    command = [sys.executable, "-m", "acquire", "run", protocol_file(**patient)]
    process = subprocess.Popen(
        [str(word) for word in (*command, "--bench", bench, "--out", "x.h5", "--no-fit")],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        documents = folder / "x.documents.jsonl"
        deadline_s = time.monotonic() + 60
        while not (documents.exists() and '["event"' in documents.read_text()):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        assert laboratory.outputs == (True, True)
        said = cli("bench", "off", bench, "--json")
        assert (said.status, said.json["stopped"]) == (0, [process.pid]), said.out
        assert laboratory.outputs == (False, False)
        assert re.search(rf"process {process.pid} .*measures x.h5.*asked to stop", said.err)
        process.communicate(timeout=60)
        assert process.returncode == 130
    finally:
        process.kill()
        process.communicate()


HOLDER = """
import signal, sys, time
from protocols.bench import BenchFile
from drivers.bench_lock import bench_locked
orders = 0
def count(*_):
    global orders
    orders += 1
signal.signal(signal.SIGTERM, count)
with bench_locked(BenchFile.from_file(sys.argv[1]).instruments, "a program that hangs"):
    print("holds it", flush=True)
    while orders < int(sys.argv[2]):
        time.sleep(0.05)
"""


@contextmanager
def held_by_another(path, orders):
    """Another process that uses a bench until it has got some orders to stop."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), str(orders)],
        env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout.readline() == "holds it\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_program_that_does_not_stop_is_named_with_the_last_resort(laboratory, real_bench):
    path = real_bench()
    laboratory.switch_on()
    with held_by_another(path, orders=1000) as process:
        report = switch_off(BenchFile.from_file(path), Orders(), print, patience_s=0.5)
        assert (report.is_off, report.stopped) == (False, (process.pid,))
        assert laboratory.outputs == (True, True)
        found = {each.about: each for each in report.findings}
        for role in ("generator", "synthesizers"):
            assert found[role].result == "fail"
            assert f"kill -9 {process.pid}" in found[role].remedy
        # After the last resort, which frees the lock, everything can be reached.
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert switch_off(BenchFile.from_file(path), Orders(), print).is_off
    assert laboratory.outputs == (False, False)


def test_a_program_that_is_slow_to_stop_is_asked_again(laboratory, real_bench, monkeypatch):
    monkeypatch.setattr("acquire.bench.off._ASK_AGAIN_S", 0.3)
    path, said = real_bench(), []
    laboratory.switch_on()
    with held_by_another(path, orders=2):
        report = switch_off(BenchFile.from_file(path), Orders(), said.append)
    assert report.is_off
    assert laboratory.outputs == (False, False)
    assert "again" in said[1]


def test_a_program_of_another_user_is_named(laboratory, real_bench, monkeypatch):
    def refuse(*_):
        raise PermissionError

    path = real_bench()
    with held_by_another(path, orders=1000) as process:
        with monkeypatch.context() as patch:
            patch.setattr(os, "kill", refuse)
            report = switch_off(BenchFile.from_file(path), Orders(), print)
        assert process.poll() is None
    assert (report.is_off, report.stopped) == (False, ())
    assert "sudo" in report.findings[0].remedy


def test_a_program_does_not_stop_itself(laboratory, real_bench):
    bench = BenchFile.from_file(real_bench())
    with open_bench(bench, Preparation("R07", "A", "asymmetric")):
        report = switch_off(bench, Orders(), print, patience_s=0.3)
    assert (report.is_off, report.stopped) == (False, ())
    assert "close the bench" in report.findings[0].remedy


def test_stopping_the_switching_off_ends_the_waiting_and_says_what_may_be_on(
    laboratory, real_bench
):
    bench, orders = BenchFile.from_file(real_bench()), Orders()
    with open_bench(bench, Preparation("R07", "A", "asymmetric")):
        orders.stop()
        began_s = time.monotonic()
        report = switch_off(bench, orders, print)
        assert time.monotonic() - began_s < 5
    assert [each.result for each in report.findings] == ["fail", "fail", "note"]
    # One order to stop does not leave on what can be switched off.
    laboratory.switch_on()
    assert switch_off(bench, orders, print).is_off
    assert laboratory.outputs == (False, False)


# --- list --------------------------------------------------------------------------------------


@pytest.fixture
def plugged_in(monkeypatch):
    """One generator, and no way to look for cameras; return how often ports were to be asked."""
    asked = []
    found = Found(
        "visa", "TCPIP::192.168.0.7::INSTR", "Siglent Technologies,SDG2042X,SDG2X1,2.01", "",
        "generator", "siglent-sdg2042x", {"resource": "TCPIP::192.168.0.7::INSTR"},
    )  # fmt: skip

    def search_all(ask_serial=False):
        asked.append(ask_serial)
        return Search("visa", (found,)), Search("camera", remarks=("install [pylon]",))

    monkeypatch.setattr("drivers.discovery.search_all", search_all)
    return asked


def test_what_is_plugged_in_is_listed_with_its_line_of_a_bench_file(cli, folder, plugged_in):
    said = cli("bench", "list")
    assert said.status == 0
    line = 'generator: {driver: siglent-sdg2042x, options: {resource: "TCPIP::192.168.0.7::INSTR"}}'
    assert line in said.out
    assert "install [pylon]" in said.out
    assert plugged_in == [False]


def test_the_list_has_stable_keys(cli, folder, plugged_in):
    said = cli("bench", "list", "--ask", "--json")
    assert set(said.json) == {"found", "remarks"}
    (found,) = said.json["found"]
    keys = {"kind", "address", "answer", "remark", "role", "driver", "options", "fill_in"}
    assert set(found) == keys
    assert said.json["remarks"] == [{"kind": "camera", "remark": "install [pylon]"}]
    assert plugged_in == [True]


# --- Words and obvious mistakes ----------------------------------------------------------------


@pytest.mark.parametrize("verb", ["list", "check", "off"])
def test_every_verb_of_benches_has_help_and_json(cli, verb):
    said = cli("bench", verb, "--help")
    assert (said.status, said.err) == (0, "")
    assert "--json" in said.out
    assert verb in cli("bench", "--help").out


@pytest.mark.parametrize("verb", ["check", "off"])
@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("atlantis", "shipped are emulated, simulated"),
        ("seriesA", "is a protocol"),
        (str(ROOT / "protocols" / "seriesA.yaml"), "is a protocol"),
        (str(ROOT / "README.md"), "README.md"),
    ],
)
def test_what_is_no_bench_file_is_bad_input(cli, folder, verb, name, remedy):
    said = cli("bench", verb, name, "--json")
    assert (said.status, said.out) == (2, "")
    assert remedy in said.err
    assert said.err.count("\n") == 1
