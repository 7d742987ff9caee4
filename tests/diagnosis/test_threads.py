"""Linear algebra of small matrices: threads of its own would make a diagnosis ten times as long."""

from types import SimpleNamespace

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from diagnosis import campaign_diagnosis, observe
from diagnosis.readings import campaign_readings


class ReachedError(Exception):
    """Where threads were counted."""


def count_threads(*_args, **_kwargs):
    raise ReachedError(count_of_threads())


@pytest.fixture(autouse=True)
def two_threads():
    """Whatever the machine and its environment say."""
    with threadpool_limits(limits=2, user_api="blas"):
        if count_of_threads() < 2:
            pytest.skip("linear algebra has but one thread on this machine")
        yield


def count_of_threads():
    return max(p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas")


def test_effects_are_tried_on_one_thread(monkeypatch):
    monkeypatch.setattr(campaign_diagnosis, "select_model", count_threads)
    with pytest.raises(ReachedError) as reached:
        campaign_diagnosis.diagnose_problem(SimpleNamespace(), campaign_diagnosis.CampaignSummary())
    assert reached.value.args == (1,)
    assert count_of_threads() == 2


def test_campaigns_are_read_on_one_thread(monkeypatch):
    monkeypatch.setattr(campaign_readings, "parameters_of", count_threads)
    campaign = SimpleNamespace(sweeps=[SimpleNamespace(run=None)], of_kind=lambda _kind: [])
    with pytest.raises(ReachedError) as reached:
        observe.read(campaign)
    assert reached.value.args == (1,)
