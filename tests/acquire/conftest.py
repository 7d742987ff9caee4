"""Fake instruments that tell what was asked of them, and fail where they are told to."""

import functools
import json
import math
import multiprocessing
from dataclasses import dataclass, field
from fractions import Fraction

import event_model
import numpy as np
import pytest

from acquire.runner.recorder import reconstruction_of
from drivers.errors import InstrumentError
from drivers.roles import Bench, Frame
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.preparation import Preparation
from protocols.protocol import Protocol
from runs.documents import documents_path
from runs.provenance import git_revision, package_versions

_PROVENANCE = {
    "git_revision": functools.cache(git_revision),
    "package_versions": functools.cache(package_versions),
}


@dataclass
class FakeBench:
    """Instruments whose every order goes through `do`, which logs it.

    `failing` names orders that raise, from the n-th time on; `before` may do anything else.
    `picture` gives the image of a frame of some number and shape; `spoilt` changes the frames of
    the n-th acquisition, the first being 1.
    """

    log: list = field(default_factory=list)
    failing: dict = field(default_factory=dict)
    before: object = None
    picture: object = lambda id, shape: np.full(shape, 100 + id, np.uint16)
    spoilt: dict = field(default_factory=dict)
    time_s: float = 0.0
    started_s: float = 0.0
    pair_hz: tuple = (Fraction(0), Fraction(0))
    sine: tuple = (Fraction(0), 0.0)
    output_on: bool = False
    rf: bool = False
    running: bool = False
    shape: tuple = (0, 0)
    next_id: int = 0

    def do(self, name, *arguments):
        self.log.append((name, *arguments))
        self.time_s += 0.01
        count = sum(1 for entry in self.log if entry[0] == name)
        if self.before is not None:
            self.before(name, count)
        if count >= self.failing.get(name, np.inf):
            raise InstrumentError(f"fake: {name} fails; mend it")

    def names(self):
        return [entry[0] for entry in self.log]

    def opened(self):
        return Bench(
            name="fake bench",
            fingerprint="0" * 64,
            preparation=Preparation("R07", "A", "asymmetric"),
            seed=1,
            synthesizers=FakeSynthesizers(self),
            generator=FakeGenerator(self),
            camera=FakeCamera(self),
            clock=FakeClock(self),
        )


class FakeInstrument:
    identity = "fake"

    def __init__(self, bench):
        self.bench = bench

    def close(self):
        pass


class FakeClock(FakeInstrument):
    def now_s(self):
        return self.bench.time_s

    def wait(self, seconds):
        self.bench.time_s += max(seconds, 0.0)


class FakeSynthesizers(FakeInstrument):
    step_hz = Fraction(1, 10)

    def set_pair(self, aom1_hz, aom2_hz):
        self.bench.do("set_pair", aom1_hz, aom2_hz)
        self.bench.pair_hz = (aom1_hz, aom2_hz)

    def read_pair(self):
        self.bench.do("read_pair")
        return self.bench.pair_hz

    def rf_on(self):
        self.bench.do("rf_on")
        self.bench.rf = True

    def rf_off(self):
        self.bench.do("rf_off")
        self.bench.rf = False


class FakeGenerator(FakeInstrument):
    def set_sine(self, frequency_hz, volts):
        self.bench.do("set_sine", frequency_hz, volts)
        self.bench.sine, self.bench.output_on = (frequency_hz, volts), True

    def ramp_to(self, volts, duration_s):
        self.bench.do("ramp_to", volts, duration_s)
        self.bench.sine = (self.bench.sine[0], volts)

    def output_off(self):
        self.bench.do("output_off")
        self.bench.output_on = False

    def read(self):
        self.bench.do("read")
        return (*self.bench.sine, self.bench.output_on)


class FakeCamera(FakeInstrument):
    """A camera that runs freely.

    Unless told otherwise, every pixel of frame k is k counts brighter than 100, so that frames can
    be told apart.
    """

    saturation_dn = 4095

    def configure(self, frame_rate_hz, exposure_s, shape):
        self.bench.do("configure", frame_rate_hz, exposure_s, shape)
        self.bench.rate_hz, self.bench.shape = frame_rate_hz, shape

    def start(self):
        self.bench.do("start")
        self.bench.running = True
        self.bench.started_s, self.bench.next_id = self.bench.time_s, 0

    def stop(self):
        self.bench.do("stop")
        self.bench.running = False

    def grab(self, count, not_before_s):
        bench = self.bench
        bench.do("grab", count, not_before_s)
        wanted_s = max(not_before_s, bench.time_s) - bench.started_s
        first = max(bench.next_id, math.ceil(wanted_s * bench.rate_hz))
        ids = range(first, first + count)
        bench.next_id = first + count
        starts_s = [bench.started_s + float(id / bench.rate_hz) for id in ids]
        bench.time_s = starts_s[-1] + float(1 / bench.rate_hz)
        images = [bench.picture(id, bench.shape) for id in ids]
        frames = [Frame(*parts) for parts in zip(ids, starts_s, images, strict=True)]
        return bench.spoilt.get(bench.names().count("grab"), list)(frames)

    def now_s(self):
        return self.bench.time_s


@pytest.fixture(autouse=True)
def _provenance_is_asked_once(monkeypatch):
    """Git and the packages' metadata say the same of every run of these tests."""
    for name, answer in _PROVENANCE.items():
        monkeypatch.setattr(f"runs.writer.{name}", answer)


@pytest.fixture
def fake_bench():
    return FakeBench


@pytest.fixture(scope="session")
def plans():
    """Plans that were made in this session: they never change."""
    return {}


@pytest.fixture
def tiny_plan(small_plan, plans):
    """Plan `steps` steps on 32 × 40 pixels, which a fake camera fills; none is taken again."""

    def make(steps=3, **changes):
        small = {"sweep.first": 12, "sweep.last": 10 + 2 * steps}
        small |= {"camera.width": 40, "camera.height": 32, "policy.bad_pictures.retry": 0}
        asked = {**small, **changes}
        if repr(asked) not in plans:
            plan = small_plan(asked)
            # As if read from files, whose text need not be written anew for every run.
            protocol = Protocol.from_text(plan.protocol.text, plan.protocol.source)
            bench_file = BenchFile.from_text(plan.bench.text, plan.bench.source)
            plans[repr(asked)] = make_plan(protocol, bench_file)
        return plans[repr(asked)]

    return make


@pytest.fixture
def lit():
    """Return `FakeBench.picture` of a plan: a bright reed, turning a quarter of a turn a frame."""

    def make(plan, turn=Fraction(1, 4)):
        reconstruction, rng = reconstruction_of(plan), np.random.default_rng(3)
        region, transform = reconstruction.region, reconstruction.transform
        size = (2, region.height, region.width)
        rough = rng.standard_normal(size, dtype=np.float32)
        light = transform.to_sensor(region.paste(rough[0] + 1j * rough[1], plan.frame_shape))
        light *= 400 / np.abs(light).max()

        def picture(id, shape):
            phase = np.exp(-2j * np.pi * float(id * turn % 1))
            # What the rounding of the camera leaves would be the same four pictures for ever.
            noise = np.random.default_rng(id).normal(0, 2, shape)
            return np.rint(2000 + 2 * (light * phase).real + noise).astype(np.uint16)

        return picture

    return make


@pytest.fixture
def documents_of():
    """Read the documents beside a run file, each checked against its schema."""

    def read(path):
        lines = documents_path(path).read_text(encoding="utf-8").splitlines()
        documents = [json.loads(line) for line in lines]
        for name, document in documents:
            event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
        return documents

    return read


@pytest.fixture(scope="session")
def processes():
    """Start processes that have imported already what a run needs, and end them all.

    ``start(code, **names)`` executes Python code in which those names are known, and ``said``: the
    end of a pipe whose other end is returned beside the process.
    """
    started = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(
            ["acquire.runner.script", "drivers.simulated", "event_model"]
        )

        def start(code, **names):
            heard, said = context.Pipe(duplex=False)
            child = context.Process(target=exec, args=(code, {**names, "said": said}))
            child.start()
            # The other end is the child's alone: when it is gone, hearing ends.
            said.close()
            started.append((child, heard))
            return child, heard

        yield start
    for child, heard in started:
        child.kill()
        child.join()
        heard.close()
