"""Protocol and bench files: what they say, and how they are refused."""

import json
import re
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import protocols.protocol
from protocols.bench import (
    BenchFile,
    find_bench,
    shipped_benches,
)
from protocols.errors import ProtocolError
from protocols.protocol import (
    MAX_STEPS,
    Policies,
    Policy,
    Protocol,
    find_protocol,
    shipped_protocols,
)
from protocols.reed import ReedFile
from protocols.yaml_files.strict_yaml import find_description
from tests.protocols.refusals import refusal

SERIES_A = find_protocol("seriesA").read_text(encoding="utf-8")
BENCH = find_bench().read_text(encoding="utf-8")


# --- What a file says --------------------------------------------------------------------------


def test_series_a_is_the_sweep_of_the_paper():
    protocol = Protocol.from_file("seriesA")
    assert (protocol.series, protocol.chamber) == ("A", "asymmetric")
    assert protocol.sweep.reference_hz == Fraction("1396.9")
    assert protocol.sweep.interval_cents == 25
    assert protocol.sweep.indices == range(1, 185)
    ramp = protocol.drive
    assert (ramp.from_v, ramp.to_v, ramp.first, ramp.last) == (Fraction(1, 2), 16, 1, 73)
    assert protocol.sideband.order == 1
    assert (protocol.camera.frames, protocol.camera.frame_rate_hz) == (4, Fraction("12.4"))
    assert protocol.exposure_s == 1 / Fraction("12.4")


def test_what_happens_when_a_step_goes_wrong_can_be_said():
    quick = Protocol.from_file("quick")
    # The values of series A hold where nothing is said.
    assert quick.policy == Protocol.from_file("seriesA").policy == Policies()
    assert (quick.policy.bad_step.retries, quick.policy.bad_step.then) == (1, "skip")
    assert (quick.policy.instrument_error.retries, quick.policy.instrument_error.then) == (
        0,
        "stop",
    )
    changed = quick.replace({"policy.instrument_error": {"retries": 2, "then": "skip"}})
    assert changed.policy.instrument_error == Policy(retries=2, then="skip")
    assert changed.policy.bad_step == quick.policy.bad_step
    assert changed.replace({"policy.bad_step.then": "stop"}).policy.bad_step.retries == 1
    assert Protocol.from_text(changed.text) == changed


def test_series_b_differs_only_in_the_excitation():
    series_a, series_b = Protocol.from_file("seriesA"), Protocol.from_file("seriesB")
    assert series_b.chamber == "symmetric"
    names = {"name": series_a.name, "series": "A", "chamber": "asymmetric"}
    assert series_b.replace(names) == series_a


def test_shipped_files_are_complete():
    assert shipped_protocols() == ("quick", "seriesA", "seriesB")
    assert shipped_benches() == ("emulated", "simulated")


@pytest.mark.parametrize("model", [Protocol, BenchFile])
def test_optional_sections_have_defaults(model):
    text, dropped = {
        Protocol: (SERIES_A, ("sideband", "tolerance", "policy", "keep")),
        BenchFile: (BENCH, ("twin",)),
    }[model]
    content = yaml.safe_load(text)
    short = {key: value for key, value in content.items() if key not in dropped}
    assert model.from_text(yaml.safe_dump(short)) == model.from_text(text)


@pytest.mark.parametrize(
    ("sideband", "selected"),
    [
        ({}, (1,)),
        ({"order": 3}, (3,)),
        ({"order": 0}, (0,)),
        ({"orders": [0, 1, 2]}, (0, 1, 2)),
        ({"order": 5, "orders": [5, 0, 2]}, (5, 0, 2)),
    ],
)
def test_sidebands_are_one_or_several(sideband, selected):
    written = yaml.safe_dump(yaml.safe_load(SERIES_A) | {"sideband": sideband})
    protocol = Protocol.from_text(written)
    assert protocol.sideband.selected == selected
    assert Protocol.from_text(yaml.safe_dump(protocol.content())) == protocol


@pytest.mark.parametrize(
    ("sideband", "message"),
    [
        ({"orders": [0, 2]}, "sideband.orders: lacks sideband.order, which is 1; add 1"),
        ({"orders": []}, "sideband.orders: lacks sideband.order, which is 1; add 1"),
        ({"orders": [1, 0, 1]}, "sideband.orders: has 1 twice; write each order once"),
        ({"orders": [1, -1]}, "sideband.orders[1]: -1 should be greater than or equal to 0"),
    ],
)
def test_sidebands_that_make_no_sense_are_refused(sideband, message):
    written = yaml.safe_dump(yaml.safe_load(SERIES_A) | {"sideband": sideband})
    with pytest.raises(ProtocolError, match=re.escape(message)):
        Protocol.from_text(written)


@pytest.mark.parametrize(
    ("model", "name"),
    [(Protocol, name) for name in shipped_protocols()]
    + [(BenchFile, name) for name in shipped_benches()],
)
def test_written_content_reads_as_the_same(model, name):
    original = model.from_file(name)
    written = original.replace({})
    assert "#" in original.text
    assert "#" not in written.text
    again = model.from_text(written.text)
    assert again == original
    assert again.sha256 == original.sha256


def test_hash_is_of_the_meaning():
    series_a = Protocol.from_text(SERIES_A)
    spelt = SERIES_A.replace("0.5 V", "500 mV").replace("# Series A", "# my own")
    assert Protocol.from_text(spelt).sha256 == series_a.sha256
    assert Protocol.from_text(SERIES_A.replace("0.5 V", "0.51 V")).sha256 != series_a.sha256


def test_bench_keeps_options_and_twin_untouched():
    text = BENCH.replace("twin: {}", "twin: {seed: 3, loss: [0.02, {F1: 0.03}]}").replace(
        "    step: 1 uHz", "    step: 1 uHz\n    options: {port: /dev/ttyUSB0, gain: 4.0}"
    )
    bench = BenchFile.from_text(text)
    assert bench.twin == {"seed": 3, "loss": [0.02, {"F1": 0.03}]}
    assert bench.instruments.generator.options == {"port": "/dev/ttyUSB0", "gain": 4.0}
    assert bench.fingerprint != BenchFile.from_file().fingerprint
    assert BenchFile.from_text(bench.replace({}).text).fingerprint == bench.fingerprint
    assert bench.acoustic_resonances_hz == (Fraction("4308.6"),)


# --- replace -----------------------------------------------------------------------------------


def test_replace_takes_key_paths_and_leaves_the_original():
    series_a = Protocol.from_file("seriesA")
    changed = series_a.replace(
        {"sweep.last": 30, "drive.to": "8 V", "camera.exposure": "40 ms"}, keep="frames"
    )
    assert (changed.sweep.last, changed.drive.to_v) == (30, 8)
    assert (changed.exposure_s, changed.keep) == (Fraction(1, 25), "frames")
    assert changed.replace({"camera.exposure": None}).camera.exposure_s is None
    assert series_a == Protocol.from_file("seriesA")
    assert Protocol.from_text(changed.text) == changed
    assert series_a.replace(**{"sweep.last": 30}).sweep.last == 30


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"sweep.lst": 30}, "sweep.lst: unknown key; did you mean 'last'?"),
        ({"sweep.last": "30"}, "sweep.last: '30'"),
        ({"drive.to": 8}, "drive.to: 8 has no unit"),
        ({"keep.frames": True}, "keep: has no key 'frames' below it"),
        ({"optics.distance": "1 m"}, "optics: unknown key"),
    ],
)
def test_replace_is_checked_like_a_file(changes, expected):
    message = refusal(Protocol.from_file("seriesA").replace, changes)
    assert message.startswith(f"seriesA (changed): {expected}")


def test_models_are_frozen():
    protocol = Protocol.from_file("seriesA")
    with pytest.raises(ValueError, match="frozen"):
        protocol.sweep.last = 3


# --- Wrong files -------------------------------------------------------------------------------

BOMB = "a: &a [x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(20)
)

WRONG_TEXTS = {
    # name: (text in series A to replace, its replacement, key path and message expected)
    "unknown key": ("interval:", "intervall:", "sweep.intervall: unknown key; did you mean 'int"),
    "unknown section": ("tolerance:", "tolerances:", "tolerances: unknown key; did you mean 'tol"),
    "far from any key": ("tolerance:", "qqq:", "qqq: unknown key; known are name, series"),
    "missing key": ("  frame_rate: 12.4 Hz\n", "", "camera.frame_rate: is missing"),
    "missing unit": ("1396.9 Hz", "1396.9", "sweep.reference: 1396.9 has no unit; write a freq"),
    "missing unit, quoted": ("12.4 Hz\n", "'12.4'\n", "camera.frame_rate: '12.4' is not a number"),
    "wrong unit": ("16 V,", "16 Hz,", "drive.to: '16 Hz' is not a voltage"),
    "unknown unit": ("settle: 40 ms", "settle: 40 msec", "settle: '40 msec' has the unknown"),
    "NaN": ("from: 0.5 V", "from: .nan", "drive.from: nan is not a finite number"),
    "NaN with unit": ("from: 0.5 V", "from: nan V", "drive.from: 'nan V' is not a number"),
    "infinite": ("16 V,", ".inf,", "drive.to: inf is not a finite number"),
    "negative volts": (
        "from: 0.5 V",
        "from: -0.5 V",
        "drive.from: '-0.5 V' should be greater than 0",
    ),
    "absurd volts": (
        "from: 0.5 V",
        "from: 1e30 V",
        "drive.from: '1e30 V' should be less than",
    ),
    "bool": ("first: 1\n", "first: yes\n", "sweep.first: True should be a valid integer"),
    "float index": ("first: 1\n", "first: 1.0\n", "sweep.first: 1.0 should be a valid integer"),
    "huge index": ("last: 184", f"last: 0x{'F' * 900}", "sweep.last: "),
    "octal": ("first: 1\n", "first: 010\n", "sweep.first: '010' is not a decimal number"),
    "hexadecimal": ("first: 1\n", "first: 0x10\n", "sweep.first: '0x10' is not a decimal"),
    "sexagesimal": ("last: 184", "last: 1:30", "sweep.last: '1:30' is not a decimal number"),
    "underscores": ("first: 1\n", "first: 1__0\n", "sweep.first: '1__0' is not a decimal"),
    "huge float": ("first: 1\n", "first: 1.0e+999\n", "sweep.first: inf is not a finite number"),
    "key without value": ("chamber: asym", "calibration:\nchamber: asym", "calibration: an empty"),
    "bidi": ("name: Ser", "name: \u202eSer", "name: holds the character U+202E"),
    "escape": ("name: Series A, ", 'name: "\\e[2J" #', "name: holds the character U+001B"),
    "two lines": ("name: Series A, ", 'name: "a\\nb" #', "name: holds the character U+000A"),
    "unseen key": ("keep:", '"\\e[2J": 1\nkeep:', "holds the character U+001B"),
    "long key": ("tolerance:", f"{'t' * 900}:", "tttttttttttttttttttt…"),
    "no number": ("last: 184", "last: 0x_", "sweep.last: '0x_' is not a decimal number"),
    "empty value": ("last: 184", "last:", "sweep.last: an empty value should be"),
    "0 steps": ("last: 184", "last: 0", "sweep.last: 0 is below sweep.first 1, so there are 0 st"),
    "too many octaves": ("last: 184", "last: 5000", "sweep.last: 5000 is over 20 octaves"),
    "no stride": ("last: 184", "last: 184\n  stride: 0", "sweep.stride: 0 should be greater"),
    "no ramp": ("last: 73", "last: 1", "drive.last: 1 is not above drive.first 1"),
    "frames 3": ("frames: 4", "frames: 3", "camera.frames: 3 frames make no hologram"),
    "frames 8": ("frames: 4", "frames: 8", "camera.frames: 8 frames make no hologram"),
    "not a choice": ("asymmetric\n", "lopsided\n", "chamber: 'lopsided' should be 'asymmetric'"),
    "scalar for a section": ("\n  order: 1", " 1", "sideband: 1 is no mapping; give order"),
    "list for a section": ("\n  order: 1", " [1]", "sideband: a list is no mapping"),
    "unknown policy": (
        "retries: 1, then",
        "retry: 1, then",
        "policy.bad_step.retry: unknown",
    ),
    "half a policy": (
        "{retries: 1, then: skip}",
        "{retries: 1}",
        "policy.bad_step.then: is missing",
    ),
    "endless retries": (
        "retries: 1, then",
        "retries: 6, then",
        "policy.bad_step.retries: 6 should",
    ),
    "negative retries": (
        "retries: 1, then",
        "retries: -1, then",
        "policy.bad_step.retries: -1 sho",
    ),
    "no such end": ("then: skip}", "then: panic}", "policy.bad_step.then: 'panic' should be"),
    "scalar for a policy": (
        "instrument_error: {retries: 0, then: stop}",
        "instrument_error: stop",
        "policy.instrument_error: 'stop' is no mapping",
    ),
    "duplicate key": ("last: 184", "last: 184\n  last: 30", "sweep.last: is given twice, first in"),
    "anchor": ("name: Ser", "name: &a Ser", "name: has a YAML anchor"),
    "tag": ("name: Ser", "name: !!python/name:os.system Ser", "name: has the YAML tag"),
    "date": ("name: Series A, asymmetric excitation", "name: 2026-01-01", "name: has the YAML typ"),
    "merge": ("sideband:\n", "sideband:\n  <<: {order: 2}\n", "sideband: has the YAML type"),
    "boolean key": ("keep: hol", "on: 1\nkeep: hol", "has a key that is not a word"),
    "tab": ("  order: 1", "\torder: 1", "is not YAML (found character '\\t'"),
    "open bracket": ("last: 73}", "last: 73", "is not YAML"),
    "two documents": ("keep:", "---\nkeep:", "is not YAML"),
    "control character": ("name: S", "name: \x01S", "is not text"),
    "long value": ("name: S", f"name: {'S' * 2000}", "name: is longer than 1000 characters"),
    "long name": ("name: S", f"name: {'S' * 200}", "name: 'SSS"),
    "deep": ("name: S", f"name: {'[' * 50_000} S", "name[0][0]"),
}


@pytest.mark.parametrize("case", WRONG_TEXTS)
def test_wrong_file_is_refused_in_one_line(case, tmp_path):
    old, new, expected = WRONG_TEXTS[case]
    assert old in SERIES_A
    file = tmp_path / "my sweep.yaml"
    file.write_text(SERIES_A.replace(old, new, 1), encoding="utf-8")
    message = refusal(Protocol.from_file, file)
    assert message.startswith(str(file))
    assert f": {expected}" in message


def test_line_number_is_that_of_the_key():
    text = "\n\n" + SERIES_A.replace("last: 184", "last: 0")
    line = text.splitlines().index("  last: 0") + 1
    assert f"f.yaml:{line}: sweep.last" in refusal(Protocol.from_text, text, "f.yaml")


def test_missing_key_is_in_the_line_of_its_section():
    text = SERIES_A.replace("  last: 184\n", "")
    line = text.splitlines().index("sweep:") + 1
    assert f"f.yaml:{line}: sweep.last: is missing" in refusal(Protocol.from_text, text, "f.yaml")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "is empty"),
        (b"# only a comment\n", "is empty"),
        (b"hello world", "'hello world' is not a mapping"),
        (b"- 1\n- 2\n", "a list is not a mapping"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "is not text"),
        (bytes(1000), "is not text"),
        (b"x: 1\n" * 1_000_000, "is larger than 64 KiB"),
        (BOMB.encode(), ":1: a: has a YAML anchor"),
        (b"name: *a\n", ":1: name: has a YAML anchor"),
    ],
)
def test_what_is_no_protocol_at_all(data, expected, tmp_path):
    file = tmp_path / "odd.yaml"
    file.write_bytes(data)
    start = time.perf_counter()
    message = refusal(Protocol.from_file, file)
    assert time.perf_counter() - start < 2
    assert message.startswith(str(file))
    assert expected in message


def test_folder(tmp_path):
    assert refusal(Protocol.from_file, tmp_path) == f"{tmp_path}: is a folder; name a file in it"


def test_link_to_itself(tmp_path):
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    assert "no such file" in refusal(Protocol.from_file, tmp_path / "loop.yaml")


def test_name_that_no_file_can_have():
    assert "cannot be read: File name too long" in refusal(Protocol.from_file, "x" * 300)


def test_forbidden_file(tmp_path, monkeypatch):
    def forbid(*_):
        raise PermissionError(13, "Permission denied")

    file = tmp_path / "secret.yaml"
    file.write_text(SERIES_A, encoding="utf-8")
    monkeypatch.setattr(Path, "open", forbid)
    assert "secret.yaml: cannot be read: Permission denied" in refusal(Protocol.from_file, file)


def test_escape_sequences_do_not_reach_the_terminal():
    text = SERIES_A.replace("keep: holograms", 'keep: "\\e[31mred"\n"\\e[2J": 1')
    assert "\x1b" not in refusal(Protocol.from_text, text, "\x1b[2Jf.yaml")


@given(st.text(max_size=300))
@settings(deadline=None)
def test_any_text_is_refused_with_a_protocol_error(text):
    refused = False
    try:
        Protocol.from_text(text)
    except ProtocolError:
        refused = True
    assert refused


@given(st.data())
@settings(deadline=None)
def test_a_damaged_file_is_read_or_refused(data):
    start = data.draw(st.integers(0, len(SERIES_A)))
    end = data.draw(st.integers(start, min(start + 20, len(SERIES_A))))
    damage = data.draw(st.text("[]{}:-&*!|>'\"%@`#,?\t\n 0x_.", max_size=4))
    message = "read"
    try:
        Protocol.from_text(SERIES_A[:start] + damage + SERIES_A[end:])
    except ProtocolError as error:
        message = str(error)
    assert message.isprintable()


WRONG_BENCHES = {
    "unknown key": ("pixel:", "pixels:", "instruments.camera.pixels: unknown key; did you mean 'p"),
    "option next to the driver": (
        "step: 1 uHz",
        "step: 1 uHz\n    port: x",
        "generator.port: unkn",
    ),
    "wrong dimension": ("650 nm", "650 nHz", "optics.wavelength: '650 nHz' is not a length"),
    "volts of no kind": ("  volts_are: peak\n", "", "limits.volts_are: is missing; add it"),
    "volts of another kind": (
        "volts_are: peak",
        "volts_are: mean",
        "limits.volts_are: 'mean' should",
    ),
    "output without load": (
        "driver: simulated\n    step: 1 uHz",
        "driver: simulated\n    step: 1 uHz\n    output: {amplifier_gain: 2.0}",
        "generator.output.load: is missing",
    ),
    "limits exchanged": ("volts_max: 16 V", "volts_max: 0 V", "limits.volts_max: '0 V' should"),
    "drive exchanged": ("drive_max: 20 kHz", "drive_max: 20 Hz", "limits.drive_max: the maximum"),
    "line without unit": ("[4308.6 Hz]", "[4308.6]", "acoustic_resonances[0]: 4308.6 has no unit"),
    "window down to 0 Hz": ("centre: 80 MHz", "centre: 80 uHz", "synthesizers.window: 5000000 Hz"),
    "steps beyond the window": ("step: 0.1 Hz", "step: 6 MHz", "narrower than instruments.synth"),
    "long driver": ("driver: simulated", f"driver: {'s' * 101}", "synthesizers.driver: 'sss"),
    "too near": ("distance: 1.0 m", "distance: 80 mm", "optics: distance 0.08 m is below"),
}


def test_more_steps_than_a_run_has_are_refused():
    series_a = Protocol.from_file("seriesA")
    fine = {"sweep.interval": "0.1 cents", "sweep.first": 1}
    assert len(series_a.replace({**fine, "sweep.last": MAX_STEPS}).sweep.indices) == MAX_STEPS
    for more in ({"sweep.first": 0}, {"sweep.stride": 2, "sideband.orders": [0, 1, 2]}):
        message = refusal(series_a.replace, {**fine, "sweep.last": MAX_STEPS, **more})
        assert f"at most {MAX_STEPS}" in message
    still = {"kind": "dark", "count": 1000, "exposures": ["20 ms"] * 51}
    message = refusal(series_a.replace, {"keep": "frames", "calibration": still})
    assert "calibration: makes 51000 steps" in message


def test_a_reed_s_name_that_no_file_can_have_is_no_reed():
    # Of 255 characters at most, but of more bytes than a file system takes.
    protocol = Protocol.from_file("seriesA").replace({"reed": "é" * 250})
    assert "reed: " in refusal(protocol.reed_file)


@pytest.mark.parametrize(
    ("known", "key"),
    [
        ({"sensor_nonlinearity": {"fraction": [1]}}, "known.sensor_nonlinearity.fraction"),
        ([1], "known"),
        (3, "known"),
    ],
)
def test_a_list_for_the_size_of_an_effect_is_refused(known, key):
    message = refusal(BenchFile.from_text, BENCH + f"known: {known}\n", "lab.yaml")
    assert key in message


@pytest.mark.parametrize("case", WRONG_BENCHES)
def test_wrong_bench_is_refused(case):
    old, new, expected = WRONG_BENCHES[case]
    assert old in BENCH
    message = refusal(BenchFile.from_text, BENCH.replace(old, new, 1), "lab.yaml")
    assert message.startswith("lab.yaml:")
    assert expected in message


# --- The kind of reed --------------------------------------------------------------------------

UNEVEN = """  thickness_map:
    x: [2 mm, 20 mm]
    y: [-5 mm, 5 mm]
    deviation: [[3 um, 0 um], [0 um, 0 um]]
"""


def test_a_protocol_without_a_reed_is_for_a_clarinet_s():
    protocol = Protocol.from_text(SERIES_A.replace("reed: clarinet\n", ""))
    assert protocol == Protocol.from_text(SERIES_A)
    assert protocol.reed_file() == ReedFile.from_file("clarinet")


def test_a_reed_file_is_looked_for_in_the_folder_of_the_protocol_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    bass = find_description("bass-clarinet", "reed", "reeds").read_text(encoding="utf-8")
    Path("mine/reed.yaml").write_text(bass.replace("name: bass clarinet", "name: next"))
    Path("reed.yaml").write_text(bass.replace("name: bass clarinet", "name: here"))
    asked = SERIES_A.replace("reed: clarinet", "reed: reed.yaml")
    Path("mine/sweep.yaml").write_text(asked, encoding="utf-8")
    assert Protocol.from_file("mine/sweep.yaml").reed_file().name == "next"
    assert Protocol.from_text(asked, "elsewhere/sweep.yaml").reed_file().name == "here"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("name:", "nome:", "reed: reed.yaml:1: nome: unknown key; did you mean 'name'?"),
        ("cane:\n", UNEVEN + "\ncane:\n", "reed: reed.yaml has a thickness map with two differ"),
        (None, None, "reed: bassoon: there is no such file, nor a shipped reed of that name"),
    ],
)
def test_a_reed_that_a_run_cannot_be_fitted_with_is_refused(
    old, new, expected, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    name = "bassoon"
    if old:
        name = "reed.yaml"
        clarinet = find_description("clarinet", "reed", "reeds").read_text(encoding="utf-8")
        Path(name).write_text(clarinet[clarinet.index("name:") :].replace(old, new, 1))
    protocol = Protocol.from_text(SERIES_A.replace("reed: clarinet", f"reed: {name}"), "f.yaml")
    line = SERIES_A.splitlines().index("reed: clarinet") + 1
    assert refusal(protocol.reed_file).startswith(f"f.yaml:{line}: {expected}")


# --- Names -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["seriesA", "seriesA.yaml", "protocols/seriesA.yaml"])
def test_shipped_protocol_is_found_from_anywhere(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "seriesA").mkdir()
    assert Protocol.from_file(name).series == "A"


@pytest.mark.parametrize(
    "name", ["simulated", "benches/simulated.yaml", "protocols/benches/simulated.yaml"]
)
def test_shipped_bench_is_found_from_anywhere(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert BenchFile.from_file(name) == BenchFile.from_file()


def test_own_file_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("seriesA").write_text(SERIES_A.replace("series: A", "series: mine"), encoding="utf-8")
    assert Protocol.from_file("seriesA").series == "mine"


def test_unknown_name_lists_the_shipped_ones():
    message = refusal(find_protocol, "serieA")
    assert "did you mean seriesA?" in message
    assert "shipped are campaign, quick, seriesA, seriesB" in message
    assert "nor a shipped bench of that name; shipped are emulated, simulated" in refusal(
        find_bench, "lab"
    )


def test_reading_a_protocol_loads_no_heavy_library():
    heavy = ("scipy", "matplotlib", "h5py", "pint")
    code = (
        "import sys, json; import protocols.protocol; "
        f"print(json.dumps([name for name in {heavy!r} if name in sys.modules]))"
    )
    root = Path(protocols.protocol.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == []
