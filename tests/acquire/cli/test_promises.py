"""What the README promises, through the command line: one test per promise."""

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest

import acquire
from drivers.simulated.settings import Simulation, cane_of
from fitting.errors import FitError
from fitting.fringes.pictures import read_pictures
from physics.reed.cane.viscoelastic import Series, viscoelastic_cane
from physics.reed.reduced.elastic import viscoelastic_mode
from physics.reed.reduced.stored import reduced_reed
from protocols.reed import ReedFile
from runs.reader import Run

VERBS = (
    *("plan", "run", "pause", "continue", "list", "show", "fit", "report", "diagnose"),
    *("population", "acoustics", "modes", "paper", "effects", "pack"),
)
ROOT = Path(__file__).parents[3]


def listing(folder):
    """Every file below a folder with its size and time of change."""
    return {
        path.relative_to(folder): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in folder.rglob("*")
    }


def one_line(text):
    """The only line that went to standard error, without its prefix."""
    lines = text.splitlines()
    assert len(lines) == 1, text
    assert lines[0].startswith("acquire: ")
    return lines[0].removeprefix("acquire: ")


@pytest.fixture
def no_instruments(monkeypatch):
    """Fail if anything opens a bench."""

    def refuse(*arguments, **settings):
        raise AssertionError("a bench was opened")

    monkeypatch.setattr("acquire.runner.run_session.open_bench", refuse)


# --- README ------------------------------------------------------------------------------------


def test_commands_and_links_of_the_readme_exist():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"(?:^ {4}|`)acquire (\w+)", text, flags=re.MULTILINE))
    # Of `bench`, `check` and `off` have verbs of their own, see test_bench_verbs.
    assert named <= {*VERBS, "bench"}
    assert {"plan", "run", "list", "fit", "report"} <= named
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert (ROOT / target).exists(), target


def test_the_example_of_the_readme_is_tested_and_leaves_nothing_behind(request):
    assert "README.md" in request.config.getini("testpaths")
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count(">>> ") >= 6
    # A file in the folder of the tests would make the second time fail.
    assert not list(ROOT.glob("*.h5"))


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_and_json(cli, verb):
    said = cli(verb, "--help")
    assert said.status == 0
    assert "--json" in said.out
    assert said.err == ""


def test_help_lists_all_verbs(cli):
    said = cli("--help")
    assert all(verb in said.out for verb in VERBS)


# --- plan --------------------------------------------------------------------------------------


def test_a_plan_shows_every_step_and_touches_no_instrument(cli, folder, no_instruments):
    said = cli("plan", "seriesA")
    assert (said.status, said.err) == (0, "")
    assert "184 steps" in said.out
    assert re.search(r"\d+ min \d\d s at the frame rate of the camera, \d+ MB", said.out)
    assert "limit exceeded" not in said.out
    assert listing(folder) == {}


def test_a_plan_is_exact_to_the_last_digit(cli, no_instruments):
    answer = cli("plan", "protocols/seriesA.yaml", "--json").json
    assert [step["index"] for step in answer["steps"]] == list(range(1, 185))
    keys = "index asked_hz drive_hz aom1_hz aom2_hz difference_hz lock_residual_hz volts frames"
    for step in answer["steps"]:
        assert set(keys.split()) <= set(step)
        drive, aom1, aom2 = (Fraction(step[key]) for key in ("drive_hz", "aom1_hz", "aom2_hz"))
        assert aom1 - aom2 == Fraction(step["difference_hz"]) == drive + Fraction("12.4") / 4
        assert Fraction(step["lock_residual_hz"]) == 0
    assert answer["steps"][0]["volts"] == 0.5
    assert {step["volts"] for step in answer["steps"][72:]} == {16.0}
    assert answer["violations"] == []
    assert answer["known"] == {}
    assert answer["duration_s"] > 184 * 0.4
    assert answer["file_size_bytes"] > 1e6


def test_a_plan_shows_what_is_known_of_the_bench(cli, folder):
    shipped = Path(__file__).parents[3] / "protocols" / "benches" / "simulated.yaml"
    known = "known: {tip_mass: {mass: 4e-7 ± 1e-7 kg}}\n"
    text = shipped.read_text(encoding="utf-8")
    Path("mine.yaml").write_text(f"{text}\n{known}", encoding="utf-8")
    answer = cli("plan", "quick", "--bench", "mine.yaml", "--json").json
    assert answer["known"] == {"tip_mass": {"mass": "4e-7 ± 1e-7 kg"}}
    assert "tip_mass (mass 4e-7 ± 1e-7 kg)" in cli("plan", "quick", "--bench", "mine.yaml").out


# --- run, list ---------------------------------------------------------------------------------


def test_a_run_ends_with_a_file_a_fit_and_pictures(measured):
    answer = measured.said.json
    assert (answer["run"], answer["status"]) == (str(measured.a), "complete")
    assert answer["verdicts"] == {"ok": 47}
    refused = [each["not_identified"] for each in answer["fit"]["runs"]]
    assert {"F1", "T1", "F2", "T2"} <= set(answer["fit"]["modes"]), refused
    assert set(answer["files"]) == {"report", "contact sheet", "response", "modes"}
    assert all(mode["method"] == "joint" for mode in answer["fit"]["modes"].values())
    assert all(Path(file).is_file() for file in answer["files"].values())
    assert measured.said.err.count("\n") < 10


def test_a_run_knows_who_was_on_the_bench(cli, measured):
    said = cli("list", measured.a.parent, "--json")
    assert said.err == ""
    first, second = said.json
    assert first["path"] == str(measured.a)
    assert (first["reed"], first["strength"], first["series"]) == ("R07", 3.5, "A")
    assert (first["note"], first["operator"]) == ("new box A", "Ann")
    assert (first["status"], first["steps"], first["good"]) == ("complete", 47, 47)
    assert (second["series"], second["note"]) == ("B", "new box B")


def test_the_list_is_read_by_people_too(cli, measured):
    out = cli("list", measured.a.parent).out
    for word in ("R07", "3.5", "complete", "47/47"):
        assert word in out


def test_files_that_are_no_runs_are_reported_and_passed_over(
    cli, folder, protocol_file, bench_file
):
    cli("run", protocol_file(), "--bench", bench_file(), "--out", "good.h5", "--no-fit")
    Path("bad.h5").write_text("no HDF5")
    said = cli("list", ".", "--json")
    assert said.status == 0
    assert [entry["path"] for entry in said.json] == ["good.h5"]
    assert one_line(said.err).startswith("bad.h5: ")


def test_a_folder_that_is_not_there_is_bad_input(cli, folder):
    said = cli("list", "nowhere", "--json")
    assert (said.status, said.out) == (2, "")
    assert one_line(said.err).startswith("nowhere: ")


def test_a_series_of_ones_own_is_recorded(cli, folder, protocol_file, bench_file):
    asked = ["--bench", bench_file(), "--out", "x.h5", "--series", "B", "--no-fit", "--json"]
    assert cli("run", protocol_file(), *asked).status == 0
    assert cli("list", ".", "--json").json[0]["series"] == "B"


def test_words_of_people_are_shown_as_they_are(cli, folder, protocol_file, bench_file):
    note = "[red]wet[/red] [/nope] 50 %"
    asked = ["--bench", bench_file(), "--out", "x.h5", "--no-fit"]
    cli("run", protocol_file(), *asked, "--note", note, "--reed", "[R]1")
    shown = "".join(cli("list", ".").out.split())
    assert "[R]1" in shown
    assert cli("list", ".", "--json").json[0]["note"] == note


def test_a_run_without_a_name_goes_to_a_folder_of_runs(cli, folder, protocol_file, bench_file):
    asked = ["--bench", bench_file(), "--reed", "R/../07", "--no-fit", "--json"]
    path = Path(cli("run", protocol_file(), *asked).json["run"])
    assert path.parent == Path("measurements")
    assert path.is_file()


def test_a_reed_is_always_the_same_cane(cli, folder, protocol_file, bench_file):
    def brightness(name, *asked):
        common = ["--bench", bench_file(), "--no-fit", "--out", name]
        assert cli("run", protocol_file(), *common, *asked).status == 0
        with Run.open(name) as run:
            return np.stack([np.abs(run.field(step.position)) for step in run])

    first = brightness("1.h5", "--reed", "R07")
    assert np.array_equal(brightness("2.h5", "--reed", "R07"), first)
    assert not np.array_equal(brightness("3.h5", "--reed", "R08"), first)
    assert not np.array_equal(brightness("4.h5", "--reed", "R07", "--seed", "5"), first)


@pytest.mark.slow
def test_another_reed_is_measured_and_fitted_with_its_own_modes(
    cli, folder, protocol_file, bench_file, monkeypatch
):
    """F1 and T1 of an alto saxophone's reed, far below a clarinet's; all with a coarse mesh."""
    alto = ReedFile.from_file("alto-saxophone")
    coarse = reduced_reed(alto.geometry(), *Simulation(mesh="coarse").finite_elements)
    monkeypatch.setattr("fitting.cane.fit_runs.basis_of", lambda kind, announce: coarse)
    protocol = protocol_file(
        **{"reed": "alto-saxophone", "sweep.first": 10, "sweep.last": 60, "sweep.stride": 1},
        **{"camera.width": 640, "camera.height": 512},
    )
    asked = ["--bench", bench_file(), "--reed", "R07", "--out", "x.h5", "--no-fit"]
    assert cli("run", protocol, *asked).status == 0
    said = cli("fit", "x.h5", "--method", "picture", "--json")
    assert said.status == 0, said.err
    with Run.open("x.h5") as run:
        assert run.reed_file() == alto
        assert run.good.all()
    cane = viscoelastic_cane(cane_of("R07"), Series.A)
    found = said.json["modes"]
    assert list(found) == ["F1", "T1"]
    for name, clarinet_hz in (("F1", 1980.0), ("T1", 3377.0)):
        mode = viscoelastic_mode(coarse, cane, name, clarinet_hz)
        assert abs(1200 * math.log2(found[name]["hz"] / mode.frequency_hz)) < 25
        assert abs(1200 * math.log2(found[name]["hz"] / clarinet_hz)) > 250


def test_both_ways_to_keep_a_step_give_the_same_pictures(cli, folder, protocol_file, bench_file):
    pictures = []
    for keep in ("holograms", "frames"):
        asked = ["--bench", bench_file(), "--out", f"{keep}.h5", "--no-fit"]
        assert cli("run", protocol_file(keep=keep), *asked).status == 0
        with Run.open(f"{keep}.h5") as run:
            pictures.append(read_pictures(run).brightness)
    assert np.array_equal(*pictures)


def test_a_file_that_exists_is_never_overwritten(cli, folder, protocol_file, bench_file):
    asked = [protocol_file(), "--bench", bench_file(), "--out", "x.h5", "--no-fit"]
    assert cli("run", *asked).status == 0
    before = listing(folder)
    again = cli("run", *asked)
    assert again.status == 2
    assert again.out == ""
    assert "x.h5: exists already and is never overwritten" in again.err
    assert listing(folder) == before


@pytest.mark.parametrize(
    "label",
    [
        ["--strength", "inf"],
        ["--strength", "nan"],
        ["--seed", "-1"],
        ["--note", "\udcff"],
    ],
    ids=["inf", "nan", "seed", "bytes"],
)
def test_a_label_that_cannot_be_kept_is_refused_without_a_trace(
    cli, folder, protocol_file, bench_file, label
):
    asked = [protocol_file(), "--bench", bench_file(), "--no-fit", *label]
    before = listing(folder)
    said = cli("run", *asked)
    assert said.status == 2
    assert said.out == ""
    assert listing(folder) == before


def test_a_run_file_of_another_kind_is_refused_without_a_trace(
    cli, folder, no_instruments, protocol_file
):
    message = refused(cli, folder, "run", protocol_file(), "--out", "new/x.hdf5")
    assert "new/x.hdf5: the name of a run file ends in .h5" in message


def test_a_name_too_long_for_a_file_is_shortened_or_refused(cli, folder, protocol_file, bench_file):
    asked = [protocol_file(), "--bench", bench_file(), "--no-fit", "--reed", "x" * 300]
    assert cli("run", *asked).status in (0, 2)


# --- fit, report, diagnose ---------------------------------------------------------------------


def test_a_fit_prints_json_and_nothing_else(cli, measured):
    said = cli("fit", measured.a, "--json")
    assert (said.status, said.err) == (0, "")
    assert said.json == measured.said.json["fit"]


def test_a_fit_prints_a_table_of_modes_and_parameters(cli, measured):
    fit, out = measured.said.json["fit"], cli("fit", measured.a).out
    for name, mode in fit["modes"].items():
        assert re.search(rf"{name}\W+{mode['hz']:.1f}\b", out)
    for name, estimate in (fit["components"] or {}).items():
        assert re.search(rf"{name}\W+{re.escape(format(estimate['value'], '+.2f'))}", out)


@pytest.mark.slow
def test_both_series_together_fix_four_components(cli, measured):
    said = cli("fit", measured.a, measured.b, "--method", "picture", "--json")
    assert said.status == 0
    assert list(said.json["components"]) == ["e1", "e2", "e3", "e4"]
    cane = cane_of("R07")
    for name, estimate in said.json["components"].items():
        assert abs(estimate["value"] - getattr(cane, name)) < 4 * estimate["error"]
    assert [run["series"] for run in said.json["runs"]] == ["A", "B"]
    # Nothing excites them in series B.
    assert {"T1", "X1", "T3"}.isdisjoint(said.json["runs"][1]["modes"])


def test_one_run_twice_is_bad_input(cli, measured):
    said = cli("fit", measured.a, measured.a)
    assert (said.status, said.out) == (2, "")
    assert "series A and B of one reed" in one_line(said.err)


def test_an_unknown_model_is_bad_input(cli, measured):
    said = cli("fit", measured.a, "--model", "magic")
    assert (said.status, said.out) == (2, "")
    assert "magic" in said.err


def test_the_paper_s_model_can_be_asked_for(cli, measured, monkeypatch):
    asked = []

    def note_and_stop(runs, model, announce, method):
        asked.append((model, method))
        raise FitError("far enough")

    monkeypatch.setattr("acquire.analysis.fit_runs", note_and_stop)
    for arguments in ([], ["--model", "paper"], ["--method", "picture"]):
        assert cli("fit", measured.a, *arguments).status == 1
    assert asked == [("fem", "joint"), ("paper", "joint"), ("fem", "picture")]
    assert cli("fit", measured.a, "--method", "guess").status == 2


def test_a_report_is_one_page(cli, measured, folder):
    said = cli("report", measured.a, "--out", folder / "page.html", "--json")
    assert said.status == 0
    files = {name: Path(file) for name, file in said.json["files"].items()}
    assert files["report"] == folder / "page.html"
    assert set(folder.iterdir()) == set(files.values())
    assert "R07" in files["report"].read_text(encoding="utf-8")
    assert said.json["fit"] == measured.said.json["fit"]


def test_a_report_is_in_the_folder_of_its_run(cli, measured):
    out = cli("report", measured.a).out
    assert str(measured.a.with_suffix(".html")) in out


def test_the_catalogue_of_effects_is_listed_for_people_and_programs(cli):
    answer = cli("effects", "--json").json
    assert len(answer) >= 30
    assert {"id", "stage", "parameters", "unaffected", "similar", "check"} <= set(answer[0])
    assert all(effect["id"] in cli("effects").out for effect in answer[:3])


@pytest.mark.parametrize("verb", ["make", "score"])
def test_blind_verbs_have_help_and_json(cli, verb):
    said = cli("blind", verb, "--help")
    assert (said.status, said.err) == (0, "")
    assert "--json" in said.out


def test_a_tier_that_is_not_there_is_bad_input(cli, folder):
    pytest.importorskip("skfem", reason="the extra 'blind' is not installed")
    said = cli("blind", "make", folder / "cases", "--tier", "5", "--count", "1", "--seed", "1")
    assert said.status == 2
    assert "there is no tier 5; choose one of 0, 1, 2, 3, 4, 6" in one_line(said.err)
    assert listing(folder) == {}


def test_answers_without_cases_are_bad_input(cli, folder):
    pytest.importorskip("skfem", reason="the extra 'blind' is not installed")
    said = cli("blind", "score", folder / "no", "--answers", folder, "--key", folder / "key.json")
    assert said.status == 2
    assert "cannot be read" in one_line(said.err)


@pytest.mark.parametrize("verb", ["fit", "report", "diagnose"])
def test_a_run_that_is_not_there_is_bad_input(cli, folder, verb):
    said = cli(verb, "gone.h5", "--json")
    assert (said.status, said.out) == (2, "")
    assert one_line(said.err).endswith("gone.h5: there is no such file; check the name")
    assert listing(folder) == {}


# --- Bad protocols -----------------------------------------------------------------------------

BOMB = "a: &a [x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
BAD = {
    "an unknown key": ({"sweep.lats": 12}, "sweep.lats"),
    "a missing unit": ({"settle": "0.1"}, "settle"),
    "a bare number": ({"sweep.reference": 1396.9}, "sweep.reference"),
    "NaN": ({"sweep.reference": float("nan")}, "sweep.reference"),
    "NaN with a unit": ({"sweep.reference": "nan Hz"}, "sweep.reference"),
    "no steps": ({"sweep.last": 13}, "sweep.last"),
    "three frames": ({"camera.frames": 3}, "camera.frames"),
}
BEYOND = {
    "17 V": ({"drive.to": "17 V"}, "drive.to"),
    "30 kHz": ({"sweep.last": 214}, "sweep.last"),
    "all at 30 kHz": ({"sweep.reference": "30 kHz"}, "sweep.reference"),
}
NO_PROTOCOL = {
    "an anchor bomb": BOMB,
    "no YAML": "sweep: [1, 2",
    "no text": "\x00\x01\x02",
    "a list": "- 1\n- 2\n",
    "nothing": "",
}


def refused(cli, folder, *arguments):
    """Carry out a command that must leave no trace, and return its one line."""
    before = listing(folder)
    said = cli(*arguments)
    assert said.status == 2
    assert said.out == ""
    assert listing(folder) == before
    return one_line(said.err)


@pytest.mark.parametrize("verb", ["plan", "run"])
@pytest.mark.parametrize("what", BAD)
def test_a_bad_protocol_is_refused_in_one_line(
    cli, folder, protocol_file, no_instruments, what, verb
):
    changes, key = BAD[what]
    path = protocol_file(**changes)
    message = refused(cli, folder, verb, path)
    assert re.match(rf"{re.escape(str(path))}(:\d+)?: {re.escape(key)}", message)


@pytest.mark.parametrize("what", BEYOND)
def test_a_protocol_beyond_the_limits_is_refused_in_one_line(
    cli, folder, protocol_file, no_instruments, what
):
    changes, key = BEYOND[what]
    path = protocol_file(**changes)
    message = refused(cli, folder, "run", path)
    assert re.match(rf"{re.escape(str(path))}(:\d+)?: {re.escape(key)}", message)


@pytest.mark.parametrize("what", BEYOND)
def test_a_plan_beyond_the_limits_is_shown_with_what_is_wrong(
    cli, folder, protocol_file, no_instruments, what
):
    changes, key = BEYOND[what]
    path = protocol_file(**changes)
    said = cli("plan", path)
    assert said.status == 2
    assert f"limit exceeded: {key}: " in said.out
    answer = cli("plan", path, "--json")
    assert answer.status == 2
    assert key in [violation["key"] for violation in answer.json["violations"]]


@pytest.mark.parametrize("verb", ["plan", "run"])
@pytest.mark.parametrize("what", NO_PROTOCOL)
def test_what_is_no_protocol_is_refused_in_one_line(cli, folder, no_instruments, what, verb):
    path = folder / "bad.yaml"
    path.write_text(NO_PROTOCOL[what])
    started_s = time.monotonic()
    assert refused(cli, folder, verb, path).startswith(str(path))
    assert time.monotonic() - started_s < 5


@pytest.mark.parametrize("verb", ["plan", "run"])
def test_a_protocol_or_bench_that_is_not_there_is_refused(cli, folder, no_instruments, verb):
    assert "seriesA" in refused(cli, folder, verb, "seriesZ")
    assert "simulated" in refused(cli, folder, verb, "seriesA", "--bench", "atlantis")


# --- Faults: a verdict each, and no fit --------------------------------------------------------


ALL_NINE = list(range(1, 10))
# So that no run gives up before its last step.
PATIENT = {"policy.give_up_after": 99}
FAULTS = {
    "dropped": ({"drop_frame_at": ALL_NINE}, "not consecutive"),
    "stale": ({"stale_frame_at": ALL_NINE}, "before the setting had settled"),
    "lock": ({"frame_rate_error_ppm": 20_000.0}, "frames per second"),
    "saturated": ({"local_oscillator_factor": 4.0}, "pixels are saturated"),
    "no_signal": ({"tweeter_unplugged": True}, "loudspeaker's cable"),
}


@pytest.mark.parametrize("verdict", FAULTS)
def test_every_fault_has_a_verdict_of_its_own_and_no_fit(
    cli, folder, protocol_file, bench_file, verdict
):
    faults, words = FAULTS[verdict]
    asked = ["--bench", bench_file(faults=faults), "--out", "x.h5", "--json"]
    said = cli("run", protocol_file(**PATIENT), *asked, "--no-fit")
    assert said.status == 0
    assert said.json["verdicts"] == {verdict: 9}
    assert f"not good: 9 {verdict}" in said.err
    assert words in said.err
    refusal = cli("fit", "x.h5", "--json")
    assert (refusal.status, refusal.out) == (1, "")
    assert re.search(rf"0 of 9 steps are good.*9 {verdict}.*{words}", one_line(refusal.err))


def test_a_run_that_cannot_be_fitted_keeps_its_file_and_fails(
    cli, folder, protocol_file, bench_file
):
    bench = bench_file(faults={"tweeter_unplugged": True})
    said = cli("run", protocol_file(**PATIENT), "--bench", bench, "--out", "x.h5")
    assert said.status == 1
    assert "x.h5: 0 of 9 steps are good" in said.err.splitlines()[-1]
    with Run.open("x.h5") as run:
        assert run.status == "complete"


def test_one_dropped_frame_spoils_one_step(cli, folder, protocol_file, bench_file):
    bench = bench_file(faults={"drop_frame_at": [3]})
    once = protocol_file(**{"policy.bad_step": {"retries": 0, "then": "skip"}})
    said = cli("run", once, "--bench", bench, "--out", "x.h5", "--no-fit", "--json")
    assert said.json["verdicts"] == {"ok": 8, "dropped": 1}
    with Run.open("x.h5") as run:
        assert [step.index for step in run if step.verdict == "dropped"] == [18]
        assert 18 not in read_pictures(run).step_index


def test_the_printed_formula_is_no_lock_and_gives_no_fit(small_plan, tmp_path):
    """As the paper prints it, (f + f_CCD)/4: nowhere in the software but here."""
    right = small_plan({"sweep.first": 14, "sweep.last": 30, **PATIENT})
    rate_hz = right.protocol.camera.frame_rate_hz

    def misprinted(step):
        difference_hz = round((step.drive_hz + rate_hz) / 4 * 10) / Fraction(10)
        return replace(step, aom1_hz=step.aom2_hz + difference_hz, difference_hz=difference_hz)

    wrong = replace(right, steps=tuple(misprinted(step) for step in right.steps))
    summary = acquire.run(wrong, tmp_path / "wrong.h5", reed="R07")
    assert summary.counts == {"lock": 9}
    with Run.open(summary.path) as run:
        assert all("off the lock" in step.sentence for step in run)
        # It is not only said: the light of the reed is gone.
        assert max(step.signal_to_noise for step in run) < 1.5
        with pytest.raises(FitError, match="9 lock"):
            read_pictures(run)


# --- Ctrl-C, in a process of its own -----------------------------------------------------------

TRACING = """
from pathlib import Path

from drivers.simulated import SimulatedGenerator, SimulatedSynthesizers


def note(words):
    with Path(__file__).with_name("trace.txt").open("a") as file:
        file.write(words + "\\n")


class Generator(SimulatedGenerator):
    def __init__(self, entry, context):
        super().__init__(entry, context)
        note("opened")

    def set_sine(self, frequency_hz, volts):
        super().set_sine(frequency_hz, volts)
        note(f"sine {volts:g}")

    def ramp_to(self, volts, duration_s):
        super().ramp_to(volts, duration_s)
        note(f"ramp {volts:g}")

    def output_off(self):
        super().output_off()
        note("output off")


class Synthesizers(SimulatedSynthesizers):
    def rf_on(self):
        super().rf_on()
        note("rf on")

    def rf_off(self):
        super().rf_off()
        note("rf off")
"""


@pytest.fixture
def traced(folder, bench_file):
    """Bench file whose drivers write down what they are asked, and the environment to find them."""
    (folder / "tracing.py").write_text(TRACING)
    drivers = {"generator": "tracing:Generator", "synthesizers": "tracing:Synthesizers"}
    bench = bench_file(drivers=drivers, pace="realtime")
    return bench, os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


def started(*arguments, **settings):
    command = [sys.executable, "-m", "acquire", *map(str, arguments)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, **streams, **settings)


def wait_for_events(path, count, process):
    """Wait until a run has recorded some steps."""
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s:
        if path.exists() and path.read_text().count('["event", ') >= count:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    raise AssertionError("the run does not get on")


@pytest.mark.slow
def test_ctrl_c_ends_at_a_step_with_everything_off_and_a_readable_file(
    folder, traced, protocol_file
):
    bench, environment = traced
    protocol = protocol_file(**{"sweep.last": 140})
    process = started("run", protocol, "--bench", bench, "--out", "x.h5", "--json", env=environment)
    wait_for_events(folder / "x.documents.jsonl", 3, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    answer = json.loads(out)
    assert answer["status"] == "interrupted"
    assert "fit" not in answer

    trace = (folder / "trace.txt").read_text().split("\n")[:-1]
    assert trace[-3:] == ["ramp 0", "output off", "rf off"]
    assert trace.count("rf on") == 1

    # With nothing but h5py, as anybody can.
    with h5py.File("x.h5") as file:
        verdicts = [verdict.decode() for verdict in file["entry/steps/verdict"][()]]
        done = verdicts.count("ok")
        assert 3 <= done < 64
        assert verdicts == ["ok"] * done + ["pending"] * (64 - done)
        assert file["entry/status"].asstr()[()] == "interrupted"
        powers = [np.mean(np.abs(file["entry/data/field"][k]) ** 2) for k in range(done)]
        assert min(powers) > 0
        assert np.isfinite(file["entry/steps/noise_level"][:done]).all()
    assert answer["verdicts"] == {"ok": done}


def test_a_bad_protocol_opens_no_instrument_in_a_process_of_its_own(folder, traced, protocol_file):
    bench, environment = traced
    protocol = protocol_file(**{"camera.frames": 3})
    before = listing(folder)
    process = started("run", protocol, "--bench", bench, "--out", "x.h5", env=environment)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (2, "")
    assert re.match(r".*small.yaml:\d+: camera.frames: 3 frames", one_line(err))
    assert listing(folder) == before


def test_standard_output_of_a_process_is_json_and_nothing_else(folder, bench_file, protocol_file):
    process = started(
        "run", protocol_file(), "--bench", bench_file(), "--out", "x.h5", "--json", "--no-fit",
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert json.loads(out) == {
        "run": "x.h5",
        "status": "complete",
        "reason": "",
        "unconfirmed": [],
        "remarks": [],
        "verdicts": {"ok": 9},
    }
    assert "9 of 9 steps" in err
