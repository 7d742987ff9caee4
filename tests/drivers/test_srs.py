"""Two SG384 as a pair: literal bytes, faults on real sockets, and safety when one of them fails."""

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.context import BenchContext
from drivers.emulators.serving import (
    PtyServer,
    SocketServer,
    WireFaults,
)
from drivers.emulators.srs import SRSEmulator
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.roles import SynthesizerPair
from drivers.synthesizers.srs import SRSPair
from drivers.transport.visa import VisaLine
from protocols.bench import BenchFile
from protocols.preparation import Preparation

PAIRS = yaml.safe_load((Path(__file__).parent / "wire_pairs_srs.yaml").read_text())
BENCH = BenchFile.from_file()
CENTRE_HZ = Fraction(80_000_000)
PAIR_HZ = (Fraction("80002036.125"), CENTRE_HZ)
OTHER_HZ = (Fraction("80002037.000001"), Fraction("79999999.999999"))
SHORT = {"timeout_s": 0.1}
STEP = {"step": "1 uHz"}


def opened(resources, options=(), **keys):
    defaults = {"resources": resources, "power_dbm": -3.5, "power_max_dbm": 0.0, "timeout_s": 2.0}
    changes = {"instruments.synthesizers.options": defaults | dict(options)}
    changes |= {f"instruments.synthesizers.{key}": value for key, value in (STEP | keys).items()}
    bench = BENCH.replace(changes)
    context = BenchContext(
        bench, Preparation("R07", "A", "asymmetric"), np.random.default_rng(0), lambda _: None
    )
    return SRSPair(bench.instruments.synthesizers, context)


class Box:
    """A simulated generator, what it heard and what it gave."""

    def __init__(self, **settings):
        self.heard = []
        self.changes = []
        self.device = SRSEmulator(lambda *state: self.changes.append(state), **settings)

    def receive(self, data):
        self.heard += data.decode("ascii", errors="replace").splitlines()
        return self.device.receive(data)


@contextmanager
def served(boxes, faults=(None, None)):
    """Put two generators on sockets; give their VISA names."""
    with ExitStack() as stack:
        resources = []
        for box, fault in zip(boxes, faults, strict=True):
            server = SocketServer(box, fault)
            stack.callback(server.close)
            resources.append(f"TCPIP::127.0.0.1::{server.port}::SOCKET")
        yield resources


@pytest.fixture
def pair():
    """An open pair and its two generators, without faults."""
    boxes = (Box(), Box(serial_number="s/n003163"))
    with served(boxes) as resources:
        driver = opened(resources)
        yield driver, boxes
        driver.close()


def playing(boxes):
    return tuple(box.device.frequency_hz for box in boxes)


def lit(boxes):
    return tuple(box.device.is_on for box in boxes)


# --- Literal bytes -----------------------------------------------------------------------------


@pytest.mark.parametrize("pairs", PAIRS, ids=lambda pairs: pairs["source"][:30])
def test_the_simulated_generator_answers_what_the_sources_say(pairs):
    device = SRSEmulator(lambda *state: None)
    for line in pairs["conversation"]:
        assert device.receive(line["said"].encode()) == line["answered"].encode(), line


IDENTITY = "Stanford Research Systems,SG384,s/n001796,ver1.21.26\r\n"
OFF = [("ENBR 0\n", ""), ("ENBR?\n", "0\r\n")]
WHOLE = [
    ("*IDN?\n", IDENTITY),
    ("*IDN?\n", IDENTITY),
    ("ENBR 0\n", ""),
    *2 * OFF,
    ("MODL 0\n", ""),
    ("MODL?\n", "0\r\n"),
    ("TIMB?\n", "3\r\n"),
    ("FREQ 80000000.000000\n", ""),
    ("FREQ?\n", "80000000.000000\r\n"),
    ("FREQ 80002036.125000\n", ""),
    ("FREQ?\n", "80002036.125\r\n"),
    ("AMPR -3.50\n", ""),
    ("AMPR?\n", "-3.5\r\n"),
    ("ENBR 1\n", ""),
    ("ENBR?\n", "1\r\n"),
    ("FREQ?\n", "8.0002036125E7\r\n"),
    *2 * OFF,
]


class Script:
    """Answers literal lines with literal lines, and nothing to any other."""

    def __init__(self, conversation):
        self.rest = list(conversation)
        self.strange = []

    def receive(self, data):
        answers = b""
        for line in data.splitlines(keepends=True):
            if self.rest and line == self.rest[0][0].encode():
                answers += self.rest.pop(0)[1].encode()
            else:
                self.strange.append(line)
        return answers


def test_the_driver_says_and_understands_literal_bytes():
    boxes = (Script(WHOLE), Box())
    with served(boxes) as resources:
        driver = opened(resources)
        driver.set_pair(*PAIR_HZ)
        driver.rf_on()
        assert driver.read_pair() == PAIR_HZ
        driver.rf_off()
        driver.close()
    assert (boxes[0].rest, boxes[0].strange) == ([], [])


# --- What the pair does ------------------------------------------------------------------------


def test_it_is_a_pair_that_says_what_it_is(pair):
    driver, _ = pair
    assert isinstance(driver, SynthesizerPair)
    assert driver.step_hz == Fraction(1, 1_000_000)
    assert driver.identity == (
        "Stanford Research Systems,SG384,s/n001796,ver1.21.26 and "
        "Stanford Research Systems,SG384,s/n003163,ver1.21.26"
    )


def test_it_opens_at_the_centre_with_rf_and_modulation_off(pair):
    _, boxes = pair
    assert playing(boxes) == (CENTRE_HZ, CENTRE_HZ)
    assert lit(boxes) == (False, False)
    assert [box.device.is_modulated for box in boxes] == [False, False]
    # RF went off before anything else changed.
    assert [box.changes[0][2] for box in boxes] == [False, False]


MICROHERTZ = st.integers(75 * 10**12, 85 * 10**12).map(lambda steps: Fraction(steps, 10**6))


@pytest.fixture(scope="module")
def shared_pair():
    boxes = (Box(), Box())
    with served(boxes) as resources:
        driver = opened(resources)
        yield driver, boxes
        driver.close()


@given(aom1_hz=MICROHERTZ, aom2_hz=MICROHERTZ)
@settings(max_examples=40, deadline=None)
def test_every_microhertz_is_played_and_read_exactly(shared_pair, aom1_hz, aom2_hz):
    driver, boxes = shared_pair
    driver.set_pair(aom1_hz, aom2_hz)
    assert playing(boxes) == driver.read_pair() == (aom1_hz, aom2_hz)


def test_rf_goes_on_at_its_power_and_off(pair):
    driver, boxes = pair
    driver.rf_on()
    assert lit(boxes) == (True, True)
    assert [float(box.device.power_dbm) for box in boxes] == [-3.5, -3.5]
    # The power was there before the output was on.
    assert all(change[1] == -3.5 for box in boxes for change in box.changes if change[2])
    driver.rf_off()
    driver.rf_off()
    assert lit(boxes) == (False, False)


def test_a_power_between_two_steps_is_rounded_down():
    boxes = (Box(), Box())
    with served(boxes) as resources:
        driver = opened(resources, {"power_dbm": -0.001, "power_max_dbm": -0.001})
        driver.rf_on()
        assert [float(box.device.power_dbm) for box in boxes] == [-0.01, -0.01]
        driver.close()


def test_only_the_generator_that_changes_is_reported(pair):
    driver, boxes = pair
    for box in boxes:
        box.heard.clear()
    driver.set_pair(*PAIR_HZ)
    assert boxes[0].heard == ["FREQ 80002036.125000", "FREQ?"]
    assert boxes[1].heard == ["FREQ?"]


@pytest.mark.parametrize("hz", [Fraction(74_999_999), Fraction("85000000.000001"), float("nan")])
def test_a_frequency_outside_the_window_is_refused_before_anything_is_sent(pair, hz):
    driver, boxes = pair
    for box in boxes:
        box.heard.clear()
    with pytest.raises(LimitError, match=r"AOM2 was asked for .*inside the window"):
        driver.set_pair(PAIR_HZ[0], hz)
    assert [box.heard for box in boxes] == [[], []]


def test_one_external_timebase_is_enough_and_none_is_not():
    with served((Box(timebase=1), Box(timebase=3))) as resources:
        opened(resources).close()
    with served((Box(timebase=1), Box(timebase=0))) as resources:
        with pytest.raises(
            InstrumentError, match=r"TIMB\? says 1 and 0.* feed both with one 10 MHz"
        ):
            opened(resources)
        opened(resources, {"check_timebase": False}).close()


# --- Faults ------------------------------------------------------------------------------------


class Coarse(Box):
    """Plays whole hertz only."""

    def receive(self, data):
        answer = super().receive(data)
        self.device.frequency_hz = Fraction(round(self.device.frequency_hz))
        return answer


def test_a_failure_between_the_two_takes_rf_off():
    boxes = (Box(), Coarse())
    with served(boxes) as resources:
        driver = opened(resources)
        driver.rf_on()
        with pytest.raises(InstrumentError, match=r"AOM2, at .*RF is off at both") as caught:
            driver.set_pair(*OTHER_HZ)
        assert "'FREQ 79999999.999999' and reads 80000000" in str(caught.value)
        assert "\n" not in str(caught.value)
        assert lit(boxes) == (False, False)
        # The next pair that is confirmed turns RF on again, with both frequencies sent again.
        driver.set_pair(*PAIR_HZ)
        assert (playing(boxes), lit(boxes)) == (PAIR_HZ, (True, True))
        driver.close()


def test_rf_that_was_taken_off_stays_off_after_a_failure():
    boxes = (Box(), Coarse())
    with served(boxes) as resources:
        driver = opened(resources)
        driver.rf_on()
        driver.rf_off()
        with pytest.raises(InstrumentError):
            driver.set_pair(*OTHER_HZ)
        driver.set_pair(*PAIR_HZ)
        assert (playing(boxes), lit(boxes)) == (PAIR_HZ, (False, False))
        driver.close()


def test_rf_that_cannot_be_taken_off_is_said():
    boxes = (Box(), Box())
    with served(boxes, (WireFaults(unplug_at=10), None)) as resources:
        driver = opened(resources, SHORT)
        driver.rf_on()
        with pytest.raises(InstrumentError, match=r"RF is not confirmed off \(.*AOM1"):
            driver.set_pair(*PAIR_HZ)
        assert lit(boxes)[1] is False, "that which can be taken off is"
        with pytest.raises(InstrumentError, match="AOM1"):
            driver.rf_off()
        driver.close()
        driver.close()


class Timed(Box):
    """Remembers when its output went off."""

    off_s = None

    def receive(self, data):
        answer = super().receive(data)
        if not self.device.is_on and self.off_s is None:
            self.off_s = time.monotonic()
        return answer


@contextmanager
def both_lit(faults, timeout_s):
    """A driver with RF on at both, from when on things go wrong at both."""
    boxes = Timed(), Timed()
    servers = [SocketServer(box) for box in boxes]
    resources = [f"TCPIP::127.0.0.1::{server.port}::SOCKET" for server in servers]
    driver = opened(resources, {"timeout_s": timeout_s})
    driver.rf_on()
    for box, server in zip(boxes, servers, strict=True):
        box.off_s = None
        server.spoil(faults)
    yield driver, boxes
    driver.close()
    for server in servers:
        server.close()


NEVER = WireFaults(lose_answer_at=range(1, 1000))


@pytest.mark.parametrize("amid", [False, True], ids=["in step", "amid a question"])
@pytest.mark.parametrize(
    ("faults", "timeout_s", "most_s"),
    [
        (WireFaults(), 1.0, 0.5),
        # Two answers of each, one after another, and two more to get in step again.
        (WireFaults(slow_s=0.5), 1.0, 6 * 0.5 + 0.5),
        (NEVER, 0.3, 6 * 0.3 + 0.5),
    ],
    ids=["prompt", "slow", "never"],
)
def test_rf_is_off_before_any_answer_is_waited_for(faults, timeout_s, most_s, amid, awake_s):
    with both_lit(faults, timeout_s) as (driver, boxes):
        if amid:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(VisaLine, "_read", _interrupted)
                with pytest.raises(KeyboardInterrupt):
                    driver.read_pair()
        started_s = time.monotonic()
        if faults is NEVER:
            with pytest.raises(InstrumentError, match=r"AOM1.*AOM2") as caught:
                driver.rf_off()
            assert "\n" not in str(caught.value)
        else:
            driver.rf_off()
        assert awake_s(started_s) < most_s
        assert awake_s(started_s, max(box.off_s for box in boxes)) < 0.3


def _interrupted(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("faults", [WireFaults(), NEVER], ids=["prompt", "never"])
def test_closing_takes_rf_off_and_does_not_wait_long(faults, awake_s):
    with both_lit(faults, 5.0) as (driver, boxes):
        started_s = time.monotonic()
        driver.close()
        assert awake_s(started_s) < 1.5
        assert lit(boxes) == (False, False)


def test_rf_off_that_got_lost_is_sent_again(pair):
    driver, boxes = pair
    driver.rf_on()
    receive, heard = boxes[1].receive, []

    def half_deaf(data):
        heard.append(data)
        return b"" if heard == [b"ENBR 0\n"] else receive(data)

    boxes[1].receive = half_deaf
    driver.rf_off()
    assert lit(boxes) == (False, False)
    assert heard.count(b"ENBR 0\n") == 2


def test_a_frequency_is_played_as_soon_as_it_is_set(pair):
    assert pair[0].echoes_registers is False


def test_opening_that_fails_leaves_both_off():
    boxes = (Box(timebase=1), Box(timebase=0))
    with served(boxes) as resources, pytest.raises(InstrumentError, match="TIMB"):
        opened(resources)
    assert lit(boxes) == (False, False)
    boxes = (Box(), Box())
    with served(boxes, (None, NEVER)) as resources:
        with pytest.raises(InstrumentError, match=r"AOM2.*did not answer"):
            opened(resources, SHORT)
        assert [goes_off(box) for box in boxes] == [True, True], "also that which says nothing"


def test_another_model_of_the_same_language_is_switched_off_and_refused():
    other = Box()
    other.device._identity = "Stanford Research Systems,SG396,s/n1,ver1"  # noqa: SLF001  # its own
    with served((Box(), other)) as resources:
        with pytest.raises(InstrumentError, match="no SG382"):
            opened(resources)
        assert goes_off(other)


def goes_off(box):
    """Whether a command that was sent before the line was closed arrives."""
    until_s = time.monotonic() + 2.0
    while box.device.is_on and time.monotonic() < until_s:
        time.sleep(0.01)
    return not box.device.is_on


def session(boxes, resources, options=SHORT):
    """Go through a session; after each act that succeeded, both must be as believed."""
    driver = opened(resources, options)
    try:
        driver.rf_on()
        assert lit(boxes) == (True, True)
        driver.set_pair(*PAIR_HZ)
        assert playing(boxes) == driver.read_pair() == PAIR_HZ
        driver.set_pair(*OTHER_HZ)
        assert playing(boxes) == driver.read_pair() == OTHER_HZ
        driver.rf_off()
        assert lit(boxes) == (False, False)
    finally:
        driver.close()


def at_once(check, cases):
    """Do checks side by side, for nearly all their time is spent waiting for answers."""
    with ThreadPoolExecutor(8) as pool:
        outcomes = {case: pool.submit(check, *case) for case in cases}
    failed = {case: done.exception() for case, done in outcomes.items() if done.exception()}
    assert not failed


SPOILT_ANSWERS = ("lose_answer_at", "garble_answer_at", "late_answer_at")


def test_a_fault_never_leaves_a_wrong_belief():
    def check(kind, at):
        boxes = (Box(), Box())
        faults = WireFaults(late_s=1.5 * SHORT["timeout_s"], **{kind: (at,)})
        with served(boxes, (None, faults)) as resources, suppress(InstrumentError):
            session(boxes, resources)

    at_once(check, product((*SPOILT_ANSWERS, "lose_command_at"), range(1, 17)))


def test_nothing_is_given_up_for_one_spoilt_answer():
    def check(kind, at):
        boxes = (Box(), Box())
        faults = WireFaults(late_s=0.4, **{kind: (at,)})
        with served(boxes, (None, faults)) as resources:
            session(boxes, resources, {"timeout_s": 0.3})

    at_once(check, product(SPOILT_ANSWERS, (1, 2, 6)))


def test_faults_of_the_whole_line_are_found_when_opening():
    for faults, said in (
        (WireFaults(echo=True), "said just that"),
        (WireFaults(wrong_baud=True), "did not answer"),
        (WireFaults(unplug_at=1), "AOM2, at "),
    ):
        boxes = (Box(), Box())
        with (
            served(boxes, (None, faults)) as resources,
            pytest.raises(InstrumentError, match=said),
        ):
            opened(resources, SHORT)


def test_a_serial_line_works_too():
    box = Box()
    server = PtyServer(box)
    with served((Box(), Box())) as resources:
        driver = opened([resources[0], f"ASRL{server.port}::INSTR"], {"baud": 115200})
        driver.set_pair(*OTHER_HZ)
        assert box.device.frequency_hz == OTHER_HZ[1]
        driver.close()
    server.close()


def test_another_instrument_is_no_synthesizer():
    class Other:
        def receive(self, data):
            return b"".join(b"Siglent Technologies,SDG2042X,1,2\r\n" for _ in data.splitlines())

    with (
        served((Box(), Other())) as resources,
        pytest.raises(InstrumentError, match=r"AOM2, at .*'Siglent.*check options\.resources"),
    ):
        opened(resources)


# --- Bench files -------------------------------------------------------------------------------

TWO = ["TCPIP::192.0.2.1::5025::SOCKET", "TCPIP::192.0.2.2::5025::SOCKET"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"power_dbm": 1.0}, r"power_dbm 1 is above power_max_dbm 0"),
        ({"power_max_dbm": 20.0}, r"options\.power_max_dbm: "),
        ({"power_dbm": float("nan")}, r"options\.power_dbm: "),
        ({"resources": TWO[:1]}, r"options\.resources: "),
        ({"resources": TWO[:1] * 2}, r"name the same generator twice"),
        ({"resource": TWO[0]}, r"options\.resource: unknown key"),
    ],
)
def test_wrong_options_are_refused_by_name(options, said):
    with pytest.raises(BenchSetupError, match=said):
        opened(TWO, options)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"step": "0.1 Hz"}, r"synthesizers\.step: is 0\.1 Hz.*write step: 1 uHz"),
        ({"window": "79.5 MHz"}, r"synthesizers\.window: .*950000 to"),
        ({"centre": "2.1 GHz"}, r"synthesizers\.window: .*2025000000 Hz"),
    ],
)
def test_a_bench_file_that_they_cannot_play_is_refused(keys, said):
    with pytest.raises(BenchSetupError, match=said):
        opened(TWO, **keys)
