"""Fake instruments that tell what was asked of them, and fail where they are told to."""

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
import pytest

from drivers.errors import InstrumentError
from drivers.roles import Bench, Frame, Preparation


@dataclass
class FakeBench:
    """Instruments whose every order goes through `do`, which logs it.

    `failing` names orders that raise, from the n-th time on; `before` may do anything else.
    """

    log: list = field(default_factory=list)
    failing: dict = field(default_factory=dict)
    before: object = None
    time_s: float = 0.0
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
    """Every pixel of frame k is k counts brighter than 100, so that frames can be told apart."""

    saturation_dn = 4095

    def configure(self, frame_rate_hz, exposure_s, shape):
        self.bench.do("configure", frame_rate_hz, exposure_s, shape)
        self.bench.rate_hz, self.bench.shape = frame_rate_hz, shape

    def start(self):
        self.bench.do("start")
        self.bench.running = True

    def stop(self):
        self.bench.do("stop")
        self.bench.running = False

    def grab(self, count, not_before_s):
        self.bench.do("grab", count, not_before_s)
        period_s = float(1 / self.bench.rate_hz)
        start_s = max(not_before_s, self.bench.time_s)
        ids = range(self.bench.next_id, self.bench.next_id + count)
        self.bench.next_id += count
        self.bench.time_s = start_s + count * period_s
        return [
            Frame(id, start_s + k * period_s, np.full(self.bench.shape, 100 + id, np.uint16))
            for k, id in enumerate(ids)
        ]

    def now_s(self):
        return self.bench.time_s


@pytest.fixture
def fake_bench():
    return FakeBench


@pytest.fixture
def tiny_plan(small_plan):
    """Plan `steps` steps on 32 × 40 pixels, which a fake camera fills."""

    def make(steps=3, **changes):
        small = {"sweep.first": 12, "sweep.last": 10 + 2 * steps}
        return small_plan({**small, "camera.width": 40, "camera.height": 32, **changes})

    return make
