"""Benches are put together from names; what cannot be put together is said in one line."""

import os
import signal
import subprocess
import sys
import threading
import time
from importlib.metadata import EntryPoint
from typing import get_type_hints

import pytest

from drivers import registry
from drivers.bench_lock import BenchInUseError
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    OpeningStoppedError,
)
from drivers.registry import (
    find_driver,
    is_simulated,
    known_drivers,
    open_bench,
    open_each,
)
from drivers.roles import (
    Camera,
    SignalGenerator,
    SynthesizerPair,
)
from drivers.safe_off import safe_off
from drivers.simulated import (
    SimulatedCamera,
    SimulatedGenerator,
    SimulatedSynthesizers,
)
from protocols.bench import BenchFile
from protocols.preparation import Preparation

PREPARATION = Preparation("R07", "A", "asymmetric")

OTHERS = """
closed = []

class Box:
    def __init__(self, context):
        self.reed = context.preparation.reed

class Minimal:
    identity = "minimal"
    saturation_dn = 4095

    def __init__(self, entry, context):
        self.lab = context.share(Box)
        self.options = dict(entry.options)

    def close(self):
        closed.append(type(self).__name__)

class Generator(Minimal):
    def set_sine(self, frequency_hz, volts): ...
    def ramp_to(self, volts, duration_s): ...
    def output_off(self): ...
    def read(self): ...

class Synthesizers(Minimal):
    step_hz = 1
    def set_pair(self, aom1_hz, aom2_hz): ...
    def read_pair(self): ...
    def rf_on(self): ...
    def rf_off(self): ...

class Camera(Minimal):
    def configure(self, frame_rate_hz, exposure_s, shape): ...
    def start(self): ...
    def stop(self): ...
    def grab(self, count, not_before_s): ...
    def now_s(self): ...
"""


@pytest.fixture
def others(tmp_path, monkeypatch):
    """A package of drivers from elsewhere."""
    (tmp_path / "others_drivers.py").write_text(OTHERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "others_drivers"
    sys.modules.pop("others_drivers", None)


def bench_of(module, **roles):
    drivers = {"synthesizers": "Synthesizers", "generator": "Generator", "camera": "Camera"} | roles
    return BenchFile.from_file().replace(
        {f"instruments.{role}.driver": f"{module}:{name}" for role, name in drivers.items()}
    )


def test_the_simulated_bench_fills_all_roles(small_plan, open_small_bench):
    plan = small_plan()
    bench = open_small_bench(plan, seed=5)
    assert isinstance(bench.synthesizers, SynthesizerPair)
    assert isinstance(bench.generator, SignalGenerator)
    assert isinstance(bench.camera, Camera)
    assert bench.fingerprint == plan.bench.fingerprint
    assert (bench.seed, bench.preparation.reed) == (5, "R07")
    assert set(bench.identities) == {"synthesizers", "generator", "camera"}
    assert all(identity and "\n" not in identity for identity in bench.identities.values())
    before_s = bench.clock.now_s()
    bench.synthesizers.rf_on()
    assert bench.camera.now_s() == bench.clock.now_s() > before_s, "one laboratory, one time"


def test_short_names_work_in_a_checkout_that_was_never_installed(monkeypatch):
    monkeypatch.setattr(registry, "entry_points", lambda group: [])
    assert find_driver("synthesizers", "simulated") is SimulatedSynthesizers
    assert find_driver("generator", "simulated") is SimulatedGenerator
    assert find_driver("camera", "simulated") is SimulatedCamera


def test_drivers_of_others_are_found_by_entry_point(monkeypatch, others):
    def points(group):
        if group != "reedbench.camera":
            return []
        return [EntryPoint("theirs", f"{others}:Camera", group)]

    ours = known_drivers("camera")
    monkeypatch.setattr(registry, "entry_points", points)
    assert known_drivers("camera") == {**ours, "theirs": f"{others}:Camera"}
    assert find_driver("camera", "theirs").__name__ == "Camera"
    with pytest.raises(BenchSetupError) as refused:
        find_driver("generator", "theirs")
    assert all(name in str(refused.value) for name in known_drivers("generator"))


ROLES = {"synthesizers": SynthesizerPair, "generator": SignalGenerator, "camera": Camera}


@pytest.mark.parametrize(
    ("role", "name"), [(role, name) for role in ROLES for name in known_drivers(role)]
)
def test_every_driver_fills_its_role(role, name):
    """A driver is a class with all methods of its role, or a function that returns such a class."""
    driver = find_driver(role, name)
    made = driver if isinstance(driver, type) else get_type_hints(driver)["return"]
    methods = {each for each in dir(ROLES[role]) if not each.startswith("_")}
    assert methods <= set(dir(made))


def test_drivers_of_others_share_what_they_need(others):
    with open_bench(bench_of(others), PREPARATION) as bench:
        assert bench.synthesizers.lab is bench.generator.lab is bench.camera.lab
        assert bench.camera.lab.reed == "R07"
        assert bench.clock.now_s() >= 0
    assert sorted(sys.modules[others].closed) == ["Camera", "Generator", "Synthesizers"]


@pytest.mark.parametrize(
    ("driver", "said"),
    [
        ("simulate", "known are .*simulated"),
        ("no_such_package:Camera", "No module named 'no_such_package'"),
        ("drivers.simulated:NoCamera", "no attribute 'NoCamera'|cannot be loaded"),
        (":Camera", "cannot be loaded"),
    ],
)
def test_an_unknown_driver_is_named_with_the_remedy(driver, said):
    bench_file = BenchFile.from_file().replace({"instruments.camera.driver": driver})
    with pytest.raises(BenchSetupError, match=said) as caught:
        open_bench(bench_file.replace({"twin.mesh": "coarse"}), PREPARATION)
    assert "instruments.camera.driver" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, InstrumentError)
    assert caught.value.exit_status == 2


def test_a_driver_that_does_not_fill_its_role_leaves_nothing_open(others):
    with pytest.raises(BenchSetupError, match=r"no Camera, it lacks .*grab"):
        open_bench(bench_of(others, camera="Generator"), PREPARATION)
    assert sys.modules[others].closed == ["Generator", "Generator", "Synthesizers"]


def test_instruments_are_opened_each_by_itself(others):
    with open_each(bench_of(others, generator="Nothing"), PREPARATION) as opened:
        assert set(opened.instruments) == {"synthesizers", "camera"}
        assert set(opened.failures) == {"generator"}
        assert "Nothing" in str(opened.failures["generator"])
        assert opened.bench is None
        assert sys.modules[others].closed == []
    assert sorted(sys.modules[others].closed) == ["Camera", "Synthesizers"]


def test_instruments_that_are_all_there_are_one_bench(others):
    with open_each(bench_of(others), PREPARATION, seed=3) as opened:
        assert opened.failures == {}
        assert opened.bench.generator is opened.instruments["generator"]
        assert (opened.bench.seed, opened.bench.preparation) == (3, PREPARATION)
    assert sorted(sys.modules[others].closed) == ["Camera", "Generator", "Synthesizers"]


def test_some_instruments_are_opened_without_the_others(others):
    roles = ("camera", "generator")
    with open_each(bench_of(others), PREPARATION, roles=roles) as opened:
        assert tuple(opened.instruments) == roles
        assert opened.bench is None


def test_opening_each_is_given_up_if_it_is_stopped(others):
    answers = iter([False, True])
    with (
        pytest.raises(OpeningStoppedError) as stopped,
        open_each(bench_of(others), PREPARATION, stopped=lambda: next(answers)),
    ):
        pass
    assert stopped.value.unconfirmed == ()
    assert sys.modules[others].closed == ["Synthesizers"]


@pytest.mark.parametrize(
    ("role", "name", "simulated"),
    [
        ("generator", "simulated", True),
        ("generator", "emulated-siglent", True),
        ("camera", "emulated-camera", True),
        ("camera", "drivers.emulators.cameras:LoopbackGigeCamera", True),
        ("generator", "siglent-sdg2042x", False),
        ("camera", "basler", False),
    ],
)
def test_simulated_drivers_are_distinguished_from_real_ones(role, name, simulated):
    assert is_simulated(role, name) is simulated


# --- Opening that fails half way ---------------------------------------------------------------

ABSENT = """
from drivers.errors import InstrumentError
from others_drivers import Camera, Generator, Synthesizers

orders = []

class AbsentSynthesizers(Synthesizers):
    def __init__(self, entry, context):
        raise InstrumentError("synthesizers: do not answer; check the cable")

class AbsentGenerator(Generator):
    def __init__(self, entry, context):
        raise OSError("no route")

class LoggedGenerator(Generator):
    def output_off(self):
        orders.append("output off")
    def read(self):
        return 0, 0.0, False

class StubbornGenerator(LoggedGenerator):
    def read(self):
        return 0, 0.0, True

class LoggedSynthesizers(Synthesizers):
    def rf_off(self):
        orders.append("RF off")
"""


@pytest.fixture
def absent(others, tmp_path):
    """More drivers from elsewhere, some of whose instruments are not there."""
    (tmp_path / "absent_drivers.py").write_text(ABSENT)
    yield "absent_drivers"
    sys.modules.pop("absent_drivers", None)


def opened_with(module, **drivers):
    return open_bench(bench_of("others_drivers", **drivers).replace({
        f"instruments.{role}.driver": f"{module}:{name}" for role, name in drivers.items()
    }), PREPARATION)  # fmt: skip


def test_without_the_synthesizers_the_generator_is_still_switched_off(absent):
    """An earlier program may have been killed, and left it on."""
    with pytest.raises(InstrumentError, match="do not answer") as caught:
        opened_with(absent, synthesizers="AbsentSynthesizers", generator="LoggedGenerator")
    assert sys.modules[absent].orders == ["output off"]
    (left,) = caught.value.unconfirmed
    assert "RF" in left
    assert any("RF" in note for note in caught.value.__notes__)
    assert sys.modules["others_drivers"].closed == ["Camera", "LoggedGenerator"]


def test_whatever_a_driver_raises_the_others_are_switched_off(absent):
    with pytest.raises(OSError, match="no route") as caught:
        opened_with(absent, synthesizers="LoggedSynthesizers", generator="AbsentGenerator")
    assert sys.modules[absent].orders == ["RF off"]
    assert any("tweeter output" in note for note in caught.value.__notes__)


def test_all_instruments_that_fail_are_named(absent):
    with pytest.raises(InstrumentError) as caught:
        opened_with(absent, synthesizers="AbsentSynthesizers", generator="AbsentGenerator")
    assert "no route" in caught.value.__notes__
    assert len(caught.value.unconfirmed) == 2


def test_an_output_that_stays_on_is_named_too(absent):
    with pytest.raises(InstrumentError) as caught:
        opened_with(absent, synthesizers="AbsentSynthesizers", generator="StubbornGenerator")
    assert any("still on" in what for what in caught.value.unconfirmed)


def test_a_stop_while_a_bench_is_opened_opens_no_more(absent):
    asked = []

    def stopped():
        asked.append(len(asked))
        return len(asked) > 2

    with pytest.raises(OpeningStoppedError) as caught:
        open_bench(
            bench_of("others_drivers").replace({
                "instruments.synthesizers.driver": f"{absent}:LoggedSynthesizers",
                "instruments.generator.driver": f"{absent}:LoggedGenerator",
            }),
            PREPARATION, stopped=stopped,
        )  # fmt: skip
    assert caught.value.exit_status == 130
    assert sorted(sys.modules[absent].orders) == ["RF off", "output off"]
    assert sys.modules["others_drivers"].closed == ["LoggedGenerator", "LoggedSynthesizers"]


def test_a_bench_is_one_program_s_alone(absent, tmp_path, monkeypatch):
    monkeypatch.setenv("REEDBENCH_LOCKS", str(tmp_path / "locks"))
    bench_file = bench_of("others_drivers").replace(
        {"instruments.generator.options": {"port": "P"}}
    )
    held = open_bench(bench_file, PREPARATION, does="measures R07.h5")
    with held, pytest.raises(BenchInUseError, match=r"measures R07\.h5"):
        open_bench(bench_file, PREPARATION)
    open_bench(bench_file, PREPARATION).close()


def test_an_instrument_is_opened_again_after_its_connection_is_lost(absent):
    """`safe_off` does so once, and what is then confirmed counts."""
    bench = opened_with(absent, synthesizers="LoggedSynthesizers", generator="LoggedGenerator")
    lost = bench.synthesizers

    def gone():
        raise InstrumentError("synthesizers: the port is gone; plug it in again")

    lost.rf_off = gone
    assert safe_off(bench) == ()
    assert bench.synthesizers is not lost
    assert sys.modules[absent].orders == ["output off", "RF off"]
    bench.close()


def test_an_instrument_that_hangs_keeps_nothing_else_on(absent, monkeypatch, awake_s):
    monkeypatch.setattr("drivers.safe_off._PATIENCE_S", 1.0)
    bench = opened_with(absent, synthesizers="LoggedSynthesizers", generator="LoggedGenerator")
    hanging = threading.Event()
    bench.generator.ramp_to = lambda volts, duration_s: hanging.wait(20)
    begun_s = time.monotonic()
    (left,) = safe_off(bench)
    assert awake_s(begun_s) < 3
    assert "generator" in left
    assert sys.modules[absent].orders == ["RF off"]
    hanging.set()


def test_ctrl_c_does_not_keep_the_bench_on(absent, monkeypatch):
    """Also where a script handles no signals: all is off before the interrupt goes on."""
    bench = opened_with(absent, synthesizers="LoggedSynthesizers", generator="LoggedGenerator")

    def slow(volts, duration_s):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.3)

    bench.generator.ramp_to = slow
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            safe_off(bench)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sys.modules[absent].orders == ["output off", "RF off"]


def test_importing_the_roles_and_the_registry_does_not_load_scipy():
    code = (
        "import sys, drivers.roles, drivers.registry, drivers.context, drivers.errors;"
        "sys.exit('scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
