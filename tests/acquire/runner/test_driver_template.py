"""The template of drivers measures, and drivers are called in the order that its page states."""

import importlib
import threading
from pathlib import Path

import numpy as np
import pytest

import acquire
from acquire.bench.check import check_bench
from acquire.bench.shot import shot_plan
from acquire.runner.orders import Orders
from drivers.errors import InstrumentError
from protocols.bench import BenchFile
from protocols.campaign import CampaignFile
from runs.reader import Run

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
SMALL = {"camera.width": 160, "camera.height": 128}
SHORT = {**SMALL, "sweep.first": 14, "sweep.last": 18, "policy.bad_step.retries": 0}
STILL = {**SMALL, "keep": "frames"}
# Calls that change something; the others only ask.
WATCHED = {
    "synthesizers.MySynthesizers": ("set_pair", "rf_on", "rf_off", "close"),
    "generator.MyGenerator": ("set_sine", "ramp_to", "output_off", "close"),
    "camera.MyCamera": ("configure", "start", "stop", "grab", "close"),
    "pretended.PretendedLaboratory": ("arrange", "clamp_again"),
}
BEGIN = ["output_off", "configure", "rf_on", "start"]
END = ["ramp_to", "output_off", "rf_off", "stop"]
FIRST, NEXT = ["set_pair", "set_sine", "ramp_to", "grab"], ["set_pair", "set_sine", "grab"]
OPEN = ["clamp_again", "rf_off", "output_off"]
# The camera stops itself when it is closed.
CLOSE = ["close", "close", "close", "stop"]


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return BenchFile.from_file(EXAMPLES / "my-bench.yaml")


@pytest.fixture
def calls(bench, monkeypatch):
    """Names of all calls that change something, in order; and the threads of each name."""
    log, threads = [], {}

    def watched(owner, name):
        original = getattr(owner, name)

        def call(self, *arguments):
            log.append(name)
            threads.setdefault(name, set()).add(threading.current_thread().name)
            return original(self, *arguments)

        monkeypatch.setattr(owner, name, call)

    for place, names in WATCHED.items():
        module, _, owner = place.partition(".")
        for name in names:
            watched(getattr(importlib.import_module(f"my_bench.{module}"), owner), name)
    return log, threads


@pytest.fixture
def campaign(tmp_path):
    """A campaign with dark and flat frames, a sweep, and a sweep after a new clamping."""
    flat = {"kind": "flat", "count": 1, "exposures": ["20 ms", "40 ms"]}
    parts = [
        {"name": "dark", "change": {**STILL, "calibration": {"kind": "dark", "count": 1}}},
        {"name": "flat", "change": {**STILL, "calibration": flat}},
        {"name": "up", "change": SHORT},
        {"name": "again", "change": SHORT, "new_clamping": True},
    ]
    return CampaignFile.from_file("campaign").replace({"protocol": "quick", "parts": parts})


def frames_of(path):
    with Run.open(path) as run:
        return [float(np.mean(run.frames(k))) for k in range(len(run.steps))]


def test_a_short_sweep_of_the_template_is_good(bench, tmp_path):
    plan = acquire.plan(acquire.load("quick").replace(SHORT), bench)
    measured = acquire.run(plan, tmp_path / "run.h5", reed="R07")
    assert str(measured.status) == "complete"
    with Run.open(measured.path) as run:
        assert [step.verdict for step in run.steps] == ["ok"] * 3
        assert all(abs(step.lock_error_hz) < 0.1 for step in run.steps)
        assert all(step.signal_to_noise > 30 for step in run.steps)
        assert "pretended-port" in run.identities["synthesizers"]
        assert run.saturation_dn == 4050


def test_the_template_passes_the_check_of_a_bench(bench):
    report = check_bench(bench, shot_plan(bench), Orders(), lambda _: None)
    assert {finding.result for finding in report.findings} == {"pass"}
    assert report.shot.verdict == "ok"


def test_exchanged_modulators_are_named(bench, tmp_path, monkeypatch):
    """As after a wrong sign in a driver: the light turns backwards, by half the frame rate."""
    from my_bench.synthesizers import MySynthesizers

    def exchanged(self, aom1_hz, aom2_hz):
        self._laboratory.aom_hz = (aom2_hz, aom1_hz)

    def read_pair(self):
        return self._laboratory.aom_hz[::-1]

    monkeypatch.setattr(MySynthesizers, "set_pair", exchanged)
    monkeypatch.setattr(MySynthesizers, "read_pair", read_pair)
    plan = acquire.plan(acquire.load("quick").replace(SHORT), bench)
    with Run.open(acquire.run(plan, tmp_path / "run.h5").path) as run:
        assert {step.verdict for step in run.steps} == {"lock"}
        assert all(abs(step.lock_error_hz) == pytest.approx(6.2, abs=0.1) for step in run.steps)
        assert all("AOM1 and AOM2" in step.sentence for step in run.steps)


def test_drivers_are_called_in_the_stated_order(bench, calls, tmp_path):
    log, threads = calls
    plan = acquire.plan(acquire.load("quick").replace(SHORT), bench)
    acquire.run(plan, tmp_path / "run.h5")
    assert log == [*OPEN, "arrange", *BEGIN, *FIRST, *NEXT, *NEXT, *END, *CLOSE]
    # All is switched off on threads of its own, one for each instrument.
    assert len(threads["rf_off"] | threads["stop"] | threads["output_off"]) == 4
    assert len(threads["grab"] | threads["configure"] | threads["arrange"]) == 1


def test_parts_of_a_campaign_are_prepared_first(bench, calls, campaign, tmp_path):
    log, _ = calls
    folder = tmp_path / "campaign"
    acquire.run_campaign(campaign, folder, bench)
    # RF is on for dark and flat frames, and the output of the generator stays off.
    still = ["set_pair", "grab"]
    flat = ["arrange", *BEGIN, *still, "stop", "configure", "start", *still, *END]
    sweep = ["arrange", *BEGIN, *FIRST, *NEXT, *NEXT, *END]
    dark = ["arrange", *BEGIN, *still, *END]
    assert log == [*OPEN, *dark, *flat, *sweep, "clamp_again", *sweep, *CLOSE]
    (dark_dn,), flat_dn = frames_of(folder / "dark.h5"), frames_of(folder / "flat.h5")
    assert dark_dn == pytest.approx(50, abs=1)
    assert (flat_dn[1] - 50) / (flat_dn[0] - 50) == pytest.approx(2, rel=0.01)


def test_a_resumed_campaign_prepares_complete_parts_again(bench, calls, campaign, tmp_path):
    log, _ = calls
    folder = tmp_path / "campaign"
    acquire.run_campaign(campaign, folder, bench)
    for name in ("again.h5", "again.documents.jsonl"):
        (folder / name).unlink()
    log.clear()
    acquire.resume_campaign(campaign, folder, bench)
    complete = ["arrange"] * 3
    sweep = [*BEGIN, *FIRST, *NEXT, *NEXT, *END]
    assert log == [*OPEN, *complete, "clamp_again", "arrange", *sweep, *CLOSE]


def test_shutters_that_fail_end_a_campaign_that_can_be_resumed(
    bench, calls, campaign, tmp_path, monkeypatch
):
    from my_bench.pretended import PretendedLaboratory

    log, _ = calls
    folder, original = tmp_path / "campaign", PretendedLaboratory.arrange

    def stuck(self, arrangement):
        if arrangement == "flat":
            raise InstrumentError("shutter: does not move; look whether something blocks it")
        original(self, arrangement)

    with monkeypatch.context() as broken:
        broken.setattr(PretendedLaboratory, "arrange", stuck)
        with pytest.raises(InstrumentError, match="does not move"):
            acquire.run_campaign(campaign, folder, bench)
    # All is off since the end of the part before.
    assert log[-len([*END, *CLOSE]) :] == [*END, *CLOSE]
    assert [path.name for path in folder.glob("*.h5")] == ["dark.h5"]
    resumed = acquire.resume_campaign(campaign, folder, bench)
    assert [part.path.stem for part in resumed.parts] == ["flat", "up", "again"]
