"""Runs of a campaign: put in order, and what is missing is reported."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from diagnosis.campaign import Campaign
from fitting.errors import FitInputError
from runs.layout import RunKind, RunPurpose
from runs.verdict import Verdict


def run(kind=RunKind.SWEEP, second=0, part="", clamping=0, volts=16.0, clock_s=100.0, **changed):
    """Say what a run file says, without one."""
    step = SimpleNamespace(
        volts=volts, timestamps_s=(clock_s + second, clock_s + second + 0.1), verdict=Verdict.OK,
        lock_error_se_hz=1e-3,
    )  # fmt: skip
    transform = SimpleNamespace(wavelength_m=532e-9, distance_m=0.8)
    fields = {
        "uid": "",
        "reed": "R07",
        "series": "A",
        "reed_sha256": "ab" * 32,
        "chamber": "asymmetric",
        "start_time": f"2026-01-01T10:00:{second:02d}+00:00",
        "acquisition": RunPurpose(kind, "campaign" if part else "", part, clamping),
        "steps": (step,),
        "path": Path(f"{part or 'run'}.h5"),
        "reconstruction": SimpleNamespace(transform=transform),
        "frame_shape": (1024, 1280),
        "frame_rate_hz": 12.4,
        "exposure_of": lambda _step: 0.08,
    }
    return SimpleNamespace(**fields | changed)


def test_runs_are_in_the_order_of_time_on_one_clock() -> None:
    campaign = Campaign.of(
        [run(second=40, part="down"), run(RunKind.DARK, 5, "dark"), run(second=9, part="up")]
    )
    assert [part.name for part in campaign.parts] == ["dark", "up", "down"]
    assert [part.began_s for part in campaign.parts] == [0, 4, 35]
    # The camera's clock showed 105 when the campaign began.
    assert [part.clock_s for part in campaign.parts] == [105, 105, 105]
    assert [part.name for part in campaign.sweeps] == ["up", "down"]


def test_what_is_missing_is_reported() -> None:
    alone = Campaign.of([run()]).missing
    assert len(alone) == 7
    kinds = [run(kind, k) for k, kind in enumerate(RunKind) if kind is not RunKind.SWEEP]
    sweeps = [run(second=20), run(second=30, volts=4.0), run(second=40, clamping=1)]
    assert Campaign.of([*kinds, *sweeps]).missing == []
    assert Campaign.of([*kinds, *sweeps[:2]]).missing == [
        "a sweep after a new clamping (what the clamp does)"
    ]


def test_runs_of_one_name_are_distinguished() -> None:
    sweeps = [run(second=second, path=Path(f"{second}/up.h5")) for second in (9, 40)]
    assert [part.name for part in Campaign.of([*sweeps, run(second=20)]).sweeps] == [
        "up", "run", "up-2",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"reed": "R08"}, r"R07 \(A\), R08 \(A\); diagnose them one by one"),
        ({"series": "B"}, r"R07 \(A\), R07 \(B\)"),
        ({"frame_shape": (512, 640)}, "several sizes of frames: 1024 x 1280, 512 x 640"),
        ({"exposure_of": lambda _step: 0.04}, "40 ms at 12.4 Hz, 80 ms at 12.4 Hz"),
        ({"frame_rate_hz": 6.2}, "exposures or frame rates: 80 ms at 12.4 Hz, 80 ms at 6.2 Hz"),
        ({"reed_sha256": "cd" * 32}, "several kinds of reed: abababab, cdcdcdcd"),
        ({"chamber": "symmetric"}, "fillings of the chamber: asymmetric, symmetric"),
        (
            {"reconstruction": SimpleNamespace(transform=SimpleNamespace(
                wavelength_m=633e-9, distance_m=0.8))},
            "532 nm at 0.8 m, 633 nm at 0.8 m",
        ),
        ({}, "part up of campaign campaign is there 2 times; name the runs of one"),
    ],
)  # fmt: skip
def test_runs_that_do_not_belong_together_are_refused(changed, said) -> None:
    with pytest.raises(FitInputError, match=said):
        Campaign.of([run(part="up"), run(second=9, part="up", **changed)])


def test_runs_without_reed_and_campaign_may_be_among_others() -> None:
    alone = run(second=9, reed_sha256="", acquisition=RunPurpose())
    assert len(Campaign.of([run(part="up"), alone]).sweeps) == 2


def test_another_campaign_has_clampings_of_its_own() -> None:
    first = [run(second=9, part="up"), run(second=20, part="again", clamping=1)]
    acquisitions = [RunPurpose(RunKind.SWEEP, "next", part, k) for k, part in enumerate("ab")]
    later = [run(second=40 + k, acquisition=a) for k, a in enumerate(acquisitions)]
    campaign = Campaign.of([*later, *first])
    assert [part.clamping for part in campaign.parts] == [0, 1, 2, 3]


def test_a_run_that_is_named_twice_is_refused() -> None:
    with pytest.raises(FitInputError, match=r"a\.h5, b\.h5: are the same run; name it once"):
        Campaign.of([run(uid="1", path=Path("a.h5")), run(uid="1", path=Path("b.h5"))])


def test_times_are_read_with_and_without_their_zone() -> None:
    runs = [run(second=9), run(start_time="2026-01-01T10:00:07")]
    assert [part.began_s for part in Campaign.of(runs).parts] == [0, 2]
    with pytest.raises(FitInputError, match=r"run\.h5: start_time is '', which is no time; write"):
        Campaign.of([run(start_time="")])


def test_steps_that_were_not_taken_have_no_time() -> None:
    taken = run(second=9)
    skipped = SimpleNamespace(**vars(taken.steps[0]) | {"timestamps_s": (float("nan"),) * 2})
    taken.steps = (skipped, *taken.steps)
    assert Campaign.of([taken]).parts[0].clock_s == 109


def test_calibrations_in_which_nothing_was_measured_are_missing() -> None:
    dark = run(RunKind.DARK, 5, "dark")
    dark.steps[0].verdict = Verdict.SKIPPED
    campaign = Campaign.of([dark, run(second=9, part="up")])
    assert not campaign.of_kind(RunKind.DARK)
    assert any("dark frames" in lack for lack in campaign.missing)


def test_locks_that_were_not_measured_are_missing() -> None:
    sweep = run()
    sweep.steps[0].lock_error_se_hz = float("nan")
    assert any("lock errors" in lack for lack in Campaign.of([sweep]).missing)


def test_a_campaign_needs_a_sweep() -> None:
    with pytest.raises(FitInputError, match=r"run\.h5: no run is a sweep"):
        Campaign.of([run(RunKind.DARK)])
