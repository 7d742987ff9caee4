"""Benches are put together from names; what cannot be put together is said in one line."""

import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from acquire.bench_file import BenchFile
from drivers import registry
from drivers.errors import BenchSetupError, InstrumentError
from drivers.registry import find_driver, known_drivers, open_bench
from drivers.roles import Camera, Preparation, SignalGenerator, SynthesizerPair
from drivers.simulated import SimulatedCamera, SimulatedGenerator, SimulatedSynthesizers

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
    """A package of drivers that somebody else wrote."""
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

    monkeypatch.setattr(registry, "entry_points", points)
    ours = {"simulated", "basler", "aravis", "wire-camera"}
    assert set(known_drivers("camera")) == {*ours, "theirs"}
    assert find_driver("camera", "theirs").__name__ == "Camera"
    with pytest.raises(BenchSetupError, match=r"known are keysight-33500b, [^;]*wire-siglent, or"):
        find_driver("generator", "theirs")


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


def test_importing_the_roles_and_the_registry_does_not_load_scipy():
    code = (
        "import sys, drivers.roles, drivers.registry, drivers.context, drivers.errors;"
        "sys.exit('scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
