"""Benches with nothing wrong, diagnosed without parts of the errors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import (
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    observable_group,
)
from holography.fresnel import FresnelTransform
from holography.reconstruction import Reconstruction
from holography.region import Region
from physics.parameters.tree import BenchParameters
from studies.sealed import ablation
from studies.sealed.ablation import (
    ABLATIONS,
    WHOLE,
    Ablation,
    Verdict,
    _side_lobes,
    line,
    verdicts,
)
from studies.sealed.disorder_curve import CleanBench
from tests.diagnosis.toy import LEVEL

COUNT = 12
LAMP = GroupNuisances("lamp", np.full((COUNT, 1), 3.0), 0.7, "toy")
BEAM = GroupNuisances("beam", np.eye(COUNT)[:, :1], 0.7, "toy")
TILT = replace(LEVEL, name="tilt", family="reed")


def predict(parameters):
    return np.full(COUNT, parameters.optics.interference.fade_per_h)


@pytest.fixture
def problem():
    places = [Coordinates("hz", mode=f"F{n}") for n in range(COUNT)]
    many, dark = (
        observable_group(
            name, Observable.MODES, np.zeros(COUNT), Errors(np.ones(COUNT), nuisances), places,
            ("optics",), predict,
        )
        for name, nuisances in (("modes", (LAMP, BEAM)), ("dark frames", ()))
    )  # fmt: skip
    return InferenceProblem([many, dark], BenchParameters(), (LEVEL, TILT))


def test_what_is_left_out_is_in_no_error(problem):
    found = Ablation("no lamp", nuisances=frozenset({"lamp", "reed"})).of(problem)
    assert [each.name for each in found.groups[0].errors.nuisances] == ["beam"]
    assert found.groups[0].covariance == pytest.approx(np.eye(COUNT) + np.diag([1.0] + 11 * [0.0]))
    assert [each.name for each in found.nuisances] == ["level"]
    assert problem.groups[0].covariance[0, 1] == 9.0
    found = Ablation("no level", nuisances=frozenset({"level"})).of(problem)
    assert [each.name for each in found.nuisances] == ["tilt"]


def test_observables_are_left_out_by_their_group(problem):
    found = Ablation("no dark frames", groups=frozenset({"dark frames"})).of(problem)
    assert [each.name for each in found.groups] == ["modes"]


def test_known_errors_have_no_freedom(problem):
    before, found = problem.groups[0].errors, Ablation("known", certain=True).of(problem)
    now = found.groups[0].errors
    assert now.noise_freedom < 0.1 * before.noise_freedom
    assert {each.freedom for each in now.nuisances} == {now.noise_freedom}
    assert found.groups[0].covariance == pytest.approx(problem.groups[0].covariance)


def test_nothing_is_left_out_of_the_whole(problem):
    found = WHOLE.of(problem)
    assert [each.name for each in found.groups] == ["modes", "dark frames"]
    assert found.groups[0].errors == problem.groups[0].errors
    assert found.nuisances == problem.nuisances


def test_what_a_campaign_does_not_have_cannot_be_left_out(problem):
    with pytest.raises(LookupError, match="lmap"):
        Ablation("misspelt", nuisances=frozenset({"lmap", "beam"})).of(problem)


def test_each_ablation_is_of_the_campaign_that_it_needs(problem, tmp_path, monkeypatch):
    """Without a window, the bench is recorded again: noise is measured as it is recorded."""
    recorded, judged = [], []

    def records(bench, campaigns):
        recorded.append((campaigns.name, Reconstruction.only_noise is windowed))
        return campaigns / bench.name

    def judge(asked, _summary):
        judged.append([each.name for each in asked.groups[0].errors.nuisances])
        none = {"none": 0.9, "crack": 0.1}
        return SimpleNamespace(kind="none", effects=(), probability_of_what_shows=none)

    windowed, bare = Reconstruction.only_noise, Ablation("no", nuisances=frozenset({"beam"}))
    lobed = Ablation("no lamp", nuisances=frozenset({"lamp"})).of(problem)
    monkeypatch.setattr(CleanBench, "recorded_in", records)
    monkeypatch.setattr(
        ablation, "_problem", lambda path: problem if path.parent.name == "campaigns" else lobed
    )
    monkeypatch.setattr(ablation, "diagnose_problem", judge)
    asked = WHOLE, Ablation("no window", with_lobes=True), bare
    found = verdicts(CleanBench(1.0, 2), tmp_path, asked)
    assert recorded == [("campaigns", True), ("with side lobes", False)]
    assert judged == [["lamp", "beam"], ["beam"], ["lamp"]]
    assert found == [Verdict("none", (), 0.9)] * 3


def test_without_a_window_noise_has_the_light_of_side_lobes():
    plan = Reconstruction(
        FresnelTransform((256, 320), 6.7e-6, 650e-9, 1.0), Region(160, 80, 60, 160)
    )
    y, x = np.indices((256, 320))
    # Light between two pixels of the reed's image.
    image = np.exp(2j * np.pi * (0.1234 * x + 0.2345 * y)).astype(np.complex64)
    within, pixels = plan.only_noise(image), plan.independent_noise
    with _side_lobes():
        lobed = plan.only_noise(image)
        assert plan.independent_noise == plan.empty.height * plan.empty.width > pixels
    assert lobed.shape == within.shape
    assert np.array_equal(plan.only_noise(image), within)
    assert plan.independent_noise == pixels


def test_a_line_counts_what_was_named():
    said = [
        Verdict("none", (), 0.9),
        Verdict("effect", ("crack",), 0.1),
        Verdict("unknown", (), 0.2),
    ]
    found = line(WHOLE, said)
    assert "2 of 3 false alarms" in found
    assert "0.40 (none, crack, unknown)" in found


def test_names_are_different():
    assert len({each.name for each in ABLATIONS}) == len(ABLATIONS)
