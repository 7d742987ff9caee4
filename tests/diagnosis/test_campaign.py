"""Runs of a campaign: put in order, and what is missing told."""

from types import SimpleNamespace

import pytest

from acquire.run_layout import Acquisition, Kind
from diagnosis.campaign import Campaign
from fitting.errors import FitInputError


def run(kind=Kind.SWEEP, second=0, part="", clamping=0, reed="R07", volts=16.0, clock_s=100.0):
    """Say what a run file says, without one."""
    step = SimpleNamespace(volts=volts, timestamps_s=(clock_s + second, clock_s + second + 0.1))
    return SimpleNamespace(
        reed=reed,
        series="A",
        start_time=f"2026-01-01T10:00:{second:02d}+00:00",
        acquisition=Acquisition(kind, "campaign", part, clamping),
        steps=(step,),
        path=SimpleNamespace(stem=part or "run", name=f"{part or 'run'}.h5"),
    )


def test_runs_stand_in_the_order_of_time_on_one_clock() -> None:
    campaign = Campaign.of(
        [run(second=40, part="down"), run(Kind.DARK, 5, "dark"), run(second=9, part="up")]
    )
    assert [part.name for part in campaign.parts] == ["dark", "up", "down"]
    assert [part.began_s for part in campaign.parts] == [0, 4, 35]
    # The camera's clock showed 105 when the campaign began.
    assert [part.clock_s for part in campaign.parts] == [105, 105, 105]
    assert [part.name for part in campaign.sweeps] == ["up", "down"]


def test_what_is_missing_is_told() -> None:
    alone = Campaign.of([run()]).missing
    assert len(alone) == 7
    kinds = [run(kind, k) for k, kind in enumerate(Kind) if kind is not Kind.SWEEP]
    sweeps = [run(second=20), run(second=30, volts=4.0), run(second=40, clamping=1)]
    assert Campaign.of([*kinds, *sweeps]).missing == []
    assert Campaign.of([*kinds, *sweeps[:2]]).missing == [
        "a sweep after a new clamping (what the clamp does)"
    ]


def test_parts_of_one_name_are_told_apart() -> None:
    sweeps = [run(second=9, part="up"), run(second=40, part="up"), run(second=20, part="down")]
    assert [part.name for part in Campaign.of(sweeps).sweeps] == ["up", "down", "up-2"]


def test_runs_of_two_reeds_are_refused() -> None:
    with pytest.raises(FitInputError, match=r"R07 \(A\), R08 \(A\)"):
        Campaign.of([run(), run(reed="R08")])


def test_a_campaign_needs_a_sweep() -> None:
    with pytest.raises(FitInputError, match=r"run\.h5: no run is a sweep"):
        Campaign.of([run(Kind.DARK)])
