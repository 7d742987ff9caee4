"""Sweep laws: frequencies and volts of every kind, and what is wrong with each."""

import doctest
import json
from fractions import Fraction
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from protocols import laws
from protocols.bench import BenchFile
from protocols.errors import ProtocolError
from protocols.laws import AmplitudeLaw, FrequencyLaw
from protocols.plan import make_plan
from protocols.protocol import Protocol

SERIES_A = Protocol.from_file("seriesA")
BENCH = BenchFile.from_file()
LINEAR = {"law": "linear", "from": "1 kHz", "to": "1.5 kHz", "step": "100 Hz"}
LIST = {"law": "list", "frequencies": ["1.9 kHz", "3.4 kHz", "5 kHz"]}
CONSTANT = {"law": "constant", "volts": "2 V"}
# All laws of volts, in the order in which they are tried.
KINDS = ", ".join(
    get_args(kind.model_fields["law"].annotation)[0] for kind in get_args(get_args(AmplitudeLaw)[0])
)
TABLE = {"law": "table", "frequencies": ["1 kHz", "2 kHz"], "volts": ["8 V", "2 V"]}


def test_the_tutorials_of_the_laws_are_right():
    result = doctest.testmod(laws)
    assert (result.failed, result.attempted >= 12) == (0, True)


def read(kind, content):
    return TypeAdapter(kind).validate_python(content)


# --- Plans of every law ------------------------------------------------------------------------


def test_a_linear_sweep_is_planned():
    plan = make_plan(SERIES_A.replace(sweep=LINEAR, drive=CONSTANT), BENCH)
    assert plan.violations == ()
    assert [float(step.asked_hz) for step in plan.steps] == [1000, 1100, 1200, 1300, 1400, 1500]
    assert {step.volts for step in plan.steps} == {2.0}
    assert all(step.lock_residual_hz == 0 for step in plan.steps)


def test_a_list_is_planned_and_measured_from_the_top():
    plan = make_plan(SERIES_A.replace(sweep=LIST | {"direction": "down"}, drive=TABLE), BENCH)
    assert plan.violations == ()
    assert [(step.index, float(step.asked_hz)) for step in plan.steps] == [
        (1, 1900), (2, 3400), (3, 5000)
    ]  # fmt: skip
    assert plan.sequence == (2, 1, 0)
    assert [step.volts for step in plan.steps] == [2.6, 2.0, 2.0]


@pytest.mark.parametrize("sweep", [LINEAR, LIST])
def test_every_law_is_written_and_read_again(sweep):
    protocol = SERIES_A.replace(sweep=sweep | {"stride": 2}, drive=TABLE)
    again = Protocol.from_text(protocol.text)
    assert (again, again.sha256) == (protocol, protocol.sha256)
    assert make_plan(again, BENCH).steps == make_plan(protocol, BENCH).steps
    assert json.dumps(protocol.content())


@given(st.integers(1, 10**9), st.integers(0, 10**9), st.integers(1, 10**8), st.integers(1, 5))
def test_a_linear_sweep_stays_within_its_ends(millihertz, width, step, stride):
    """The last step is less than one step below the end."""
    step = max(step, width // 1000 + 1)
    sweep = read(
        FrequencyLaw,
        {
            "law": "linear", "from": f"{millihertz} mHz", "to": f"{millihertz + width} mHz",
            "step": f"{step} mHz", "stride": stride,
        },
    )  # fmt: skip
    asked = [1000 * sweep.frequency_hz(k) for k in sweep.indices]
    assert asked == list(range(millihertz, millihertz + width + 1, step * stride))


@given(st.lists(st.integers(1, 10**5), min_size=2, unique=True), st.integers(1, 2 * 10**5))
def test_volts_of_a_table_lie_between_those_of_its_points(hertz, asked_hz):
    nodes = sorted(hertz)
    volts = [1 + hz % 7 for hz in nodes]
    table = read(
        AmplitudeLaw,
        {
            "law": "table", "frequencies": [f"{hz} Hz" for hz in nodes],
            "volts": [f"{v} V" for v in volts],
        },
    )  # fmt: skip
    found = table.volts(1, Fraction(asked_hz))
    assert min(volts) <= found <= max(volts)
    assert [table.volts(1, Fraction(hz)) for hz in nodes] == volts
    assert {float(v) for _, v in table.extremes()} == {min(volts), max(volts)}


def test_limits_of_the_tweeter_hold_for_the_extremes_of_a_ramp():
    ramp = SERIES_A.drive
    assert dict(ramp.extremes()) == {"from": ramp.from_v, "to": ramp.to_v}


# --- Errors ------------------------------------------------------------------------------------

WRONG = {
    "no law": ("sweep", {k: LINEAR[k] for k in ("from", "to", "step")}, "sweep.law", "geometric"),
    "unknown law": ("sweep", LINEAR | {"law": "cubic"}, "sweep.law", "'cubic'"),
    "a number for a law": ("sweep", LINEAR | {"law": 3}, "sweep.law", "one of geometric, linear"),
    "a list for a law": ("sweep", LINEAR | {"law": ["x"]}, "sweep.law", "one of geometric, linear"),
    "law of the other section": ("sweep", LINEAR | {"law": "ramp"}, "sweep.law", "'ramp'"),
    "no mapping": ("sweep", 3, "sweep", "is no mapping; give"),
    "another law": ("sweep", LINEAR | {"interval": "1 cents"}, "sweep.interval", "known are"),
    "misspelt": ("sweep", {**LINEAR, "steps": "1 Hz"}, "sweep.steps", "did you mean 'step'?"),
    "named as a law": ("sweep", LINEAR | {"linear": 1}, "sweep.linear", "unknown key"),
    "no unit": ("sweep", LINEAR | {"step": 10}, "sweep.step", "10 has no unit"),
    "backwards": ("sweep", LINEAR | {"to": "900 Hz"}, "sweep.to", "write at least '1000 Hz'"),
    "endless": ("sweep", LINEAR | {"step": "1e-30 Hz"}, "sweep.step", "write a larger step"),
    "descending": (
        "sweep", {"law": "list", "frequencies": ["2 kHz", "1 kHz"]}, "sweep.frequencies",
        "in ascending order",
    ),
    "twice": (
        "sweep", {"law": "list", "frequencies": ["2 kHz", "2 kHz"]}, "sweep.frequencies",
        "write each frequency once",
    ),
    "no frequency": ("sweep", {"law": "list", "frequencies": []}, "sweep.frequencies", "a list"),
    "a wrong item": (
        "sweep", {"law": "list", "frequencies": ["1 kHz", "2 V"]}, "sweep.frequencies[1]",
        "'2 V' is not a frequency",
    ),
    "direction": ("sweep", LIST | {"direction": "left"}, "sweep.direction", "'left' should be"),
    "0 V": ("drive", {"law": "constant", "volts": "0 V"}, "drive.volts", "greater than 0"),
    "unknown drive law": ("drive", {"law": "linear"}, "drive.law", f"one of {KINDS}"),
    "uneven table": ("drive", TABLE | {"volts": ["1 V"]}, "drive.volts", "has 1 values for 2"),
    "one point": (
        "drive", {"law": "table", "frequencies": ["1 kHz"], "volts": ["1 V"]},
        "drive.frequencies", "at least 2",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_law_is_refused_with_key_value_and_remedy(case):
    section, content, key, expected = WRONG[case]
    with pytest.raises(ProtocolError) as refused:
        SERIES_A.replace({section: content})
    message = str(refused.value)
    assert message.startswith(f"seriesA (changed): {key}: ")
    assert expected in message
    assert message.isprintable()


def test_an_error_of_a_law_names_its_line():
    text = SERIES_A.text.replace("interval: 25 cents", "interval: 25 Hz")
    line = text.splitlines().index("  interval: 25 Hz") + 1
    with pytest.raises(ProtocolError, match=rf"^f\.yaml:{line}: sweep\.interval: "):
        Protocol.from_text(text, "f.yaml")


IMPOSSIBLE = {
    "high": ({"sweep": LINEAR | {"to": "30 kHz"}}, "sweep.to", "write '20000 Hz'"),
    "low": ({"sweep": LINEAR | {"from": "5 Hz", "step": "1 Hz"}}, "sweep.from", "write '20 Hz'"),
    "all too high": (
        {"sweep": LINEAR | {"from": "25 kHz", "to": "26 kHz"}}, "sweep.from", "no step",
    ),
    "list": (
        {"sweep": {"law": "list", "frequencies": ["1 kHz", "2 kHz", "25 kHz"]}},
        "sweep.frequencies", "end with '2000 Hz'",
    ),
    "low list": (
        {"sweep": {"law": "list", "frequencies": ["1 Hz", "2 kHz"]}}, "sweep.frequencies",
        "begin with '2000 Hz'",
    ),
    "dense": ({"sweep": LINEAR | {"step": "0.02 Hz"}}, "sweep.step", "write a larger step"),
    "dense list": (
        {"sweep": {"law": "list", "frequencies": ["1 kHz", "1000.01 Hz"]}}, "sweep.frequencies",
        "leave out one of the two",
    ),
    "constant": ({"drive": {"law": "constant", "volts": "17 V"}}, "drive.volts", "'16 V'"),
    "table": ({"drive": TABLE | {"volts": ["17 V", "1 V"]}}, "drive.volts", "17 V is above"),
}  # fmt: skip


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_a_plan_beyond_the_bench_names_the_key_of_its_law(case):
    changes, key, expected = IMPOSSIBLE[case]
    (violation,) = make_plan(SERIES_A.replace(changes), BENCH).violations
    assert violation.key == key
    assert expected in violation.message
