"""Simulated instruments on wires outlive the drivers that talk to them."""

import gc
import threading
import time
import weakref
from fractions import Fraction

import numpy as np
import pytest

from drivers.context import BenchContext
from drivers.emulators.instruments import (
    EmulatedNovatech,
    EmulatedSiglent,
    serve_siglent,
)
from drivers.errors import InstrumentError
from drivers.registry import open_bench
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.preparation import Preparation
from protocols.protocol import Protocol

DRIVE_HZ = Fraction(2_033_075, 1000)
PAIR_HZ = (Fraction("80002036.1"), Fraction(80_000_000))
UNPLUGGED_ONCE = {"unplug_at": 80, "replug_after_s": 1.0}


@pytest.fixture
def context():
    """Return a function that gives the context of an emulated bench with simulated faults."""
    made = []

    def make(**faults):
        bench = BenchFile.from_file("emulated").replace(
            {
                "twin": {"mesh": "coarse", "faults": faults},
                "instruments.generator.options": {"timeout_s": 0.2},
            }
        )
        preparation = Preparation("R07", "A", "asymmetric")
        made.append(BenchContext(bench, preparation, np.random.default_rng(1), lambda _: None))
        return made[-1]

    yield make
    for each in made:
        each.close()


def opened(kind, context):
    instruments = context.description.instruments
    entry = instruments.synthesizers if kind is EmulatedNovatech else instruments.generator
    return kind(entry, context)


@pytest.fixture
def servers():
    """Return a function that names the servers that were started in this test and still run."""
    before = set(threading.enumerate())

    def names():
        return {thread.name for thread in set(threading.enumerate()) - before}

    return names


def test_a_box_keeps_what_it_plays_while_no_driver_talks_to_it(context, servers):
    bench = context()
    first = opened(EmulatedNovatech, bench)
    first.set_pair(*PAIR_HZ)
    device = first.device
    device.receive(b"V0 511\r\nV1 511\r\nI p\r\n")
    first.close()
    assert [output.frequency_hz for output in device.outputs[:2]] == list(PAIR_HZ)
    second = opened(EmulatedNovatech, bench)
    assert second.device is device
    assert [output.amplitude for output in device.outputs[:2]] == [0, 0], "off when opened"
    second.set_pair(*PAIR_HZ)
    assert second.read_pair() == PAIR_HZ
    second.close()
    assert servers() == {"PtyServer"}
    bench.close()
    assert servers() == set()


def test_a_generator_keeps_playing_while_no_driver_talks_to_it(context, servers):
    bench = context()
    first = opened(EmulatedSiglent, bench)
    first.set_sine(DRIVE_HZ, 1.0)
    device = first.device
    first.close()
    device.turn_knob("C1:OUTP ON")
    assert bench.share(serve_siglent).device is device
    second = opened(EmulatedSiglent, bench)
    assert second.device is device
    assert not device.socket[2], "off when opened"
    second.set_sine(DRIVE_HZ, 2.0)
    assert device.socket == (DRIVE_HZ, 1.0, True)
    second.close()
    bench.close()
    assert servers() == set()


def use_until_it_fails(instrument):
    for number in range(100):
        if isinstance(instrument, EmulatedNovatech):
            instrument.set_pair(PAIR_HZ[0] + Fraction(number, 10), PAIR_HZ[1])
        else:
            instrument.set_sine(DRIVE_HZ + number, 1.0)


@pytest.mark.parametrize(
    ("kind", "wire"),
    [(EmulatedNovatech, "synthesizers_wire"), (EmulatedSiglent, "generator_wire")],
    ids=["novatech", "siglent"],
)
def test_a_wire_that_was_pulled_can_be_opened_again(context, kind, wire):
    bench = context(**{wire: UNPLUGGED_ONCE})
    first = opened(kind, bench)
    if kind is EmulatedNovatech:
        first.rf_on()
    with pytest.raises(InstrumentError):
        use_until_it_fails(first)
    first.close()
    with pytest.raises(InstrumentError):
        opened(kind, bench)
    state = first.lab.state
    assert (state.rf_on, state.drive_v > 0) == (kind is EmulatedNovatech, kind is EmulatedSiglent)
    time.sleep(UNPLUGGED_ONCE["replug_after_s"] + 0.3)
    second = opened(kind, bench)
    assert second.device is first.device
    state = second.lab.state
    assert not state.rf_on
    assert state.drive_v == 0
    use_until_it_fails(second)
    second.close()


def test_faults_of_the_instruments_are_in_the_twin(context):
    bench = context(
        synthesizers_device={"skips_updates_from": 1, "shows_registers": False},
        generator_device={"trips_at": [60]},
    )
    with pytest.raises(InstrumentError, match="reads"):
        opened(EmulatedNovatech, bench)
    generator = opened(EmulatedSiglent, bench)
    with pytest.raises(InstrumentError, match="its output is off, but was switched on"):
        use_until_it_fails(generator)
    generator.close()


def test_a_relay_that_sticks_is_not_noticed_by_the_generator(context):
    bench = context(generator_device={"relay_sticks_from": 60})
    generator = opened(EmulatedSiglent, bench)
    for number in range(20):
        generator.set_sine(DRIVE_HZ + number, 1.0)
    generator.output_off()
    assert not generator.read()[2]
    assert generator.device.socket[2]
    assert generator.lab.state.drive_v > 0
    generator.close()


def test_a_closed_bench_leaves_nothing_in_memory():
    """A laboratory of full size holds some hundred megabytes."""
    plan = make_plan(Protocol.from_file("quick"), BenchFile.from_file("emulated").replace(
        {"twin": {"mesh": "coarse"}, "instruments.camera.driver": "simulated"}
    ))  # fmt: skip
    gc.collect()
    gc.disable()
    try:
        bench = open_bench(plan.bench, plan.preparation("R07"))
        lab = weakref.ref(bench.camera.lab)
        bench.close()
        del bench
        assert lab() is None
    finally:
        gc.enable()
