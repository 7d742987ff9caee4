"""Cases of the second laboratory: how they are drawn, and that recordings hide their label."""

import json
from collections import Counter

import h5py
import numpy as np
import pytest

import acquire
from acquire.campaigns import plan_campaign
from studies.second_laboratory.campaigns.case import Case, case_from_json, draw_case, setup_of
from studies.second_laboratory.campaigns.effects.catalogue import LISTED, UNLISTED
from studies.second_laboratory.campaigns.effects.light import LaserModeHop
from studies.second_laboratory.campaigns.recording import bench_file, campaign_file, record
from studies.second_laboratory.campaigns.truth import truth_of
from tests.studies.second_worlds import COARSE

# What no two run files share, and what follows from it.
OWN = {"entry/entry_identifier_uuid", "entry/header_checksum"}
PARTS = [
    {"name": "dark", "change": {"keep": "frames", "calibration": {"kind": "dark", "count": 1}}},
    {"name": "lo", "change": {"keep": "frames", "calibration": {"kind": "lo_only", "count": 1}}},
    {"name": "rest1", "change": {"keep": "frames", "calibration": {"kind": "order0", "count": 1}}},
    {"name": "up", "change": {"sweep.first": 60, "sweep.last": 63}},
    {"name": "again", "new_clamping": True, "change": {"sweep.first": 60, "sweep.last": 63}},
]


def short_campaign(series):
    shipped = campaign_file(series)
    always = {"camera.width": 128, "camera.height": 96}
    return shipped.replace(
        {"parts": [{**part, "change": {**part["change"], **always}} for part in PARTS]}
    )


def recorded(case, folder, repeat=0):
    made = record(case, folder, repeat, campaign=short_campaign(case.series), fineness=COARSE)
    assert [path.stem for path in made] == [part["name"] for part in PARTS]
    return folder


def contents(folder):
    """Return all numbers and texts of all run files but their own identifiers."""
    found = {}
    for path in sorted(folder.glob("*.h5")):
        with h5py.File(path) as file:

            def keep(name, node, part=path.stem):
                if isinstance(node, h5py.Dataset) and name not in OWN:
                    found[part, name] = np.asarray(node[()])

            file.visititems(keep)
    return found


def different(a, b):
    assert a.keys() == b.keys()
    # Of any type, NaN included.
    return {key for key in a if a[key].tobytes() != b[key].tobytes()}


@pytest.fixture(scope="module")
def clean():
    """A case whose camera has a dark pattern that four frames show: 1.9 e, with 6.5 e of noise."""
    return draw_case("clean", "ordinary", 5, 4)


@pytest.fixture(scope="module")
def campaign(clean, tmp_path_factory):
    return recorded(clean, tmp_path_factory.mktemp("clean"))


def test_labels_come_once_in_a_block_and_reeds_do_not_depend_on_them():
    singles = [draw_case("single", "ordinary", 3, number) for number in range(40)]
    assert Counter(case.effects[0].id for case in singles) == Counter(list(LISTED))
    unknown = [draw_case("unknown", "ordinary", 3, number) for number in range(15)]
    assert Counter(case.effects[0].id for case in unknown) == Counter(list(UNLISTED))
    pair = draw_case("pair", "ordinary", 3, 1)
    assert len({each.id for each in pair.effects}) == 2
    clean = draw_case("clean", "ordinary", 3, 1)
    assert setup_of(clean).bench == setup_of(pair).bench
    assert setup_of(clean).reed.cane.E_T == setup_of(pair).reed.cane.E_T
    assert {draw_case("clean", 1.0, 3, number).series for number in range(12)} == {"A", "B"}
    leaking = [draw_case("single", 1.0, 3, n, ["chamber_leakage"]) for n in range(12)]
    assert {case.series for case in leaking} == {"A"}
    with pytest.raises(ValueError, match="2 effects"):
        draw_case("pair", 1.0, 3, 1, ["density"])


def test_a_case_survives_its_key():
    for kind in ("clean", "single", "unknown", "pair"):
        case = draw_case(kind, "rough", 9, 4)
        assert case_from_json(json.loads(json.dumps(case.to_json()))) == case
        assert case.amount == 2.0


@pytest.mark.parametrize("sensor", ["small", "full"])
def test_campaigns_can_be_planned(sensor):
    planned = plan_campaign(campaign_file("B", sensor), bench_file())
    assert [len(plan.steps) for plan in planned.plans].count(184) == 5
    assert not any(plan.violations for plan in planned.plans)


def test_the_bench_file_says_nothing_of_the_case(campaign):
    text = bench_file().text
    assert "options: {}" in text
    # Only names of drivers show whose bench it is.
    assert text.count("second_laboratory") == 3
    assert contents(campaign)["up", "entry/provenance/bench"].item().decode() == text
    with acquire.open_run(campaign / "up.h5") as run:
        assert (run.reed, run.seed) == ("R1", 0)
    assert "clean" not in (campaign / "up.documents.jsonl").read_text("utf-8")


def test_a_label_of_size_0_leaves_no_trace(clean, campaign, tmp_path):
    effects = (LaserModeHop(0.0, 0.2),)
    labelled = Case("single", effects, clean.amount, clean.series, clean.seed, clean.number)
    other = recorded(labelled, tmp_path / "other")
    assert different(contents(campaign), contents(other)) == set()


def test_an_effect_shows_and_only_in_what_it_touches(clean, campaign, tmp_path):
    effects = (LaserModeHop(0.7, 0.0),)
    hop = Case("single", effects, clean.amount, clean.series, clean.seed, clean.number)
    changed = different(contents(campaign), contents(recorded(hop, tmp_path / "hop")))
    parts = {part for part, name in changed if name.startswith("entry/data/")}
    assert parts == {"rest1", "up", "again"}


@pytest.mark.slow
def test_another_clamping_and_another_day_differ(clean, campaign, tmp_path):
    with (
        acquire.open_run(campaign / "up.h5") as up,
        acquire.open_run(campaign / "again.h5") as again,
    ):
        fields = [np.stack([run.field(k) for k in range(4)]) for run in (up, again)]
        assert (up.acquisition.clamping, again.acquisition.clamping) == (0, 1)
    same = abs(np.vdot(*fields)) / np.linalg.norm(fields[0]) / np.linalg.norm(fields[1])
    assert same < 0.2
    other = recorded(clean, tmp_path / "day", repeat=1)
    first, second = contents(campaign), contents(other)
    assert second["up", "entry/start_time"].item() > first["up", "entry/start_time"].item()
    dark = [c["dark", "entry/data/frames"].astype(float).mean((0, 1)) for c in (first, second)]
    # The same camera: its pattern is there again, and its noise is not.
    assert 0.1 < np.corrcoef(dark[0].ravel(), dark[1].ravel())[0, 1] < 0.99
    assert dark[0].mean() == pytest.approx(dark[1].mean(), abs=1.0)


def test_truth_is_plain_and_complete():
    case = draw_case("pair", "ordinary", 5, 3, ["density", "tip_mass"])
    truth = json.loads(json.dumps(truth_of(case, fineness=COARSE)))
    assert [each["id"] for each in truth["effects"]] == ["density", "tip_mass"]
    assert truth["effects"][0]["sizes"]["relative"]["unit"] == "relative"
    assert truth["disorder"]["bench"]["sensor"]["offset_dn"] != 60.0
    clean = truth_of(draw_case("clean", "ordinary", 5, 3), fineness=COARSE)
    assert truth["modes"]["F1"]["hz"] != pytest.approx(clean["modes"]["F1"]["hz"], rel=1e-4)
    assert truth["disorder"] == json.loads(json.dumps(clean["disorder"]))


@pytest.mark.slow
def test_a_whole_campaign_takes_a_quarter_of_an_hour(tmp_path):
    case = draw_case("clean", "rough", 5, 2)
    record(case, tmp_path, fineness=COARSE)
    good = []
    for part in ("up", "down", "shuffled", "again"):
        with acquire.open_run(tmp_path / f"{part}.h5") as run:
            assert run.status == "complete"
            good.append(np.mean([str(step.verdict) == "ok" for step in run.steps]))
    assert np.mean(good) > 0.9
    ends = contents(tmp_path)
    minutes = [ends[p, "entry/end_time"].item().decode()[11:16] for p in ("dark", "rest3")]
    passed = [int(m[:2]) * 60 + int(m[3:]) for m in minutes]
    assert 11 < passed[1] - passed[0] < 22
