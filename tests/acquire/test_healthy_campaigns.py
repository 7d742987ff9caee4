"""Campaigns of benches on which nothing is wrong, measured and diagnosed as users do it."""

import pytest

import acquire
from acquire.campaigns import load_campaign
from protocols.bench import BenchFile

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("disorder", [{}, {"seed": 5, "ordinary": True}], ids=["plain", "ordinary"])
def test_a_quick_campaign_of_a_healthy_bench_needs_no_effect(tmp_path, disorder):
    campaign = load_campaign("campaign").replace({"protocol": "quick"})
    bench = BenchFile.from_file().replace({"twin": {"disorder": disorder}})
    measured = acquire.run_campaign(campaign, tmp_path / "R07", bench, reed="R07", seed=1)
    assert measured.exit_status == 0
    found = acquire.diagnose(tmp_path / "R07")
    assert found.verdict.kind == "none"
    assert not found.verdict.refused
    assert found.probability["none"] > 0.5
