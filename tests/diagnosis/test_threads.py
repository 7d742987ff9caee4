"""Linear algebra of small matrices: threads of its own would make a diagnosis ten times as long."""

from types import SimpleNamespace

import pytest

from diagnosis import campaign_diagnosis, observe
from diagnosis.readings import campaign_readings
from tests.threads import ReachedError, count_of_threads, count_threads, two_threads


@pytest.fixture(autouse=True)
def threads():
    with two_threads():
        yield


def test_effects_are_tried_on_one_thread(monkeypatch):
    monkeypatch.setattr(campaign_diagnosis, "starts_without_effects", count_threads)
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
