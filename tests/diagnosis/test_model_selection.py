"""Candidates on a bench whose truth is known."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from diagnosis.inference.candidate_search import refit_from_elsewhere, refit_without_effects
from diagnosis.inference.candidates import d_prime, fit_fully, without_effects
from diagnosis.inference.model_selection import (
    probability_range,
    refit_candidate,
    select_model,
)
from diagnosis.inference.probabilities import (
    NONE,
    PRIOR,
    UNKNOWN,
    Evidence,
    log_odds_with_unknown,
    log_probabilities,
    unseen_share,
)
from diagnosis.inference.problem import InferenceProblem, LocatedEffect
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters, more
from tests.diagnosis.toy import AT, EFFECTS, bench, effect, fitted, measured


def probabilities(problem):
    return {
        name: np.exp(log) for name, log in select_model(problem, EFFECTS).log_probability.items()
    }


def test_probabilities_sum_to_one() -> None:
    assert sum(probabilities(measured(1, bench())).values()) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_named_on_a_bench_with_nothing_wrong(seed: int) -> None:
    found = probabilities(measured(seed, bench(fade_per_h=1.3)))
    assert max(found, key=found.get) == NONE


@pytest.mark.parametrize(
    ("changes", "name"),
    [({"leak": 0.4}, "slope"), ({"leak": -0.4}, "slope"), ({"crosstalk": 0.5}, "bump"),
     ({"detuning_hz": -0.3}, "offset")],
)  # fmt: skip
def test_what_is_wrong_is_named(changes: dict[str, float], name: str) -> None:
    found = probabilities(measured(3, bench(fade_per_h=-0.7, **changes)))
    assert found[name] > 0.8


def test_two_things_are_named_together() -> None:
    found = probabilities(measured(4, bench(crosstalk=0.6, detuning_hz=0.3)))
    best = max(found, key=found.get)
    assert set(best.split("+")) == {"bump", "offset"}


def test_what_no_effect_makes_is_unknown() -> None:
    found = probabilities(measured(5, bench(), extra=0.4))
    assert found[UNKNOWN] > 0.9


def test_what_a_great_effect_leaves_is_its_own_form() -> None:
    """A slope that is a tenth steeper on one side than the catalogue's, 80 standard errors long."""
    problem = measured(6, bench(leak=1.5))
    lines_, clocks = problem.groups
    steeper = replace(lines_, values=lines_.values + 0.1 * np.maximum(1.5 * AT, 0))
    found = select_model(
        type(problem)((steeper, clocks), BenchParameters(), problem.nuisances), EFFECTS
    )
    assert found.unknown_log_bayes_with["slope"] < 1
    assert found.probability["slope"] > 0.8
    # What is left where the slope does nothing is no form of it.
    found = select_model(measured(6, bench(leak=1.5), extra=0.25), EFFECTS)
    assert found.unknown_log_bayes_with["slope"] > 10
    assert found.probability[UNKNOWN] > 0.9


@pytest.mark.parametrize("detuning_hz", [0.1, 0.3, 1.0, 3.0])
def test_an_effect_that_has_its_form_exactly_is_named(detuning_hz: float) -> None:
    """All clocks are off by the same, up to sixty standard errors: as something unknown might."""
    found = select_model(measured(2, bench(detuning_hz=detuning_hz)), EFFECTS)
    assert found.probability_of_what_shows["offset"] > 0.8
    # The clocks are twenty numbers, and what one unit of an effect does is known to a tenth.
    ((size, z, error),) = found.single["offset"].size_estimates["offset"]
    assert size.scale * z == pytest.approx(detuning_hz, abs=3 * size.scale * error)
    assert size.scale * error > 0.1 * detuning_hz / np.sqrt(20)


def test_what_is_left_is_no_form_of_an_effect_that_explains_as_little() -> None:
    found = select_model(measured(5, bench(leak=0.3), extra=0.4), EFFECTS)
    assert found.probability[UNKNOWN] > 0.9


def test_effects_that_move_nothing_do_not_compete() -> None:
    found = select_model(measured(6, bench()), EFFECTS)
    assert "nothing" not in found.single
    assert set(found.signatures) == {"slope", "bump", "offset"}


def test_confusable_effects_are_no_pair() -> None:
    similar = effect("incline", "optics.interference", "leak")
    found = select_model(measured(6, bench(leak=1.5)), (*EFFECTS, similar))
    assert {"slope", "incline"} <= set(found.single)
    both = {"slope+incline", "incline+slope"}
    assert not both & set(found.log_probability)
    assert found.probability["slope"] == pytest.approx(found.probability["incline"], rel=0.01)


def test_without_nuisances_only_what_moves_nothing_is_unseen() -> None:
    found = select_model(measured(6, bench()), EFFECTS)
    assert set(found.undetectable) == {"nothing"}
    odds = found.log_probability["nothing"] - found.log_probability[NONE]
    assert odds == pytest.approx(np.log(PRIOR["one"] / 4 / PRIOR["none"]))


def _harming(parameters: BenchParameters, values: Mapping[str, float]) -> BenchParameters:
    """Do harm if there is little of it; from three deviations on it is what there is."""
    size = values["size"]
    return more(parameters, "optics.interference", leak=-0.2 * size + 0.02 * size**3)


def test_an_effect_that_shows_only_when_large_is_found() -> None:
    problem = measured(15, bench(leak=0.6))
    found = select_model(problem, (replace(EFFECTS[1], change=_harming), *EFFECTS[2:]))
    assert found.single["bump"].size_estimates["bump"][0][1] * EFFECTS[1].sizes[0].scale > 3
    assert found.probability["bump"] > 0.5


def test_sizes_come_back_within_their_errors() -> None:
    found = select_model(measured(7, bench(fade_per_h=0.5, leak=0.3)), EFFECTS).single["slope"]
    ((size, z, error),) = found.size_estimates["slope"]
    assert size.scale * z == pytest.approx(0.3, abs=4 * size.scale * error)
    by_noise = np.sqrt(found.estimate.covariance[-1, -1])
    assert size.scale * by_noise < 0.02
    # And a form that may deviate by a fifth, in bands and times by themselves.
    assert 0.01 < size.scale * error < 0.6 * 0.18 * 0.3
    assert found.names == ("slope",)


@pytest.mark.parametrize("louder", [1.0, 3.0])
def test_sizes_are_as_unsure_as_this_bench_scatters(louder: float) -> None:
    """Noise three times as loud as stated makes their errors three times as large."""
    off, errors = [], []
    for seed in range(24):
        stated = measured(seed, bench(leak=1.2))
        scattered = measured(seed, bench(leak=1.2), noise=0.05 * louder)
        blocks = [
            replace(a, values=b.values)
            for a, b in zip(stated.groups, scattered.groups, strict=True)
        ]
        problem = type(stated)(blocks, BenchParameters(), stated.nuisances)
        ((size, z, error),) = fitted(problem, EFFECTS[0]).size_estimates["slope"]
        off.append(size.scale * z - 1.2)
        errors.append(size.scale * error)
    # A form that deviates by a fifth is in the errors, and not in these draws.
    assert np.std(off) < np.mean(errors)
    noise = louder * 0.05 / np.sqrt(np.sum(AT**2) + 0.09 * np.sum(AT[:20] ** 2))
    assert np.std(off) == pytest.approx(noise, rel=0.5)
    assert np.mean(errors) > 0.9 * noise


def test_a_louder_noise_than_stated_is_no_effect() -> None:
    # Replicates that were a third too quiet: everything is off by a little more than it should be.
    problem = measured(8, BenchParameters(), noise=0.05)
    louder = measured(8, BenchParameters(), noise=0.065)
    blocks = [
        replace(a, values=b.values) for a, b in zip(problem.groups, louder.groups, strict=True)
    ]
    found = probabilities(type(problem)(blocks, BenchParameters(), problem.nuisances))
    assert max(found, key=found.get) == NONE


def _breaking(
    limit: float, parameters: BenchParameters, values: Mapping[str, float]
) -> BenchParameters:
    if abs(values["size"]) > limit:
        raise ImpossibleReedError("it breaks")
    return EFFECTS[0].change(parameters, values)


def _brittle(limit: float) -> Effect:
    """A slope that no bench has beyond a limit."""
    return replace(EFFECTS[0], change=partial(_breaking, limit))


def test_an_effect_that_is_possible_only_when_small_is_found_all_the_same() -> None:
    problem = measured(8, bench(leak=0.4))
    found = select_model(problem, (_brittle(0.45), *EFFECTS[1:]))
    assert max(found.probability, key=lambda name: found.probability[name]) == "slope"
    ((size, z, _),) = found.single["slope"].size_estimates["slope"]
    assert size.scale * z == pytest.approx(0.4, abs=0.1)


def test_searches_that_end_at_no_possible_bench_certify_nothing() -> None:
    problem = measured(9, bench(leak=0.4))
    slope = LocatedEffect(_brittle(1.0), {})
    found = fit_fully(problem, (slope,), [np.zeros(2), np.array([0.0, 3.0])])
    assert (found.consistent_starts, found.starts) == (1, 2)
    assert not found.converged
    assert fit_fully(problem, (slope,), [np.zeros(2), np.full(2, 0.3)]).converged
    with pytest.raises(ImpossibleReedError):
        fit_fully(problem, (slope,), [np.array([0.0, 3.0])])


def test_what_is_confirmed_has_been_fitted_from_two_starts() -> None:
    problem = measured(10, bench(leak=0.3))
    found = select_model(problem, EFFECTS)
    for name in ("slope", "offset"):
        candidate = refit_candidate(problem, found, name).candidate(name)
        assert candidate is not None
        assert candidate.estimate.starts > 1
    assert refit_candidate(problem, found, NONE) is found


def test_what_would_not_show_counts_as_none() -> None:
    found = select_model(measured(12, bench()), EFFECTS)
    whole, shown = found.probability, found.probability_of_what_shows
    assert sum(shown.values()) == pytest.approx(1.0)
    # What changes nothing is as likely as before, but would not show.
    assert whole["nothing"] == pytest.approx(PRIOR["one"] / 4 / PRIOR["none"] * whole[NONE])
    assert "nothing" not in shown
    assert shown[UNKNOWN] < 0.5 * whole[UNKNOWN]
    assert whole[NONE] < 0.85
    assert shown[NONE] > 0.9
    # A bump of some standard deviations shows, whichever way it is counted.
    bump = select_model(measured(12, bench(crosstalk=0.3)), EFFECTS)
    # Something unknown that would not show may be there as well.
    unseen = unseen_share(bump.evidence)
    assert bump.probability_of_what_shows["bump"] == pytest.approx(
        bump.probability["bump"] * (1 + PRIOR["also"] / PRIOR["one"] * unseen), abs=0.02
    )


def test_strengths_that_would_not_show_have_the_evidence_of_none() -> None:
    """A slope shows from 2 deviations of 2 / √20 on, and is between 0.06 and 6."""
    found = select_model(measured(12, bench(), noise=2.0), EFFECTS)
    whole, shown = found.probability, found.probability_of_what_shows
    hidden = np.log(2 * 2 / np.sqrt(20) / 0.06) / np.log(100)
    ratio = (whole["slope"] - shown["slope"]) / whole["nothing"]
    assert ratio == pytest.approx(hidden, abs=0.25)
    assert shown["slope"] < 0.5 * whole["slope"]


def test_priors_of_others_move_a_probability_by_no_more_than_their_odds() -> None:
    found = select_model(measured(12, bench(crosstalk=0.12)), EFFECTS)
    own = found.probability_of_what_shows["bump"]
    low, high = probability_range(found, ["bump"])
    assert low < own < high
    for end in (low, high):
        odds = end / (1 - end) / (own / (1 - own))
        assert 1 / 3 - 1e-9 < odds < 3 + 1e-9


def test_what_cannot_be_seen_may_still_be_unknown() -> None:
    # Nothing is off: what is unknown is as likely as before, but for what would have been seen.
    selection = select_model(measured(12, bench()), EFFECTS)
    found, before = selection.log_probability, PRIOR["unknown"] / PRIOR["none"]
    share = unseen_share(selection.evidence)
    # Next to an effect that would not show either, too.
    most = before + PRIOR["also"] / PRIOR["none"]
    assert share * before < np.exp(found[UNKNOWN] - found[NONE]) < most
    # One of four effects moves nothing; all strengths of the others show, or not where it is noisy.
    assert share == pytest.approx(2 / 6)
    noisy = select_model(measured(12, bench(), noise=2.0), EFFECTS)
    assert 2.1 / 6 < unseen_share(noisy.evidence) < 4 / 6


def test_something_unknown_next_to_an_effect_may_be_too_small_to_be_seen() -> None:
    """One of four effects is sure, one changes nothing, two have the evidence that is given."""
    null = without_effects(measured(12, bench()), [np.zeros(1)])
    lone = {
        name: replace(
            null,
            effects=(LocatedEffect(each, {}),),
            log_evidence=null.log_evidence + log,
            log_hidden=-np.inf,
        )
        for (name, log), each in zip(
            {"sure": 20.0, "one": -30.0, "other": -30.0}.items(), EFFECTS, strict=False
        )
    }
    evidence = Evidence(null, lone, -30.0, {"sure": 3.0}, ("nothing",), 4)
    share = unseen_share(evidence)
    assert share == pytest.approx(2 / 6)
    logs = log_probabilities(evidence, only_what_shows=True)
    also = PRIOR["also"] / PRIOR["one"]
    # The unknown that shows has its share of the prior and its evidence; the other is no matter.
    shown = also * (1 - share) * np.exp(3.0) / (1 + also * share)
    assert np.exp(logs[UNKNOWN] - logs["sure"]) == pytest.approx(shown)
    assert np.exp(log_odds_with_unknown(evidence)["sure"]) == pytest.approx(
        PRIOR["also"] / 4 * (1 - share) * np.exp(23.0)
    )
    whole = log_probabilities(evidence)
    every = also * (share + (1 - share) * np.exp(3.0))
    assert np.exp(whole[UNKNOWN] - whole["sure"]) == pytest.approx(every)


def test_priors_follow_from_one_another() -> None:
    assert sum(PRIOR.values()) == pytest.approx(1.0)
    assert PRIOR["none"] == 0.5
    # Of causes that are alone, and of those next to an effect, a quarter is not in the catalogue.
    two_unknown = 0.5 / 6 / 16
    alone = PRIOR["one"] + PRIOR["unknown"] - two_unknown
    assert (PRIOR["unknown"] - two_unknown) / alone == pytest.approx(0.25)
    causes = 2 * (PRIOR["two"] + PRIOR["also"] + two_unknown)
    assert (PRIOR["also"] + 2 * two_unknown) / causes == pytest.approx(0.25)


def test_a_gain_of_form_alone_is_no_signal() -> None:
    # An effect far from its form is less certain by itself: that costs likelihood.
    problem = measured(13, bench(leak=2.0))
    lines_, clocks = problem.groups
    off = 0.2 * np.random.default_rng(1).standard_normal(len(AT))
    other = replace(lines_, values=lines_.values + 2.0 * AT * off)
    problem = InferenceProblem((other, clocks), BenchParameters(), problem.nuisances)
    found = select_model(problem, EFFECTS)
    slope = found.single["slope"]
    assert np.sum(np.log(slope.deviation)) > 5
    gain = found.null.estimate.cost - slope.estimate.cost
    assert d_prime(found.null, slope) ** 2 == pytest.approx(
        gain - 2 * np.sum(np.log(slope.deviation))
    )
    assert d_prime(slope, found.null) == 0.0
    # It is the slope all the same, and alone.
    assert found.probability["slope"] > 0.9


def test_a_search_that_ends_in_a_worse_place_is_followed_by_another(monkeypatch) -> None:
    problem = measured(3, bench(leak=0.6))
    candidate = select_model(problem, EFFECTS).single["slope"]
    for agree, said in (([1, 1, 2], 2), ([1] * 9, 1)):
        turns = iter(agree)
        begun = []

        def ended(_problem, candidate, starts, begun=begun, turns=turns):
            begun.append(starts[1])
            estimate = replace(
                candidate.estimate, consistent_starts=next(turns), starts=len(starts)
            )
            return replace(candidate, estimate=estimate)

        monkeypatch.setattr("diagnosis.inference.candidate_search.refitted", ended)
        again = refit_from_elsewhere(problem, candidate, np.random.default_rng(0))
        assert again.estimate.consistent_starts == said
        assert again.estimate.converged == (said == 2)
        assert len(begun) == (3 if said == 2 else 4)
        # Each from another place, and never from where it has ended.
        assert len({start.tobytes() for start in begun}) == len(begun)


def test_the_model_without_effects_is_fitted_from_several_rivals(monkeypatch) -> None:
    problem = measured(14, bench(fade_per_h=0.5))
    good = without_effects(problem, [np.zeros(1)])
    candidates = [
        replace(
            good,
            estimate=replace(good.estimate, z=np.array([k])),
            log_evidence=good.log_evidence + 10 - float(k),
        )
        for k in range(6)
    ]

    def ended(costs):
        def fitted(_problem, starts):
            if len(starts) > 1:
                return replace(good, estimate=replace(good.estimate, starts=2, consistent_starts=2))
            cost = costs.get(int(starts[0][0]), 0.0)
            if np.isnan(cost):
                raise ImpossibleReedError("no such bench")
            estimate = replace(good.estimate, cost=good.estimate.cost + cost, starts=1)
            return replace(good, estimate=estimate)

        monkeypatch.setattr("diagnosis.inference.candidate_search.without_effects", fitted)
        return refit_without_effects(problem, good, candidates).estimate

    monkeypatch.setattr("fitting.parallel.processes._SPLITS", False)
    assert (ended({0: 9.0, 1: 9.0}).consistent_starts, ended({}).consistent_starts) == (3, 5)
    # The best of them is a little better: kept, and all that are as good agree.
    found = ended({0: 9.0, 2: -0.5})
    assert found.cost == pytest.approx(good.estimate.cost - 0.5)
    assert (found.consistent_starts, found.starts) == (4, 5)
    # One is much better: the others have agreed on something else.
    assert (ended({3: -7.0}).consistent_starts, ended({3: -7.0}).starts) == (2, 2)
    # The fifth is not asked, and of no possible bench nothing is learnt.
    assert ended({4: -7.0, 0: np.nan}).starts == 4


def test_a_better_optimum_takes_the_certificate_of_a_worse_one_away() -> None:
    problem = measured(14, bench(fade_per_h=0.5))
    good = without_effects(problem, [np.zeros(1)])
    # Two searches that agreed on something much worse.
    worse = replace(
        good,
        estimate=replace(
            good.estimate, cost=good.estimate.cost + 50, consistent_starts=2, starts=2
        ),
        log_evidence=good.log_evidence - 25,
    )
    again = refit_without_effects(problem, worse, [good])
    assert again.estimate.cost == pytest.approx(good.estimate.cost, abs=0.1)
    assert (again.estimate.consistent_starts, again.estimate.starts) == (2, 2)


def test_a_better_optimum_is_looked_for_until_two_searches_agree(monkeypatch) -> None:
    problem = measured(14, bench(fade_per_h=0.5))
    good = without_effects(problem, [np.zeros(1)])
    costly = replace(good.estimate, cost=good.estimate.cost + 50, starts=2, consistent_starts=2)
    worse = replace(good, estimate=costly, log_evidence=good.log_evidence - 25)
    for agree, said in (([1, 1, 2], 2), ([1] * 9, 1)):
        turns, begun = iter(agree), []

        def ended(_problem, starts, begun=begun, turns=turns):
            if len(starts) == 1:
                return replace(good, estimate=replace(good.estimate, starts=1))
            begun.append(starts)
            found = replace(
                good.estimate, z=np.array([len(begun)]), starts=2, consistent_starts=next(turns)
            )
            return replace(good, estimate=found)

        monkeypatch.setattr("diagnosis.inference.candidate_search.without_effects", ended)
        again = refit_without_effects(problem, worse, [good])
        assert (again.estimate.consistent_starts, len(begun)) == (said, 3 if said == 2 else 4)
        # Each begins where the last one has ended, and from another place near it.
        assert [float(first[0]) for first, _ in begun[1:]] == [1.0, 2.0, 3.0][: len(begun) - 1]
        assert len({float((near - first)[0]) for first, near in begun}) == len(begun)


def test_what_moves_no_number_by_a_thousandth_of_its_error_is_undetectable() -> None:
    (size,) = EFFECTS[0].parameters
    for most, seen in ((1e-5, False), (6.0, True)):
        effect = replace(EFFECTS[0], parameters=(replace(size, most=most),))
        # The error of a number is 0.05: the weak one moves it by 2e-4 of that.
        found = select_model(measured(1, bench()), (effect,))
        assert (effect.id in found.single) is seen
        assert (effect.id in found.undetectable) is not seen
