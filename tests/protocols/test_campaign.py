"""Campaigns: parts with changes, what is taken of a reed at rest, and in which order."""

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import h5py
import numpy as np
import pytest

from acquire import Callbacks, run_campaign
from drivers.context import BenchContext
from drivers.registry import open_bench
from drivers.simulated import SimulatedCamera, SimulatedGenerator
from protocols.bench import BenchFile
from protocols.campaign import (
    CampaignFile,
    names_campaign,
    tasks_of,
)
from protocols.errors import ProtocolError
from protocols.plan import make_plan
from protocols.protocol import Protocol, shipped_protocols
from runs.layout import RunKind
from runs.reader import Run

BENCH = BenchFile.from_file()
# A camera of few pixels, a coarse reed, and sweeps of few steps.
SMALL = BENCH.replace({"twin": {"mesh": "coarse"}})
QUICK = {"camera.width": 192, "camera.height": 192, "sweep.last": 16, "sweep.first": 12}


def described(parts: str) -> CampaignFile:
    return CampaignFile.from_text(f"name: Test\nprotocol: seriesA\nparts:\n{parts}", "c.yaml")


def test_the_shipped_campaign_has_what_a_diagnosis_needs() -> None:
    tasks = tasks_of(CampaignFile.from_file("campaign"))
    kinds = [t.protocol.calibration.kind for t in tasks if t.protocol.calibration]
    assert set(kinds) == set(RunKind) - {RunKind.SWEEP}
    sweeps = [task.protocol for task in tasks if task.protocol.calibration is None]
    assert {sweep.sweep.direction for sweep in sweeps} == {"up", "down", "shuffled"}
    assert len({sweep.drive.to_v for sweep in sweeps}) == 2
    assert tasks[-1].clamping == 1
    assert all(not make_plan(task.protocol, BENCH).violations for task in tasks)


def test_campaigns_are_distinguished_from_protocols() -> None:
    assert names_campaign("campaign")
    assert not names_campaign("seriesA")
    assert "campaign" not in shipped_protocols()
    assert "seriesA" in shipped_protocols()


def test_directions_take_the_same_steps_in_another_order() -> None:
    plans = {
        direction: make_plan(Protocol.from_file("seriesA").replace({"sweep.direction": direction}),
                             BENCH)
        for direction in ("up", "down", "shuffled")
    }  # fmt: skip
    assert plans["up"].sequence == tuple(range(184))
    assert plans["down"].sequence == tuple(range(184))[::-1]
    assert sorted(plans["shuffled"].sequence) == list(range(184))
    apart = [b - a for a, b in pairwise(plans["shuffled"].sequence)]
    assert sum(abs(step) for step in apart) / len(apart) > 40
    assert {plan.steps for plan in plans.values()} == {plans["up"].steps}


def test_a_reed_at_rest_is_taken_at_each_exposure() -> None:
    asked = {"kind": "flat", "count": 2, "exposures": ["20 ms", "40 ms"]}
    protocol = Protocol.from_file("seriesA").replace({"keep": "frames", "calibration": asked})
    plan = make_plan(protocol, BENCH)
    assert [step.exposure_s for step in plan.steps] == [Fraction(1, 50)] * 2 + [Fraction(1, 25)] * 2
    assert {(step.volts, step.order, step.drive_hz) for step in plan.steps} == {(0.0, 0, 0)}
    assert plan.violations == ()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"calibration": {"kind": "dark"}}, "needs the frames themselves; write keep: frames"),
        ({"keep": "frames", "calibration": {"kind": "dusk"}}, "calibration.kind"),
        ({"sweep.direction": "sideways"}, "sweep.direction"),
    ],
)
def test_what_is_wrong_with_a_part_is_named(changes: dict, said: str) -> None:
    with pytest.raises(ProtocolError, match=said):
        Protocol.from_file("seriesA").replace(changes)


def test_an_exposure_longer_than_a_frame_is_a_violation() -> None:
    asked = {"kind": "flat", "exposures": ["20 ms", "90 ms"]}
    protocol = Protocol.from_file("seriesA").replace({"keep": "frames", "calibration": asked})
    (found,) = make_plan(protocol, BENCH).violations
    assert found.key == "calibration.exposures"


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ("{name: up, chnge: {}}", r"parts\[0\]\.chnge: unknown key; did you mean 'change'"),
        ("3", r"parts\[0\]: 3 is no mapping; give name, change, do"),
        ("{name: up, change: 3}", r"parts\[0\]\.change"),
        ("{name: up, change: {a: [1, {b: 2}]}}", r"c\.yaml:4: parts\[0\]\.change: .* a: unknown"),
        ("{name: up, change: {sweep.lst: 3}}", r"c\.yaml:4: parts\[0\]\.change: .*mean 'last'"),
        ("{name: up, change: {sweep.last: x}}", r"c\.yaml:4: parts\[0\]\.change: .*sweep\.last"),
        ("{name: up, change: {keep.all: true}}", r"parts\[0\]\.change: .*no key 'all' below"),
    ],
)
def test_what_is_wrong_with_a_part_names_the_campaign_and_the_part(part: str, said: str) -> None:
    with pytest.raises(ProtocolError, match=said):
        tasks_of(described(f"  - {part}\n"))


@pytest.mark.parametrize("name", ["seriesZ", "é" * 250])
def test_a_campaign_without_its_protocol_says_so(name: str) -> None:
    text = f"name: Test\nprotocol: {name}\nparts: [{{name: up}}]\n"
    with pytest.raises(ProtocolError, match=r"^c\.yaml:2: protocol: "):
        tasks_of(CampaignFile.from_text(text, "c.yaml"))


def test_parts_need_names_of_their_own() -> None:
    with pytest.raises(ProtocolError, match="has up twice"):
        described("  - name: up\n  - name: up\n")


def test_a_campaign_leaves_a_run_of_each_part(tmp_path) -> None:
    quick = described("  - name: up\n").replace(
        {
            "parts": [
                {"name": "dark", "do": "cover the camera", "change": {
                    **QUICK, "keep": "frames", "calibration": {"kind": "dark", "count": 2}}},
                {"name": "lo", "change": {**QUICK, "keep": "frames", "calibration": {
                    "kind": "lo_only", "count": 1, "exposures": ["20 ms", "40 ms"]}}},
                {"name": "rest", "change": {**QUICK, "keep": "frames",
                                            "calibration": {"kind": "order0", "count": 1}}},
                {"name": "down", "change": {**QUICK, "sweep.direction": "down"}},
                {"name": "again", "new_clamping": True, "change": QUICK},
            ]
        }
    )  # fmt: skip
    asked: list[str] = []
    run_campaign(
        quick, tmp_path / "R07", SMALL, reed="R07", callbacks=Callbacks(wait_for=asked.append)
    )
    assert asked == [], "the simulated bench arranges itself"
    runs = {path.stem: Run.open(path) for path in (tmp_path / "R07").glob("*.h5")}
    assert {name: run.acquisition.kind for name, run in runs.items()} == {
        "dark": RunKind.DARK, "lo": RunKind.LO_ONLY, "rest": RunKind.ORDER0, "down": RunKind.SWEEP,
        "again": RunKind.SWEEP,
    }  # fmt: skip
    assert {run.acquisition.campaign for run in runs.values()} == {"R07"}
    assert [runs[name].acquisition.clamping for name in ("rest", "down", "again")] == [0, 0, 1]
    dark, bright = runs["dark"].frames(0).mean(), runs["lo"].frames(1).mean()
    assert dark == pytest.approx(50, abs=1)
    assert bright > 3 * dark
    assert [runs["lo"].exposure_of(step) for step in runs["lo"].steps] == [0.02, 0.04]
    times = [step.timestamps_s[0] for step in runs["down"].steps]
    assert times == sorted(times, reverse=True)
    # Another speckle after the reed was clamped again.
    one, other = (runs[name].field(0).ravel() for name in ("down", "again"))
    assert abs(np.vdot(one, other)) < 0.5 * np.linalg.norm(one) * np.linalg.norm(other)
    for run in runs.values():
        assert run.good.all()
        run.close()
    with h5py.File(tmp_path / "R07" / "dark.h5") as file:
        assert file["entry/acquisition/part"][()] == b"dark"


def test_a_person_is_asked_where_no_program_can_do_it(tmp_path, monkeypatch) -> None:
    def by_hand(*asked, **more):
        return replace(open_bench(*asked, **more), surroundings=None)

    monkeypatch.setattr("acquire.runner.run_session.open_bench", by_hand)
    dark = {**QUICK, "keep": "frames", "calibration": {"kind": "dark", "count": 1}}
    parts = [{"name": "dark", "do": "cover the camera", "change": dark}]
    asked: list[str] = []
    campaign = described("  - name: up\n").replace({"parts": parts})
    run_campaign(campaign, tmp_path / "R07", SMALL, callbacks=Callbacks(wait_for=asked.append))
    assert asked == ["cover the camera"]


def test_only_a_simulated_camera_has_simulated_surroundings() -> None:
    # A real camera with simulated instruments sees real light: a person works the shutters.
    entries = SMALL.instruments
    preparation = make_plan(Protocol.from_file("seriesA"), SMALL).preparation("R07")
    context = BenchContext(SMALL, preparation, np.random.default_rng(0), lambda _: None)
    SimulatedGenerator(entries.generator, context)
    assert context.surroundings is None
    SimulatedCamera(entries.camera, context)
    assert context.surroundings is not None


def test_a_campaign_is_never_written_over(tmp_path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "notes.txt").write_text("precious")
    with pytest.raises(Exception, match="exists already; choose another folder"):
        run_campaign(described("  - name: up\n"), tmp_path / "there", SMALL)


@pytest.mark.parametrize("first", [True, False])
def test_a_setting_that_a_part_changes_twice_is_refused(first) -> None:
    whole = "sweep: {law: geometric, reference: 1396.9 Hz, interval: 25 cents, first: 1, last: 9}"
    both = ["sweep.stride: 40", whole] if first else [whole, "sweep.stride: 40"]
    text = "  - name: quiet\n    change:\n" + "".join(f"      {line}\n" for line in both)
    with pytest.raises(ProtocolError, match=r"parts\[0\]\.change: sweep\.stride is given twice"):
        tasks_of(described(text))
