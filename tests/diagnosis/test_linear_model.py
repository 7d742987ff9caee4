"""Evidence of linear models with scales, and of effects scanned over their strength."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from diagnosis.inference.candidates import without_effects
from diagnosis.inference.effect_scan import Start, _log_integral, scan_effect
from diagnosis.inference.linear_model import KNOWN, LinearModel, Scales, weigh, weighed_at
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Coordinates, Observable, observable_group
from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage
from physics.parameters.tree import BenchParameters, with_part
from tests.diagnosis.toy import EFFECTS, LEVEL, bench, measured

N, Q = 60, 20


def drawn(seed, families=(1.0, 1.0), noise=(1.0, 1.0, 1.0), rare=False):
    rng = np.random.default_rng(seed)
    slopes = rng.standard_normal((N, Q))
    family, group = np.repeat([0, 1], Q // 2), np.repeat([0, 1, 2], N // 3)
    left = slopes @ (np.array(families)[family] * rng.standard_normal(Q))
    left = left + np.array(noise)[group] * rng.standard_normal(N)
    # Of four families the last two, the form of effects, have no columns here.
    freedoms = np.full(3, 0.5), np.full(4, 0.7)
    which = np.array([False, rare, False, False])
    return LinearModel(left, slopes, group, family, *freedoms, which, np.zeros(N))


def test_evidence_is_that_of_a_gaussian() -> None:
    form = np.linspace(0, 2, N)
    model = drawn(1).with_form(np.cos(np.arange(N))[:, None], form).with_columns(np.ones((N, 1)))
    assert list(model.family[-2:]) == [2, KNOWN]
    scales = Scales(np.array([0.0, 0.3, 0.1]), np.array([0.5, -0.4, 0.9, 0.6]))
    found = weighed_at(model, scales)
    prior = np.append(np.exp(2 * scales.families)[model.family[:-1]], 1.0)
    covariance = np.diag(np.exp(2 * scales.noise)[model.group] + np.exp(1.2) * form)
    covariance += (model.slopes * prior) @ model.slopes.T
    likelihood = multivariate_normal(np.zeros(N), covariance).logpdf(model.left)
    unusual = np.sum((scales.noise / 0.5) ** 2) + np.sum((scales.families / 0.7) ** 2)
    expected = likelihood + 0.5 * N * np.log(2 * np.pi) - 0.5 * unusual
    assert found.log_evidence == pytest.approx(expected)
    np.testing.assert_allclose(found.precision, np.linalg.inv(covariance), atol=1e-10)


@pytest.mark.parametrize("truth", [((1, 1), (1, 1, 1)), ((4, 0.5), (1, 2, 1))])
def test_scales_are_the_likeliest(truth) -> None:
    model = drawn(2, *truth).with_form(np.cos(np.arange(N))[:, None], np.linspace(0, 20, N))
    found = weigh(model)
    assert np.all(found.scales.noise >= 0)

    def cost(x):
        # The form has limits, two standard deviations of its logs.
        families = np.append(x[3:5], np.clip(x[5:7], -1.4, 1.4))
        return -weighed_at(model, Scales(np.maximum(x[:3], 0), families)).log_evidence

    start = np.concatenate([found.scales.noise, found.scales.families])
    options = {"fatol": 1e-6, "maxiter": 6000, "maxfev": 6000}
    best = minimize(cost, start, method="Nelder-Mead", options=options)
    there = weighed_at(model, found.scales)
    assert there.log_evidence == pytest.approx(-best.fun, abs=0.01)


@pytest.mark.parametrize(
    ("families", "rare"), [((3, 0.5), False), ((3, 0.5), True), ((3, 2), True)]
)
@pytest.mark.parametrize("noise", [(1, 1, 1), (1, 2, 1), (0.7, 4, 1)])
def test_evidence_is_that_of_all_scales(noise, families, rare) -> None:
    """Against importance sampling; noise, and what is rare, are never less than 1."""
    model = drawn(3, families, noise, rare)
    found = weigh(model)
    centre = np.concatenate([found.scales.noise, found.scales.families[:2]])
    around = multivariate_normal(centre, 0.3**2 * np.eye(5))
    drawn_at = around.rvs(8000, random_state=4)
    least = np.array([0, 0, 0, -np.inf, 0 if rare else -np.inf])
    logs = np.array([weighed_at(model, Scales(x[:3], np.append(x[3:], [0, 0]))).log_evidence
                     if np.all(x >= least) else -np.inf for x in drawn_at])  # fmt: skip
    # Densities of the prior: of a whole Gaussian for disorder, of half a one for noise and what is
    # rare.
    density = 3 * np.log(2 / 0.5) + 2 * np.log(1 / 0.7) - 2.5 * np.log(2 * np.pi)
    density += np.log(2) if rare else 0.0
    mean = logsumexp(logs - around.logpdf(drawn_at)) - np.log(len(logs)) + density
    assert found.log_evidence == pytest.approx(mean, abs=0.4)
    # That of the likeliest scales alone is nats more.
    assert weighed_at(model, found.scales).log_evidence > mean + 3


def test_larger_disorder_is_found_as_such() -> None:
    found = [weigh(drawn(seed, (4, 0.5), (1, 2, 1))).scales for seed in range(20)]
    noise = np.exp(np.mean([each.noise for each in found], axis=0))
    families = np.exp(np.mean([each.families for each in found], axis=0))
    np.testing.assert_allclose(noise, [1, 1.75, 1], atol=0.12)
    # A prior within a factor of two draws each a little towards 1.
    assert 3 < families[0] < 4
    assert 0.4 < families[1] < 0.6


def test_what_nuisances_absorb_is_left_out() -> None:
    model = drawn(3)
    along = model.slopes @ np.linspace(-1, 1, Q)
    left = model.not_absorbed(along, model.usual)
    assert np.linalg.norm(left) < 0.1 * np.linalg.norm(along)
    across = np.linalg.svd(model.slopes)[0][:, -1]
    np.testing.assert_allclose(model.not_absorbed(across, model.usual), across, atol=1e-9)


@pytest.mark.parametrize(("truth", "expected"), [(0.5, 0.5), (1.0, 1.0), (3.0, 3.0), (9.0, 4.06)])
def test_how_far_forms_deviate_is_found(truth: float, expected: float) -> None:
    """Of effects that move every number by thirty standard deviations of the noise.

    It ends at two standard deviations of the log of the factor.
    """
    rng, seen = np.random.default_rng(5), np.full(N, 30.0)
    found = []
    for seed in range(20):
        off = truth * 0.15 * seen * rng.standard_normal(N)
        model = drawn(seed).moved(off).with_form(np.zeros((N, 0)), (0.15 * seen) ** 2)
        found.append(weigh(model).scales.families[-1])
    assert np.exp(np.mean(found)) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("truth", [0.3, 1.0, 3.0])
def test_how_far_numbers_deviate_together_is_found_apart(truth: float) -> None:
    """Twelve times five numbers deviate together, and no number by itself: the limit is 0.25."""
    rng, seen, own = np.random.default_rng(5), 30.0, np.kron(np.eye(12), np.ones((5, 1)))
    found = []
    for seed in range(20):
        off = own @ (truth * 0.15 * seen * rng.standard_normal(12))
        formed = drawn(seed).moved(off).with_form(0.15 * seen * own, np.full(N, (0.15 * seen) ** 2))
        found.append(np.exp(weigh(formed).scales.families[-2:]))
    together, by_itself = np.median(found, axis=0)
    assert together == pytest.approx(truth, rel=0.2)
    assert by_itself == pytest.approx(np.exp(-1.4), rel=0.05)


def test_a_form_that_no_number_shows_is_as_expected() -> None:
    model = drawn(6).with_form(np.full((N, 1), 1e-3), np.full(N, 1e-6))
    assert weigh(model).scales.form == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("leak", [0.0, 0.02, 0.1, 0.4])
def test_a_scan_is_the_integral_over_all_strengths(leak: float) -> None:
    """Of an effect that is straight: an integral that can be computed strength by strength.

    At 0.4 the peak is narrower than the steps of the scan.
    """
    problem = measured(3, bench(fade_per_h=-0.7, leak=leak))
    null = without_effects(problem, [np.zeros(1)])
    start = Start.without(problem, null.estimate)
    usual = weighed_at(start.model, start.model.usual)
    start = Start(start.parameters, start.residuals, start.model, usual, start.sizes, usual)
    scan = scan_effect(problem, start, EFFECTS[0])
    (size,) = EFFECTS[0].sizes
    unit = problem.residuals(EFFECTS[0].change(start.parameters, {"size": 1.0}))
    unit = problem.to_noise(unit - start.residuals)
    shares = np.geomspace(0.01, 1, 50_001)
    logs = []
    for sign in (-1, 1):
        moved = sign * size.most * shares
        pull, known = usual.precision @ start.model.left @ unit, unit @ usual.precision @ unit
        logs += list(-moved * pull - 0.5 * moved**2 * known)
    together = float(logsumexp(logs)) - np.log(len(logs))
    # The form of the effect is fitted at the best strength; without it the scan is the integral.
    free = scan.weighed.log_evidence - usual.log_evidence
    straight = -scan.sizes[0] * size.scale * pull - 0.5 * (scan.sizes[0] * size.scale) ** 2 * known
    expected = together + free - straight
    assert scan.log_evidence - usual.log_evidence == pytest.approx(expected, abs=0.05)


def test_an_effect_shows_however_far_its_form_deviates() -> None:
    """With a form that deviates by thirty times what the effect does, nothing would show."""
    problem = measured(3, bench(leak=0.4))
    plain = Start.without(problem, without_effects(problem, [np.zeros(1)]).estimate)
    unit = problem.residuals(EFFECTS[0].change(plain.parameters, {"size": 200 / 0.18}))
    model = problem.with_form(plain.model, problem.to_noise(unit - plain.residuals))
    start = replace(plain, model=model, weighed=weighed_at(model, model.usual))
    scan = scan_effect(problem, start, EFFECTS[0])
    assert np.isfinite(scan.log_evidence)


def test_an_effect_that_changes_nothing_has_no_scan() -> None:
    problem = measured(3, bench())
    start = Start.without(problem, without_effects(problem, [np.zeros(1)]).estimate)
    assert scan_effect(problem, start, EFFECTS[3]) is None


def test_parts_of_an_integral_add_up_to_the_whole() -> None:
    logs, step = -(np.linspace(0.0, 3.0, 31) ** 2), 0.1
    whole = _log_integral(logs, step)
    assert whole == pytest.approx(np.log(0.5 * np.sqrt(np.pi)), abs=2e-3)
    for first in (1, 9, 30):
        below, above = logs.copy(), logs.copy()
        below[first:], above[:first] = -np.inf, -np.inf
        parts = [_log_integral(part, step) for part in (below, above)]
        assert np.logaddexp(*parts) == pytest.approx(whole, abs=0.01)
    assert _log_integral(np.full(5, -np.inf), step) == -np.inf


def _stepping(strength: float, noise: float = 0.3) -> InferenceProblem:
    """Numbers that step up somewhere, at any of forty places; places behind the last are empty."""

    def steps(parameters):
        beams = parameters.optics.interference
        return beams.fade_per_h + beams.hop * (np.linspace(0, 4, 120) > beams.hop_after_h)

    truth = with_part(BenchParameters(), "optics.interference", hop=strength, hop_after_h=1.52)
    y = steps(truth) + noise * np.random.default_rng(5).standard_normal(120)
    places = [Coordinates("step", time=f"t{k // 30}") for k in range(120)]
    group = observable_group(
        "steps", Observable.MAPS, y, np.full(120, noise), places, ("optics",), steps
    )
    return InferenceProblem([group], BenchParameters(), (LEVEL,))


_STEP = Effect(
    id="step", title="step", stage=Stage.OPTICS,
    parameters=(
        Parameter("size", "", 1.0, "toy", positive=True, most=3.0),
        Parameter("after", "h", 0.0, "toy", grid=tuple(np.linspace(0.05, 4.1, 40).tolist())),
    ),
    change=changed("optics.interference", put={"hop": "size", "hop_after_h": "after"}),
    reference="",
)  # fmt: skip


@pytest.mark.parametrize("strength", [0.0, 0.15, 1.0])
def test_places_that_are_not_swept_count_as_if_they_were(monkeypatch, strength: float) -> None:
    problem = _stepping(strength)
    start = Start.without(problem, without_effects(problem, [np.zeros(1)]).estimate)
    few = scan_effect(problem, start, _STEP)
    monkeypatch.setattr("diagnosis.inference.effect_scan._PLACES", 40)
    all_of_them = scan_effect(problem, start, _STEP)
    assert few.log_evidence == pytest.approx(all_of_them.log_evidence, abs=0.02)
    assert few.log_hidden == pytest.approx(all_of_them.log_hidden, abs=0.02)
    if not strength:
        # In the middle, steps of 0.11 show: 0.28 of two decades are below. At the ends it is more.
        assert 0.28 < np.exp(few.log_hidden - start.weighed.log_evidence) < 0.45


def test_a_direction_that_gains_nothing_has_no_part_in_the_gain_of_the_other() -> None:
    """The noise that seems large without the effect is small with it, in its direction only."""
    problem = measured(3, bench(leak=0.4))
    null = without_effects(problem, [np.zeros(1)])
    found = scan_effect(problem, Start.without(problem, null.estimate), EFFECTS[0])
    assert found is not None
    assert found.elsewhere.count == 2
    assert found.log_evidence > null.log_evidence + 50
    assert found.elsewhere.log_evidence < null.log_evidence
